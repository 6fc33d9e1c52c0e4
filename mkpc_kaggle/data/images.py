"""Decoding images, in the background and once: an unreadable file is a value with a reason, not an exception."""

import hashlib
import os
import stat
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from mkpc_kaggle.data.cache import ByteCache
from mkpc_kaggle.geometry.coordinates import Pixels, Size

MOST_ASPECT = 32
"""Of the longer side to the shorter one. A picture beyond it is taken for damaged: views of it would be a few
pixels high, or would not fit into memory."""

Stamp = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Image:
    """A decoded picture: ``pixels`` is (H, W, 3) uint8 RGB; ``name`` is unique in a run.

    ``version`` tells the content of its file, see :func:`is_unchanged`; empty where there is none.
    """

    name: str
    pixels: Pixels
    version: str = ""

    @classmethod
    def of_array(cls, array: Pixels) -> "Image":
        """From (H, W, 3) RGB or (H, W) gray uint8, named by its content; ``ValueError`` for anything else."""
        if (
            array.dtype != np.uint8
            or array.ndim not in (2, 3)
            or array.shape[2:] not in ((), (3,))
            or not array.size
        ):
            raise ValueError(f"an image is uint8 (H, W) or (H, W, 3), not {array.dtype} {array.shape}")
        pixels = np.ascontiguousarray(np.stack([array] * 3, axis=2) if array.ndim == 2 else array)
        return cls(f"{hashlib.blake2b(pixels.tobytes()).hexdigest()[:32]} {pixels.shape}", pixels)

    @property
    def size(self) -> Size:
        height, width = self.pixels.shape[:2]
        return Size(width, height)

    @cached_property
    def gray(self) -> Pixels:
        """(H, W) uint8."""
        return np.asarray(cv2.cvtColor(self.pixels, cv2.COLOR_RGB2GRAY), np.uint8)


@dataclass(frozen=True)
class Unreadable:
    """An image that could not be decoded, and why."""

    name: str
    reason: str

    def __str__(self) -> str:
        return f"{printable(self.name)}: {self.reason}"


def read_image(path: Path) -> Image | Unreadable:
    """Decode one file (png, jpg; 8 or 16 bit; gray, colour, with alpha) to 8-bit RGB; never raises.

    16-bit values are divided by 256, alpha is dropped, an EXIF orientation is applied. OpenCV decides whether
    a damaged file is readable: version 5 refuses a truncated one.
    """
    name = str(path)
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):  # a pipe or a device may never end
            return Unreadable(name, "cannot be read: not a regular file")
        data = np.fromfile(path, np.uint8)
    except FileNotFoundError:
        return Unreadable(name, "no such file")
    except (OSError, ValueError, MemoryError) as error:
        return Unreadable(name, f"cannot be read: {error}")
    return decode_image(name, data, stamp_of(status))


def decode_image(name: str, data: Pixels, stamp: Stamp = ()) -> Image | Unreadable:
    """Decode the (N,) uint8 bytes of a file, as :func:`read_image` does; never raises.

    ``stamp`` is what the file had before it was read.
    """
    if data.size == 0:
        return Unreadable(name, "the file is empty")
    try:
        bgr = cv2.imdecode(data, cv2.IMREAD_COLOR)
    except (cv2.error, MemoryError) as error:
        return Unreadable(name, f"cannot be decoded: {error}")
    if bgr is None:
        return Unreadable(name, "not a picture, or cut off: it cannot be decoded")
    height, width = bgr.shape[:2]
    if max(height, width) > MOST_ASPECT * min(height, width):
        return Unreadable(name, f"{width} x {height} pixels: one side is more than {MOST_ASPECT} times the other")
    version = " ".join(map(str, (digest_of(data), *stamp)))
    return Image(name, np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8), version)


def is_unchanged(path: Path, version: str) -> bool:
    """Whether a file still has the content that it had when an image of that ``version`` was read from it.

    A file whose size and times are the same is not read. One that cannot be read any more has no other content.
    """
    digest, *stamp = version.split()
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode) or list(map(str, stamp_of(status))) == stamp:
            return True
        return digest_of(np.fromfile(path, np.uint8)) == digest
    except (OSError, ValueError):
        return True


def stamp_of(status: os.stat_result) -> Stamp:
    """Size in bytes and times of change in nanoseconds: a file's content does not change without them."""
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns


def digest_of(data: Pixels) -> str:
    return hashlib.blake2b(data.data, digest_size=16).hexdigest()


def printable(text: str) -> str:
    """``text`` in UTF-8's alphabet: paths may hold bytes that are none of it."""
    return text.encode("utf-8", "backslashreplace").decode()


class ImageStore:
    """Images by path, decoded in the background by :meth:`prefetch`; the most recently used are kept.

    ``read`` replaces :func:`read_image`; it never raises.
    """

    read: Callable[[Path], Image | Unreadable] = staticmethod(read_image)

    def __init__(
        self,
        limit_bytes: int = 512 << 20,
        threads: int = 1,
        read: Callable[[Path], Image | Unreadable] | None = None,
    ) -> None:
        if read is not None:
            self.read = read
        self._images: ByteCache[Path, Image] = ByteCache(limit_bytes)
        self._pending: dict[Path, Future[Image | Unreadable]] = {}
        self._lock = threading.Lock()
        self._decoders = ThreadPoolExecutor(threads, thread_name_prefix="decode")

    def prefetch(self, paths: Iterable[Path]) -> None:
        """Start decoding the images that are neither cached nor being decoded."""
        for path in paths:
            with self._lock:
                if path not in self._pending and self._images.get(path) is None:
                    self._pending[path] = self._decoders.submit(self.read, path)

    def get(self, path: Path) -> Image | Unreadable:
        """The image; waits until it is decoded."""
        with self._lock:
            known = self._images.get(path)
            if known is not None:
                return known
            pending = self._pending.get(path) or self._decoders.submit(self.read, path)
            self._pending[path] = pending
        image = pending.result()
        with self._lock:
            if isinstance(image, Image):
                self._images.put(path, image, image.pixels.nbytes)
            if self._pending.get(path) is pending:
                del self._pending[path]
        return image

    def close(self) -> None:
        self._decoders.shutdown(wait=False, cancel_futures=True)
