"""The digests of a file, both kinds in one pass, cached for the process."""

import hashlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path

BLOCK = 1 << 20


@dataclass(frozen=True)
class Digests:
    """A file's size in bytes, and its digests as the manifest writes them."""

    size: int
    sha256: str
    git_blob: str

    def have(self, digest: str) -> bool:
        return digest in (self.sha256, self.git_blob)


def file_digests(path: Path) -> Digests:
    """The digests of a regular file; raises ``OSError`` where it cannot be read."""
    status = path.stat()
    return _digests(path.resolve(), status.st_size, status.st_mtime_ns)


@cache
def _digests(path: Path, size: int, modified: int) -> Digests:
    """``modified``, in nanoseconds, and ``size`` are part of the cache key: the file may be replaced."""
    sha256 = hashlib.sha256()
    blob = hashlib.sha1(b"blob %d\0" % size, usedforsecurity=False)
    with path.open("rb") as stream:
        while block := stream.read(BLOCK):
            sha256.update(block)
            blob.update(block)
    return Digests(size, f"sha256:{sha256.hexdigest()}", f"git-blob:{blob.hexdigest()}")
