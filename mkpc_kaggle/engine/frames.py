"""The results of a run as pandas DataFrames, from the tables of its store.

They are all that reports, the summary, notebooks and scores read.
"""

import json
from base64 import b64decode
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mkpc_kaggle.engine.request import About, Ending
from mkpc_kaggle.engine.store import Store, undamaged
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.robust import FALLBACK_FUNDAMENTAL
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.recipe import Recipe, recipe_of
from mkpc_kaggle.scene.candidates import title_of
from mkpc_kaggle.scene.records import CAMERAS, SceneRecord

if TYPE_CHECKING:
    from pandas import DataFrame

NOT_REACHED = "not reached in time"
TOO_FEW = "at least three matched images are needed"
# Of F, row by row
ELEMENTS = [f"f{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3)]
SCENE_COLUMNS = [
    "batch",
    "images",
    "cameras",
    "models",
    "points",
    "reprojection_error",
    "seconds",
    "candidate",
    "failure",
    "missing",
]

# The store unites two databases by views. So its tables are not joined: SQLite would copy one of them.
# A former run may have had more rows.
ROWS = "WITH rows AS (SELECT *, key AS number FROM pair WHERE key < (SELECT rows FROM run))"
PAIRS = f"""{ROWS} SELECT id AS pair, batch AS "group", image0, image1, source, choice, error, estimate, F
    FROM rows ORDER BY number"""
ESTIMATES = f"{ROWS} SELECT key, facts FROM result WHERE key IN (SELECT estimate FROM rows)"
UNITS = f"""{ROWS} SELECT number, rows.id AS pair, estimate, json_extract(unit.value, '$[0]') AS unit,
        json_extract(unit.value, '$[1]') AS key, json_extract(unit.value, '$[2]') AS is_needed,
        json_extract(unit.value, '$[3]') AS failure
    FROM rows, json_each(units) AS unit ORDER BY number, unit.key"""
POINTS = f"""{ROWS} SELECT key, matches, keypoints, seconds, scale, detail, note FROM points
    WHERE key IN (SELECT json_extract(unit.value, '$[1]') FROM rows, json_each(units) AS unit)"""
# The images of each batch, in the order of the pairs
IMAGES = f"""{ROWS} SELECT batch, digest, name AS image FROM (
        SELECT batch, image0 AS name, 2 * number AS position FROM rows
        UNION ALL SELECT batch, image1, 2 * number + 1 FROM rows
    ) LEFT JOIN image ON image.key = name GROUP BY batch, name ORDER BY min(position)"""


@dataclass(frozen=True, eq=False)
class Results:
    """The results of a run. ``pairs`` has a row for each pair, ``units`` for each unit of a pair, with the
    ``key`` of its points in the store.

    ``cameras`` has a row for each camera of each model; identical files share a camera, and each
    has a row. ``scenes`` has a row for each batch: numbers of images, cameras, models and points, the mean
    reprojection error in pixels, whose tracks were used, the reason if there are no cameras, and the images
    without a camera. Columns that name a pair have its id. Columns that name an image have its
    path below the directory of the run's images. ``f11`` to ``f33`` of ``pairs`` are F; ``own`` is the F of
    the pair's matches alone, and ``magsac`` that before the prior, nine numbers or ``None``. ``choice`` is the
    reason why F is the scene's or not, ``units`` the number of units that are known or failed, and ``error`` the
    error that left the pair without an F, if it was not for few matches.
    """

    pairs: "DataFrame"
    units: "DataFrame"
    cameras: "DataFrame"
    scenes: "DataFrame"
    about: About
    directory: Path
    # Points (P, 3) of each model, of the longest tracks, by batch and number of the model
    points: Mapping[tuple[str, int], NDArray[np.float64]]

    @property
    def ending(self) -> Ending:
        return self.about.ending

    @property
    def recipe(self) -> Recipe:
        """The recipe as it ran: its file may have changed since."""
        settings = dict(self.about.recipe)
        return recipe_of(settings, settings.pop("name"))

    def matches(self, *pairs: str) -> Iterator[PairMatch]:
        """Yield the matches, critical regions and own F of pairs, by id, to plot them."""
        units = {unit.name: unit for unit in self.recipe.units}
        known = self.pairs.set_index("pair")
        with Store.read(self.directory) as store:
            for pair in pairs:
                row: Any = known.loc[pair]
                used = self.units[self.units["pair"] == pair]
                found = store.select("points", "key, data, regions", used["key"])
                stored = {key: more for key, *more in found}
                rows = []
                for unit in used.to_dict("records"):
                    data, regions = stored.get(unit["key"], (None, ""))
                    # Points that the pair does not need are not used.
                    rows.append(
                        (units[unit["unit"]], data if unit["is_needed"] else None, regions)
                    )
                F = (
                    FALLBACK_FUNDAMENTAL
                    if row["own"] is None
                    else np.reshape(row["own"], (3, 3))
                )
                yield PairMatch.of_stored(rows, F, row["inliers"], row["failure"])


def results(directory: Path | str) -> Results:
    """Return the results in a work directory, during a run or after it.

    Parameters
    ----------
    directory : str or Path
        NAME.work of a submission, ``--work-dir``, or OUT/work of :func:`reconstruct`.

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
    with Store.read(Path(directory)) as store, undamaged(Path(directory)):
        return results_of(store)


def results_of(store: Store) -> Results:
    """Return the results that were published last. Raise :class:`UserError` if nothing was."""
    from pandas import DataFrame

    row = store.db.execute("SELECT about FROM run").fetchone()
    # A store that was opened, and then ended by a signal before the first publication
    if row is None:
        raise UserError(
            f"{store.directory}: the run has not begun, or was stopped at its start"
        )
    facts = json.loads(row[0])
    stored = facts.pop("scenes")
    about = About(**{**facts, "ending": Ending(facts["ending"])})
    estimates = {key: json.loads(text) for key, text in store.db.execute(ESTIMATES)}
    estimates[""] = {"F": None, "magsac": None, "inliers": {}}  # of a pair without one
    units = unit_rows(store, estimates)
    pairs = frame_of(store, PAIRS)
    sums = units.assign(units=1).groupby("number")[["units", "matches", "inliers"]].sum()
    pairs[sums.columns] = sums.reindex(pairs.index, fill_value=0)
    found = [estimates[key] for key in pairs.pop("estimate")]
    # A failed estimate has its reason. Without one, a pair has that of a lost job.
    pairs["failure"] = [
        each.get("failure", error or NOT_REACHED)
        for each, error in zip(found, pairs["error"], strict=True)
    ]
    pairs["own"] = [each["F"] for each in found]
    pairs["magsac"] = [each["magsac"] for each in found]
    elements = np.frombuffer(b"".join(pairs.pop("F"))).reshape(-1, 9)
    pairs[ELEMENTS] = DataFrame(elements, index=pairs.index)
    images = frame_of(store, IMAGES)
    records = store.facts(key for _, key, _ in stored)
    scenes = [
        replace(SceneRecord.from_json(records[key]), batch=batch)
        if key in records
        else SceneRecord(batch, failure=failure)
        for batch, key, failure in stored
    ]
    others = about.files.keys() - {scene.batch for scene in scenes}
    scenes += [SceneRecord(batch, failure=TOO_FEW) for batch in sorted(others)]
    points = {
        (scene.batch, number): np.frombuffer(b64decode(cloud), "<f4")
        .reshape(-1, 3)
        .astype(float)
        for scene in scenes
        for number, cloud in enumerate(scene.clouds)
    }
    return Results(
        pairs,
        units.drop(columns=["number", "estimate"]),
        camera_table(scenes, images),
        scene_table(scenes, images, about.files),
        about,
        store.directory,
        points,
    )


def frame_of(store: Store, query: str) -> "DataFrame":
    from pandas import DataFrame  # importing it takes half a second

    rows = store.db.execute(query)
    return DataFrame(rows.fetchall(), columns=[column for column, *_ in rows.description])


def unit_rows(store: Store, estimates: Mapping[str, Mapping[str, Any]]) -> "DataFrame":
    """Return a row for each unit of a pair that has points, or a reason why it has none."""
    units = frame_of(store, UNITS).astype({"is_needed": bool})
    units = units.merge(frame_of(store, POINTS), how="left", on="key")
    # A failed unit has no points, and neither matches nor seconds.
    filled = {"matches": 0, "keypoints": 0, "seconds": 0.0, "note": ""}
    units = units.fillna(filled).astype({"matches": int, "keypoints": int})
    # Points that the pair does not need under today's rule are not used.
    units["matches"] *= units["is_needed"]
    units["inliers"] = [
        estimates[estimate]["inliers"].get(key, 0)
        for estimate, key in zip(units["estimate"], units["key"], strict=True)
    ]
    return units


def camera_table(scenes: Iterable[SceneRecord], images: "DataFrame") -> "DataFrame":
    """Return the cameras of all models. Identical files share a camera, and each has a row."""
    from pandas import DataFrame

    rows = [(scene.batch, *row) for scene in scenes for row in scene.cameras]
    frame = DataFrame(rows, columns=["batch", *CAMERAS]).drop(columns="image")
    # As in the tables of pairs, the names come first.
    frame = images.merge(frame, on=["batch", "digest"]).drop(columns="digest")
    for name in ("K", "R", "t"):
        frame[name] = frame[name].map(np.array)
    return frame


def scene_table(
    scenes: Iterable[SceneRecord], images: "DataFrame", files: Mapping[str, Sequence[str]]
) -> "DataFrame":
    """Return the table of scenes.

    ``files`` has the images of each dataset of a folder, also those in no pair.
    """
    from pandas import DataFrame

    table = []
    for scene in scenes:
        own = images[images["batch"] == scene.batch]
        digests = dict(zip(own["image"], own["digest"], strict=True))
        placed = {row[CAMERAS.index("digest")] for row in scene.cameras}
        names = files.get(scene.batch, list(digests))
        missing = tuple(name for name in names if digests.get(name) not in placed)
        row = (
            scene.batch,
            len(names),
            len(names) - len(missing),
            len(scene.clouds),
            scene.points,
            scene.reprojection_error,
            scene.seconds,
            title_of(scene.candidate),
            scene.failure,
            missing,
        )
        table.append(row)
    return DataFrame(table, columns=SCENE_COLUMNS)
