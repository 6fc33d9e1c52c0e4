"""Journals that were damaged, or made up, between two runs."""

import os
import shutil
import sqlite3
import tempfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from attack import EITHER, Case, prepared
from room import SUBMIT, write_template

PAGE = 4096
READ = "journal out/s.work"
ROUGH: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda data: b"",
    "one byte": lambda data: data[:1],
    "its head alone": lambda data: data[:100],
    "its first page": lambda data: data[:PAGE],
    "its first half": lambda data: data[: len(data) // 2],
    "all but its last page": lambda data: data[:-PAGE],
    "text": lambda data: b"this is no journal\n" * 1000,
    "noise": lambda data: np.random.default_rng(0).bytes(len(data)),
    "noise after its head": lambda data: data[:100] + np.random.default_rng(0).bytes(len(data) - 100),
    "bytes after its end": lambda data: data + bytes(3 * PAGE),
    "another format of files": lambda data: data[:18] + b"\x09\x09" + data[20:],
    "no page size": lambda data: data[:16] + b"\0\0" + data[18:],
    **{
        f"page {page} of zeros": lambda data, page=page: (
            data[: page * PAGE] + bytes(min(PAGE, len(data) - page * PAGE)) + data[(page + 1) * PAGE :]
        )
        for page in (1, 2, 4, 7)
    },
    **{
        f"a byte turned in each of its pages at {place}": lambda data, place=place: bytes(
            byte ^ 0x55 if index % PAGE == place and index > 100 else byte for index, byte in enumerate(data)
        )
        for place in (0, 8, 2000)
    },
}
OTHER_PAIR = (
    "CREATE TEMP TABLE other AS SELECT * FROM pair LIMIT 1; UPDATE other SET pair = {};"
    "INSERT INTO pair SELECT * FROM other"
)
FINE = {
    "F of NaN": "UPDATE pair SET fundamental = zeroblob(72); UPDATE choice SET fundamental = NULL;"
    "UPDATE pair SET fundamental = X'" + np.full(9, np.nan).tobytes().hex() + "'",
    "F of zeros": "UPDATE pair SET fundamental = zeroblob(72)",
    "F of infinity": "UPDATE pair SET fundamental = X'" + np.full(9, np.inf).tobytes().hex() + "'",
    "a short F": "UPDATE pair SET fundamental = X'00'",
    "an F that is text": "UPDATE pair SET fundamental = 'F'",
    "a chosen F of NaN": "REPLACE INTO choice VALUES (0, X'" + np.full(9, np.nan).tobytes().hex() + "', 'scene')",
    "a reason nobody knows": "REPLACE INTO choice VALUES (0, NULL, 'because')",
    "a pair that is not there": OTHER_PAIR.format(99),
    "a pair before the first": OTHER_PAIR.format(-1),
    "a pair of 2^62": OTHER_PAIR.format(2**62),
    "no pairs": "DELETE FROM pair",
    "no units": "DELETE FROM unit",
    "no samples": "DELETE FROM sample",
    "no run": "DELETE FROM run",
    "one region a pair": "DELETE FROM region WHERE image = 0",
    "a region upside down": 'UPDATE region SET "left" = "right", "right" = -5',
    "a region of text": "UPDATE region SET \"left\" = 'left'",
    "a region nobody knows": "UPDATE region SET reason = 'because'",
    "a region of 10^18 pixels": 'UPDATE region SET "right" = 1000000000000000000',
    "points that are no points": "UPDATE unit SET points = X'00112233'",
    "points of one byte": "UPDATE unit SET points = X'789c636000000002000100010000'",
    "points of a gigabyte": "UPDATE unit SET points = :bomb",
    "counts below none": "UPDATE unit SET matches = -5, inliers = -5",
    "counts of text": "UPDATE unit SET matches = 'many', inliers = 'all'",
    "seconds of text": "UPDATE unit SET encode_seconds = 'long'; UPDATE pair SET decode_seconds = 'long'",
    "seconds of infinity": "UPDATE unit SET encode_seconds = 9e999, match_seconds = -9e999",
    "units nobody knows": "UPDATE unit SET unit = 'x' || unit",
    "a failure of 10 MB": "UPDATE pair SET failure = printf('%.*c', 10000000, 'x')",
    "a failure with markup": "UPDATE pair SET failure = '<script>alert(1)</script>\x1b[31m'",
    "an event of text": "UPDATE event SET seconds = 'never', kind = 'x'",
    "JSON cut off": "UPDATE run SET value = substr(value, 1, 3)",
    "JSON of another kind": "UPDATE run SET value = '[1, 2]'",
    "deep JSON": "UPDATE run SET value = replace(printf('%.*c', 100000, 'x'), 'x', '[')",
    "a number of 5,000 digits": "UPDATE run SET value = printf('%.*c', 5000, '9')",
    "another format": "UPDATE run SET value = '99' WHERE key = 'format'",
    "a format of text": "UPDATE run SET value = '\"x\"' WHERE key = 'format'",
    "what it is about of another kind": "UPDATE run SET value = '{\"x\": 1}' WHERE key = 'about'",
    "other images": "UPDATE sample SET image0 = 'q.png'",
    "ids that are blobs": "UPDATE sample SET id = X'ff00'",
    "a table missing": "DROP TABLE pair",
    "another table for one": "DROP TABLE unit; CREATE TABLE unit (a, b)",
    "a view for a table": "ALTER TABLE pair RENAME TO was; CREATE VIEW pair AS SELECT * FROM was",
    "a trigger": "CREATE TRIGGER t AFTER INSERT ON event BEGIN DELETE FROM pair; END",
    "a scene that is none": "INSERT INTO scene VALUES ('b1', 1, 1, 1, 1, 1, 1, '', 'no cameras', '[]')",
}
BESIDE: dict[str, Callable[[Path], object]] = {
    "noise for its lock": lambda work: (work / "journal.lock").write_bytes(b"garbage" * 500),
    "a directory for its lock": lambda work: [(work / "journal.lock").unlink(), (work / "journal.lock").mkdir()],
    "a pipe for its lock": lambda work: [(work / "journal.lock").unlink(), os.mkfifo(work / "journal.lock")],
    "noise for its log": lambda work: (work / "journal.sqlite-wal").write_bytes(b"garbage" * 500),
    "noise for its rollback": lambda work: (work / "journal.sqlite-journal").write_bytes(b"garbage" * 500),
    "a directory for it": lambda work: [(work / "journal.sqlite").unlink(), (work / "journal.sqlite").mkdir()],
    "a pipe for it": lambda work: [(work / "journal.sqlite").unlink(), os.mkfifo(work / "journal.sqlite")],
    "a link to /dev/zero": lambda work: [
        (work / "journal.sqlite").unlink(),
        (work / "journal.sqlite").symlink_to("/dev/zero"),
    ],
    "many files beside it": lambda work: [(work / f"file{number}").touch() for number in range(1000)],
}


