"""Downloads files of the manifest: resumed after interruptions, renamed once their digest is verified."""

import re
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from http.client import HTTPException
from pathlib import Path
from ssl import SSLError
from typing import IO, Any
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit
from urllib.request import (
    HTTPDefaultErrorHandler,
    HTTPErrorProcessor,
    HTTPHandler,
    HTTPRedirectHandler,
    HTTPSHandler,
    OpenerDirector,
    ProxyHandler,
    Request,
)

from tqdm import tqdm

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.weights.digests import file_digests
from mkpc_kaggle.weights.found import State, examine
from mkpc_kaggle.weights.manifest import UNVERIFIED, WeightFile

ATTEMPTS = 5
TIMEOUT = 30.0
"""Seconds without a byte."""
BLOCK = 1 << 20
WEB_PAGE_HOSTS = ("drive.google.com",)
"""Hosts that answer with a web page instead of the file."""
CONNECTION_ERRORS = (URLError, ConnectionError, TimeoutError, HTTPException, SSLError)
TRANSIENT_STATUSES = (408, 425, 429, 500, 502, 503, 504)
"""HTTP status codes after which a retry may succeed."""
RANGE_NOT_SATISFIABLE = 416


class Outcome(StrEnum):
    """The outcome of fetching a file."""

    FETCHED = "fetched"
    ALREADY_THERE = "already there"
    BY_HAND = "by hand"
    FAILED = "failed"


@dataclass(frozen=True)
class Fetched:
    """``note`` says why it failed, what to do by hand, or the digest of an unverified file."""

    file: WeightFile
    path: Path
    outcome: Outcome
    note: str = ""


def url_of(file: WeightFile) -> str | None:
    """Where the file can be downloaded as it is, or ``None``."""
    url = file.source.split()[0]
    parts = urlsplit(url)
    return url if parts.scheme in ("http", "https") and parts.hostname not in WEB_PAGE_HOSTS else None


def choose(alternatives: Sequence[WeightFile], directory: Path) -> WeightFile:
    """Of the lines of one slot: one whose file is there, else one that can be downloaded, else the first."""
    there = [file for file in alternatives if _state(file, directory).usable]
    return next(iter(there + [file for file in alternatives if url_of(file)] + list(alternatives)))


def fetch(file: WeightFile, directory: Path, *, wait: Callable[[float], None] = time.sleep) -> Fetched:
    """Download the file into the directory, which is created. A partial download stays in ``NAME.part``.

    ``wait`` is called with the seconds to pause before another attempt.
    """
    path = directory / file.name
    if _state(file, directory).usable:
        return Fetched(file, path, Outcome.ALREADY_THERE)
    url = url_of(file)
    if url is None:
        return Fetched(file, path, Outcome.BY_HAND, f"get it from {file.source} and save it as {path}")
    try:
        directory.mkdir(parents=True, exist_ok=True)
        part = PartialFile(path, file)
        _download(url, part, wait)
        note = part.finish()
    except UserError as error:
        return Fetched(file, path, Outcome.FAILED, str(error))
    except OSError as error:
        return Fetched(file, path, Outcome.FAILED, f"{path} cannot be written: {error.strerror}")
    return Fetched(file, path, Outcome.FETCHED, note)


def _state(file: WeightFile, directory: Path) -> State:
    return examine(directory / file.name, file, ()).state


class PartialFile:
    """A partial download, ``NAME.part``, and the HTTP validator (ETag or date) of its version."""

    def __init__(self, path: Path, file: WeightFile) -> None:
        self.path = path
        self.file = file
        self._data = path.with_name(f"{path.name}.part")
        self._validator_file = path.with_name(f"{path.name}.part.mark")
        if 0 <= file.size < self.size:
            self.remove()

    @property
    def size(self) -> int:
        return self._data.stat().st_size if self._data.exists() else 0

    @property
    def complete(self) -> bool:
        """All bytes are here, by the size in the manifest."""
        return self.file.size == self.size

    @property
    def range_headers(self) -> dict[str, str]:
        """Headers that ask for the rest; empty where nothing would show that the rest fits."""
        validator = self._validator_file.read_text(encoding="latin-1") if self._validator_file.exists() else ""
        if self.size == 0 or not (validator or self.file.digest != UNVERIFIED):
            return {}
        return {"Range": f"bytes={self.size}-"} | ({"If-Range": validator} if validator else {})

    def begin(self, validator: str, *, resumed: bool) -> IO[bytes]:
        """The file to write to, appending if ``resumed``."""
        self._validator_file.write_text(validator, encoding="latin-1")
        return self._data.open("ab" if resumed else "wb")

    def remove(self) -> None:
        self._data.unlink(missing_ok=True)
        self._validator_file.unlink(missing_ok=True)

    def finish(self) -> str:
        """Verify the bytes and give the file its name; on a mismatch remove them and raise :class:`UserError`."""
        digests = file_digests(self._data)
        file = self.file
        if 0 <= file.size != digests.size:
            self.remove()
            raise UserError(f"{digests.size} bytes came, the manifest says {file.size}; they were removed")
        if file.digest != UNVERIFIED and not digests.have(file.digest):
            self.remove()
            raise UserError(
                f"what came has the digest {digests.sha256}, the manifest says {file.digest}: not the file that "
                "the matchers were tested with; it was removed"
            )
        self._data.replace(self.path)
        self.remove()
        if file.digest == UNVERIFIED:
            return f"not verified: the manifest has no digest for it; this file's is {digests.sha256}"
        return ""


