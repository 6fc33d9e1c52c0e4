"""The coordinates of a folder that grows: which cameras a later run keeps, and by how much they
moved.
"""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from mkpc_kaggle.data.outputs import replacing
from mkpc_kaggle.errors import writing
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.reconstruction.folder import batch_names
from mkpc_kaggle.reconstruction.run import FolderResult
from mkpc_kaggle.scene.align import (
    MIN_COMMON,
    REFERENCE,
    ModelCameras,
    model_size,
    moved_by,
    read_reference,
    write_reference,
)

STILL = 1e-6  # of the model's size; smaller movements are rounding


def keep_coordinates(out: Path, root: Path, result: FolderResult) -> Iterator[str]:
    """Save the cameras of a complete run for the next run. Yield a line per dataset whose earlier
    cameras moved.

    A run that was ended early saves nothing, so that it ends as an undisturbed run when it is
    resumed. Raises :class:`UserError` if writing fails.
    """
    # Cameras of half the pairs are no coordinates to keep.
    if not result.report.ending.is_done:
        return
    batches = batch_names(root, result.cameras)
    for dataset, cameras in result.cameras.items():
        if dataset in result.earlier:
            continue  # nothing new
        models: dict[int, dict[str, Camera]] = {}
        for file, placed in cameras.items():
            if placed is not None:
                name = file.relative_to(root).as_posix()
                models.setdefault(placed.model, {})[name] = placed.camera
        # Before they are replaced
        yield from moved_lines(
            batches[dataset],
            read_reference(out / dataset),
            [models[number] for number in sorted(models)],
        )
        # Without any model, the cameras of the last run stay for the next one.
        if models:
            path = out / dataset / REFERENCE
            with writing(f"the coordinates {path}"), replacing(path) as stream:
                write_reference(stream, [models[number] for number in sorted(models)])


def moved_lines(
    batch: str, earlier: Iterable[ModelCameras], models: Sequence[ModelCameras]
) -> Iterator[str]:
    """Yield a line for each earlier model whose cameras are in a model now, and have moved."""
    for former in earlier:
        # A model may have split, or joined another one.
        now = max(models, key=lambda model: len(model.keys() & former.keys()), default={})
        names = sorted(now.keys() & former.keys())
        if len(names) < MIN_COMMON:
            continue
        targets = [former[name] for name in names]
        moved = moved_by([now[name] for name in names], targets) / model_size(targets)
        if moved.max() > STILL:
            middle = 100 * np.median(moved)
            most = 100 * moved.max()
            text = f"{len(names)} cameras keep the coordinates of the last run and moved by {middle:.2g} %"
            yield f"{batch}: {text} of the model's size (the median; {most:.2g} % at most)"
