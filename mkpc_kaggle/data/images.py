"""Images: decoded once, in the background; an unreadable file is a value with the reason.

EXIF gives the orientation of the stored pixels, and the focal length as COLMAP computes it. Source:
``Bitmap::ExifFocalLength`` of COLMAP 4.2, without COLMAP's table of sensors, and scaled to the stored
pixels if the photograph was reduced after it was taken.
"""

import hashlib
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from math import hypot, inf
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mkpc_kaggle.config import Range
from mkpc_kaggle.data.heads import HEIC_BRANDS, ORIENTATION, exif_tags, is_tiff, size_of
from mkpc_kaggle.errors import shown
from mkpc_kaggle.geometry.coordinates import Pixels, Size

# Files that are read as photographs, by suffix; the first three also stand for the competitions'
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
MORE_SUFFIXES = (
    *(".jpe", ".jfif", ".webp", ".tif", ".tiff", ".bmp", ".ppm", ".pgm", ".pnm", ".jp2"),
    # OpenCV's wheels have a reader of AVIF since 2024.
    *((".avif",) if cv2.haveImageWriter("a.avif") else ()),
)
READ_SUFFIXES = IMAGE_SUFFIXES + MORE_SUFFIXES
# Photographs that nothing here decodes: of phones, of newer formats, and of sensors (raw)
OTHER_SUFFIXES = frozenset(
    (
        *(".heic", ".heif", ".hif", ".avif", ".jxl", ".jxr", ".exr", ".psd", ".gif", ".insp"),
        *(".dng", ".raw", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".sr2", ".srf", ".orf"),
        *(".rw2", ".raf", ".pef", ".srw", ".x3f", ".3fr", ".iiq", ".rwl", ".erf", ".mrw", ".kdc"),
        ".gpr",
    )
) - set(READ_SUFFIXES)

# Ratio of the sides; a longer image's views would be a few pixels high or exceed the memory.
MAX_ASPECT = 32

# Tags of EXIF.
FOCAL_MM = 0x920A
PLANE_RESOLUTION = 0xA20E  # pixels per unit of the sensor
PLANE_UNIT = 0xA210
EXIF_BYTES = 1 << 17  # of a file, which has its EXIF there; a segment of JPEG has up to 64 kB
RECORDED_SIDES = 0xA002, 0xA003  # width and height in pixels when the photograph was taken
FOCAL_35MM = 0xA405
FILM_MM = 43.27  # diagonal of 35 mm film
UNITS_MM: dict[float, float] = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # inch, cm, mm, micrometre
# Marks of JPEG, and bytes that change a picture if they are decoded
JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"
JPEG_SCAN = 0xDA
JPEG_FILL = b"\xaa" * 64
MAX_TRAILER_BYTES = 1 << 16  # after the end mark, such as a maker's notes
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
    # Size in bytes and time of change in nanoseconds of its file before it was read; 0: not noted
    file: tuple[int, int] = (0, 0)

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
        return cls(f"{_content_digest(pixels)} {pixels.shape}", pixels)

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

    16-bit values are divided by 256. OpenCV decides whether a damaged file is readable: version 5
    refuses a truncated file, and so do all versions if it is a JPEG. In a JPEG file,
    only the end mark may be missing.
    """
    name = str(path)
    bgr = None
    # Before it is read, so that a later change is never missed.
    file = file_state(path)
    try:
        if path.exists() and not path.is_file():  # a pipe or a device may never end
            return Unreadable(name, "cannot be read: not a regular file")
        data = np.fromfile(path, np.uint8)
        if data.size:  # OpenCV raises for an empty array
            bgr = decode(data)
    except FileNotFoundError:
        return Unreadable(name, "no such file")
    except (OSError, ValueError, MemoryError, cv2.error) as error:
        return Unreadable(name, f"cannot be read: {error}")
    if bgr is None:
        return Unreadable(name, _undecoded(path, data))
    height, width = bgr.shape[:2]
    if not has_usable_shape(Size(width, height)):
        return Unreadable(
            name, f"{width} x {height} pixels: one side is more than {MAX_ASPECT} times the other"
        )
    turns, focal = read_exif(data.tobytes(), Size(width, height))
    pixels = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
    return Image(name, pixels, _content_digest(data), focal, turns, file)


def _undecoded(path: Path, data: Pixels) -> str:
    """Return why OpenCV does not decode the bytes of a file."""
    if not data.size:
        return "the file is empty"
    # Photographs of phones are often HEIC under the name of a JPEG.
    head = data[:12].tobytes()
    if head[4:8] == b"ftyp" and head[8:12] in HEIC_BRANDS:
        return "a HEIC file, which cannot be decoded here; convert it to JPEG or PNG"
    if path.suffix.lower() in OTHER_SUFFIXES:
        return f"{path.suffix} files cannot be decoded here; convert it to JPEG or PNG"
    # A raw file is a TIFF file, too.
    if is_tiff(head):
        return (
            "a TIFF file of a kind that cannot be decoded here; save it with 8 or 16 bits per value"
        )
    return "not a picture, or cut off: it cannot be decoded"


def has_usable_shape(size: Size) -> bool:
    """Return whether no side is more than ``MAX_ASPECT`` times the other."""
    return max(size) <= MAX_ASPECT * min(size)


def decode(data: Pixels, kind: int = cv2.IMREAD_COLOR) -> Pixels | None:
    """Return the stored pixels of a picture file, (H, W, 3) BGR or as OpenCV's ``kind``; ``None``
    if it is unreadable.
    """
    pixels = _decode_file(data, kind)
    start = data[:4].tobytes()
    # OpenCV 5 refuses these files, and OpenCV 4 fills their missing part without a word.
    if start.startswith(JPEG_START) and not _has_end(data):
        # Some cameras and downloads leave the end mark out. If the picture is complete, further
        # bytes change nothing; if it is cut off, they are decoded.
        pixels, other = (_decode_file(_with_end(data, more), kind) for more in (b"", JPEG_FILL))
        if pixels is None or other is None or not np.array_equal(pixels, other):
            return None
    if pixels is not None and is_tiff(start):
        # OpenCV sets TIFF upright even if it is asked not to. COLMAP reads the stored pixels.
        orientation = int(exif_tags(data.tobytes()).get(ORIENTATION, 1))
        pixels = _stored(pixels, orientation)
    return pixels


def _decode_file(data: Pixels, kind: int) -> Pixels | None:
    # OpenCV's types do not say that the pixels are bytes, as IMREAD_COLOR makes them.
    pixels: Any = cv2.imdecode(data, kind | cv2.IMREAD_IGNORE_ORIENTATION)
    return pixels if pixels is None else np.asarray(pixels)


def _has_end(data: Pixels) -> bool:
    """Return whether a JPEG file has an end mark after its first scan."""
    scan = 2
    # Each segment before it has a length. A thumbnail in EXIF has an end mark of its own.
    while scan + 4 <= len(data) and data[scan] == JPEG_END[0] and data[scan + 1] != JPEG_SCAN:
        scan += 2 + int.from_bytes(data[scan + 2 : scan + 4].tobytes(), "big")
    # Cameras may write more after the end mark.
    return JPEG_END in data[max(scan, len(data) - MAX_TRAILER_BYTES) :].tobytes()


def _with_end(data: Pixels, more: bytes) -> Pixels:
    """Return the bytes of a JPEG file without its end, with ``more`` bytes and the end mark."""
    whole = data[:-1] if data[-1] == JPEG_END[0] else data  # the first half of the mark
    return np.concatenate([whole, np.frombuffer(more + JPEG_END, np.uint8)])


def _stored(pixels: Pixels, orientation: int) -> Pixels:
    """Return the stored pixels of a picture that was set upright from an EXIF orientation."""
    if orientation in (2, 4, 5, 7):
        # Mirrored: 2 and no more; 4, 5 and 7 are also turned, like 3, 8 and 6.
        pixels = pixels[:, ::-1]
    turns = -TURNS.get(orientation, 0)
    return np.ascontiguousarray(np.rot90(pixels, turns))


def read_exif(data: bytes, size: Size) -> tuple[int, float]:
    """Return the quarter turns that set an image upright, and its focal length in pixels.

    Turns are counter-clockwise. ``data`` has the file's bytes; ``size`` is in pixels. Both results
    are 0 if unknown. Damaged EXIF is ignored.
    """
    return exif_facts(exif_tags(data), size)


def exif_facts(tags: Mapping[int, float], size: Size) -> tuple[int, float]:
    """Return the turns and the focal length of :func:`read_exif` from EXIF's tags."""
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


