"""F of a pair under a prior on the focal lengths of its two cameras.

The seven degrees of freedom of F are a relative pose and two focal lengths, once the principal points are known,
and cameras have plausible focal lengths. What is minimised over the pose and log f0, log f1 is the negative
logarithm of a posterior density,

    sum_n rho(r_n / scale) + sum_i (log f_i - log g_i)^2 / (2 sigma_i^2),     rho(x) = x^2 / (2 (1 + x^2)),

r being the Sampson distance in pixels (:mod:`mkpc_kaggle.geometry.two_view`), g the focal lengths that are
expected, and rho the loss of Geman and McClure (1985): an outlier costs a half, as much as a focal length that is
sigma off. Where the matches determine the focal lengths they decide, elsewhere the prior does.

A match whose point would lie behind a camera is an outlier, too.

The search is local, so it has several starts: the F of MAGSAC, and E by MAGSAC at several focal lengths, each
on another part of the matches. What a short search on few matches makes of each is compared, and the best are
refined. MAGSAC's own F is kept where it costs much less: then no plausible focal lengths explain the matches, and
the principal points may be elsewhere. The two rotations that an E stands for are not two starts: both give the
same F and the same derivatives of it.
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
    EstimateStats,
    ModelKind,
    RobustConfig,
    consensus,
    homogeneous,
    permutation,
    unit_norm,
)
from mkpc_kaggle.geometry.two_view import Problem, TwoView, Vectors, robust_costs, sampson

ESSENTIAL_STARTS = 5  # how often E is sought, at focal lengths spread evenly over the prior's distribution
ESSENTIAL_SHARE, MIN_ESSENTIAL = 0.25, 50  # of the matches, and at least so many, that E is sought on
ESSENTIAL_THRESHOLD_PX, ESSENTIAL_ITERATIONS = 0.4, 300
ROUGH_SCALES, FINE_SCALES = (4.0,), (2.0, 1.0)  # times the scale, in turn: a wide loss has fewer local minima
ROUGH_MATCHES, FINE_MATCHES = 300, 1000  # at most, evenly spread; the results are scored on all
FINE_STARTS = 2  # how many of the rough results are refined
FREE_COST = 10.0  # what MAGSAC's own F pays for being free of plausible focal lengths
EXIF_SIGMA = 0.05  # standard deviation of the logarithm of a focal length that EXIF tells
LOG_FOCAL_GRID = (-0.7, -0.35, 0.0, 0.35, 0.7)  # log f / g to read MAGSAC's F with; the best is a start


@dataclass(frozen=True)
class FocalConfig:
    """Settings of :func:`estimate_with_prior`, table ``[focal]`` of a recipe; without it MAGSAC is alone."""

    ratio: float = 1.1  # of an unknown focal length to the image's long side
    sigma: float = 0.4  # standard deviation of the focal length's logarithm
    scale: float = 0.35  # of the loss, in pixels
    exif: bool = True  # where an image's EXIF has a focal length, expect that one, within 5 %

    def __post_init__(self) -> None:
        check_ranges(self, ratio=POSITIVE, sigma=POSITIVE, scale=POSITIVE)


@dataclass(frozen=True, eq=False)
class FocalPrior:
    K: Matrix3  # in pixels
    sigma: float  # standard deviation of the log focal length; 0: it is known

    @classmethod
    def of_image(cls, size: Size, config: FocalConfig, exif_focal: float = 0.0) -> "FocalPrior":
        """The prior for an image of that size: weak, unless EXIF tells its focal length in pixels."""
        if config.exif and exif_focal:
            return cls.of_focal(exif_focal, EXIF_SIGMA, size)
        return cls.of_focal(config.ratio * max(size), config.sigma, size)

    @classmethod
    def of_focal(cls, focal: float, sigma: float, size: Size) -> "FocalPrior":
        """A focal length in pixels, and the image's centre as principal point."""
        centre = (size.width - 1) / 2, (size.height - 1) / 2
        return cls(np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]]), sigma)

    @property
    def focal(self) -> float:
        """The mean focal length of both axes in pixels."""
        return float(self.K[0, 0] + self.K[1, 1]) / 2

    @property
    def to_ray(self) -> Matrix3:
        """Homogeneous pixels -> rays (u, v, g), g being the focal length."""
        return np.asarray(self.focal * np.linalg.inv(self.K))

    def scaled(self, factor: float) -> Matrix3:
        """The camera matrix of a focal length that is ``factor`` times as long."""
        return np.asarray(self.K * np.array([[factor, factor, 1], [1, factor, 1], [1, 1, 1]]))

    def rays(self, points: Vectors) -> Vectors:
        """(N, 2) pixels -> (N, 3)."""
        return homogeneous(points) @ self.to_ray.T


