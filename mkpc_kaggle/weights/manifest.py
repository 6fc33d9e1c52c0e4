"""The weights manifest: all files that matchers can use.

``weights_manifest.txt`` has one line per file, with columns separated by blanks; ``#`` starts a comment::

    name  bytes  digest  licence  slot  source

``bytes`` is a number or ``?``. ``digest`` is ``sha256:<64 hex>`` or ``unverified``. Matchers request files by
*slot*. Lines of one slot are alternatives: the first file that is found is used.
"""

import errno
import hashlib
import re
import stat
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from mkpc_kaggle.data.outputs import replacing
from mkpc_kaggle.errors import UserError, read_text

MANIFEST = "weights_manifest.txt"
UNVERIFIED = "unverified"
DIGEST = re.compile(rf"sha256:[0-9a-f]{{64}}|{UNVERIFIED}")


@dataclass(frozen=True)
class WeightFile:
    """A line of the manifest; ``size`` in bytes, -1 if unknown."""

    name: str
    size: int
    digest: str
    licence: str
    slot: str
    source: str

    @property
    def line(self) -> str:
        size = "?" if self.size < 0 else str(self.size)
        return "  ".join((self.name, size, self.digest, self.licence, self.slot, self.source))


def parse_manifest(text: str, where: str = "the weights manifest") -> tuple[WeightFile, ...]:
    """Parse all lines of a manifest; raise :class:`UserError` with the number of an invalid line."""
    numbered = enumerate(text.splitlines(), start=1)
    lines = ((number, line.partition("#")[0].split(maxsplit=5)) for number, line in numbered)
    return tuple(
        _parse_line(columns, f"{where}, line {number}") for number, columns in lines if columns
    )


def read_manifest(path: Path) -> tuple[WeightFile, ...]:
    """Read a manifest file; raises :class:`UserError` if it cannot be read."""
    return parse_manifest(read_text(path), str(path))


@cache
def manifest() -> tuple[WeightFile, ...]:
    """Return the package's manifest: inside the package in a wheel, next to the package in a
    checkout.
    """
    package = Path(__file__).resolve().parents[1]
    for path in (package / MANIFEST, package.parent / MANIFEST):
        if path.is_file():
            return read_manifest(path)
    raise UserError(f"{MANIFEST} is missing from {package}: install the package again")


def pin(file: WeightFile, path: Path) -> None:
    """Add the line of ``file``, with the size and digest of ``path``, to the manifest next to
    ``path``.
    """
    pinned = replace(file, size=path.stat().st_size, digest=digest_of(path))
    own = path.with_name(MANIFEST)
    former = own.read_text(encoding="utf-8") if own.is_file() else ""
    with replacing(own) as stream:
        stream.write(f"{former}{pinned.line}\n")


def digest_of(path: Path) -> str:
    """Return ``sha256:<hex>`` of a file, or of the names and contents of all files in a directory.

    The digest of a file is cached for the process. Raises ``OSError`` if a file cannot be read.
    """
    if path.is_dir():
        files = sorted(file for file in path.rglob("*") if file.is_file())
        lines = (f"{digest_of(file)[7:]} {file.relative_to(path).as_posix()}\n" for file in files)
        return f"sha256:{hashlib.sha256(''.join(lines).encode()).hexdigest()}"
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return _file_digest(path.resolve(), status.st_size, status.st_mtime_ns)


@cache
# Size and time are part of the cache's key
def _file_digest(path: Path, _size: int, _modified_ns: int) -> str:
    with path.open("rb") as stream:
        return f"sha256:{hashlib.file_digest(stream, 'sha256').hexdigest()}"


def _parse_line(columns: list[str], where: str) -> WeightFile:
    if len(columns) != 6:
        raise UserError(f"{where}: expected 6 columns, found {len(columns)}")
    name, size, digest, licence, slot, source = columns
    if Path(name).name != name or name.startswith(".") or not "".join(columns).isprintable():
        raise UserError(f"{where}: {name!r} is not a plain file name")
    if size != "?" and not re.fullmatch("[0-9]{1,18}", size):
        raise UserError(f"{where}: bytes must be a number or '?', not {size[:20]!r}")
    if not DIGEST.fullmatch(digest):
        raise UserError(
            f"{where}: digest must be 'sha256:' with 64 hex digits or '{UNVERIFIED}', not {digest!r}"
        )
    return WeightFile(name, -1 if size == "?" else int(size), digest, licence, slot, source.strip())
