"""vismatch's matchers as ours, by a stand-in of the same interface with known answers."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from pictures import as_picture, match_one
from standin import scene

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.vismatch import VismatchMatcher
from mkpc_kaggle.pipeline.two_stage import TwoStageMatcher
from mkpc_kaggle.recipe import Recipe, Unit, parse_recipe

PICTURE = scene(160, 200, 3)
POINTS = np.stack(np.meshgrid(np.arange(8.0, 120, 8), np.arange(8.0, 88, 8)), axis=-1).reshape(
    -1, 2
)
SHIFTED = np.add(POINTS, (3, 2))


class Vismatch:
    """``corner``: points count from the image's corner; ``confidences`` of its matches."""

    def __init__(self, corner: bool = False, confidences: np.ndarray | None = None) -> None:
        self.offset, self.confidences = 0.5 * corner, confidences
        self.skip_ransac, self.seen = False, []

    def __call__(self, *images: torch.Tensor) -> dict:
        assert self.skip_ransac, "a homography would be fitted to the matches"
        self.seen += images
        points = {
            f"matched_kpts{side}": of + self.offset for side, of in enumerate((POINTS, SHIFTED))
        }
        return points | {
            "matched_confidences": self.confidences,
            "inlier_kpts0": np.empty((0, 2)),
            "H": None,
        }


@pytest.mark.parametrize("corner", [False, True])
@pytest.mark.parametrize("confidences", [None, np.linspace(0, 1, len(POINTS))])
def test_points_are_pixels_from_the_first_ones_centre_and_confidences_are_scores(
    corner, confidences
):
    matcher = VismatchMatcher(Vismatch(corner, confidences), corner=corner)
    matches = match_one(matcher, as_picture(PICTURE), as_picture(PICTURE))
    assert_allclose(matches.points0, POINTS, atol=1e-4)
    assert_allclose(matches.points1, SHIFTED, atol=1e-4)
    assert_allclose(matches.scores, 1 if confidences is None else confidences)


def test_images_are_rgb_in_0_to_1_and_padded_to_the_multiple_in_both_stages():
    standin, recipe = Vismatch(), Recipe((Unit(1, "own", 200), Unit(2, "own", 160)))
    matchers = {"own": VismatchMatcher(standin, "own", multiple=64)}
    found = TwoStageMatcher(recipe, matchers=matchers)(PICTURE, PICTURE)
    assert [(result.failure, len(result.matches) > 20) for result in found.results] == [
        ("", True)
    ] * 2
    assert [tuple(image.shape) for image in standin.seen[:2]] == [(3, 192, 256)] * 2
    assert torch.equal(
        standin.seen[0][:, :160, :200], torch.from_numpy(PICTURE).permute(2, 0, 1) / 255
    )


def test_a_recipe_names_a_matcher_of_vismatch(monkeypatch):
    asked = []

    def get_matcher(name: str, **settings: object) -> Vismatch:
        asked.append((name, settings))
        return Vismatch(corner=True)

    monkeypatch.setitem(sys.modules, "vismatch", SimpleNamespace(get_matcher=get_matcher))
    recipe = parse_recipe(
        """
        units = [{ stage = 1, matcher = "vismatch:master", long_side = 200 }]
        [matchers."vismatch:master"]
        corner = true
        multiple = 64
        keypoints = 100
        """,
        "test",
    )
    found = TwoStageMatcher(recipe)(PICTURE, PICTURE)
    assert asked == [("master", {"device": "cpu", "max_num_keypoints": 100})]
    assert [result.unit.name for result in found.results] == ["1:vismatch:master@200"]
    assert_allclose(found.matches.points0, POINTS, atol=1e-4)
    with pytest.raises(UserError, match="refuses recipe 'test' for the weights of vismatch:master"):
        TwoStageMatcher(recipe, licence="permissive")


def test_without_vismatch_its_matchers_cannot_be_used(monkeypatch):
    monkeypatch.setitem(sys.modules, "vismatch", None)
    with pytest.raises(UserError, match="cannot be used here: vismatch:master"):
        TwoStageMatcher(Recipe((Unit(1, "vismatch:master", 200),)))
