"""F of one pair under a prior on the focal lengths of its two cameras.

The seven degrees of freedom of F are a relative pose and two focal lengths, once the principal points are known,
and cameras have plausible focal lengths. What is minimised over the pose and log f0, log f1 is the negative
logarithm of a posterior density,

    sum_n rho(r_n / scale) + sum_i (log f_i - log g_i)^2 / (2 sigma_i^2),     rho(x) = x^2 / (2 (1 + x^2)),

r being the Sampson distance in pixels (:mod:`mkpc_kaggle.geometry.two_view`), g the focal lengths that are
expected, and rho the loss of Geman and McClure (1985): an outlier costs a half, as much as a focal length one
sigma off. Where the matches determine the focal lengths they decide, elsewhere the prior does.

A match whose point would lie behind a camera is an outlier, too.

The search is local, so it has several starts: the F of MAGSAC, and E by MAGSAC at several focal lengths, each
on another part of the matches. What a short search on few matches makes of each is compared, and the best are
refined. The two rotations that an E stands for are not two starts: both give one F and the same derivatives of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np

from mkpc_kaggle.config import AT_LEAST_0, AT_LEAST_1, POSITIVE, SHARE, check_ranges
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import (
    DistinctMatches,
    Estimate,
    Matrix3,
    Model,
    Origin,
    RobustConfig,
    consensus,
    nth_order,
    robust_costs,
)
from mkpc_kaggle.geometry.two_view import Problem, TwoView, Vectors, sampson

ROUGHLY, FINELY = (4.0,), (2.0, 1.0)
"""Times the scale, one after the other: a wide loss has fewer local minima."""
LEAST_PART = 50
"""Matches, if there are as many, that E is sought on."""
FOCAL_GRID = (-0.7, -0.35, 0.0, 0.35, 0.7)
"""log f / g: the focal lengths that MAGSAC's F is read with; the search starts from the best."""
UNCERTAIN_DIRECTION = 0.5
"""Radians: with a larger standard deviation the matches do not determine the direction of t."""
UNLIKELY_FOCAL = 3.0
"""Standard deviations."""


@dataclass(frozen=True)
class FocalConfig:
    """Settings of :func:`estimate_with_prior`, table ``[focal]`` of a recipe; without the table MAGSAC is alone.

    An unknown focal length is ``ratio`` times the image's long side, and its logarithm has the standard deviation
    ``sigma``; ``scale``, in pixels, is that of the loss. F is sought as :class:`RobustConfig` says, and E
    ``essential_starts`` times, at focal lengths spread evenly over the prior's distribution, each time on
    another ``essential_share`` of the matches, within ``essential_threshold`` pixels and
    ``essential_iterations``. From each a search on ``rough_matches`` begins; the best ``refined`` results are
    refined on ``most_matches``, evenly spread, and scored on all. MAGSAC's own F is kept where it costs less
    by ``free_cost``: no plausible focal lengths explain the matches, so the principal points may be elsewhere.
    """

    ratio: float = 1.1
    sigma: float = 0.4
    scale: float = 0.35
    essential_threshold: float = 0.4
    essential_iterations: int = 300
    essential_starts: int = 5
    essential_share: float = 0.25
    rough_matches: int = 300
    refined: int = 2
    most_matches: int = 1000
    free_cost: float = 10.0

    def __post_init__(self) -> None:
        check_ranges(self, ratio=POSITIVE, sigma=POSITIVE, scale=POSITIVE, essential_threshold=POSITIVE)
        check_ranges(self, essential_iterations=AT_LEAST_1, essential_starts=AT_LEAST_1, essential_share=SHARE)
        check_ranges(
            self, rough_matches=AT_LEAST_1, refined=AT_LEAST_1, most_matches=AT_LEAST_1, free_cost=AT_LEAST_0
        )

    def essential(self, magsac: RobustConfig) -> RobustConfig:
        """How E is sought where F is sought in that way."""
        return replace(
            magsac, orders=1, threshold=self.essential_threshold, max_iterations=self.essential_iterations
        )


