"""What a journal says of a run: read at one moment, kept as a value, exported to files."""

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.journal_tables import DRAWN, About, Event, EventKind, JournalReader, undamaged
from mkpc_kaggle.engine.records import PairRecord, SceneRecord
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Recipe, recipe_of
from mkpc_kaggle.reporting.tables import RunTables, run_tables, to_json

NOT_ENDED = "not ended (at work, or killed)"


@dataclass(frozen=True, eq=False)
class WeakPair:
    """One of the weakest pairs, with its matches by unit where the journal still has them."""

    record: PairRecord
    results: tuple[UnitResult, ...]


@dataclass(frozen=True, eq=False)
class RunLog:
    """A run as its journal has it.

    ``records`` are one a pair, in order, those not reached among them. ``events`` are those of all sessions;
    ``weakest`` are the pairs with the fewest inliers of those that were matched. ``digests`` are those of the
    test set and of the weights, by name. ``scenes`` are the batches that were reconstructed, or could not be.
    """

    path: Path
    about: About
    recipe: Recipe
    digests: dict[str, str]
    pairs: tuple[Pair, ...]
    records: tuple[PairRecord, ...]
    events: tuple[Event, ...]
    weakest: tuple[WeakPair, ...]
    scenes: tuple[SceneRecord, ...] = ()

    @cached_property
    def tables(self) -> RunTables:
        return run_tables(self.pairs, self.records, self.events)

    @property
    def sessions(self) -> int:
        """How often the run was started."""
        return sum(event.kind == EventKind.START for event in self.events)

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
    with JournalReader(directory) as journal, undamaged(journal.path):
        about, belongs_to, pairs = journal.about(), journal.belongs_to(), journal.pairs()
        recipe = recipe_of(belongs_to.get("recipe", {}), about.recipe)
        known = journal.records()
        records = tuple(known.get(index) or PairRecord.untouched(index) for index in range(len(pairs)))
        touched = sorted((record for record in records if record.units), key=lambda r: (r.inliers, r.index))
        units = {unit.name: unit for unit in recipe.units}
        weakest = tuple(WeakPair(record, journal.results(record.index, units)) for record in touched[:DRAWN])
        digests = {"test set": str(belongs_to.get("test set", "")), **belongs_to.get("weights", {})}
        events, scenes = journal.events(), journal.scenes()
        return RunLog(journal.path, about, recipe, digests, pairs, records, events, weakest, scenes)


def write_csv(log: RunLog, directory: Path) -> list[Path]:
    """Write each of the log's tables to a file of its name; :class:`UserError` where they cannot be written."""
    paths = []
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for name, table in log.tables.named().items():
            paths.append(directory / f"{name}.csv")
            table.to_csv(paths[-1], index=False)
    except OSError as error:
        raise UserError(f"--csv {directory} cannot be written: {error.strerror}") from error
    return paths


def write_json(log: RunLog, path: Path) -> None:
    """Write all there is as one JSON value, each pair with its units and regions; :class:`UserError` as above."""
    values = {
        "recipe": {"name": log.about.recipe, **log.recipe.fingerprint()},
        "device": log.about.device,
        "limit_seconds": log.about.limit,
        "ending": log.ending,
        "seconds": log.seconds,
        "versions": dict(log.about.versions),
        "digests": log.digests,
        **to_json(log.tables),
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(values, allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise UserError(f"--json {path} cannot be written: {error.strerror}") from error
