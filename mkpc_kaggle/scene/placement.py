"""Cameras of a finished model: their world, and contradictions of its photographs, since another picture
may have the name of one.
"""

from collections import Counter
from collections.abc import Collection
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mkpc_kaggle.geometry.cameras import Camera, fundamental_of_cameras
from mkpc_kaggle.geometry.intrinsics import PlacedCamera
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import sampson_distances
from mkpc_kaggle.scene.view_graph import ViewGraph

MIN_CHECKED = 100  # verified matches with other images of the model; fewer may be wrong ones
# Share of these matches that fit the cameras. Right cameras keep almost all, and a picture from
# elsewhere those near an epipolar line by chance. Half of them may be with other wrong pictures.
MIN_CONSISTENT = 0.25
MAX_DISTANCE = 0.01  # of a match to the epipolar line, in focal lengths: the limit of the mapper


def misplaced_images(model: Any, correspondences: Any, numbers: Collection[int]) -> set[int]:
    """Return the images among ``numbers`` whose matches with each other contradict their cameras.

    ``model`` is pycolmap's, with these images registered; ``correspondences`` has verified matches.
    """
    import pycolmap  # may be missing, and other functions here do without

    checked: Counter[int] = Counter()
    consistent: Counter[int] = Counter()
    placed = set(numbers)
    matched = map(pycolmap.pair_id_to_image_pair, correspondences.num_matches_between_all_images())
    for first, second in sorted(matched):
        if not {first, second} <= placed:
            continue
        indices = correspondences.extract_matches_between_images(first, second)
        count = _count_consistent(model.images[first], model.images[second], np.asarray(indices))
        for number in (first, second):
            checked[number] += len(indices)
            consistent[number] += count
    return {
        number
        for number, count in checked.items()
        if count >= MIN_CHECKED and consistent[number] < MIN_CONSISTENT * count
    }


def centred(graph: ViewGraph) -> tuple[ViewGraph, NDArray[np.float64]]:
    """Return the graph in a world whose origin is in the middle of its placed cameras, and this origin in
    the world of the graph. Coordinates such as UTM's would leave few digits for bundle adjustment.
    """
    placed = {
        digest: camera for digest, camera in graph.known.items() if isinstance(camera, PlacedCamera)
    }
    if not placed:
        return graph, np.zeros(3)
    R = Rotation.from_quat([camera.pose[:4] for camera in placed.values()]).as_matrix()
    t = np.array([camera.pose[4:] for camera in placed.values()])
    origin = -np.einsum("nji,nj->ni", R, t).mean(axis=0)
    moved = {
        digest: replace(camera, pose=(*camera.pose[:4], *offset.tolist()))
        for (digest, camera), offset in zip(placed.items(), t + R @ origin, strict=True)
    }
    return replace(graph, known={**graph.known, **moved}), origin


def is_at(camera: Camera, placed: PlacedCamera) -> bool:
    """Return whether a camera has the pose of a finished model, but for rounding."""
    rotation = Rotation.from_quat(placed.pose[:4]).as_matrix()
    return bool(np.allclose(camera.R, rotation) and np.allclose(camera.t, placed.pose[4:]))


def _count_consistent(first: Any, second: Any, indices: Any) -> int:
    """Return how many matches, pairs of indices of keypoints, fit the cameras of two images."""
    if not len(indices):
        return 0
    rays = []
    cameras = []
    for image, column in ((first, indices[:, 0]), (second, indices[:, 1])):
        points = np.array([image.points2D[int(index)].xy for index in column])
        rays.append(np.asarray(image.camera.cam_from_img(points), np.float32)[:, :2])
        pose = np.asarray(image.cam_from_world().matrix())
        cameras.append(Camera(np.eye(3), pose[:, :3], pose[:, 3]))
    try:
        essential = fundamental_of_cameras(*cameras)
    except ValueError:  # two cameras at one place have no epipolar lines
        return len(indices)
    matches = Matches(rays[0], rays[1], np.ones(len(indices), np.float32))
    return int((sampson_distances(essential, matches) < MAX_DISTANCE).sum())
