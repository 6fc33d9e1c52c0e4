"""Images that lie on a side or upside down, found by matching them in four orientations."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mkpc_kaggle.data.images import Image, Unreadable, read_image
from mkpc_kaggle.geometry.robust import estimate
from mkpc_kaggle.pipeline.assembly import Assembly
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.reconstruction.shortlist import similarities

PARTNERS = 4  # that an image is matched with: those most like it, however it is turned
MIN_INLIERS = 30  # with one of them: the image matches


def find_turns(files: Sequence[Path], assembly: Assembly) -> dict[Path, int]:
    """By how many quarters, counter-clockwise, images have to be turned that match nothing as they are.

    The recipe's first unit matches each image with the few that are most like it. An image that matches none of
    them is tried in the three other orientations, and the one with most inliers is taken if they are enough.
    """
    pipeline = assembly.pipeline()
    similarity = similarities(files)
    np.fill_diagonal(similarity, -np.inf)
    near = np.argsort(-similarity, axis=1, kind="stable")[:, :PARTNERS]
    turns: dict[Path, int] = {}

    def inliers(place: int, times: int) -> int:
        image = _turned(files[place], times)
        partners = [_turned(files[other], turns.get(files[other], 0)) for other in near[place] if other != place]
        pairs = [PairMatch(images=(image, other)) for other in partners if image is not None and other is not None]
        matched = pipeline.match(pairs, assembly.recipe.units[:1])
        found = [estimate(pair.matches, assembly.recipe.magsac) for pair in matched]
        return max((each.inlier_count for each in found if not each.failure), default=0)

    for place, path in enumerate(files):
        if inliers(place, 0) < MIN_INLIERS:
            counts = {times: inliers(place, times) for times in (1, 2, 3)}
            best = max(counts, key=counts.__getitem__)
            if counts[best] >= MIN_INLIERS:
                turns[path] = best
    return turns


def _turned(path: Path, times: int) -> Image | None:
    image = read_image(path)
    if isinstance(image, Unreadable):
        return None
    return Image(f"{path} {times}", np.ascontiguousarray(np.rot90(image.pixels, times)))
