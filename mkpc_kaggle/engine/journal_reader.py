"""Reading the journal of a run: its rows as values, at one moment.

``schema.sql`` has the tables, and in its views the rule that says which rows are current.
"""

import json
import os
import sqlite3
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, Self

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.budget import format_duration
from mkpc_kaggle.engine.codec import from_blob, matrix_of, vector_of
from mkpc_kaggle.engine.records import NOT_REACHED, CameraRecord, PairRecord, SceneRecord, UnitRecord
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Box, Size
from mkpc_kaggle.geometry.critical_region import CriticalRegion, RegionReason
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import EstimateStats
from mkpc_kaggle.scene.choose import Choice, Reason
from mkpc_kaggle.scene.view_graph import BatchImage

FORMAT = 11
FILE_NAME = "journal.sqlite"
LOCK_NAME = "journal.lock"
SCHEMA = Path(__file__).with_name("schema.sql")
MIN_SQLITE = (3, 37, 0)  # STRICT tables

UNITS = """SELECT position, revision, decode_seconds, cluster_seconds, unit, stage, matches, encode_seconds,
    match_seconds, failure, note, keypoints FROM current_points ORDER BY position, number"""

# SQLite's primary result codes that say nothing against a file: no permission, busy, locked, read only, input or
# output failed, full, cannot be opened.
UNUSABLE = {3, 5, 6, 8, 10, 13, 14}
# Errors of reading what no run writes.
DAMAGE = (
    *(sqlite3.Error, zlib.error, ValueError, TypeError),
    *(LookupError, AttributeError, ArithmeticError, RecursionError),
)


class EventKind(StrEnum):
    """What is noted during a run."""

    START = "start"  # the program began or resumed the run
    PLAN = "plan"  # a decision, and why
    JOB = "job"  # a job has ended; the text begins with its phase
    SCENE = "scene"  # a batch was reconstructed; the text says how much of it
    FAULT = "fault"
    END = "end"  # the run ended; the text says how


@dataclass(frozen=True)
class Event:
    """Something that happened ``seconds`` after the start of the program; ``kind`` is an :class:`EventKind`."""

    kind: str
    seconds: float
    text: str

    def __str__(self) -> str:
        return f"{format_duration(self.seconds):>7}  {self.text}"


@dataclass(frozen=True)
class About:
    """The latest run that wrote a journal, for reports."""

    recipe: Mapping[str, Any] = field(default_factory=dict)  # a table as of a recipe's file, and its name
    device: str = ""
    limit: float | None = None  # in seconds; None: no limit
    left_out: tuple[str, ...] = ()  # matchers that did not run, by cause
    versions: Mapping[str, str] = field(default_factory=dict)  # of the package and its main dependencies


@contextmanager
def undamaged(path: Path, advice: str = "delete it with --fresh") -> Iterator[None]:
    """Raise :class:`UserError` if a journal holds what no run writes, or cannot be used now."""
    try:
        yield
    except DAMAGE as error:
        if getattr(error, "sqlite_errorcode", sqlite3.SQLITE_ERROR) & 0xFF in UNUSABLE:
            raise UserError(f"{path} cannot be used: {error}; is another run using it?") from error
        raise UserError(f"{path} is damaged ({error}); {advice}") from error


