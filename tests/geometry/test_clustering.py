"""`dbscan` with its points merged in cells, against scikit-learn's plain one."""

import numpy as np
import pytest
from scipy.spatial import KDTree
from sklearn.cluster import DBSCAN

from mkpc_kaggle.geometry.critical_region import MERGE_ABOVE, dbscan

EPS, MIN_SAMPLES = 0.05, 5


def clumps(rng, n):
    """Six clumps of many widths, farther apart than eps, and a little noise."""
    corner = np.stack([np.arange(6) % 3, np.arange(6) // 3], axis=1) * 0.3 + 0.15
    clump = rng.integers(6, size=n)
    points = corner[clump] + rng.normal(size=(n, 2)) * (10.0 ** np.linspace(-4, -1.7, 6))[clump, None]
    points[:5] = [(0.95, 0.1 + 0.2 * i) for i in range(5)]
    return points


DISTRIBUTIONS = [lambda rng, n: rng.random((n, 2)), clumps, lambda rng, n: np.full((n, 2), 0.3)]


@pytest.mark.parametrize("count", [200, MERGE_ABOVE + 1])
@pytest.mark.parametrize("sample", DISTRIBUTIONS)
def test_merged_points_have_scikit_learns_clusters(sample, count):
    points = sample(np.random.default_rng(1), count)
    merged = dbscan(points, eps=EPS, min_samples=MIN_SAMPLES)
    expected = DBSCAN(eps=EPS, min_samples=MIN_SAMPLES, algorithm="kd_tree").fit_predict(points)
    # Only points at the edge of a cluster may differ; clusters have other numbers.
    both = np.unique(np.column_stack([merged, expected])[(merged >= 0) & (expected >= 0)], axis=0)
    assert len(both) == expected.max() + 1 == merged.max() + 1
    assert np.mean((merged >= 0) != (expected >= 0)) < 0.002


def test_many_points_are_merged_so_that_memory_stays_linear(monkeypatch):
    seen = []
    fit = DBSCAN.fit

    def spy(self, points, sample_weight=None):
        seen.append((points, sample_weight))
        return fit(self, points, sample_weight=sample_weight)

    monkeypatch.setattr(DBSCAN, "fit", spy)
    dbscan(clumps(np.random.default_rng(2), 20_000), eps=EPS, min_samples=MIN_SAMPLES)
    [(cells, counts)] = seen
    assert counts.sum() == 20_000
    # pi 10^2 cells, and those that the circle only touches
    assert KDTree(cells).query_ball_point(cells, EPS, return_length=True).max() < 450
