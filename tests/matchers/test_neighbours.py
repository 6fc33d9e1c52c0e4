"""Mutual nearest neighbours against a brute force in numpy."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from mkpc_kaggle.matchers import neighbours
from mkpc_kaggle.matchers.neighbours import mutual_neighbours


def unit(rng, n, dimension=16):
    descriptors = rng.normal(size=(n, dimension))
    return descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)


def related(seed, n, m, dimension=16):
    """Descriptors of two images, about half of them seen in both."""
    rng = np.random.default_rng(seed)
    first = unit(rng, n, dimension)
    second = unit(rng, m, dimension)
    common = min(n, m) // 2
    chosen = first[rng.permutation(n)[:common]]
    noise = 0.05 * rng.normal(size=(common, dimension))
    second[:common] = chosen + noise
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    return first, second


def brute_force(first, second):
    """index0, index1, similarity and ratio, from all distances."""
    distance = np.linalg.norm(first[:, None] - second[None], axis=2)
    to1 = distance.argmin(axis=1)
    to0 = distance.argmin(axis=0)
    is_mutual = to0[to1] == np.arange(len(first))
    index0 = np.flatnonzero(is_mutual)
    index1 = to1[index0]
    similarity = first @ second.T
    ratios = []
    for i, j in zip(index0, index1, strict=True):
        # Without a second neighbour: 2 is the largest distance of unit vectors.
        second_of_row = min(np.delete(distance[i], j), default=2.0)
        second_of_column = min(np.delete(distance[:, j], i), default=2.0)
        ratios.append(distance[i, j] / min(second_of_row, second_of_column))
    return index0, index1, similarity[index0, index1], np.array(ratios)


def found(first, second):
    descriptors = [torch.tensor(each, dtype=torch.float64) for each in (first, second)]

    got = mutual_neighbours(*descriptors)
    parts = (got.index0, got.index1, got.similarity, got.ratio)
    return tuple(part.numpy() for part in parts)


# One and two descriptors have no second neighbour, or just one.
@pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 9), (9, 1), (2, 2), (150, 61), (61, 150)])
# Blocks that end within, at and after the last row.
@pytest.mark.parametrize("rows", [7, 61, 4096])
def test_neighbours_are_those_of_brute_force_in_blocks_of_any_size(n, m, rows, monkeypatch):
    monkeypatch.setattr(neighbours, "BLOCK_ROWS", {"cpu": rows})
    first, second = related(n, n, m)
    index0, index1, *values = found(first, second)
    true0, true1, *true_values = brute_force(first, second)
    assert_array_equal(index0, true0)
    assert_array_equal(index1, true1)
    for value, truth in zip(values, true_values, strict=True):
        assert_allclose(value, truth, rtol=0, atol=1e-9)


@pytest.mark.parametrize("max_ratio", [0.0, 0.3, 0.8])
def test_a_maximum_ratio_drops_pairs_and_changes_no_others(max_ratio):
    descriptors = [torch.tensor(each) for each in related(3, 150, 61)]
    every = mutual_neighbours(*descriptors)
    kept = mutual_neighbours(*descriptors, max_ratio)
    passed = every.ratio <= max_ratio
    assert_array_equal(kept.index0, every.index0[passed])
    assert_array_equal(kept.index1, every.index1[passed])
    assert_allclose(kept.similarity, every.similarity[passed], atol=1e-9)
    assert_allclose(kept.ratio, every.ratio[passed], atol=1e-9)


@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 5), (5, 0)])
def test_no_descriptors_give_no_pairs(n, m):
    # A blank picture has no keypoints, and torch's minimum of nothing is an error.
    parts = found(np.zeros((n, 8)), np.zeros((m, 8)))
    assert [part.shape for part in parts] == [(0,)] * 4


def test_a_pair_whose_second_neighbour_is_as_near_is_ambiguous():
    x = [1.0, 0.0]
    y = [0.0, 1.0]
    # At distance 0 the ratio is 0 / 0: repeated texture must not pass as a perfect match.
    *_, ratios = found(np.array([x, y]), np.array([x, x, y]))
    assert_allclose(ratios, [1, 0], atol=1e-5)
    near = [np.cos(0.1), np.sin(0.1)]
    *_, ratios = found(np.array([x]), np.array([near, near]))
    assert_allclose(ratios, [1])
