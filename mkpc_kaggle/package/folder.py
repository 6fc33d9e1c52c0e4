"""Folders with exactly the given files."""

import filecmp
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from mkpc_kaggle.errors import UserError


@dataclass(frozen=True)
class Item:
    """A file to write: name in the folder, source, and licence if it has its own."""

    name: str
    source: Path
    licence: str = ""
    note: str = ""


def refuse_other_files(directory: Path, items: Sequence[Item]) -> None:
    """Raise :class:`UserError` if the folder has other files, which would be uploaded too."""
    names = {name for item in items for name in (item.name, f".{item.name}.part")}
    others = sorted({path.name for path in directory.glob("*")} - names)
    if others:
        raise UserError(
            f"{directory} contains files that would be uploaded too: {', '.join(others)}. Remove them, or choose "
            "another --out."
        )


def write_files(directory: Path, items: Sequence[Item]) -> tuple[Item, ...]:
    """Write files into the folder, except existing ones with the same bytes, and return them as written.

    Raises :class:`UserError` if a file cannot be written; the same call resumes.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for item in items:
            target, part = directory / item.name, directory / f".{item.name}.part"
            part.unlink(missing_ok=True)
            if target.is_file() and filecmp.cmp(item.source, target, shallow=False):
                continue
            with item.source.open("rb") as source, part.open("xb") as copy:  # "x" follows no link
                shutil.copyfileobj(source, copy)
            part.replace(target)
    except OSError as error:
        raise UserError(f"{directory} cannot be written: {error}") from error
    return tuple(replace(item, source=directory / item.name) for item in items)
