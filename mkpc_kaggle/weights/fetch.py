"""Downloads files of the manifest: resumed after interruptions, renamed once their digest is verified."""

import re
import shutil
import stat
import sys
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from queue import Empty, Queue
from threading import Thread
from typing import IO, Any
from urllib.error import HTTPError
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
LEAST_SPEED = 10_000.0
"""Bytes a second, once ``TIMEOUT`` is over; a slower connection counts as broken."""
LARGEST = 1 << 33
"""Bytes of a file whose size the manifest does not know."""
LONGEST_VALIDATOR = 200
BLOCK = 1 << 20
WEB_PAGE_HOSTS = ("drive.google.com",)
"""Hosts that answer with a web page instead of the file."""
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
    """Download the file into the directory, which is created.

    A partial download stays in ``NAME.part``. It is continued where something tells whether the rest is of the
    same file: the manifest's digest, or the server's validator, which is kept in ``NAME.part.mark``. ``wait`` is
    called with the seconds to pause before another attempt.
    """
    path = directory / file.name
    if _state(file, directory).usable:
        return Fetched(file, path, Outcome.ALREADY_THERE)
    url = url_of(file)
    if url is None:
        return Fetched(file, path, Outcome.BY_HAND, f"get it from {file.source} and save it as {path}")
    part = path.with_name(f"{path.name}.part")
    try:
        directory.mkdir(parents=True, exist_ok=True)
        if not (_size_of(part) and file_digests(part).have(file.digest)):
            _download(url, part, file, wait)
        note = _verify(part, file)
        part.replace(path)
        _remove(part)
    except UserError as error:
        return Fetched(file, path, Outcome.FAILED, str(error))
    except OSError as error:
        return Fetched(file, path, Outcome.FAILED, f"{path} cannot be written: {error.strerror}")
    return Fetched(file, path, Outcome.FETCHED, note)


def _state(file: WeightFile, directory: Path) -> State:
    return examine(directory / file.name, file, ()).state


def _size_of(part: Path) -> int:
    """Bytes of the partial download; what is no regular file is removed, and no link is followed."""
    try:
        status = part.lstat()
    except FileNotFoundError:
        return 0
    if not stat.S_ISREG(status.st_mode):
        part.unlink()
        return 0
    return status.st_size


def _mark_of(part: Path) -> Path:
    return part.with_name(f"{part.name}.mark")


def _remove(part: Path) -> None:
    for path in (part, _mark_of(part)):
        path.unlink(missing_ok=True)


def _range_headers(part: Path, have: int, file: WeightFile) -> dict[str, str]:
    """Headers that ask for the rest; empty where nothing would show that the rest fits."""
    mark = _mark_of(part)
    validator = mark.read_text(encoding="latin-1") if 0 < _size_of(mark) <= LONGEST_VALIDATOR else ""
    if not re.fullmatch(r"[ -~]+", validator):  # what is sent must be one line
        validator = ""
    if not 0 < have < _most_bytes(file) or (not validator and file.digest == UNVERIFIED):
        return {}
    return {"Range": f"bytes={have}-"} | ({"If-Range": validator} if validator else {})


def _verify(part: Path, file: WeightFile) -> str:
    """What to say of the complete download; where it is another file, remove it and raise :class:`UserError`."""
    digests = file_digests(part)
    if file.digest == UNVERIFIED and file.size in (-1, digests.size):
        return f"not verified: the manifest has no digest for it; this file's is {digests.sha256}"
    if digests.have(file.digest):
        return ""
    _remove(part)
    raise UserError(
        f"what came has {digests.size} bytes and the digest {digests.sha256}, the manifest says {file.digest}: "
        "not the file that the matchers were tested with; it was removed"
    )


@dataclass(frozen=True)
class _Head:
    """Of a server's answer; ``length`` of the body in bytes, ``None`` where it is not told; ``validator``: the
    ETag or date by which the server knows this version of the file.
    """

    status: int
    content_range: str
    length: int | None
    validator: str

    @classmethod
    def of(cls, response: Any) -> "_Head":
        tag = response.headers.get("ETag", "")
        validator = response.headers.get("Last-Modified", "") if not tag or tag.startswith("W/") else tag
        return cls(response.status, response.headers.get("Content-Range", ""), response.length, validator)


class _BrokenConnectionError(Exception):
    """Another attempt may succeed."""


class _HttpRedirectHandler(HTTPRedirectHandler):
    """Follows redirections to http and https alone, and never from https to http."""

    def redirect_request(
        self, req: Request, fp: IO[bytes], code: int, msg: str, headers: Any, newurl: str
    ) -> Request | None:
        scheme = newurl.partition(":")[0]
        if scheme not in ("http", "https") or (req.type == "https" and scheme == "http"):
            fp.close()
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


