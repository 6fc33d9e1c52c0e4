"""Two views as rotation, translation direction and focal lengths, fitted with a robust loss.

A ray y = (u, v, g) holds a pixel's offset (u, v) from the principal point and the expected focal
length g. Two views satisfy

    F = diag(1, 1, f1 / g1) [t]x R diag(1, 1, f0 / g0),     y1^T F y0 = 0,

since K^-1 = diag(1, 1, f) / f. The Sampson distance is r = y1^T F y0 / s (Sampson, 1982; Hartley
and Zisserman, Multiple View Geometry, 11.4.3). s is the norm of the gradient of y1^T F y0 in the
four pixel coordinates, so r is in pixels. With P = diag(1, 1, 0), the derivative of r with respect
to F is

    dr = (a^T dF y0 + y1^T dF b) / s,     a = y1 - (r / s) P F y0,     b = -(r / s) P F^T y1.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.geometry.coordinates import Matrix3

Vectors = NDArray[np.float64]

MAX_STEPS = 10  # Levenberg-Marquardt iterations at one scale
MIN_GAIN = 1e-3  # stop after a smaller decrease of the cost; an outlier costs 0.5
# Of Levenberg-Marquardt, relative to the diagonal of the Hessian. A rejected step is tried again
# with ten times the damping, up to the maximum.
MIN_DAMPING = 1e-9
FIRST_DAMPING = 1e-3
MAX_DAMPING = 1e6
MAX_LOG_FOCAL = 2.0  # of |log f / g|: a factor of 7.4
TINY = float(np.finfo(np.float64).tiny)
# [e_k]x of the three axes, (3, 3, 3).
CROSS: NDArray[np.float64] = np.swapaxes(np.cross(np.eye(3)[:, None], np.eye(3)), 1, 2)
CROSS.setflags(write=False)


@dataclass(frozen=True, eq=False)
class TwoView:
    """Two views with X_1 = R X_0 + t and |t| = 1; ``logs`` (2,) are log f / g of both cameras."""

    R: Matrix3
    t: Vectors
    logs: Vectors

    @classmethod
    def nearest(cls, F: Matrix3, log0: float = 0.0, log1: float = 0.0) -> "TwoView":
        """Return the views with logs ``log0`` and ``log1`` whose E is nearest to the E of F.

        Four combinations of rotation and sign of t have the same F; the result is one of them.
        Raises ``LinAlgError`` if F is not finite.
        """
        logs = np.array([log0, log1])
        # Hartley and Zisserman, Multiple View Geometry, 9.6.2; singular values become (1, 1, 0).
        U, _, Vt = np.linalg.svd(F / _focal_factors(logs))
        # Makes the determinant of R one: U and V may have -1.
        sign = np.linalg.det(U) * np.linalg.det(Vt)
        quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, sign]])
        return cls(U @ quarter @ Vt, U[:, 2], logs)

    @property
    def fundamental(self) -> Matrix3:
        """The F (3, 3) of rays: y1^T F y0 = 0."""
        return np.asarray(cross_matrix(self.t) @ self.R * _focal_factors(self.logs))

    @property
    def twisted(self) -> "TwoView":
        """The two views with the same F and the other rotation."""
        half_turn = 2 * np.outer(self.t, self.t) - np.eye(3)  # about t
        return TwoView(half_turn @ self.R, self.t, self.logs)

    def depth_signs(
        self, rays0: Vectors, rays1: Vectors, error: float
    ) -> NDArray[np.float64]:
        """Return (N,) signs: 1 for a point in front of both cameras, -1 behind both, 0 otherwise.

        The point is the least-squares solution of X_1 = R X_0 + t along the rays. With -t the signs
        are opposite. The sign is NaN if the rays are parallel within ``error`` pixels: the point
        may be at infinity.
        """
        ratio0, ratio1 = np.exp(self.logs)
        # Both rays (N, 3) in the axes of camera 1.
        a = (rays0 * (1, 1, ratio0)) @ self.R.T
        b = rays1 * (1, 1, ratio1)
        aa = _row_dots(a, a)
        bb = _row_dots(b, b)
        ab = _row_dots(a, b)
        at = a @ self.t
        bt = b @ self.t
        # Depths d0 and d1 minimise |d1 b - d0 a - t|^2. Cramer's rule gives them up to the positive
        # determinant aa bb - ab^2, so the numerators have their signs.
        depth0 = ab * bt - bb * at
        depth1 = aa * bt - ab * at
        signs = (np.sign(depth0) + np.sign(depth1)) / 2
        # The distance of b from the line of a, in pixels, as b is.
        distance = np.sqrt(np.maximum(aa * bb - ab**2, 0) / aa)
        return np.where(distance > error, signs, np.nan)

    def tangent(self) -> NDArray[np.float64]:
        """Return the Jacobian (9, 7) of F's elements.

        Columns are the derivatives by rotation (3), t on the sphere (2) and logs (2).
        """
        F = self.fundamental
        factors = _focal_factors(self.logs)
        # A small rotation w changes R by [w]x R, a small step along t's tangent changes [t]x.
        turns = cross_matrix(self.t) @ CROSS @ self.R * factors  # (3, 3, 3)
        # (2, 3, 3)
        shifts = np.tensordot(self._tangent_basis().T, CROSS, 1) @ self.R * factors
        # Focal length 0 is a factor of F's last column, focal length 1 of its last row.
        by_log0 = np.zeros((3, 3))
        by_log0[:, 2] = F[:, 2]
        by_log1 = np.zeros((3, 3))
        by_log1[2] = F[2]
        return np.concatenate([turns, shifts, [by_log0, by_log1]]).reshape(7, 9).T

    def moved(self, step: Vectors) -> "TwoView":
        """Return the views after a step (7,) along the columns of :meth:`tangent`."""
        from scipy.spatial.transform import Rotation  # here: the import takes half a second

        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        t = self.t + self._tangent_basis() @ step[3:5]
        t /= np.linalg.norm(t)  # back on the sphere: the scale of t is free
        return TwoView(turn @ self.R, t, self.logs + step[5:])

    def _tangent_basis(self) -> NDArray[np.float64]:
        """Return (3, 2) orthonormal vectors perpendicular to t."""
        # Perpendicular to the axis that is farthest from t, so never zero.
        first = cross_matrix(self.t)[np.argmin(np.abs(self.t))]
        first = first / np.linalg.norm(first)
        return np.column_stack([first, cross_matrix(self.t) @ first])


@dataclass(frozen=True, eq=False)
class Problem:
    """A fit of two views to rays (N, 3) of equal ``weight``.

    ``sigmas`` (2,) are the standard deviations of log f / g. A sigma of 0 fixes the focal length of
    that camera.
    """

    rays0: Vectors
    rays1: Vectors
    sigmas: Vectors
    weight: float = 1.0

    def cost(self, view: TwoView, scale: float) -> float:
        """Return :meth:`prior_cost` plus the weighted sum of the rays' robust costs."""
        distances = sampson(view.fundamental, self.rays0, self.rays1)
        total = float(np.sum(robust_costs(distances, scale)))
        return self.weight * total + self.prior_cost(view)

    def prior_cost(self, view: TwoView) -> float:
        """Return half the sum of squared logs, each over its variance."""
        return 0.5 * float(self._precisions @ view.logs**2)

    def fit(self, start: TwoView, scale: float) -> TwoView:
        """Return a local minimum of :meth:`cost` near ``start``.

        The method is Levenberg-Marquardt, reweighted at every step.
        """
        view = start
        cost = self.cost(start, scale)
        damping = FIRST_DAMPING
        for _ in range(MAX_STEPS):
            gradient, curvature = self._derivatives(view, scale)
            # Shorter and shorter steps, until one of them lowers the cost.
            while damping < MAX_DAMPING:
                moved = view.moved(self._step(gradient, curvature, damping))
                moved_cost = np.inf
                if np.abs(moved.logs).max() < MAX_LOG_FOCAL:
                    moved_cost = self.cost(moved, scale)
                # False for NaN, the step of a singular system.
                if moved_cost < cost:
                    break
                damping *= 10
            else:
                break
            gain = cost - moved_cost
            view = moved
            cost = moved_cost
            damping = max(damping / 10, MIN_DAMPING)
            if gain < MIN_GAIN:
                break
        return view

    @property
    def _free(self) -> NDArray[np.bool_]:
        """(7,) mask of the free parameters."""
        return np.concatenate([np.ones(5, bool), self.sigmas > 0])

    @property
    def _precisions(self) -> Vectors:
        return np.array([1 / sigma**2 if sigma else 0.0 for sigma in self.sigmas])

    def _step(
        self, gradient: Vectors, curvature: NDArray[np.float64], damping: float
    ) -> Vectors:
        """Return the damped step (7,), or NaN, which is rejected, for a singular system."""
        free = self._free
        step = np.zeros(7)
        # Marquardt's scaling by the diagonal; MIN_DAMPING keeps a zero on it from being singular.
        damped = curvature + damping * np.diag(np.diag(curvature) + MIN_DAMPING)
        try:
            block = damped[np.ix_(free, free)]
            step[free] = -np.linalg.solve(block, gradient[free])
        except np.linalg.LinAlgError:
            step[free] = np.nan
        return step

    def _derivatives(
        self, view: TwoView, scale: float
    ) -> tuple[Vectors, NDArray[np.float64]]:
        """Return the gradient (7,) of the cost, and its Gauss-Newton Hessian (7, 7)."""
        lines0, lines1, slope = _lines(view.fundamental, self.rays0, self.rays1)
        distances = _row_dots(self.rays1, lines1) / slope  # r
        ratio = (distances / slope)[:, None]  # r / s
        # a and b of the module's docstring: P F y0 and P F^T y1 are the lines without their third
        # coordinate.
        a = self.rays1.copy()
        a[:, :2] -= ratio * lines1[:, :2]
        b = -ratio * lines0
        b[:, 2] = 0
        # dr / dF, times the slope: (N, 3, 3).
        by_element = a[:, :, None] * self.rays0[:, None]
        by_element += self.rays1[:, :, None] * b[:, None]
        jacobian = by_element.reshape(-1, 9) @ view.tangent()  # (N, 7)
        jacobian /= (scale * slope)[:, None]

        # The derivative of rho(x) is x / (1 + x^2)^2, that of a weighted least-squares problem.
        weights = self.weight / np.square(1 + np.square(distances / scale))
        weighted = jacobian * weights[:, None]
        gradient = weighted.T @ (distances / scale)
        curvature = weighted.T @ jacobian
        # The prior is quadratic in the two logs, parameters 5 and 6.
        gradient[5:] += self._precisions * view.logs
        curvature[[5, 6], [5, 6]] += self._precisions
        return gradient, curvature


