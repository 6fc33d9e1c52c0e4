"""A folder of images: its datasets, and lists of their pairs."""

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from mkpc_kaggle.data.competition import CONTROL, IMAGE_SUFFIXES
from mkpc_kaggle.engine.console import warn
from mkpc_kaggle.errors import UserError, printable, read_text
from mkpc_kaggle.reconstruction.directory import RESERVED

# Images of each folder, by the folder's path below the root
Datasets = Mapping[str, Sequence[Path]]
Ends = tuple[Path, Path]


def read_folder(root: Path) -> Datasets:
    """Return the datasets, sorted by name: each folder with images below ``root``, and ``root``
    itself as ".".

    Hidden files and folders are skipped with a warning. Raises :class:`UserError` if no dataset has
    two images, if images of a dataset differ only in the suffix, or if a name cannot be used in
    result files.
    """
    if not root.is_dir():
        raise UserError(
            f"{root}: no such directory; name a folder of images, or of folders of images"
        )
    datasets = {}
    hidden: list[Path] = []
    seen = {root.resolve()}
    # A folder that cannot be read is an error: a part of the images would be missing silently.
    for place, folders, names in os.walk(root, onerror=_refuse_unreadable, followlinks=True):
        folder = Path(place)
        # Sorted, since the order of a file system is arbitrary and decides bytes of results
        images = sorted(filter(_is_image, names))
        hidden += [folder / name for name in (*folders, *images) if name.startswith(".")]
        inner = [folder / name for name in sorted(folders) if not name.startswith(".")]
        # Links may form a cycle
        folders[:] = [each.name for each in inner if each.resolve() not in seen]
        seen.update(each.resolve() for each in inner)
        files = [folder / name for name in images if not name.startswith(".")]
        if files:
            _require_usable(folder, root, files)
            datasets[folder.relative_to(root).as_posix()] = files
    if hidden:
        warn(f"hidden files and folders are passed over: {len(hidden)}, the first is {hidden[0]}")
    if not datasets:
        raise UserError(
            f"{root} has no images: name a folder with {', '.join(IMAGE_SUFFIXES)} files"
        )
    # Other datasets of a single image are listed without a camera.
    if all(len(files) < 2 for files in datasets.values()):
        name = next(iter(datasets.values()))[0].name
        raise UserError(f"{root} has a single image, {name}: matching needs two")
    return dict(sorted(datasets.items()))


def batch_names(root: Path, datasets: Iterable[str]) -> dict[str, str]:
    """Return the name of each dataset in messages and reports: its path, and for "." the root's own
    name.
    """
    names = {name: name for name in datasets}
    if "." in names:
        own = root.resolve().name or "images"  # the root of the file system has no name
        while own in names:
            own += "_"
        names["."] = own
    return names


def _is_image(name: str) -> bool:
    return name.lower().endswith(IMAGE_SUFFIXES)


def _require_usable(folder: Path, root: Path, files: Sequence[Path]) -> None:
    """Raise :class:`UserError` if the name of a folder or an image cannot be used in tables and
    databases.
    """
    # The root's own name stands for "." in reports.
    parts = folder.relative_to(root).parts or (root.resolve().name,)
    for name in (*parts, *(path.name for path in files)):
        if CONTROL.search(name) or printable(name) != name:
            raise UserError(
                f"{folder}: the name {name!r} has characters that are no text; rename it"
            )
    if reserved := RESERVED.intersection(map(str.lower, folder.relative_to(root).parts)):
        raise UserError(f"{folder}: results are called {min(reserved)}; rename that folder")
    require_distinct(files)


def require_distinct(files: Iterable[Path]) -> None:
    """Raise :class:`UserError` if two images of a folder differ only in the suffix."""
    # Names of pairs, and ids of some submissions, have no suffix.
    stems: dict[Path, Path] = {}
    for path in files:
        if (other := stems.setdefault(path.with_suffix(""), path)) is not path:
            raise UserError(
                f"{path.parent} has both {other.name} and {path.name}; rename one of them"
            )


def _refuse_unreadable(error: OSError) -> None:
    raise UserError(f"{error.filename} cannot be read: {error.strerror}")


def read_pair_list(path: Path, root: Path, datasets: Datasets) -> list[Ends]:
    """Return the pairs of a list in hloc's format: one line per pair, two image paths below
    ``root``.

    Raises :class:`UserError` for a line that does not name two images of one dataset.
    """
    known = {file for files in datasets.values() for file in files}
    found = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        text = line.strip()
        if not text:
            continue
        ways = (
            (root / text[: gap.start()], root / text[gap.end() :])
            for gap in re.finditer(r"\s+", text)
        )
        # Names may have blanks, so each blank may be the border.
        ends = [sorted(two) for two in ways if known.issuperset(two)]
        if len(ends) != 1 or ends[0][0] == ends[0][1] or ends[0][0].parent != ends[0][1].parent:
            raise UserError(
                f"{path}, line {number}: expected two images of one dataset of {root}, found {line!r}"
            )
        found.append((ends[0][0], ends[0][1]))
    if not found:
        raise UserError(f"{path} has no pairs")
    # hloc's lists may name a pair in both orders.
    return list(dict.fromkeys(found))
