"""Synthetic batches with known cameras: noisy matches of true points, and wrong matches."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np

from mkpc_kaggle.geometry.cameras import Camera, fundamental_of_cameras
from mkpc_kaggle.geometry.coordinates import Box, Matrix3, Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import sampson_distances
from mkpc_kaggle.scene.models import RegisteredImage
from mkpc_kaggle.scene.sfm import Solution
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair

SIZE = Size(800, 600)
# The points in an image: ascending indices (N,) and detected positions (N, 2).
Seen = tuple[np.ndarray, np.ndarray]


def registered_images(solution: Solution) -> dict[str, RegisteredImage]:
    """Return the registered images by digest, each from the first model that has it."""
    models = [model for found in solution.reconstructions for model in found.models]
    return {found.image.digest: found for model in reversed(models) for found in model.images}


@dataclass(frozen=True, eq=False)
class SyntheticScene:
    """A batch's images and pairs, the true cameras by image name, and the world's points (P, 3)."""

    images: tuple[BatchImage, ...]
    pairs: tuple[BatchPair, ...]
    cameras: dict[str, Camera]
    world: np.ndarray

    def true_cameras(self, pair: BatchPair) -> tuple[Camera, Camera]:
        return self.cameras[pair.image0.name], self.cameras[pair.image1.name]

    def true_fundamental(self, pair: BatchPair) -> Matrix3:
        return fundamental_of_cameras(*self.true_cameras(pair))

    def median_distance(self, F: Matrix3, pair: BatchPair) -> float:
        """Return the median Sampson distance in pixels of true correspondences under ``F``."""
        # Of points that the images need not see: F holds for them, too.
        world = self.world[:400]
        camera0, camera1 = self.true_cameras(pair)
        points0 = project(camera0, world)
        points1 = project(camera1, world)
        scores = np.ones(len(world), np.float32)
        true = Matches(points0.astype(np.float32), points1.astype(np.float32), scores)
        return float(np.median(sampson_distances(F, true)))


def synthetic_scene(
    images: int,
    pairs: int | None = None,
    *,
    points: int = 1500,
    noise: float | Sequence[float] = 0.4,
    outliers: float = 0.2,
    seed: int = 0,
    prefix: str = "",
    focals: Sequence[float] = (),
    principal_point_share: float = 0.0,
) -> SyntheticScene:
    """Return a scene of cameras on an arc in front of a facade, with ``pairs`` random pairs or all.

    ``noise`` is the detector's standard deviation in pixels per coordinate: one number, or one for
    each image. A point has the same error in all pairs of the image, except for a deviation of 0.05
    pixels. ``outliers`` is the share of wrong matches. Without ``focals``, in pixels, each camera
    has its own random focal length. Principal points deviate from the middle by
    ``principal_point_share`` of the long side.
    """
    rng = np.random.default_rng(seed)
    world = front(rng, points)
    arc = [arc_camera(rng, number / max(images - 1, 1)) for number in range(images)]
    if focals:
        arc = [zoomed(camera, focal) for camera, focal in zip(arc, focals, strict=True)]
    if principal_point_share:
        offsets = rng.normal(0, principal_point_share * max(SIZE), (images, 2))
        arc = [shifted(camera, offset) for camera, offset in zip(arc, offsets, strict=True)]
    ends = list(combinations(range(images), 2))
    if pairs is not None and pairs < len(ends):
        drawn = rng.choice(len(ends), pairs, replace=False)
        ends = [ends[index] for index in np.sort(drawn)]
    return batch_of(rng, world, arc, ends, noise, outliers, prefix=prefix)


def street(
    images: int, pairs: int, *, noise: float = 0.4, outliers: float = 0.25, seed: int = 0
) -> SyntheticScene:
    """Return a scene of one image per metre along a loop of facades.

    Images look outwards. Neighbours have up to 290 matches.
    """
    rng = np.random.default_rng(seed)
    radius = images / (2 * np.pi)
    wall = radius + 20  # the facades are 20 m away, with 44 points a metre
    count = round(2 * np.pi * wall * 44)
    around = rng.uniform(0, 2 * np.pi, count)
    height = rng.uniform(-7, 7, count)
    # Every second bay of 3 m is set back: points of one plane would leave F undetermined.
    setback = np.where(np.floor(around * wall / 3) % 2 == 0, 0.0, 2.0)
    distance = wall + (setback + rng.uniform(0, 1, count))
    east = distance * np.sin(around)
    north = distance * np.cos(around)
    world = np.column_stack([east, height, north])
    cameras = []
    for angle in 2 * np.pi * np.arange(images) / images:
        x = radius * np.sin(angle)
        y = rng.normal(0, 0.2)
        z = radius * np.cos(angle)
        centre = np.array([x, y, z])
        direction = angle + rng.normal(0, np.radians(4))
        focal = max(SIZE) * np.exp(rng.normal(np.log(1.1), 0.1))
        cameras.append(looking(centre, direction, focal))
    # The nearest images first: all next neighbours, then the second next, ...
    ends = []
    for step, first in product(range(1, images), range(images)):
        second = (first + step) % images
        ends.append((min(first, second), max(first, second)))
    # From half the loop on, the same pairs come again from the other side.
    distinct = sorted(set(ends[:pairs]))
    return batch_of(rng, world, cameras, distinct, noise, outliers, most=290)


def batch_of(
    rng: np.random.Generator,
    world: np.ndarray,
    cameras: Sequence[Camera],
    ends: Iterable[tuple[int, int]],
    noise: float | Sequence[float],
    outliers: float,
    *,
    prefix: str = "",
    most: int | None = None,
) -> SyntheticScene:
    """Return the scene of these cameras and of the pairs with the image indices ``ends``."""
    names = [f"{prefix}{number:04}" for number in range(len(cameras))]
    images = tuple(BatchImage(name, f"digest of {name}", SIZE) for name in names)
    noises = np.broadcast_to(noise, len(cameras)).tolist()
    # Detected once per image: a point's error is the same in all pairs.
    seen = [see(rng, camera, world, own) for camera, own in zip(cameras, noises, strict=True)]
    pairs = []
    for first, second in ends:
        matches = match(rng, seen[first], seen[second], outliers, most)
        pairs.append(BatchPair(images[first], images[second], (matches,)))
    by_name = dict(zip(names, cameras, strict=True))
    return SyntheticScene(images, tuple(pairs), by_name, world)


def front(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return world points (count, 3) of a facade with bays.

    x is to the right, y down, z away from the cameras.
    """
    x = rng.uniform(-8, 8, count)
    y = rng.uniform(-4, 4, count)
    setback = np.where(np.floor(x / 2) % 2 == 0, 0.0, 2.0)
    return np.column_stack([x, y, setback + rng.uniform(0, 1.0, count)])


