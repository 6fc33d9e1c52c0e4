"""``mkpc_kaggle.reconstruct``: the models of a Python program's images."""

import os
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from mkpc_kaggle.data.images import Unreadable, has_usable_shape, read_image, read_size
from mkpc_kaggle.data.masks import Masks
from mkpc_kaggle.engine.console import logger
from mkpc_kaggle.engine.plan.budget import Budget
from mkpc_kaggle.engine.request import RunReport, name_below
from mkpc_kaggle.engine.session import Interrupt, Session, interruptible
from mkpc_kaggle.engine.store.database import FILE_NAME
from mkpc_kaggle.errors import UserError, plural, temporary_directory
from mkpc_kaggle.matchers.contract import Matcher
from mkpc_kaggle.recipe import Recipe
from mkpc_kaggle.reconstruction.directory import require_directory_apart
from mkpc_kaggle.reconstruction.folder import read_folder, require_distinct
from mkpc_kaggle.reconstruction.outputs import PlacedImage
from mkpc_kaggle.reconstruction.panoramas import require_perspective
from mkpc_kaggle.reconstruction.priors import (
    crops_line,
    has_gaps,
    intrinsics_line,
    read_intrinsics_table,
)
from mkpc_kaggle.reconstruction.run import for_cameras, reconstruct_folder
from mkpc_kaggle.reporting.summary import trouble, unreadable_images
from mkpc_kaggle.scene.export import MODELS
from mkpc_kaggle.scene.models import SfmModel
from mkpc_kaggle.setup.arguments import PathSource, Weights, shown_value, weights_of
from mkpc_kaggle.setup.assembly import Assembly, assemble
from mkpc_kaggle.setup.availability import Licence

COLMAP = "colmap"  # in the work directory, for COLMAP's files


def reconstruct(
    images: PathSource | Iterable[PathSource],
    recipe: Recipe | PathSource = "auto",
    *,
    weights: Weights = (),
    device: str = "auto",
    precision: str = "float32",
    licence: Licence | str = Licence.ANY,
    matchers: Mapping[str, Matcher[Any]] | None = None,
    settings: Mapping[str, Any] = MappingProxyType({}),
    masks: str | Path | None = None,
    intrinsics: str | Path | None = None,
    progress: bool = True,
    work_dir: str | Path | None = None,
) -> tuple[SfmModel, ...]:
    """Return the models of photographs: cameras and points by structure from motion.

    This is a run of the command ``reconstruct`` on one set of images, without a time limit.

    Parameters
    ----------
    images : path, or iterable of paths
        A folder of images, or image files.
    recipe, weights, device, precision, licence, matchers, settings
        As for :class:`mkpc_kaggle.TwoStageMatcher`. With ``matchers``, matching runs in this
        process, else in separate processes.
    masks : path, optional
        A directory of masks, as for the command. Masks are named by the path of their image
        relative to the common directory of the images.
    intrinsics : path, optional
        A table of known cameras, as for the command, whose images have the same paths.
    progress : bool
        Show the progress on the standard error stream.
    work_dir : path, optional
        A directory to keep the journal and COLMAP's files: after Ctrl-C, the same call continues,
        and with more images it matches only the new pairs. Custom matchers need
        ``MatcherSpec(version=...)`` for that.

    Returns
    -------
    tuple of SfmModel
        The largest model first; empty if too few images match. Cameras refer to the
        stored pixels of the files, as COLMAP reads them. ``colmap`` of a model is pycolmap's. It
        has one of several identical files; ``images`` has a camera for each of them.

    Raises
    ------
    UserError
        For a recipe that cannot run here, unusable masks or intrinsics, an unreadable image, a
        ``work_dir`` whose folder ``colmap`` is not of an earlier call or has an input, and cameras
        that cannot be computed.
    KeyboardInterrupt
        After Ctrl-C, once finished work is saved.

    Examples
    --------
    >>> from mkpc_kaggle import reconstruct
    >>> models = reconstruct(["a.jpg", "b.jpg"], "sift", work_dir="work", progress=False)
    >>> len(models)  # a model needs three images
    0
    """
    # By absolute path, because the journal knows an image by its path below the common directory
    given = {image.absolute(): str(image) for image in image_paths(images)}
    files = sorted(given)
    assembly = assemble(
        recipe,
        weights=weights,
        device=device,
        precision=precision,
        licence=Licence(licence),
        matchers=matchers,
        settings=settings,
    )
    if len(files) < 2:
        # An empty result without its reason would look like a success.
        count = plural(len(files), "image")
        logger.warning(f"no cameras: {count} given, and at least three matched images are needed")
        return ()
    require_readable(files)
    require_perspective(files)
    root = Path(os.path.commonpath([file.parent for file in files]))
    assembly = with_priors(assembly, root, files, masks, intrinsics)
    with ExitStack() as closed:
        if work_dir is None:
            work_dir = closed.enter_context(temporary_directory())
        elif assembly.unversioned:
            logger.warning(
                f"the results of {', '.join(assembly.unversioned)} are not kept for later calls: "
                "set MatcherSpec(version=...), and change it whenever equal pictures get other points"
            )
        directory = Path(work_dir)
        out = directory / COLMAP
        if out.exists() and not (directory / FILE_NAME).is_file():
            raise UserError(f"{out} was not made here; name another work_dir")
        files_of_recipe = () if isinstance(recipe, Recipe) else (recipe,)
        weight_folders, weight_files = weights_of(weights)
        given_paths = filter(None, (masks, intrinsics, *files_of_recipe))
        inputs = [
            *dict.fromkeys(file.parent for file in files),
            *map(Path, given_paths),
            *weight_folders,
            *weight_files.values(),
        ]
        # The photographs often lie around the work directory, and so may all other inputs.
        require_directory_apart(out, (), inputs, "work_dir:")
        session = Session(
            directory,
            Budget(time.monotonic()),
            closed.enter_context(interruptible()) if is_main_thread() else Interrupt(),
            progress=progress,
            # Objects of the user's program may not exist in other processes.
            workers=0 if matchers else None,
        )
        result = reconstruct_folder(root, {".": files}, assembly, session, out)
        if session.interrupt.is_set():
            raise KeyboardInterrupt
        if reason := trouble(result.report):
            raise UserError(reason)
        # The models are complete, but the next call computes results again.
        if result.report.unsaved:
            logger.warning(result.report.unsaved)
        for failure in unreadable_images(result.report.tables.pairs):
            logger.warning(f"cannot be read: {failure}")
        # In the models of an earlier call, images may be missing, and so may their files.
        if result.lost:
            reason = next(iter(result.lost.values()))
            raise UserError(f"no cameras: {reason}; the same call tries again")
        # An empty result without its reason would look like a success.
        for line in no_models(result.report) or result.causes:
            logger.warning(line)
        names = {name_below(str(root), str(file)): name for file, name in given.items()}
        return tuple(
            with_copies(
                complete_model(model, out / MODELS / str(number), names),
                number,
                {given[file]: camera for file, camera in result.cameras["."].items()},
            )
            for scene in result.report.scenes
            for number, model in enumerate(scene.models)
        )


