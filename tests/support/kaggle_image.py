"""Stand-ins for Kaggle's images, environments with the packages that they have and none of ours; and its uploads.

The quick environment links this interpreter's packages; the table's are installed from pip's index.
"""

import os
import re
import shutil
import subprocess
import sys
import venv
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path
from zipfile import ZipFile, is_zipfile


@dataclass(frozen=True)
class Image:
    """What an image of Kaggle's has: Python's version, and those of the packages that we take from it."""

    python: str
    versions: tuple[str, ...]

    def __str__(self) -> str:
        return "-".join([self.python, *self.versions[:1], *self.versions[2:3]])


NEWER = ("opencv-python-headless==4.13.0.92", "scikit-learn==1.6.1", "pandas==2.2.3", "scipy==1.15.3")
OLDER = ("opencv-python-headless==4.11.0.86", "scikit-learn==1.6.1", "pandas==2.2.3", "scipy==1.15.3")
OPENCV_5 = ("opencv-python-headless==5.0.0.93", *NEWER[1:])
IMAGES = (
    Image("3.11", ("torch==2.6.0", "numpy==1.26.4", *OLDER)),
    Image("3.12", ("torch==2.10.0", "numpy==2.0.2", *NEWER)),
    Image("3.12", ("torch==2.11.0", "numpy==2.0.2", *NEWER)),
    Image("3.13", ("torch==2.11.0", "numpy==2.1.3", *NEWER)),
    Image("3.13", ("torch==2.11.0", "numpy==2.1.3", *OPENCV_5)),
)
BESIDE = ("matplotlib", "tqdm", "ipykernel", "nbclient", "nbformat")
UNPACKED = (".zip", ".tar", ".gz", ".pt", ".pth", ".ckpt")  # Kaggle unpacks archives, as torch's checkpoints are
PACKAGES = ("numpy", "pandas", "scipy", "scikit-learn", "opencv-python-headless", "torch", "pip", *BESIDE)


def interpreter(python: str) -> Path | None:
    """The first command of that version, ``3.13``, on ``PATH`` that runs; version managers have some that fail."""
    for folder in os.environ["PATH"].split(os.pathsep):
        found = shutil.which(f"python{python}", path=folder)
        if found and subprocess.run([found, "-c", ""], capture_output=True, check=False).returncode == 0:
            return Path(found)
    return None


def install_image(image: Image, directory: Path) -> Path | None:
    """The interpreter of an environment with just that image's versions; ``None`` where it cannot be had here.

    An environment that is there already is taken as it is: it has gigabytes, with CUDA's libraries.
    """
    python = directory / "bin" / "python"
    done = directory / "installed"
    base = interpreter(image.python)
    if base is None:
        return None
    if not done.is_file():
        subprocess.run([base, "-m", "venv", "--clear", directory], check=True, env=environment())
        pip = [python, "-m", "pip", "install", "--quiet", *image.versions, *BESIDE]
        if subprocess.run(pip, check=False, env=environment()).returncode != 0:
            return None
        done.touch()
    return python


def upload(folder: Path, mount: Path) -> None:
    """What Kaggle makes of an uploaded folder: sub-folders are dropped, archives become directories."""
    mount.mkdir(parents=True)
    for path in folder.iterdir():
        if path.suffix in UNPACKED and is_zipfile(path):
            with ZipFile(path) as archive:
                archive.extractall(mount / path.name)
        elif path.is_file():
            shutil.copyfile(path, mount / path.name)


def make_image(directory: Path) -> Path:
    """An environment with links to this interpreter's copies of the packages; its interpreter."""
    venv.create(directory, symlinks=True)
    site = next(directory.glob("lib/python*/site-packages"))
    for installed in closure(PACKAGES).values():
        for entry in {
            file.parts[0] for file in installed.files or () if file.parts[0] not in ("..", "__pycache__")
        }:
            link = site / entry
            if not link.is_symlink():
                link.symlink_to(Path(str(installed.locate_file(entry))))
    return directory / "bin" / "python"


def closure(names: Sequence[str]) -> dict[str, Distribution]:
    """The named distributions and all that they need, as far as they are here, by name."""
    found: dict[str, Distribution] = {}
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
    """The wheel that an installed distribution came from, but for the order and dates of its entries."""
    installed = distribution(name)
    tags = re.findall(r"^Tag: (.*)$", installed.read_text("WHEEL") or "", re.MULTILINE)
    columns = zip(*(tag.split("-") for tag in tags), strict=True)
    pythons, abis, platforms = (".".join(dict.fromkeys(column)) for column in columns)
    stem = f"{installed.name.replace('-', '_')}-{installed.version}"
    path = directory / f"{stem}-{pythons}-{abis}-{platforms}.whl"
    written_by_pip = ("INSTALLER", "REQUESTED", "direct_url.json")
    with ZipFile(path, "w") as archive:
        for file in installed.files or ():
            if file.parts[0] != ".." and "__pycache__" not in file.parts and file.name not in written_by_pip:
                archive.write(Path(str(installed.locate_file(file))), str(file))
    return path


def environment(**more: str) -> dict[str, str]:
    """This process's environment without what leads to its own packages, or tells that a test is running."""
    hidden = ("PYTHONPATH", "VIRTUAL_ENV", "MKPC_WEIGHTS", "PYTEST_CURRENT_TEST")
    kept = {name: value for name, value in os.environ.items() if name not in hidden}
    return {**kept, "PYTHONNOUSERSITE": "1", **more}


def python_version() -> str:
    return f"{sys.version_info.major}.{sys.version_info.minor}"