@dataclass(frozen=True, eq=False)
class FocalPrior:
    """What is known of a camera: ``K`` (3, 3) in pixels, and the standard deviation of its log focal length.

    ``sigma`` 0 says that K is known. ``ValueError`` for a negative one, and for a K that is no camera matrix.
    """

    K: Matrix3
    sigma: float

    def __post_init__(self) -> None:
        if not self.sigma >= 0:
            raise ValueError(f"sigma must be at least 0, not {self.sigma}")
        focals = np.diag(self.K)[:2]
        if self.K.shape != (3, 3) or not np.isfinite(self.K).all() or not (focals > 0).all():
            raise ValueError(f"K must be a camera matrix with positive focal lengths, not {self.K.tolist()}")

    @classmethod
    def of_image(cls, size: Size, config: FocalConfig) -> "FocalPrior":
        """The weak prior for an image of which the size alone is known."""
        return cls.of_focal(config.ratio * max(size), config.sigma, size)

    @classmethod
    def of_focal(cls, focal: float, sigma: float, size: Size) -> "FocalPrior":
        """A focal length in pixels and how sure it is; the principal point is the image's centre."""
        centre = (size.width - 1) / 2, (size.height - 1) / 2
        return cls(np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]]), sigma)

    @property
    def focal(self) -> float:
        """Pixels, the mean of both axes."""
        return float(self.K[0, 0] + self.K[1, 1]) / 2

    @property
    def to_ray(self) -> Matrix3:
        """Homogeneous pixels -> rays (u, v, g)."""
        return np.asarray(self.focal * np.linalg.inv(self.K))

    def scaled(self, factor: float) -> Matrix3:
        """The camera matrix of a focal length that is ``factor`` times as long."""
        return np.asarray(self.K * np.array([[factor, factor, 1], [1, factor, 1], [1, 1, 1]]))

    def rays(self, points: Vectors) -> Vectors:
        """(N, 2) pixels -> (N, 3)."""
        return np.column_stack([points, np.ones(len(points))]) @ self.to_ray.T


Priors = tuple[FocalPrior, FocalPrior]


def estimate_with_prior(
    matches: Matches, priors: Priors, magsac: RobustConfig, config: FocalConfig, model: Model = Model.F
) -> Estimate:
    """F of ``matches`` (image pixels), or E where both K are known: of all candidates the one of lowest cost.

    Inliers are nearer than MAGSAC's threshold by their Sampson distance. MAGSAC's own F is a candidate, so that
    the winner never costs more. ``remark`` has warnings about the result, and why candidates are missing.
    Six distinct matches are enough. The same input gives the same bytes. Raises ``ValueError`` for H, which has
    no focal lengths, and for E with a focal length that is not known.
    """
    if model is Model.H or (model is Model.E and any(prior.sigma for prior in priors)):
        raise ValueError(f"{model} cannot use a prior on focal lengths")
    distinct = DistinctMatches.of(matches)
    with np.errstate(all="ignore"):  # points need not be pixels; what overflows loses
        search = _Search(distinct, priors, config)
        tried = search.candidates(magsac, model)
        candidates = [one for one in tried if not isinstance(one, str) and np.isfinite(one.cost)]
        reasons = list(dict.fromkeys(one for one in tried if isinstance(one, str)))
        if not candidates:
            return Estimate.failed(model, len(matches), "; ".join(reasons) or "no candidate has a finite cost")
        best = min(candidates, key=_cost_of)
        plain = [one for one in candidates if one.origin is Origin.MAGSAC]
        unrefined = _unit(search.for_pixels(min(plain, key=_cost_of).fundamental)) if plain else None
        inliers = np.abs(sampson(best.fundamental, *search.rays)) < magsac.threshold
        reasons += search.remarks(best)
    matrix = best.fundamental if model is Model.E else search.for_pixels(best.fundamental)
    return Estimate(
        model,
        _unit(matrix),
        distinct.mask_of_all(inliers),
        origin=best.origin,
        focals=search.focals(best.view) if best.view else None,
        magsac=unrefined,
        remark="; ".join(reasons),
    )


@dataclass(frozen=True, eq=False)
class _Candidate:
    """An F (3, 3) for rays, its cost, and its two views; ``None`` for MAGSAC's F as it is."""

    origin: Origin
    fundamental: Matrix3
    cost: float
    view: TwoView | None = None


def _cost_of(candidate: _Candidate) -> float:
    return candidate.cost


def _unit(matrix: Matrix3) -> Matrix3:
    return np.asarray(matrix / np.linalg.norm(matrix))


