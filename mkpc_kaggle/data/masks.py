"""Masks of images, named as COLMAP's: ``DIR/a.jpg.png`` masks ``a.jpg``.

Black pixels are left out, and transparent ones.
"""

import hashlib
import unicodedata
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.data.competition import evenly_spread
from mkpc_kaggle.data.heads import is_whole_png, may_have_one_colour
from mkpc_kaggle.data.images import ByteCache, decode, read_size
from mkpc_kaggle.data.outputs import lies_in
from mkpc_kaggle.errors import UserError, plural
from mkpc_kaggle.geometry.coordinates import Points, Size
from mkpc_kaggle.geometry.resolution import text_of

CACHE_BYTES = 128 << 20
MASK_SUFFIX = ".png"
# Masks that are decoded before the run: one of 24 megapixels takes 0.28 s.
MAX_DECODED = 24
MIN_SHOWN = 0.05  # share of an image; a mask that shows less is often inverted


@dataclass(frozen=True)
class Masks:
    """The mask file of each image, by the image's path, with the digest of its content.

    ``lines`` state for the user which part of the masks takes effect; ``is_partial`` if that is not
    all of them.
    """

    files: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    lines: tuple[str, ...] = field(default=(), compare=False)
    is_partial: bool = field(default=False, compare=False)

    @classmethod
    def of_folder(cls, directory: Path, root: Path, images: Iterable[Path]) -> "Masks":
        """Return the masks below ``directory`` of images below ``root``.

        An image without a mask is used whole. Raises :class:`UserError` for a directory that is
        missing, has images of the run or no masks of these images. Raises it also for a mask that
        is unreadable or not as large as its image. Of many masks, up to ``MAX_DECODED`` are decoded,
        and those that may have one colour; of the others, sizes and the checksums of PNG are read.
        """
        if not directory.is_dir():
            raise UserError(
                f"{directory}: no such directory; --masks names a directory with files such as a.jpg{MASK_SUFFIX}"
            )
        images = list(images)
        # Each folder once: resolving links takes long.
        if any(lies_in(folder, directory) for folder in {image.parent for image in images}):
            raise UserError(
                f"--masks {directory} has images of the run, so masks count as images; move it elsewhere"
            )
        present = _files_below(directory)
        masked: dict[Path, Path] = {}
        for image in images:
            path = present.pop(_key(f"{image.relative_to(root).as_posix()}{MASK_SUFFIX}"), None)
            if path is not None:  # as in COLMAP, an image without a mask is used whole
                masked[image] = path
        if not masked:
            name = images[0].relative_to(root).as_posix() if images else "a.jpg"
            expected = f"{name}{MASK_SUFFIX}"
            raise UserError(f"{directory} has no mask of any image: {expected} would be the first")
        files: dict[str, tuple[str, str]] = {}
        effects: dict[str, str] = {}  # of the decoded masks, by digest: many may be copies of one
        unusual: dict[str, list[Path]] = {}
        sample = set(evenly_spread([*masked.values()], MAX_DECODED))
        decoded = 0
        for image, path in masked.items():
            data = _bytes_of(path)
            digest = _digest(data)
            mask = None
            # A mask that hides everything or nothing has one colour.
            is_light = is_whole_png(data) and not may_have_one_colour(data)
            if digest not in effects and (path in sample or not is_light):
                mask = read_mask(path)
                effects[digest] = _effect(mask)
            _require_size(path, image, mask)
            files[str(image)] = (str(path), digest)
            decoded += digest in effects
            if effect := effects.get(digest):
                unusual.setdefault(effect, []).append(path)
        lines = _lines(directory, len(images), len(files), decoded, present, unusual)
        is_partial = len(files) < len(images) or bool(present or unusual)
        return cls(files, tuple(lines), is_partial)

    def digest(self, image: str) -> str:
        """Return the digest of an image's mask; empty without a mask."""
        return self.files.get(image, ("", ""))[1]


def _files_below(directory: Path) -> dict[str, Path]:
    """Return the files below a directory of masks by the key of their names, sorted."""
    files: dict[str, Path] = {}
    for path in sorted(directory.rglob("*")):
        name = path.relative_to(directory).as_posix()
        # A directory at the name of a mask is refused later.
        is_mask = not path.is_dir() or path.suffix.lower() == MASK_SUFFIX
        if is_mask and not any(part.startswith(".") for part in name.split("/")):
            files.setdefault(_key(name), path)
    return files


def _key(name: str) -> str:
    """Return a key that equal names have: macOS writes "é" as two characters, Windows ".PNG"."""
    stem, dot, suffix = unicodedata.normalize("NFC", name).rpartition(".")
    return f"{stem}{dot}{suffix.lower()}"


