"""Whether COLMAP's files are whole, by the counts in them.

pycolmap reports neither a full disk while it writes a model, nor the end of a file that is cut off. The files are
read without it, since it may end the process. Sources: COLMAP's and SQLite's descriptions of their formats.
"""

import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TypeAlias

from mkpc_kaggle.geometry.intrinsics import LENS_MODELS

RECORDS = struct.Struct("<Q")  # the number of records that follow
CAMERA = struct.Struct("<IiQQ")  # id, model, width, height
IMAGE = struct.Struct("<I7dI")  # id, quaternion (w, x, y, z), t, id of the camera
KEYPOINT_BYTES = 24  # x, y, and the point that it sees
POINT = struct.Struct("<Q3d3Bd")  # id, x, y, z, colour, error
OBSERVATION_BYTES = 8  # an image, and its keypoint
# Each of our rigs has one camera, and each of our frames one image.
RIG_BYTES = 16
FRAME_BYTES = 84
# By COLMAP's numbers; those between them are no perspective lenses.
MODEL_NAMES = dict(zip((0, 1, 2, 3, 4, 6), LENS_MODELS, strict=True))
# Of SQLite's header: the size of a page, and the number of pages
PAGE_SIZE = struct.Struct(">16xH")
PAGE_COUNT = struct.Struct(">28xI")
HEADER_BYTES = 100
LARGEST_PAGE = 65_536  # does not fit its field, which is 1 then

RecordEnd: TypeAlias = Callable[[bytes, int], int]  # of the record that begins at an offset


def is_whole_database(path: Path) -> bool:
    """Return whether a database exists and has all of its pages."""
    try:
        with path.open("rb") as stream:
            header = stream.read(HEADER_BYTES)
        page = _number(PAGE_SIZE, header)
        size = _number(PAGE_COUNT, header) * (LARGEST_PAGE if page == 1 else page)
        # A program that was killed may leave more pages.
        return 0 < size <= path.stat().st_size
    except (OSError, struct.error):
        return False


def is_whole_model_file(path: Path) -> bool:
    """Return whether a file of a model, with its usual name, exists and ends where its counts say."""
    try:
        data = path.read_bytes()
        record_end = RECORD_ENDS[path.name]
        end = RECORDS.size
        for _ in range(_number(RECORDS, data)):
            # A damaged count may be astronomical.
            if end >= len(data):
                return False
            end = record_end(data, end)
    except (OSError, struct.error, ValueError, KeyError):
        return False
    return end == len(data)


def _number(form: struct.Struct, data: bytes, start: int = 0) -> int:
    """Return the only number of a structure."""
    return int(form.unpack_from(data, start)[0])


def _camera_end(data: bytes, start: int) -> int:
    _, model, _, _ = CAMERA.unpack_from(data, start)
    parameters = len(LENS_MODELS[MODEL_NAMES[model]])
    return start + CAMERA.size + 8 * parameters


def _image_end(data: bytes, start: int) -> int:
    name_end = data.index(b"\0", start + IMAGE.size) + 1
    return name_end + RECORDS.size + _number(RECORDS, data, name_end) * KEYPOINT_BYTES


def _point_end(data: bytes, start: int) -> int:
    track_start = start + POINT.size
    return track_start + RECORDS.size + _number(RECORDS, data, track_start) * OBSERVATION_BYTES


RECORD_ENDS: Mapping[str, RecordEnd] = MappingProxyType(
    {
        "cameras.bin": _camera_end,
        "frames.bin": lambda _, start: start + FRAME_BYTES,
        "images.bin": _image_end,
        "points3D.bin": _point_end,
        "rigs.bin": lambda _, start: start + RIG_BYTES,
    }
)
