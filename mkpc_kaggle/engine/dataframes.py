"""The results of a run as three pandas DataFrames."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mkpc_kaggle.engine.records import (
    PairRecord,
    SceneRecord,
    Table,
    UnitRecord,
    read_records,
    read_scenes,
)
from mkpc_kaggle.engine.store import Store
from mkpc_kaggle.scene.reconstruction import RegisteredImage, Sigmas

if TYPE_CHECKING:
    from pandas import DataFrame

# pandas treats NaN as missing.
UNKNOWN = Sigmas(np.nan, np.nan, np.nan)


class Results(NamedTuple):
    """The results of a run. ``pairs`` has a row for each pair, ``units`` for each unit of a pair.

    ``cameras`` has a row for each camera of each model. Columns that name a pair have its id.
    """

    pairs: "DataFrame"
    units: "DataFrame"
    cameras: "DataFrame"


def results(directory: Path | str) -> Results:
    """Return the results in a work directory (NAME.work), during a run or after it.

    Raises :class:`UserError` if the store is missing, damaged, or of another format.
    """
    with Store.read(Path(directory)) as store:
        table = Table.of(store)
        records = read_records(store, table)
        scenes = read_scenes(store, table)
    from pandas import DataFrame  # importing it takes half a second

    units = [_unit_row(record, unit) for record in records for unit in record.units]
    return Results(
        DataFrame([_pair_row(record) for record in records]),
        DataFrame(units),
        DataFrame(list(_camera_rows(scenes.values()))),
    )


def _pair_row(record: PairRecord) -> dict[str, Any]:
    row = {
        "pair": record.pair.id,
        "group": record.pair.group,
        "image0": record.pair.names[0],
        "image1": record.pair.names[1],
        "failure": record.failure,
        "source": record.source,
        "matches": record.matches,
        "inliers": record.inliers,
        "overlaps": record.overlaps,
        "support": record.stats.support,
        "focal0": record.stats.focals[0],
        "focal1": record.stats.focals[1],
    }
    for index, value in np.ndenumerate(record.chosen_fundamental):
        row[f"f{index[0] + 1}{index[1] + 1}"] = value  # f11 to f33, row by row
    return row


def _unit_row(record: PairRecord, unit: UnitRecord) -> dict[str, Any]:
    return {
        "pair": record.pair.id,
        "unit": unit.unit,
        "stage": unit.stage,
        "matches": unit.matches,
        "inliers": unit.inliers,
        "encode_seconds": unit.encode_seconds,
        "match_seconds": unit.match_seconds,
        "failure": unit.failure,
        "note": unit.note,
        "keypoints": unit.keypoints,
    }


def _camera_rows(scenes: Iterable[SceneRecord]) -> Iterator[dict[str, Any]]:
    for scene in scenes:
        # Model 0 has the most images.
        for number, model in enumerate(scene.models):
            for found in model.images:
                yield _camera_row(scene.batch, number, found)


def _camera_row(batch: str, model: int, found: RegisteredImage) -> dict[str, Any]:
    sigmas = found.sigmas or UNKNOWN
    return {
        "batch": batch,
        "model": model,
        "image": found.image.name,
        "width": found.image.size.width,
        "height": found.image.size.height,
        "focal": found.focal,
        "points": found.points,
        "rotation_sigma": sigmas.rotation,
        "centre_sigma": sigmas.centre,
        "focal_sigma": sigmas.focal,
        "K": found.camera.K,
        "R": found.camera.R,
        "t": found.camera.t,
    }
