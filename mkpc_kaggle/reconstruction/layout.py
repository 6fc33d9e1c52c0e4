"""The folders ``images`` and ``sparse`` of a dataset, which gsplat, nerfstudio and Gaussian
splatting read.

``images`` has links to the photographs, or copies where the file system has no links. ``sparse/0`` is the largest
model in COLMAP's format, with plain file names and with the colours of points.
"""

import errno
import os
import shutil
import signal
import time
import unicodedata
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from math import inf
from multiprocessing import get_context
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any
from unicodedata import combining

from mkpc_kaggle.matchers.failures import reason_of
from mkpc_kaggle.reconstruction.colours import colour_points
from mkpc_kaggle.reconstruction.directory import holds_dataset
from mkpc_kaggle.reconstruction.folder import Datasets
from mkpc_kaggle.reconstruction.undistort import undistort
from mkpc_kaggle.scene.export import (
    FORMER,
    IMAGES,
    MODELS,
    PART,
    SPARSE,
    HeldDirectory,
    remove_parts,
    replace_models,
    require_on_disk,
)


def write_layouts(
    out: Path,
    root: Path,
    datasets: Datasets,
    ends: float,
    held: Mapping[str, HeldDirectory] | None = None,
) -> Iterator[str]:
    """Write the folders of each dataset until ``ends``, in seconds of the monotonic clock. Yield
    the problems.

    ``held`` are the datasets' directories as the run began with them.
    """
    # A folder that fails is a line, and the others are still written.
    for dataset, files in datasets.items():
        directory = out / dataset
        if holds_dataset(str(PurePosixPath(dataset, IMAGES)), datasets):
            yield (
                f"{directory / IMAGES} belongs to another dataset, so {directory / SPARSE} was not written: "
                f"rename the folder {root / dataset / IMAGES}"
            )
            continue
        left = max(0.0, ends - time.monotonic())
        links = link_names(files)
        names = {file.relative_to(root).as_posix(): link for file, link in links.items()}
        try:
            if held is not None:
                held[dataset].check()
            write_images(directory, files)
            failure = write_sparse(directory, names, None if ends == inf else left)
        except OSError as error:
            failure = reason_of(error)
        if failure:
            yield f"{directory / SPARSE} was not written: {failure}; the same command writes it"


def write_images(directory: Path, files: Sequence[Path]) -> None:
    """Make ``images``: a link to each file, or a copy. Remove links to other files. Raises
    ``OSError``.
    """
    folder = directory / IMAGES
    folder.mkdir(parents=True, exist_ok=True)
    links = link_names(files)
    names = set(links.values())
    # Files that are no links may be the user's.
    for former in folder.iterdir():
        is_part = former.name.startswith(PART) and former.is_file()  # of a process that was killed
        if is_part or (former.is_symlink() and former.name not in names):
            former.unlink()
    for file, name in links.items():
        _link(folder / name, file.resolve())


def link_names(files: Sequence[Path]) -> dict[Path, str]:
    """Return the name of each file in ``images`` and ``sparse``: its own, if that is unique ASCII.

    Some readers of COLMAP's files decode names byte by byte, which only ASCII survives. Of files
    with equal names, each has the name of its folder before its own.
    """
    counts = Counter(file.name for file in files)
    names = {file: file.name for file in files if file.name.isascii() and counts[file.name] == 1}
    used = set(names.values())
    for file in files:
        if file in names:
            continue
        name = file.name if counts[file.name] == 1 else f"{file.parent.name}_{file.name}"
        path = PurePosixPath(_ascii(name))
        number = 1
        name = path.name
        while name in used:
            number += 1
            name = f"{path.stem}_{number}{path.suffix}"
        used.add(name)
        names[file] = name
    return {file: names[file] for file in files}


def _ascii(name: str) -> str:
    """Return a name in ASCII: letters without accents, and "_" for other characters."""
    letters = (each for each in unicodedata.normalize("NFKD", name) if not combining(each))
    return "".join(each if each.isascii() else "_" for each in letters)


def _link(path: Path, file: Path) -> None:
    """Make ``path`` a link to ``file``, or a copy of it; one that is up to date stays."""
    if path.is_symlink():
        if path.readlink() == file:
            return
        # Of an image that has moved
        path.unlink()
    elif path.exists() and _version(path) == _version(file):
        return
    with suppress(OSError):  # an old copy exists, or the file system has no links
        path.symlink_to(file)
        return
    # A device has no end: a copy of /dev/zero would fill the disk.
    if not file.is_file():
        return
    # A copy that cannot fit would fill the disk before it fails, at the cost of other programs.
    if file.stat().st_size > shutil.disk_usage(path.parent).free:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(file))
    # A copy that was cut off must not look like an image.
    part = path.with_name(f"{PART}{path.name}")
    try:
        shutil.copy2(file, part)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _version(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_size, status.st_mtime_ns


def write_sparse(directory: Path, names: Mapping[str, str], seconds: float | None) -> str:
    """Make ``sparse`` from ``models`` and ``images``. Return why that failed, or an empty string.

    ``names`` maps an image's name in a model to its name in ``images``. A separate process does the work, since
    pycolmap may end it; the process is ended after ``seconds``, unless ``None``.
    """
    # A fork would copy the threads' locks of a parent that may hold them.
    context = get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(
        target=_write_sparse_to,
        args=(sender, HeldDirectory.of(directory), dict(names)),
        daemon=True,
    )
    process.start()
    # The child's end alone stays open, so its death ends the wait.
    sender.close()
    try:
        if not receiver.poll(seconds):
            return "no time was left"
        with suppress(EOFError):
            return str(receiver.recv())
        process.join()
        return f"its process ended with status {process.exitcode}"
    finally:
        process.kill()
        process.join()
        receiver.close()


def _write_sparse_to(sender: Any, held: HeldDirectory, names: Mapping[str, str]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the terminal; the parent decides
    try:
        convert_models(held, names)
        sender.send("")
    except Exception as error:  # any error of pycolmap
        # Some errors have no text, such as a lack of memory.
        sender.send(reason_of(error))


def convert_models(held: HeldDirectory, names: Mapping[str, str]) -> None:
    """Write ``sparse`` in this process. The complete folder replaces an earlier one."""
    directory = held.path
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    remove_parts(directory)
    with TemporaryDirectory(prefix=PART, dir=directory) as name:
        made = Path(name)
        (made / SPARSE).mkdir()
        (made / IMAGES).mkdir()
        for folder in sorted((directory / MODELS).glob("[0-9]*")):
            model = pycolmap.Reconstruction(folder)
            # Before colours are read: images/ has plain names.
            for image in model.images.values():
                image.name = names.get(image.name, image.name)
            colour_points(model, directory / IMAGES)
            undistort(model, directory / IMAGES, made / IMAGES)
            (made / SPARSE / folder.name).mkdir()
            model.write(made / SPARSE / folder.name)
        require_on_disk(made)
        held.check()
        for path in sorted((made / IMAGES).iterdir()):
            # Of a link, which is replaced, and not of its photograph
            path.replace(directory / IMAGES / path.name)
        replace_models(made / SPARSE, directory / SPARSE, made / FORMER)
