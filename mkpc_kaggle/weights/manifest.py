"""The weights manifest: all files that matchers can use.

``weights_manifest.txt`` is TOML, with a table for each file. Matchers ask for files by *slot*. Files
of one slot are alternatives: the first one that is found is used.
"""

import errno
import hashlib
import stat
import tomllib
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from mkpc_kaggle.config import from_table
from mkpc_kaggle.errors import UserError, read_text

MANIFEST = "weights_manifest.txt"


@dataclass(frozen=True)
class WeightFile:
    """A file of the manifest, with the keys of its table."""

    slot: str
    licence: str
    size: int = 0  # bytes; 0 if unknown
    sha256: str = ""  # hexadecimal; empty if nobody has published it
    url: str = ""  # of a direct download
    wheel: str = ""  # NAME==VERSION/PATH: a file in a wheel of the package index
    source: str = ""  # of a file that is fetched by hand, or made from another one
    name: str = ""  # the table's


def read_manifest(path: Path) -> tuple[WeightFile, ...]:
    """Read a manifest. Raise :class:`UserError` if it cannot be read."""
    try:
        tables = tomllib.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: {error}") from error
    files = []
    for name, table in tables.items():
        file = from_table(WeightFile, table, f"{path}, table {name!r}")
        files.append(replace(file, name=name))
    return tuple(files)


@cache
def manifest() -> tuple[WeightFile, ...]:
    """Return the package's manifest: inside the package in a wheel, next to it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    for path in (package / MANIFEST, package.parent / MANIFEST):
        if path.is_file():
            return read_manifest(path)
    raise UserError(f"{MANIFEST} is missing from {package}: install the package again")


def digest_of(path: Path) -> str:
    """Return the SHA-256 digest of a file, cached for the process. Raise ``OSError``."""
    status = path.stat()
    # A pipe or a device may never end.
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return _file_digest(path.resolve(), status.st_size, status.st_mtime_ns)


@cache
def _file_digest(path: Path, size: int, modified_ns: int) -> str:
    """Return the digest of a file; size and time of change are part of the cache's key."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
