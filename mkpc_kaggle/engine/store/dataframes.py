"""The results of a run as pandas DataFrames, made by SQL from the tables of its store.

They are all that reports, the summary, ``mkpc journal``, notebooks and scores read. A further fact of a
result is a field in :mod:`tables`, the line that computes it, and a line of a query here.
"""

import json
import sqlite3
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.engine.console import Event, read_events
from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.image_files import stored_digests
from mkpc_kaggle.engine.store.published import Published
from mkpc_kaggle.engine.store.sqlite_file import connected
from mkpc_kaggle.engine.store.tables import (
    LAYOUTS,
    MIN_PAIRS,
    NO_CAMERAS,
    NOT_RECONSTRUCTED,
    SCHEMA,
    About,
    ImageFile,
    PairEstimate,
    PublishedPair,
    PublishedRun,
    SceneRecord,
    UnitPoints,
)
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Box, Matrix3
from mkpc_kaggle.geometry.critical_region import CriticalRegion, RegionReason
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.overlap import MIN_SUPPORT
from mkpc_kaggle.geometry.robust import (
    FALLBACK_FUNDAMENTAL,
    Estimate,
    ModelKind,
    sampson_distances,
)
from mkpc_kaggle.pipeline.pair import PairMatch, Regions, UnitResult
from mkpc_kaggle.recipe import Recipe, recipe_of
from mkpc_kaggle.scene.candidates import title_of

if TYPE_CHECKING:
    from pandas import DataFrame

NOT_REACHED = "not reached in time"
# Numbers, since SQL has no names for ours
PARAMETERS = {
    "not_reached": NOT_REACHED,
    "min_support": MIN_SUPPORT,
    "fallback": FALLBACK_FUNDAMENTAL.tobytes(),
}

# Units of pairs, with all columns of their points. Each has points, or a known reason why it has
# none; without either, it was not reached. Inliers are by the key of points: newer points than the
# estimate's have none yet.
UNIT_TABLE = """
CREATE TABLE unit AS
WITH used AS (
    SELECT
        pair.number, pair.estimate, point.key AS position, point.value AS points,
        json_extract(named.value, '$[0]') AS name, json_extract(named.value, '$[1]') AS stage,
        json_extract(pair.failures, '$."' || json_extract(named.value, '$[0]') || '"') AS reason
    FROM
        run JOIN pair JOIN json_each(pair.points) AS point
        JOIN json_each(run.units) AS named ON named.key = point.key
)
SELECT
    number, name, stage, iif(points.key IS NULL, reason, '') AS reason,
    json_extract(inliers, '$."' || points.key || '"') AS inliers, points.*
FROM
    used LEFT JOIN points ON points.key = used.points
    LEFT JOIN estimate ON estimate.key = used.estimate
WHERE points.key IS NOT NULL OR reason IS NOT NULL
ORDER BY number, position;
CREATE INDEX unit_of_pair ON unit (number);
"""


class Query(NamedTuple):
    """A table: for each column its type and its SQL, and where the rows come from.

    The type is for a table without rows, too.
    """

    columns: Mapping[str, tuple[type, str]]
    source: str

    def frame(self, database: sqlite3.Connection) -> "DataFrame":
        from pandas import DataFrame  # importing it takes half a second

        expressions = ", ".join(sql for _, sql in self.columns.values())
        rows = database.execute(f"SELECT {expressions} {self.source}", PARAMETERS).fetchall()
        kinds = {name: kind for name, (kind, _) in self.columns.items()}
        return DataFrame(rows, columns=list(kinds)).astype(kinds)


