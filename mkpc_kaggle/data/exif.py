"""EXIF of a photograph: the orientation of its stored pixels, and the focal length by COLMAP's rule.

Source: ``Bitmap::ExifFocalLength`` of COLMAP 4.2, without its table of sensors.
"""

import warnings
from contextlib import suppress
from io import BytesIO
from math import hypot, inf
from numbers import Real

import PIL.Image

from mkpc_kaggle.config import Range
from mkpc_kaggle.geometry.coordinates import Size

ORIENTATION, DIRECTORY, FOCAL_MM = 0x0112, 0x8769, 0x920A  # tags
PLANE_RESOLUTION, PLANE_UNIT, FOCAL_35MM = 0xA20E, 0xA210, 0xA405
FILM_MM = 43.27  # diagonal of 35 mm film
UNITS_MM: dict[float, float] = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
FOCALS = Range(0.2, 20.0)  # long sides of an image; a focal length outside this range counts as a mistake

# Counter-clockwise quarter turns that set stored pixels upright, by orientation; mirrored pixels stay mirrored.
TURNS: dict[float, int] = {3: 2, 4: 2, 5: 3, 6: 3, 7: 1, 8: 1}


def read_exif(data: bytes, size: Size) -> tuple[int, float]:
    """Return the quarter turns, counter-clockwise, that set an image upright, and its focal length in pixels.

    ``data`` is the file of an image of ``size``. Both numbers are 0 if unknown; damaged EXIF counts as missing.
    """
    tags: dict[int, float] = {}
    with suppress(Exception), warnings.catch_warnings():  # Pillow raises errors of any type for a damaged file
        warnings.filterwarnings("ignore", module="PIL")
        tags = _numbers(data)
    unit = UNITS_MM.get(tags.get(PLANE_UNIT, 0), inf)
    focal = tags.get(FOCAL_35MM, 0.0) / FILM_MM * hypot(*size)
    focal = focal or tags.get(FOCAL_MM, 0.0) * tags.get(PLANE_RESOLUTION, 0.0) / unit
    return TURNS.get(tags.get(ORIENTATION, 1), 0), focal if focal / max(size) in FOCALS else 0.0


def _numbers(data: bytes) -> dict[int, float]:
    with PIL.Image.open(BytesIO(data), formats=("JPEG", "PNG", "WEBP")) as picture:  # OpenCV turns TIFF itself
        if picture.format == "PNG" and b"eXIf" not in data:
            return {}  # Pillow would decode all pixels, since EXIF may come after them
        exif = picture.getexif()
        tags = {**exif, **exif.get_ifd(DIRECTORY)}
        return {tag: float(value) for tag, value in tags.items() if isinstance(value, Real)}
