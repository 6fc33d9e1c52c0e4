"""What a journal tells of a run: read at one moment, kept as a value, exported to tables."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.jobs import Record
from mkpc_kaggle.engine.journal import DRAWN, About, Event, EventKind, JournalReader
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.pipeline.stages import UnitResult
from mkpc_kaggle.recipe import Recipe, recipe_of
from mkpc_kaggle.reporting.summary import account, headline

NOT_ENDED = "not ended (at work, or killed)"
F_COLUMNS = tuple(f"f{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3))


@dataclass(frozen=True, eq=False)
class WeakPair:
    """One of the weakest pairs, with its matches by unit where the journal still has them."""

    record: Record
    results: tuple[UnitResult, ...]


@dataclass(frozen=True, eq=False)
class RunLog:
    """A run as its journal tells it.

    ``records`` are one a pair, in order, those not reached among them. ``events`` are those of all sessions;
    ``weakest`` are the pairs with the fewest inliers of those that were matched. ``digests`` are those of the
    test set and of the weights, by name.
    """

    path: Path
    about: About
    recipe: Recipe
    digests: dict[str, str]
    pairs: tuple[Pair, ...]
    records: tuple[Record, ...]
    events: tuple[Event, ...]
    weakest: tuple[WeakPair, ...]

    @property
    def session(self) -> tuple[Event, ...]:
        """The events since the run was last started."""
        starts = [place for place, event in enumerate(self.events) if event.kind == EventKind.START]
        return self.events[starts[-1] :] if starts else self.events

    @property
    def ending(self) -> str:
        ends = [event.text for event in self.session if event.kind == EventKind.END]
        return ends[-1] if ends else NOT_ENDED

    @property
    def seconds(self) -> float:
        """How long the last session took, or had taken when it last noted something."""
        return max((event.seconds for event in self.session), default=0.0)

    @property
    def faults(self) -> list[str]:
        return [event.text for event in self.events if event.kind == EventKind.FAULT]


def read_log(directory: Path) -> RunLog:
    """Read the journal of a work directory, of a run at work or ended.

    Raises :class:`UserError` where there is none, or none that this version can read.
    """
    with JournalReader(directory) as journal:
        about, belongs_to, pairs = journal.about(), journal.belongs_to(), journal.pairs()
        recipe = recipe_of(belongs_to.get("recipe", {}), about.recipe)
        known = journal.records()
        records = tuple(known.get(index) or Record.untouched(index) for index in range(len(pairs)))
        touched = sorted((record for record in records if record.units), key=lambda r: (r.inliers, r.index))
        units = {unit.name: unit for unit in recipe.units}
        weakest = tuple(WeakPair(record, journal.results(record.index, units)) for record in touched[:DRAWN])
        digests = {"test set": str(belongs_to.get("test set", "")), **belongs_to.get("weights", {})}
        return RunLog(journal.path, about, recipe, digests, pairs, records, journal.events(), weakest)


def overview(log: RunLog) -> str:
    """One screen, like that which ends a run."""
    first = headline(log.records, log.ending, log.seconds)
    about = f"recipe {log.about.recipe}, {log.about.device}, {len(log.events)} events"
    return "\n".join([first, about, *account(log.pairs, log.records, log.about.left_out, log.faults)])


def tables(log: RunLog) -> dict[str, pd.DataFrame]:
    """Long tables by name: ``pairs``, ``units``, ``regions``, ``events``; ``pair`` is the row of the test set."""
    return {
        name: pd.DataFrame(list(rows(log)), columns=list(columns)) for name, (columns, rows) in _TABLES.items()
    }


def write_csv(log: RunLog, directory: Path) -> list[Path]:
    """Write each of :func:`tables` to a file of its name; :class:`UserError` where they cannot be written."""
    paths = []
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for name, table in tables(log).items():
            paths.append(directory / f"{name}.csv")
            table.to_csv(paths[-1], index=False)
    except OSError as error:
        raise UserError(f"--csv {directory} cannot be written: {error.strerror}") from error
    return paths


def write_json(log: RunLog, path: Path) -> None:
    """Write all there is as one JSON value, each pair with its units and regions; :class:`UserError` as above."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(to_json(log), allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise UserError(f"--json {path} cannot be written: {error.strerror}") from error


def to_json(log: RunLog) -> dict[str, Any]:
    """The tables as JSON values, the rows of ``units`` and ``regions`` inside their pairs."""
    rows = {name: [_row(columns, values) for values in give(log)] for name, (columns, give) in _TABLES.items()}
    for pair in rows["pairs"]:
        pair |= {"units": [], "regions": []}
    for inner in ("units", "regions"):
        for row in rows[inner]:
            rows["pairs"][row.pop("pair")][inner].append(row)
    return {
        "recipe": {"name": log.about.recipe, **log.recipe.fingerprint()},
        "device": log.about.device,
        "limit_seconds": log.about.limit,
        "ending": log.ending,
        "seconds": log.seconds,
        "versions": dict(log.about.versions),
        "digests": log.digests,
        "pairs": rows["pairs"],
        "events": rows["events"],
    }


Row = tuple[Any, ...]


def _pair_rows(log: RunLog) -> Iterator[Row]:
    for pair, record in zip(log.pairs, log.records, strict=True):
        encode = sum(unit.encode_seconds for unit in record.units)
        match = sum(unit.match_seconds for unit in record.units)
        seconds = (record.decode_seconds, encode, match, record.cluster_seconds, record.estimate_seconds)
        names = (pair.id, pair.group, pair.image0.name, pair.image1.name)
        counts = (record.matches, record.inliers)
        yield (record.index, *names, record.failure, *counts, *seconds, *map(float, record.F.ravel()))


def _unit_rows(log: RunLog) -> Iterator[Row]:
    for record in log.records:
        for unit in record.units:
            counts = (unit.matches, unit.inliers, unit.encode_seconds, unit.match_seconds)
            yield (record.index, unit.unit, unit.stage, *counts, unit.failure)


def _region_rows(log: RunLog) -> Iterator[Row]:
    for record in log.records:
        for image, region in enumerate(record.regions or ()):
            box = region.box
            edges = (box.left, box.top, box.right, box.bottom)
            yield (record.index, image, *edges, str(region.reason), region.clusters, region.kept)


def _event_rows(log: RunLog) -> Iterator[Row]:
    for event in log.events:
        yield (event.kind, event.seconds, event.text)


_TABLES: dict[str, tuple[tuple[str, ...], Callable[[RunLog], Iterator[Row]]]] = {
    "pairs": (
        (
            *("pair", "id", "group", "image0", "image1", "failure", "matches", "inliers"),
            *("decode_seconds", "encode_seconds", "match_seconds", "cluster_seconds", "estimate_seconds"),
            *F_COLUMNS,
        ),
        _pair_rows,
    ),
    "units": (
        ("pair", "unit", "stage", "matches", "inliers", "encode_seconds", "match_seconds", "failure"),
        _unit_rows,
    ),
    "regions": (
        ("pair", "image", "left", "top", "right", "bottom", "reason", "clusters", "kept"),
        _region_rows,
    ),
    "events": (("kind", "seconds", "text"), _event_rows),
}


def _row(columns: tuple[str, ...], values: Row) -> dict[str, Any]:
    row = dict(zip(columns, values, strict=True))
    if F_COLUMNS[0] in row:
        row["F"] = [[row.pop(f"f{i}{j}") for j in (1, 2, 3)] for i in (1, 2, 3)]
    return row
