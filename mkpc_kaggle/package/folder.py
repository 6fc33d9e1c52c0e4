"""A folder that holds exactly the files that it should."""

import filecmp
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mkpc_kaggle.errors import UserError


@dataclass(frozen=True)
class Item:
    """A file to be: its name in the folder, and where its bytes are; its licence, where it has one of its own."""

    name: str
    source: Path
    licence: str = ""
    note: str = ""

    @property
    def size(self) -> int:
        """Bytes."""
        return self.source.stat().st_size


def refuse_strangers(directory: Path, items: Sequence[Item]) -> None:
    """Raise :class:`UserError` where the folder holds other files: they would be uploaded with ours."""
    names = {item.name for item in items} | {_part(item.name) for item in items}
    others = (
        sorted(path.name for path in directory.iterdir() if path.name not in names) if directory.is_dir() else []
    )
    if others:
        raise UserError(
            f"{directory} holds what this run would not put there, and what would be uploaded all the same: "
            f"{', '.join(others)}. Remove it, or choose another --out."
        )


def fill(directory: Path, items: Sequence[Item]) -> None:
    """Have these files in the folder; those that are there with the same bytes are left alone.

    Raises :class:`UserError` where one cannot be written; the same call goes on there.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for item in items:
            target, part = directory / item.name, directory / _part(item.name)
            if not (target.is_file() and filecmp.cmp(item.source, target, shallow=False)):
                shutil.copyfile(item.source, part)
                part.replace(target)
            part.unlink(missing_ok=True)
    except OSError as error:
        raise UserError(f"{directory} cannot be written: {error}") from error


def _part(name: str) -> str:
    return f".{name}.part"
