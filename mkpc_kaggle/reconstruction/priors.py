"""Priors of a folder's cameras: the user's table of intrinsics."""

from collections.abc import Iterable
from pathlib import Path

from mkpc_kaggle.data.competition import read_rows
from mkpc_kaggle.data.images import FOCALS, read_size
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.intrinsics import KnownCamera, camera_of, parse_row, written

COLUMNS = ("image", "model", "parameters", "sigma")


def read_intrinsics_table(file: Path, root: Path, images: Iterable[Path]) -> str:
    """Return the rows of a table for ``[scene] intrinsics``.

    Columns: ``image``, a path below ``root``, a file name, or a pattern with ``*``; ``model`` of COLMAP, its
    ``parameters`` separated by blanks; ``sigma`` of the focal length in percent, or ``fixed``. Raises
    :class:`UserError` for a malformed row, a row that names no image, and a camera that does not fit its image.
    """
    rows: list[tuple[str, KnownCamera]] = []
    # The file and line of each row, for messages
    where: list[str] = []
    for place, cells in read_rows(file, COLUMNS):
        try:
            rows.append(parse_row(*cells))
        except ValueError as error:
            raise UserError(f"{place}: {error}") from error
        where.append(place)
    if not rows:
        raise UserError(f"{file} has no rows; the columns are {', '.join(COLUMNS)}")
    used = set()
    for image in images:
        name = image.relative_to(root).as_posix()
        known = camera_of(rows, name)
        if known is not None:
            # By identity, because two rows may have equal cameras
            number = next(n for n, (_, camera) in enumerate(rows) if camera is known)
            used.add(number)
            _require_fit(known, image, where[number])
    # A misspelt name would silently have no effect.
    for number, (pattern, _) in enumerate(rows):
        if number not in used:
            raise UserError(
                f"{where[number]}: {pattern!r} is the camera of no image; earlier rows come first"
            )
    return written(rows)


def _require_fit(known: KnownCamera, image: Path, where: str) -> None:
    """Raise :class:`UserError` for a camera that cannot have taken an image of this size."""
    size = read_size(image)
    if size is None:  # an unreadable image is reported by the run
        return
    # Such as millimetres in place of pixels
    if known.focal / max(size) not in FOCALS:
        raise UserError(
            f"{where}: a focal length of {known.focal:g} px is implausible for {image.name} "
            f"of {size.width} x {size.height} pixels"
        )
    # The most frequent mistake: a calibration at another resolution
    x, y = known.principal_point
    if x >= size.width or y >= size.height:
        raise UserError(
            f"{where}: the principal point {x:g}, {y:g} is outside {image.name} "
            f"of {size.width} x {size.height} pixels"
        )