def _download(url: str, part: Path, file: WeightFile, wait: Callable[[float], None]) -> None:
    """Request until the file is complete; raises :class:`UserError` where a retry cannot help or all failed."""
    last_error: Exception | None = None
    for attempt in range(ATTEMPTS):
        if last_error is not None:
            wait(2.0 ** (attempt - 1))
        try:
            return _receive(url, part, file)
        except _BrokenConnectionError as error:
            last_error = error
    raise UserError(
        f"{url}: the connection failed {ATTEMPTS} times (the last time: {last_error}). What came is kept: "
        "the same command goes on there."
    )


def _receive(url: str, part: Path, file: WeightFile) -> None:
    """One request for what is missing."""
    have = _size_of(part)
    wanted = _range_headers(part, have, file)
    answer = _answer(Request(url, headers={"User-Agent": "mkpc_kaggle", **wanted}))
    with closing(answer):
        try:
            head = next(answer)
        except HTTPError as error:
            error.close()
            if error.code == RANGE_NOT_SATISFIABLE and wanted:
                _remove(part)  # these bytes belong to another version
            elif error.code not in TRANSIENT_STATUSES:
                raise UserError(f"{url}: the server says {error.code} {error.reason}") from error
            raise _BrokenConnectionError(f"{error.code} {error.reason}") from error
        assert isinstance(head, _Head)
        have = have if wanted and _is_partial_content(head, part, have) else 0
        total = None if head.length is None else have + head.length
        _check_total(total, have, part, file)
        _mark_of(part).write_text(head.validator, encoding="latin-1")
        have = _store(answer, part, have, total, file)
    if total is not None and have < total:
        raise _BrokenConnectionError(f"it broke off after {have} of {total} bytes")


def _answer(request: Request) -> Generator[_Head | bytes, None, None]:
    """The head of the answer, then its body in blocks.

    They are read in a thread: a server that sends a byte now and then keeps a socket's own timeout from passing.
    """
    arrived: Queue[_Head | bytes | Exception] = Queue(maxsize=2)

    def read() -> None:
        try:
            with _opener().open(request, timeout=TIMEOUT) as response:
                arrived.put(_Head.of(response))
                while block := response.read1(BLOCK):
                    arrived.put(block)
                arrived.put(b"")
        except Exception as error:
            arrived.put(error)

    Thread(target=read, daemon=True).start()
    begun, size = time.monotonic(), 0
    while True:
        last = begun + TIMEOUT + size / LEAST_SPEED
        try:
            one = arrived.get(timeout=max(0.0, last - time.monotonic()))
        except Empty:
            raise _BrokenConnectionError(f"{size} bytes came in {time.monotonic() - begun:.0f} s") from None
        if isinstance(one, (HTTPError, UserError)):
            raise one
        if isinstance(one, (ValueError, OverflowError)):  # as urllib says of malformed addresses and chunks
            raise UserError(f"{request.full_url}: the server's answer cannot be read: {one}") from one
        if isinstance(one, Exception):
            raise _BrokenConnectionError(f"{one}") from one
        if one == b"":
            return
        size += len(one) if isinstance(one, bytes) else 0
        yield one


def _is_partial_content(head: _Head, part: Path, have: int) -> bool:
    """Whether the server sends the missing range, and not the complete file again."""
    if head.status != 206:
        return False
    first = re.match(r"bytes (\d+)-", head.content_range)
    if first is None or int(first[1]) != have:
        _remove(part)
        raise _BrokenConnectionError("the server sent another part than was asked for")
    return True


def _most_bytes(file: WeightFile) -> int:
    return LARGEST if file.size < 0 else file.size


def _check_total(total: int | None, have: int, part: Path, file: WeightFile) -> None:
    if total is None:
        return
    if 0 <= file.size != total:
        _remove(part)
        raise UserError(f"the server's file has {total} bytes, the manifest says {file.size}: another file")
    free = shutil.disk_usage(part.parent).free + _size_of(part) - have
    if total - have > free:
        raise UserError(f"{total - have} bytes are to come, but {part.parent} has only {free} bytes free")


def _store(answer: Iterator[Any], part: Path, have: int, total: int | None, file: WeightFile) -> int:
    """Write the blocks to the file, after the ``have`` bytes there; the size that it has then."""
    with (
        part.open("ab" if have else "wb") as out,
        tqdm(
            desc=file.name,
            initial=have,
            total=total,
            unit="B",
            unit_scale=True,
            unit_divisor=1024,
            mininterval=0.1 if sys.stderr.isatty() else 30,  # a log file gets a line for each update
        ) as progress,
    ):
        for block in answer:
            have += len(block)
            if have > _most_bytes(file):
                raise UserError(f"more than {_most_bytes(file)} bytes came, the most that {file.name} may have")
            out.write(block)
            progress.update(len(block))
    return have
