"""vismatch's matchers as ours, by a stand-in of the same interface with known answers."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from pictures import as_picture, match_one
from sklearn.datasets import load_sample_image
from standin import scene

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.vismatch import VismatchMatcher
from mkpc_kaggle.pipeline.two_stage import TwoStageMatcher
from mkpc_kaggle.recipe import Recipe, Unit, parse_recipe

PICTURE = scene(160, 200, 3)
GRID = np.meshgrid(np.arange(8.0, 120, 8), np.arange(8.0, 88, 8))
POINTS = np.stack(GRID, axis=-1).reshape(-1, 2)
SHIFTED = np.add(POINTS, (3, 2))


class Vismatch:
    """``corner``: points count from the image's corner; ``confidences`` of its matches."""

    def __init__(self, corner: bool = False, confidences: np.ndarray | None = None) -> None:
        self.offset = 0.5 * corner
        self.confidences = confidences
        self.skip_ransac = False  # vismatch's default
        self.seen = []

    def __call__(self, *images: torch.Tensor) -> dict:
        assert self.skip_ransac, "a homography would be fitted to the matches"
        self.seen += images
        return {
            "matched_kpts0": POINTS + self.offset,
            "matched_kpts1": SHIFTED + self.offset,
            "matched_confidences": self.confidences,
            # Empty without RANSAC: a matcher that took these would find nothing.
            "inlier_kpts0": np.empty((0, 2)),
            "H": None,
        }


# Its matchers count pixels from a corner or from a centre, and some have no confidences.
@pytest.mark.parametrize("corner", [False, True])
@pytest.mark.parametrize("confidences", [None, np.linspace(0, 1, len(POINTS))])
def test_the_centre_of_the_first_pixel_is_at_0_and_confidences_are_scores(corner, confidences):
    matcher = VismatchMatcher(Vismatch(corner, confidences), corner=corner)
    matches = match_one(matcher, as_picture(PICTURE), as_picture(PICTURE))
    assert_allclose(matches.points0, POINTS, atol=1e-4)
    assert_allclose(matches.points1, SHIFTED, atol=1e-4)
    assert_allclose(matches.scores, 1 if confidences is None else confidences)


def test_images_are_rgb_in_0_to_1_and_padded_to_the_multiple_in_both_stages():
    standin = Vismatch()
    recipe = Recipe((Unit(1, "own", 200), Unit(2, "own", 160)))
    matchers = {"own": VismatchMatcher(standin, "own", multiple=64)}
    found = TwoStageMatcher(recipe, matchers=matchers)(PICTURE, PICTURE)
    for result in found.results:
        assert result.failure == ""
        assert len(result.matches) > 20
    # 160 x 200, padded to multiples of 64.
    assert [tuple(image.shape) for image in standin.seen[:2]] == [(3, 192, 256)] * 2
    expected = torch.from_numpy(PICTURE).permute(2, 0, 1) / 255
    assert torch.equal(standin.seen[0][:, :160, :200], expected)


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
    # vismatch downloads weights of all licences, which the manifest does not know.
    with pytest.raises(UserError, match="refuses recipe 'test' for the weights of vismatch:master"):
        TwoStageMatcher(recipe, licence="permissive")


def test_without_vismatch_its_matchers_cannot_be_used(monkeypatch):
    monkeypatch.setitem(sys.modules, "vismatch", None)
    with pytest.raises(UserError, match="cannot be used here: vismatch:master"):
        TwoStageMatcher(Recipe((Unit(1, "vismatch:master", 200),)))


def test_a_genuine_matcher_of_vismatch_runs():
    """On OpenCV's SIFT, which needs no weights."""
    pytest.importorskip("vismatch", reason="vismatch is not installed")
    image = load_sample_image("china.jpg")
    recipe = Recipe((Unit(1, "vismatch:sift-nn", 640),))
    match = TwoStageMatcher(recipe, device="cpu")(image, image)
    assert match.estimate.inlier_count > 500
    assert np.abs(match.inliers.points0 - match.inliers.points1).max() < 1
