"""The cameras of a finished model, for new photographs that are registered among them.

The parent process reads COLMAP's files itself, since pycolmap may end a process. Source: COLMAP's
description of its binary format.
"""

import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from mkpc_kaggle.data.images import read_size
from mkpc_kaggle.errors import UserError, plural
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.intrinsics import LENS_MODELS, PlacedCamera, Rows
from mkpc_kaggle.scene.whole_files import CAMERA, IMAGE, KEYPOINT_BYTES, MODEL_NAMES, RECORDS

CAMERAS = "cameras.bin"
IMAGES = "images.bin"
MIN_PLACED = 2  # images of the model in the folder; one has no points


class StoredCamera(NamedTuple):
    """A camera of COLMAP's without a pose, and the size of its images."""

    model: str
    parameters: tuple[float, ...]
    size: Size


def read_placed(folder: Path, root: Path, datasets: Mapping[str, Sequence[Path]]) -> Rows:
    """Return a row for each image of the only dataset that COLMAP's model in ``folder`` has.

    The model names images by their path below ``root`` or below the dataset. Raises
    :class:`UserError` for other files, for images of other sizes, and if fewer than two are found.
    """
    if len(datasets) != 1:
        raise UserError(
            f"--onto {folder} is for one dataset, and {root} has {len(datasets)}: name one of its "
            "folders, or add --join"
        )
    ((dataset, files),) = datasets.items()
    cameras = read_cameras(folder)
    rows = []
    for file in files:
        path = PurePosixPath(file.relative_to(root).as_posix())
        names = (str(path), str(path.relative_to(dataset)))
        found = next((cameras[name] for name in names if name in cameras), None)
        if found is not None:
            camera, size = found
            stored = read_size(file)  # an unreadable image is reported by the run
            if stored is not None and stored != size:
                raise UserError(
                    f"--onto {folder} has {path} with {size.width} x {size.height} pixels, and "
                    f"{file} has {stored.width} x {stored.height}"
                )
            rows.append((str(path), camera))
    if len(rows) < MIN_PLACED:
        first = min(cameras, default="")
        example = f", such as {first}" if first else ""
        raise UserError(
            f"--onto {folder}: {plural(len(rows), 'image')} of {root} of the model's "
            f"{plural(len(cameras), 'image')}{example}. The photographs of the model are needed, too, "
            "since new ones are matched with them"
        )
    return tuple(rows)


def placed_line(rows: Rows, folder: Path, files: Sequence[Path], root: Path) -> str:
    """Return a line on the images that keep the cameras of a model."""
    names = {name for name, _ in rows}
    new = [file for file in files if file.relative_to(root).as_posix() not in names]
    line = f"onto {folder}: {len(rows)} of {plural(len(files), 'image')} keep the model's cameras"
    return line + (f"; the first new one is {new[0].relative_to(root)}" if new else "; none is new")


def read_cameras(folder: Path) -> dict[str, tuple[PlacedCamera, Size]]:
    """Return the camera and the size of each image of COLMAP's binary model, by name.

    Raises :class:`UserError` for other files.
    """
    try:
        lenses = dict(_lenses((folder / CAMERAS).read_bytes()))
        return dict(_images((folder / IMAGES).read_bytes(), lenses))
    except OSError as error:
        raise UserError(
            f"--onto {folder}: {error.filename} cannot be read: {error.strerror}; name a folder with COLMAP's "
            "binary files, such as models/0 in the OUT of another run"
        ) from error
    except (struct.error, ValueError) as error:
        raise UserError(f"--onto {folder} is not a model of COLMAP: {error}") from error


def _lenses(data: bytes) -> Iterator[tuple[int, StoredCamera]]:
    """Yield each camera with its number."""
    (count,) = RECORDS.unpack_from(data)
    at = RECORDS.size
    for _ in range(count):
        number, model, width, height = CAMERA.unpack_from(data, at)
        if model not in MODEL_NAMES:
            raise ValueError(f"a camera has model {model}; known: {', '.join(LENS_MODELS)}")
        name = MODEL_NAMES[model]
        parameters = struct.Struct(f"<{len(LENS_MODELS[name])}d")
        yield (
            number,
            StoredCamera(name, parameters.unpack_from(data, at + CAMERA.size), Size(width, height)),
        )
        at += CAMERA.size + parameters.size


def _images(
    data: bytes, lenses: Mapping[int, StoredCamera]
) -> Iterator[tuple[str, tuple[PlacedCamera, Size]]]:
    """Yield each image's name, with its camera and its size."""
    (count,) = RECORDS.unpack_from(data)
    at = RECORDS.size
    for _ in range(count):
        _, w, x, y, z, *t, camera = IMAGE.unpack_from(data, at)
        at += IMAGE.size
        end = data.index(b"\0", at)
        name = data[at:end].decode("utf-8")
        (points,) = RECORDS.unpack_from(data, end + 1)
        at = end + 1 + RECORDS.size + points * KEYPOINT_BYTES
        if camera not in lenses:
            raise ValueError(f"{name} has camera {camera}, which {CAMERAS} lacks")
        lens = lenses[camera]
        yield name, (PlacedCamera(lens.model, lens.parameters, pose=(x, y, z, w, *t)), lens.size)