@cache
def finished() -> Path:
    """The room of a run that has ended, made once a process."""
    room = write_template(Path(tempfile.mkdtemp(prefix="hostile-")) / "room")
    done = prepared(SUBMIT, room)
    assert done == 0, "the undisturbed run failed"
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
        db = sqlite3.connect(work / "journal.sqlite")
        db.execute(script, {"bomb": bomb()}) if ":bomb" in script else db.executescript(script)
        db.commit()
        db.close()

    return run


@cache
def bomb() -> bytes:
    return zlib.compress(bytes(1_000_000_000), level=9)


DAMAGES = [
    *((name, rewritten(damage)) for name, damage in ROUGH.items()),
    *((name, executed(script)) for name, script in FINE.items()),
    *BESIDE.items(),
]
CASES = [
    *(Case("journals", f"{name}, resumed", SUBMIT, resumed(change), (0, 1, 2)) for name, change in DAMAGES),
    *(
        Case("journals", f"{name}, read", READ + " --csv out/t --json out/j", resumed(change), EITHER)
        for name, change in DAMAGES[::2]
    ),
    *(
        Case("journals", f"{name}, drawn", READ + " --report out/r.html --test-dir D", resumed(change), EITHER)
        for name, change in DAMAGES[1::8]
    ),
    *(
        Case("journals", f"{name}, forgotten", SUBMIT + " --fresh", resumed(change), EITHER)
        for name, change in DAMAGES[3::12]
    ),
]
