"""SIFT + LightGlue: golden vectors, and matches of turned pictures."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from golden import golden_arrays, needs_golden, seeded_tensor
from light_matchers import lightglue_matcher
from numpy.testing import assert_allclose
from pictures import as_picture, match_one, picture

from mkpc_kaggle.matchers.adapters.sift_lightglue import SHAPE, SPEC, sift_encoder
from mkpc_kaggle.matchers.contract import Placement
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher
from mkpc_kaggle.matchers.networks.lightglue import Adaptation, LightGlue

PICTURE = picture(130, 171, channels=1)


@needs_golden
def test_keypoints_and_log_assignment_are_the_golden_ones():
    golden = golden_arrays("sift_lightglue", "herz_jesus")
    glue = LightGlue(SHAPE, Adaptation(depth=-1, width=-1))
    state = glue.state_dict()
    glue.load_state_dict({name: seeded_tensor(name, tuple(x.shape)) for name, x in state.items()})
    found = []
    glue.assignment(8).register_forward_hook(lambda *call: found.append(call[-1]))
    matcher = LightGlueMatcher(SPEC, sift_encoder(512, "cpu"), glue, Placement())
    encodings = matcher.encode([as_picture(golden[f"image{number}"].numpy()) for number in (0, 1)])
    for number, keypoints in enumerate(encodings):
        parts = {"keypoints": keypoints.points + 0.25}  # OpenCV's offset
        parts |= {
            "scales": keypoints.scales,
            "oris": keypoints.orientations,
            "descriptors": keypoints.descriptors,
        }
        expected = np.hstack(
            [golden[f"{part}{number}"].reshape(len(keypoints), -1) for part in parts]
        )
        own = np.hstack([part.reshape(len(keypoints), -1) for part in parts.values()])
        off = np.abs(own[np.lexsort(own[:, :2].T)] - expected[np.lexsort(expected[:, :2].T)])
        assert (off < 1e-5 + 1e-6 * np.abs(expected)).mean() > 0.998, (
            "OpenCV 4.8 rounds some elsewhere"
        )
        assert off.max() < 2e-3
    names = {
        "points": "keypoints",
        "scales": "scales",
        "orientations": "oris",
        "descriptors": "descriptors",
    }
    given = []
    for number, each in enumerate(encodings):
        parts = {
            own: golden[f"{name}{number}"] - 0.25 * (own == "points") for own, name in names.items()
        }
        given.append([replace(each, **parts)])
    assert len(matcher.match(*given)[0]) == len(golden["matches"]) == 0
    # Down to -38. The golden values are up to 2e-4 from those in float64, so the tolerance is
    # relative, too.
    expected = golden["log_assignment"][: found[0].shape[0], : found[0].shape[1]]
    assert_allclose(found[0], expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_a_picture_matches_itself_turned_by_quarter_turns(turns):
    turned = as_picture(np.ascontiguousarray(np.rot90(PICTURE.pixels, turns)))
    matches = match_one(lightglue_matcher("sift_lightglue", Placement()), PICTURE, turned)
    points, (width, height) = matches.points0, PICTURE.content
    for _ in range(turns):
        points, width, height = np.stack([points[:, 1], width - 1 - points[:, 0]], 1), height, width
    offsets = matches.points1 - points
    assert len(matches) > 100
    assert np.mean(np.hypot(*offsets.T) < 1) > 0.9
    assert_allclose(np.median(offsets, axis=0), 0, atol=0.06)


def test_a_pixel_has_one_keypoint_and_the_strongest_are_kept():
    (few,), (many,) = (sift_encoder(features, "cpu")([PICTURE]) for features in (20, 500))
    assert len(many) == len((many.points - 0.25).round().unique(dim=0)) > 100
    assert torch.cdist(few.points, many.points).min(dim=1).values.max() < 0.5
    equal = as_picture(np.tile(np.pad(np.full((6, 6), 255, np.uint8), 13), (4, 4)))
    assert len(sift_encoder(5, "cpu")([equal])[0]) == 5
