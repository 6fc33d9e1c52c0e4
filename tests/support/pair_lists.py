"""Writes pairs in the format that :mod:`benchmarks.lists` reads."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from mkpc_kaggle.data.competition import TrainScene, TruePair
from mkpc_kaggle.geometry.cameras import Camera, relative_pose
from mkpc_kaggle.geometry.coordinates import Size


def turned_camera(camera: Camera, turns: int, size: Size) -> Camera:
    """The camera of ``np.rot90(picture, turns)``, where ``camera`` took a picture of ``size``."""
    quarter = np.array(
        [
            [0.0, 1, 0],
            [-1, 0, 0],
            [0, 0, 1],
        ]
    )
    width, height = size
    for _ in range(turns % 4):
        # The last column of pixels becomes the first row.
        shift = np.array(
            [
                [1.0, 0, 0],
                [0, 1, width - 1],
                [0, 0, 1],
            ]
        )
        K = shift @ quarter @ camera.K @ quarter.T
        camera = Camera(K, quarter @ camera.R, quarter @ camera.t)
        width, height = height, width
    return camera


def line_of(
    names: tuple[str, str], cameras: tuple[Camera, Camera], turns: tuple[int, int] = (0, 0)
) -> str:
    R, t = relative_pose(*cameras)
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    # 17 digits: the package must read the very cameras that the test has.
    first, second = cameras
    numbers = np.concatenate([first.K.ravel(), second.K.ravel(), T.ravel()])
    written = [f"{number:.17g}" for number in numbers]
    return " ".join([*names, *map(str, turns), *written])


def line_of_pair(true: TruePair, image_root: Path) -> str:
    image0, image1 = (str(image.relative_to(image_root)) for image in true.pair.images)
    return line_of((image0, image1), (true.camera0, true.camera1))


def write_list(path: Path, scenes: Iterable[TrainScene], image_root: Path) -> Path:
    lines = [line_of_pair(true, image_root) for scene in scenes for true in scene.pairs]
    path.write_text("\n".join(lines) + "\n")
    return path
