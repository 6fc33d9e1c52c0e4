"""Tables of cameras: ``cameras.csv``, and submissions to the Image Matching Challenges of 2023 to
2025.
"""

import csv
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.outputs import replacing
from mkpc_kaggle.scene.models import RegisteredImage

# By dataset and file: the number of the model and the camera in that model; None without a camera.
Cameras = Mapping[str, Mapping[Path, tuple[int, RegisteredImage] | None]]

NO_POSE = ";".join(["nan"] * 9), "nan;nan;nan"
ORIGIN = "1;0;0;0;1;0;0;0;1", "0;0;0"
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
    ``Sigmas``, COLMAP's camera model and its parameters.

    The centre of an image's first pixel is (0, 0); X_cam = R X + t. In COLMAP's parameters it is
    (0.5, 0.5). Unknown sigmas are empty cells.
    """
    sigma_names = ("rotation_sigma", "centre_sigma", "focal_sigma")
    yield "image", "model", "K", "R", "t", *sigma_names, "camera_model", "parameters"
    for files in cameras.values():
        for file, placed in files.items():
            if placed is None:
                continue
            model, image = placed
            camera = image.camera
            sigmas = [f"{value:g}" for value in image.sigmas] or [""] * 3
            # As in a table of --intrinsics, which takes them
            lens = image.lens
            parameters = (
                "" if lens is None else " ".join(f"{value:.12g}" for value in lens.parameters)
            )
            yield (
                file.relative_to(root).as_posix(),
                str(model),
                joined(camera.K),
                joined(camera.R),
                joined(camera.t),
                *sigmas,
                "" if lens is None else lens.model,
                parameters,
            )


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
            pose = (joined(placed[1].camera.R), joined(placed[1].camera.t)) if placed else NO_POSE
            if of_2025:
                number = _unused(f"{folder}_{name}", ids)
                yield number, folder, f"cluster{placed[0]}" if placed else "outliers", name, *pose
            else:
                place = f"{folder}/{name}", parts[0], parts[1 if len(parts) > 2 else 0]
                yield *place, *(pose if placed and placed[0] == 0 else ORIGIN)


def joined(numbers: NDArray[np.float64]) -> str:
    # Twelve digits: later ones are rounding.
    return ";".join(f"{value:.12g}" for value in numbers.ravel())


def _unused(name: str, used: set[str]) -> str:
    """Append ``_`` to the name until it is unused, add it to ``used``, and return it."""
    while name in used:
        name += "_"
    used.add(name)
    return name
