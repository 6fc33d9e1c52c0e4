"""Snapshot of a run from its journal, and its export to files."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.outputs import replacing, require_table
from mkpc_kaggle.engine.journal_reader import About, Event, EventKind, JournalReader, undamaged
from mkpc_kaggle.engine.records import PairRecord, SceneRecord
from mkpc_kaggle.errors import writing
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import Estimate, ModelKind, sampson_distances
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
from mkpc_kaggle.recipe import Recipe, recipe_of
from mkpc_kaggle.reporting.tables import RunTables, run_tables

MAX_DRAWN_PAIRS = 20  # the weakest, which the report draws
NOT_ENDED = "not ended (at work, or killed)"


@dataclass(frozen=True, eq=False)
class WeakPair:
    """A pair with few inliers, with its matches by unit."""

    record: PairRecord
    results: tuple[UnitResult, ...]

    def match(self, threshold: float) -> PairMatch:
        """The pair as MAGSAC left it, without running it again; inliers are within ``threshold`` pixels."""
        record = self.record
        matches = Matches.concatenate(result.matches for result in self.results)
        inliers = (sampson_distances(record.pair_fundamental, matches) < threshold) & (not record.failure)
        return PairMatch(
            self.results, record.regions, Estimate(ModelKind.F, record.pair_fundamental, inliers, record.failure)
        )


@dataclass(frozen=True, eq=False)
class RunLog:
    path: Path  # of the journal
    about: About
    recipe: Recipe
    pairs: tuple[Pair, ...]
    records: tuple[PairRecord, ...]  # a record for each pair, in order, reached or not
    events: tuple[Event, ...]  # of all sessions
    weakest: tuple[WeakPair, ...]  # of the pairs that were matched, the fewest inliers first
    scenes: tuple[SceneRecord, ...] = ()  # the batches that were reconstructed, or could not be

    @cached_property
    def tables(self) -> RunTables:
        return run_tables(self.pairs, self.records, self.events)

    @property
    def session(self) -> tuple[Event, ...]:
        """The events since the run was last started."""
        starts = [index for index, event in enumerate(self.events) if event.kind == EventKind.START]
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

    Raises :class:`UserError` if there is none, or none that this version can read.
    """
    with JournalReader(directory) as journal, undamaged(journal.path):
        about, pairs, records = journal.about(), journal.pairs(), tuple(journal.records())
        table = dict(about.recipe)
        recipe = recipe_of(table, table.pop("name"))
        touched = sorted((record for record in records if record.units), key=lambda r: (r.inliers, r.index))
        units = {unit.name: unit for unit in recipe.units}

        def weak(record: PairRecord) -> WeakPair:
            inputs = journal.inputs(record.index)
            points = journal.points(inputs.values())
            return WeakPair(record, tuple(UnitResult(units[name], points[inputs[name]]) for name in inputs))

        weakest, scenes = tuple(map(weak, touched[:MAX_DRAWN_PAIRS])), tuple(journal.scenes().values())
        return RunLog(journal.path, about, recipe, pairs, records, journal.events(), weakest, scenes)


def write_csv(log: RunLog, directory: Path) -> list[Path]:
    """Write each table to a file of its name; :class:`UserError` if they cannot be written.

    Such tables are replaced, other files are not.
    """
    tables = {directory / f"{name}.csv": table for name, table in log.tables.named().items()}
    with writing(f"--csv {directory}"):
        directory.mkdir(parents=True, exist_ok=True)
        for path, table in tables.items():
            require_table(path, table.columns)
        for path, table in tables.items():
            with replacing(path) as stream:
                table.to_csv(stream, index=False)
    return list(tables)
