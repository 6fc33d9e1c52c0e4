"""Priors of a folder's cameras: the user's table of intrinsics."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from mkpc_kaggle.data.competition import evenly_spread, read_rows
from mkpc_kaggle.data.images import EXIF_FOCALS, is_crop, read_size
from mkpc_kaggle.engine.console import logger
from mkpc_kaggle.errors import UserError, plural
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.intrinsics import CameraTable, KnownCamera, Rows, parse_row, radial_factor
from mkpc_kaggle.geometry.resolution import (
    MAX_OFFSET,
    is_same_shape,
    offset_from_middle,
    size_around,
    text_of,
    text_of_point,
)

COLUMNS = ("image", "model", "parameters")
OPTIONAL = ("size",)  # of the images that the parameters are for
SIZE = re.compile(r"\s*([1-9]\d{0,5})\s*[xX]\s*([1-9]\d{0,5})\s*", re.ASCII)
MAX_USUAL_OFFSET = 0.05  # of a principal point from the middle, as a share of the sides
MAX_ASPECT_RATIO = 1.1  # of two focal lengths; calibrations of one lens differ by 0.01
MAX_TANGENT = 4.0  # of the angle of a ray with the axis: 76 degrees
STEPS = 400
MAX_HEADS = 200  # of files whose EXIF is read before a run, at a millisecond each


def read_intrinsics_table(file: Path, root: Path, images: Iterable[Path]) -> Rows:
    """Return the rows of a table of known cameras.

    Columns: ``image``, a path below ``root``, a file name, or a pattern with ``*``; ``model`` of COLMAP, its
    ``parameters`` separated by blanks; optionally ``size``, the width x height that the parameters are for.
    Raises :class:`UserError` for a malformed row, a row that names no image, and a camera that does not fit its
    image.
    """
    rows: list[tuple[str, KnownCamera]] = []
    # The file and line of each row, for messages, and its size if it has one
    where: list[str] = []
    sizes: list[Size | None] = []
    for place, cells in read_rows(file, COLUMNS, optional=OPTIONAL):
        *camera, size = cells
        try:
            rows.append(parse_row(*camera))
            sizes.append(parse_size(size))
        except ValueError as error:
            raise UserError(f"{place}: {error}") from error
        where.append(place)
    if not rows:
        raise UserError(f"{file} has no rows; the columns are {', '.join(COLUMNS)}")
    used = set()
    warned = set()
    table = CameraTable(rows)
    for image in images:
        number = table.row_of(image.relative_to(root).as_posix())
        if number is None:
            continue
        used.add(number)
        doubt = require_fit(rows[number][1], sizes[number], image, where[number])
        # A row may name thousands of images.
        if doubt and number not in warned:
            warned.add(number)
            logger.warning(doubt)
    # A misspelt name would silently have no effect.
    unused = [number for number in range(len(rows)) if number not in used]
    if unused:
        pattern, _ = rows[unused[0]]
        count = f"; {len(unused)} of {plural(len(rows), 'row')} are so" if len(unused) > 1 else ""
        raise UserError(
            f"{where[unused[0]]}: row {pattern!r} matches no image, or only images that an earlier row "
            f"matches{count}; a row has a path below {root}, a file name or a pattern such as *.jpg"
        )
    return rows


def crops_line(rows: Rows, root: Path, images: Sequence[Path]) -> str:
    """Return a line on images without a row that are crops by their EXIF; empty without any.

    The middle of a crop need not be the middle of its lens, which cameras assume.
    """
    sample = evenly_spread(images, MAX_HEADS)
    crops = []
    table = CameraTable(rows)
    for image in sample:
        size = read_size(image)
        is_known = table.row_of(image.relative_to(root).as_posix()) is not None
        if size is not None and not is_known and is_crop(image, size):
            crops.append(f"{image.relative_to(root).as_posix()} with {text_of(size)} pixels")
    if not crops:
        return ""
    return (
        f"{len(crops)} of {plural(len(sample), 'photograph')} are crops by their EXIF, the first is "
        f"{crops[0]}: cameras assume that the middle of an image is the middle of the lens; use the "
        "photographs as taken, or give --intrinsics"
    )


def has_gaps(rows: Rows, root: Path, images: Sequence[Path]) -> bool:
    """Return whether an image has no camera in the rows of :func:`read_intrinsics_table`."""
    return bool(_without_camera(rows, root, images))


def intrinsics_line(rows: Rows, root: Path, images: Sequence[Path]) -> str:
    """Return a line on the images that have a camera in the rows of
    :func:`read_intrinsics_table`.
    """
    without = _without_camera(rows, root, images)
    line = f"known cameras: {len(images) - len(without)} of {plural(len(images), 'image')}"
    return line + (f"; the first without one is {without[0]}" if without else "")


def _without_camera(rows: Rows, root: Path, images: Sequence[Path]) -> list[str]:
    names = (image.relative_to(root).as_posix() for image in images)
    table = CameraTable(rows)
    return [name for name in names if table.row_of(name) is None]


def parse_size(cell: str) -> Size | None:
    """Return the size of a cell such as ``640x480``; ``None`` if it is empty."""
    if not cell.strip():
        return None
    found = SIZE.fullmatch(cell)
    if found is None:
        raise ValueError(f"a size is width x height such as 640x480, not {cell!r}")
    return Size(int(found[1]), int(found[2]))


def require_fit(known: KnownCamera, stated: Size | None, image: Path, where: str) -> str:
    """Return a doubt about a camera of an image, or an empty string.

    ``stated`` is the size in the camera's row, if any. Raises :class:`UserError` for a camera that
    cannot have taken an image of this size.
    """
    size = read_size(image)
    if size is None:  # an unreadable image is reported by the run
        return ""
    has_pixels = f"{image.name} has {text_of(size)} pixels"
    if stated is not None and stated != size:
        raise UserError(
            f"{where}: the row is for {text_of(stated)}, and {has_pixels}{remedy(known, stated, size)}"
        )
    # The most frequent mistake: a calibration at another resolution. A stated size rules it out.
    doubt = "" if stated is not None else _principal_point_doubt(known, size, has_pixels, where)
    # Such as millimetres in place of pixels
    if known.focal / max(size) not in EXIF_FOCALS:
        raise UserError(
            f"{where}: a focal length of {known.focal:g} px is implausible for {image.name} "
            f"of {text_of(size)} pixels"
        )
    _require_visible_edge(known, size, image, where)
    return doubt or _aspect_doubt(known, where)


def _aspect_doubt(known: KnownCamera, where: str) -> str:
    """Return a doubt about two focal lengths, since pixels of cameras are square."""
    ratio = max(known.focals) / min(known.focals)
    if ratio <= MAX_ASPECT_RATIO:
        return ""
    return (
        f"{where}: fx and fy differ by {100 * (ratio - 1):.0f} %, and pixels of cameras are square: "
        "the order is fx fy cx cy"
    )


def _require_visible_edge(known: KnownCamera, size: Size, image: Path, where: str) -> None:
    """Raise :class:`UserError` for coefficients by which no ray reaches the edge of an image."""
    shown = 0.0
    for number in range(1, STEPS + 1):
        radius = number * MAX_TANGENT / STEPS
        distorted = radius * radial_factor(known, radius)
        # From here on, farther rays would come back to the middle.
        if distorted <= shown:
            break
        shown = distorted
    if shown < max(size) / 2 / known.focal:
        raise UserError(
            f"{where}: with this distortion no pixel of {image.name} is more than "
            f"{shown * known.focal:.0f} px from the middle; COLMAP's coefficients are for x / f and y / f"
        )


def _principal_point_doubt(known: KnownCamera, size: Size, has_pixels: str, where: str) -> str:
    """Return a doubt about a principal point off the middle, or an empty string. Raises
    :class:`UserError` if it is far off.
    """
    point = known.principal_point
    offset = offset_from_middle(point, size)
    if offset <= MAX_USUAL_OFFSET:
        return ""
    text = f"{where}: {text_of_point(point, size)}: {has_pixels}"
    other = size_around(point, size)
    if other is not None:
        text += f", and the row seems to be for {text_of(other)}{remedy(known, other, size)}"
    text += f"; if the row is right, add the column size with {size.width}x{size.height}"
    if offset > MAX_OFFSET:
        raise UserError(text)
    return text


def remedy(known: KnownCamera, of: Size, size: Size) -> str:
    """Return the remedy for a row that is for another size than that of its image."""
    if not is_same_shape(of, size):
        return ". Rows are for pixels as stored, without the rotation of EXIF"
    scaled = known.scaled(size.width / of.width, size.height / of.height)
    parameters = " ".join(f"{value:.6g}" for value in scaled.parameters)
    return f". Write the parameters {parameters}"
