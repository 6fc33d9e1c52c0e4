"""The results of a run as pandas DataFrames, from the tables of its store.

They are all that reports, the summary, notebooks and scores read.
"""

import json
import sqlite3
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.engine.console import Event, read_events
from mkpc_kaggle.engine.records import (
    NO_CAMERAS,
    NOT_RECONSTRUCTED,
    SceneRecord,
    from_bytes,
    scene_of,
)
from mkpc_kaggle.engine.request import MIN_PAIRS, About
from mkpc_kaggle.engine.store import Store, undamaged
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
SECONDS = {  # columns of pairs, and their names in reports
    "decode_seconds": "wait for decoding",
    "encode_seconds": "encode",
    "match_seconds": "match",
    "cluster_seconds": "cluster",
    "estimate_seconds": "MAGSAC (in parallel with matching)",
}
ELEMENTS = [f"f{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3)]  # of F, row by row
# Columns of estimates, and their values without one
STATISTICS = {
    "support": 0.0,
    "focal0": 0.0,
    "focal1": 0.0,
    "estimate_seconds": 0.0,
    "cost": 0.0,
}
PAIRS = ["pair", "group", "image0", "image1", "failure", "source", "matches", "inliers", "overlaps"]
PAIRS += ["support", "focal0", "focal1", *ELEMENTS, *SECONDS]
PAIRS += ["cost", "choice", "units", "error"]
UNITS = [
    "pair",
    "unit",
    "stage",
    "matches",
    "inliers",
    "encode_seconds",
    "match_seconds",
    "failure",
]
UNITS += ["note", "keypoints", "is_needed", "scale", "detail"]
REGIONS = ["pair", "image", "left", "top", "right", "bottom", "reason", "clusters", "kept"]
CAMERAS = ["batch", "model", "image", "width", "height", "focal", "points", "K", "R", "t"]
CAMERAS += ["camera_model", "parameters"]
SCENE_COLUMNS = ["batch", "images", "cameras", "models", "points"]
SCENE_COLUMNS += ["reprojection_error", "seconds", "candidate", "failure", "missing"]


@dataclass(frozen=True, eq=False)
class Results:
    """The results of a run. ``pairs`` has a row for each pair, ``units`` for each unit of a pair.

    ``cameras`` has a row for each camera of each model; identical files share a camera, and each
    has a row. ``scenes`` has a row for each batch: numbers of images, cameras, models and points, the mean
    reprojection error in pixels, whose tracks were used, the reason if there are no cameras, and the images
    of a folder without a camera. Columns that name a pair have its id. Columns that name an image have its
    path below the directory of the run's images. ``f11`` to ``f33`` of ``pairs`` are F.
    ``choice`` is the reason why it is the scene's or not,
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
        """Yield the matches, critical regions and own F of pairs, by id, to plot them."""
        recipe = self.recipe
        units = {unit.name: unit for unit in recipe.units}
        with Store.read(self.directory) as store:
            tables = pair_tables(store.db)
            regions = by_pair(tables.regions)
            numbers = {pair: number for number, pair in enumerate(tables.pairs["pair"])}
            for pair in pairs:
                number = numbers[pair]
                row = tables.pairs.to_dict("records")[number]
                points = points_of(store, number)
                found = tuple(UnitResult(units[name], each) for name, each in points.items())
                F = tables.estimates["F"][number]
                estimate = nearest_to(F, found, row["inliers"], row["failure"])
                crops = regions_of(regions[pair]) if pair in regions else None
                yield PairMatch(found, crops, estimate, mkpc=recipe.mkpc)


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
        NAME.work of a submission, ``--work-dir``, or ``work_dir`` of :func:`reconstruct`.

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
    >>> tables.pairs[["image0", "image1", "failure"]].values.tolist()[0]
    ['0.jpg', '1.jpg', '']
    """
    directory = Path(directory)
    with Store.read(directory) as store, undamaged(directory):
        facts = about_run(store.db)
        # A store that was opened, and then ended by a signal before the first publication
        if not facts:
            raise UserError(f"{directory}: the run has not begun, or was stopped at its start")
        about = About(**{name: facts[name] for name in vars(About())})
        tables = pair_tables(store.db)
        scenes = [*scenes_of(store).values()]
        placed = cameras(store)
        digests = dict(store.db.execute("SELECT name, digest FROM image"))
    if about.recipe.get("scene"):
        scenes += missing_scenes(tables.pairs, {scene.batch for scene in scenes})
    points = {
        (scene.batch, number): model.points
        for scene in scenes
        for number, model in enumerate(scene.models)
    }
    table = scene_table(scenes, about.files, digests)
    events = read_events(directory)
    return Results(tables.pairs, tables.units, placed, table, events, about, directory, points)


def about_run(db: sqlite3.Connection) -> dict[str, Any]:
    """Return the facts about the run that was published last: the fields of
    :class:`mkpc_kaggle.engine.request.About`, ``units`` (names and stages), the number of ``rows``, and the keys
    of the ``scenes`` by batch, the one in use first. Empty if the run has not published yet.
    """
    row = db.execute("SELECT about FROM run").fetchone()
    found: dict[str, Any] = json.loads(row[0]) if row else {}
    return found


def pair_tables(db: sqlite3.Connection) -> PairTables:
    """Return the tables of the pairs that were published last."""
    from pandas import DataFrame, Series, read_sql_query  # importing it takes half a second

    about = about_run(db)
    query = "SELECT * FROM pair WHERE number < ? ORDER BY number"
    pairs = read_sql_query(query, db, params=[about.get("rows", 0)])
    query = "SELECT key, facts FROM result WHERE key IN (SELECT estimate FROM pair)"
    stored = {key: json.loads(facts) for key, facts in db.execute(query)}
    estimates = [stored.get(key, {}) for key in pairs["estimate"]]
    units = _units(db, about.get("units", []), pairs, estimates)
    sums = units[units["reason"] == ""].groupby("number")
    names = ["matches", "inliers", *list(SECONDS)[:-1]]
    totals = sums[names].sum().reindex(pairs.index, fill_value=0)
    frame = pairs.rename(columns={"id": "pair", "batch": "group"})
    frame[names] = totals
    frame["units"] = units.groupby("number").size().reindex(pairs.index, fill_value=0)
    for name, default in STATISTICS.items():
        fact = name.removeprefix("estimate_")
        values = [facts.get(fact, default) for facts in estimates]
        frame[name] = Series(values, index=frame.index, dtype=type(default))
    frame["overlaps"] = frame["support"] >= MIN_SUPPORT
    elements = np.frombuffer(b"".join(pairs["F"])).reshape(-1, 9)
    frame[ELEMENTS] = DataFrame(elements, columns=ELEMENTS, index=frame.index)
    reasons = [json.loads(text) for text in pairs["reasons"]]
    failures = list(map(_failure, estimates, reasons, totals["matches"]))
    frame["failure"] = Series(failures, index=frame.index, dtype=object)
    each = zip(failures, reasons, pairs["source"], frame["units"], strict=True)
    frame["error"] = Series([_error(*row) for row in each], index=frame.index, dtype=object)
    units["pair"] = units["number"].map(frame["pair"])
    regions = _regions(units)
    shown = units.rename(columns={"reason": "failure"})[UNITS]
    return PairTables(frame[PAIRS], shown, regions, _estimates(frame["pair"], estimates))


def _units(
    db: sqlite3.Connection,
    named: Sequence[tuple[str, int]],
    pairs: "DataFrame",
    estimates: Sequence[Mapping[str, Any]],
) -> "DataFrame":
    """Return a row for each unit of a pair that has points, or a reason why it has none."""
    from pandas import DataFrame, read_sql_query

    used = []
    columns = ["number", "unit", "stage", "key", "is_needed", "inliers", "reason"]
    each = zip(pairs["points"], pairs["reasons"], estimates, strict=True)
    for number, (points, texts, facts) in enumerate(each):
        reasons = json.loads(texts)
        inliers = facts.get("inliers", {})
        for (unit, stage), (key, is_needed) in zip(named, json.loads(points), strict=True):
            reason = "" if key else reasons.get(unit, "")
            if key or reason:
                count = inliers.get(key, 0)
                used.append((number, unit, stage, key, is_needed, count, reason))
    frame = DataFrame(used, columns=columns)
    counts = ["matches", "keypoints"]
    seconds = list(SECONDS)[:-1]
    wanted = ", ".join(["key", *counts, *seconds, "scale", "detail", "regions", "note"])
    keys = "SELECT json_extract(value, '$[0]') FROM pair JOIN json_each(pair.points)"
    stored = read_sql_query(f"SELECT {wanted} FROM points WHERE key IN ({keys})", db)
    frame = frame.merge(stored, how="left", on="key")
    frame[["note", "regions"]] = frame[["note", "regions"]].fillna("")
    # A failed unit has no points, and neither matches nor seconds.
    frame[counts + seconds] = frame[counts + seconds].fillna(0)
    kinds: dict[str, type] = dict.fromkeys([*seconds, "scale", "detail"], float)
    kinds |= dict.fromkeys(["stage", "inliers", *counts], int) | {"is_needed": bool}
    # Points that the pair does not need under today's rule are not used.
    frame = frame.astype(kinds)
    frame.loc[~frame["is_needed"], "matches"] = 0
    return frame


def _failure(facts: Mapping[str, Any], reasons: Mapping[str, str], matches: int) -> str:
    """Return why a pair has no estimate, or why its estimate failed; empty with one."""
    if facts:
        return str(facts["failure"])
    units = [reason for what, reason in reasons.items() if what not in ("", "estimate")]
    lost = [] if matches else units[:1]
    return next(filter(None, [reasons.get(""), reasons.get("estimate"), *lost]), NOT_REACHED)


def _error(failure: str, reasons: Mapping[str, str], source: str, units: int) -> str:
    """Return the error that left a pair without an F. A unit that ran and found nothing is none: the images
    may not overlap.
    """
    if source != "fallback" or failure == NOT_REACHED:
        return ""
    if not units or "estimate" in reasons:
        return failure
    return next((reason for what, reason in reasons.items() if what), "")


def _regions(units: "DataFrame") -> "DataFrame":
    """Return the critical regions of each image of a pair, of its first unit that has any."""
    from pandas import DataFrame

    rows = []
    cropped = units[units["regions"] != ""].drop_duplicates("number")
    for pair, text in zip(cropped["pair"], cropped["regions"], strict=True):
        rows += [(pair, image, *region) for image, region in enumerate(json.loads(text))]
    return DataFrame(rows, columns=REGIONS)


def _estimates(pairs: Iterable[str], estimates: Iterable[Mapping[str, Any]]) -> "DataFrame":
    from pandas import DataFrame

    rows = []
    for pair, facts in zip(pairs, estimates, strict=True):
        magsac = facts.get("magsac")
        F = np.array(facts["F"]).reshape(3, 3) if facts else FALLBACK_FUNDAMENTAL
        matrix = None if magsac is None else np.array(magsac).reshape(3, 3)
        rows.append((pair, F, matrix))
    return DataFrame(rows, columns=["pair", "F", "magsac"])


def scenes_of(store: Store) -> dict[str, SceneRecord]:
    """Return the present reconstruction of each batch that has one."""
    named: dict[str, list[str]] = about_run(store.db).get("scenes", {})
    facts = store.facts(key for keys in named.values() for key in keys)
    found = {}
    for batch, keys in named.items():
        scenes = [scene_of(key, facts[key]) for key in keys if key in facts]
        if scenes:
            found[batch] = scenes[0].against(scenes[1:])
    return found


def cameras(store: Store) -> "DataFrame":
    """Return the cameras of all models. Identical files share a camera, and each has a row, in the order of
    the pairs.
    """
    from pandas import DataFrame

    contents: dict[tuple[str, str], list[str]] = {}  # names by batch and content
    query = """SELECT batch, image.name, digest FROM (
        SELECT batch, image0 AS name, 2 * number AS position FROM pair
        UNION ALL SELECT batch, image1, 2 * number + 1 FROM pair
    ) AS used JOIN image USING (name) GROUP BY batch, name ORDER BY min(position)"""
    for batch, name, content in store.db.execute(query):
        contents.setdefault((batch, content), []).append(name)
    rows = []
    for batch, scene in scenes_of(store).items():
        for number, model in enumerate(scene.models):
            for found in model.images:
                image, lens = found.image, found.lens
                camera = found.camera
                facts = (*image.size, found.focal, found.points, camera.K, camera.R, camera.t)
                known = ("", ()) if lens is None else (lens.model, lens.parameters)
                for name in contents.get((batch, image.digest), [image.name]):
                    rows.append((batch, number, name, *facts, *known))
    return DataFrame(rows, columns=CAMERAS)


def points_of(store: Store, number: int) -> dict[str, Matches]:
    """Return the matches of a row's pair by unit, in the recipe's order."""
    units = [name for name, _ in about_run(store.db)["units"]]
    ((points,),) = store.select("pair", "points", [number])
    named = zip(units, json.loads(points), strict=True)
    keys = {unit: key for unit, (key, is_needed) in named if key and is_needed}
    data = dict(store.select("points", "key, data", keys.values()))
    return {unit: from_bytes(data[key]) for unit, key in keys.items() if data.get(key)}


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


def matrices_of(pairs: "DataFrame") -> NDArray[np.float64]:
    """Return the written matrices (N, 3, 3) of a table of pairs."""
    return pairs[ELEMENTS].to_numpy(float).reshape(-1, 3, 3)


def by_pair(rows: "DataFrame") -> dict[str, "DataFrame"]:
    """Return the rows of each pair in a table of units or of regions, by the pair's id."""
    return {str(pair): members for pair, members in rows.groupby("pair", sort=False)}
