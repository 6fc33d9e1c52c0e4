"""Masks of images, as COLMAP reads them: ``DIR/a.jpg.png`` masks ``a.jpg``; black is left out."""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.images import ByteCache, read_size
from mkpc_kaggle.data.outputs import lies_in
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Points, Size

CACHE_BYTES = 128 << 20
SUFFIX = ".png"


@dataclass(frozen=True)
class Masks:
    """The mask file of each image, by the image's path, with the digest of its content."""

    files: Mapping[str, tuple[str, str]] = field(default_factory=dict)

    @classmethod
    def of_folder(cls, directory: Path, root: Path, images: Iterable[Path]) -> "Masks":
        """Return the masks below ``directory`` of images below ``root``.

        An image without a mask is used whole. Raises :class:`UserError` for a directory that is
        missing, has images of the run or no masks of these images. Raises it also for a mask that
        is unreadable or not as large as its image.
        """
        if not directory.is_dir():
            raise UserError(
                f"{directory}: no such directory; --masks names a directory with files such as a.jpg{SUFFIX}"
            )
        images = list(images)
        # Each folder once: resolving links takes long.
        if any(lies_in(folder, directory) for folder in {image.parent for image in images}):
            raise UserError(
                f"--masks {directory} has images of the run, so masks count as images; move it elsewhere"
            )
        files: dict[str, tuple[str, str]] = {}
        first = None
        for image in images:
            first = first or image
            path = directory / f"{image.relative_to(root).as_posix()}{SUFFIX}"
            if path.exists():  # as in COLMAP, an image without a mask is used whole
                _require_usable(path, image)
                digest = hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()
                files[str(image)] = (str(path), digest)
        if not files:
            name = first.relative_to(root).as_posix() if first else "a.jpg"
            expected = f"{name}{SUFFIX}"
            raise UserError(f"{directory} has no mask of any image: {expected} would be the first")
        return cls(files)

    def digest(self, image: str) -> str:
        """Return the digest of an image's mask; empty without a mask."""
        return self.files.get(image, ("", ""))[1]


def _require_usable(path: Path, image: Path) -> None:
    """Raise :class:`UserError` for a mask that is unreadable or not as large as its image."""
    if not path.is_file():
        raise UserError(f"{path} cannot be read: not a regular file")
    mask = read_mask(path)
    size = read_size(image)
    # An unreadable image is reported by the run.
    if size is not None and size != (mask.shape[1], mask.shape[0]):
        found = f"{mask.shape[1]} x {mask.shape[0]}"
        raise UserError(
            f"{path} has {found} pixels, its image {size.width} x {size.height}; make them equal"
        )


def read_mask(path: Path) -> NDArray[np.bool_]:
    """Return the mask (H, W) of a file, False where it is black.

    Raises :class:`UserError` if it is unreadable.
    """
    pixels = None
    try:
        data = np.fromfile(path, np.uint8)
        if data.size:  # OpenCV raises for an empty array
            pixels = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except (OSError, ValueError, MemoryError, cv2.error) as error:
        raise UserError(f"the mask {path} cannot be read: {error}") from error
    if pixels is None:
        raise UserError(f"the mask {path} cannot be read: it is no picture")
    return np.asarray(pixels > 0)


class MaskReader:
    """Masks by image, the most recently used in memory. Not thread-safe."""

    def __init__(self, masks: Masks) -> None:
        self._masks = masks
        self._cache = ByteCache(CACHE_BYTES)

    def shows(self, image: str, points: Points, size: Size) -> NDArray[np.bool_]:
        """Return a mask (N,) of the points (N, 2) that an image's mask keeps; all without a mask.

        Raises :class:`UserError` for a mask that has changed since the run began: unreadable, or of
        another size.
        """
        if image not in self._masks.files:
            return np.ones(len(points), bool)
        mask = self._cache.get(image)
        if mask is None:
            path = Path(self._masks.files[image][0])
            mask = read_mask(path)
            if mask.shape != (size.height, size.width):
                raise UserError(f"the mask {path} is not as large as its image")
            self._cache.put(image, mask, mask.nbytes)
        # (0, 0) is the centre of the first pixel; points on the border round to pixels outside.
        columns, rows = np.round(points).astype(np.intp).T
        rows = rows.clip(0, size.height - 1)
        columns = columns.clip(0, size.width - 1)
        return np.asarray(mask[rows, columns])
