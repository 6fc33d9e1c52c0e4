"""The data of a run for reports: a snapshot of the journal, and tables as CSV files."""

import csv
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import astuple, dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

from mkpc_kaggle.data.outputs import replacing, require_table
from mkpc_kaggle.engine.plan.budget import format_duration
from mkpc_kaggle.engine.store.image_files import stored_digests
from mkpc_kaggle.engine.store.records import (
    About,
    Event,
    EventKind,
    PairRecord,
    SceneRecord,
    Table,
    UnitRecord,
    read_events,
    read_points,
    read_records,
    read_scenes,
    unmatched_scenes,
)
from mkpc_kaggle.engine.store.tables import Store
from mkpc_kaggle.errors import UserError, writing
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import Estimate, ModelKind, sampson_distances
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult
from mkpc_kaggle.recipe import Recipe, recipe_of

MAX_DRAWN_PAIRS = 20  # the number of weakest pairs that the report draws
SECONDS = {  # fields of a pair's record, and their names in reports
    "decode_seconds": "wait for decoding",
    "encode_seconds": "encode",
    "match_seconds": "match",
    "cluster_seconds": "cluster",
    "estimate_seconds": "MAGSAC (in parallel with matching)",
}
PAIR_HEADS = f"""pair id group image0 image1 failure source matches inliers overlaps {" ".join(SECONDS)}
    support flat plane candidates cost magsac_cost focal0 focal1 model f11 f12 f13 f21 f22 f23 f31 f32 f33"""
REGION_HEADS = "pair image left top right bottom reason clusters kept"


@dataclass(frozen=True, eq=False)
class RunLog:
    path: Path  # of the journal
    about: About
    recipe: Recipe
    records: tuple[PairRecord, ...]  # of each pair, in order
    events: tuple[Event, ...]  # of all sessions
    weakest: tuple[tuple[PairRecord, PairMatch], ...]  # matched pairs, the fewest inliers first
    scenes: tuple[SceneRecord, ...] = ()
    digests: Mapping[str, str] = field(default_factory=dict)  # of the images' contents, by name

    @property
    def ending(self) -> str:
        """The ending of the last session."""
        # Only the last event counts: a resumed run has the ends of former sessions.
        ends = (event.text for event in self.events[-1:] if event.kind == EventKind.END)
        return next(ends, "not ended (at work, or killed)")

    @property
    def seconds(self) -> float:
        """Duration of the last session, until its last event."""
        return self.events[-1].seconds if self.events else 0.0

    @property
    def faults(self) -> list[str]:
        return [text for _, text in self.of_kind(EventKind.FAULT)]

    def of_kind(self, kind: str) -> list[tuple[str, str]]:
        """Return the time and the text of each event of a kind."""
        return [
            (format_duration(event.seconds), event.text)
            for event in self.events
            if event.kind == kind
        ]


def read_log(directory: Path) -> RunLog:
    """Read the store of a work directory, during a run or after it.

    Raises :class:`UserError` if the journal is missing, or if this version cannot read it.
    """
    with Store.read(directory) as store:
        published = Table.of(store)
        records = tuple(read_records(store, published))
        table = dict(published.about.recipe)
        # A store that was opened, and then ended by a signal before the first publication
        if not table:
            store.warn_of_damage()
            raise UserError(f"{directory}: the run has not begun, or was stopped at its start")
        # The recipe as it ran: its file may have changed since.
        recipe = recipe_of(table, table.pop("name"))
        # The index settles ties, so that equal runs draw the same pairs.
        touched = sorted(
            (record for record in records if record.units), key=lambda r: (r.inliers, r.index)
        )
        units = {unit.name: unit for unit in recipe.units}

        # The journal has points and F, from which the inliers follow as in the run.
        def weak(record: PairRecord) -> tuple[PairRecord, PairMatch]:
            F = record.pair_fundamental
            points = read_points(store, published, record.index)
            results = tuple(UnitResult(units[name], found) for name, found in points.items())
            distances = sampson_distances(F, Matches.concatenate(each.matches for each in results))
            # The fallback fits some matches by chance.
            inliers = (distances < recipe.magsac.threshold) & (not record.failure)
            estimate = Estimate(ModelKind.F, F, inliers, record.failure)
            return record, PairMatch(results, record.regions, estimate)

        # The points of other pairs are not read: they may have gigabytes.
        weakest = tuple(map(weak, touched[:MAX_DRAWN_PAIRS]))
        scenes = [*read_scenes(store, published).values()]
        if recipe.scene is not None:
            present = {scene.batch for scene in scenes}
            scenes += [each for each in unmatched_scenes(records) if each.batch not in present]
        events = read_events(store)
        store.warn_of_damage()
        digests = stored_digests(store, published.image_names)
        return RunLog(
            store.path, published.about, recipe, records, events, weakest, tuple(scenes), digests
        )


def write_csv(log: RunLog, directory: Path) -> list[Path]:
    """Write the tables pairs.csv, units.csv, regions.csv and events.csv. Return their paths.

    An existing file is replaced only if it is a table with the same columns. Otherwise, and if a
    table cannot be written, raises :class:`UserError`.
    """
    tables: dict[str, tuple[list[str], Iterable[Iterable[Any]]]] = {
        "pairs": (PAIR_HEADS.split(), map(_pair_cells, log.records)),
        "units": (
            ["pair", *UnitRecord.__annotations__],
            ((record.index, *astuple(unit)) for record in log.records for unit in record.units),
        ),
        "regions": (REGION_HEADS.split(), _region_rows(log.records)),
        "events": (["kind", "seconds", "text"], map(astuple, log.events)),
    }
    with writing(f"--csv {directory}"):
        directory.mkdir(parents=True, exist_ok=True)
        files = {directory / f"{name}.csv": table for name, table in tables.items()}
        # All before the first is written: a refused export leaves all files as they were.
        for path, (heads, _) in files.items():
            require_table(path, heads)
        for path, (heads, rows) in files.items():
            with replacing(path) as stream:
                csv.writer(stream, lineterminator="\n").writerows(chain([heads], rows))
    return list(files)


def _pair_cells(record: PairRecord) -> tuple[Any, ...]:
    """Return the cells of a pair, in the order of ``PAIR_HEADS``."""
    stats = record.stats
    return (
        record.index,
        record.pair.id,
        record.pair.group,
        record.pair.file0,
        record.pair.file1,
        record.failure,
        record.source,
        record.matches,
        record.inliers,
        record.overlaps,
        *(getattr(record, name) for name in SECONDS),
        stats.support,
        record.is_flat,
        stats.plane,
        stats.candidates,
        stats.cost,
        stats.magsac_cost,
        *stats.focals,
        record.model,
        *record.chosen_fundamental.flat,
    )


def _region_rows(records: Iterable[PairRecord]) -> Iterator[tuple[Any, ...]]:
    """Yield a row per image of the pairs with critical regions, in the order of ``REGION_HEADS``."""
    for record in records:
        # A pair without a unit of stage 2 has none.
        for image, region in enumerate(record.regions or ()):
            counts = (region.reason, region.clusters, region.kept)
            yield (record.index, image, *astuple(region.box), *counts)