class JournalReader:
    """The journal of a work directory at one moment; a run may be writing to it meanwhile.

    Raises :class:`UserError` if the file is missing, damaged, or of another format.
    """

    path: Path
    _db: sqlite3.Connection

    def __init__(self, directory: Path, *, check: bool = True) -> None:
        path = directory / FILE_NAME
        if not path.is_file():
            raise UserError(f"{directory} has no {FILE_NAME}: name the work directory of a run (NAME.work)")
        # A directory that cannot be written has no room for SQLite's locks, and needs none.
        mode = "mode=ro" if os.access(directory, os.W_OK) else "mode=ro&immutable=1"
        with ExitStack() as opened, undamaged(path):
            uri = f"{path.resolve().as_uri()}?{mode}"
            db = opened.enter_context(closing(sqlite3.connect(uri, uri=True, timeout=5.0, isolation_level=None)))
            db.execute("BEGIN")
            self.path, self._db = path, db
            if check:
                self._check()
            opened.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._db.close()

    def about(self) -> About:
        with undamaged(self.path):
            values = json.loads(*self._rows("SELECT value FROM about")[0])
            return About(**{**values, "left_out": tuple(values["left_out"])})

    def events(self) -> tuple[Event, ...]:
        """Return all events of all sessions, in order."""
        with undamaged(self.path):
            return tuple(
                Event(*row) for row in self._rows("SELECT kind, seconds, text FROM event ORDER BY number")
            )

    def pairs(self) -> tuple[Pair, ...]:
        """Return the pairs that have a row, in order, with the names of their images for files."""
        query = """SELECT w.id, batch, image0, image1, turns0, turns1 FROM wanted_pair w
            JOIN pair ON pair.id = w.pair WHERE has_row ORDER BY position"""
        with undamaged(self.path):
            rows = self._rows(query)
            return tuple(Pair(n, b, f0, f1, turns=(t0, t1)) for n, b, f0, f1, t0, t1 in rows)

    def records(self) -> list[PairRecord]:
        """Return a record of each pair that has a row, in order."""
        with undamaged(self.path):
            query = "SELECT position, failure FROM wanted_pair WHERE has_row ORDER BY position"
            values: dict[int, dict[str, Any]] = {
                n: {"failure": why or NOT_REACHED} for n, why in self._rows(query)
            }
            inliers: dict[int, int] = {}
            for position, inputs, counts, F, magsac, failure, seconds, *stats, rotation in self._rows(
                """SELECT position, inputs, inliers, F, magsac, failure, seconds, candidates, cost, magsac_cost,
                focal0, focal1, support, rotation FROM standing_estimate"""
            ):
                if position in values:
                    inliers |= zip(map(int, inputs.split()), map(int, counts.split()), strict=True)
                    values[position] |= {
                        "pair_fundamental": matrix_of(F),
                        "magsac_fundamental": None if magsac is None else matrix_of(magsac),
                        "failure": failure,
                        "estimate_seconds": seconds,
                        "stats": EstimateStats(
                            *(stats[0], stats[1], stats[2], (stats[3], stats[4]), stats[5]),
                            rotation=tuple(vector_of(rotation).tolist()),
                        ),
                    }
            for position, units in groupby(self._rows(UNITS), itemgetter(0)):
                if position in values:
                    values[position] |= _units(list(units), inliers)
            regions, choices = self._regions(), self._choices()
            return [
                PairRecord(position, **fields, regions=regions.get(position), scene=choices.get(position))
                for position, fields in values.items()
            ]

    def scenes(self) -> dict[str, SceneRecord]:
        """Return the standing reconstruction of each batch that has one."""
        with undamaged(self.path):
            scenes = {}
            for revision, *row in self._rows(
                """SELECT revision, batch, images, registered, models, points, seconds, failure FROM standing_scene
                ORDER BY batch"""
            ):
                cameras = self._rows("SELECT * FROM camera WHERE scene = ? ORDER BY rowid", revision)
                clouds = self._rows("SELECT points FROM cloud WHERE scene = ? ORDER BY model", revision)
                drawn = tuple(map(_camera, cameras)), tuple(map(_cloud, clouds))
                scenes[row[0]] = replace(SceneRecord(*row), cameras=drawn[0], clouds=drawn[1])
            return scenes

    def points(self, revisions: Iterable[int]) -> dict[int, Matches]:
        """Return the points of these rows, by revision."""
        with undamaged(self.path):
            return {revision: from_blob(blob) for revision, blob in self.blobs(revisions).items()}

    def blobs(self, revisions: Iterable[int]) -> dict[int, bytes]:
        with undamaged(self.path):
            query = "SELECT points FROM points WHERE revision = ?"
            return {revision: self._rows(query, revision)[0][0] for revision in revisions}

    def inputs(self, position: int) -> dict[str, int]:
        """Return the revisions of a pair's current points by unit, in the recipe's order."""
        query = "SELECT unit, revision FROM current_points WHERE position = ? ORDER BY number"
        with undamaged(self.path):
            return dict(self._rows(query, position))

    def images(self, position: int) -> tuple[BatchImage, ...]:
        """Return both images of a pair as they were last looked at, or nothing."""
        query = """SELECT name, digest, width, height, focal FROM wanted_pair w JOIN pair ON pair.id = w.pair
            JOIN image ON image.name = {} WHERE position = ?"""
        with undamaged(self.path):
            rows = [row for end in ("image0", "image1") for row in self._rows(query.format(end), position)]
            images = tuple(BatchImage(name, digest, Size(w, h), focal) for name, digest, w, h, focal in rows)
            return images if len(images) == 2 else ()

    def feature(self, digest: str, settings: str) -> bytes | None:
        """Return the features saved under a key, or ``None``."""
        with undamaged(self.path):
            found = self._rows("SELECT value FROM feature WHERE digest = ? AND settings = ?", digest, settings)
        return found[0][0] if found else None

    def _regions(self) -> dict[int, Any]:
        """The critical regions of each pair's first unit of stage 2."""
        found: dict[int, dict[int, CriticalRegion]] = {}
        for position, image, *box, reason, clusters, kept in self._rows(
            """SELECT position, r.image, r."left", r.top, r."right", r.bottom, r.reason, r.clusters, r.kept
            FROM current_points c JOIN region r ON r.points = c.revision ORDER BY position, c.number DESC"""
        ):
            region = CriticalRegion(Box(*box), RegionReason(reason), clusters, kept)
            found.setdefault(position, {})[image] = region
        return {position: (both[0], both[1]) for position, both in found.items()}

    def _choices(self) -> dict[int, Choice]:
        rows = self._rows(
            """SELECT w.position, c.F, c.reason FROM standing_scene s JOIN choice c ON c.scene = s.revision
            JOIN wanted_pair w ON w.pair = c.pair AND w.batch = s.batch"""
        )
        return {position: Choice(None if F is None else matrix_of(F), Reason(why)) for position, F, why in rows}

    def _rows(self, query: str, *values: Any) -> list[Any]:
        return self._db.execute(query, values).fetchall()

    def _check(self) -> None:
        """Raise :class:`UserError` for a journal of another format, ``sqlite3.Error`` for a damaged journal."""
        (written,) = self._rows("PRAGMA user_version")[0]
        if written != FORMAT:
            raise UserError(
                f"{self.path} was written by another version of this program (its format is not {FORMAT}). "
                "Use that version, delete it with --fresh, or name another --work-dir."
            )
        if (trouble := self._rows("PRAGMA quick_check(1)")[0][0]) != "ok":
            raise sqlite3.DatabaseError(trouble)


def _units(rows: Sequence[Any], inliers: Mapping[int, int]) -> dict[str, Any]:
    """The fields of a :class:`PairRecord` that come from rows of the query :data:`UNITS`."""
    units = tuple(UnitRecord(row[4], row[5], row[6], inliers.get(row[1], 0), *row[7:]) for row in rows)
    decode, cluster = (sum(row[column] for row in rows) for column in (2, 3))
    return {"units": units, "decode_seconds": decode, "cluster_seconds": cluster}


def _camera(row: Sequence[Any]) -> CameraRecord:
    _, image, digest, model, *axes, focal, width, height, seen, rotation, centre_sigma, focal_sigma = row
    centre, forward, down = (tuple(vector_of(blob).tolist()) for blob in axes)
    sigmas = () if rotation is None else (rotation, centre_sigma, focal_sigma)
    return CameraRecord(image, digest, model, centre, forward, down, focal, Size(width, height), seen, sigmas)


def _cloud(row: Sequence[Any]) -> tuple[Any, ...]:
    return tuple(map(tuple, vector_of(row[0]).reshape(-1, 3).tolist()))
