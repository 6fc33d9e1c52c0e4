"""Images: decoded once, in the background; an unreadable file is a value with the reason.

Pillow reads size, EXIF and stored pixels. EXIF gives the orientation of the pixels, and the focal length as
COLMAP computes it. Source: ``Bitmap::ExifFocalLength`` of COLMAP 4.2, without COLMAP's table of sensors, and
scaled to the stored pixels if the photograph was reduced after it was taken.
"""

import hashlib
import warnings
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from io import BytesIO
from math import hypot, inf
from numbers import Real
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
import PIL.Image

from mkpc_kaggle.config import Range
from mkpc_kaggle.errors import open_regular, shown
from mkpc_kaggle.geometry.coordinates import Pixels, Size

# Pillow's names of the formats that are read. Its readers of others may start programs.
FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "AVIF", "JPEG2000", "PPM")
# Files that are read as photographs, by suffix; the first three also stand for the competitions'
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
MORE_SUFFIXES = (
    ".jpe",
    ".jfif",
    ".webp",
    ".tif",
    ".tiff",
    ".bmp",
    ".ppm",
    ".pgm",
    ".pnm",
    ".jp2",
    ".avif",
)
READ_SUFFIXES = IMAGE_SUFFIXES + MORE_SUFFIXES

BLAKE2 = partial(hashlib.blake2b, digest_size=16)
# Ratio of the sides; a longer image's views would be a few pixels high or exceed the memory.
MAX_ASPECT = 32

# Tags of EXIF and TIFF
ORIENTATION = 0x0112
EXIF_DIRECTORY = 0x8769  # of the tags that only EXIF has
TIFF_SIDES = 0x0100, 0x0101
FOCAL_MM = 0x920A
PLANE_RESOLUTION = 0xA20E  # pixels per unit of the sensor
PLANE_UNIT = 0xA210
RECORDED_SIDES = 0xA002, 0xA003  # width and height in pixels when the photograph was taken
FOCAL_35MM = 0xA405
FILM_MM = 43.27  # diagonal of 35 mm film
# Inch, cm, mm, micrometre
UNITS_MM: dict[float, float] = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
# In long sides of the image; a focal length outside this range counts as unknown.
EXIF_FOCALS = Range(0.2, 20.0)
# Ratio of the shapes of a stored and a recorded picture; more is a crop, and not rounding.
MAX_SHAPE_RATIO = 1.03
# Counter-clockwise quarter turns that set pixels upright, by EXIF orientation; mirrored pixels stay
# mirrored.
TURNS: dict[float, int] = {3: 2, 4: 2, 5: 3, 6: 3, 7: 1, 8: 1}


@dataclass(frozen=True, eq=False)
class Image:
    """An image as stored in its file; ``turns`` rotates its views upright."""

    name: str  # unique in a run
    pixels: Pixels  # (H, W, 3) uint8 RGB
    version: str = ""  # :func:`content_digest` of its file
    focal: float = 0.0  # in pixels, from EXIF; 0: unknown
    turns: int = 0  # counter-clockwise quarter turns, from EXIF

    @classmethod
    def of_array(cls, array: Pixels) -> "Image":
        """Wrap a uint8 array (H, W, 3) RGB or (H, W) gray, named by its digest.

        Raises ``ValueError`` for any other array.
        """
        has_shape = array.ndim >= 2 and array.shape[2:] in ((), (3,))
        if array.dtype != np.uint8 or not has_shape or not array.size:
            raise ValueError(
                f"an image is uint8 (H, W) or (H, W, 3), not {array.dtype} {array.shape}"
            )
        if array.ndim == 2:
            array = np.stack([array] * 3, axis=2)
        pixels = np.ascontiguousarray(array)
        # Two arrays of other shapes may have the same bytes.
        return cls(f"{BLAKE2(pixels.data).hexdigest()} {pixels.shape}", pixels)

    @property
    def size(self) -> Size:
        return Size(self.pixels.shape[1], self.pixels.shape[0])

    @property
    def nbytes(self) -> int:
        """The memory of its pixels and of its gray values, in bytes."""
        return self.pixels.nbytes + self.pixels[..., 0].size

    @cached_property
    def gray(self) -> Pixels:
        """Gray values, (H, W) uint8."""
        return np.asarray(cv2.cvtColor(self.pixels, cv2.COLOR_RGB2GRAY), np.uint8)

    def turned(self, turns: int) -> "Image":
        """Return the image with its views rotated by further counter-clockwise quarter turns."""
        return replace(self, turns=(self.turns + turns) % 4) if turns else self


@dataclass(frozen=True)
class Unreadable:
    """An image that cannot be decoded, and the reason."""

    name: str
    reason: str

    def __str__(self) -> str:
        return f"{shown(self.name)}: {self.reason}"

    def turned(self, _: int) -> "Unreadable":
        return self


