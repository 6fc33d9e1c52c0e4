"""Reconstruction of a folder, or of the images of a Python program, in a run of the engine."""

import os
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.images import Unreadable, read_image
from mkpc_kaggle.data.masks import Masks
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.console import warn
from mkpc_kaggle.engine.request import RunReport
from mkpc_kaggle.engine.session import (
    Interrupt,
    Session,
    interruptible,
    opened_engine,
    request_of,
)
from mkpc_kaggle.engine.state import State, name_below
from mkpc_kaggle.engine.store import FILE_NAME
from mkpc_kaggle.errors import UserError, writing
from mkpc_kaggle.matchers.contract import Matcher
from mkpc_kaggle.pipeline.assembly import Assembly, assemble
from mkpc_kaggle.recipe import CameraSharing, Recipe, SceneConfig
from mkpc_kaggle.reconstruction.choice import choose_pairs
from mkpc_kaggle.reconstruction.folder import Datasets, Ends, batch_names, require_distinct
from mkpc_kaggle.reconstruction.outputs import Cameras
from mkpc_kaggle.reconstruction.priors import read_intrinsics_table
from mkpc_kaggle.scene.export import MODELS, remove_files
from mkpc_kaggle.scene.reconstruction import RegisteredImage, SfmModel

if TYPE_CHECKING:
    from mkpc_kaggle.reporting.view import View

AUTO = "auto"  # the recipe of all matchers whose weights are found
COLMAP = "colmap"  # in the work directory of :func:`reconstruct`, for COLMAP's files


@dataclass(frozen=True)
class FolderResult:
    report: RunReport
    pairs: tuple[Pair, ...]
    cameras: Cameras


def for_cameras(recipe: Recipe, sharing: str | None = None, intrinsics: str = "") -> Recipe:
    """Return the recipe without extra pairs and without steps that only improve the F of single
    pairs.

    Recipe ``auto`` without weights keeps its first unit alone. ``sharing`` is a
    :class:`CameraSharing`, and ``intrinsics`` are known cameras as in :class:`SceneConfig`. Without
    them, the recipe's are kept.
    """
    scene = recipe.scene or SceneConfig()
    scene = replace(
        scene,
        # The folder has its pairs already.
        pairs_per_image=0.0,
        cameras=CameraSharing(sharing or scene.cameras),
        intrinsics=intrinsics or scene.intrinsics,
    )
    units = recipe.units
    # More views by RootSIFT cost three times as much, and two scenes scored 0.981 and 0.651 with
    # them, 0.985 and 0.637 without. A recipe that the user names runs as it is written.
    if recipe.name == AUTO and recipe.matcher_names == ("sift",):
        units = units[:1]
    # F of a pair is for the report alone: its inliers, and doubts about the pair.
    magsac = replace(recipe.magsac, permutations=1)
    return replace(recipe, units=units, magsac=magsac, focal=None, scene=scene)


def reconstruct_folder(
    root: Path,
    datasets: Datasets,
    assembly: Assembly,
    session: Session,
    out: Path,
    *,
    listed: Sequence[Ends] | None = None,
    rotations: bool = False,
    publish: Callable[[Cameras], None] = lambda _: None,
) -> FolderResult:
    """Match the pairs that :func:`choose_pairs` returns for the datasets below ``root``;
    reconstruct each dataset.

    COLMAP's files are in ``out``, in a folder with the dataset's name. With ``rotations``, images
    without matches are turned. A scene's process writes these files before the journal records the
    scene, so that a resumed run makes missing files. ``publish`` is called with the cameras so far:
    initially with no cameras, then after each scene.
    """
    assembly = replace(assembly, recipe=for_cameras(assembly.recipe))
    with opened_engine(
        assembly, session, [files[0].parent for files in datasets.values()]
    ) as engine:
        standing: list[Cameras] = [{name: dict.fromkeys(files) for name, files in datasets.items()}]
        # The tables of an earlier run are worth more than empty ones.
        if not (out / "cameras.csv").exists():
            with writing(f"--out {out}"):
                publish(standing[0])
        pairs = choose_pairs(
            engine, root, datasets, assembly, session, listed=listed, rotations=rotations
        )
        # Reports call the images directly below the root by the root's name.
        batches = batch_names(root, datasets)
        exports = {batches[name]: out / name for name in datasets}

        # Called by the engine's publications, and by the watchdog at the end of the time
        def write(results: State) -> None:
            standing[:] = [cameras_of(datasets, root, results)]
            publish(standing[0])

        engine.ask(request_of(pairs, assembly, session, str(root), exports=exports, publish=write))
        # Within the context: afterwards the store is closed.
        report = engine.report()
        # An earlier run's models, from other images, do not belong to tables without cameras.
        state = engine.state
        assert state is not None
        for batch in state.batches:
            if batch not in state.scenes and remove_files(exports[batch]):
                warn(f"{batch}: this run has no cameras; the models of an earlier run were removed")
    return FolderResult(report, tuple(pairs), *standing)