def arc_camera(rng: np.random.Generator, where: float) -> Camera:
    """Return a camera at ``where`` (0 to 1) on an 80-degree arc about the facade.

    Its focal length is random, about 1.1 times the image's longer side.
    """
    angle = np.radians(80) * (where - 0.5) + rng.normal(0, 0.02)
    distance = rng.uniform(11, 15)
    x = distance * np.sin(angle)
    y = rng.normal(0, 0.5)
    z = 1.5 - distance * np.cos(angle)  # the middle of the facade's depth is at 1.5
    centre = np.array([x, y, z])
    target = np.array([rng.normal(0, 1), rng.normal(0, 0.5), 1.5])
    ahead = (target - centre) / np.linalg.norm(target - centre)
    focal = max(SIZE) * np.exp(rng.normal(np.log(1.1), 0.2))
    return pointed(centre, ahead, focal)


def looking(centre: np.ndarray, angle: float, focal: float) -> Camera:
    """Return a level camera that looks at an angle, in radians, about the vertical axis."""
    ahead = np.array([np.sin(angle), 0.0, np.cos(angle)])
    return pointed(centre, ahead, focal)


def pointed(centre: np.ndarray, ahead: np.ndarray, focal: float) -> Camera:
    """Return an upright camera at ``centre`` that looks along the unit vector ``ahead``."""
    right = np.cross([0.0, 1, 0], ahead)  # y is down
    right /= np.linalg.norm(right)
    down = np.cross(ahead, right)
    R = np.stack([right, down, ahead])
    camera = Camera(np.eye(3), R, -R @ centre)
    return zoomed(camera, focal)


def zoomed(camera: Camera, focal: float) -> Camera:
    """Return the camera with another focal length, in pixels."""
    # Pixel centres are at integers, so the image's centre is half a pixel before the half size.
    centre_x = SIZE.width / 2 - 0.5
    centre_y = SIZE.height / 2 - 0.5
    K = np.array([[focal, 0, centre_x], [0, focal, centre_y], [0, 0, 1]])
    return replace(camera, K=K)


def shifted(camera: Camera, offset: np.ndarray) -> Camera:
    """Return the camera with its principal point moved by ``offset`` (2,), in pixels."""
    K = camera.K.copy()
    K[:2, 2] += offset
    return replace(camera, K=K)


def project(camera: Camera, world: np.ndarray) -> np.ndarray:
    """Project (N, 3) world points to (N, 2) pixels."""
    in_camera = world @ camera.R.T + camera.t
    seen = in_camera @ camera.K.T
    return np.asarray(seen[:, :2] / seen[:, 2:])


def see(rng: np.random.Generator, camera: Camera, world: np.ndarray, noise: float) -> Seen:
    """Detect the points that are in front of the camera and within the image."""
    # Noise for all points, also unseen ones: the draws do not depend on the camera.
    errors = rng.normal(0, noise, (len(world), 2))
    found = project(camera, world) + errors
    depth = world @ camera.R[2] + camera.t[2]
    is_inside = Box.whole(SIZE).contains(found)
    numbers = np.flatnonzero(is_inside & (depth > 0))
    return numbers, found[numbers]


def match(
    rng: np.random.Generator, first: Seen, second: Seen, outliers: float, most: int | None
) -> Matches:
    """Return matches of about half the points that both images share; some matches are wrong."""
    numbers0, detected0 = first
    numbers1, detected1 = second
    common, index0, index1 = np.intersect1d(
        numbers0, numbers1, assume_unique=True, return_indices=True
    )
    kept = np.flatnonzero(rng.random(len(common)) < 0.5)[:most]
    moves = rng.normal(0, 0.05, (len(kept), 2))
    points0 = detected0[index0[kept]] + moves
    # A wrong match is of another point that is matched, as repetitions give.
    wrong = rng.random(len(kept)) < outliers
    other = kept.copy()
    other[wrong] = rng.permutation(kept[wrong])
    moves = rng.normal(0, 0.05, (len(kept), 2))
    points1 = detected1[index1[other]] + moves
    scores = np.ones(len(kept), np.float32)
    return Matches(points0.astype(np.float32), points1.astype(np.float32), scores)