def no_models(report: RunReport) -> list[str]:
    """Return why a run has no models, and the faults that explain it; empty if it has models."""
    if any(scene.models for scene in report.scenes):
        return []
    reasons = [scene.failure for scene in report.scenes]
    reason = "; ".join(reasons) or "at least three matched images are needed"
    return [f"no cameras: {reason}", *report.faults]


def image_paths(images: Any) -> list[Path]:
    """Return the paths of images, or the images of a folder.

    Raises :class:`UserError` for a folder with several folders of images.
    """
    expected = "a folder, or paths of images"
    if isinstance(images, str | os.PathLike):
        folder = Path(images)
        if not folder.is_dir():
            raise UserError(f"images: {folder} is no folder; expected {expected}")
        datasets = read_folder(folder)
        if len(datasets) > 1:
            names = ", ".join(datasets)
            raise UserError(
                f"images: {folder} has several folders of images, {names}; name one of them"
            )
        return [file for files in datasets.values() for file in files]
    # An array or a column of a table may have paths; one of several dimensions has pixels or cells.
    if not isinstance(images, Iterable) or len(getattr(images, "shape", (0,))) != 1:
        raise TypeError(f"images is {shown_value(images)}; expected {expected}")
    paths = []
    for number, image in enumerate(images):
        if not isinstance(image, str | os.PathLike):
            raise TypeError(
                f"images[{number}] is {shown_value(image)}; expected the path of an image"
            )
        path = Path(image)
        if path.is_dir():
            raise UserError(f"images[{number}]: {path} is a folder; give it alone, or its images")
        paths.append(path)
    return paths


def require_readable(files: Sequence[Path]) -> None:
    """Raise :class:`UserError` for an image that cannot be read, or for one that is given twice."""
    require_distinct(files)
    for file in files:
        # A few images of a notebook: one that is missing is a mistake. The head is enough here: the
        # run decodes the rest, and this process may be a notebook's.
        size = read_size(file)
        if size is not None and has_usable_shape(size):
            continue
        if isinstance(image := read_image(file), Unreadable):
            raise UserError(str(image))


def with_priors(
    assembly: Assembly,
    root: Path,
    files: Sequence[Path],
    masks: str | Path | None,
    intrinsics: str | Path | None,
) -> Assembly:
    """Return the assembly for cameras, with the user's masks and intrinsics. Raises
    :class:`UserError` if they are unusable.
    """
    cameras = () if intrinsics is None else read_intrinsics_table(Path(intrinsics), root, files)
    given = assembly.masks if masks is None else Masks.of_folder(Path(masks), root, files)
    if masks is not None and len(given.files) < len(files):
        logger.warning(given.line)
    if cameras and has_gaps(cameras, root, files):
        logger.warning(intrinsics_line(cameras, root, files))
    if line := crops_line(cameras, root, files):
        logger.warning(line)
    recipe = for_cameras(assembly.recipe)
    return replace(assembly, recipe=recipe, masks=given, cameras=cameras)


def complete_model(model: SfmModel, folder: Path, names: Mapping[str, str]) -> SfmModel:
    """Return a model of the journal with all of its points, and with the user's names of images."""
    import pycolmap

    from mkpc_kaggle.scene.colmap import points_of

    found = pycolmap.Reconstruction(folder)
    images = []
    for placed in model.images:
        image = replace(placed.image, name=names[placed.image.name])
        images.append(replace(placed, image=image))
    return replace(model, images=tuple(images), points=points_of(found), colmap=found)


def with_copies(
    model: SfmModel, number: int, cameras: Mapping[str, PlacedImage | None]
) -> SfmModel:
    """Return model ``number`` with a camera for each file that is identical to one of its images.

    ``cameras`` has the camera of each file, by the user's name.
    """
    names = {found.image.name for found in model.images}
    by_content = {found.image.digest: found for found in model.images}
    copies = []
    for name, camera in cameras.items():
        if camera is not None and camera.model == number and name not in names:
            found = by_content[camera.content]
            copies.append(replace(found, image=replace(found.image, name=name)))
    return replace(model, images=(*model.images, *copies))


def is_main_thread() -> bool:
    """Return whether this is the thread that may handle signals."""
    return threading.current_thread() is threading.main_thread()
