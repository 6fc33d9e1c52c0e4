"""Images that lie on a side or upside down, found by matching them in four orientations."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mkpc_kaggle.data.images import Image, Unreadable, read_image
from mkpc_kaggle.geometry.robust import estimate
from mkpc_kaggle.pipeline.assembly import Assembly
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.reconstruction.shortlist import most_alike

PARTNERS = 4  # that an image is matched with: those most like it, however it is turned
MANY_INLIERS = 100  # with one of them: the image is the right way up
MIN_INLIERS = 30  # of an image that is turned
MIN_GAIN = 2.0  # times the inliers that it has as it is


def find_turns(files: Sequence[Path], assembly: Assembly) -> dict[Path, int]:
    """By how many quarters, counter-clockwise, images have to be turned that match little as they are.

    The recipe's first unit matches each image with the few that are most like it. An image that has few inliers
    with all of them is tried in the three other orientations, of which the best is taken if it gains enough.
    """
    pipeline, turns = assembly.pipeline(), dict[Path, int]()

    def inliers(path: Path, times: int, partners: Sequence[Path]) -> int:
        shown = [turned(path, times), *(turned(other, turns.get(other, 0)) for other in partners)]
        pairs = [
            PairMatch(images=(shown[0], other))
            for other in shown[1:]
            if shown[0].pixels.size and other.pixels.size
        ]
        matched = pipeline.match(pairs, assembly.recipe.units[:1])
        return max((estimate(pair.matches, assembly.recipe.magsac).inlier_count for pair in matched), default=0)

    for path, near in zip(files, most_alike(files, PARTNERS), strict=True):
        partners = [files[place] for place in near]
        if (upright := inliers(path, 0, partners)) < MANY_INLIERS:
            counts = {times: inliers(path, times, partners) for times in (1, 2, 3)}
            best = max(counts, key=counts.__getitem__)
            if counts[best] >= max(MIN_INLIERS, MIN_GAIN * upright):
                turns[path] = best
    return turns


def turned(path: Path, times: int) -> Image:
    """An image turned by so many quarters; without pixels if it cannot be read."""
    image = read_image(path)
    pixels = np.zeros((0, 0, 3), np.uint8) if isinstance(image, Unreadable) else np.rot90(image.pixels, times)
    return Image(f"{path} {times}", np.ascontiguousarray(pixels))
