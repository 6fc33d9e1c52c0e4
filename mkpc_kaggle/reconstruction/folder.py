"""A folder of images: its datasets, and lists of their pairs."""

import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mkpc_kaggle.data.competition import CONTROL
from mkpc_kaggle.data.images import (
    IMAGE_SUFFIXES,
    MORE_SUFFIXES,
    OTHER_SUFFIXES,
    READ_SUFFIXES,
    is_picture,
)
from mkpc_kaggle.engine.console import logger
from mkpc_kaggle.errors import UserError, plural, printable, read_text
from mkpc_kaggle.reconstruction.directory import RESERVED

# Images of each folder, by the folder's path below the root
Datasets = Mapping[str, Sequence[Path]]
Ends = tuple[Path, Path]
# Of Synology, QNAP, Windows and macOS: small copies of the photographs, and deleted ones
THUMBNAIL_FOLDERS = frozenset(
    {"@eadir", "#recycle", "@recycle", "$recycle.bin", "system volume information", "__macosx"}
)
KNOWN_SUFFIXES = OTHER_SUFFIXES.union(READ_SUFFIXES)
# Files with other suffixes that are opened. On a file server each takes a millisecond.
MAX_OPENED = 1_000


def read_folder(root: Path, *, join: bool = False) -> Datasets:
    """Return the datasets, sorted by name: each folder with images below ``root``, and ``root``
    itself as ".". With ``join``, all images below ``root`` are the dataset ".".

    Hidden files, thumbnails of file servers and photographs that cannot be read are skipped with a
    warning. Raises :class:`UserError` if no dataset has two images, if images of a dataset differ
    only in the suffix, or if a name cannot be used in result files.
    """
    if not root.is_dir():
        raise UserError(
            f"{root}: no such directory; name a folder of images, or of folders of images"
        )
    found = _Unread()
    datasets: dict[str, list[Path]] = {}
    for folder, files in _folders(root, found):
        name = folder.relative_to(root).as_posix()
        _require_usable(folder, root, files, is_dataset=not join)
        datasets.setdefault("." if join else name, []).extend(files)
    for line in found.lines():
        logger.warning(line)
    if not datasets:
        message = f"{root} has no images: name a folder with {', '.join(READ_SUFFIXES)} files"
        if found.unread:
            message += "; photographs of other formats must be converted first"
        if found.unnamed:
            message += "; photographs of other names must be renamed first"
        raise UserError(message)
    # Other datasets of a single image are listed without a camera.
    if all(len(files) < 2 for files in datasets.values()):
        name = next(iter(datasets.values()))[0].name
        raise UserError(f"{root} has a single image, {name}: matching needs two")
    # Joined, the images of all folders have one order.
    return {name: sorted(files) for name, files in sorted(datasets.items())}


@dataclass
class _Unread:
    """Files and folders that are not read, for one line about each kind."""

    hidden: list[Path] = field(default_factory=list)
    thumbnails: list[Path] = field(default_factory=list)
    unread: list[Path] = field(default_factory=list)
    twins: list[Path] = field(default_factory=list)
    unnamed: list[Path] = field(default_factory=list)
    opened: int = 0  # files of other names whose first bytes were read

    def lines(self) -> Iterator[str]:
        if self.hidden:
            yield f"hidden files and folders are passed over: {_first(self.hidden)}"
        if self.thumbnails:
            yield f"folders of thumbnails and deleted files are passed over: {_first(self.thumbnails)}"
        if self.twins:
            yield (
                "not used, because another image of the folder has the same name: "
                f"{_first(self.twins)}"
            )
        if self.unread:
            kinds = Counter(path.suffix.lower() for path in self.unread)
            counts = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
            yield (
                f"photographs that cannot be read: {counts}, the first is {self.unread[0]}; "
                "convert them to JPEG or PNG"
            )
        if self.unnamed:
            yield (
                f"photographs without a known suffix are not used: {_first(self.unnamed)}; give them the "
                "suffix of their format, such as .jpg"
            )

    def add_unnamed(self, folder: Path, names: Iterable[str]) -> None:
        """Add the files of a folder that are pictures by their first bytes."""
        for name in names:
            if self.opened >= MAX_OPENED:
                return
            self.opened += 1
            if is_picture(folder / name):
                self.unnamed.append(folder / name)


def _first(paths: Sequence[Path]) -> str:
    return f"{len(paths)}, the first is {paths[0]}"


