"""Writing a folder that has exactly the given files."""

import filecmp
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mkpc_kaggle.errors import UserError


@dataclass(frozen=True)
class Item:
    """A file to write: its name in the folder, its source, and its licence if it has one of its own."""

    name: str
    source: Path
    licence: str = ""
    note: str = ""

    @property
    def size(self) -> int:
        """Bytes."""
        return self.source.stat().st_size


def refuse_other_files(directory: Path, items: Sequence[Item]) -> None:
    """Raise :class:`UserError` where the folder has other files: they would be uploaded too."""
    names = {item.name for item in items} | {_part(item.name) for item in items}
    others = (
        sorted(path.name for path in directory.iterdir() if path.name not in names) if directory.is_dir() else []
    )
    if others:
        raise UserError(
            f"{directory} holds what this run would not put there, and what would be uploaded all the same: "
            f"{', '.join(others)}. Remove it, or choose another --out."
        )


def write_files(directory: Path, items: Sequence[Item]) -> None:
    """Write these files into the folder, but for those that are there with the same bytes.

    Raises :class:`UserError` where one cannot be written; the same call continues there.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for item in items:
            target, part = directory / item.name, directory / _part(item.name)
            part.unlink(missing_ok=True)  # it may be a link
            if not (target.is_file() and filecmp.cmp(item.source, target, shallow=False)):
                shutil.copyfile(item.source, part)
                part.replace(target)
    except OSError as error:
        raise UserError(f"{directory} cannot be written: {error}") from error


def _part(name: str) -> str:
    return f".{name}.part"