SECONDS = {  # columns of pairs, and their names in reports
    "decode_seconds": "wait for decoding",
    "encode_seconds": "encode",
    "match_seconds": "match",
    "cluster_seconds": "cluster",
    "estimate_seconds": "MAGSAC (in parallel with matching)",
}
REASON = (
    "coalesce(estimate.failure, nullif(pair.failure, ''), nullif(unestimated, ''), :not_reached)"
)
# The error that left a pair without an F. A unit that ran and found nothing is none: the images may
# not overlap.
ERROR = f"""
CASE
    WHEN source != 'fallback' OR {REASON} = :not_reached THEN ''
    WHEN sums.units IS NULL OR unestimated != '' THEN {REASON}
    ELSE coalesce(
        (
            SELECT reason FROM unit
            WHERE unit.number = pair.number AND reason != '' AND matches IS NULL ORDER BY rowid
        ),
        ''
    )
END
"""
PAIRS = Query(
    {
        "pair": (str, "pair.id"),
        "group": (str, "pair.batch"),
        # Not the file names alone: two folders may have the same.
        "image0": (str, "image0"),
        "image1": (str, "image1"),
        "failure": (str, REASON),
        "source": (str, "source"),
        "matches": (int, "coalesce(sums.matches, 0)"),
        "inliers": (int, "coalesce(sums.inliers, 0)"),
        "overlaps": (bool, "coalesce(support, 0) >= :min_support"),
        "support": (float, "coalesce(support, 0)"),
        "focal0": (float, "coalesce(focal0, 0)"),
        "focal1": (float, "coalesce(focal1, 0)"),
        "model": (str, "model"),
        "F": (object, "pair.F"),
        "decode_seconds": (float, "coalesce(sums.decode_seconds, 0)"),
        "encode_seconds": (float, "coalesce(sums.encode_seconds, 0)"),
        "match_seconds": (float, "coalesce(sums.match_seconds, 0)"),
        "cluster_seconds": (float, "coalesce(sums.cluster_seconds, 0)"),
        "estimate_seconds": (float, "coalesce(estimate.seconds, 0)"),
        "candidates": (int, "coalesce(candidates, 0)"),
        "cost": (float, "coalesce(cost, 0)"),
        "magsac_cost": (float, "coalesce(magsac_cost, 0)"),
        "choice": (str, "choice"),
        "units": (int, "coalesce(sums.units, 0)"),
        "error": (str, ERROR),
    },
    """
    FROM
        pair LEFT JOIN estimate ON estimate.key = pair.estimate
        LEFT JOIN (
            SELECT
                number, count(*) AS units, sum(matches) AS matches, sum(inliers) AS inliers,
                sum(decode_seconds) AS decode_seconds, sum(encode_seconds) AS encode_seconds,
                sum(match_seconds) AS match_seconds, sum(cluster_seconds) AS cluster_seconds
            FROM unit GROUP BY number
        ) AS sums USING (number)
    ORDER BY pair.number
    """,
)
ELEMENTS = [f"f{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3)]  # of F, row by row
UNITS = Query(
    {
        "pair": (str, "pair.id"),
        "unit": (str, "unit.name"),
        "stage": (int, "stage"),
        "matches": (int, "coalesce(matches, 0)"),
        "inliers": (int, "coalesce(inliers, 0)"),
        "encode_seconds": (float, "coalesce(encode_seconds, 0)"),
        "match_seconds": (float, "coalesce(match_seconds, 0)"),
        "failure": (str, "reason"),
        "note": (str, "coalesce(note, '')"),
        "keypoints": (int, "coalesce(keypoints, 0)"),
        "is_needed": (bool, "coalesce(is_needed, 1)"),
        "scale": (float, "scale"),
        "detail": (float, "detail"),
    },
    "FROM unit JOIN pair USING (number) ORDER BY unit.rowid",
)
# All units of stage 2 in one job have the same regions; later jobs may have others.
REGIONS = Query(
    {
        "pair": (str, "pair.id"),
        "image": (int, "region.key"),
        "left": (int, "json_extract(region.value, '$.box.left')"),
        "top": (int, "json_extract(region.value, '$.box.top')"),
        "right": (int, "json_extract(region.value, '$.box.right')"),
        "bottom": (int, "json_extract(region.value, '$.box.bottom')"),
        "reason": (str, "json_extract(region.value, '$.reason')"),
        "clusters": (int, "json_extract(region.value, '$.clusters')"),
        "kept": (int, "json_extract(region.value, '$.kept')"),
    },
    """
    FROM
        pair JOIN unit ON unit.rowid = (
            SELECT min(rowid) FROM unit WHERE number = pair.number AND regions != '[]'
        )
        JOIN json_each(unit.regions) AS region
    ORDER BY pair.number, region.key
    """,
)
ESTIMATES = Query(
    {
        "pair": (str, "pair.id"),
        "F": (object, "coalesce(estimate.F, :fallback)"),
        "magsac": (object, "magsac"),
        "rotation": (object, "coalesce(rotation, '[0.0, 0.0, 0.0]')"),
    },
    "FROM pair LEFT JOIN estimate ON estimate.key = pair.estimate ORDER BY pair.number",
)
# Identical files share a camera, and each has a row, in the order of the pairs. An image that has
# changed since is known by its former name. Arrays are JSON, whose digits are exact.
CAMERAS = Query(
    {
        "batch": (str, "used.key"),
        "model": (int, "model.key"),
        "image": (str, "coalesce(alike.name, json_extract(camera.value, '$.image.name'))"),
        "width": (int, "json_extract(camera.value, '$.image.size[0]')"),
        "height": (int, "json_extract(camera.value, '$.image.size[1]')"),
        "points": (int, "json_extract(camera.value, '$.points')"),
        "K": (object, "json_extract(camera.value, '$.camera.K')"),
        "R": (object, "json_extract(camera.value, '$.camera.R')"),
        "t": (object, "json_extract(camera.value, '$.camera.t')"),
        "camera_model": (str, "coalesce(json_extract(camera.value, '$.lens.model'), '')"),
        "parameters": (object, "coalesce(json_extract(camera.value, '$.lens.parameters'), '[]')"),
    },
    """
    FROM
        run JOIN json_each(run.scenes) AS used JOIN scene ON scene.key = used.value
        JOIN json_each(scene.models) AS model JOIN json_each(model.value, '$.images') AS camera
        LEFT JOIN (
            SELECT image.batch, content, image.name, min(position) AS position
            FROM
                (
                    SELECT batch, image0 AS name, 2 * number AS position FROM pair
                    UNION ALL SELECT batch, image1, 2 * number + 1 FROM pair
                ) AS image JOIN file ON file.name = image.name
            GROUP BY image.batch, image.name
        ) AS alike
            ON alike.batch = used.key
            AND alike.content = json_extract(camera.value, '$.image.digest')
    ORDER BY used.id, model.key, camera.key, alike.position
    """,
)
SCENE_COLUMNS = ["batch", "images", "cameras", "models", "points"]
SCENE_COLUMNS += ["reprojection_error", "seconds", "candidate", "failure", "missing"]


@dataclass(frozen=True, eq=False)
class Results:
    """The results of a run. ``pairs`` has a row for each pair, ``units`` for each unit of a pair.

    ``cameras`` has a row for each camera of each model; identical files share a camera, and each
    has a row. ``scenes`` has a row for each batch: numbers of images, cameras, models and points, the mean
    reprojection error in pixels, whose tracks were used, the reason if there are no cameras, and the images
    of a folder without a camera. Columns that name a pair have its id. Columns that name an image have its
    path below the directory of the run's images. ``f11`` to ``f33`` of ``pairs`` are the matrix of ``model``:
    F, or E for a pair with known intrinsics. ``choice`` is the reason why it is the scene's or not,
    ``units`` the number of units that ran or failed, and ``error`` the error that left the pair without
    an F, if it was not for few matches. ``events`` are those of the last session, such as faults.
    """

    pairs: "DataFrame"
    units: "DataFrame"
    cameras: "DataFrame"
    scenes: "DataFrame"
    events: Sequence[Event]
    about: About
    directory: Path
    # Points (P, 3) of each model, of the longest tracks, by batch and number of the model
    points: Mapping[tuple[str, int], NDArray[np.float64]]

    @property
    def recipe(self) -> Recipe:
        """The recipe as it ran: its file may have changed since."""
        settings = dict(self.about.recipe)
        return recipe_of(settings, settings.pop("name"))

    def matches(self, *pairs: str) -> Iterator[PairMatch]:
        """Yield the matches, critical regions and own F of pairs, by id, to plot them.

        An E has no residuals in pixels, so its pair has no inliers here.
        """
        recipe = self.recipe
        units = {unit.name: unit for unit in recipe.units}
        with Store.read(self.directory) as store:
            published = Published.of(store)
            tables = pair_tables(store, published)
            regions = by_pair(tables.regions)
            rows = {row.id: row for row in published.rows}
            for row in map(rows.__getitem__, pairs):
                points = published.points_of(store, row)
                results = tuple(UnitResult(units[name], found) for name, found in points.items())
                F = tables.estimates["F"][row.number]
                count = tables.pairs["inliers"][row.number] if row.model == ModelKind.F else 0
                estimate = nearest_to(F, results, count, tables.pairs["failure"][row.number])
                crops = regions_of(regions[row.id]) if row.id in regions else None
                yield PairMatch(results, crops, estimate, mkpc=recipe.mkpc)


def nearest_to(F: Matrix3, results: Iterable[UnitResult], count: int, failure: str) -> Estimate:
    """Return the estimate F of a pair; its inliers are the ``count`` matches that are nearest to F."""
    distances = sampson_distances(F, Matches.concatenate(each.matches for each in results))
    inliers = np.zeros(len(distances), bool)
    inliers[np.argsort(distances, kind="stable")[:count]] = True
    return Estimate(ModelKind.F, F, inliers, failure)


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


class PairTables(NamedTuple):
    """The pairs and units of :class:`Results`, and more about the pairs.

    ``regions`` has the critical region of each image of a pair, numbers 0 and 1. ``estimates`` has a row for
    each pair in the same order: its own F, from its matches alone, and MAGSAC's F before the prior, if any.
    """

    pairs: "DataFrame"
    units: "DataFrame"
    regions: "DataFrame"
    estimates: "DataFrame"


def results(directory: Path | str) -> Results:
    """Return the results in a work directory, during a run or after it.

    Parameters
    ----------
    directory : str or Path
        NAME.work of a submission, ``--work-dir``, or ``OUT/work`` of :func:`reconstruct`.

    Returns
    -------
    Results
        The DataFrames ``pairs``, ``units``, ``cameras`` and ``scenes``, and more facts.

    Raises
    ------
    UserError
        If the store is missing, damaged, of another format, or of a run that has not begun.

    Examples
    --------
    >>> from mkpc_kaggle import reconstruct, results
    >>> models = reconstruct("photographs", "OUT", "sift", progress=False)
    >>> tables = results("OUT/work")
    >>> set(tables.pairs["model"])
    {'F'}
    """
    with Store.read(Path(directory)) as store:
        published = Published.of(store)
        about = published.run.about
        # A store that was opened, and then ended by a signal before the first publication
        if not about.recipe:
            store.warn_of_damage()
            raise UserError(f"{directory}: the run has not begun, or was stopped at its start")
        with published_results(store, published) as database:
            pairs = _pairs(database)
            units = UNITS.frame(database)
            cameras = _cameras(database)
        scenes = [*published.scenes_of(store).values()]
        if about.recipe.get("scene"):
            scenes += missing_scenes(pairs, {scene.batch for scene in scenes})
        digests = stored_digests(store, published.image_names)
        store.warn_of_damage()
    points = {
        (scene.batch, number): model.points
        for scene in scenes
        for number, model in enumerate(scene.models)
    }
    table = scene_table(scenes, about.files, digests)
    events = read_events(Path(directory))
    return Results(pairs, units, cameras, table, events, about, Path(directory), points)


def missing_scenes(pairs: "DataFrame", known: Collection[str]) -> Iterator[SceneRecord]:
    """Yield a record without cameras for each further batch that could have a scene."""
    for batch, members in pairs.groupby("group", sort=False):
        if batch not in known and len(members) >= MIN_PAIRS:
            may_match = (members["matches"] > 0) | (members["failure"] == NOT_REACHED)
            images = {*members["image0"], *members["image1"]}
            failure = NOT_RECONSTRUCTED if may_match.any() else NO_CAMERAS
            yield SceneRecord(str(batch), images=len(images), failure=failure)


def scene_table(
    scenes: Iterable[SceneRecord],
    files: Mapping[str, Sequence[str]],
    digests: Mapping[str, str],
) -> "DataFrame":
    """Return the table of scenes.

    ``files`` has the images of each dataset of a folder, also those in no pair, and ``digests`` their
    contents: identical files share a camera. Without files, as in a submission, distinct images count.
    """
    from pandas import DataFrame

    rows = []
    for scene in scenes:
        images = scene.images
        cameras = scene.registered
        missing: list[str] = []
        if scene.batch in files:
            names = files[scene.batch]
            placed = {found.image.digest for model in scene.models for found in model.images}
            missing = [name for name in names if digests.get(name) not in placed]
            images = len(names)
            cameras = images - len(missing)
        # A model without points has no error, and a weight that is not 0: the sum must not vanish.
        weights = [max(1, sum(found.points for found in each.images)) for each in scene.models]
        errors = [each.reprojection_error for each in scene.models]
        error = float(np.average(errors, weights=weights)) if errors else np.nan
        counts = (images, cameras, len(errors), scene.points, error, scene.seconds)
        text = (title_of(scene.candidate), scene.failure)
        rows.append((scene.batch, *counts, *text, tuple(missing)))
    for batch in files.keys() - {row[0] for row in rows}:
        names = files[batch]
        few = "at least three matched images are needed"
        rows.append((batch, len(names), 0, 0, 0, np.nan, 0.0, "", few, tuple(names)))
    return DataFrame(rows, columns=SCENE_COLUMNS)


def pair_tables(store: Store, published: Published | None = None) -> PairTables:
    """Return the tables of the pairs of a version, by default of the published one."""
    with published_results(store, published) as database:
        return tables_in(database)


def tables_in(database: sqlite3.Connection) -> PairTables:
    """Return the tables of the pairs in a database of :func:`published_results`."""
    return PairTables(
        _pairs(database),
        UNITS.frame(database),
        REGIONS.frame(database),
        _estimates(database),
    )


@contextmanager
def published_results(
    store: Store, published: Published | None = None
) -> Iterator[sqlite3.Connection]:
    """Yield a database in memory with the results that a version names, and nothing else.

    Damaged rows of the file are missing there, and results that the file did not take are not.
    """
    version = Published.of(store) if published is None else published
    rows = version.rows
    with database_of(
        {
            PublishedRun: [LAYOUTS[PublishedRun].values(version.run)],
            PublishedPair: map(LAYOUTS[PublishedPair].values, rows),
            UnitPoints: store.facts(UnitPoints, [key for row in rows for key in row.points if key]),
            PairEstimate: store.facts(PairEstimate, [row.estimate for row in rows if row.estimate]),
            SceneRecord: store.facts(SceneRecord, version.run.scenes.values()),
            ImageFile: store.facts(ImageFile, version.image_names),
        }
    ) as database:
        yield database


@contextmanager
def database_of(facts: Mapping[type, Iterable[tuple[Any, ...]]]) -> Iterator[sqlite3.Connection]:
    """Yield a database in memory whose tables have these facts, as SQLite has them."""
    with closing(connected(":memory:")) as database:
        database.executescript(SCHEMA)
        for kind, rows in facts.items():
            layout = LAYOUTS[kind]
            more = (b"",) * (1 + layout.has_data)
            marks = ", ".join("?" * (len(layout.facts) + len(more)))
            query = f"INSERT OR IGNORE INTO {layout.table} VALUES ({marks})"
            database.executemany(query, ((*row, *more) for row in rows))
        database.executescript(UNIT_TABLE)
        yield database


def matrices_of(pairs: "DataFrame") -> NDArray[np.float64]:
    """Return the written matrices (N, 3, 3) of a table of pairs."""
    return pairs[ELEMENTS].to_numpy(float).reshape(-1, 3, 3)


def by_pair(rows: "DataFrame") -> dict[str, "DataFrame"]:
    """Return the rows of each pair in a table of units or of regions, by the pair's id."""
    return {str(pair): members for pair, members in rows.groupby("pair", sort=False)}


def _pairs(database: sqlite3.Connection) -> "DataFrame":
    from pandas import DataFrame, concat

    frame = PAIRS.frame(database)
    number = list(frame.columns).index("F")
    data = b"".join(frame["F"])
    elements = DataFrame(np.frombuffer(data).reshape(-1, 9), columns=ELEMENTS, index=frame.index)
    return concat([frame.iloc[:, :number], elements, frame.iloc[:, number + 1 :]], axis=1)


def _estimates(database: sqlite3.Connection) -> "DataFrame":
    frame = ESTIMATES.frame(database)
    for name in ("F", "magsac"):
        frame[name] = _objects(frame[name], lambda data: data and np.frombuffer(data).reshape(3, 3))
    frame["rotation"] = _objects(frame["rotation"], json.loads)
    return frame


def _cameras(database: sqlite3.Connection) -> "DataFrame":
    frame = CAMERAS.frame(database)
    for name in ("K", "R", "t"):
        frame[name] = _objects(frame[name], lambda text: np.array(json.loads(text), float))
    frame["parameters"] = _objects(frame["parameters"], lambda text: tuple(json.loads(text)))
    frame.insert(5, "focal", np.array([K[0, 0] for K in frame["K"]], float))
    return frame


def _objects(column: Iterable[Any], convert: Any) -> "Any":
    """Return a column of converted values, which may be arrays."""
    from pandas import Series

    values = list(map(convert, column))
    return Series(values, dtype=object)