def file_state(path: Path) -> tuple[int, int]:
    """Return the size of a file in bytes and its time of change in nanoseconds; zeros if it is
    missing.
    """
    try:
        status = path.stat()
    except (OSError, ValueError):
        return 0, 0
    return status.st_size, status.st_mtime_ns


def read_image(path: Path) -> Image | Unreadable:
    """Decode a file's stored pixels to RGB; return failures, never raise.

    Of 16 bits, the upper eight count. A file that is cut off is unreadable.
    """
    name = str(path)
    try:
        with open_regular(path) as stream:
            data = stream.read()
        with open_picture(BytesIO(data)) as picture:
            size = stored_size(picture)
            if max(size) > MAX_ASPECT * min(size):
                sides = f"{size.width} x {size.height} pixels"
                return Unreadable(
                    name, f"{sides}: one side is more than {MAX_ASPECT} times the other"
                )
            tags = exif_tags(picture)
            pixels = rgb_pixels(picture)
            if picture.format == "TIFF":
                pixels = _stored(pixels, int(tags.get(ORIENTATION, 1)))
    except FileNotFoundError:
        return Unreadable(name, "no such file")
    except PIL.UnidentifiedImageError:
        return Unreadable(name, _unknown(data))
    except Exception as error:  # a reader may raise anything for a damaged file
        return Unreadable(
            name, f"cannot be read: {getattr(error, 'strerror', None) or error}"
        )
    turns, focal = exif_facts(tags, size)
    return Image(name, pixels, BLAKE2(data).hexdigest(), focal, turns)


@contextmanager
def open_picture(stream: BinaryIO) -> Iterator[PIL.Image.Image]:
    """Yield Pillow's picture of a stream, which is not decoded yet."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of damaged EXIF, and of many pixels
        with PIL.Image.open(stream, formats=FORMATS) as picture:
            yield picture


def _unknown(data: bytes) -> str:
    """Return why no reader takes the bytes of a file."""
    if not data:
        return "the file is empty"
    if data[:4] in (b"II*\0", b"MM\0*"):
        return (
            "a TIFF file of another kind than 1, 3 or 4 channels of 8 or 16 bits; convert it"
        )
    return "not a picture of a known format; convert it to JPEG or PNG"


def stored_size(picture: PIL.Image.Image) -> Size:
    """Return the size of a picture's stored pixels. Pillow gives the upright size of TIFF."""
    tags = getattr(picture, "tag_v2", {})
    width, height = (int(tags.get(tag, 0)) for tag in TIFF_SIDES)
    return Size(width, height) if width and height else Size(*picture.size)


def rgb_pixels(picture: PIL.Image.Image) -> Pixels:
    """Return a picture's pixels (H, W, 3) uint8 RGB, without transparency.

    Raises ``ValueError`` for values of more than 16 bits.
    """
    if picture.mode.startswith(("I", "F")):
        values = np.asarray(picture)
        if picture.mode == "F" or values.min() < 0 or values.max() > 0xFFFF:
            raise ValueError(
                "values of more than 16 bits; save it with 8 or 16 bits per value"
            )
        gray = (values.astype(np.uint16) >> 8).astype(np.uint8)
        return np.stack([gray] * 3, axis=2)
    return np.asarray(picture if picture.mode == "RGB" else picture.convert("RGB"))


def _stored(pixels: Pixels, orientation: int) -> Pixels:
    """Return the stored pixels of a TIFF file, which Pillow sets upright when it decodes them."""
    if orientation in (2, 4, 5, 7):
        # Mirrored: 2 and no more; 4, 5 and 7 are also turned, like 3, 8 and 6.
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(np.rot90(pixels, -TURNS.get(orientation, 0)))


def exif_tags(picture: PIL.Image.Image) -> dict[int, float]:
    """Return the numbers among the EXIF tags of a picture, by tag; empty if damaged."""
    tags = {}
    try:
        exif = picture.getexif()
        for tag, value in {**exif, **exif.get_ifd(EXIF_DIRECTORY)}.items():
            if isinstance(value, Real):
                tags[tag] = float(value)
    except Exception:  # Pillow raises many kinds of errors for damaged EXIF
        return {}
    return tags


def exif_facts(tags: Mapping[int, float], size: Size) -> tuple[int, float]:
    """Return the counter-clockwise quarter turns that set an image of ``size`` upright, and its focal
    length in pixels. Both are 0 if unknown.
    """
    turns = TURNS.get(tags.get(ORIENTATION, 1), 0)
    # In COLMAP's order: the equivalent focal length first, then the sensor's resolution. An unknown
    # unit is infinite, which gives 0.
    focal = tags.get(FOCAL_35MM, 0.0) / FILM_MM * hypot(*size)
    if not focal:
        unit = UNITS_MM.get(tags.get(PLANE_UNIT, 0), inf)
        focal = tags.get(FOCAL_MM, 0.0) * tags.get(PLANE_RESOLUTION, 0.0) / unit
        focal *= scale_since_taken(tags, size)
    return turns, focal if focal / max(size) in EXIF_FOCALS else 0.0