def _folders(root: Path, unread: _Unread) -> Iterator[tuple[Path, list[Path]]]:
    """Yield each folder with images from ``root`` on, and its images, sorted."""
    seen = {root.resolve()}
    # A folder that cannot be read is an error: a part of the images would be missing silently.
    for place, folders, names in os.walk(root, onerror=_refuse_unreadable, followlinks=True):
        folder = Path(place)
        # Sorted, since the order of a file system is arbitrary and decides bytes of results
        images = sorted(filter(_is_image, names))
        unread.hidden += [folder / name for name in (*folders, *images) if name.startswith(".")]
        unread.thumbnails += [folder / name for name in sorted(folders) if _has_thumbnails(name)]
        inner = [
            folder / name
            for name in sorted(folders)
            if not name.startswith(".") and not _has_thumbnails(name)
        ]
        # Links may form a cycle
        folders[:] = [subfolder.name for subfolder in inner if subfolder.resolve() not in seen]
        seen.update(subfolder.resolve() for subfolder in inner)
        files, twins = _without_twins(name for name in images if not name.startswith("."))
        unread.twins += [folder / name for name in twins]
        # A raw file next to its JPEG is no loss.
        stems = {_stem(name) for name in files}
        others = [name for name in sorted(names) if _suffix(name) in OTHER_SUFFIXES]
        unread.unread += [
            folder / name
            for name in others
            if _stem(name) not in stems and not name.startswith(".")
        ]
        # "a.jpg_original" and "a.jpg.bak" are copies of "a.jpg".
        copied = stems.union(files)
        unread.add_unnamed(
            folder,
            (
                name
                for name in sorted(names)
                if _suffix(name) not in KNOWN_SUFFIXES
                and _stem(name) not in copied
                and not name.startswith(".")
            ),
        )
        if files:
            yield folder, [folder / name for name in files]


def _without_twins(names: Iterable[str]) -> tuple[list[str], list[str]]:
    """Return the images to read, and other formats of images that are also there as JPEG or PNG."""
    files = list(names)
    usual = {_stem(name) for name in files if _suffix(name) in IMAGE_SUFFIXES}
    twins = {name for name in files if _suffix(name) in MORE_SUFFIXES and _stem(name) in usual}
    return [name for name in files if name not in twins], [name for name in files if name in twins]


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


def _suffix(name: str) -> str:
    return os.path.splitext(name)[1].lower()  # noqa: PTH122  Path takes ten times as long


def _stem(name: str) -> str:
    return os.path.splitext(name)[0]  # noqa: PTH122


def _is_image(name: str) -> bool:
    # A hidden file may be called ".jpg".
    return name.lower().endswith(READ_SUFFIXES)


def _has_thumbnails(folder: str) -> bool:
    return folder.lower() in THUMBNAIL_FOLDERS


def _require_usable(folder: Path, root: Path, files: Sequence[Path], *, is_dataset: bool) -> None:
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
    reserved = RESERVED.intersection(map(str.lower, folder.relative_to(root).parts))
    # Only a dataset has a folder in OUT.
    if reserved and is_dataset:
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


def pair_list_line(listed: Sequence[Ends], root: Path, datasets: Datasets) -> str:
    """Return a line on the images that the pairs of a list connect."""
    files = [file for found in datasets.values() for file in found]
    paired = {file for ends in listed for file in ends}
    without = [file for file in files if file not in paired]
    named = len(files) - len(without)
    line = f"--pairs: {plural(len(listed), 'pair')} with {named} of {plural(len(files), 'image')}"
    if not without:
        return line
    return f"{line}; the first image without a pair is {without[0].relative_to(root).as_posix()}"


def _refuse_unreadable(error: OSError) -> None:
    raise UserError(f"{error.filename} cannot be read: {error.strerror}")


def read_pair_list(path: Path, root: Path, datasets: Datasets) -> list[Ends]:
    """Return the pairs of a list in hloc's format: one line per pair, two image paths below
    ``root``.

    Raises :class:`UserError` for a line that does not name two images of one dataset.
    """
    # The dataset of each image
    dataset_of = {file: name for name, files in datasets.items() for file in files}
    listed = []
    problems = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        text = line.strip()
        if not text:
            continue
        ways = (
            (root / text[: gap.start()], root / text[gap.end() :])
            for gap in re.finditer(r"\s+", text)
        )
        # Names may have blanks, so each blank may be the border.
        ends = [sorted(two) for two in ways if dataset_of.keys() >= set(two)]
        # As in COLMAP's lists; an image may be called "#1.jpg".
        if not ends and text.startswith("#"):
            continue
        problem = _problem_of_line(text, ends, root, dataset_of)
        if problem:
            problems.append(
                f"line {number}: expected two images of one dataset of {root}, found {line!r}; {problem}"
            )
        else:
            listed.append((ends[0][0], ends[0][1]))
    if problems:
        count = f"; {len(problems)} lines name no pair" if len(problems) > 1 else ""
        raise UserError(f"{path}, {problems[0]}{count}")
    if not listed:
        raise UserError(f"{path} has no pairs")
    # hloc's lists may name a pair in both orders.
    return list(dict.fromkeys(listed))


def _problem_of_line(
    text: str, ends: Sequence[Sequence[Path]], root: Path, dataset_of: Mapping[Path, str]
) -> str:
    """Return why a line of a list names no pair, or an empty string. ``ends`` are the pairs that it may
    name.
    """
    if len(ends) > 1:
        return "its blanks allow several pairs"
    if not ends:
        unknown = [name for name in text.split() if root / name not in dataset_of]
        example = next(iter(dataset_of)).relative_to(root).as_posix()
        return f"{' '.join(unknown) or 'a name'} is no image there; names are such as {example}"
    first, second = ends[0]
    if first == second:
        return "both are one image"
    if dataset_of[first] != dataset_of[second]:
        return "their folders are separate datasets without --join"
    return ""
