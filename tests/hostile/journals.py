"""Journals that were damaged, or made up, between two runs."""

import shutil
import sqlite3
import tempfile
from collections.abc import Callable
from contextlib import closing
from functools import cache
from pathlib import Path

import numpy as np
from attack import REFUSED, Case, prepared
from room import SUBMIT, write_template

PAGE = 4096
READ = "journal out/s.work"
ROUGH: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda data: b"",
    "its head alone": lambda data: data[:100],
    "its first half": lambda data: data[: len(data) // 2],
    "all but its last page": lambda data: data[:-PAGE],
    "noise after its head": lambda data: data[:100] + np.random.default_rng(0).bytes(len(data) - 100),
    "bytes after its end": lambda data: data + bytes(3 * PAGE),
    "another format of files": lambda data: data[:18] + b"\x09\x09" + data[20:],
    "no page size": lambda data: data[:16] + b"\0\0" + data[18:],
    "a page of zeros": lambda data: data[: 2 * PAGE] + bytes(PAGE) + data[3 * PAGE :],
}


def pairs_with(path: str, value: str) -> str:
    """All records of pairs with another JSON value at a place: a pair's fields are in their order."""
    return f"UPDATE pair SET value = json_replace(value, '$[{path}]', json('{value}'))"


# Other values that no reading takes, and pipes in the files' places, are in tests/engine/test_journal.py.
FINE = {
    "a pair of 2^62": pairs_with("0", str(2**62)),
    "no pairs": "DELETE FROM pair",
    "no points": "DELETE FROM points",
    "no run": "DELETE FROM run",
    "a region of 10^18 pixels": pairs_with("4][0][0", "[0, 0, 1000000000000000000, 9]"),
    "counts below none": pairs_with("3][0][2", "-5"),
    "a failure of 10 MB": "UPDATE pair SET value = json_replace(value, '$[2]', printf('%.*c', 10000000, 'x'))",
    "a failure with markup": pairs_with("2", '"<script>alert(1)</script>\\u001b[31m"'),
    "JSON of another kind": "UPDATE run SET value = '[1, 2]'",
    "another format": "UPDATE run SET value = '99' WHERE key = 'format'",
    "what it is about of another kind": "UPDATE run SET value = '{\"x\": 1}' WHERE key = 'about'",
    "other images": 'UPDATE sample SET value = \'["a", "b", "q.png", "r.png"]\'',
    "another table of points": "DROP TABLE points; CREATE TABLE points (a, b)",
    "a view for a table": "ALTER TABLE pair RENAME TO was; CREATE VIEW pair AS SELECT * FROM was",
    "a trigger": "CREATE TRIGGER t AFTER INSERT ON event BEGIN DELETE FROM pair; END",
}
BESIDE: dict[str, Callable[[Path], object]] = {
    "a directory for its lock": lambda work: [(work / "journal.lock").unlink(), (work / "journal.lock").mkdir()],
    "noise for its log": lambda work: (work / "journal.sqlite-wal").write_bytes(b"garbage" * 500),
    "noise for its rollback": lambda work: (work / "journal.sqlite-journal").write_bytes(b"garbage" * 500),
    "a directory for it": lambda work: [(work / "journal.sqlite").unlink(), (work / "journal.sqlite").mkdir()],
    "a link to /dev/zero": lambda work: [
        (work / "journal.sqlite").unlink(),
        (work / "journal.sqlite").symlink_to("/dev/zero"),
    ],
}


@cache
def finished() -> Path:
    """The room of a run that has ended, made once a process."""
    room = write_template(Path(tempfile.mkdtemp(prefix="hostile-")) / "room")
    assert prepared(SUBMIT, room) == 0, "the undisturbed run failed"
    return room


def resumed(change: Callable[[Path], object]) -> Callable[[Path], None]:
    """What the ended run left, changed."""

    def make(room: Path) -> None:
        shutil.rmtree(room / "D")
        shutil.copytree(finished() / "D", room / "D")
        shutil.copytree(finished() / "out" / "s.work", room / "out" / "s.work")
        change(room / "out" / "s.work")

    return make


def rewritten(damage: Callable[[bytes], bytes]) -> Callable[[Path], object]:
    return lambda work: (work / "journal.sqlite").write_bytes(damage((work / "journal.sqlite").read_bytes()))


def executed(script: str) -> Callable[[Path], object]:
    def run(work: Path) -> None:
        with closing(sqlite3.connect(work / "journal.sqlite")) as db:
            db.executescript(script)

    return run


DAMAGES = [
    *((name, rewritten(damage)) for name, damage in ROUGH.items()),
    *((name, executed(script)) for name, script in FINE.items()),
    *BESIDE.items(),
]
REFUSED_WHEN = {  # what is not named here is survived with status 0
    "resumed": {
        "its head alone",
        "its first half",
        "all but its last page",
        "noise after its head",
        "another format of files",
        "no page size",
        "a page of zeros",
        "no run",
        "JSON of another kind",
        "another format",
        "another table of points",
        "a view for a table",
        "a directory for its lock",
        "a directory for it",
        "a link to /dev/zero",
    },
    "read": {
        "empty",
        "its first half",
        "noise after its head",
        "another format of files",
        "no run",
        "another format",
        "noise for its rollback",
        "a link to /dev/zero",
    },
    "drawn": {"its head alone", "JSON of another kind"},
    "forgotten": {"a directory for it"},
}


def statuses(name: str, when: str) -> tuple[int, ...]:
    return REFUSED if name in REFUSED_WHEN[when] else (0,)


CASES = [
    *(
        Case("journals", f"{name}, resumed", SUBMIT, resumed(change), statuses(name, "resumed"))
        for name, change in DAMAGES
    ),
    *(
        Case("journals", f"{name}, read", READ + " --csv out/t", resumed(change), statuses(name, "read"))
        for name, change in DAMAGES[::2]
    ),
    *(
        Case(
            "journals",
            f"{name}, drawn",
            READ + " --report out/r.html --test-dir D",
            resumed(change),
            statuses(name, "drawn"),
        )
        for name, change in DAMAGES[1::8]
    ),
    *(
        Case("journals", f"{name}, forgotten", SUBMIT + " --fresh", resumed(change), statuses(name, "forgotten"))
        for name, change in DAMAGES[3::12]
    ),
]
