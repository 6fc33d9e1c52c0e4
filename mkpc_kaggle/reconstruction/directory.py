"""The directory of results: what this command has made there, and what is in the way."""

import json
import os
import re
import shutil
from collections.abc import Collection, Iterable
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from mkpc_kaggle.data.outputs import replacing
from mkpc_kaggle.errors import UserError, writing
from mkpc_kaggle.scene.export import DATABASE, FORMER, MODEL_FILES, MODELS, PART

WORK, TABLES = "work", ("cameras.csv", "submission.csv", "report.html")
RESERVED = {DATABASE, MODELS, WORK, *TABLES}  # names that no dataset may have
MARK = "datasets.json"  # in WORK: the datasets that may have results here; where it lies, the directory is ours
RESULT = re.compile(
    rf"(?:(.+)/)?(?:{re.escape(DATABASE)}|{MODELS}/\d+/(?:{'|'.join(map(re.escape, MODEL_FILES))}))"
)


def claim(out: Path, datasets: Iterable[str]) -> list[str]:
    """Make the directory ours, and writable for all ``datasets``; the datasets of earlier runs that are gone.

    Raises :class:`UserError` with the name of what is in the way: a file that no run has made, a link anywhere.
    """
    mark = out / WORK / MARK
    former = _former(mark)
    for folder, folders, files in os.walk(out, onerror=_refuse_unreadable):
        place = Path(folder)
        is_work = former is not None and place.relative_to(out).parts[:1] == (WORK,)
        folders[:] = [name for name in folders if not name.startswith(".")]
        strange = [name for name in folders if (place / name).is_symlink() or name in RESERVED - {MODELS, WORK}]
        for name in (name for name in files if not name.startswith(".")):
            path = place / name
            is_ours = is_work or _is_ours(path.relative_to(out).as_posix(), former)
            if path.is_symlink() or not path.is_file() or not is_ours:
                strange.append(name)
        if strange:
            raise UserError(
                f"--out {out}: {place / min(strange)} is in the way, it was not made by this command; move it, or "
                "name an empty directory"
            )
    wanted = set(datasets)
    with writing(f"--out {out}"):
        _write_mark(mark, wanted | (former or set()))
        for name in wanted:
            (out / name).mkdir(parents=True, exist_ok=True)
            TemporaryDirectory(prefix=PART, dir=out / name).cleanup()
    return sorted((former or set()) - wanted)


def settle(out: Path, datasets: Collection[str], gone: Iterable[str]) -> None:
    """Remove the results of the datasets that are ``gone``, for the run that holds the directory.

    Models that a killed run was replacing come back.
    """
    with writing(f"--out {out}"):
        for former in (found for name in datasets for found in (out / name).glob(f"{PART}*/{FORMER}")):
            if not (former.parent.parent / MODELS).exists():
                former.rename(former.parent.parent / MODELS)
        for name in gone:
            (out / name / DATABASE).unlink(missing_ok=True)
            shutil.rmtree(out / name / MODELS, ignore_errors=True)
            for folder in (out / name, *(out / name).parents):
                with suppress(OSError):  # until it is not empty
                    folder.rmdir()
        _write_mark(out / WORK / MARK, datasets)


def _former(mark: Path) -> set[str] | None:
    """The datasets that may have results; ``None`` in a directory that is not ours yet."""
    if not mark.is_file() or mark.is_symlink():
        return None
    with suppress(OSError, ValueError, TypeError):
        return {str(name) for name in json.loads(mark.read_text())}
    return None


def _is_ours(name: str, former: set[str] | None) -> bool:
    found = RESULT.fullmatch(name)
    return former is not None and (name in TABLES or (found is not None and (found[1] or ".") in former))


def _write_mark(mark: Path, datasets: Iterable[str]) -> None:
    mark.parent.mkdir(parents=True, exist_ok=True)
    with replacing(mark) as stream:
        json.dump(sorted(datasets), stream)


def _refuse_unreadable(error: OSError) -> None:
    if not isinstance(error, FileNotFoundError):
        raise UserError(f"--out {error.filename} cannot be read: {error.strerror}")