def cameras_of(datasets: Datasets, root: Path, results: State) -> Cameras:
    """Return the camera of each image. Identical files share one camera, from the largest model
    that has it.
    """
    cameras: dict[str, Mapping[Path, tuple[int, RegisteredImage] | None]] = {}
    # A file that was not read has no digest, and no camera.
    known_digests = results.digests
    batches = batch_names(root, datasets)
    for name, files in datasets.items():
        scene = results.scenes.get(batches[name])
        models = () if scene is None else scene.models
        # The largest model is the first, so it comes last into the dictionary and stays there.
        placed = [(number, found) for number, model in enumerate(models) for found in model.images]
        known = {found.image.digest: (number, found) for number, found in reversed(placed)}
        digests = {file: known_digests.get(name_below(str(root), str(file)), "") for file in files}
        cameras[name] = {file: known.get(digests[file]) for file in files}
    return cameras


class Models(tuple[SfmModel, ...]):
    """The models of :func:`reconstruct`, the largest first, which a notebook can show."""

    __slots__ = ()

    def show(self, *, metres_per_unit: float | None = None) -> "View":
        """Return an interactive view of cameras and points, the last value of a notebook's cell.

        With ``metres_per_unit``, the scale of a single model, a bar shows a length.
        """
        from mkpc_kaggle.reporting.view import show  # jinja2 is slow to import

        return show(self, metres_per_unit=metres_per_unit)


def reconstruct(
    images: Iterable[str | Path],
    recipe: Recipe | str = "auto",
    *,
    weights: Iterable[str | Path] = (),
    device: str = "auto",
    matchers: Mapping[str, Matcher[Any]] | None = None,
    masks: str | Path | None = None,
    intrinsics: str | Path | None = None,
    progress: bool = True,
    work_dir: str | Path | None = None,
) -> Models:
    """Return the models of the images at these paths, the largest first; no model if too few images
    match.

    This is a run of the command ``reconstruct`` on one set of images, without a time limit. Its
    ``progress`` is shown on the standard error stream. ``work_dir`` keeps the journal and COLMAP's
    files: after Ctrl-C, which raises ``KeyboardInterrupt``, the same call continues, and with more
    images it matches only the new pairs. ``masks`` is a directory, and ``intrinsics`` a table, as for
    the command; their paths are relative to the common directory of the images. With ``matchers``,
    matching runs in this process, else in separate processes.

    Cameras refer to the stored pixels of the files, as COLMAP reads them. ``colmap`` of a model is
    pycolmap's. Raises :class:`UserError` for a recipe that cannot run here, for unusable masks or
    intrinsics, for an unreadable image, and for a ``work_dir`` with a folder ``colmap`` that is not of
    an earlier call.
    """
    # By absolute path, because the journal knows an image by its path below the common directory
    given = {Path(image).absolute(): str(image) for image in images}
    files = sorted(given)
    checked = partial(
        assemble, recipe, weights=map(Path, weights), device=device, matchers=matchers
    )
    if len(files) < 2:
        checked()  # wrong arguments are errors here, too
        return Models()
    root = Path(os.path.commonpath([file.parent for file in files]))
    require_distinct(files)
    for file in files:
        # A few images of a notebook: one that is missing is a mistake.
        if isinstance(image := read_image(file), Unreadable):
            raise UserError(str(image))
    known = "" if intrinsics is None else read_intrinsics_table(Path(intrinsics), root, files)
    assembly = checked()
    assembly = replace(
        assembly,
        recipe=for_cameras(assembly.recipe, intrinsics=known),
        masks=assembly.masks if masks is None else Masks.of_folder(Path(masks), root, files),
    )
    with ExitStack() as closed:
        if work_dir is None:
            work_dir = closed.enter_context(TemporaryDirectory(prefix="mkpc-"))
        directory = Path(work_dir)
        if (directory / COLMAP).exists() and not (directory / FILE_NAME).is_file():
            raise UserError(f"{directory / COLMAP} was not made here; name another work_dir")
        session = Session(
            directory,
            Budget(time.monotonic()),
            closed.enter_context(interruptible()) if is_main_thread() else Interrupt(),
            progress=progress,
            # Objects of the user's program may not exist in other processes.
            workers=0 if matchers else None,
        )
        result = reconstruct_folder(root, {".": files}, assembly, session, directory / COLMAP)
        if session.interrupt.is_set():
            raise KeyboardInterrupt
        from mkpc_kaggle.reporting.summary import trouble  # jinja2 is slow to import

        if reason := trouble(result.report):
            raise UserError(reason)
        scenes = result.report.scenes
        names = {name_below(str(root), str(file)): name for file, name in given.items()}
        return Models(
            _complete(model, directory / COLMAP / MODELS / str(number), names)
            for scene in scenes
            for number, model in enumerate(scene.models)
        )


def _complete(model: SfmModel, folder: Path, names: Mapping[str, str]) -> SfmModel:
    """Return a model of the journal with all of its points, and with the user's names of images."""
    import pycolmap

    from mkpc_kaggle.scene.colmap import points_of

    found = pycolmap.Reconstruction(folder)
    images = []
    for placed in model.images:
        image = replace(placed.image, name=names[placed.image.name])
        images.append(replace(placed, image=image))
    return replace(model, images=tuple(images), points=points_of(found), colmap=found)


def is_main_thread() -> bool:
    """Return whether this is the thread that may handle signals."""
    return threading.current_thread() is threading.main_thread()
