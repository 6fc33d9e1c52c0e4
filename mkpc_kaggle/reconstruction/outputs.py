"""Tables of cameras: ours, and those that the Image Matching Challenges of 2023 to 2025 ask for."""

import csv
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.outputs import replacing
from mkpc_kaggle.engine.records import CameraRecord
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.reconstruction.folder import Dataset

CAMERA_COLUMNS = ("image", "model", "K", "R", "t")
IMC2025_COLUMNS = ("image_id", "dataset", "scene", "image", "rotation_matrix", "translation_vector")
IMC2023_COLUMNS = ("image_path", "dataset", "scene", "rotation_matrix", "translation_vector")


class Form(StrEnum):
    """The forms of a submission."""

    IMC2025 = "imc2025"  # a cluster for each model; images without a camera are ``outliers`` with poses of ``nan``
    IMC2023 = "imc2023"  # also of 2024: the cameras of the largest model, the others at the origin


@dataclass(frozen=True)
class DatasetCameras:
    """A dataset with the cameras that were found, by the names of the images' files."""

    dataset: Dataset
    cameras: dict[str, CameraRecord]


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Write a CSV file in one piece; raises ``OSError`` where it cannot be written."""
    with replacing(path) as stream:
        csv.writer(stream, lineterminator="\n").writerows([columns, *rows])


def camera_rows(found: Iterable[DatasetCameras]) -> Iterator[Sequence[str]]:
    """A row for each image with a camera: its path below the folder, its model, K, R and t.

    The centre of an image's first pixel is (0, 0); X_cam = R X + t.
    """
    for each in found:
        for name, record in each.cameras.items():
            camera = record.camera
            path = (Path(each.dataset.name) / name).as_posix()
            yield path, str(record.model), *map(joined, (camera.K, camera.R, camera.t))


def submission_rows(form: Form, found: Iterable[DatasetCameras], root: Path) -> Iterator[Sequence[str]]:
    """A row for each image, in the order of the folder."""
    for each in found:
        folder = root.resolve().name if each.dataset.name == "." else each.dataset.name
        for name in (file.name for file in each.dataset.files):
            record = each.cameras.get(name)
            if form is Form.IMC2025:
                scene, R, t = "outliers", *map(joined, (np.full(9, np.nan), np.full(3, np.nan)))
                if record is not None:
                    scene, R, t = f"cluster{record.model}", joined(record.camera.R), joined(record.camera.t)
                yield f"{folder}_{name}", folder, scene, name, R, t
            else:
                parts = folder.split("/")  # dataset/scene/images, of 2024 dataset/images
                scene = parts[1] if len(parts) > 2 else parts[0]
                is_placed = record is not None and record.model == 0
                camera = record.camera if record and is_placed else Camera(np.eye(3), np.eye(3), np.zeros(3))
                yield f"{folder}/{name}", parts[0], scene, joined(camera.R), joined(camera.t)


def joined(numbers: NDArray[np.float64]) -> str:
    return ";".join(f"{value:.12g}" for value in numbers.ravel())
