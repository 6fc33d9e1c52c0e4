"""Wheels: our own, built from the checkout, and those of the dependencies that Kaggle's image may lack."""

import re
import subprocess
import sys
import zipfile
from collections.abc import Iterable, Sequence
from email.message import Message
from email.parser import Parser
from importlib.util import find_spec
from pathlib import Path

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.package.checkout import Checkout

BUNDLED = (
    "kornia",
    "kornia-rs",
    "pycolmap",
    "safetensors",
)
"""Direct and indirect dependencies that Kaggle's image may lack or have in a version that is too old.
The others (torch, numpy, scipy, pandas, scikit-learn, OpenCV, matplotlib, tqdm) are in the image."""
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
"""Versions in Kaggle's images, pinned older ones included, and likely next ones."""
PLATFORMS = ("manylinux_2_28_x86_64", "manylinux_2_17_x86_64", "manylinux2014_x86_64")


def pins(checkout: Checkout) -> tuple[str, ...]:
    """``name==version`` of each bundled package, the version being the one that the tests run with."""
    lines = checkout.pins.read_text(encoding="utf-8").splitlines()
    pinned = dict(_pin(line) for line in lines if line and not line.startswith("#"))
    return tuple(f"{name}=={pinned[name]}" for name in BUNDLED)


def install_lines(own: Path, wheels: Iterable[Path]) -> tuple[str, ...]:
    """What the notebook installs: our wheel, and the ranges of bundled packages that the wheels require.

    A version of the image within the range stays, whether there is a wheel for its Python or not.
    """
    version = _metadata(own)["Version"]
    asked = (line for wheel in (own, *wheels) for line in _metadata(wheel).get_all("Requires-Dist", []))
    plain = (line.partition(";")[0].strip() for line in asked if "extra ==" not in line)
    bundled = (
        line for line in plain if _canonical_name(re.split(r"[^A-Za-z0-9._-]", line, maxsplit=1)[0]) in BUNDLED
    )
    return (f"mkpc-kaggle=={version}", *sorted(set(bundled)))


def build_wheel(checkout: Checkout, directory: Path) -> Path:
    """Build our wheel into the directory; the same sources give the same bytes. Raises :class:`UserError`."""
    # If hatchling is not installed, pip downloads it for the build.
    isolation = ["--no-build-isolation"] if find_spec("hatchling") else []
    failure = _pip("wheel", "--no-deps", *isolation, "--wheel-dir", directory, checkout.root)
    if failure:
        raise UserError(f"the wheel could not be built from {checkout.root}: {failure}")
    return next(directory.glob("mkpc_kaggle-*.whl"))


def collect_wheels(
    requirements: Sequence[str], pythons: Iterable[str], directory: Path, *, kept: Path, wheels: Path | None
) -> list[Path]:
    """The wheels of these requirements for these Python versions (``3.11``), in order of their names.

    They come from the directory ``wheels`` if given; else from ``kept``, the output of an earlier run, or, if one
    is missing there, from pip's index. Raises :class:`UserError` where one is not found.
    """
    local = ("--no-index", "--find-links")
    sources: list[tuple[str | Path, ...]] = [(*local, wheels)] if wheels else [(*local, kept), ()]
    for python in pythons:
        failure = ""
        for source in sources:
            failure = _download(requirements, python, directory, source)
            if not failure:
                break
        else:
            raise UserError(
                f"no wheels of {', '.join(requirements)} for Python {python} on Linux x86-64"
                + (f" in {wheels}" if wheels else "")
                + f": {failure}. On a machine without internet, name a directory that has them with --wheels."
            )
    return sorted(directory.glob("*.whl"))


def licence_of(wheel: Path) -> str:
    """The licence that a wheel's metadata names."""
    headers = _metadata(wheel)
    classifiers = [text.rpartition(" :: ")[2] for text in headers.get_all("Classifier", []) if "License" in text]
    named = [headers["License-Expression"], headers["License"], *classifiers]
    return next(filter(None, named), "see its dist-info/licenses")


def _metadata(wheel: Path) -> Message:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if re.fullmatch(r"[^/]+\.dist-info/METADATA", name))
        return Parser().parsestr(archive.read(name).decode())


def _download(requirements: Sequence[str], python: str, directory: Path, source: Sequence[str | Path]) -> str:
    platforms = [option for platform in PLATFORMS for option in ("--platform", platform)]
    only_these = ("--only-binary=:all:", "--no-deps", "--python-version", python)
    return _pip("download", *only_these, *platforms, "--dest", directory, *source, *requirements)


def _pip(*arguments: str | Path) -> str:
    """Run this interpreter's pip; the reason if it failed, else empty."""
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return ""
    lines = [line.removeprefix("ERROR: ") for line in done.stderr.splitlines() if line.strip()]
    return lines[-1] if lines else f"pip ended with status {done.returncode}"


def _pin(line: str) -> tuple[str, str]:
    name, _, version = line.strip().partition("==")
    return _canonical_name(name), version


def _canonical_name(name: str) -> str:
    """A package's name as the index compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()
