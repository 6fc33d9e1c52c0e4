"""Synthetic batches with known cameras: noisy matches of true points, and wrong matches."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from mkpc_kaggle.geometry.cameras import Camera, fundamental_of_cameras
from mkpc_kaggle.geometry.coordinates import Box, Matrix3, Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import sampson_distances
from mkpc_kaggle.scene.reconstruct import Solution
from mkpc_kaggle.scene.reconstruction import RegisteredImage
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
        """Return the median Sampson distance, in pixels, of a pair's true correspondences under
        ``F``.
        """
        points = [project(camera, self.world[:400]) for camera in self.true_cameras(pair)]
        return float(np.median(sampson_distances(F, Matches(*points, np.ones(len(points[0]))))))


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
) -> SyntheticScene:
    """Return a scene of cameras on an arc in front of a facade, with ``pairs`` random pairs or all
    pairs.

    ``noise`` is the detector's standard deviation in pixels per coordinate: one number, or one for each image. A
    point has the same error in all pairs of the image, except for a deviation of 0.05 pixels. ``outliers`` is the
    share of wrong matches. Without ``focals``, in pixels, each camera has its own random focal length.
    """
    rng = np.random.default_rng(seed)
    world = front(rng, points)
    arc = [arc_camera(rng, number / max(images - 1, 1)) for number in range(images)]
    if focals:
        arc = [zoomed(camera, focal) for camera, focal in zip(arc, focals, strict=True)]
    ends = list(combinations(range(images), 2))
    if pairs is not None and pairs < len(ends):
        ends = [ends[index] for index in np.sort(rng.choice(len(ends), pairs, replace=False))]
    return batch_of(rng, world, arc, ends, noise, outliers, prefix=prefix)


def street(
    images: int, pairs: int, *, noise: float = 0.4, outliers: float = 0.25, seed: int = 0
) -> SyntheticScene:
    """Return a scene of one image per metre along a loop of facades; neighbours have up to 290
    matches.
    """
    rng = np.random.default_rng(seed)
    radius = images / (2 * np.pi)
    angles = 2 * np.pi * np.arange(images) / images
    count = round(2 * np.pi * (radius + 20) * 44)
    around, height = rng.uniform(0, 2 * np.pi, count), rng.uniform(-7, 7, count)
    bays = np.where(np.floor(around * (radius + 20) / 3) % 2 == 0, 0.0, 2.0) + rng.uniform(
        0, 1, count
    )
    distance = radius + 20 + bays
    world = np.column_stack([distance * np.sin(around), height, distance * np.cos(around)])
    cameras = [
        looking(
            np.array([radius * np.sin(angle), rng.normal(0, 0.2), radius * np.cos(angle)]),
            angle + rng.normal(0, np.radians(4)),
            max(SIZE) * np.exp(rng.normal(np.log(1.1), 0.1)),
        )
        for angle in angles
    ]
    near = ((step, first) for step in range(1, images) for first in range(images))
    ends = [tuple(sorted((first, (first + step) % images))) for step, first in near][:pairs]
    return batch_of(rng, world, cameras, sorted(set(ends)), noise, outliers, most=290)


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
    images = tuple(
        BatchImage(f"{prefix}{n:04}", f"digest of {prefix}{n:04}", SIZE)
        for n in range(len(cameras))
    )
    noises = np.broadcast_to(noise, len(cameras)).tolist()
    seen = [see(rng, camera, world, own) for camera, own in zip(cameras, noises, strict=True)]
    pairs = tuple(
        BatchPair(
            images[first], images[second], match(rng, seen[first], seen[second], outliers, most)
        )
        for first, second in ends
    )
    return SyntheticScene(
        images, pairs, dict(zip((i.name for i in images), cameras, strict=True)), world
    )


def front(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return (count, 3) world points of a facade with bays: x to the right, y down, z away from the
    cameras.
    """
    x, y = rng.uniform(-8, 8, count), rng.uniform(-4, 4, count)
    bays = np.where(np.floor(x / 2) % 2 == 0, 0.0, 2.0)
    return np.column_stack([x, y, bays + rng.uniform(0, 1.0, count)])


def arc_camera(rng: np.random.Generator, where: float) -> Camera:
    """Return a camera at ``where`` (0 to 1) on an 80-degree arc about the facade, with a random
    focal length.
    """
    angle = np.radians(80) * (where - 0.5) + rng.normal(0, 0.02)
    distance = rng.uniform(11, 15)
    centre = np.array(
        [distance * np.sin(angle), rng.normal(0, 0.5), 1.5 - distance * np.cos(angle)]
    )
    target = np.array([rng.normal(0, 1), rng.normal(0, 0.5), 1.5])
    ahead = (target - centre) / np.linalg.norm(target - centre)
    return pointed(centre, ahead, max(SIZE) * np.exp(rng.normal(np.log(1.1), 0.2)))


def looking(centre: np.ndarray, angle: float, focal: float) -> Camera:
    """Return a level camera whose viewing direction has this angle, in radians, about the vertical
    axis.
    """
    return pointed(centre, np.array([np.sin(angle), 0.0, np.cos(angle)]), focal)


def pointed(centre: np.ndarray, ahead: np.ndarray, focal: float) -> Camera:
    """Return an upright camera at ``centre`` that looks along the unit vector ``ahead``."""
    right = np.cross([0.0, 1, 0], ahead)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(ahead, right), ahead])
    return zoomed(Camera(np.eye(3), R, -R @ centre), focal)


def zoomed(camera: Camera, focal: float) -> Camera:
    """Return the camera with another focal length, in pixels."""
    K = np.array([[focal, 0, SIZE.width / 2 - 0.5], [0, focal, SIZE.height / 2 - 0.5], [0, 0, 1]])
    return replace(camera, K=K)


def project(camera: Camera, world: np.ndarray) -> np.ndarray:
    """Project (N, 3) world points to (N, 2) pixels."""
    seen = (world @ camera.R.T + camera.t) @ camera.K.T
    return np.asarray(seen[:, :2] / seen[:, 2:])


def see(rng: np.random.Generator, camera: Camera, world: np.ndarray, noise: float) -> Seen:
    """Detect the points that are in front of the camera and within the image."""
    found = project(camera, world) + rng.normal(0, noise, (len(world), 2))
    ahead = world @ camera.R[2] + camera.t[2] > 0
    numbers = np.flatnonzero(Box.whole(SIZE).contains(found) & ahead)
    return numbers, found[numbers]


def match(
    rng: np.random.Generator, first: Seen, second: Seen, outliers: float, most: int | None
) -> Matches:
    """Return matches of about half the points that both images share; some matches are wrong."""
    common, places0, places1 = np.intersect1d(
        first[0], second[0], assume_unique=True, return_indices=True
    )
    kept = np.flatnonzero(rng.random(len(common)) < 0.5)[:most]
    points0 = first[1][places0[kept]] + rng.normal(0, 0.05, (len(kept), 2))
    wrong = rng.random(len(kept)) < outliers
    other = kept.copy()
    other[wrong] = rng.permutation(kept[wrong])
    points1 = second[1][places1[other]] + rng.normal(0, 0.05, (len(kept), 2))
    return Matches(points0, points1, np.ones(len(kept)))
