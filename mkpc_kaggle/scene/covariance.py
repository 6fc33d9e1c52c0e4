"""Covariance of a model's cameras: the inverse of the normal equations of bundle adjustment, from which
the points are eliminated (the Schur complement).

Bundle adjustment holds principal points in the middle of the images, and no camera's is exactly there.
Of many keypoints, this error is larger than that of their noise, so it is added. The noise is estimated
from the residuals.
"""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from math import inf
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mkpc_kaggle.geometry.intrinsics import KnownCamera
from mkpc_kaggle.scene.models import MAX_SIGMA_IMAGES, MIN_POINTS

Array = NDArray[np.float64]
# Of an image: the ascending rows (n,) of its points, the columns (c,) of its parameters, values (n, c, 3)
Block = tuple[NDArray[np.int64], NDArray[np.int64], Array]

STEP = 1e-6  # of numerical derivatives, relative
DAMPING = 1e-10  # of scaled normal equations, which have the seven freedoms of the world
GAUGE = 7
CHUNK = 1_000_000  # parameters times points that are eliminated at a time, for 24 MB


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of a model's cameras, in a world whose origin is in their middle.

    ``poses`` (6N, 6N) has three angles in radians and the translation of each of the ``images``, for
    X_cam = exp(angles) R X + t; ``matrices`` are their [R | t]. ``intrinsics`` has the covariance (p, p) of
    each camera's parameters, by camera id, zeros if the camera is exact. Variances of a camera without it
    are infinite.
    """

    images: tuple[Any, ...]  # as :func:`seeing_images` returns them
    matrices: Array  # (N, 3, 4)
    poses: Array
    intrinsics: Mapping[int, Array]

    def variance(self, camera: Any, quantity: Callable[[KnownCamera], float]) -> float:
        """Return the variance of a quantity of a camera, to first order."""
        known = self.intrinsics.get(camera.camera_id)
        if known is None:
            return inf
        values = np.array(camera.params)
        gradient = np.empty(len(values))
        for parameter, value in enumerate(values):
            step = np.zeros(len(values))
            step[parameter] = STEP * max(1.0, abs(value))
            after = quantity(KnownCamera(camera.model_name, tuple(values + step)))
            before = quantity(KnownCamera(camera.model_name, tuple(values - step)))
            gradient[parameter] = (after - before) / (2 * step[parameter])
        variance = float(gradient @ known @ gradient)
        return variance if variance >= 0 else inf  # negative by rounding, if nearly undetermined

    def focal_variance(self, camera: Any) -> float:
        """Return the variance of the logarithm of a mean focal length."""
        known = self.intrinsics.get(camera.camera_id)
        focals = camera.focal_length_idxs()
        if known is None:
            return inf
        return float(known[np.ix_(focals, focals)].mean() / camera.mean_focal_length() ** 2)


def covariance_of(
    model: Any,
    given_cameras: Mapping[str, KnownCamera],
    principal_point_share: float,
    numbers: Collection[int] | None = None,
) -> Covariance | None:
    """Return the covariance of pycolmap's model; ``None`` if it is not determined, or of more than
    ``MAX_SIGMA_IMAGES`` images.

    Principal points deviate by ``principal_point_share`` of the long side; with 0 they are exact. With
    ``numbers``, the model is one of these images alone.
    """
    images = seeing_images(model, numbers)
    if not 1 < len(images) <= MAX_SIGMA_IMAGES:
        return None
    cameras = _inexact_cameras(images, given_cameras)
    # The world of coordinates such as UTM's is far away: their equations are singular but for rounding.
    origin = np.mean([image.projection_center() for image in images], axis=0)
    matrices = np.array([image.cam_from_world().matrix() for image in images])
    matrices[:, :, 3] += matrices[:, :, :3] @ origin
    try:
        equations = _NormalEquations.of(model, images, matrices, origin, cameras.values())
    except np.linalg.LinAlgError:  # a point that its images do not determine
        return None
    # The adjusted parameters, and the principal points, which are held
    is_held = np.zeros(len(equations.matrix), bool)
    held_variances = np.zeros(len(is_held))
    for start, (camera, sigma) in zip(equations.starts, cameras.values(), strict=True):
        held = start + np.array(camera.principal_point_idxs())
        is_held[held] = True
        deviation = principal_point_share * max(camera.width, camera.height)
        if sigma:
            # A calibration knows it about as well, in pixels, as the focal length.
            deviation = min(deviation, sigma / 100 * camera.mean_focal_length())
        held_variances[held] = deviation**2
    adjusted = np.count_nonzero(~is_held) + 3 * equations.points - GAUGE
    redundancy = equations.residuals - adjusted
    if redundancy <= 0 or not equations.squares:
        return None
    noise = equations.squares / redundancy  # variance of a keypoint's coordinate, square pixels
    matrix = equations.matrix / noise
    inverse = _inverse(matrix[np.ix_(~is_held, ~is_held)], equations.scale[~is_held] / noise)
    if inverse is None:
        return None
    # Errors of what is held move the optimum of the rest.
    moves = inverse @ matrix[np.ix_(~is_held, is_held)]
    covariance = np.diag(held_variances)
    covariance[np.ix_(~is_held, ~is_held)] = inverse + moves * held_variances[is_held] @ moves.T
    blocks = {
        image.camera_id: np.zeros((len(image.camera.params),) * 2)
        for image in images
        if image.camera_id not in cameras
    }
    for start, (camera, _) in zip(equations.starts, cameras.values(), strict=True):
        block = slice(start, start + len(camera.params))
        blocks[camera.camera_id] = covariance[block, block]
    number = 6 * len(images)
    return Covariance(tuple(images), matrices, covariance[:number, :number], blocks)


def connected_part(model: Any) -> list[int]:
    """Return the numbers of ``MAX_SIGMA_IMAGES`` images of a large model of pycolmap that see many points
    together.
    """
    images = [image for _, image in sorted(model.images.items()) if image.has_pose]
    points = [
        {each.point3D_id for each in image.points2D if each.has_point3D()} for image in images
    ]
    rows = np.repeat(np.arange(len(images)), list(map(len, points)))
    columns = np.fromiter(chain.from_iterable(points), np.int64)
    _, columns = np.unique(columns, return_inverse=True)
    seen = csr_array((np.ones(len(rows)), (rows, columns)))
    common = (seen @ seen.T).tocsr()
    # From the image with most points on, always the one with most points in common with those so far
    chosen = [int(np.argmax(list(map(len, points))))]
    counts = np.zeros(len(images))
    while len(chosen) < min(MAX_SIGMA_IMAGES, len(images)):
        counts += common[[chosen[-1]]].toarray()[0]
        counts[chosen] = -inf
        chosen.append(int(np.argmax(counts)))
    return [images[index].image_id for index in chosen]


def seeing_images(model: Any, numbers: Collection[int] | None = None) -> list[Any]:
    """Return the registered images of pycolmap's model, or those among ``numbers``, that see enough points
    which others of them see, too, in the order of their ids.

    An image that sees fewer is no plausible one of the model. Its pose may be anywhere, and would make the
    world of all others uncertain.
    """
    images = [
        image
        for number, image in sorted(model.images.items())
        if image.has_pose and (numbers is None or number in numbers)
    ]
    seen = {
        image.image_id: [each.point3D_id for each in image.points2D if each.has_point3D()]
        for image in images
    }
    while True:
        counts = Counter(chain.from_iterable(seen[image.image_id] for image in images))
        kept = [
            image
            for image in images
            if sum(counts[number] > 1 for number in seen[image.image_id]) >= MIN_POINTS
        ]
        if len(kept) == len(images):
            return kept
        images = kept


def _inexact_cameras(
    images: Sequence[Any], given_cameras: Mapping[str, KnownCamera]
) -> dict[int, tuple[Any, float]]:
    """Return the cameras whose intrinsics are not exact, by id, with the deviations in percent of
    their given focal lengths, 0 if unknown.
    """
    cameras = {}
    for image in images:
        known = given_cameras.get(image.name)
        if known is None or known.sigma:
            cameras[image.camera_id] = (image.camera, known.sigma if known else 0.0)
    return cameras


@dataclass(frozen=True, eq=False)
class _NormalEquations:
    """The normal equations J^T J of all reprojection errors, without the points, in the world of the
    ``matrices``.

    The six columns of each image come first, then the parameters of the cameras, at ``starts``.
    """

    matrix: Array
    scale: Array  # the diagonal before the points were eliminated
    starts: tuple[int, ...]
    points: int
    residuals: int  # two of each observation
    squares: float  # their sum of squares, in square pixels

    @classmethod
    def of(
        cls,
        model: Any,
        images: Sequence[Any],
        matrices: Array,
        origin: Array,
        cameras: Iterable[tuple[Any, float]],
    ) -> "_NormalEquations":
        start_of = {}
        size = 6 * len(images)
        for camera, _ in cameras:
            start_of[camera.camera_id] = size
            size += len(camera.params)
        counts = Counter(
            each.point3D_id for image in images for each in image.points2D if each.has_point3D()
        )
        # One ray determines no point, and rays without parallax give points at infinity.
        places = {
            number: model.points3D[number].xyz for number in sorted(counts) if counts[number] > 1
        }
        numbers = [number for number, place in places.items() if np.isfinite(place).all()]
        row_of = {number: row for row, number in enumerate(numbers)}
        points = np.array([places[number] for number in numbers]).reshape(-1, 3) - origin
        matrix = np.zeros((size, size))
        of_points = np.zeros((len(points), 3, 3))
        observed: list[Block] = []  # J^T J of cameras with points
        squares = 0.0
        for number, image in enumerate(images):
            seen = [each for each in image.points2D if each.point3D_id in row_of]
            seen.sort(key=lambda each: row_of[each.point3D_id])
            rows = np.array([row_of[each.point3D_id] for each in seen], np.int64)
            columns = np.arange(6 * number, 6 * number + 6)
            residuals, by_pose, by_parameters, by_point = _derivatives(
                image, matrices[number], points[rows], seen
            )
            by_camera = by_pose
            if image.camera_id in start_of:
                by_camera = np.concatenate([by_pose, by_parameters], axis=2)
                start = start_of[image.camera_id]
                columns = np.append(columns, np.arange(start, start + by_parameters.shape[2]))
            squares += float((residuals**2).sum())
            matrix[np.ix_(columns, columns)] += np.einsum("nij,nik->jk", by_camera, by_camera)
            np.add.at(of_points, rows, np.einsum("nij,nik->njk", by_point, by_point))
            observed.append((rows, columns, np.einsum("nij,nik->njk", by_camera, by_point)))
        # With C = L L^T, A - B C^-1 B^T = A - V V^T, where V = B L^-T
        trace = np.trace(of_points, axis1=1, axis2=2)[:, None, None]
        roots = np.linalg.cholesky(of_points + DAMPING * trace * np.eye(3))
        to_white = np.linalg.inv(roots).transpose(0, 2, 1)
        blocks = [(rows, columns, mixed @ to_white[rows]) for rows, columns, mixed in observed]
        scale = np.diag(matrix).copy()
        step = max(1, CHUNK // size)
        for start in range(0, len(points), step):
            part = _dense(blocks, size, start, min(start + step, len(points)))
            matrix -= part @ part.T
        residuals_count = sum(2 * len(rows) for rows, _, _ in observed)
        return cls(matrix, scale, tuple(start_of.values()), len(points), residuals_count, squares)


def _dense(blocks: Iterable[Block], size: int, start: int, end: int) -> Array:
    """Return V (size, 3 n) of the points from ``start`` to ``end``."""
    dense = np.zeros((size, end - start, 3))
    for rows, columns, block in blocks:
        inside = slice(*np.searchsorted(rows, (start, end)))
        places = (columns[:, None], rows[inside] - start)
        # An image may see a point twice.
        np.add.at(dense, places, block[inside].transpose(1, 0, 2))
    return dense.reshape(size, -1)


def _derivatives(
    image: Any, matrix: Array, points: Array, seen: Sequence[Any]
) -> tuple[Array, Array, Array, Array]:
    """Return an image's residuals (n, 2) in pixels, and their derivatives: by angles and translation
    (n, 2, 6), by the camera's parameters (n, 2, p), and by the points (n, 2, 3).
    """
    R = matrix[:, :3]
    turned = points @ R.T
    in_camera = turned + matrix[:, 3]
    camera: Any = pycolmap.Camera(image.camera.todict())
    by_ray = np.empty((len(points), 2, 3))
    for axis in range(3):
        step = np.zeros_like(in_camera)
        step[:, axis] = STEP * in_camera[:, 2]
        change = camera.img_from_cam(in_camera + step) - camera.img_from_cam(in_camera - step)
        by_ray[:, :, axis] = change / (2 * step[:, axis, None])
    values = np.array(camera.params)
    by_parameters = np.empty((len(points), 2, len(values)))
    for parameter, value in enumerate(values):
        step = np.zeros_like(values)
        step[parameter] = STEP * max(1.0, abs(value))
        camera.params = (values + step).tolist()
        after = camera.img_from_cam(in_camera)
        camera.params = (values - step).tolist()
        change = after - camera.img_from_cam(in_camera)
        by_parameters[:, :, parameter] = change / (2 * step[parameter])
    keypoints = np.array([each.xy for each in seen]).reshape(-1, 2)
    residuals = image.camera.img_from_cam(in_camera) - keypoints
    # An angle w moves a turned point by w x point, and ray . (w x point) = w . (point x ray).
    by_angles = np.cross(turned[:, None], by_ray)
    return residuals, np.concatenate([by_angles, by_ray], axis=2), by_parameters, by_ray @ R


def _inverse(matrix: Array, scale: Array) -> Array | None:
    """Return the inverse of normal equations, whose rounding errors are relative to ``scale``; ``None``
    if they are singular.
    """
    if not np.isfinite(matrix).all() or scale.min() <= 0:
        return None
    scales = np.sqrt(np.outer(scale, scale))
    try:
        inverse = np.linalg.inv(matrix / scales + DAMPING * np.eye(len(matrix)))
    except np.linalg.LinAlgError:
        return None
    # Of equations that are not positive definite, by rounding
    return np.asarray(inverse / scales) if np.diag(inverse).min() > 0 else None
