"""Matchers with genuine weights against golden vectors of the original networks, on photographs."""

import json
from functools import cache

import cv2
import numpy as np
import pytest
import torch
from genuine import genuine_files, genuine_store
from golden import GOLDEN, needs_golden
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.spatial import KDTree
from shared import DATA, needs_data

from mkpc_kaggle.geometry.coordinates import Box, Size, View
from mkpc_kaggle.matchers.contract import Matcher, Picture, Placement
from mkpc_kaggle.matchers.registry import MATCHERS, load_matcher, spec_of
from mkpc_kaggle.matchers.sparse import Keypoints

pytestmark = pytest.mark.genuine
KEYPOINTS = 2048
PAIRS = (0, 2)  # of three: a building and a castle
SAME_PX = 0.01  # positions agree to 1e-4
MULTIPLE = 32  # of the sides of the golden pictures

Scores = dict[tuple[float, ...], float]  # by the coordinates of a match's two points


def test_all_matchers_with_genuine_files_load_them():
    slots = {file.slot for file in genuine_files()}
    loaded = []
    for name in MATCHERS:
        spec = spec_of(name, "test")
        if spec.slots and slots.issuperset(spec.slots_for(spec.options())):
            load_matcher(name, genuine_store(), spec.options(), Placement())
            loaded.append(name)
    assert loaded == ["aliked", "aliked_lightglue", "disk_lightglue", "xfeat_lighterglue"]


@cache
def matcher_of(name: str, **options: float) -> Matcher[Keypoints]:
    chosen = spec_of(name, "test").options(features=KEYPOINTS, **options)
    return load_matcher(name, genuine_store(), chosen, Placement())


@cache
def golden() -> dict[str, NDArray[np.float32]]:
    with np.load(GOLDEN / "genuine" / "genuine.npz") as file:
        return {name: file[name] for name in file}


@cache
def picture(pair: int, side: int) -> Picture:
    """Return the picture that the original networks saw; see the README of the golden vectors."""
    index = json.loads((GOLDEN / "genuine" / "genuine.json").read_text())
    path = index["pairs"][pair][side]
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    stored = cv2.imread(str(DATA / "train" / path), flags)
    if stored.shape[1] > 1100:
        stored = cv2.resize(stored, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    height, width = (MULTIPLE * (length // MULTIPLE) for length in stored.shape[:2])
    size = Size(width, height)
    pixels = np.ascontiguousarray(stored[:height, :width, ::-1])
    return Picture(pixels, View(Box.whole(size), size, size))


def golden_keypoints(detector: str, pair: int, side: int) -> Keypoints:
    points = golden()[f"{pair}/{detector}/keypoints{side}"]
    descriptors = golden()[f"{pair}/{detector}/descriptors{side}"]
    size = picture(pair, side).content
    return Keypoints(torch.from_numpy(points), torch.from_numpy(descriptors), size)


@needs_data
@needs_golden
@pytest.mark.parametrize(
    ("detector", "matcher", "least", "mean"),
    # The original ALIKED also keeps keypoints on the flanks of stronger ones.
    [("aliked", "aliked", 0.65, 0.94), ("xfeat", "xfeat_lighterglue", 0.99, 0.999)],
)
def test_keypoints_and_descriptors_are_the_originals(detector, matcher, least, mean):
    shares = []
    for pair in PAIRS:
        for side in (0, 1):
            expected = golden_keypoints(detector, pair, side)
            (found,) = matcher_of(matcher).encode([picture(pair, side)])
            # Equal scores at the limit may keep or lose a keypoint.
            assert abs(len(found) - KEYPOINTS) <= 2
            distances, nearest = KDTree(found.points).query(expected.points)
            same = distances < SAME_PX
            shares.append(same.mean())
            of_same = found.descriptors[nearest[same]]
            assert_allclose(of_same, expected.descriptors[same], atol=1e-3)
    assert min(shares) >= least
    assert np.mean(shares) >= mean


def matches_of(name: str, pair: int, kind: str, **options: float) -> tuple[Scores, Scores]:
    """Return the scores of our matches and of the golden ones, both on the golden keypoints."""
    detector = name.partition("_")[0]
    first = golden_keypoints(detector, pair, 0)
    second = golden_keypoints(detector, pair, 1)
    (found,) = matcher_of(name, **options).match([first], [second])
    ours = by_points(found.points0, found.points1, found.scores)
    index0, index1 = golden()[f"{pair}/{name}/{kind}/matches"].T
    scores = golden()[f"{pair}/{name}/{kind}/scores"]
    expected = by_points(first.points[index0].numpy(), second.points[index1].numpy(), scores)
    return ours, expected


def by_points(*columns: NDArray[np.float32]) -> Scores:
    return {tuple(row): score for *row, score in np.column_stack(columns).tolist()}


GLUES = pytest.mark.parametrize("name", ["aliked_lightglue", "xfeat_lighterglue"])


@needs_data
@needs_golden
@pytest.mark.parametrize("pair", PAIRS)
@GLUES
def test_all_layers_find_the_originals_matches_of_its_keypoints(name, pair):
    ours, expected = matches_of(name, pair, "full", depth_confidence=-1, width_confidence=-1)
    # A score at the threshold may fall on either side of it.
    common = expected.keys() & ours.keys()
    assert len(common) >= 0.995 * len(expected.keys() | ours.keys())
    own_scores = [ours[row] for row in common]
    scores = [expected[row] for row in common]
    assert_allclose(own_scores, scores, atol=1e-3)


@needs_data
@needs_golden
@pytest.mark.parametrize("pair", PAIRS)
@GLUES
def test_early_stopping_and_pruning_find_nearly_the_originals_matches(name, pair):
    """By default, as published. Which keypoints are dropped depends on rounding."""
    ours, expected = matches_of(name, pair, "early")
    assert abs(len(ours) - len(expected)) <= 0.02 * len(expected)
    assert len(expected.keys() & ours.keys()) >= 0.98 * len(expected)
