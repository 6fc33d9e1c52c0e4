"""`dbscan` against scikit-learn's, which is the definition."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from sklearn.cluster import DBSCAN

from benchmarks.clustering import DISTRIBUTIONS
from mkpc_kaggle.geometry.clustering import dbscan


def reference(points, *, eps, min_samples):
    # The k-d tree always: the brute force that "auto" takes for a few points rounds |a|^2 - 2ab + |b|^2.
    return DBSCAN(eps=eps, min_samples=min_samples, algorithm="kd_tree").fit_predict(points)


def clumps(rng, n):
    centre = rng.random((6, 2)) * 0.6
    width = 10.0 ** rng.uniform(-4, -1, 6)
    clump = rng.integers(6, size=n)
    return centre[clump] + rng.normal(size=(n, 2)) * width[clump, None]


def parallel_lines(rng, n):
    angle = rng.uniform(0, np.pi)
    along, across = rng.random(n), rng.integers(5, size=n) * 0.127
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * along - s * across, s * along + c * across], axis=1)


def exact_lattice(rng, n):
    """Multiples of 1/8, many of them coincident: distances of exactly eps are everywhere."""
    return rng.integers(-8, 8, (n, 2)) / 8


def pythagorean_lattice(rng, n):
    """Multiples of 1/80, which are rounded, and 3-4-5 triangles: eps 1/16 is five of them."""
    return rng.integers(0, 60, (n, 2)) / 80


def far_from_the_origin(rng, n):
    return rng.random((n, 2)) - np.array([3e5, -7e6])


FAMILIES = [clumps, parallel_lines, exact_lattice, pythagorean_lattice, far_from_the_origin]
SEEDS = st.integers(0, 2**32 - 1)
EPS = st.sampled_from([0.01, 1 / 32, 0.05, 1 / 16, 0.1, 1 / 8, 0.17, 1 / 4, 0.5, 5.0])
MIN_SAMPLES = st.one_of(st.integers(1, 12), st.integers(13, 100))


@pytest.mark.parametrize("family", FAMILIES)
@given(seed=SEEDS, n=st.integers(1, 600), eps=EPS, min_samples=MIN_SAMPLES)
@settings(max_examples=120, deadline=None)
def test_labels_are_scikit_learns(family, seed, n, eps, min_samples):
    points = family(np.random.default_rng(seed), n)
    assert_array_equal(
        dbscan(points, eps=eps, min_samples=min_samples), reference(points, eps=eps, min_samples=min_samples)
    )


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_labels_are_scikit_learns_in_memory_that_is_linear_in_the_number_of_points(name):
    points = DISTRIBUTIONS[name](np.random.default_rng(1), 2000)
    points.flags.writeable = False
    assert_array_equal(dbscan(points, eps=0.05, min_samples=5), reference(points, eps=0.05, min_samples=5))
    many = DISTRIBUTIONS[name](np.random.default_rng(2), 20_000)
    tracemalloc.start()
    try:
        dbscan(many, eps=0.05, min_samples=5)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 40 << 20  # a list of all neighbours of clumped points takes gigabytes


@pytest.mark.parametrize("offset", [(0.5, 0.0), (0.0, -0.5), (0.375, 0.3125), (0.3, 0.4), (-0.4, 0.3)])
def test_a_distance_of_exactly_eps_counts(offset):
    eps = np.sqrt(offset[0] * offset[0] + offset[1] * offset[1])
    eps = eps if eps * eps >= offset[0] * offset[0] + offset[1] * offset[1] else np.nextafter(eps, 1)
    pair = np.array([(0.0, 0.0), offset])
    assert_array_equal(dbscan(pair, eps=eps, min_samples=2), [0, 0])
    assert_array_equal(dbscan(pair, eps=eps * (1 - 1e-12), min_samples=2), [-1, -1])
    assert_array_equal(dbscan(pair, eps=eps * (1 - 1e-12), min_samples=1), [0, 1])


@pytest.mark.parametrize("at", [2300, 2400, 2500, 2610])
def test_one_touching_pair_joins_crowded_cells(at):
    # Parallel lines 0.0503 apart: a cell has hundreds of points, and the point that moves is not an extreme.
    x = np.linspace(0, 1, 5000)
    points = np.concatenate([np.stack([x, 0.3 * x], axis=1), np.stack([x, 0.3 * x + 0.0525], axis=1)])
    assert dbscan(points, eps=0.05, min_samples=5).max() == 1
    points[at, 1] += 0.0002
    assert dbscan(points, eps=0.05, min_samples=5).max() == 1
    points[at, 1] += 0.0002
    assert dbscan(points, eps=0.05, min_samples=5).max() == 0


def test_a_border_point_takes_the_lowest_cluster_not_the_nearest():
    # Two crosses of five points, arms of 1: their centres alone are core; (2, 0) ... is an arm of both.
    arms = np.array([(0, 0), (0, 1), (0, -1), (-1, 0)], dtype=np.float64)
    shared = np.array([[1.0, 0.0]])
    near, far = arms * [-1, 1] + [1.75, 0], arms
    for clusters in ([near, far], [far, near]):
        points = np.concatenate([shared, *clusters])
        labels = dbscan(points, eps=1.0, min_samples=5)
        assert_array_equal(labels, [0] + [0] * 4 + [1] * 4)
        assert_array_equal(labels, reference(points, eps=1.0, min_samples=5))


def test_few_points_are_legal():
    empty = dbscan(np.empty((0, 2)), eps=0.05, min_samples=5)
    assert (empty.shape, empty.dtype) == ((0,), np.intp)
    point = np.array([[0.2, 0.7]])
    assert_array_equal(dbscan(point, eps=0.05, min_samples=1), [0])
    assert_array_equal(dbscan(point, eps=0.05, min_samples=2), [-1])
    same = np.repeat(point, 4, axis=0)
    assert_array_equal(dbscan(same, eps=1e-9, min_samples=4), [0] * 4)
    assert_array_equal(dbscan(same, eps=1e-9, min_samples=5), [-1] * 4)


@pytest.mark.parametrize(
    ("points", "eps", "min_samples", "says"),
    [
        ([[0, np.nan]], 0.05, 5, "finite"),
        ([[0, 0], [0, np.inf]], 0.05, 5, "finite"),
        ([[0, 0], [1e300, 0]], 0.05, 5, "less than"),
        (np.zeros((4, 3)), 0.05, 5, "shape"),
        (np.zeros(4), 0.05, 5, "shape"),
        (np.zeros((3, 2)), 0.0, 5, "positive"),
        (np.zeros((3, 2)), np.nan, 5, "positive"),
        (np.zeros((3, 2)), np.inf, 5, "positive"),
        (np.zeros((3, 2)), 0.05, 0, "positive"),
    ],
)
def test_what_cannot_be_clustered_is_an_error(points, eps, min_samples, says):
    with pytest.raises(ValueError, match=says):
        dbscan(np.array(points), eps=eps, min_samples=min_samples)