class _Search:
    """The candidates from the distinct matches of a pair, as ``rays``."""

    def __init__(self, distinct: DistinctMatches, priors: Priors, config: FocalConfig) -> None:
        self._distinct, self._priors, self._config = distinct, priors, config
        self.rays = priors[0].rays(distinct.points0), priors[1].rays(distinct.points1)
        self._sigmas = np.array([prior.sigma for prior in priors])
        self._all = Problem(*self.rays, self._sigmas)
        self._many, self._few = (self._sample(most) for most in (config.most_matches, config.rough_matches))

    def _sample(self, most: int) -> Problem:
        """At most as many matches, evenly spread, in place of all."""
        count = len(self.rays[0])
        few = np.linspace(0, count - 1, min(count, most)).astype(int)
        return Problem(self.rays[0][few], self.rays[1][few], self._sigmas, count / max(len(few), 1))

    def candidates(self, magsac: RobustConfig, model: Model) -> list[_Candidate | str]:
        """MAGSAC's F as it is, and the best of what F and E became; a reason in place of a start that failed."""
        found: list[_Candidate | str] = []
        starts: list[tuple[Origin, TwoView]] = []
        for number in range(magsac.orders):
            plain = self._plain(number, magsac)
            if not plain.ok:
                found.append(plain.failure)
                continue
            F = self._for_rays(plain.matrix)
            starts.append((Origin.FROM_F, self._decomposed(F)))
            if model is Model.F:
                cost = self._cost(F, starts[-1][1]) + self._config.free_cost
                found.append(_Candidate(Origin.MAGSAC, F, cost))
        for number in range(self._config.essential_starts):
            start = self._essential(number, magsac)
            if isinstance(start, str):
                found.append(start)
            else:
                starts.append((Origin.FROM_E, start))
        rough = [(origin, self._searched(self._few, start, ROUGHLY)) for origin, start in starts]
        rough.sort(key=lambda one: self._many.cost(one[1], self._config.scale))
        for origin, view in rough[: self._config.refined]:
            best = self._searched(self._many, view, FINELY)
            cost = self._cost(best.fundamental, best) + self._all.prior_cost(best)
            found.append(_Candidate(origin, best.fundamental, cost, best))
        return found

    def _searched(self, problem: Problem, view: TwoView, factors: Sequence[float]) -> TwoView:
        """The local minimum near a view, with a loss that narrows."""
        for factor in factors:
            view = problem.fit(view, factor * self._config.scale)
        return view

    def _cost(self, F: Matrix3, view: TwoView) -> float:
        """What an F for rays costs by all matches; those behind a camera of ``view`` are outliers."""
        distances = sampson(F, *self.rays)
        saved = 0.5 - robust_costs(distances, self._config.scale)
        error = 3 * self._config.scale
        signs = (one.depth_signs(*self.rays, error) for one in (view, view.twisted))
        behind = min(saved[one * sign <= 0].sum() for one in signs for sign in (1, -1))
        return float((0.5 - saved).sum() + behind)

    def _plain(self, number: int, magsac: RobustConfig) -> Estimate:
        """MAGSAC's F on one order of the matches."""
        order = nth_order(number, len(self.rays[0]))
        return consensus(
            self._distinct.points0[order], self._distinct.points1[order], replace(magsac, orders=1), Model.F
        )

    def _essential(self, number: int, magsac: RobustConfig) -> TwoView | str:
        """E of a part of the matches, at focal lengths at a quantile of the prior; or why there is none."""
        count = len(self.rays[0])
        part = nth_order(number + 1, count)[: max(LEAST_PART, round(self._config.essential_share * count))]
        quantile = NormalDist().inv_cdf((number + 0.5) / self._config.essential_starts)
        logs = quantile * self._sigmas
        K0, K1 = (prior.scaled(float(np.exp(log))) for prior, log in zip(self._priors, logs, strict=True))
        points0, points1 = self._distinct.points0[part], self._distinct.points1[part]
        found = consensus(points0, points1, self._config.essential(magsac), Model.E, (K0, K1))
        return replace(TwoView.nearest(found.matrix), logs=logs) if found.ok else found.failure

    def remarks(self, best: _Candidate) -> list[str]:
        """Warnings about the winner."""
        if best.view is None:
            return ["no plausible focal lengths explain the matches"]
        remarks = [
            f"the focal length of image {number} is {abs(log) / prior.sigma:.1f} sigma from what is expected"
            for number, (log, prior) in enumerate(zip(best.view.logs, self._priors, strict=True))
            if abs(log) > UNLIKELY_FOCAL * prior.sigma
        ]
        if self._all.direction_error(best.view, self._config.scale) > UNCERTAIN_DIRECTION:
            remarks.append("the matches do not determine the direction of motion")
        return remarks

    def focals(self, view: TwoView) -> tuple[float, float]:
        """Pixels."""
        first, second = (
            prior.focal * float(np.exp(log)) for prior, log in zip(self._priors, view.logs, strict=True)
        )
        return first, second

    def for_pixels(self, F: Matrix3) -> Matrix3:
        """The F for homogeneous pixels, from one for rays."""
        return self._priors[1].to_ray.T @ F @ self._priors[0].to_ray

    def _for_rays(self, F: Matrix3) -> Matrix3:
        """The F for rays, of unit norm, from one for pixels."""
        return _unit(np.linalg.inv(self._priors[1].to_ray).T @ F @ np.linalg.inv(self._priors[0].to_ray))

    def _decomposed(self, F: Matrix3) -> TwoView:
        """An F for rays as two views, with the focal lengths of a grid that fit the matches best."""
        grid0, grid1 = (FOCAL_GRID if prior.sigma else (0.0,) for prior in self._priors)
        views = [TwoView.nearest(F, log0, log1) for log0 in grid0 for log1 in grid1]
        return min(views, key=lambda view: self._few.cost(view, ROUGHLY[0] * self._config.scale))
