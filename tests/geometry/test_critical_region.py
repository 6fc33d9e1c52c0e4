"""The critical region: the paper's Algorithm 1 and Crop Area Expansion; DBSCAN of merged points."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from scipy.spatial import KDTree
from sklearn.cluster import DBSCAN

from mkpc_kaggle.geometry import critical_region as regions
from mkpc_kaggle.geometry.coordinates import Box, Size
from mkpc_kaggle.geometry.critical_region import (
    MkpcConfig,
    RegionReason,
    critical_region,
    expand_box,
)

SQUARE = Size(1000, 1000)
PAPER = MkpcConfig()
BARE = MkpcConfig(expand_x=1.0, min_side=1)  # the plain bounding box, however small
SEEDS = st.integers(0, 2**32 - 1)


def block(left, top, right, bottom, n):
    """n points that span a box from pixel to pixel: two of its corners, the others anywhere in it."""
    corners = [(left, top), (right, bottom)]
    inner = np.random.default_rng(n).uniform(*corners, (n - 2, 2))
    return np.concatenate([corners, inner]).astype(np.float32)


def lone(n):
    """n points farther than eps apart, in the lower half of the square."""
    row, column = np.divmod(np.arange(n), 16)
    points = np.column_stack([20 + 60 * column, 440 + 60 * row])
    return points.astype(np.float32)


NOTHING = np.zeros((0, 2), np.float32)
FIVE = block(100, 100, 133, 133, 5)


def region(*parts, size=SQUARE, config=BARE):
    return critical_region(np.concatenate(parts), size, config)


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (NOTHING, RegionReason.TOO_FEW_POINTS),
        (block(100, 100, 101, 101, 4), RegionReason.TOO_FEW_POINTS),
        (lone(30), RegionReason.NO_CLUSTER),
        (np.concatenate([FIVE, lone(21)]), RegionReason.TOO_SCATTERED),
        (block(100, 100, 132, 130, 50), RegionReason.TOO_SMALL),
        (block(100, 100, 132, 131, 50), RegionReason.CROPPED),
        # 5 of 25 points are the 20 % that may be clustered at least.
        (np.concatenate([FIVE, lone(20)]), RegionReason.CROPPED),
    ],
    ids=[
        "empty",
        "few",
        "no cluster",
        "scattered",
        "one row too small",
        "of least side",
        "just clustered enough",
    ],
)
def test_every_region_has_its_reason_and_is_the_whole_image_unless_cropped(points, reason):
    got = critical_region(points, SQUARE, PAPER)
    assert got.reason is reason
    assert (reason is RegionReason.CROPPED) == (got.box != Box.whole(SQUARE))


def test_clusters_are_kept_down_to_the_share_largest_first_and_equal_ones_in_their_order():
    cases = [
        ([4, 100, 6, 5, 3, 50], [1, 5, 2, 3]),
        ([7, 9, 7, 9], [1, 3, 0, 2]),
        ([], []),
    ]
    for sizes, kept in cases:
        assert_array_equal(regions.keep_clusters(np.array(sizes, int), 0.05), kept)


def test_x_is_normalised_by_the_width_and_y_by_the_height():
    size = Size(1000, 200)  # eps is 50 pixels along x and 10 along y
    stack = np.full((6, 2), (500, 100), np.float32)
    # One cluster if the two stacks are within eps of each other, else two.
    cases = [
        ((40, 0), 0),
        ((60, 0), 1),
        ((0, 9), 0),
        ((0, 20), 1),
    ]
    for shift, last_label in cases:
        points = np.concatenate([stack, stack + np.float32(shift)])
        found = regions.find_clusters(points, size, PAPER)
        assert found.labels.max() == last_label
        # The same with x and y exchanged
        turned = points[:, ::-1]
        found = regions.find_clusters(turned, Size(200, 1000), PAPER)
        assert found.labels.max() == last_label


def test_the_box_grows_about_its_centre_and_holds_the_pixels_that_the_points_lie_on():
    # Pixel centres are at integers: 99.5 belongs to pixel 100, and 130.49 to pixel 130.
    points = np.array([(99.5, 100.49), (130.49, 131.4)])
    assert expand_box(points, SQUARE, 1.0, 1.0) == Box(100, 100, 131, 132)
    points = np.array([(200, 300), (399, 331)], np.float32)
    assert expand_box(points, SQUARE, 1.05, 1.0) == Box(195, 300, 405, 332)
    assert expand_box(points[:, ::-1], SQUARE, 1.0, 1.05) == Box(300, 195, 332, 405)
    # 101 columns grow by 2.525 on either side: edges are rounded outwards
    points = np.array([(200, 300), (300, 331)], np.float32)
    assert expand_box(points, SQUARE, 1.05, 1.0) == Box(197, 300, 304, 332)


def test_points_that_are_not_finite_or_not_on_the_image_are_ignored():
    clustered = block(100, 100, 130, 130, 10)
    # Pixels end at 999.5, so that point is the first outside.
    outside = [(1000, 5), (5, 999.5), (-0.75, 5)]
    not_finite = [(np.nan, 5), (5, np.inf), (-np.inf, np.nan)]
    # Thirty of each: enough for a cluster, if they counted.
    junk = np.repeat(np.float32([*not_finite, *outside]), 30, axis=0)
    assert region(clustered, junk) == region(clustered)
    assert region(junk).reason is RegionReason.TOO_FEW_POINTS


@given(
    seed=SEEDS,
    size=st.builds(Size, st.integers(1, 2000), st.integers(1, 2000)),
    config=st.builds(
        MkpcConfig,
        share=st.sampled_from([0.0, 0.05, 0.5, 1.0]),
        expand_x=st.floats(1, 3),
        expand_y=st.floats(1, 3),
        min_side=st.integers(1, 64),
    ),
)
@settings(max_examples=150, deadline=None)
def test_the_box_is_on_the_image_and_holds_every_kept_point(seed, size, config):
    rng = np.random.default_rng(seed)
    parts = [rng.uniform(-0.2, 1.2, (8, 2))]  # some outside of the image
    for _ in range(4):
        centre = rng.random(2)
        spread = rng.choice([1e-3, 0.02])
        count = rng.integers(1, 60)
        parts.append(rng.normal(centre, spread, (count, 2)))
    points = (np.concatenate(parts) * size).astype(np.float32)
    got = critical_region(points, size, config)
    box = got.box
    assert 0 <= box.left < box.right <= size.width
    assert 0 <= box.top < box.bottom <= size.height
    if got.reason is not RegionReason.CROPPED:
        assert box == Box.whole(size)
        return
    on_image = points[Box.whole(size).contains(points)]
    clusters = regions.find_clusters(on_image, size, config)
    assert box.contains(on_image[clusters.in_kept]).all()
    assert min(box.size) >= config.min_side


EPS = 0.05
MIN_SAMPLES = 5


def clumps(rng, n):
    """Six clumps of many widths, farther apart than eps, and a little noise."""
    row, column = np.divmod(np.arange(6), 3)
    centre = 0.15 + 0.3 * np.column_stack([column, row])
    # From far below the side of a merged cell (a tenth of eps) to almost eps.
    width = 10.0 ** np.linspace(-4, -1.7, 6)
    clump = rng.integers(6, size=n)
    points = centre[clump] + rng.normal(size=(n, 2)) * width[clump, None]
    # The noise: 0.2 apart, so none is within eps of another.
    noise_y = 0.1 + 0.2 * np.arange(5)
    points[:5, 0] = 0.95
    points[:5, 1] = noise_y
    return points


def scattered(rng, n):
    return rng.random((n, 2))


def all_in_one_place(_, n):
    return np.full((n, 2), 0.3)


@pytest.mark.parametrize("count", [200, regions.MERGE_ABOVE + 1])
@pytest.mark.parametrize("sample", [scattered, clumps, all_in_one_place])
def test_merged_points_have_scikit_learns_clusters(sample, count):
    points = sample(np.random.default_rng(1), count)
    merged = regions.dbscan(points, eps=EPS, min_samples=MIN_SAMPLES)
    plain = DBSCAN(eps=EPS, min_samples=MIN_SAMPLES, algorithm="kd_tree")
    expected = plain.fit_predict(points)
    # Only points at the edge of a cluster may differ; clusters have other numbers.
    is_merged = merged >= 0
    is_expected = expected >= 0
    labels = np.column_stack([merged, expected])[is_merged & is_expected]
    both = np.unique(labels, axis=0)
    assert len(both) == expected.max() + 1 == merged.max() + 1
    # A merged point moves by up to a cell's diagonal, so some points at an edge become noise.
    assert np.mean(is_merged != is_expected) < 0.002


def test_many_points_are_merged_so_that_memory_stays_linear(monkeypatch):
    seen = []
    fit = DBSCAN.fit

    def spy(self, points, sample_weight=None):
        seen.append((points, sample_weight))
        return fit(self, points, sample_weight=sample_weight)

    monkeypatch.setattr(DBSCAN, "fit", spy)
    points = clumps(np.random.default_rng(2), 20_000)
    regions.dbscan(points, eps=EPS, min_samples=MIN_SAMPLES)
    [(cells, counts)] = seen
    assert counts.sum() == 20_000
    neighbours = KDTree(cells).query_ball_point(cells, EPS, return_length=True)
    # pi 10^2 cells, and cells that the circle only touches
    assert neighbours.max() < 450
