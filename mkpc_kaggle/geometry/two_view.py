"""Two cameras as rotation, direction and focal lengths, fitted to matches by a robust loss.

With rays y = (u, v, g), pixels from the principal point and the focal length that is expected, two views have

    F = diag(1, 1, f1 / g1) [t]x R diag(1, 1, f0 / g0),     y1^T F y0 = 0,

since K^-1 = diag(1, 1, f) / f there. The Sampson distance (Sampson, 1982; Hartley and Zisserman, Multiple View
Geometry, 11.4.3) is r = y1^T F y0 / s, s being the length of its gradient by the four coordinates: pixels, as the
third element of a ray has no part in it. With P = diag(1, 1, 0) its derivative by the elements of F is

    dr = (a^T dF y0 + y1^T dF b) / s,     a = y1 - (r / s) P F y0,     b = -(r / s) P F^T y1.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mkpc_kaggle.geometry.coordinates import Matrix3

Vectors = NDArray[np.float64]

MAX_STEPS = 10  # of Levenberg-Marquardt at one scale
MIN_GAIN = 1e-3  # a step that lowers the cost by less is the last; a match costs up to a half
MIN_DAMPING, FIRST_DAMPING, MAX_DAMPING = 1e-9, 1e-3, 1e6
MAX_LOG_FOCAL = 2.0  # |log f / g|: a factor of 7.4 in either direction
TINY = float(np.finfo(np.float64).tiny)
CROSS: NDArray[np.float64] = np.swapaxes(np.cross(np.eye(3)[:, None], np.eye(3)), 1, 2)  # [e_k]x of three axes
CROSS.setflags(write=False)


@dataclass(frozen=True, eq=False)
class TwoView:
    """X_1 = R X_0 + t up to the scale of t, (3,) of unit length; ``logs`` (2,) are log f / g of both cameras."""

    R: Matrix3
    t: Vectors
    logs: Vectors

    @classmethod
    def nearest(cls, F: Matrix3, log0: float = 0.0, log1: float = 0.0) -> "TwoView":
        """The views of these focal lengths whose E is nearest to the E that F gives with them.

        Two rotations and two signs of t stand for the same F; this is one of the four. Raises ``LinAlgError`` if F
        is not finite.
        """
        U, _, Vt = np.linalg.svd(F / _focal_factors(np.array([log0, log1])))
        quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, np.linalg.det(U) * np.linalg.det(Vt)]])
        return cls(U @ quarter @ Vt, U[:, 2], np.array([log0, log1]))

    @property
    def fundamental(self) -> Matrix3:
        return np.asarray(cross_matrix(self.t) @ self.R * _focal_factors(self.logs))

    @property
    def twisted(self) -> "TwoView":
        """The other rotation that stands for the same F."""
        return TwoView((2 * np.outer(self.t, self.t) - np.eye(3)) @ self.R, self.t, self.logs)

    def depth_signs(self, rays0: Vectors, rays1: Vectors, error: float) -> NDArray[np.float64]:
        """(N,) 1 for a match whose point is in front of both cameras, -1 behind both, 0 in front of only one.

        The point is where X_1 = R X_0 + t holds best. With -t the signs are opposite. NaN for a match whose rays
        are parallel within ``error`` pixels: its point may be at infinity.
        """
        ratio0, ratio1 = np.exp(self.logs)
        a, b = (rays0 * (1, 1, ratio0)) @ self.R.T, rays1 * (1, 1, ratio1)
        aa, bb, ab, at, bt = _row_dots(a, a), _row_dots(b, b), _row_dots(a, b), a @ self.t, b @ self.t
        signs = (np.sign(ab * bt - bb * at) + np.sign(aa * bt - ab * at)) / 2
        apart = np.sqrt(np.maximum(aa * bb - ab**2, 0) / aa) > error  # in pixels, as b is
        return np.where(apart, signs, np.nan)

    def tangent(self) -> NDArray[np.float64]:
        """(9, 7): F's elements by a turn of R (3), a shift of t on the sphere (2) and the logs (2)."""
        F, factors = self.fundamental, _focal_factors(self.logs)
        turns = cross_matrix(self.t) @ CROSS @ self.R * factors
        shifts = np.tensordot(self._tangent_basis().T, CROSS, 1) @ self.R * factors
        by_log0, by_log1 = np.zeros((3, 3)), np.zeros((3, 3))
        by_log0[:, 2], by_log1[2] = F[:, 2], F[2]
        return np.concatenate([turns, shifts, [by_log0, by_log1]]).reshape(7, 9).T

    def moved(self, step: Vectors) -> "TwoView":
        """After a step (7,) along the columns of :meth:`tangent`."""
        t = self.t + self._tangent_basis() @ step[3:5]
        return TwoView(
            Rotation.from_rotvec(step[:3]).as_matrix() @ self.R, t / np.linalg.norm(t), self.logs + step[5:]
        )

    def _tangent_basis(self) -> NDArray[np.float64]:
        """(3, 2) unit vectors at right angles to t and to each other."""
        first = cross_matrix(self.t)[np.argmin(np.abs(self.t))]
        first = first / np.linalg.norm(first)
        return np.column_stack([first, cross_matrix(self.t) @ first])