Priors = tuple[FocalPrior, FocalPrior]


def estimate_with_prior(
    matches: Matches, priors: Priors, magsac: RobustConfig, config: FocalConfig, model: ModelKind = ModelKind.F
) -> Estimate:
    """F of ``matches`` (image pixels), or E where both K are known: of all candidates that of lowest cost.

    Inliers are nearer than MAGSAC's threshold by their Sampson distance. MAGSAC's own F is a candidate, so the
    winner never costs more. Six distinct matches are enough. The same input gives the same bytes.
    """
    distinct = DistinctMatches.of(matches)
    with np.errstate(all="ignore"):  # points need not be pixels; a candidate that overflows loses
        search = _Search(distinct, priors, config.scale)
        free, starts, failures = search.starts(magsac)
        if model is ModelKind.E:
            free = []
        candidates = [found for found in (*free, *search.refined(starts)) if np.isfinite(found.cost)]
        if not candidates:
            reasons = "; ".join(dict.fromkeys(failures)) or "no candidate has a finite cost"
            return Estimate.failed(model, len(matches), reasons)
        best = min(candidates, key=lambda found: found.cost)
        inliers = np.abs(sampson(best.fundamental, *search.rays)) < magsac.threshold
        matrix = best.fundamental if model is ModelKind.E else search.for_pixels(best.fundamental)
        finite = [found for found in free if np.isfinite(found.cost)]
        plain = min(finite, key=lambda found: found.cost, default=None)
    magsac_fundamental = unit_norm(search.for_pixels(plain.fundamental)) if plain else None
    told = EstimateStats(len(candidates), best.cost, plain.cost if plain else 0.0, search.focals(best))
    return Estimate(model, unit_norm(matrix), distinct.mask_of_all(inliers), "", magsac_fundamental, told)


class _Candidate(NamedTuple):
    """An F (3, 3) for rays, and its cost: MAGSAC's own pays FREE_COST, the others the prior's."""

    fundamental: Matrix3
    cost: float
    logs: Vectors | None = None  # log f / g of both cameras, where it has focal lengths