def robust_costs(distances: Vectors, scale: float) -> Vectors:
    """Return x^2 / (2 (1 + x^2)) for x = distance / scale (Geman and McClure, 1985).

    An outlier costs 0.5.
    """
    # The same expression; x^2 / (1 + x^2) would be NaN for an infinite distance.
    return np.asarray(0.5 - 0.5 / (1 + np.square(distances / scale)))


def sampson(F: Matrix3, rays0: Vectors, rays1: Vectors) -> Vectors:
    """Return (N,) signed Sampson distances, in pixels, of rays (N, 3) under an F for rays."""
    _, lines1, slope = _lines(F, rays0, rays1)
    return np.asarray(_row_dots(rays1, lines1) / slope)


def _lines(F: Matrix3, rays0: Vectors, rays1: Vectors) -> tuple[Vectors, Vectors, Vectors]:
    """Return the epipolar lines (N, 3) in both images, and the norms (N,) of grad y1^T F y0."""
    lines0 = rays1 @ F
    lines1 = rays0 @ F.T
    normals0 = lines0[:, :2]
    normals1 = lines1[:, :2]
    squares = _row_dots(normals0, normals0) + _row_dots(normals1, normals1)
    # A point at both epipoles has no gradient, and its distance is zero.
    return lines0, lines1, np.sqrt(squares) + TINY


def _row_dots(a: Vectors, b: Vectors) -> Vectors:
    """Return the (N,) dot products of the rows of two (N, K) arrays."""
    return np.asarray(np.einsum("nk,nk->n", a, b))


def _focal_factors(logs: Vectors) -> Matrix3:
    """Return the (3, 3) factors that turn the elements of E into the elements of F."""
    # diag(1, 1, ratio1) E diag(1, 1, ratio0), element by element.
    ratio0, ratio1 = np.exp(logs)
    return np.array([[1, 1, ratio0], [1, 1, ratio0], [ratio1, ratio1, ratio0 * ratio1]])


def cross_matrix(t: Vectors) -> Matrix3:
    """Return [t]x, with [t]x v = t x v."""
    return np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
