"""Time of `dbscan` beside scikit-learn's, for 20,000 points of many distributions.

python -m benchmarks.clustering

scikit-learn's is quadratic in time and memory when points are clumped: it runs on the first 4,000 points, on which
the labels are compared. Both use one thread.
"""

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from sklearn.cluster import DBSCAN

from mkpc_kaggle.geometry.clustering import dbscan

EPS = 0.05
MIN_SAMPLES = 5
POINTS = 20_000
FEASIBLE = 4_000

Points = NDArray[np.float64]
Distribution = Callable[[np.random.Generator, int], Points]


def uniform(rng: np.random.Generator, n: int) -> Points:
    return rng.random((n, 2))


def sparse(rng: np.random.Generator, n: int) -> Points:
    """About 4 points a disc of radius eps."""
    return rng.random((n, 2)) * np.sqrt(n * np.pi * EPS**2 / 4)


def blobs(*centres_and_widths: tuple[float, float, float]) -> Distribution:
    """Gaussians of equal weight, each given by x, y and standard deviation."""

    def sample(rng: np.random.Generator, n: int) -> Points:
        blob = np.array(centres_and_widths)[rng.integers(len(centres_and_widths), size=n)]
        return blob[:, :2] + rng.normal(size=(n, 2)) * blob[:, 2:]

    return sample


def lines(degrees: float, spacing: float) -> Distribution:
    """Parallel lines across the unit square."""

    def sample(rng: np.random.Generator, n: int) -> Points:
        along = rng.uniform(-0.5, 0.5, n)
        across = spacing * rng.integers(-int(0.5 / spacing), int(0.5 / spacing) + 1, n)
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        return 0.5 + np.stack([c * along - s * across, s * along + c * across], axis=1)

    return sample


def two_lines(rng: np.random.Generator, n: int) -> Points:
    """Parallel lines of 1 unit's length, 1.001 eps apart, at 10 degrees: many points a cell, none touching."""
    points = lines(0, 2.0)(rng, n) - 0.5
    points[:, 1] += 1.001 * EPS * rng.integers(2, size=n)
    c, s = np.cos(np.radians(10)), np.sin(np.radians(10))
    return points @ np.array([[c, s], [-s, c]])


def lattice(spacing: float, jitter: float = 0.0) -> Distribution:
    def sample(rng: np.random.Generator, n: int) -> Points:
        node = rng.integers(0, int(1 / spacing) + 1, (n, 2))
        return node * spacing + rng.uniform(-jitter, jitter, (n, 2))

    return sample


def coincident(rng: np.random.Generator, n: int) -> Points:
    return np.full((n, 2), 0.3)


def coincident_with_outliers(rng: np.random.Generator, n: int) -> Points:
    points = np.full((n, 2), 0.3)
    outlier = rng.random(n) < 0.005
    points[outlier] = rng.random((np.count_nonzero(outlier), 2))
    return points


def crowds_among_few(rng: np.random.Generator, n: int) -> Points:
    """One cell in 25 crowded, four points in each of the others: the most neighbours to count."""
    side = EPS / np.sqrt(2)
    cells = np.stack(np.meshgrid(np.arange(28), np.arange(28)), axis=-1).reshape(-1, 2)
    crowded = (cells % 5 == 2).all(axis=1)
    few = np.repeat(cells[~crowded], 4, axis=0)[: n // 2]
    crowd = cells[crowded][rng.integers(crowded.sum(), size=n - len(few))]
    return rng.permutation((np.concatenate([few, crowd]) + rng.random((n, 2))) * side)


def facing_arcs(rng: np.random.Generator, n: int) -> Points:
    """A tight blob and an arc around it, just beyond eps: hard for k-d trees and for separating axes."""
    half = n // 2
    angle = rng.uniform(-0.3, 0.3, n - half)
    arc = EPS * 1.002 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return rng.permutation(0.5 + np.concatenate([rng.uniform(-EPS / 2000, EPS / 2000, (half, 2)), arc]))


DISTRIBUTIONS: dict[str, Distribution] = {
    "uniform": uniform,
    "uniform, sparse": sparse,
    "one tight blob": blobs((0.5, 0.5, 0.002)),
    "one blob": blobs((0.5, 0.5, 0.05)),
    "two blobs": blobs((0.3, 0.3, 0.03), (0.7, 0.6, 0.03)),
    "two tight blobs, 1.05 eps apart": blobs((0.5, 0.5, 0.0002), (0.5485, 0.52, 0.0002)),
    "blobs of different density": blobs((0.2, 0.2, 0.001), (0.5, 0.6, 0.03), (0.6, 0.3, 0.15)),
    "on a line": lines(30, 2.0),
    "lines at 10 degrees, 1.01 eps apart": lines(10, 1.01 * EPS),
    "two lines at 10 degrees, 1.001 eps apart": two_lines,
    "lines at 45 degrees, 1.01 eps apart": lines(45, 1.01 * EPS),
    "lines at 22.5 degrees, 1.001 eps apart": lines(22.5, 1.001 * EPS),
    "all coincident": coincident,
    "coincident, a few outliers": coincident_with_outliers,
    "coincident on a lattice above eps": lattice(EPS * 1.01),
    "coincident on a lattice below eps": lattice(EPS * 0.99),
    "small blobs on a lattice above eps": lattice(EPS * 1.01, EPS * 0.004),
    "touching blobs on a lattice": lattice(EPS * 1.01, EPS * 0.02),
    "crowded cells among sparse ones": crowds_among_few,
    "a blob in the centre of an arc": facing_arcs,
}


def milliseconds(call: Callable[[], object], repeats: int) -> float:
    """The best of several runs, in the processor's time of this thread: the machine may have other work."""
    times = []
    for _ in range(repeats):
        begin = time.thread_time()
        call()
        times.append(time.thread_time() - begin)
    return 1000 * min(times)


def main() -> None:
    plain = DBSCAN(eps=EPS, min_samples=MIN_SAMPLES, algorithm="kd_tree")
    print(f"{'distribution':42}{'clusters':>9}{'ours ms':>9}{'sklearn ms':>12}  same labels")
    for name, sample in DISTRIBUTIONS.items():
        points = sample(np.random.default_rng(0), POINTS)
        few = points[:FEASIBLE]
        labels = dbscan(points, eps=EPS, min_samples=MIN_SAMPLES)
        ours = milliseconds(lambda points=points: dbscan(points, eps=EPS, min_samples=MIN_SAMPLES), 7)
        theirs = milliseconds(lambda few=few: plain.fit(few), 1)
        same = np.array_equal(dbscan(few, eps=EPS, min_samples=MIN_SAMPLES), plain.labels_)
        print(f"{name:42}{labels.max() + 1:9}{ours:9.1f}{theirs:12.1f}  {'yes' if same else 'NO'}", flush=True)


if __name__ == "__main__":
    main()
