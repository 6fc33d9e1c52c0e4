"""A batch from known cameras: matches of true points with noise, and wrong ones."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from mkpc_kaggle.geometry.cameras import Camera, fundamental_of_cameras
from mkpc_kaggle.geometry.coordinates import Box, Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import Matrix3, sampson_distances
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair

SIZE = Size(800, 600)


@dataclass(frozen=True, eq=False)
class SyntheticScene:
    """A batch's images and pairs, and the true cameras by image name."""

    images: tuple[BatchImage, ...]
    pairs: tuple[BatchPair, ...]
    cameras: dict[str, Camera]

    def true_fundamental(self, pair: BatchPair) -> Matrix3:
        return fundamental_of_cameras(self.cameras[pair.image0.name], self.cameras[pair.image1.name])

    def median_distance(self, F: Matrix3, pair: BatchPair) -> float:
        """How far true correspondences of a pair are from an F: the median of Sampson's distance, in pixels."""
        rng = np.random.default_rng(0)
        world = front(rng, 400)
        points = [project(self.cameras[image.name], world) for image in (pair.image0, pair.image1)]
        return float(np.median(sampson_distances(F, Matches(*points, np.ones(len(world))))))


def synthetic_scene(
    images: int,
    pairs: int | None = None,
    *,
    points: int = 1500,
    noise: float = 0.4,
    outliers: float = 0.2,
    seed: int = 0,
    prefix: str = "",
    focals: Sequence[float] = (),
) -> SyntheticScene:
    """Cameras on an arc before a front with depth; ``pairs`` of all pairs, chosen evenly, or all of them.

    A point is where the image's detector finds it, ``noise`` pixels off in each coordinate, and the same in every
    pair of the image but for a twentieth of a pixel. ``outliers`` is the share of matches between other points.
    Without ``focals``, in pixels, each camera has a focal length of its own.
    """
    rng = np.random.default_rng(seed)
    world = front(rng, points)
    arc = [arc_camera(rng, number / max(images - 1, 1)) for number in range(images)]
    if focals:
        arc = [zoomed(camera, focal) for camera, focal in zip(arc, focals, strict=True)]
    cameras = {f"{prefix}{number:04}": camera for number, camera in enumerate(arc)}
    seen = {name: project(camera, world) + rng.normal(0, noise, (points, 2)) for name, camera in cameras.items()}
    named = tuple(BatchImage(name, f"digest of {name}", SIZE) for name in cameras)
    chosen = list(combinations(named, 2))
    if pairs is not None and pairs < len(chosen):
        chosen = [chosen[index] for index in np.sort(rng.choice(len(chosen), pairs, replace=False))]
    made = tuple(match(rng, first, second, seen, outliers) for first, second in chosen)
    return SyntheticScene(named, made, cameras)


def front(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 3) world points of a facade with bays: x to the right, y down, z away from the cameras."""
    x, y = rng.uniform(-8, 8, count), rng.uniform(-4, 4, count)
    bays = np.where(np.floor(x / 2) % 2 == 0, 0.0, 2.0)
    return np.column_stack([x, y, bays + rng.uniform(0, 1.0, count)])


def arc_camera(rng: np.random.Generator, where: float) -> Camera:
    """A camera at ``where`` (0 to 1) of an arc of 80 degrees about the front, with a focal length of its own."""
    angle = np.radians(80) * (where - 0.5) + rng.normal(0, 0.02)
    distance = rng.uniform(11, 15)
    centre = np.array([distance * np.sin(angle), rng.normal(0, 0.5), 1.5 - distance * np.cos(angle)])
    target = np.array([rng.normal(0, 1), rng.normal(0, 0.5), 1.5])
    ahead = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross([0.0, 1, 0], ahead)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(ahead, right), ahead])
    return zoomed(Camera(np.eye(3), R, -R @ centre), max(SIZE) * np.exp(rng.normal(np.log(1.1), 0.2)))


def zoomed(camera: Camera, focal: float) -> Camera:
    """The camera with another focal length, in pixels."""
    K = np.array([[focal, 0, SIZE.width / 2 - 0.5], [0, focal, SIZE.height / 2 - 0.5], [0, 0, 1]])
    return replace(camera, K=K)


def project(camera: Camera, world: np.ndarray) -> np.ndarray:
    """(N, 3) world points -> (N, 2) pixels."""
    seen = (world @ camera.R.T + camera.t) @ camera.K.T
    return np.asarray(seen[:, :2] / seen[:, 2:])


def match(
    rng: np.random.Generator,
    first: BatchImage,
    second: BatchImage,
    seen: dict[str, np.ndarray],
    outliers: float,
) -> BatchPair:
    """The points that both images see, some of them lost and some mixed up."""
    whole = Box.whole(SIZE)
    common = np.flatnonzero(whole.contains(seen[first.name]) & whole.contains(seen[second.name]))
    common = common[rng.random(len(common)) < 0.5]
    points0 = seen[first.name][common] + rng.normal(0, 0.05, (len(common), 2))
    wrong = rng.random(len(common)) < outliers
    other = common.copy()
    other[wrong] = rng.permutation(common[wrong])
    points1 = seen[second.name][other] + rng.normal(0, 0.05, (len(common), 2))
    return BatchPair(first, second, Matches(points0, points1, np.ones(len(common))))
