"""The inputs of ``reconstruct``: a folder of photographs, a list of pairs, a table of cameras."""

import fnmatch
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from mkpc_kaggle.config import decimal, whole
from mkpc_kaggle.data.competition import CONTROL, read_rows
from mkpc_kaggle.data.images import READ_SUFFIXES, read_size
from mkpc_kaggle.errors import UserError, plural, printable, read_text
from mkpc_kaggle.geometry.intrinsics import KnownCamera, Rows
from mkpc_kaggle.scene.models import MIN_IMAGES
from mkpc_kaggle.setup.console import logger

CAMERA_COLUMNS = ("image", "camera_model", "width", "height", "parameters")
FOCALS = (0.1, 10.0)  # in long sides of the image, as in COLMAP's ``has_bogus_params``

Ends = tuple[Path, Path]  # the two images of a pair


def require_folder(path: str | Path) -> Path:
    """Return the path of a folder. Raise :class:`UserError` for any other path."""
    if not Path(path).is_dir():
        raise UserError(f"{path} is no folder; give the folder that has the photographs")
    return Path(path)


def read_folder(root: Path) -> list[Path]:
    """Return the photographs below ``root``, sorted: the files with a suffix of photographs.

    Hidden files and folders are skipped. A line counts the other files. Raises :class:`UserError` if
    fewer than three photographs are found, and for a name that is no text.
    """
    require_folder(root)
    files: list[Path] = []
    others: Counter[str] = Counter()
    for place, folders, names in os.walk(root, onerror=_refuse):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in names:
            path = Path(place, name)
            if name.startswith("."):
                continue
            if path.suffix.lower() in READ_SUFFIXES:
                files.append(path)
            else:
                others[path.suffix.lower() or "no suffix"] += 1
    if others:
        kinds = ", ".join(f"{count} {suffix}" for suffix, count in sorted(others.items()))
        logger.warning(f"{root}: {plural(others.total(), 'file')} not read: {kinds}")
    if len(files) < MIN_IMAGES:
        suffixes = ", ".join(READ_SUFFIXES)
        raise UserError(
            f"{root} has {plural(len(files), 'photograph')} ({suffixes}); cameras need {MIN_IMAGES}"
        )
    for file in files:
        name = file.relative_to(root).as_posix()
        if CONTROL.search(name) or printable(name) != name:
            raise UserError(
                f"{root}: the name {name!r} has characters that are no text; rename it"
            )
    return sorted(files)


def _refuse(error: OSError) -> None:
    # A part of the photographs would be missing silently.
    raise UserError(f"{error.filename} cannot be read: {error.strerror}")


def read_pair_list(path: Path, root: Path, files: Sequence[Path]) -> list[Ends]:
    """Return the pairs of a list: in each line the paths of two photographs below ``root``.

    Raises :class:`UserError` for a line that does not name two photographs.
    """
    known = set(files)
    pairs = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        text = line.strip()
        # Names may have blanks, so each blank may be the border.
        ways = [
            (root / text[: gap.start()], root / text[gap.end() :])
            for gap in re.finditer(r"\s+", text)
        ]
        ends = [(a, b) for a, b in ways if a != b and known.issuperset((a, b))]
        if len(ends) != 1:
            raise UserError(
                f"{path}, line {number}: {text!r} does not name two images of {root}"
            )
        pairs.append((min(ends[0]), max(ends[0])))
    if not pairs:
        raise UserError(f"{path} has no pairs")
    return list(dict.fromkeys(pairs))


def read_intrinsics(path: Path, root: Path, files: Sequence[Path]) -> Rows:
    """Return the exact camera of each image that a table names, by its path below ``root``.

    Columns: ``image``, a path below ``root``, a file name or a pattern such as ``*.jpg``;
    ``camera_model`` of COLMAP; ``width`` and ``height`` of the image; ``parameters`` in COLMAP's
    order, with blanks between. The first row that names an image counts. Raises :class:`UserError`
    for a camera that no image has, for a row of an image of another size, and for a row without an
    image.
    """
    found: dict[str, KnownCamera] = {}
    for where, (pattern, model, *sides, parameters) in read_rows(path, CAMERA_COLUMNS):
        try:
            camera = KnownCamera(model.strip(), tuple(map(decimal, parameters.split())))
            size = tuple(map(whole, sides))
        except ValueError as error:
            raise UserError(f"{where}: {error}") from error
        images = [file for file in files if _names(pattern.strip(), file.relative_to(root))]
        # A misspelt name would silently have no effect.
        if not images:
            raise UserError(f"{where}: {pattern!r} names no image below {root}")
        for image in images:
            stored = read_size(image)  # an unreadable image is reported by the run
            name = image.relative_to(root).as_posix()
            if name not in found and stored is not None and tuple(stored) != size:
                has = f"{name} has {stored.width} x {stored.height} pixels"
                raise UserError(f"{where}: the row is for {' x '.join(sides)}, and {has}")
            # Such as millimetres
            if not FOCALS[0] * max(size) < camera.focal < FOCALS[1] * max(size):
                raise UserError(f"{where}: {camera.focal:g} px is no focal length of {name}")
            found.setdefault(name, camera)
    if not found:
        raise UserError(f"{path} has no rows; the columns are {', '.join(CAMERA_COLUMNS)}")
    return tuple(found.items())


def _names(pattern: str, image: Path) -> bool:
    # macOS writes "é" as two characters, most tables as one.
    pattern, path = (
        unicodedata.normalize("NFC", text) for text in (pattern, image.as_posix())
    )
    ways = (path, path.rpartition("/")[2])
    # A file may be called "photo [1].jpg", and as a pattern this is another.
    return pattern in ways or any(fnmatch.fnmatchcase(name, pattern) for name in ways)
