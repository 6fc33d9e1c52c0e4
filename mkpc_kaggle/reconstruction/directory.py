"""The output directory of ``reconstruct``: rules for writing, replacing and removing its files."""

import hashlib
import json
import os
import re
import shutil
import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

from mkpc_kaggle.data.images import READ_SUFFIXES
from mkpc_kaggle.data.outputs import lies_in, replacing, weights_of_environment
from mkpc_kaggle.engine.console import logger
from mkpc_kaggle.errors import UserError, writing
from mkpc_kaggle.scene.align import REFERENCE
from mkpc_kaggle.scene.export import (
    DATABASE,
    IMAGES,
    MODEL_FILE,
    MODELS,
    PART,
    SPARSE,
    HeldDirectory,
    model_files,
    remove_models,
)
from mkpc_kaggle.weights.manifest import digest_of

WORK = "work"
TABLES = ("cameras.csv", "submission.csv", "report.html", "summary.json")
RESERVED = {DATABASE, MODELS, SPARSE, WORK, *TABLES}  # names that no dataset may have
FILES = (DATABASE, MODELS, SPARSE, IMAGES, REFERENCE)  # of each dataset
MARK = f"{WORK}/results.json"  # digests of results by path; "" if their run did not end
MODEL_FOLDER = re.compile(r"\d+")
IMAGE_FILE = re.compile(rf"[^/]+({'|'.join(map(re.escape, READ_SUFFIXES))})", re.IGNORECASE)
CONTENTS = (MODELS, SPARSE, IMAGES)  # folders that may have files of others, too


@contextmanager
def output_directory(
    out: Path, datasets: Iterable[str], form: str | None = None
) -> Iterator[HeldDirectory]:
    """Reserve ``out`` for a run's results. At the end, remove results that only earlier runs made.

    With a ``form``, ``submission.csv`` is a result. A result that was changed after its run is not
    removed, and files of others stay. If ``out`` leads to another directory at the end, nothing is
    written or removed there. Raise :class:`UserError` if ``out`` is neither empty nor marked by a run. A link or
    another file at the path of a result also raises it.
    """
    results = [name for name in TABLES if form or name != "submission.csv"]
    names = list(datasets)
    # Each dataset has its files in a folder of OUT with its name.
    inner = {str(PurePosixPath(name, file)) for name in names for file in FILES}
    results += sorted(file for file in inner if not holds_dataset(file, names))
    with writing(f"--out {out}"):
        marked = _read_mark(out)
        for name in results:
            is_ours = name in (marked or ()) and _is_inside(out, name)
            if is_ours and PurePosixPath(name).name == DATABASE:
                _require_closed(out, out / name)
        if strange := next(_in_the_way(out, results, marked), None):
            message = f"--out {out}: {strange} is in the way, it was not made by this command"
            raise UserError(f"{message}; move it, or name an empty directory")
        digests = dict.fromkeys(results, "") | (marked or {})
        # Before the first result: after a kill, its files are known as ours.
        _write_mark(out, digests)
        # A folder that cannot be written is found now, and not after hours.
        for folder in {(out / name).parent for name in results}:
            folder.mkdir(parents=True, exist_ok=True)
            TemporaryDirectory(prefix=PART, dir=folder).cleanup()
        before = {name: _digest(out / name) for name in results}
        held = HeldDirectory.of(out)
    yield held
    if not held.is_here:
        return
    with writing(f"--out {out}"):
        # Results of datasets that are gone, unless the user has changed them
        for name in digests.keys() - results:
            if digests[name] and digests[name] == _digest(out / name):
                _remove(out / name, out)
        after = {}
        for name in results:
            digest = _digest(out / name)
            # A result that this run left as it was may be the user's version of it.
            if digest:
                after[name] = digests[name] if digest == before[name] else digest
        _write_mark(out, after)


def _require_closed(out: Path, database: Path) -> None:
    """Raise :class:`UserError` if another program has a database open.

    A program that was killed leaves files next to it. SQLite removes these with the last connection.
    """
    if not _companions(database) or not database.is_file():
        return
    try:
        with closing(sqlite3.connect(database, timeout=0)) as connection:
            connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except sqlite3.OperationalError:  # locked
        pass
    except sqlite3.DatabaseError:  # no database, so the files next to it are the user's
        return
    if left := _companions(database):
        raise UserError(
            f"--out {out}: another program has {database} open, as {left[0].name} shows; "
            "close that program"
        )


def _companions(database: Path) -> list[Path]:
    return sorted(database.parent.glob(f"{database.name}-*"))


def holds_dataset(result: str, datasets: Iterable[str]) -> bool:
    """Return whether a dataset lies at the path of a result: one that is called ``images``."""
    return any(PurePosixPath(name).is_relative_to(result) for name in datasets)


