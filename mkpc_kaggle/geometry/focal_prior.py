"""F of a pair under a prior on the focal lengths of its two cameras.

With known principal points, the seven degrees of freedom of F are a relative pose and two focal
lengths. The prior favours plausible focal lengths. The search minimises the negative log posterior
of the pose and of log f0 and log f1:

    sum_n rho(r_n / scale) + sum_i (log f_i - log g_i)^2 / (2 sigma_i^2),

    rho(x) = x^2 / (2 (1 + x^2)).

r is the Sampson distance in pixels (:mod:`mkpc_kaggle.geometry.two_view`), g is the expected focal
length, and rho the loss of Geman and McClure (1985). An outlier costs 0.5, as much as a log focal
length that is one sigma off. The prior matters only if the matches do not determine the focal
lengths. A match whose point lies behind a camera is an outlier, too.

The search is local and has several starts: MAGSAC's F, and MAGSAC's E at several focal lengths,
each from a different subset of the matches. Short searches on few matches rank the starts, and the
best are refined. MAGSAC's own F wins if it costs much less. Then no plausible focal lengths explain
the matches, for example because the principal points are off-centre. The two rotations of an E have
the same F and the same derivatives, so one start covers both.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.config import POSITIVE, check_ranges
from mkpc_kaggle.geometry.coordinates import Matrix3, Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import (
    DistinctMatches,
    Estimate,
    ModelKind,
    RobustConfig,
    consensus,
    homogeneous,
    unit_norm,
)
from mkpc_kaggle.geometry.two_view import Problem, TwoView, Vectors, robust_costs, sampson

# Estimates of E, at evenly spaced quantiles of the prior on focal lengths
ESSENTIAL_STARTS = 5
# Share and minimum number of the matches for each of them.
ESSENTIAL_SHARE = 0.25
MIN_ESSENTIAL = 50
ESSENTIAL_THRESHOLD_PX = 0.4
ESSENTIAL_ITERATIONS = 300  # an estimate is only a start, so it may be rough
# Multiples of the loss's scale, in order; a wide loss has few minima.
ROUGH_SCALES = (4.0,)
FINE_SCALES = (2.0, 1.0)
# Maximum numbers of matches, evenly spaced; results are scored on all matches.
ROUGH_MATCHES = 300
FINE_MATCHES = 1000
FINE_STARTS = 2  # number of rough results to refine
FREE_COST = 10.0  # penalty of MAGSAC's own F, which need not have plausible focal lengths
FOCAL_RATIO = 1.1  # expected focal length over the long side
FOCAL_SIGMA = 0.4  # standard deviation of its log
EXIF_SIGMA = 0.05  # standard deviation of the log of EXIF's focal length
# Values of log f / g to decompose MAGSAC's F; the best is a start.
LOG_FOCAL_GRID = (-0.7, -0.35, 0.0, 0.35, 0.7)


@dataclass(frozen=True)
class FocalConfig:
    """Settings of :func:`estimate_with_prior`, table ``[focal]`` of a recipe.

    Without the table, F is MAGSAC's.
    """

    scale: float = 0.35  # scale of the loss, in pixels

    def __post_init__(self) -> None:
        check_ranges(self, scale=POSITIVE)


@dataclass(frozen=True, eq=False)
class FocalPrior:
    """The expected focal length of a camera, as a matrix K, and how uncertain it is."""

    K: Matrix3  # in pixels
    sigma: float  # standard deviation of the log focal length; 0: known

    @classmethod
    def of_image(cls, size: Size, exif_focal: float = 0.0) -> "FocalPrior":
        """Return the prior for an image; it is weak without EXIF's focal length.

        ``exif_focal`` is in pixels, 0 if unknown.
        """
        if exif_focal:
            return cls.of_focal(exif_focal, EXIF_SIGMA, size)
        return cls.of_focal(FOCAL_RATIO * max(size), FOCAL_SIGMA, size)

    @classmethod
    def of_focal(cls, focal: float, sigma: float, size: Size) -> "FocalPrior":
        """Return the prior for a focal length in pixels; the principal point is the centre."""
        # Pixel centres are at integers, so the middle of n pixels is at (n - 1) / 2.
        centre_x = (size.width - 1) / 2
        centre_y = (size.height - 1) / 2
        K = np.array([[focal, 0, centre_x], [0, focal, centre_y], [0, 0, 1]])
        return cls(K, sigma)

    @property
    def focal(self) -> float:
        """The mean focal length of both axes in pixels."""
        return float(self.K[0, 0] + self.K[1, 1]) / 2

    @property
    def to_ray(self) -> Matrix3:
        """The matrix from homogeneous pixels to rays (u, v, g), with g the focal length."""
        return np.asarray(self.focal * np.linalg.inv(self.K))

    def scaled(self, factor: float) -> Matrix3:
        """Return K with the focal length times ``factor``."""
        # The skew, too: it is a multiple of the focal length.
        factors = np.array([[factor, factor, 1], [1, factor, 1], [1, 1, 1]])
        return np.asarray(self.K * factors)

    def rays(self, points: Vectors) -> Vectors:
        """Convert (N, 2) pixels to (N, 3) rays."""
        return homogeneous(points) @ self.to_ray.T


Priors = tuple[FocalPrior, FocalPrior]


def estimate_with_prior(
    matches: Matches,
    priors: Priors,
    magsac: RobustConfig,
    config: FocalConfig,
    model: ModelKind = ModelKind.F,
) -> Estimate:
    """Estimate F, or E if K is known, from ``matches`` in image pixels.

    The result is the candidate of lowest cost. MAGSAC's own F is a candidate, so F never costs
    more. Inliers have a Sampson distance below MAGSAC's threshold. Six distinct matches are enough.
    The same input gives the same bytes.
    """
    distinct = DistinctMatches.of(matches)
    # Extreme coordinates may overflow; a candidate of non-finite cost loses.
    with np.errstate(all="ignore"):
        search = _Search(distinct, priors, config.scale)
        free, starts, failures = search.starts(magsac)
        # An F without focal lengths is no E.
        if model is ModelKind.E:
            free = []
        plain = _cheapest(free)
        candidates = _finite([*free, *search.refined(starts)])
        best = _cheapest(candidates)
        if best is None:
            reasons = "; ".join(dict.fromkeys(failures)) or "no candidate has a finite cost"
            return Estimate.failed(model, len(matches), reasons)
        inliers = np.abs(sampson(best.fundamental, *search.rays)) < magsac.threshold
        matrix = (
            best.fundamental if model is ModelKind.E else search.for_pixels(best.fundamental)
        )
    own = unit_norm(search.for_pixels(plain.fundamental)) if plain else None
    return Estimate(model, unit_norm(matrix), distinct.mask_of_all(inliers), magsac=own)


class _Candidate(NamedTuple):
    """An F (3, 3) for rays.

    ``cost`` includes FREE_COST for MAGSAC's own F, and the prior's cost for others.
    """

    fundamental: Matrix3
    cost: float


def _finite(candidates: Sequence[_Candidate]) -> list[_Candidate]:
    """Return the candidates of finite cost."""
    return [candidate for candidate in candidates if np.isfinite(candidate.cost)]


def _cheapest(candidates: Sequence[_Candidate]) -> _Candidate | None:
    """Return the first candidate of lowest finite cost, if any."""
    return min(_finite(candidates), key=lambda candidate: candidate.cost, default=None)


class _Search:
    """Search for candidates on a pair's distinct matches, converted to ``rays``."""

    def __init__(self, distinct: DistinctMatches, priors: Priors, scale: float) -> None:
        self._distinct = distinct
        self._priors = priors
        self._scale = scale
        rays0 = priors[0].rays(distinct.points0)
        rays1 = priors[1].rays(distinct.points1)
        self.rays = (rays0, rays1)
        self._sigmas = np.array([prior.sigma for prior in priors])
        # Searches run on samples, which cost a fraction; results are scored on all matches.
        self._all = Problem(*self.rays, self._sigmas)
        self._many = self._sample(FINE_MATCHES)
        self._few = self._sample(ROUGH_MATCHES)

    def _sample(self, most: int) -> Problem:
        """Return the problem of up to ``most`` evenly spaced matches, weighted to represent all."""
        rays0, rays1 = self.rays
        count = len(rays0)
        few = np.linspace(0, count - 1, min(count, most)).astype(int)
        weight = count / max(len(few), 1)
        return Problem(rays0[few], rays1[few], self._sigmas, weight)

    def starts(
        self, magsac: RobustConfig
    ) -> tuple[list[_Candidate], list[TwoView], list[str]]:
        """Return MAGSAC's candidates for F, all starts, and the reasons for missing starts.

        Starts come from these candidates and from estimates of E.
        """
        free: list[_Candidate] = []
        starts: list[TwoView] = []
        failures: list[str] = []
        count = len(self.rays[0])
        plain = self._consensus(np.arange(count), magsac)
        if plain.ok:
            F = self._for_rays(plain.matrix)
            view = self._decomposed(F)
            starts.append(view)
            free.append(_Candidate(F, self._cost(F, view) + FREE_COST))
        else:
            failures.append(plain.failure)
        for number in range(ESSENTIAL_STARTS):
            # Another quantile of the prior, and another subset of the matches.
            logs = NormalDist().inv_cdf((number + 0.5) / ESSENTIAL_STARTS) * self._sigmas
            essential = self._essential(number + 1, logs, magsac)
            if essential.ok:
                starts.append(replace(TwoView.nearest(essential.matrix), logs=logs))
            else:
                failures.append(essential.failure)
        return free, starts, failures

    def _essential(self, seed: int, logs: Vectors, magsac: RobustConfig) -> Estimate:
        """Estimate E at focal lengths of ``logs`` from a part of the matches by ``seed``."""
        config = replace(
            magsac, threshold=ESSENTIAL_THRESHOLD_PX, max_iterations=ESSENTIAL_ITERATIONS
        )
        count = len(self.rays[0])
        size = max(MIN_ESSENTIAL, round(ESSENTIAL_SHARE * count))
        prior0, prior1 = self._priors
        K0 = prior0.scaled(float(np.exp(logs[0])))
        K1 = prior1.scaled(float(np.exp(logs[1])))
        chosen = np.random.default_rng(seed).permutation(count)[:size]
        return self._consensus(chosen, config, (K0, K1))

    def refined(self, starts: Sequence[TwoView]) -> list[_Candidate]:
        """Search from all starts. Return the best results, refined."""
        rough = [self._searched(self._few, start, ROUGH_SCALES) for start in starts]
        rough.sort(key=lambda view: self._many.cost(view, self._scale))
        found = []
        for start in rough[:FINE_STARTS]:
            view = self._searched(self._many, start, FINE_SCALES)
            cost = self._cost(view.fundamental, view) + self._all.prior_cost(view)
            found.append(_Candidate(view.fundamental, cost))
        return found

    def for_pixels(self, F: Matrix3) -> Matrix3:
        """Convert an F for rays to an F for homogeneous pixels."""
        return self._priors[1].to_ray.T @ F @ self._priors[0].to_ray

    def _for_rays(self, F: Matrix3) -> Matrix3:
        """Convert an F for homogeneous pixels to an F for rays, of unit norm."""
        to_pixel0 = np.linalg.inv(self._priors[0].to_ray)
        to_pixel1 = np.linalg.inv(self._priors[1].to_ray)
        return unit_norm(to_pixel1.T @ F @ to_pixel0)

    def _consensus(
        self,
        chosen: NDArray[np.intp],
        config: RobustConfig,
        intrinsics: tuple[Matrix3, Matrix3] | None = None,
    ) -> Estimate:
        """Estimate F, or E with ``intrinsics``, by MAGSAC on the chosen matches, in this order."""
        points0 = self._distinct.points0[chosen]
        points1 = self._distinct.points1[chosen]
        model = ModelKind.E if intrinsics else ModelKind.F
        return consensus(points0, points1, config, model, intrinsics)

    def _decomposed(self, F: Matrix3) -> TwoView:
        """Decompose an F for rays into two views, with the best-fitting focal lengths of a grid."""
        # A known focal length has one value.
        grid0, grid1 = (LOG_FOCAL_GRID if prior.sigma else (0.0,) for prior in self._priors)
        views = [TwoView.nearest(F, log0, log1) for log0 in grid0 for log1 in grid1]
        scale = ROUGH_SCALES[0] * self._scale
        return min(views, key=lambda view: self._few.cost(view, scale))

    def _searched(self, problem: Problem, view: TwoView, factors: Sequence[float]) -> TwoView:
        """Return the local minimum near ``view``, with the loss scaled by each factor in turn."""
        # From a wide loss to a narrow one: with a narrow loss, a rough start has no gradient.
        for factor in factors:
            view = problem.fit(view, factor * self._scale)
        return view

    def _cost(self, F: Matrix3, view: TwoView) -> float:
        """Return the cost of an F for rays on all matches; points behind a camera are outliers.

        ``view`` is one of the four poses of F. The one with the fewest points behind counts.
        """
        # An outlier costs 0.5.
        saved = 0.5 - robust_costs(sampson(F, *self.rays), self._scale)
        behind = []
        for each in (view, view.twisted):
            signs = each.depth_signs(*self.rays, 3 * self._scale)
            # With -t all signs change. NaN, a point that may be at infinity, compares as False.
            behind.append(saved[signs <= 0].sum())
            behind.append(saved[-signs <= 0].sum())
        return float((0.5 - saved).sum() + min(behind))