class _Search:
    """The candidates from the distinct matches of a pair, as ``rays``."""

    def __init__(self, distinct: DistinctMatches, priors: Priors, scale: float) -> None:
        self._distinct, self._priors, self._scale = distinct, priors, scale
        self.rays = priors[0].rays(distinct.points0), priors[1].rays(distinct.points1)
        self._sigmas = np.array([prior.sigma for prior in priors])
        self._all = Problem(*self.rays, self._sigmas)
        self._many, self._few = self._sample(FINE_MATCHES), self._sample(ROUGH_MATCHES)

    def _sample(self, most: int) -> Problem:
        """At most so many matches, evenly spread, that stand for all."""
        count = len(self.rays[0])
        few = np.linspace(0, count - 1, min(count, most)).astype(int)
        return Problem(self.rays[0][few], self.rays[1][few], self._sigmas, count / max(len(few), 1))

    def starts(self, magsac: RobustConfig) -> tuple[list[_Candidate], list[TwoView], list[str]]:
        """MAGSAC's F as they are, the starts from them and from E, and the reasons why starts are missing."""
        free, starts, failures, count = [], [], [], len(self.rays[0])
        for number in range(magsac.permutations):
            plain = self._consensus(permutation(number, count), magsac)
            if plain.ok:
                to_pixels = [np.linalg.inv(prior.to_ray) for prior in self._priors]
                F = unit_norm(to_pixels[1].T @ plain.matrix @ to_pixels[0])
                starts.append(self._decomposed(F))
                free.append(_Candidate(F, self._cost(F, starts[-1]) + FREE_COST))
            else:
                failures.append(plain.failure)
        config = replace(magsac, threshold=ESSENTIAL_THRESHOLD_PX, max_iterations=ESSENTIAL_ITERATIONS)
        for number in range(ESSENTIAL_STARTS):
            part = permutation(number + 1, count)[: max(MIN_ESSENTIAL, round(ESSENTIAL_SHARE * count))]
            logs = NormalDist().inv_cdf((number + 0.5) / ESSENTIAL_STARTS) * self._sigmas
            K0, K1 = (prior.scaled(float(np.exp(log))) for prior, log in zip(self._priors, logs, strict=True))
            essential = self._consensus(part, config, (K0, K1))
            if essential.ok:
                starts.append(replace(TwoView.nearest(essential.matrix), logs=logs))
            else:
                failures.append(essential.failure)
        return free, starts, failures

    def refined(self, starts: Sequence[TwoView]) -> list[_Candidate]:
        """The best of what a search from each start finds."""
        rough = [self._searched(self._few, start, ROUGH_SCALES) for start in starts]
        rough.sort(key=lambda view: self._many.cost(view, self._scale))
        fine = [self._searched(self._many, view, FINE_SCALES) for view in rough[:FINE_STARTS]]
        costs = [self._cost(view.fundamental, view) + self._all.prior_cost(view) for view in fine]
        return [_Candidate(view.fundamental, cost, view.logs) for view, cost in zip(fine, costs, strict=True)]

    def focals(self, found: _Candidate) -> tuple[float, float]:
        """In pixels; 0 for MAGSAC's own F, which has none."""
        if found.logs is None:
            return 0.0, 0.0
        ratio0, ratio1 = np.exp(found.logs).tolist()
        return self._priors[0].focal * ratio0, self._priors[1].focal * ratio1

    def for_pixels(self, F: Matrix3) -> Matrix3:
        """The F for homogeneous pixels, from an F for rays."""
        return self._priors[1].to_ray.T @ F @ self._priors[0].to_ray

    def _consensus(
        self, chosen: NDArray[np.intp], config: RobustConfig, intrinsics: tuple[Matrix3, Matrix3] | None = None
    ) -> Estimate:
        """MAGSAC's F of the matches in that order, or E with ``intrinsics``."""
        points0, points1 = self._distinct.points0[chosen], self._distinct.points1[chosen]
        model = ModelKind.E if intrinsics else ModelKind.F
        return consensus(points0, points1, replace(config, permutations=1), model, intrinsics)

    def _decomposed(self, F: Matrix3) -> TwoView:
        """An F for rays as two views, with the focal lengths of a grid that fit the matches best."""
        grid0, grid1 = (LOG_FOCAL_GRID if prior.sigma else (0.0,) for prior in self._priors)
        views = [TwoView.nearest(F, log0, log1) for log0 in grid0 for log1 in grid1]
        return min(views, key=lambda view: self._few.cost(view, ROUGH_SCALES[0] * self._scale))

    def _searched(self, problem: Problem, view: TwoView, factors: Sequence[float]) -> TwoView:
        """The local minimum near a view, with a loss that narrows."""
        for factor in factors:
            view = problem.fit(view, factor * self._scale)
        return view

    def _cost(self, F: Matrix3, view: TwoView) -> float:
        """What an F for rays costs by all matches; matches behind a camera of ``view`` are outliers."""
        saved = 0.5 - robust_costs(sampson(F, *self.rays), self._scale)
        signs = (views.depth_signs(*self.rays, 3 * self._scale) for views in (view, view.twisted))
        behind = min(saved[both * sign <= 0].sum() for both in signs for sign in (1, -1))
        return float((0.5 - saved).sum() + behind)
