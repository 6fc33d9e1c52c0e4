"""EXIF of a photograph: how its stored pixels lie, and the focal length by COLMAP's rule.

Sources: CIPA DC-008 (Exif), TIFF 6.0, and ``Bitmap::ExifFocalLength`` of COLMAP 4.2, without its table of sensors.
"""

import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from math import hypot, inf

from mkpc_kaggle.config import Range
from mkpc_kaggle.geometry.coordinates import Size

ORIENTATION, DIRECTORY, FOCAL_MM = 0x0112, 0x8769, 0x920A  # tags
PLANE_RESOLUTION, PLANE_UNIT, FOCAL_35MM = 0xA20E, 0xA210, 0xA405
TAGS = (ORIENTATION, DIRECTORY, FOCAL_MM, PLANE_RESOLUTION, PLANE_UNIT, FOCAL_35MM)
NUMBERS = {3: "H", 4: "I"}  # types that stand in an entry itself
RATIONAL = 5
FILM_MM = 43.27  # diagonal of 35 mm film
UNITS_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
FOCALS = Range(0.2, 20.0)  # long sides of an image; a focal length beyond is taken for a mistake

# By orientation, the quarter turns, counter-clockwise, that set stored pixels upright; mirrored pixels stay so.
TURNS = {3: 2, 4: 2, 5: 3, 6: 3, 7: 1, 8: 1}


@dataclass(frozen=True)
class Exif:
    """The default is that of a file without EXIF."""

    turns: int = 0  # quarters, counter-clockwise, that set the stored pixels upright
    focal: float = 0.0  # in pixels; 0: unknown


def read_exif(data: memoryview, size: Size) -> Exif:
    """The EXIF of a JPEG or PNG file of an image of that size; never raises. What is damaged counts as missing."""
    tags: dict[int, float] = {}
    with suppress(struct.error):
        tiff = _tiff_part(data)
        order = {b"II": "<", b"MM": ">"}.get(bytes(tiff[:2]))
        if order is not None:
            tags.update(_entries(tiff, order, *struct.unpack_from(f"{order}I", tiff, 4)))
            tags.update(_entries(tiff, order, int(tags.get(DIRECTORY, len(tiff)))))
    focal = tags.get(FOCAL_35MM, 0.0) / FILM_MM * hypot(*size)
    if not focal:
        unit = UNITS_MM.get(int(tags.get(PLANE_UNIT, 0)), inf)
        focal = tags.get(FOCAL_MM, 0.0) * tags.get(PLANE_RESOLUTION, 0.0) / unit
    return Exif(TURNS.get(int(tags.get(ORIENTATION, 1)), 0), focal if focal / max(size) in FOCALS else 0.0)


def _tiff_part(data: memoryview) -> memoryview:
    """The part of a file that has the tags, empty if there is none."""
    if bytes(data[:8]) == b"\x89PNG\r\n\x1a\n":
        start = 8
        while start < len(data):  # length, name, content, checksum
            length, name = struct.unpack_from(">I4s", data, start)
            if name == b"eXIf":
                return data[start + 8 : start + 8 + length]
            start += 12 + length
    elif bytes(data[:2]) == b"\xff\xd8":
        start = 2
        while bytes(data[start : start + 1]) == b"\xff":  # marker, length, content; no picture comes before it
            marker, length = struct.unpack_from(">HH", data, start)
            if marker == 0xFFE1 and bytes(data[start + 4 : start + 10]) == b"Exif\0\0":
                return data[start + 10 : start + 2 + length]
            start += 2 + length
    return data[:0]


def _entries(tiff: memoryview, order: str, start: int) -> Iterator[tuple[int, float]]:
    """The tags of a directory that are wanted, with their numbers."""
    (count,) = struct.unpack_from(f"{order}H", tiff, start)
    for place in range(start + 2, start + 2 + 12 * count, 12):
        tag, kind = struct.unpack_from(f"{order}HH", tiff, place)
        if tag in TAGS and kind in NUMBERS:
            (number,) = struct.unpack_from(order + NUMBERS[kind], tiff, place + 8)
            yield tag, number
        elif tag in TAGS and kind == RATIONAL:
            (offset,) = struct.unpack_from(f"{order}I", tiff, place + 8)
            above, below = struct.unpack_from(f"{order}II", tiff, offset)
            yield tag, above / below if below else 0.0
