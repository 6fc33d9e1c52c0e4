"""SIFT + LightGlue: golden vectors, and matches of turned pictures."""

from dataclasses import replace

import numpy as np
import pytest
from golden import golden_arrays, needs_golden, seeded_tensor
from light_matchers import lightglue_matcher
from numpy.testing import assert_allclose
from pictures import as_picture, match_one, picture

from mkpc_kaggle.matchers.adapters.sift_lightglue import SHAPE, SPEC, sift_encoder
from mkpc_kaggle.matchers.contract import Placement
from mkpc_kaggle.matchers.lightglue import LightGlueMatcher
from mkpc_kaggle.matchers.networks.lightglue import LightGlue

PICTURE = picture(130, 171, channels=1)


def seeded_network() -> LightGlue:
    """LightGlue with the weights of the golden vectors."""
    glue = LightGlue(SHAPE, depth=-1, width=-1)
    seeded = {}
    for name, tensor in glue.state_dict().items():
        seeded[name] = seeded_tensor(name, tuple(tensor.shape))
    glue.load_state_dict(seeded)
    return glue


def by_position(rows):
    return rows[np.lexsort(rows[:, :2].T)]


@needs_golden
def test_keypoints_and_log_assignment_are_the_golden_ones():
    golden = golden_arrays("sift_lightglue", "herz_jesus")
    glue = seeded_network()
    found = []
    glue.assignment(8).register_forward_hook(lambda *call: found.append(call[-1]))
    matcher = LightGlueMatcher(SPEC, sift_encoder(512, "cpu"), glue, Placement())
    shown = [as_picture(golden[f"image{number}"].numpy()) for number in (0, 1)]
    encodings = matcher.encode(shown)
    for number, keypoints in enumerate(encodings):
        parts = {
            "keypoints": keypoints.points + 0.25,  # OpenCV's offset
            "scales": keypoints.scales,
            "oris": keypoints.orientations,
            "descriptors": keypoints.descriptors,
        }
        count = len(keypoints)
        expected = np.hstack([golden[f"{part}{number}"].reshape(count, -1) for part in parts])
        own = np.hstack([part.reshape(count, -1) for part in parts.values()])
        # Versions of OpenCV order keypoints differently.
        off = np.abs(by_position(own) - by_position(expected))
        is_close = off < 1e-5 + 1e-6 * np.abs(expected)
        assert is_close.mean() > 0.998, "OpenCV 4.8 rounds some elsewhere"
        assert off.max() < 2e-3
    # The network gets the golden keypoints themselves: two versions of OpenCV find different ones.
    given = []
    for number, each in enumerate(encodings):
        exact = replace(
            each,
            points=golden[f"keypoints{number}"] - 0.25,
            scales=golden[f"scales{number}"],
            orientations=golden[f"oris{number}"],
            descriptors=golden[f"descriptors{number}"],
        )
        given.append([exact])
    (matches,) = matcher.match(*given)
    assert len(matches) == len(golden["matches"]) == 0
    assignment = found[0]
    rows, columns = assignment.shape
    expected = golden["log_assignment"][:rows, :columns]
    # Down to -38. The golden values differ by up to 2e-4 from values in float64, so the tolerance is
    # relative, too.
    assert_allclose(assignment, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_a_picture_matches_itself_turned_by_quarter_turns(turns):
    pixels = np.rot90(PICTURE.pixels, turns)
    turned = as_picture(np.ascontiguousarray(pixels))
    matcher = lightglue_matcher("sift_lightglue", Placement())
    matches = match_one(matcher, PICTURE, turned)
    points = matches.points0
    width, height = PICTURE.content
    for _ in range(turns):
        x, y = points.T
        points = np.column_stack([y, width - 1 - x])
        width, height = height, width
    offsets = matches.points1 - points
    assert len(matches) > 100
    distances = np.linalg.norm(offsets, axis=1)
    assert np.mean(distances < 1) > 0.9
    # OpenCV's offset of a quarter pixel, uncorrected, turns with the picture: up to 0.5 apart.
    assert_allclose(np.median(offsets, axis=0), 0, atol=0.06)
