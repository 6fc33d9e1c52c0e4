"""A batch whose matches are those of known cameras, for runs with a real reconstruction."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from rectified import RectifiedMatcher, Seen

from benchmarks.synthetic_scene import SIZE, SyntheticScene, synthetic_scene
from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.recipe import Recipe, SceneConfig, Unit

DARKEST, STEP = 10, 10  # the brightness of the first image, and by how much each next image is brighter
RECIPE = Recipe((Unit(1, "synthetic", SIZE.width),), scene=SceneConfig())


@dataclass
class SyntheticMatcher(RectifiedMatcher):
    """Finds the matches of a synthetic scene in flat images, which it tells by their brightness."""

    name: str = "synthetic"
    images: int = 6
    points: int = field(default=400)

    @cached_property
    def scene(self) -> SyntheticScene:
        return synthetic_scene(self.images, points=self.points)

    def _match(self, seen0: Seen, seen1: Seen) -> Matches:
        self.calls.append((max(seen0.view.content), seen0.brightness))
        names = [f"{(seen.brightness - DARKEST) // STEP:04}" for seen in (seen0, seen1)]
        (found,) = (p.matches for p in self.scene.pairs if [p.image0.name, p.image1.name] == names)
        return Matches(seen0.view.from_image(found.points0), seen1.view.from_image(found.points1), found.scores)


def synthetic_pairs(directory: Path, images: int = 6) -> list[Pair]:
    """All pairs of the flat images, in one batch."""
    directory.mkdir(parents=True, exist_ok=True)
    paths = [directory / f"{number}.png" for number in range(images)]
    for number, path in enumerate(paths):
        cv2.imwrite(str(path), np.full((SIZE.height, SIZE.width, 3), DARKEST + STEP * number, np.uint8))
    chosen = [(i, j) for i in range(images) for j in range(i + 1, images)]
    return [Pair(f"batch;{i}-{j}", "batch", str(paths[i]), str(paths[j])) for i, j in chosen]
