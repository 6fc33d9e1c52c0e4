"""Masks of images, named as COLMAP's: ``DIR/a.jpg.png`` masks ``a.jpg``. Black pixels are left out."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.images import ByteCache, content_digest, open_picture, read_size
from mkpc_kaggle.data.outputs import lies_in
from mkpc_kaggle.errors import UserError, open_regular, plural
from mkpc_kaggle.geometry.coordinates import Points, Size

CACHE_BYTES = 128 << 20
MASK_SUFFIX = ".png"


@dataclass(frozen=True)
class Masks:
    """The mask file of each image, by the image's path, with the digest of its content."""

    files: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    line: str = field(default="", compare=False)  # states how many images have a mask

    @classmethod
    def of_folder(cls, directory: Path, root: Path, images: Iterable[Path]) -> "Masks":
        """Return the masks below ``directory`` of images below ``root``.

        An image without a mask is used whole. Raises :class:`UserError` for a directory that has
        images of the run, or no mask of any; and for a mask that is unreadable, or not as large as its
        image.
        """
        images = list(images)
        # Each folder once: resolving links takes long.
        if any(lies_in(folder, directory) for folder in {image.parent for image in images}):
            raise UserError(
                f"--masks {directory} has images of the run, so masks count as images; move it elsewhere"
            )
        files: dict[str, tuple[str, str]] = {}
        for image in images:
            path = directory / f"{image.relative_to(root).as_posix()}{MASK_SUFFIX}"
            if path.exists():
                _require_size(path, image)
                files[str(image)] = (str(path), content_digest(path))
        if not files:
            name = images[0].relative_to(root).as_posix() if images else "a.jpg"
            raise UserError(
                f"{directory} has no mask of any image: {name}{MASK_SUFFIX} would be the first"
            )
        return cls(files, f"masks: {len(files)} of {plural(len(images), 'image')}")

    def digest(self, image: str) -> str:
        """Return the digest of an image's mask; empty without a mask."""
        return self.files.get(image, ("", ""))[1]


def _require_size(path: Path, image: Path) -> None:
    """Raise :class:`UserError` for a mask that is not as large as its image."""
    found = read_size(path)
    if found is None:
        raise UserError(f"the mask {path} cannot be read")
    size = read_size(image)
    # An unreadable image is reported by the run.
    if size is not None and found != size:
        raise UserError(
            f"{path} has {found.width} x {found.height} pixels, its image {size.width} x {size.height}; "
            "masks are for pixels as stored, without the rotation of EXIF"
        )


def read_mask(path: Path) -> NDArray[np.bool_]:
    """Return the mask (H, W) of a file, False where it is black.

    Raises :class:`UserError` if it is unreadable.
    """
    try:
        with open_regular(path) as stream, open_picture(stream) as picture:
            # Palettes have colours; the values of others are those of the file, of 8 or 16 bits.
            is_gray = picture.mode in ("1", "L") or picture.mode.startswith("I")
            values = np.asarray(picture if is_gray else picture.convert("RGB"))
    except Exception as error:  # a reader may raise anything for a damaged file
        raise UserError(f"the mask {path} cannot be read: {error}") from error
    shown = values.reshape(*values.shape[:2], -1).any(axis=2)
    return np.asarray(shown)


class MaskReader:
    """Masks by image, the most recently used in memory. Not thread-safe."""

    def __init__(self, masks: Masks) -> None:
        self._masks = masks
        self._cache = ByteCache(CACHE_BYTES)

    def shows(self, image: str, points: Points, size: Size) -> NDArray[np.bool_]:
        """Return a mask (N,) of the points (N, 2) that an image's mask keeps; all without a mask.

        Raises :class:`UserError` for a mask that is unreadable.
        """
        if image not in self._masks.files:
            return np.ones(len(points), bool)
        mask = self._cache.get(image)
        if mask is None:
            mask = read_mask(Path(self._masks.files[image][0]))
            self._cache.put(image, mask, mask.nbytes)
        # (0, 0) is the centre of the first pixel; points on the border round to pixels outside.
        columns, rows = np.round(points).astype(np.intp).T
        rows = rows.clip(0, size.height - 1)
        columns = columns.clip(0, size.width - 1)
        return np.asarray(mask[rows, columns])
