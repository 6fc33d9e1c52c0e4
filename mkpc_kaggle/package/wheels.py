"""Our wheel, built from the checkout, and wheels that may be missing in Kaggle's image."""

import zipfile
from collections.abc import Iterable, Sequence
from email.message import Message
from email.parser import Parser
from importlib.util import find_spec
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.progress import announced, counted
from mkpc_kaggle.weights.wheel import run_pip

# Direct and indirect dependencies that may be missing or too old in Kaggle's image.
BUNDLED = ("kornia", "kornia-rs", "pycolmap", "safetensors")
# Of Kaggle's current, older pinned and probable next images.
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
# pip matches these names exactly: an older wheel has an older name.
PLATFORMS = ("manylinux_2_28_x86_64", "manylinux_2_17_x86_64", "manylinux2014_x86_64")


def pins(checkout: Path) -> tuple[str, ...]:
    """Return ``name==version`` of each bundled package, with the version that the tests use."""
    # A package has several spellings of its name; the canonical one is compared.
    lines = (checkout / "requirements-dev.txt").read_text(encoding="utf-8").splitlines()
    pinned = {canonicalize_name(line.partition("==")[0]): line for line in lines}
    return tuple(pinned[canonicalize_name(name)] for name in BUNDLED)


def install_lines(own: Path, wheels: Iterable[Path]) -> tuple[str, ...]:
    """Return the notebook's requirements: our wheel, and version ranges of bundled packages.

    The wheels set the ranges. If the image has a version within the range, pip keeps
    it, even without a wheel for the image's Python.
    """
    bundled = set()
    for wheel in (own, *wheels):
        for line in _metadata(wheel).get_all("Requires-Dist", []):
            need = Requirement(line)
            name = canonicalize_name(need.name)
            if name in BUNDLED and "extra" not in str(need.marker):
                bundled.add(f"{name}{need.specifier}")
    return (f"mkpc-kaggle=={_metadata(own)['Version']}", *sorted(bundled))


def build_wheel(checkout: Path, directory: Path) -> Path:
    """Build our wheel into the directory; the same sources give the same bytes.

    Raises :class:`UserError` with pip's reason.
    """
    # If hatchling is not installed, pip downloads it for the build.
    isolation = ["--no-build-isolation"] if find_spec("hatchling") else []
    with announced("building the wheel of this checkout with pip"):
        failure = run_pip("wheel", "--no-deps", *isolation, "--wheel-dir", directory, checkout)
    if failure:
        raise UserError(f"the wheel could not be built from {checkout}: {failure}")
    return next(directory.glob("mkpc_kaggle-*.whl"))


def collect_wheels(
    requirements: Sequence[str],
    pythons: Iterable[str],
    directory: Path,
    *,
    kept: Path,
    wheels: Path | None,
) -> list[Path]:
    """Collect the wheels of these requirements for Python versions such as ``3.11``.

    Wheels are ordered by name. The source is the directory ``wheels``, if given. Otherwise
    ``kept``, the output of an earlier run, is tried before pip's index. Raises :class:`UserError`
    if a wheel is not found.
    """
    # The former output first: a second run then needs no network.
    local = ("--no-index", "--find-links", str(wheels or kept))
    sources = [local] if wheels else [local, ()]
    platforms = [option for platform in PLATFORMS for option in ("--platform", platform)]
    options = ["--only-binary=:all:", "--no-deps", *platforms, "--dest", str(directory)]
    for python in counted([*pythons], "wheels by pip", "Python"):
        download = ("download", *options, "--python-version", python)
        for source in sources:
            failure = run_pip(*download, *source, *requirements)
            if not failure:
                break
        else:
            there = f" in {wheels}" if wheels else ""
            raise UserError(
                f"no wheels of {', '.join(requirements)} for Python {python} on Linux x86-64{there}: "
                f"{failure}. On a machine without internet, give a directory of wheels with --wheels."
            )
    return sorted(directory.glob("*.whl"))


def licence_of(wheel: Path) -> str:
    """Return the licence that a wheel states, in the new or the old field."""
    headers = _metadata(wheel)
    return str(headers["License-Expression"] or headers["License"] or "see its dist-info/licenses")


def _metadata(wheel: Path) -> Message:
    """Return the headers of a wheel's METADATA."""
    name, version = wheel.name.split("-")[:2]
    with zipfile.ZipFile(wheel) as archive:
        return Parser().parsestr(archive.read(f"{name}-{version}.dist-info/METADATA").decode())
