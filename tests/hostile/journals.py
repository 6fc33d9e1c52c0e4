"""Damaged journals, as the real command meets them; tests/engine/test_journal.py has the table of damages."""

import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

from attack import REFUSED, Case, prepared
from room import SUBMIT, write_template


@cache
def finished() -> Path:
    """Return the room of a finished run, made once per process."""
    room = write_template(Path(tempfile.mkdtemp(prefix="hostile-")) / "room")
    assert prepared(SUBMIT, room) == 0, "the undisturbed run failed"
    return room


def damaged(damage: Callable[[Path], object], name: str = "journal.sqlite") -> Callable[[Path], None]:
    """The results of the finished run, with damage to one file of its work directory."""

    def make(room: Path) -> None:
        for folder in ("D", "out/s.work"):
            shutil.copytree(finished() / folder, room / folder, dirs_exist_ok=True)
        damage(room / "out" / "s.work" / name)

    return make


def replaced(path: Path, make: Callable[[Path], object]) -> None:
    path.unlink()
    make(path)


EMPTY = damaged(lambda path: path.write_bytes(b""))
HALF = damaged(lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]))
NOISE = damaged(lambda path: path.write_bytes(path.read_bytes()[:100] + b"noise" * 5000))
DEVICE = damaged(lambda path: replaced(path, lambda file: file.symlink_to("/dev/zero")))
NO_LOCK = damaged(lambda path: replaced(path, Path.mkdir), "journal.lock")
CASES = [
    Case("journals", "empty, resumed", SUBMIT, EMPTY),
    Case("journals", "its first half, resumed", SUBMIT, HALF, REFUSED),
    Case("journals", "its first half, forgotten", f"{SUBMIT} --fresh", HALF),
    Case("journals", "noise after its head, read", "journal out/s.work --csv out/t", NOISE, REFUSED),
    Case("journals", "a link to /dev/zero, resumed", SUBMIT, DEVICE, REFUSED),
    Case("journals", "a directory for its lock, resumed", SUBMIT, NO_LOCK, REFUSED),
]
