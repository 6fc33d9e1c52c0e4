"""A stand-in for Kaggle's image, an environment with its packages and none of ours; and Kaggle's
uploads.
"""

import os
import re
import shutil
import sys
import venv
from collections.abc import Sequence
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path
from zipfile import ZipFile, is_zipfile

BESIDE = ("matplotlib", "ipykernel", "nbclient", "nbformat")
# Kaggle unpacks archives, as torch's checkpoints are
UNPACKED = (".zip", ".tar", ".gz", ".pt", ".pth", ".ckpt")
PACKAGES = ("numpy", "scipy", "scikit-learn", "opencv-python-headless", "torch", "pip")
PACKAGES += ("pandas", "tqdm", *BESIDE)


def upload(folder: Path, mount: Path) -> None:
    """Copy a folder as Kaggle uploads it: sub-folders are dropped, archives become directories."""
    mount.mkdir(parents=True)
    for path in folder.iterdir():
        if path.suffix in UNPACKED and is_zipfile(path):
            with ZipFile(path) as archive:
                archive.extractall(mount / path.name)
        elif path.is_file():
            shutil.copyfile(path, mount / path.name)


def make_image(directory: Path) -> Path:
    """An environment with links to this interpreter's copies of the packages; its interpreter."""
    # Links, because a copy of torch takes a minute and gigabytes.
    venv.create(directory, symlinks=True)
    site = next(directory.glob("lib/python*/site-packages"))
    for installed in closure(PACKAGES).values():
        for entry in {file.parts[0] for file in installed.files or ()} - {
            "..",
            "__pycache__",
        }:
            link = site / entry
            if not link.is_symlink():
                link.symlink_to(Path(str(installed.locate_file(entry))))
    return directory / "bin" / "python"


def closure(names: Sequence[str]) -> dict[str, Distribution]:
    """Return the named distributions and the installed ones that they need, by name."""
    found = {}
    waiting = list(names)
    while waiting:
        name = waiting.pop()
        key = re.sub(r"[-_.]+", "-", name).lower()
        try:
            here = distribution(name)
        except PackageNotFoundError:  # needed on other systems or Pythons alone
            continue
        if key not in found:
            found[key] = here
            plain = [text for text in here.requires or () if "extra ==" not in text]
            waiting += [re.split(r"[^A-Za-z0-9._-]", text, maxsplit=1)[0] for text in plain]
    return found


def pack_wheel(name: str, directory: Path) -> Path:
    """The wheel that an installed distribution came from, but for the order and dates of its
    entries.
    """
    installed = distribution(name)
    tags = re.findall(r"^Tag: (.*)$", installed.read_text("WHEEL") or "", re.MULTILINE)
    columns = zip(*(tag.split("-") for tag in tags), strict=True)
    pythons, abis, platforms = (".".join(dict.fromkeys(column)) for column in columns)
    stem = f"{installed.name.replace('-', '_')}-{installed.version}"
    path = directory / f"{stem}-{pythons}-{abis}-{platforms}.whl"
    written_by_pip = ("INSTALLER", "REQUESTED", "direct_url.json")
    with ZipFile(path, "w") as archive:
        for file in installed.files or ():
            is_outside = file.parts[0] == ".."  # such as a program in bin
            is_made = "__pycache__" in file.parts or file.name in written_by_pip
            if not is_outside and not is_made:
                archive.write(Path(str(installed.locate_file(file))), str(file))
    return path


def environment(**more: str) -> dict[str, str]:
    """Return this process's environment without paths of its packages and without pytest's names."""
    hidden = ("PYTHONPATH", "VIRTUAL_ENV", "MKPC_WEIGHTS", "PYTEST_CURRENT_TEST")
    kept = {name: value for name, value in os.environ.items() if name not in hidden}
    return {**kept, "PYTHONNOUSERSITE": "1", **more}


def python_version() -> str:
    return f"{sys.version_info.major}.{sys.version_info.minor}"
