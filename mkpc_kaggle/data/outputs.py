"""Files that a command writes: an input is never overwritten, and a file is replaced only by a whole file."""

import os
import secrets
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path
from typing import TextIO

from mkpc_kaggle.errors import UserError

# By option, the suffixes of what it writes: such a file in an input directory is the result of an earlier run.
RESULTS = {"--output": (".csv",), "--json": (".json",), "--report": (".html", ".htm")}
RESULTS["--out"] = (".png", ".jpg", ".pdf", ".svg")


def require_apart(
    outputs: Mapping[str, Path | None],
    inputs: Iterable[Path],
    work_dir: Path | None = None,
    weights: Iterable[Path] = (),
) -> None:
    """Refuse outputs that would overwrite an input, or that are in each other's or the journal's way.

    ``outputs`` are files, by option; ``inputs`` and ``weights`` files and directories. A new file is fine.
    ``--json`` and ``--report`` overwrite nothing but their own kind. Raises :class:`UserError`.
    """
    files = {option: path for option, path in outputs.items() if path is not None}
    inputs = list(inputs)
    precious = [*inputs, *weights, *weights_of_environment()]
    for option, path in files.items():
        is_result = path.suffix.lower() in RESULTS.get(option, ())
        if not path.name or os.path.isdir(path):  # noqa: PTH112  Path raises for a name that is too long
            raise UserError(f"{option} {str(path)!r} is a directory; name a file")
        lost = [f"{other} {there}" for other, there in files.items() if other != option and same_file(path, there)]
        is_journal = path.name.startswith("journal.") and work_dir is not None and same_file(path.parent, work_dir)
        if is_journal or (work_dir is not None and lies_in(work_dir, path)):
            lost.append(f"the work directory {work_dir}")
        for source in precious if os.path.lexists(path) else ():
            if same_file(path, source) or (lies_in(path, source) and not is_result):
                lost.append(f"the input {source}")
        if lost:
            raise UserError(f"{option} {path} would be written over {lost[0]}; name another file")
        if option in ("--json", "--report") and not is_result and os.path.isfile(path):  # noqa: PTH113
            raise UserError(f"{option} {path} exists and is not a {RESULTS[option][0]} file; name another file")
    for source in inputs:
        if work_dir is not None and lies_in(work_dir, source):
            raise UserError(f"--work-dir {work_dir} would be written over the input {source}; name another place")


def require_directory_apart(out: Path, inputs: Iterable[Path], weights: Iterable[Path]) -> None:
    """Refuse a directory of results, ``--out``, that holds something that is read, or lies in an input."""
    inputs = list(inputs)
    for place in (*inputs, *weights, *weights_of_environment()):
        if os.path.lexists(place) and (lies_in(place, out) or (place in inputs and lies_in(out, place))):
            raise UserError(f"--out {out} and the input {place} are in each other's way; name another place")


def require_table(path: Path, columns: Iterable[str]) -> None:
    """Refuse to replace anything but a table with these columns. Raises :class:`UserError`."""
    if os.path.lexists(path):
        with suppress(OSError):
            if path.is_file() and not path.is_symlink():  # a pipe would block
                with path.open(encoding="utf-8", errors="replace") as stream:
                    if stream.readline(1 << 16).rstrip("\n") == ",".join(columns):
                        return
        raise UserError(f"{path} exists and is no such table; name another directory")


def weights_of_environment() -> list[Path]:
    """The directories that ``$MKPC_WEIGHTS`` names."""
    return [Path(name) for name in os.environ.get("MKPC_WEIGHTS", "").split(os.pathsep) if name]


def lies_in(path: Path, directory: Path) -> bool:
    """Whether ``path`` is ``directory`` or in it, links resolved."""
    return any(same_file(place, directory) for place in (path, *Path(os.path.realpath(path)).parents))


def same_file(path: Path, other: Path) -> bool:
    try:  # links, and file systems that do not tell A from a
        return os.path.realpath(path) == os.path.realpath(other) or path.samefile(other)
    except OSError:
        return False


@contextmanager
def replacing(path: Path) -> Iterator[TextIO]:
    """A file to write that takes the place of ``path`` when all of it is on the disk.

    Until then it lies beside ``path``; what a killed process has left there is removed. A device such as
    ``/dev/stdout`` is written to and not replaced. Raises ``OSError`` where it cannot be written; nothing is left.
    """
    if path.is_char_device():
        with path.open("w", encoding="utf-8", newline="") as stream:
            yield stream
        return
    for left in path.parent.glob(f".{escape(path.name)}.*.part"):
        with suppress(OSError):
            left.unlink()
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        with part.open("x", encoding="utf-8", newline="") as stream:  # "x" follows no link
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
