"""Tables of cameras: ``cameras.csv``, and submissions to the Image Matching Challenges of 2023 to
2025.
"""

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.outputs import replacing
from mkpc_kaggle.engine.console import logger
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.intrinsics import KnownCamera
from mkpc_kaggle.reconstruction.folder import Datasets


@dataclass(frozen=True, eq=False)
class PlacedImage:
    """The camera of an image file, and the number of its model: a row of ``cameras.csv``.

    ``content`` is the digest of the file, or empty for a row of an earlier run.
    """

    model: int
    camera: Camera
    points: int = 0  # that the image sees
    lens: KnownCamera | None = None
    content: str = ""


# By dataset and file; None without a camera.
Cameras = Mapping[str, Mapping[Path, PlacedImage | None]]

NO_POSE = ";".join(["nan"] * 9), "nan;nan;nan"
ORIGIN = "1;0;0;0;1;0;0;0;1", "0;0;0"
CAMERA_HEADS = (
    "image",
    "model",
    "K",
    "R",
    "t",
    "points",
    *("camera_model", "parameters"),
)
SUBMISSION_FORMATS = (
    "imc2025",  # a cluster for each model; an image without a camera is an outlier, its pose nan
    "imc2023",  # also for 2024: the cameras of the largest model; other images are at the origin
)


def write_tables(out: Path, cameras: Cameras, root: Path, form: str | None) -> None:
    """Write ``cameras.csv``, and ``submission.csv`` if a form is given. Raise ``OSError`` if that
    fails.
    """
    tables = {"cameras.csv": camera_rows(cameras, root)}
    if form is not None:
        tables["submission.csv"] = submission_rows(form, cameras, root)
    for name, rows in tables.items():
        with replacing(out / name) as stream:
            csv.writer(stream, lineterminator="\n").writerows(rows)


def camera_rows(cameras: Cameras, root: Path) -> Iterator[Sequence[str]]:
    """Yield a header, and a row per image with a camera: path below ``root``, model, K, R, t,
    number of points, COLMAP's camera model and its parameters.

    The centre of an image's first pixel is (0, 0); X_cam = R X + t. In COLMAP's parameters it is
    (0.5, 0.5).
    """
    yield CAMERA_HEADS
    for files in cameras.values():
        for file, placed in files.items():
            if placed is None:
                continue
            camera = placed.camera
            # As in a table of --intrinsics, which takes them
            lens = placed.lens
            parameters = (
                "" if lens is None else " ".join(f"{value:.12g}" for value in lens.parameters)
            )
            yield (
                file.relative_to(root).as_posix(),
                str(placed.model),
                joined(camera.K),
                joined(camera.R),
                joined(camera.t),
                str(placed.points),
                "" if lens is None else lens.model,
                parameters,
            )


def read_table_of_cameras(path: Path, root: Path, datasets: Datasets) -> Cameras:
    """Return the cameras that an earlier run wrote to ``cameras.csv``, of the files that exist now.

    Without the file, no image has one. A file that is not a table of cameras is warned of.
    """
    placed: dict[str, PlacedImage] = {}
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            heads, *rows = csv.reader(stream)
        if tuple(heads) != CAMERA_HEADS:
            raise ValueError("it has other columns")
        # Editors leave blank lines.
        placed = {row[0]: _placed(row) for row in rows if row}
    except FileNotFoundError:
        pass
    except (OSError, ValueError, csv.Error) as error:
        logger.warning(f"{path}: its cameras will be replaced, they cannot be read: {error}")
    return {
        name: {file: placed.get(file.relative_to(root).as_posix()) for file in files}
        for name, files in datasets.items()
    }


def _placed(row: Sequence[str]) -> PlacedImage:
    """Invert a row of :func:`camera_rows`. Raise ``ValueError`` for any other row."""
    _, model, K, R, t, points, name, parameters = row
    numbers = [np.array(text.split(";"), float) for text in (K, R, t)]
    if not all(np.isfinite(values).all() for values in numbers):
        raise ValueError("a number is not finite")
    camera = Camera(numbers[0].reshape(3, 3), numbers[1].reshape(3, 3), numbers[2].reshape(3))
    lens = KnownCamera(name, tuple(map(float, parameters.split()))) if name else None
    return PlacedImage(int(model), camera, int(points), lens)


def submission_rows(form: str, cameras: Cameras, root: Path) -> Iterator[Sequence[str]]:
    """Yield a header, and a row for each image, in the folder's order. Append ``_`` to repeated ids
    and names.
    """
    of_2025 = form == "imc2025"
    heads = (
        ("image_id", "dataset", "scene", "image") if of_2025 else ("image_path", "dataset", "scene")
    )
    yield *heads, "rotation_matrix", "translation_vector"
    ids = set[str]()
    names = set(cameras) - {"."}
    for dataset, found in cameras.items():
        folder = _unused(root.resolve().name, names) if dataset == "." else dataset
        parts = folder.split("/")  # dataset/scene/images in 2023, dataset/images in 2024
        for file, placed in found.items():
            # The file's name, except in a dataset of several folders
            name = file.relative_to(root / dataset).as_posix()
            pose = (joined(placed.camera.R), joined(placed.camera.t)) if placed else NO_POSE
            if of_2025:
                number = _unused(f"{folder}_{name}", ids)
                cluster = f"cluster{placed.model}" if placed else "outliers"
                yield number, folder, cluster, name, *pose
            else:
                place = f"{folder}/{name}", parts[0], parts[1 if len(parts) > 2 else 0]
                yield *place, *(pose if placed and placed.model == 0 else ORIGIN)


def joined(numbers: NDArray[np.float64]) -> str:
    # Twelve digits: later ones are rounding.
    return ";".join(f"{value:.12g}" for value in numbers.ravel())


def _unused(name: str, used: set[str]) -> str:
    """Append ``_`` to the name until it is unused, add it to ``used``, and return it."""
    while name in used:
        name += "_"
    used.add(name)
    return name
