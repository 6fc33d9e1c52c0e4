"""The results of a run as three pandas DataFrames."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mkpc_kaggle.engine.store.image_files import stored_digests
from mkpc_kaggle.engine.store.records import (
    PairRecord,
    SceneRecord,
    Table,
    UnitRecord,
    read_records,
    read_scenes,
)
from mkpc_kaggle.engine.store.tables import Store
from mkpc_kaggle.scene.models import RegisteredImage, Sigmas

if TYPE_CHECKING:
    from pandas import DataFrame

# pandas treats NaN as missing.
UNKNOWN = Sigmas(np.nan, np.nan, np.nan)
# The columns with their types, so that a table without rows has them, too.
ELEMENTS = [f"f{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3)]  # row by row
PAIR_COLUMNS = {
    "pair": str,
    "group": str,
    "image0": str,
    "image1": str,
    "failure": str,
    "source": str,
    "matches": int,
    "inliers": int,
    "overlaps": bool,
    "support": float,
    "flat": bool,
    "plane": float,
    "focal0": float,
    "focal1": float,
    "model": str,
    **dict.fromkeys(ELEMENTS, float),
}
UNIT_COLUMNS = {
    "pair": str,
    "unit": str,
    "stage": int,
    "matches": int,
    "inliers": int,
    "encode_seconds": float,
    "match_seconds": float,
    "failure": str,
    "note": str,
    "keypoints": int,
    "is_needed": bool,
    "scale": float,
    "detail": float,
}
CAMERA_COLUMNS = {
    "batch": str,
    "model": int,
    "image": str,
    "width": int,
    "height": int,
    "focal": float,
    "points": int,
    "rotation_sigma": float,
    "centre_sigma": float,
    "focal_sigma": float,
    "K": object,
    "R": object,
    "t": object,
    "camera_model": str,
    "parameters": object,
}


class Results(NamedTuple):
    """The results of a run. ``pairs`` has a row for each pair, ``units`` for each unit of a pair.

    ``cameras`` has a row for each camera of each model; identical files share a camera, and each
    has a row. Columns that name a pair have its id. Columns that name an image have its path below
    the directory of the run's images. ``f11`` to ``f33`` of ``pairs`` are the matrix of ``model``:
    F, or E for a pair with known intrinsics.
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
        digests = stored_digests(store, table.image_names)
        store.warn_of_damage()
    units = [_unit_row(record, unit) for record in records for unit in record.units]
    names = names_by_content(table, digests)
    return Results(
        _frame([_pair_row(record) for record in records], PAIR_COLUMNS),
        _frame(units, UNIT_COLUMNS),
        _frame(list(_camera_rows(scenes.values(), names)), CAMERA_COLUMNS),
    )


def names_by_content(
    table: Table, digests: Mapping[str, str]
) -> dict[tuple[str, str], dict[str, None]]:
    """Return the names of the images of each batch and content, in the order of the table."""
    names: dict[tuple[str, str], dict[str, None]] = {}
    for row in table.rows:
        for name in (row.image0, row.image1):
            # A dictionary keeps the order, and a name once.
            names.setdefault((row.batch, digests.get(name, "")), {})[name] = None
    return names


def _frame(rows: Sequence[Mapping[str, Any]], columns: Mapping[str, type]) -> "DataFrame":
    from pandas import DataFrame, Series  # importing it takes half a second

    if rows:
        return DataFrame(rows, columns=list(columns))
    return DataFrame({name: Series(dtype=kind) for name, kind in columns.items()})


def _pair_row(record: PairRecord) -> dict[str, Any]:
    row = {
        "pair": record.pair.id,
        "group": record.pair.group,
        # Not the file names alone: two folders may have the same.
        "image0": record.pair.file0,
        "image1": record.pair.file1,
        "failure": record.failure,
        "source": record.source,
        "matches": record.matches,
        "inliers": record.inliers,
        "overlaps": record.overlaps,
        "support": record.stats.support,
        "flat": record.is_flat,
        "plane": record.stats.plane,
        "focal0": record.stats.focals[0],
        "focal1": record.stats.focals[1],
        "model": record.model,
    }
    return row | dict(zip(ELEMENTS, record.chosen_fundamental.flat, strict=True))


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
        "is_needed": unit.is_needed,
        "scale": unit.scale,
        "detail": unit.detail,
    }


def _camera_rows(
    scenes: Iterable[SceneRecord], names: Mapping[tuple[str, str], Iterable[str]]
) -> Iterator[dict[str, Any]]:
    for scene in scenes:
        # Model 0 has the most images.
        for number, model in enumerate(scene.models):
            for found in model.images:
                # An image that has changed since is known by its former name.
                alike = names.get((scene.batch, found.image.digest), [found.image.name])
                for name in alike:
                    yield _camera_row(scene.batch, number, name, found)


def _camera_row(batch: str, model: int, name: str, found: RegisteredImage) -> dict[str, Any]:
    sigmas = found.sigmas or UNKNOWN
    return {
        "batch": batch,
        "model": model,
        "image": name,
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
        # COLMAP's, with (0.5, 0.5) in the centre of the first pixel: K has no distortion.
        "camera_model": "" if found.lens is None else found.lens.model,
        "parameters": () if found.lens is None else found.lens.parameters,
    }
