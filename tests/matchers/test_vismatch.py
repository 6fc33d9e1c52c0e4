"""vismatch's matchers as ours, by a stand-in of the same interface."""

import numpy as np
import torch
from numpy.testing import assert_allclose
from pictures import as_picture
from standin import scene
from vismatch_standin import OrbLikeVismatch

from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.matchers.vismatch import VismatchMatcher
from mkpc_kaggle.pipeline.two_stage import TwoStageMatcher
from mkpc_kaggle.recipe import Recipe, Unit

SIZE, SHIFT = Size(200, 160), 24
WHOLE = scene(SIZE.height, SIZE.width + SHIFT, 3)
LEFT, RIGHT = (np.ascontiguousarray(WHOLE[:, shift:][:, : SIZE.width]) for shift in (0, SHIFT))


def matched(matcher: VismatchMatcher) -> Matches:
    multiple = matcher.spec.multiple
    encoded = [matcher.encode([as_picture(pixels, multiple)]) for pixels in (LEFT, RIGHT)]
    (matches,) = matcher.match(*encoded)
    return matches


def test_points_are_where_the_matcher_saw_them() -> None:
    matches = matched(VismatchMatcher(OrbLikeVismatch()))
    offsets = matches.points1 - matches.points0
    good = np.abs(offsets - (-SHIFT, 0)).max(axis=1) < 1
    assert good.sum() > 50
    assert good.mean() > 0.5
    assert len(set(matches.scores)) > 10


def test_points_counted_from_the_corner_become_points_counted_from_the_first_pixels_centre() -> None:
    plain = matched(VismatchMatcher(OrbLikeVismatch()))
    corner = matched(VismatchMatcher(OrbLikeVismatch(offset=0.5), corner=True))
    assert_allclose(corner.points0, plain.points0, atol=1e-4)
    assert_allclose(corner.points1, plain.points1, atol=1e-4)


def test_images_are_rgb_in_0_to_1_and_padded_to_the_multiple() -> None:
    standin = OrbLikeVismatch()
    matched(VismatchMatcher(standin, multiple=64))
    assert [tuple(image.shape) for image in standin.seen] == [(3, 192, 256)] * 2
    content = standin.seen[0][:, : SIZE.height, : SIZE.width]
    assert torch.equal(content, torch.from_numpy(LEFT).permute(2, 0, 1) / 255)


def test_both_stages_run_with_it() -> None:
    recipe = Recipe((Unit(1, "orb", 200), Unit(2, "orb", 160)))
    match = TwoStageMatcher(recipe, matchers={"orb": VismatchMatcher(OrbLikeVismatch(), "orb", multiple=8)})(
        LEFT, RIGHT
    )
    assert [result.failure for result in match.results] == ["", ""]
    assert all(len(result.matches) > 20 for result in match.results)
