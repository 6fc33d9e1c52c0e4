"""The durable record of a run: an SQLite file. Only the parent writes it, in one transaction per answer."""

import json
import sqlite3
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import asdict
from functools import wraps
from operator import itemgetter
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

from mkpc_kaggle.engine.jobs import Estimated, Outcome, PairPoints, WantedPair
from mkpc_kaggle.engine.journal_reader import (
    FILE_NAME,
    FORMAT,
    About,
    Event,
    JournalReader,
    SceneRecord,
    connected,
    to_blob,
    undamaged,
)
from mkpc_kaggle.errors import UserError, printable, writing
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.scene.choose import Choice

LOCK_NAME = "journal.lock"
SCHEMA = Path(__file__).with_name("schema.sql")
ENDS = "(image0, image1, turns0, turns1)"  # columns that identify a pair
MIN_SQLITE = (3, 37, 0)  # STRICT tables

Method = TypeVar("Method", bound=Callable[..., None])


def saving(save: Method) -> Method:
    """Run a method as one transaction. If the file accepts no more data, continue in memory."""

    @wraps(save)
    def transaction(self: "Journal", *args: Any, **named: Any) -> None:
        try:
            with self._db:
                self._db.execute("BEGIN")
                save(self, *args, **named)
        except sqlite3.OperationalError as error:
            if self.is_in_memory:
                raise
            self._continue_in_memory(str(error))
            transaction(self, *args, **named)

    return cast(Method, transaction)


