"""What a matcher finds on critical regions and on whole images at one long side, compared with the true cameras.

python -m benchmarks.views --train-dir DIR [--weights DIR] [--pairs-per-scene 6] [--matchers sift,aliked]

A unit of stage 1 at one size gives the regions; then the same matcher looks at whole images and at the regions at
its second size. A match is right that lies within 3 pixels of the true epipolar geometry. Tables in Markdown, by
scene, means over pairs.
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from statistics import fmean

import cv2
import numpy as np
from tqdm import tqdm

from benchmarks.table1 import LONG_SIDES, MOST_MATCHES, OPTIONS
from mkpc_kaggle.data.competition import TrainScene, TruePair, read_train_side
from mkpc_kaggle.data.images import Image, Unreadable, read_image
from mkpc_kaggle.geometry.cameras import fundamental_of_cameras
from mkpc_kaggle.geometry.coordinates import Points, Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import ModelKind, RobustConfig, estimate, sampson_distances
from mkpc_kaggle.pipeline.assembly import assemble
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.pipeline.stages import Pipeline
from mkpc_kaggle.recipe import Recipe, Unit

RIGHT = 3.0
"""Pixels."""
PLANE = 3.0


@dataclass(frozen=True)
class Seen:
    """What one kind of view showed of one pair.

    ``right`` is the share of the matches that are; of these, ``error`` is the median distance in pixels, ``cover``
    the share of the images within their convex hull, ``plane`` the share that one homography fits.
    """

    matches: float
    right: float
    error: float
    cover: float
    plane: float

    @classmethod
    def of(cls, matches: Matches, true: TruePair, images: tuple[Image, Image]) -> "Seen":
        if not len(matches):
            return cls(0, np.nan, np.nan, 0, np.nan)
        distances = sampson_distances(fundamental_of_cameras(true.camera0, true.camera1), matches)
        is_right = distances < RIGHT
        right = matches[is_right]
        covers = [hull_share(right.points0, images[0].size), hull_share(right.points1, images[1].size)]
        error = float(np.median(distances[is_right])) if len(right) else np.nan
        plane = estimate(right, RobustConfig(threshold=PLANE), ModelKind.H)
        share = plane.inlier_count / len(right) if plane.ok else np.nan
        return cls(len(matches), float(is_right.mean()), error, fmean(covers), share)


def hull_share(points: Points, size: Size) -> float:
    """The share of an image that the convex hull of points takes."""
    if len(points) < 3:
        return 0.0
    return float(cv2.contourArea(cv2.convexHull(points))) / (size.width * size.height)


@dataclass(frozen=True)
class Views:
    """One pair on whole images and on its regions, which stage 2 shows ``enlarged`` so many times as much."""

    whole: Seen
    crop: Seen
    enlarged: float


def look(images: tuple[Image, Image], true: TruePair, pipeline: Pipeline) -> Views | None:
    """One pair; ``None`` where a region is the whole image, and there is nothing to compare."""
    first, second = pipeline.recipe.units
    (work,) = pipeline.match([PairMatch(images=images)], [first, second])
    if work.regions is None or not all(region.cropped for region in work.regions):
        return None
    (whole,) = pipeline.match([PairMatch(images=images)], [replace(second, stage=1)])
    enlarged = [
        max(image.size.width, image.size.height) / max(region.box.size.width, region.box.size.height)
        for image, region in zip(images, work.regions, strict=True)
    ]
    found = [Seen.of(one.results[-1].matches, true, images) for one in (whole, work)]
    return Views(*found, fmean(enlarged))


def looks(scene: TrainScene, pipeline: Pipeline) -> list[Views | None]:
    """The pairs of a scene; those with an image that cannot be read are left out."""
    found = []
    for true in tqdm(scene.pairs, desc=f"{scene.name}, {pipeline.recipe.name}", unit="pair", leave=False):
        image0, image1 = map(read_image, true.pair.images)
        if not isinstance(image0, Unreadable) and not isinstance(image1, Unreadable):
            found.append(look((image0, image1), true, pipeline))
    return found


def recipe_of(matcher: str) -> Recipe:
    first, second = LONG_SIDES[matcher][:2]
    most = MOST_MATCHES.get(matcher, 4096)
    options = {matcher: OPTIONS[matcher]} if matcher in OPTIONS else {}
    return Recipe((Unit(1, matcher, first, most), Unit(2, matcher, second, most)), matcher, matchers=options)


def table(found: Mapping[str, Sequence[Views | None]]) -> Iterator[str]:
    """A row a scene; each cell has the mean on whole images, then on the regions."""
    names = [field.name for field in fields(Seen)]
    yield f"| scene | pairs | cropped | enlarged | {' | '.join(names)} |"
    yield f"|{' --- |' * (4 + len(names))}"
    for scene, views in found.items():
        cropped = [one for one in views if one is not None]
        if not cropped:
            yield f"| {scene} | {len(views)} | 0 |{' |' * (1 + len(names))}"
            continue
        enlarged = fmean(one.enlarged for one in cropped)
        cells = []
        for name in names:
            sides = [np.nanmean([getattr(getattr(v, side), name) for v in cropped]) for side in ("whole", "crop")]
            form = ".0f" if name == "matches" else ".2f"
            cells.append(" -> ".join(format(value, form) for value in sides))
        yield f"| {scene} | {len(views)} | {len(cropped)} | {enlarged:.1f} | {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train-dir", type=Path, required=True)
    parser.add_argument("--weights", type=Path, action="append", default=[])
    parser.add_argument("--matchers", default=",".join(LONG_SIDES), help="default: %(default)s")
    parser.add_argument("--pairs-per-scene", type=int, help="evenly spread; default: all")
    parser.add_argument("--min-covisibility", type=float, default=0.1)
    arguments = parser.parse_args()
    scenes = read_train_side(
        arguments.train_dir,
        min_covisibility=arguments.min_covisibility,
        pairs_per_scene=arguments.pairs_per_scene,
    )
    for matcher in arguments.matchers.split(","):
        pipeline = assemble(recipe_of(matcher), weights=arguments.weights).pipeline()
        found = {scene.name: looks(scene, pipeline) for scene in scenes}
        print("\n".join(["", f"### {matcher}", "", *table(found)]), flush=True)


if __name__ == "__main__":
    main()