def is_crop(path: Path, size: Size) -> bool:
    """Return whether EXIF at the head of a picture file states that it is a part of a photograph."""
    try:
        with path.open("rb") as stream:
            head = stream.read(EXIF_BYTES)
    except (OSError, ValueError):
        return False
    return not scale_since_taken(exif_tags(head), size)


def read_size(path: Path) -> Size | None:
    """Return a picture's size in stored pixels, from its head if possible; ``None`` if it is
    unreadable.
    """
    try:
        # A pipe or a device may never end.
        if not path.is_file():
            return None
        with path.open("rb") as stream:
            size = size_of(stream)
    except (OSError, ValueError):
        return None
    # A format without a head that Pillow reads, and a damaged head
    if size is None and isinstance(image := read_image(path), Image):
        return image.size
    return size


def content_digest(path: Path) -> str:
    """Return the digest of a file. Raise ``OSError`` or ``ValueError`` if it cannot be read."""
    if not path.is_file():
        raise FileNotFoundError(path)
    return _content_digest(np.fromfile(path, np.uint8))


def _content_digest(data: Pixels) -> str:
    return hashlib.blake2b(data.data, digest_size=16).hexdigest()


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
    """Images by path, decoded in the background; the most recently used are cached as long as their
    files do not change.

    Otherwise two workers might answer with the former and the new content of a file in turns, and each
    answer would drop the results of the other. Besides the cache, only the images of the latest
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
        image: Image | Unreadable | None = self._cached(path)
        if image is None:
            self._start(path)
            image = self._pending.pop(path).result()
            self._keep(path, image)
        return image

    def _start(self, path: Path) -> None:
        if path not in self._pending and self._cached(path) is None:
            self._pending[path] = self._decoder.submit(read_image, path)

    def _cached(self, path: Path) -> Image | None:
        image: Image | None = self._images.get(path)
        # A file that is missing now keeps its image.
        if image is not None and file_state(path) in (image.file, (0, 0)):
            return image
        return None

    def _keep(self, path: Path, image: Image | Unreadable) -> None:
        if isinstance(image, Image):
            self._images.put(path, image, image.nbytes)

    @property
    def nbytes(self) -> int:
        """The memory of the images that are cached, or decoded and waiting, in bytes."""
        waiting = [future.result() for future in self._pending.values() if future.done()]
        return self._images.bytes + sum(each.nbytes for each in waiting if isinstance(each, Image))

    def close(self) -> None:
        """Stop decoding: images that wait are dropped, and the one in work is not waited for."""
        self._decoder.shutdown(wait=False, cancel_futures=True)