class _IncompleteError(ConnectionError):
    """The connection ended before the file did."""


class _HttpRedirectHandler(HTTPRedirectHandler):
    """Follows redirections to http and https alone, and never from https to http."""

    def redirect_request(
        self, req: Request, fp: IO[bytes], code: int, msg: str, headers: Any, newurl: str
    ) -> Request | None:
        scheme = urlsplit(newurl).scheme
        if scheme not in ("http", "https") or (req.type == "https" and scheme == "http"):
            raise UserError(f"{req.full_url} redirects to {newurl}, which is not followed")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _opener() -> OpenerDirector:
    """Opens http and https only; urllib's default opener would open files too."""
    opener = OpenerDirector()
    handlers = (
        ProxyHandler,
        HTTPHandler,
        HTTPSHandler,
        HTTPDefaultErrorHandler,
        HTTPErrorProcessor,
        _HttpRedirectHandler,
    )
    for handler in handlers:
        opener.add_handler(handler())
    return opener


def _download(url: str, part: PartialFile, wait: Callable[[float], None]) -> None:
    """Request until the file is complete; raises :class:`UserError` where a retry cannot help or all failed."""
    last_error: Exception | None = None
    for attempt in range(ATTEMPTS):
        if last_error is not None:
            wait(2.0 ** (attempt - 1))
        try:
            if part.complete or _receive(url, part):
                return
        except HTTPError as error:
            error.close()
            if error.code not in TRANSIENT_STATUSES:
                raise UserError(f"{url}: the server says {error.code} {error.reason}") from error
            last_error = error
        except CONNECTION_ERRORS as error:
            last_error = error
    raise UserError(
        f"{url}: the connection failed {ATTEMPTS} times (the last time: {last_error}). What came is kept: "
        "the same command goes on there."
    )


def _receive(url: str, part: PartialFile) -> bool:
    """One request for what is missing; whether the file is now complete. Raises on a broken connection."""
    request = Request(url, headers={"User-Agent": "mkpc_kaggle", **part.range_headers})
    try:
        response = _opener().open(request, timeout=TIMEOUT)
    except HTTPError as error:
        if error.code != RANGE_NOT_SATISFIABLE or part.size == 0:
            raise
        error.close()
        if error.headers.get("Content-Range") == f"bytes */{part.size}":
            return True
        part.remove()  # these bytes belong to another version
        return False
    with response:
        have = part.size if _is_partial_content(response, part) else 0
        total = None if response.length is None else have + response.length
        _check_total(total, have, part)
        _store(response, part, have, total)
    if total is not None and part.size != total:
        raise _IncompleteError(f"it broke off after {part.size} of {total} bytes")
    return True


def _is_partial_content(response: Any, part: PartialFile) -> bool:
    """Whether the server sends the missing range, and not the complete file again."""
    if response.status != 206:
        return False
    first = re.match(r"bytes (\d+)-", response.headers.get("Content-Range", ""))
    if first is None or int(first[1]) != part.size:
        part.remove()
        raise _IncompleteError("the server sent another part than was asked for")
    return True


def _check_total(total: int | None, have: int, part: PartialFile) -> None:
    if total is None:
        return
    if 0 <= part.file.size != total:
        part.remove()
        raise UserError(f"the server's file has {total} bytes, the manifest says {part.file.size}: another file")
    free = shutil.disk_usage(part.path.parent).free + part.size - have
    if total - have > free:
        raise UserError(f"{total - have} bytes are to come, but {part.path.parent} has only {free} bytes free")


def _store(response: Any, part: PartialFile, have: int, total: int | None) -> None:
    tag = response.headers.get("ETag", "")
    validator = response.headers.get("Last-Modified", "") if not tag or tag.startswith("W/") else tag
    with (
        part.begin(validator, resumed=have > 0) as out,
        tqdm(
            desc=part.file.name,
            initial=have,
            total=total,
            unit="B",
            unit_scale=True,
            unit_divisor=1024,
            mininterval=0.1 if sys.stderr.isatty() else 30,  # a log file gets a line for each update
        ) as progress,
    ):
        while block := response.read(BLOCK):
            out.write(block)
            progress.update(len(block))
