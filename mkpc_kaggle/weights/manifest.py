"""The weights manifest: all files that matchers can use.

``weights_manifest.txt`` has one line per file, with columns separated by blanks; ``#`` starts a
comment::

    name  bytes  digest  licence  slot  source

``bytes`` is a number or ``?``. ``digest`` is ``sha256:<64 hex>`` or ``unverified``. Matchers ask
for files by *slot*. Lines of one slot are alternatives: the first usable one is used.
"""

import errno
import hashlib
import os
import re
import stat
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from mkpc_kaggle.data.outputs import replacing
from mkpc_kaggle.errors import UserError, read_text
from mkpc_kaggle.progress import counted

MANIFEST = "weights_manifest.txt"
UNVERIFIED = "unverified"
DIGEST = re.compile(rf"sha256:[0-9a-f]{{64}}|{UNVERIFIED}")
BLOCK_BYTES = 1 << 20
# Names a file in which processes that follow each other keep digests: 3 GB take half a minute.
DIGESTS = "MKPC_DIGESTS"


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
    def shown_source(self) -> str:
        """The source in messages: an address, or a wheel."""
        return self.source.replace(" wheel:", " or wheel:")

    @property
    def line(self) -> str:
        """The line of a manifest, which :func:`parse_manifest` reads."""
        size = "?" if self.size < 0 else str(self.size)
        columns = (self.name, size, self.digest, self.licence, self.slot, self.source)
        return "  ".join(columns)


def parse_manifest(text: str, where: str = "the weights manifest") -> tuple[WeightFile, ...]:
    """Parse a manifest. Raise :class:`UserError` with the number of an invalid line."""
    files = []
    for number, line in enumerate(text.splitlines(), start=1):
        # The last column, the source, may contain blanks.
        columns = line.partition("#")[0].split(maxsplit=5)
        if columns:
            files.append(_parse_line(columns, f"{where}, line {number}"))
    return tuple(files)


def read_manifest(path: Path) -> tuple[WeightFile, ...]:
    """Read a manifest file; raises :class:`UserError` if it cannot be read."""
    return parse_manifest(read_text(path), str(path))


@cache
def manifest() -> tuple[WeightFile, ...]:
    """Return the package's manifest: inside the package in a wheel, next to it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    for path in (package / MANIFEST, package.parent / MANIFEST):
        if path.is_file():
            return read_manifest(path)
    raise UserError(f"{MANIFEST} is missing from {package}: install the package again")


def pin(file: WeightFile, path: Path) -> None:
    """Add ``file``, with the size and digest of ``path``, to the manifest next to ``path``."""
    # The whole text is written again: an append could be cut in the middle of a line.
    pinned = replace(file, size=path.stat().st_size, digest=digest_of(path))
    own = path.with_name(MANIFEST)
    former = own.read_text(encoding="utf-8") if own.is_file() else ""
    with replacing(own) as stream:
        stream.write(f"{former}{pinned.line}\n")


def digest_of(path: Path) -> str:
    """Return ``sha256:<hex>`` of a file, or of the names and contents of all files in a directory.

    The digest of a file is cached for the process, and in the file that ``$MKPC_DIGESTS`` names.
    Raises ``OSError`` if a file cannot be read.
    """
    if path.is_dir():
        lines = []
        for file in sorted(file for file in path.rglob("*") if file.is_file()):
            hexadecimal = digest_of(file).removeprefix("sha256:")
            lines.append(f"{hexadecimal} {file.relative_to(path).as_posix()}\n")
        return f"sha256:{hashlib.sha256(''.join(lines).encode()).hexdigest()}"
    status = path.stat()
    # A pipe or a device may never end.
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return _file_digest(path.resolve(), status.st_size, status.st_mtime_ns)


@cache
def _file_digest(path: Path, size: int, modified_ns: int) -> str:
    """Return the digest of a file; size and time of change are part of the cache's key."""
    key = f"{size} {modified_ns} {path}"
    if found := _former_digests().get(key):
        return found
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        for start in counted(range(0, max(size, 1), BLOCK_BYTES), f"digest of {path.name}", "MiB"):
            stream.seek(start)
            digest.update(stream.read(BLOCK_BYTES))
    found = f"sha256:{digest.hexdigest()}"
    _keep_digest(f"{found} {key}")
    return found


def _former_digests() -> dict[str, str]:
    """Return digests of earlier processes, by size, time of change and path."""
    kept: dict[str, str] = {}
    with suppress(OSError):
        for line in Path(os.environ.get(DIGESTS, "")).read_bytes().splitlines():
            digest, _, key = os.fsdecode(line).partition(" ")
            kept[key] = digest
    return kept


def _keep_digest(line: str) -> None:
    """Append a line to the file that later processes read, if ``$MKPC_DIGESTS`` names one."""
    path = os.environ.get(DIGESTS)
    if path:
        with suppress(OSError):  # a full disk: the next process computes it again
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            with Path(path).open("ab") as stream:
                stream.write(os.fsencode(f"{line}\n"))


def _parse_line(columns: list[str], where: str) -> WeightFile:
    """Return the file of a line's columns. Raise :class:`UserError` for an invalid column."""
    if len(columns) != 6:
        raise UserError(f"{where}: expected 6 columns, found {len(columns)}")
    name, size, digest, licence, slot, source = columns
    # A name must not lead out of the directory, nor hide, nor control a terminal.
    is_plain = Path(name).name == name and not name.startswith(".")
    if not is_plain or not "".join(columns).isprintable():
        raise UserError(f"{where}: {name!r} is not a plain file name")
    if size != "?" and not re.fullmatch("[0-9]{1,18}", size):
        raise UserError(f"{where}: bytes must be a number or '?', not {size[:20]!r}")
    if not DIGEST.fullmatch(digest):
        raise UserError(
            f"{where}: digest must be 'sha256:' with 64 hex digits or '{UNVERIFIED}', not {digest!r}"
        )
    number = -1 if size == "?" else int(size)
    return WeightFile(name, number, digest, licence, slot, source.strip())