class Journal(JournalReader):
    """The journal of a work directory, created if missing. No other run can open it at the same time.

    If the file accepts no more data (a full disk), the journal continues in memory, and :meth:`close` copies it
    back. ``trouble`` is the reason. Raises :class:`UserError` if the directory is not writable or is in use.
    """

    def __init__(self, directory: Path, *, fresh: bool = False) -> None:
        if sqlite3.sqlite_version_info < MIN_SQLITE:
            raise UserError(
                f"SQLite {sqlite3.sqlite_version} is too old: Python needs 3.37 or newer for the journal"
            )
        self.path, lock = directory / FILE_NAME, directory / LOCK_NAME
        self.trouble = ""
        with ExitStack() as opened, writing(f"the work directory {directory}"):  # kept open unless an error occurs
            directory.mkdir(parents=True, exist_ok=True)
            for path in (lock, self.path):
                if path.exists() and not path.is_file():
                    raise UserError(f"{path} is not a regular file; remove it, or name another --work-dir")
            with undamaged(lock, "remove it"):
                self._lock = opened.enter_context(closing(connected(lock)))
                self._lock.execute("BEGIN EXCLUSIVE")  # on a separate file, so others can read the journal
            if fresh:
                for ending in ("", "-journal", "-wal", "-shm"):
                    directory.joinpath(FILE_NAME + ending).unlink(missing_ok=True)
            with undamaged(self.path):
                self._file = self._db = opened.enter_context(closing(connected(self.path)))
                try:
                    self._open()
                except sqlite3.OperationalError as error:  # a full disk
                    self._continue_in_memory(str(error))
                    self._open()
            opened.pop_all()

    @property
    def is_in_memory(self) -> bool:
        return self._db is not self._file

    def close(self) -> None:
        with suppress(sqlite3.Error):  # if the disk is still full, the file stays valid
            if self.is_in_memory:
                self._db.backup(self._file)
        with suppress(sqlite3.Error):  # unless a reader uses the file
            self._file.execute("PRAGMA journal_mode = DELETE")  # a single file, which can be copied
        self._file.close()
        super().close()
        self._lock.close()

    # The request

    @saving
    def want(
        self,
        pairs: Sequence[WantedPair],
        units: Sequence[tuple[Unit, str]],
        batches: Mapping[str, str],
        about: About | None = None,
    ) -> None:
        """Replace the request: pairs, units with their settings, and the settings of each batch's scene."""
        for table in ("wanted_unit", "wanted_pair", "wanted_batch", "about"):
            self._db.execute(f"DELETE FROM {table}")
        self._insert("about", value=json.dumps(asdict(about or About())))
        for number, (unit, settings) in enumerate(units):
            self._insert("wanted_unit", number=number, unit=unit.name, stage=unit.stage, settings=settings)
        for batch, settings in batches.items():
            self._insert("wanted_batch", batch=batch, settings=settings)
        ends = [(*map(printable, each.names), *each.pair.turns) for each in pairs]
        self._db.executemany(f"INSERT OR IGNORE INTO pair {ENDS} VALUES (?, ?, ?, ?)", ends)
        rows = (
            (position, printable(each.pair.id), printable(each.pair.group), each.settings, each.has_row, *end)
            for position, (each, end) in enumerate(zip(pairs, ends, strict=True))
        )
        add = f"INSERT INTO wanted_pair SELECT ?, ?, ?, id, ?, ?, '' FROM pair WHERE {ENDS} = (?, ?, ?, ?)"
        self._db.executemany(add, rows)

    def digests(self) -> dict[str, str]:
        """Return the saved digests of the images of wanted pairs, by name."""
        return dict(self._read(tuple, "SELECT DISTINCT name, digest FROM pair_image"))

    # The state of the run

    def twins(self, position: int) -> list[int]:
        """Return the positions of all rows with the same pair as ``position``."""
        query = """SELECT w.position FROM wanted_pair w JOIN wanted_pair asked ON asked.pair = w.pair
            WHERE asked.position = ? ORDER BY w.position"""
        return self._read(itemgetter(0), query, position)

    def states(self, positions: Iterable[int] | None = None) -> list[tuple[Any, ...]]:
        """Return rows of the view ``pair_state``, for all pairs or for the given positions."""
        if positions is None:
            return self._read(tuple, "SELECT * FROM pair_state")
        query = "SELECT * FROM pair_state WHERE position = ?"
        return [row for position in positions for row in self._read(tuple, query, position)]

    def batch_inputs(self, batch: str) -> str:
        """Return the current revisions of a batch's points, from which a scene would be computed."""
        query = "SELECT coalesce(inputs, '') FROM batch_inputs WHERE batch = ?"
        return next(iter(self._read(itemgetter(0), query, batch)), "")

    def current_scenes(self) -> set[str]:
        return set(self._read(itemgetter(0), "SELECT batch FROM standing_scene WHERE is_current"))

    # Results

    @saving
    def save_digest(self, name: str, digest: str) -> None:
        """Save the digest of an image's changed content."""
        self._db.execute("UPDATE image SET digest = ? WHERE name = ?", [digest, printable(name)])

    @saving
    def save_outcomes(self, outcomes: Sequence[Outcome], settings: Mapping[str, str]) -> None:
        """Save the results of a job on all its pairs, or none; ``settings`` are by unit name."""
        for outcome in outcomes:
            failure = [printable(outcome.failure), outcome.index]
            self._db.execute("UPDATE wanted_pair SET failure = ? WHERE position = ?", failure)
            for image in outcome.images:
                self._insert("image", **image.size._asdict(), **columns(image, "size"))
            count = max(1, len(outcome.found))  # number of units, which share the pair's seconds
            row = {"pair": self._wanted(outcome.index)["pair"], "decode_seconds": outcome.decode_seconds / count}
            row |= {"cluster_seconds": outcome.cluster_seconds / count}
            row |= {f"digest{side}": image.digest for side, image in enumerate(outcome.images)}
            for found in outcome.found:
                row |= columns(found, "unit", "warm_up") | {"settings": settings[found.unit.name]}
                row |= {"matches": len(found.matches), "points": to_blob(found.matches)}
                revision = self._insert("points", **row)
                for side, region in enumerate((outcome.regions or ()) if found.unit.stage == 2 else ()):
                    row_of = columns(region, "box") | columns(region.box)
                    self._insert("region", points=revision, image=side, **row_of)

    @saving
    def save_estimates(self, estimates: Sequence[Estimated]) -> None:
        for each in estimates:
            pair, row = self._wanted(each.index), columns(each, "index", "stats", "inliers") | columns(each.stats)
            inliers = json.dumps(dict(zip(each.inputs, each.inliers, strict=True)))
            self._insert("estimate", pair=pair["pair"], settings=pair["settings"], inliers=inliers, **row)

    @saving
    def save_scene(
        self, scene: SceneRecord, inputs: str, pairs: Sequence[PairPoints], choices: Sequence[Choice]
    ) -> None:
        """Save the reconstruction of a batch and the choice for each of its pairs."""
        query = "SELECT settings FROM wanted_batch WHERE batch = ?"
        ((settings,),) = self._db.execute(query, [printable(scene.batch)])
        revision = self._insert("scene", settings=settings, inputs=inputs, **columns(scene, "models"))
        for number, model in enumerate(scene.models):
            self._insert("model", scene=revision, number=number, **columns(model, "images", "colmap"))
            for found in model.images:
                row = columns(found.camera) | columns(found.image, "size", "focal")
                row |= found.image.size._asdict() | (found.sigmas._asdict() if found.sigmas else {})
                self._insert("camera", scene=revision, model=number, points=found.points, **row)
        for pair, chosen in zip(pairs, choices, strict=True):
            number = self._wanted(pair.index)["pair"]
            self._insert("choice", scene=revision, pair=number, inputs=pair.revisions, **columns(chosen))

    @saving
    def forget_scene(self, batch: str) -> None:
        """Delete the scenes of a batch whose exported files are missing or were replaced."""
        self._db.execute("DELETE FROM scene WHERE batch = ?", [batch])

    @saving
    def save_feature(self, digest: str, settings: str, value: bytes) -> None:
        self._insert("feature", digest=digest, settings=settings, value=value)

    def note(self, event: Event) -> None:
        """Save an event, or drop it if the journal cannot be written."""
        with suppress(sqlite3.Error):
            self._insert("event", **columns(event))

    def _insert(self, table: str, **row: Any) -> int:
        """Insert or replace a row, given as values by column name. Return the row's number."""
        names, marks = ", ".join(f'"{name}"' for name in row), ", ".join("?" * len(row))
        query = f"REPLACE INTO {table} ({names}) VALUES ({marks}) RETURNING rowid"
        ((number,),) = self._db.execute(query, [*map(stored, row.values())])
        return int(number)

    def _wanted(self, position: int) -> sqlite3.Row:
        query = "SELECT * FROM wanted_pair WHERE position = ?"
        row: sqlite3.Row = self._db.execute(query, [position]).fetchone()
        return row

    def _continue_in_memory(self, trouble: str) -> None:
        """Copy the journal into memory, and write only there from now on."""
        self.trouble, memory = trouble, connected(":memory:")
        try:
            self._file.backup(memory)
        except sqlite3.OperationalError:  # a full disk has no room for SQLite's locks, either
            with closing(connected(self.path, "immutable=1")) as file:
                file.backup(memory)
        memory.execute("PRAGMA foreign_keys = ON")
        self._db = memory

    def _open(self) -> None:
        if self._db.execute("SELECT 1 FROM sqlite_master").fetchone() is None:
            self._db.execute("PRAGMA journal_mode = WAL")
            self._db.executescript(
                f"BEGIN; {SCHEMA.read_text(encoding='utf-8')} PRAGMA user_version = {FORMAT}; COMMIT;"
            )
        else:
            self._check()
            self._db.execute("PRAGMA journal_mode = WAL")
        # Readers do not block the writer. A kill loses no result; a power failure may lose the latest results.
        self._db.execute("PRAGMA synchronous = NORMAL")
        self._db.execute("PRAGMA foreign_keys = ON")


def columns(value: Any, *without: str) -> dict[str, Any]:
    """Return a dataclass's fields by name, as columns of a table. Omit the fields named in ``without``."""
    return {name: item for name, item in vars(value).items() if name not in without}


def stored(value: Any) -> Any:
    """Return a value as stored in a column: a matrix as bytes, a tuple as text."""
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, np.ndarray):
        return value.astype(np.float64).tobytes()
    return " ".join(map(str, value)) if isinstance(value, tuple) else value
