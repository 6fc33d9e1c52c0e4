"""The durable record of a run: an SQLite file that only the parent writes, a transaction for each answer."""

import json
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import asdict, astuple
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from mkpc_kaggle.data.images import printable
from mkpc_kaggle.engine.jobs import Estimated, Outcome, PairPoints, WantedPair
from mkpc_kaggle.engine.journal_reader import FILE_NAME, FORMAT, About, Event, JournalReader, undamaged
from mkpc_kaggle.engine.records import SceneRecord
from mkpc_kaggle.errors import UserError, writing
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.recipe import Unit
from mkpc_kaggle.scene.choose import Choice

LOCK_NAME = "journal.lock"
SCHEMA = Path(__file__).with_name("schema.sql")
MIN_SQLITE = (3, 37, 0)  # STRICT tables


class Journal(JournalReader):
    """The journal of a work directory, created if missing. No other run can open it meanwhile.

    When the file takes no more (a full disk), the journal continues in memory, and is copied back when it is
    closed. ``trouble`` has the reason. Raises :class:`UserError` if the directory cannot be written or is used.
    """

    def __init__(self, directory: Path, *, fresh: bool = False) -> None:
        if sqlite3.sqlite_version_info < MIN_SQLITE:
            raise UserError(
                f"SQLite {sqlite3.sqlite_version} is too old: Python needs 3.37 or newer for the journal"
            )
        path, lock = directory / FILE_NAME, directory / LOCK_NAME
        self.trouble = ""
        with ExitStack() as opened, writing(f"the work directory {directory}"):  # stays open if all is well
            directory.mkdir(parents=True, exist_ok=True)
            self._lock = opened.enter_context(closing(connect(lock)))
            with undamaged(lock, "remove it"):
                self._lock.execute("BEGIN EXCLUSIVE")  # another file: a journal can be read while its run works
            if fresh:
                for ending in ("", "-journal", "-wal", "-shm"):
                    path.with_name(FILE_NAME + ending).unlink(missing_ok=True)
            self.path = path
            self._file = self._db = opened.enter_context(closing(connect(path)))
            with undamaged(path):
                try:
                    self._open()
                except sqlite3.OperationalError as error:  # a full disk
                    self.trouble = str(error)
                    self._db = sqlite3.connect(":memory:", isolation_level=None)
                    self._open()
            opened.pop_all()

    @property
    def is_in_memory(self) -> bool:
        return self._db is not self._file

    def close(self) -> None:
        with suppress(sqlite3.Error):  # the disk is still full: what the file has is whole
            if self.is_in_memory:
                self._db.backup(self._file)
        with suppress(sqlite3.Error):  # a reader is using it
            self._file.execute("PRAGMA journal_mode = DELETE")  # a single file again, which can be copied
        self._file.close()
        super().close()
        self._lock.close()

    # What the run asks for

    def want(
        self,
        pairs: Sequence[WantedPair],
        units: Sequence[tuple[Unit, str]],
        batches: Mapping[str, str],
        about: About | None = None,
    ) -> None:
        """Replace what the run asks for: pairs, units with their settings, settings of each batch's scene."""

        def write(db: sqlite3.Connection) -> None:
            for table in ("wanted_unit", "wanted_pair", "wanted_batch", "about"):
                db.execute(f"DELETE FROM {table}")
            db.execute("INSERT INTO about VALUES (?)", [json.dumps(asdict(about or About()))])
            rows = ((n, unit.name, unit.stage, settings) for n, (unit, settings) in enumerate(units))
            db.executemany("INSERT INTO wanted_unit VALUES (?, ?, ?, ?)", rows)
            db.executemany("INSERT INTO wanted_batch VALUES (?, ?)", batches.items())
            ends = ((*map(printable, each.names), *each.pair.turns) for each in pairs)
            db.executemany("INSERT OR IGNORE INTO pair (image0, image1, turns0, turns1) VALUES (?, ?, ?, ?)", ends)
            db.executemany(
                """INSERT INTO wanted_pair SELECT ?, ?, ?, id, ?, ?, '' FROM pair
                WHERE image0 = ? AND image1 = ? AND turns0 = ? AND turns1 = ?""",
                map(_wanted_row, count(), pairs),
            )

        self._write(write)

    def digests(self) -> dict[str, str]:
        """Return the digest of each image of a wanted pair that was looked at, by name."""
        query = """SELECT DISTINCT image.name, digest FROM wanted_pair w JOIN pair ON pair.id = w.pair
            JOIN image ON image.name IN (image0, image1)"""
        with undamaged(self.path):
            return dict(self._rows(query))

    # The state of the run

    def twins(self) -> dict[int, tuple[int, ...]]:
        """Return the positions of pairs that several rows name, by each of these positions."""
        query = "SELECT group_concat(position) FROM wanted_pair GROUP BY pair HAVING count(*) > 1"
        with undamaged(self.path):
            groups = [tuple(map(int, row[0].split(","))) for row in self._rows(query)]
        return {position: group for group in groups for position in group}

    def had(self, positions: Iterable[int] | None = None) -> Iterator[tuple[int, int, int]]:
        """Yield (position, number of the unit, matches) of the current points, of all pairs or of these."""
        yield from self._of("SELECT position, number, matches FROM current_points", positions)

    def estimated(self, positions: Iterable[int] | None = None) -> Iterator[tuple[int, bytes, int, str]]:
        """Yield (position, F, inliers, failure) of the standing estimates."""
        query = "SELECT position, F, inliers, failure FROM standing_estimate"
        for position, F, inliers, failure in self._of(query, positions):
            yield position, F, sum(map(int, inliers.split())), failure

    def currently_estimated(self, positions: Iterable[int] | None = None) -> Iterator[int]:
        """Yield the positions of the pairs whose estimate is current."""
        yield from (position for (position,) in self._of("SELECT position FROM current_estimate", positions))

    def chosen(self) -> Iterator[tuple[int, Choice]]:
        """Yield (position, choice) of the standing scenes."""
        with undamaged(self.path):
            yield from self._choices().items()

    def batch_inputs(self, batch: str) -> str:
        """Return the revisions that a scene of a batch would be computed from now."""
        with undamaged(self.path):
            rows = self._rows("SELECT inputs FROM batch_inputs WHERE batch = ?", batch)
            return str(rows[0][0] or "") if rows else ""

    def current_scenes(self) -> set[str]:
        with undamaged(self.path):
            return {batch for (batch,) in self._rows("SELECT batch FROM current_scene")}

    def _of(self, query: str, positions: Iterable[int] | None) -> Iterator[Any]:
        with undamaged(self.path):
            if positions is None:
                yield from self._db.execute(query)
            else:
                for position in positions:
                    yield from self._db.execute(f"{query} WHERE position = ?", [position])

    # Results

    def save_digest(self, name: str, digest: str) -> None:
        """Save that an image has another content than it had."""
        self._write(lambda db: db.execute("UPDATE image SET digest = ? WHERE name = ?", [digest, printable(name)]))

    def save_outcomes(self, outcomes: Iterable[Outcome], settings: Mapping[str, str]) -> None:
        """Save what a job found on its pairs, all or nothing; ``settings`` by the names of units."""

        def write(db: sqlite3.Connection) -> None:
            for outcome in outcomes:
                failure = [printable(outcome.failure), outcome.index]
                db.execute("UPDATE wanted_pair SET failure = ? WHERE position = ?", failure)
                for image in outcome.images:
                    row = (printable(image.name), image.digest, *image.size, image.focal)
                    db.execute("REPLACE INTO image VALUES (?, ?, ?, ?, ?)", row)
                digests = [image.digest for image in outcome.images]
                for found in outcome.found:
                    values = (
                        (outcome.decode_seconds, outcome.cluster_seconds) if found is outcome.found[0] else (0, 0)
                    )
                    (revision,) = db.execute(
                        f"""REPLACE INTO points (pair, settings, digest0, digest1, matches, keypoints,
                        decode_seconds, cluster_seconds, encode_seconds, match_seconds, failure, note, points)
                        SELECT pair, {", ".join("?" * 12)} FROM wanted_pair WHERE position = ?
                        RETURNING revision""",
                        (
                            *(settings[found.unit.name], *digests, found.matches, found.keypoints, *values),
                            *(found.encode_seconds, found.match_seconds, printable(found.failure)),
                            *(printable(found.note), found.points, outcome.index),
                        ),
                    ).fetchone()
                    for number, region in enumerate((outcome.regions or ()) if found.unit.stage == 2 else ()):
                        box = astuple(region.box)
                        values = (revision, number, *box, region.reason, region.clusters, region.kept)
                        db.execute(f"INSERT INTO region VALUES ({', '.join('?' * 9)})", values)

        self._write(write)

    def save_estimates(self, estimates: Iterable[Estimated]) -> None:
        rows = [
            (
                *(joined(each.inputs), joined(each.inliers)),
                *(
                    each.F.tobytes(),
                    None if each.magsac is None else each.magsac.tobytes(),
                    printable(each.failure),
                ),
                *(each.stats.support, each.stats.candidates, each.stats.cost, each.stats.magsac_cost),
                *(*each.stats.focals, float_bytes(each.stats.rotation), each.seconds, each.index),
            )
            for each in estimates
        ]
        self._write(
            lambda db: db.executemany(
                f"""REPLACE INTO estimate (pair, settings, inputs, inliers, F, magsac, failure, support,
                candidates, cost, magsac_cost, focal0, focal1, rotation, seconds)
                SELECT pair, settings, {", ".join("?" * 13)} FROM wanted_pair WHERE position = ?""",
                rows,
            )
        )

    def save_scene(
        self, scene: SceneRecord, inputs: str, pairs: Sequence[PairPoints], choices: Sequence[Choice]
    ) -> None:
        """Save the reconstruction of a batch with the choices for its pairs."""

        def write(db: sqlite3.Connection) -> None:
            head = (scene.images, scene.registered, scene.models, scene.points, scene.seconds)
            (revision,) = db.execute(
                f"""REPLACE INTO scene (batch, settings, inputs, images, registered, models, points, seconds,
                failure) SELECT batch, settings, {", ".join("?" * 7)} FROM wanted_batch WHERE batch = ?
                RETURNING revision""",
                (inputs, *head, printable(scene.failure), scene.batch),
            ).fetchone()
            for camera in scene.cameras:
                axes = map(float_bytes, (camera.centre, camera.forward, camera.down))
                sigmas = camera.sigmas or (None, None, None)
                values = (camera.model, *axes, camera.focal, *camera.size, camera.seen, *sigmas)
                row = (revision, printable(camera.image), camera.digest, *values)
                db.execute(f"INSERT INTO camera VALUES ({', '.join('?' * 14)})", row)
            for model, cloud in enumerate(scene.clouds):
                db.execute("INSERT INTO cloud VALUES (?, ?, ?)", (revision, model, float_bytes(cloud)))
            rows = (
                (revision, joined(pair.revisions), chosen.reason, blob_of(chosen.F), pair.index)
                for pair, chosen in zip(pairs, choices, strict=True)
            )
            db.executemany("REPLACE INTO choice SELECT ?, pair, ?, ?, ? FROM wanted_pair WHERE position = ?", rows)

        self._write(write)

    def forget_scene(self, batch: str) -> None:
        """Delete the scenes of a batch: its files were removed."""
        self._write(lambda db: db.execute("DELETE FROM scene WHERE batch = ?", [batch]))

    def save_feature(self, digest: str, settings: str, value: bytes) -> None:
        self._write(lambda db: db.execute("REPLACE INTO feature VALUES (?, ?, ?)", [digest, settings, value]))

    def note(self, event: Event) -> None:
        """Note an event; it is lost if the journal cannot be written."""
        values = [event.kind, event.seconds, printable(event.text)]
        with suppress(sqlite3.Error):
            self._db.execute("INSERT INTO event (kind, seconds, text) VALUES (?, ?, ?)", values)

    def _write(self, write: Any) -> None:
        """Run a transaction. If the file takes no more, continue in memory."""
        try:
            self._transact(write)
        except sqlite3.OperationalError as error:
            if self.is_in_memory:
                raise
            self.trouble = str(error)
            self.continue_in_memory()
            self._transact(write)

    def continue_in_memory(self) -> None:
        """Copy everything into memory, and write there from now on."""
        memory = sqlite3.connect(":memory:", isolation_level=None)
        self._file.backup(memory)
        memory.execute("PRAGMA foreign_keys = ON")
        self._db = memory

    def _transact(self, write: Any) -> None:
        with self._db:
            self._db.execute("BEGIN")
            write(self._db)

    def _open(self) -> None:
        if self._db.execute("SELECT 1 FROM sqlite_master").fetchone() is None:
            self._db.execute("PRAGMA journal_mode = WAL")
            self._db.executescript(
                f"BEGIN; {SCHEMA.read_text(encoding='utf-8')} PRAGMA user_version = {FORMAT}; COMMIT;"
            )
        else:
            self._check()
            self._db.execute("PRAGMA journal_mode = WAL")
        # Readers do not hold up the writer. A kill loses no result, a power failure the latest results.
        self._db.execute("PRAGMA synchronous = NORMAL")
        self._db.execute("PRAGMA foreign_keys = ON")


def _wanted_row(position: int, wanted: WantedPair) -> tuple[Any, ...]:
    pair, ends = wanted.pair, (*map(printable, wanted.names), *wanted.pair.turns)
    return position, printable(pair.id), printable(pair.group), wanted.settings, wanted.has_row, *ends


def joined(numbers: Iterable[int]) -> str:
    return " ".join(map(str, numbers))


def blob_of(F: Matrix3 | None) -> bytes | None:
    return None if F is None else F.tobytes()


def float_bytes(values: Any) -> bytes:
    return np.asarray(values, np.float64).tobytes()


def connect(path: Path) -> sqlite3.Connection:
    """Open a database to write. Raise :class:`UserError` if that is impossible."""
    if path.exists() and not path.is_file():
        raise UserError(f"{path} is not a regular file; remove it, or name another --work-dir")
    with undamaged(path):
        return sqlite3.connect(path, timeout=1.0, isolation_level=None)
