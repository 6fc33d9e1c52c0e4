"""The data of a run for reports: a snapshot of the journal, and tables as CSV files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mkpc_kaggle.data.outputs import replacing, require_table
from mkpc_kaggle.engine.console import Event, EventKind, read_events
from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.dataframes import (
    NOT_REACHED,
    PairTables,
    by_pair,
    pair_tables,
)
from mkpc_kaggle.engine.store.image_files import stored_digests
from mkpc_kaggle.engine.store.published import Published
from mkpc_kaggle.engine.store.tables import (
    MIN_PAIRS,
    About,
    SceneRecord,
    unmatched_scene,
)
from mkpc_kaggle.errors import UserError, writing
from mkpc_kaggle.geometry.coordinates import Box
from mkpc_kaggle.geometry.critical_region import CriticalRegion, RegionReason
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import Estimate, ModelKind, sampson_distances
from mkpc_kaggle.pipeline.pair import PairMatch, Regions, UnitResult
from mkpc_kaggle.progress import format_duration
from mkpc_kaggle.recipe import Recipe, recipe_of

if TYPE_CHECKING:
    from pandas import DataFrame

MAX_DRAWN_PAIRS = 20  # the number of weakest pairs that the report draws


@dataclass(frozen=True, eq=False)
class RunLog:
    path: Path  # of the journal
    about: About
    recipe: Recipe
    tables: PairTables
    events: Sequence[Event]  # of the last session
    # The matched pairs with the fewest inliers, by their number in the tables
    weakest: Sequence[tuple[int, PairMatch]] = ()
    scenes: Sequence[SceneRecord] = ()
    digests: Mapping[str, str] = field(default_factory=dict)  # of the images' contents, by name

    @property
    def files(self) -> Mapping[str, Sequence[str]]:
        """The images of each dataset of a folder, by batch, also those in no pair."""
        return self.about.files

    @property
    def ending(self) -> str:
        """The ending of the last session."""
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
        published = Published.of(store)
        tables = pair_tables(store, published)
        settings = dict(published.run.about.recipe)
        # A store that was opened, and then ended by a signal before the first publication
        if not settings:
            store.warn_of_damage()
            raise UserError(f"{directory}: the run has not begun, or was stopped at its start")
        # The recipe as it ran: its file may have changed since.
        recipe = recipe_of(settings, settings.pop("name"))
        # Stable, so that equal runs draw the same pairs. The points of other pairs are not read: they
        # may have gigabytes.
        matched = tables.pairs[tables.pairs["units"] > 0].sort_values("inliers", kind="stable")
        weakest = []
        rows = published.rows
        regions = by_pair(tables.regions)
        for number in matched.index[:MAX_DRAWN_PAIRS]:
            row = rows[number]
            points = published.points_of(store, row)
            # An E has no residuals in pixels.
            inliers = tables.pairs["inliers"][number] if row.model == ModelKind.F else 0
            match = _weak_match(tables, recipe, number, points, regions.get(row.id), inliers)
            weakest.append((number, match))
        scenes = [*published.scenes_of(store).values()]
        if recipe.scene is not None:
            present = {scene.batch for scene in scenes}
            scenes += [each for each in unmatched(tables.pairs) if each.batch not in present]
        events = read_events(directory)
        digests = stored_digests(store, published.image_names)
        store.warn_of_damage()
    about = published.run.about
    return RunLog(store.path, about, recipe, tables, events, weakest, scenes, digests)


def _weak_match(
    tables: PairTables,
    recipe: Recipe,
    number: int,
    points: Mapping[str, Matches],
    regions: "DataFrame | None",
    count: int,
) -> PairMatch:
    """Return the match of a pair from its points and its own F. Its inliers are the ``count`` matches that
    are nearest to F.
    """
    units = {unit.name: unit for unit in recipe.units}
    results = tuple(UnitResult(units[name], matches) for name, matches in points.items())
    F = tables.estimates["F"][number]
    failure = tables.pairs["failure"][number]
    distances = sampson_distances(F, Matches.concatenate(each.matches for each in results))
    inliers = np.zeros(len(distances), bool)
    inliers[np.argsort(distances, kind="stable")[:count]] = True
    crops = None if regions is None else regions_of(regions)
    return PairMatch(results, crops, Estimate(ModelKind.F, F, inliers, failure))


def regions_of(rows: "DataFrame") -> Regions:
    """Return the critical regions of a pair from its two rows in the table of regions."""
    first, second = (
        CriticalRegion(
            Box(row["left"], row["top"], row["right"], row["bottom"]),
            RegionReason(row["reason"]),
            row["clusters"],
            row["kept"],
        )
        for row in rows.to_dict("records")
    )
    return first, second


def unmatched(pairs: "DataFrame") -> list[SceneRecord]:
    """Return the records of the batches whose pairs have all been reached, without a match."""
    scenes = []
    for batch, members in pairs.groupby("group", sort=False):
        may_match = (members["matches"] > 0) | (members["failure"] == NOT_REACHED)
        if len(members) >= MIN_PAIRS and not may_match.any():
            scenes.append(unmatched_scene(str(batch), {*members["image0"], *members["image1"]}))
    return scenes


def write_csv(directory: Path, out: Path) -> list[Path]:
    """Write the tables pairs.csv, units.csv and regions.csv of a work directory to ``out``. Return their paths.

    An existing file is replaced only if it is a table with the same columns. Otherwise, and if a
    table cannot be written, raises :class:`UserError`.
    """
    with Store.read(directory) as store:
        tables = pair_tables(store)
    frames = {
        "pairs": tables.pairs,
        "units": tables.units,
        "regions": tables.regions,
    }
    with writing(f"--csv {out}"):
        out.mkdir(parents=True, exist_ok=True)
        files = {out / f"{name}.csv": frame for name, frame in frames.items()}
        # All before the first is written: a refused export leaves all files as they were.
        for path, frame in files.items():
            require_table(path, list(frame.columns))
        for path, frame in files.items():
            with replacing(path) as stream:
                frame.to_csv(stream, index=False, lineterminator="\n")
    return list(files)