def scale_since_taken(tags: Mapping[int, float], size: Size) -> float:
    """Return the stored pixels per pixel of the recorded photograph; 0 for a crop of it.

    The sensor's resolution in EXIF counts recorded pixels, and programs that reduce a photograph
    keep its EXIF. 1 if the recorded size is unknown.
    """
    sides = [tags.get(tag, 0.0) for tag in RECORDED_SIDES]
    recorded = [side for side in sides if 0 < side < inf]
    if not recorded:
        return 1.0
    # Longer side with longer side: pixels may have been rotated without their EXIF.
    scale = max(size) / max(recorded)
    if len(recorded) == len(sides):
        shape_ratio = min(size) / (scale * min(recorded))
        # How much of the photograph a crop shows is unknown, and so is its scale.
        if not 1 / MAX_SHAPE_RATIO < shape_ratio < MAX_SHAPE_RATIO:
            return 0.0
    return scale


def read_size(path: Path) -> Size | None:
    """Return a picture's size in stored pixels, without decoding it; ``None`` if it is unreadable."""
    try:
        with open_regular(path) as stream, open_picture(stream) as picture:
            return stored_size(picture)
    except Exception:
        return None


def content_digest(path: Path) -> str:
    """Return the digest of a file. Raise ``OSError`` if it cannot be read."""
    with open_regular(path) as stream:
        return hashlib.file_digest(stream, BLAKE2).hexdigest()


def image_facts(path: Path) -> tuple[str, Size, float] | Unreadable:
    """Return digest, size and focal length of an image file, decoded only if its head cannot be read."""
    try:
        with open_regular(path) as stream, open_picture(stream) as picture:
            size = stored_size(picture)
            _, focal = exif_facts(exif_tags(picture), size)
        return content_digest(path), size, focal
    except Exception:  # any error of Pillow: the decoder says what is wrong
        image = read_image(path)
    return (image.version, image.size, image.focal) if isinstance(image, Image) else image


class ByteCache:
    """Cache of the most recently used values, up to ``limit`` bytes. Not thread-safe."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.bytes = 0
        # The least recently used comes first.
        self._entries: OrderedDict[Any, tuple[Any, int]] = OrderedDict()

    def get(self, key: Any) -> Any:
        """Return the value of a key, or ``None``."""
        if key in self._entries:
            self._entries.move_to_end(key)
        return self._entries.get(key, (None,))[0]

    def put(self, key: Any, value: Any, size: int) -> None:
        """Add or replace a value of ``size`` bytes; one larger than the limit is not kept."""
        self.bytes -= self._entries.pop(key, (value, 0))[1]
        if size <= self.limit:
            self._entries[key] = value, size
            self.bytes += size
        while self.bytes > self.limit:
            self.bytes -= self._entries.popitem(last=False)[1][1]


class ImageStore:
    """Images by path, decoded in the background; the most recently used are cached.

    Files are not expected to change. Besides the cache, only the images of the latest
    :meth:`prefetch` wait, and the one that is being decoded. Not thread-safe.
    """

    def __init__(self, limit_bytes: int = 512 << 20) -> None:
        self._images = ByteCache(limit_bytes)
        self._pending: dict[Path, Future[Image | Unreadable]] = {}
        self._decoder = ThreadPoolExecutor(1, thread_name_prefix="decode")

    def prefetch(self, paths: Iterable[Path]) -> None:
        """Start decoding the images that are neither cached nor being decoded.

        Images of former calls that nobody asked for are cached, or not decoded at all: with several
        workers, another one may have got their pairs.
        """
        wanted = dict.fromkeys(paths)
        for path in self._pending.keys() - wanted:
            future = self._pending[path]
            if future.cancel():
                del self._pending[path]
            # The image that is being decoded waits for the next call.
            elif future.done():
                del self._pending[path]
                self._keep(path, future.result())
        for path in wanted:
            self._start(path)

    def get(self, path: Path) -> Image | Unreadable:
        """Wait until the image is decoded, then return it."""
        image: Image | Unreadable | None = self._images.get(path)
        if image is None:
            self._start(path)
            image = self._pending.pop(path).result()
            self._keep(path, image)
        return image

    def _start(self, path: Path) -> None:
        if path not in self._pending and self._images.get(path) is None:
            self._pending[path] = self._decoder.submit(read_image, path)

    def _keep(self, path: Path, image: Image | Unreadable) -> None:
        if isinstance(image, Image):
            self._images.put(path, image, image.nbytes)

    def close(self) -> None:
        """Stop decoding: images that wait are dropped, and the one in work is not waited for."""
        self._decoder.shutdown(wait=False, cancel_futures=True)