def require_directory_apart(
    out: Path, inputs: Iterable[Path], around: Iterable[Path], option: str = "--out"
) -> None:
    """Raise :class:`UserError` if ``out``, the folder of an option, contains an input or lies in one.

    Inputs that may lie ``around`` it, such as weights in a home directory, must only not lie in it.
    """
    inputs = list(inputs)
    for place in (*inputs, *around, *weights_of_environment()):
        if os.path.lexists(place) and (
            lies_in(place, out) or (place in inputs and lies_in(out, place))
        ):
            raise UserError(
                f"{option} {out} contains, or lies in, the input {place}; name another folder"
            )


def _read_mark(out: Path) -> dict[str, str] | None:
    """Return the digests of earlier results, or ``None`` if no run has marked the directory."""
    # A damaged mark marks nothing.
    with suppress(OSError, ValueError, AttributeError, RecursionError):
        if _is_inside(out, MARK):
            known = json.loads((out / MARK).read_text()).items()
            return {name: digest for name, digest in known if _is_inside(out, name)}
    return None


def _write_mark(out: Path, known: Mapping[str, str]) -> None:
    (out / WORK).mkdir(parents=True, exist_ok=True)
    with replacing(out / MARK) as stream:
        json.dump(known, stream, indent=1, sort_keys=True)


def _in_the_way(
    out: Path, results: Iterable[str], marked: Mapping[str, str] | None
) -> Iterator[Path]:
    """Yield the user's links and files at the paths of results; in an unmarked directory, all links
    and files.
    """
    # Hidden files of file managers, for example, are in nobody's way.
    if marked is None:
        yield from (path for path in out.rglob("[!.]*") if path.is_symlink() or not path.is_dir())
    for name in results:
        path = out / name
        is_result = name in (marked or ()) and (
            path.is_dir() if path.name in CONTENTS else path.is_file()
        )
        if not _is_inside(out, name) or (path.exists() and not is_result):
            yield path
        # They belong to another database, whose program was killed.
        yield from _companions(path.parent / DATABASE)
        for each in path.rglob("*") if path.name in CONTENTS else ():
            if _blocks(each, each.relative_to(path).as_posix(), path.name):
                yield each


def _blocks(path: Path, name: str, folder: str) -> bool:
    """Return whether something else bears the ``name`` of a result in a folder of results.

    Files of other names are in nobody's way: Gaussian splatting writes sparse/0/points3D.ply.
    """
    if folder == IMAGES:
        # Links and copies of photographs are results.
        return bool(IMAGE_FILE.fullmatch(name)) and path.is_dir()
    if MODEL_FILE.fullmatch(name):
        return path.is_symlink() or not path.is_file()
    return bool(MODEL_FOLDER.fullmatch(name)) and (path.is_symlink() or not path.is_dir())


def _is_inside(out: Path, name: str) -> bool:
    """Return whether ``name``, a path relative to ``out``, stays in ``out`` and passes through no
    link.
    """
    root = Path(os.path.realpath(out))
    path = root / name
    return (
        path.is_relative_to(root) and os.path.realpath(path) == str(path) and not path.is_symlink()
    )


def _digest(path: Path) -> str:
    """Return the digest of a file or a folder; "" if it does not exist. Photographs are not read."""
    # The photographs of a large folder are gigabytes, so their links or times stand for them.
    if path.name == IMAGES and path.is_dir():
        lines = sorted(f"{each.name} {_version(each)}\n" for each in path.iterdir())
        return hashlib.sha256("".join(lines).encode("utf-8", "surrogateescape")).hexdigest()
    if path.name in (MODELS, SPARSE) and path.is_dir():
        # As digest_of, without files of others
        lines = [
            f"{digest_of(file).removeprefix('sha256:')} {file.relative_to(path).as_posix()}\n"
            for file in sorted(model_files(path))
        ]
        return f"sha256:{hashlib.sha256(''.join(lines).encode()).hexdigest()}" if lines else ""
    return digest_of(path) if path.exists() else ""


def _version(path: Path) -> str:
    """Return the target of a link, or the size and time of a file."""
    if path.is_symlink():
        return str(path.readlink())
    status = path.stat()
    return f"{status.st_size} {status.st_mtime_ns}"


def _remove(path: Path, out: Path) -> None:
    """Remove a result, and the folders of its dataset in ``out`` if they are empty then."""
    if path.name in (MODELS, SPARSE):
        remove_models(path)
    elif path.is_dir():
        shutil.rmtree(path)  # links and copies of photographs, as they were after their run
    else:
        path.unlink()
    for folder in path.relative_to(out).parents:
        # The last is OUT itself, which belongs to the user.
        if folder.parts:
            with suppress(OSError):  # the folder is not empty
                (out / folder).rmdir()
    logger.warning(f"{path} was removed: an earlier run made it, and this run does not")
