"""The weights manifest: every file that a matcher can use.

``weights_manifest.txt`` has one line a file, columns split by blanks, ``#`` starts a comment::

    name  bytes  digest  licence  slot  source

``bytes`` is a number or ``?``. ``digest`` is ``sha256:<64 hex>``, or ``git-blob:<40 hex>`` (what ``git
hash-object`` gives), or ``unverified``. A *slot* is what a matcher asks for; lines of one slot are alternatives,
the first that is found is taken.
"""

import re
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.weights.digests import file_digests

MANIFEST = "weights_manifest.txt"
LARGEST = 1 << 20
"""Bytes."""
UNVERIFIED = "unverified"
DIGEST = re.compile(rf"sha256:[0-9a-f]{{64}}|git-blob:[0-9a-f]{{40}}|{UNVERIFIED}")


@dataclass(frozen=True)
class WeightFile:
    """One line of the manifest; ``size`` in bytes, -1 where it is not known."""

    name: str
    size: int
    digest: str
    licence: str
    slot: str
    source: str

    @property
    def line(self) -> str:
        """The line as the manifest has it."""
        size = "?" if self.size < 0 else str(self.size)
        return "  ".join((self.name, size, self.digest, self.licence, self.slot, self.source))


def parse_manifest(text: str, where: str = "the weights manifest") -> tuple[WeightFile, ...]:
    """All lines of a manifest; raises :class:`UserError` naming the line that cannot be read."""
    files = []
    for number, line in enumerate(text.splitlines(), start=1):
        columns = line.partition("#")[0].split(maxsplit=5)
        if columns:
            files.append(_parse_line(columns, f"{where}, line {number}"))
    return tuple(files)


def read_manifest(path: Path) -> tuple[WeightFile, ...]:
    """A manifest's file; raises :class:`UserError` where it or one of its lines cannot be read."""
    try:
        if not path.is_file() or path.stat().st_size > LARGEST:
            raise OSError(f"it is no regular file of at most {LARGEST} bytes")
        return parse_manifest(path.read_text(encoding="utf-8"), str(path))
    except (OSError, UnicodeError) as error:
        raise UserError(f"{path} cannot be read: {error}") from error


def pin(file: WeightFile, path: Path) -> WeightFile:
    """The line with the size and digest of what lies at ``path``, also added to the manifest in its directory."""
    digests = file_digests(path)
    pinned = replace(file, size=digests.size, digest=digests.sha256)
    own = path.with_name(MANIFEST)
    former = own.read_text(encoding="utf-8") if own.is_file() else ""
    part = own.with_name(f"{MANIFEST}.part")
    part.write_text(f"{former}{pinned.line}\n", encoding="utf-8")
    part.replace(own)
    return pinned


def _parse_line(columns: list[str], where: str) -> WeightFile:
    if len(columns) != 6:
        raise UserError(f"{where}: expected 6 columns, found {len(columns)}")
    name, size, digest, licence, slot, source = columns
    if Path(name).name != name or name.startswith("."):
        raise UserError(f"{where}: {name!r} is not a plain file name")
    if size != "?" and not (size.isascii() and size.isdigit()):
        raise UserError(f"{where}: bytes must be a number or '?', not {size!r}")
    if not DIGEST.fullmatch(digest):
        raise UserError(
            f"{where}: digest must be 'sha256:' with 64 hexadecimal digits, 'git-blob:' with 40, or "
            f"'{UNVERIFIED}', not {digest!r}"
        )
    return WeightFile(name, -1 if size == "?" else int(size), digest, licence, slot, source.strip())


@cache
def manifest() -> tuple[WeightFile, ...]:
    """The manifest that came with the package (in a wheel: inside it; in a checkout: beside it)."""
    package = Path(__file__).resolve().parents[1]
    for path in (package / MANIFEST, package.parent / MANIFEST):
        if path.is_file():
            return read_manifest(path)
    raise UserError(f"{MANIFEST} is missing from {package}: install the package again")
