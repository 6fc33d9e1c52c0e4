"""A batch with matches of known cameras, for runs with a real reconstruction."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from rectified import RectifiedMatcher, Seen, batch_pairs, number_of

from benchmarks.synthetic_scene import SIZE, SyntheticScene, synthetic_scene
from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import RobustConfig
from mkpc_kaggle.recipe import Recipe, SceneConfig, Unit

QUICK = RobustConfig(max_iterations=2000)
RECIPE = Recipe((Unit(1, "synthetic", SIZE.width),), magsac=QUICK, scene=SceneConfig())


@dataclass
class SyntheticMatcher(RectifiedMatcher):
    """Gives the matches of a synthetic scene; the brightness of a flat image is its number."""

    name: str = "synthetic"
    images: int = 6
    points: int = field(default=400)  # enough for a mapper, and mapped in a second

    @cached_property
    def scene(self) -> SyntheticScene:
        return synthetic_scene(self.images, points=self.points)

    def _match(self, seen0: Seen, seen1: Seen) -> Matches:
        self.calls.append((max(seen0.view.content), seen0.brightness))
        names = [f"{number_of(seen):04}" for seen in (seen0, seen1)]
        # The scene has each pair once, in the order of `batch_pairs`.
        (found,) = (
            p.matches for p in self.scene.pairs if [p.image0.name, p.image1.name] == names
        )
        return Matches(
            seen0.view.from_image(found.points0),
            seen1.view.from_image(found.points1),
            found.scores,
        )


def synthetic_pairs(directory: Path, images: int = 6, batch: str = "batch") -> list[Pair]:
    return batch_pairs(directory, images, batch, SIZE)