@dataclass(frozen=True, eq=False)
class Problem:
    """Rays (N, 3) of both images, each counted ``weight`` times, and the standard deviations of log f / g (2,).

    A deviation of 0 keeps that focal length where it is.
    """

    rays0: Vectors
    rays1: Vectors
    sigmas: Vectors
    weight: float = 1.0

    def cost(self, view: TwoView, scale: float) -> float:
        """The robust cost of the Sampson distances and :meth:`prior_cost`."""
        distances = sampson(view.fundamental, self.rays0, self.rays1)
        return self.weight * float(np.sum(robust_costs(distances, scale))) + self.prior_cost(view)

    def prior_cost(self, view: TwoView) -> float:
        """Half the squares of the logs over their deviations."""
        return 0.5 * float(self._precisions @ view.logs**2)

    def fit(self, start: TwoView, scale: float) -> TwoView:
        """A local minimum of :meth:`cost` near ``start``, by Levenberg-Marquardt on the reweighted squares."""
        view, cost, damping = start, self.cost(start, scale), FIRST_DAMPING
        for _ in range(MAX_STEPS):
            gradient, curvature = self._derivatives(view, scale)
            while damping < MAX_DAMPING:
                moved = view.moved(self._step(gradient, curvature, damping))
                moved_cost = self.cost(moved, scale) if np.abs(moved.logs).max() < MAX_LOG_FOCAL else np.inf
                if moved_cost < cost:
                    break
                damping *= 10
            else:
                break
            gain, view, cost = cost - moved_cost, moved, moved_cost
            damping = max(damping / 10, MIN_DAMPING)
            if gain < MIN_GAIN:
                break
        return view

    @property
    def _free(self) -> NDArray[np.bool_]:
        """Which of the seven steps may be other than 0."""
        return np.concatenate([np.ones(5, bool), self.sigmas > 0])

    @property
    def _precisions(self) -> Vectors:
        return np.array([1 / sigma**2 if sigma else 0.0 for sigma in self.sigmas])

    def _step(self, gradient: Vectors, curvature: NDArray[np.float64], damping: float) -> Vectors:
        """The damped step (7,); NaN for a singular system, so that it is rejected."""
        free = self._free
        step, damped = np.zeros(7), curvature + damping * np.diag(np.diag(curvature) + MIN_DAMPING)
        try:
            step[free] = -np.linalg.solve(damped[np.ix_(free, free)], gradient[free])
        except np.linalg.LinAlgError:
            step[free] = np.nan
        return step

    def _derivatives(self, view: TwoView, scale: float) -> tuple[Vectors, NDArray[np.float64]]:
        """The gradient (7,) of the cost, and its curvature (7, 7) as that of the reweighted squares."""
        lines0, lines1, slope = _lines(view.fundamental, self.rays0, self.rays1)
        distances = _row_dots(self.rays1, lines1) / slope
        ratio = (distances / slope)[:, None]  # r / s
        a, b = self.rays1.copy(), -ratio * lines0
        a[:, :2] -= ratio * lines1[:, :2]
        b[:, 2] = 0
        rows = a[:, :, None] * self.rays0[:, None] + self.rays1[:, :, None] * b[:, None]
        jacobian = rows.reshape(-1, 9) @ view.tangent() / (scale * slope)[:, None]
        weights = self.weight / np.square(1 + np.square(distances / scale))
        weighted = jacobian * weights[:, None]
        gradient, curvature = weighted.T @ (distances / scale), weighted.T @ jacobian
        gradient[5:] += self._precisions * view.logs
        curvature[[5, 6], [5, 6]] += self._precisions
        return gradient, curvature


def robust_costs(distances: Vectors, scale: float) -> Vectors:
    """x^2 / (2 (1 + x^2)), x = distance / scale: Geman and McClure, 1985. An outlier costs a half."""
    return np.asarray(0.5 - 0.5 / (1 + np.square(distances / scale)))


def sampson(F: Matrix3, rays0: Vectors, rays1: Vectors) -> Vectors:
    """(N,) signed Sampson distances, in pixels, of (N, 3) rays to an F for rays."""
    _, lines1, slope = _lines(F, rays0, rays1)
    return np.asarray(_row_dots(rays1, lines1) / slope)


def _lines(F: Matrix3, rays0: Vectors, rays1: Vectors) -> tuple[Vectors, Vectors, Vectors]:
    """The epipolar lines (N, 3) in both images, and the length (N,) of the gradient of y1^T F y0."""
    lines0, lines1 = rays1 @ F, rays0 @ F.T
    squares = _row_dots(lines0[:, :2], lines0[:, :2]) + _row_dots(lines1[:, :2], lines1[:, :2])
    return lines0, lines1, np.sqrt(squares) + TINY


def _row_dots(a: Vectors, b: Vectors) -> Vectors:
    """The products (N,) of the rows of two (N, K) arrays."""
    return np.asarray(np.einsum("nk,nk->n", a, b))


def _focal_factors(logs: Vectors) -> Matrix3:
    """(3, 3) factors from the elements of E to those of F."""
    ratio0, ratio1 = np.exp(logs)
    return np.array([[1, 1, ratio0], [1, 1, ratio0], [ratio1, ratio1, ratio0 * ratio1]])


def cross_matrix(t: Vectors) -> Matrix3:
    return np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
