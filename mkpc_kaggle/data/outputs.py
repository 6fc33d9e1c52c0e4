"""Output files of a command: no input is overwritten, and a submission, a page or a table is replaced only by a
complete one.
"""

import os
import secrets
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path
from tempfile import TemporaryFile
from typing import TextIO

from mkpc_kaggle.errors import UserError

# Suffix of each option's results. In an input directory, a file with it is an earlier result.
SUFFIXES = {"--output": ".csv", "--json": ".json", "the report": ".html"}
PROBE_BYTES = 1 << 20  # more than the buffer of a stream that pycolmap writes


def require_apart(
    outputs: Mapping[str, Path | None],
    inputs: Iterable[Path],
    work_dir: Path | None = None,
    weights: Iterable[Path] = (),
) -> None:
    """Raise :class:`UserError` for an output that would overwrite an input, another output or the
    journal in ``work_dir``.

    ``outputs`` are files, by option; ``inputs`` and ``weights`` are files and directories. A new file
    may lie in an input directory.
    """
    files = {option: path for option, path in outputs.items() if path is not None}
    inputs = list(inputs)
    sources = [*inputs, *weights, *weights_of_environment()]
    for option, path in files.items():
        if not path.name or os.path.isdir(path):  # noqa: PTH112  Path raises for a name that is too long
            raise UserError(f"{option} {str(path)!r} is a directory; name a file")
        lost = []
        for name, other in files.items():
            if name != option and same_file(path, other):
                lost.append(f"{name} {other}")
        may_replace = not os.path.lexists(path) or path.suffix.lower() == SUFFIXES.get(option)
        for source in sources:
            if same_file(path, source) or (lies_in(path, source) and not may_replace):
                lost.append(f"the input {source}")
        if work_dir is not None and lies_in(path, work_dir):
            lost.append(f"the work directory {work_dir}")
        if lost:
            raise UserError(f"{option} {path} would overwrite {lost[0]}; name another file")
    for source in inputs:
        if work_dir is not None and lies_in(work_dir, source):
            raise UserError(
                f"--work-dir {work_dir} would overwrite the input {source}; name another place"
            )


def weights_of_environment() -> list[Path]:
    """Return the directories in ``$MKPC_WEIGHTS``."""
    return [
        Path(name) for name in os.environ.get("MKPC_WEIGHTS", "").split(os.pathsep) if name
    ]


def lies_in(path: Path, directory: Path) -> bool:
    """Return whether ``path`` is ``directory`` or lies in it, with links resolved."""
    folders = Path(os.path.realpath(path)).parents
    return any(same_file(each, directory) for each in (path, *folders))


def same_file(path: Path, other: Path) -> bool:
    """Return whether two paths name one file, with links resolved; the files may not exist yet."""
    with suppress(OSError):  # realpath for links, samefile for case-insensitive file systems
        return os.path.realpath(path) == os.path.realpath(other) or path.samefile(other)
    return False


@contextmanager
def replacing(path: Path) -> Iterator[TextIO]:
    """Open a temporary file. It replaces ``path`` once it is complete and on disk.

    The temporary file lies next to ``path``; files that a killed process left there are removed.
    Raises ``OSError`` and removes the temporary file if writing fails.
    """
    for left in path.parent.glob(f".{escape(path.name)}.*.part"):
        with suppress(OSError):
            left.unlink()
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        with part.open("x", encoding="utf-8", newline="") as stream:  # "x" follows no link
            yield stream
            stream.flush()
            # Before the renaming: after a power failure, the new name could have an empty file.
            os.fsync(stream.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def sync(folder: Path) -> None:
    """Wait until the files below a folder are on the disk. Raise ``OSError`` if the disk is full.

    A power failure must not leave empty files under their names.
    """
    for path in folder.rglob("*"):
        if path.is_file() and not path.is_symlink():
            with path.open("rb") as stream:
                os.fsync(stream.fileno())
    # pycolmap reports no full disk, so a file of ours must fit after its files.
    with TemporaryFile(dir=folder) as probe:
        probe.write(bytes(PROBE_BYTES))
        probe.flush()
        os.fsync(probe.fileno())
