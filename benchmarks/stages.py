"""Scenes from COLMAP's pipeline and ours, with one stage exchanged at a time.

python -m benchmarks.stages --train-dir DIR --journals DIR --databases DIR [--scenes NAME ...]
    [--images 18] [--seeds 4] [--cells MATCHES/CELL/ERROR/CAMERA/MAPPER ...]

Each row of the table is a pipeline of these stages. The first row, ``all/0.75/2/pinhole/global``,
is ours.

- MATCHES: ``all`` in the journal, of some units such as ``1:sift@1536+1:aliked@1024``, or by
  ``COLMAP``
- CELL: size in pixels of the cells in which keypoints are merged; ``0``: no merging
- ERROR: maximum for verified matches in pixels; below ``4`` with our number of trials, else with
  COLMAP's
- CAMERA: ``pinhole`` or ``radial``
- MAPPER: ``global`` or ``incremental``

COLMAP's SIFT features and matches of a scene are stored in DATABASES/SCENE.db. The other options
and the table are the same as in `benchmarks.estimation`. Each image has its own camera.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import cache, partial
from itertools import combinations
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pycolmap
from numpy.typing import NDArray

from benchmarks.estimation import SCENE, Known, batch_pair, compare, draws_parser, extra_of
from benchmarks.pycolmap_alone import matched
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.recipe import CameraModel, CameraSharing, SceneConfig
from mkpc_kaggle.scene import colmap, keypoints
from mkpc_kaggle.scene.models import MIN_IMAGES
from mkpc_kaggle.scene.sfm import reconstruct_batch

OURS = "all/0.75/2/pinhole/global"
COLMAP = "COLMAP/0/4/radial/incremental"
UNMERGED_PX = 1e-3  # a cell of this size holds one keypoint
# COLMAP's defaults.
COLMAP_ERROR_PX = 4.0
COLMAP_TRIALS = 10_000


@cache
def of_colmap(
    database: Path, images: Path
) -> tuple[dict[str, Any], dict[tuple[str, str], NDArray[np.uint32]]]:
    """Return COLMAP's keypoints (K, 2) by image name, and matches (M, 2) by pair of names.

    Matches are indices of keypoints.
    """
    if not database.exists():
        # Renamed when it is complete: a later run takes it.
        part = database.with_suffix(".part")
        part.unlink(missing_ok=True)
        matched(part, images, one_camera=False)
        part.rename(database)
    with pycolmap.Database.open(str(database)) as found:
        names = {image.image_id: image.name for image in found.read_all_images()}
        points = {}
        for number, name in names.items():
            # Its other columns are scale and orientation.
            points[name] = found.read_keypoints(number)[:, :2] - colmap.CENTRE_PX
        matches = {}
        for i, j in combinations(sorted(names), 2):
            if found.exists_matches(i, j):
                matches[names[i], names[j]] = found.read_matches(i, j)
        return points, matches


def matches_of(known: Known, source: str, databases: Path) -> Matches:
    """Return a pair's matches from a source of a row."""
    if source != "COLMAP":
        wanted = source.split("+")
        chosen = []
        for result in known.found.results:
            if source == "all" or result.unit.name in wanted:
                chosen.append(result.matches)
        return Matches.concatenate(chosen)
    first, second = known.true.pair.images
    points, found = of_colmap(databases / f"{first.parent.parent.name}.db", first.parent)
    # COLMAP stores a pair once, in the order of its image ids.
    if (second.name, first.name) in found:
        index = found[second.name, first.name][:, ::-1]
    else:
        none = np.zeros((0, 2), np.uint32)
        index = found.get((first.name, second.name), none)
    points0 = points[first.name][index[:, 0]]
    points1 = points[second.name][index[:, 1]]
    return Matches(points0, points1, np.ones(len(index)))


@contextmanager
def stages(cell: float, error: float, mapper: str) -> Iterator[None]:
    """Exchange the stages of :mod:`mkpc_kaggle.scene` within the context."""
    with ExitStack() as stack:
        stack.enter_context(patch.object(keypoints, "CELL_PX", cell or UNMERGED_PX))
        trials = colmap.MAX_TRIALS if error < COLMAP_ERROR_PX else COLMAP_TRIALS
        stack.enter_context(patch.multiple(colmap, MAX_ERROR_PX=error, MAX_TRIALS=trials))
        if mapper == "incremental":
            stack.enter_context(patch.object(pycolmap, "GlobalPipeline", incremental))
        yield


def incremental(_: Any, database: Any, manager: Any) -> Any:
    """Return COLMAP's incremental mapper in place of the global one, with our settings."""
    settings = {
        "random_seed": 0,
        "num_threads": 1,
        "extract_colors": False,
        "min_model_size": MIN_IMAGES,
    }
    return pycolmap.IncrementalPipeline(
        pycolmap.IncrementalPipelineOptions(settings), database, manager
    )


def by_stages(
    row: str, databases: Path, pairs: Sequence[Known], every: Sequence[Known]
) -> list[Matrix3 | None]:
    """Return each pair's F from a row's scene, else the pair's own.

    This is an estimator of `benchmarks.estimation`.
    """
    source, cell, error, camera, mapper = row.split("/")
    model = CameraModel.SIMPLE_PINHOLE if camera == "pinhole" else CameraModel.SIMPLE_RADIAL
    config = SceneConfig(cameras=CameraSharing.IMAGE, camera_model=model)
    batch = []
    for known in (*pairs, *extra_of(pairs, every, config)):
        pair = batch_pair(known.true, known.found, known.F)
        batch.append(replace(pair, tracks=matches_of(known, source, databases)))
    with stages(float(cell), float(error), mapper):
        choices = reconstruct_batch(batch, config).choices[: len(pairs)]
    matrices = []
    for known, choice in zip(pairs, choices, strict=True):
        matrices.append(known.F if choice.F is None else choice.F)
    return matrices


def main() -> None:
    parser = draws_parser(__doc__ or "")
    parser.add_argument("--databases", type=Path, required=True)
    parser.add_argument("--cells", nargs="+", default=[OURS, COLMAP])
    arguments = parser.parse_args()
    arguments.databases.mkdir(parents=True, exist_ok=True)
    estimators = {}
    for row in arguments.cells:
        # The name begins as `benchmarks.estimation` names scenes, which have seconds per batch.
        estimators[f"{SCENE}, {row}"] = partial(by_stages, row, arguments.databases)
    compare(estimators, arguments)


if __name__ == "__main__":
    main()