def _lines(
    directory: Path,
    images: int,
    masked: int,
    decoded: int,
    surplus: Mapping[str, Path],
    unusual: Mapping[str, Sequence[Path]],
) -> Iterator[str]:
    """Yield which part of the masks takes effect."""
    line = f"masks: {masked} of {plural(images, 'image')}"
    if surplus:
        first = next(iter(surplus.values())).relative_to(directory)
        belong = "belongs" if len(surplus) == 1 else "belong"
        line += f"; {plural(len(surplus), 'file')} of {directory} {belong} to none, the first is {first}"
    yield line
    of_sample = f" of {decoded} that were decoded" if decoded < masked else ""
    for effect, paths in unusual.items():
        yield f"masks that {effect}: {len(paths)}{of_sample}, the first is {paths[0]}"


def _bytes_of(path: Path) -> bytes:
    if not path.is_file():
        raise UserError(f"{path} cannot be read: not a regular file")
    try:
        return path.read_bytes()
    except OSError as error:
        raise UserError(f"the mask {path} cannot be read: {error}") from error


def _require_size(path: Path, image: Path, mask: NDArray[np.bool_] | None) -> None:
    """Raise :class:`UserError` for a mask that is not as large as its image. ``mask`` has its pixels, if it was
    decoded.
    """
    found = read_size(path) if mask is None else Size(mask.shape[1], mask.shape[0])
    size = read_size(image)
    # An unreadable image is reported by the run.
    if found is None or size is None or found == size:
        return
    remedy = "make them equal"
    if (size.height, size.width) == found:
        remedy = "masks are for pixels as stored, without the rotation of EXIF"
    raise UserError(f"{path} has {text_of(found)} pixels, its image {text_of(size)}; {remedy}")


def _effect(mask: NDArray[np.bool_]) -> str:
    """Return what is unusual about a mask, if anything."""
    if not mask.any():
        return "hide everything"
    if mask.mean() < MIN_SHOWN:
        return f"hide more than {100 * (1 - MIN_SHOWN):g} % of their image, since black is left out"
    # For example JPEG files, whose black is 1 or 2
    return "hide nothing, since only black or transparent pixels do" if mask.all() else ""


def read_mask(path: Path) -> NDArray[np.bool_]:
    """Return the mask (H, W) of a file, False where it is black or transparent.

    Raises :class:`UserError` if it is unreadable.
    """
    pixels = None
    try:
        data = np.fromfile(path, np.uint8)
        if data.size:  # OpenCV raises for an empty array
            # As stored: a conversion to 8 bits would make 255 of 65,535 black.
            pixels = decode(data, cv2.IMREAD_UNCHANGED)
    except (OSError, ValueError, MemoryError, cv2.error) as error:
        raise UserError(f"the mask {path} cannot be read: {error}") from error
    if pixels is None:
        raise UserError(f"the mask {path} cannot be read: it is no picture")
    channels = np.atleast_3d(pixels)
    has_alpha = channels.shape[2] in (2, 4)
    colours = channels[:, :, :-1] if has_alpha else channels
    shown = (colours > 0).any(axis=2)
    if has_alpha:
        shown &= channels[:, :, -1] > 0
    return np.asarray(shown)


def _digest(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=16).hexdigest()


class MaskReader:
    """Masks by image, the most recently used in memory. Not thread-safe."""

    def __init__(self, masks: Masks) -> None:
        self._masks = masks
        self._cache = ByteCache(CACHE_BYTES)

    def shows(self, image: str, points: Points, size: Size) -> NDArray[np.bool_]:
        """Return a mask (N,) of the points (N, 2) that an image's mask keeps; all without a mask.

        Raises :class:`UserError` for a mask that has changed since the run began.
        """
        if image not in self._masks.files:
            return np.ones(len(points), bool)
        mask = self._cache.get(image)
        if mask is None:
            name, digest = self._masks.files[image]
            path = Path(name)
            mask = read_mask(path)
            # Results with this mask are stored under the digest.
            if _digest(path.read_bytes()) != digest:
                raise UserError(
                    f"the mask {path} has changed during the run; run the command again"
                )
            if mask.shape != (size.height, size.width):
                raise UserError(f"the mask {path} is not as large as its image")
            self._cache.put(image, mask, mask.nbytes)
        # (0, 0) is the centre of the first pixel; points on the border round to pixels outside.
        columns, rows = np.round(points).astype(np.intp).T
        rows = rows.clip(0, size.height - 1)
        columns = columns.clip(0, size.width - 1)
        return np.asarray(mask[rows, columns])
