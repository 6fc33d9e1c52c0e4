"""``mkpc_kaggle.reconstruct``: the cameras of a folder of photographs, by a run of the engine."""

import signal
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.masks import Masks
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.session import Session, run_pairs
from mkpc_kaggle.engine.state import State
from mkpc_kaggle.errors import UserError, plural, printable, temporary_directory
from mkpc_kaggle.matchers.contract import Matcher
from mkpc_kaggle.recipe import CameraModel, CameraSharing, Recipe, SceneConfig
from mkpc_kaggle.reconstruction.folder import (
    Ends,
    read_folder,
    read_intrinsics,
    read_pair_list,
)
from mkpc_kaggle.reconstruction.outputs import (
    FOLDERS,
    PAGE,
    RESULTS,
    SCENES,
    WORK,
    Writer,
    keep_former,
    remove_results,
    require_out,
)
from mkpc_kaggle.reconstruction.pairs import choose_pairs
from mkpc_kaggle.scene.models import SfmModel
from mkpc_kaggle.setup.assembly import Assembly, PathSource, Weights, assemble
from mkpc_kaggle.setup.console import logger
from mkpc_kaggle.signals import Interrupt, interruptible

AUTO_RECIPE = "auto"  # the recipe of all matchers whose weights are found
WARNING_S = 0.5  # before the end, for the line that says why OUT is not complete
# Of MAGSAC on a pair, whose F is for the report alone. Pairs that do not overlap run all iterations.
# On 20 pairs of reichstag_26, 2,000 take 15 ms a pair and 10,000 take 24 ms. They find 1.00 of the
# inliers.
MAGSAC_ITERATIONS = 2_000
# ``all_tracks`` of [scene] for recipe auto. Cameras of 25 rendered photographs take 38 CPU seconds from all
# tracks and 18 from a few, with errors of 0.038 and 0.031 % of the model's size. Of 20 tourists'
# photographs, a few tracks lose 0.006 of 0.917 mAA (five draws).
ALL_TRACKS = 50


def reconstruct(
    images: PathSource,
    out: PathSource | None = None,
    recipe: Recipe | PathSource = AUTO_RECIPE,
    *,
    weights: Weights = (),
    device: str = "auto",
    precision: str = "float32",
    matchers: Mapping[str, Matcher[Any]] | None = None,
    settings: Mapping[str, Any] = MappingProxyType({}),
    camera: str | None = None,
    pairs: PathSource | None = None,
    intrinsics: PathSource | None = None,
    masks: PathSource | None = None,
    progress: bool = True,
    session: Session | None = None,
) -> tuple[SfmModel, ...]:
    """Return the models of a folder of photographs: cameras and points by structure from motion.

    Parameters
    ----------
    images : path
        The folder, whose photographs are one dataset, with those of its subfolders.
    out : path, optional
        The folder for COLMAP's files, ``cameras.csv``, the report and the journal: empty, or of an
        earlier call. After Ctrl-C, the same call continues, and with more photographs it matches
        only the new pairs. Custom matchers need ``MatcherSpec(version=...)`` for that.
    recipe, weights, device, precision, matchers, settings
        As for :class:`mkpc_kaggle.TwoStageMatcher`. With ``matchers``, matching runs in this
        process, else in separate processes.
    camera : {"auto", "image", "folder"}, optional
        Which images of one size share a camera: if their focal lengths agree, none, or all.
    pairs, intrinsics, masks : path, optional
        A list of the pairs to match, a table of known cameras, and a folder of masks, as for the
        command.
    progress : bool
        Show the progress on the standard error stream.
    session : Session, optional
        The environment of a command: its time limit, workers and signals.

    Returns
    -------
    tuple of SfmModel
        The models, the largest first; empty if too few images match. Cameras refer to the
        stored pixels of the files, as COLMAP reads them.

    Raises
    ------
    UserError
        For unusable inputs, a recipe that cannot run here, and an ``out`` that is neither empty nor
        of an earlier call.
    KeyboardInterrupt
        After Ctrl-C, once finished work is saved.

    Examples
    --------
    >>> from mkpc_kaggle import reconstruct
    >>> models = reconstruct("photographs", "OUT", "sift", progress=False)
    >>> all(len(model.images) >= 3 for model in models)
    True
    """
    root = Path(images)
    files = read_folder(root)
    listed = None if pairs is None else read_pair_list(Path(pairs), root, files)
    cameras = () if intrinsics is None else read_intrinsics(Path(intrinsics), root, files)
    shown = Masks() if masks is None else Masks.of_folder(Path(masks), root, files)
    with ExitStack() as closed:
        if out is None:
            out = closed.enter_context(temporary_directory())
        out = Path(out)
        if session is None:
            is_main = threading.current_thread() is threading.main_thread()
            interrupt = closed.enter_context(interruptible()) if is_main else Interrupt()
            # Objects of the user's program may not exist in other processes.
            workers = 0 if matchers else None
            budget = Budget(time.monotonic())
            session = Session(
                out / WORK, budget, interrupt, progress=progress, workers=workers
            )
        session.status = 1  # until a model exists
        with session.interrupt.raising():  # digests of weights and a shortlist take long
            assembly = assemble(
                recipe,
                weights=weights,
                device=device,
                precision=precision,
                matchers=matchers,
                settings=settings,
                scenes=True,
            )
            given = (images, pairs, intrinsics, masks)
            require_out(out, [Path(path) for path in given if path is not None])
            if listed is None:
                listed = choose_pairs(files, out / WORK, session.budget.stop_units)
        recipe = for_cameras(assembly.recipe, camera)
        assembly = replace(assembly, recipe=recipe, masks=shown, cameras=cameras)
        models, problems = _run(root, files, listed, out, assembly, session)
        for problem in problems:
            logger.warning(problem)
        session.status = int(not models or bool(problems))
        if session.interrupt.is_set():
            raise KeyboardInterrupt(session.interrupt.signal or signal.SIGINT)
        return models


def for_cameras(recipe: Recipe, sharing: str | None = None) -> Recipe:
    """Return the recipe without extra pairs and without steps that only improve the F of single
    pairs.

    Recipe ``auto`` without weights keeps its first unit alone, and enlarges no image. ``sharing`` is a
    :class:`CameraSharing`; without it, the recipe's is kept.
    """
    scene = recipe.scene or SceneConfig()
    # The folder has its pairs already.
    scene = replace(
        scene, pairs_per_image=0.0, cameras=CameraSharing(sharing or scene.cameras)
    )
    if scene.camera_model is CameraModel.AUTO:
        scene = replace(scene, camera_model=CameraModel.SIMPLE_RADIAL)  # as in COLMAP
    units = recipe.units
    if recipe.name == AUTO_RECIPE:
        scene = replace(scene, all_tracks=min(scene.all_tracks, ALL_TRACKS))
    # More views by RootSIFT cost three times as much, and two scenes scored 0.981 and 0.651 with
    # them, 0.985 and 0.637 without. Keypoints of enlarged images do not improve cameras either: the
    # mean of three scenes is 0.743 with them, 0.745 without. A recipe that the user names runs as it
    # is written.
    if recipe.name == AUTO_RECIPE and recipe.matcher_names == ("sift",):
        units = (replace(units[0], enlarge=False),)
    # F of a pair is for the report alone, and for its inliers.
    magsac = recipe.magsac
    iterations = min(magsac.max_iterations, MAGSAC_ITERATIONS)
    magsac = replace(magsac, max_iterations=iterations)
    return replace(recipe, units=units, magsac=magsac, focal=None, scene=scene)


def _run(
    root: Path,
    files: Sequence[Path],
    ends: Sequence[Ends],
    out: Path,
    assembly: Assembly,
    session: Session,
) -> tuple[tuple[SfmModel, ...], list[str]]:
    """Match the pairs, and write the results and the report to ``out``. Return the models, the
    largest first, and the problems of the run.
    """
    from mkpc_kaggle.reporting.page import report_run
    from mkpc_kaggle.reporting.summary import left_out_line, summary, trouble

    # The root of the file system has no name.
    batch = printable(root.resolve().name) or "images"
    names = {file: file.relative_to(root).as_posix() for file in files}
    pairs = [Pair(f"{names[a]} {names[b]}", batch, str(a), str(b)) for a, b in ends]
    recipe = assembly.recipe
    say = logger.info if session.progress else lambda _: None
    header = f"{plural(len(files), 'image')}, recipe {recipe.name}, {assembly.placement}, OUT {out}"
    known = f"known cameras: {len(assembly.cameras)}" if assembly.cameras else ""
    lines = [header, left_out_line(recipe, assembly.left_out), assembly.masks.line, known]
    say("\n".join(filter(None, lines)))
    with Writer(root, out) as writer:

        def publish(state: State) -> None:
            if batch in state.scenes:
                writer.update(state.scenes[batch].key)

        report = run_pairs(
            pairs,
            assembly,
            session,
            str(root),
            scenes_dir=out / WORK / SCENES,
            files={batch: list(names.values())},
            publish=publish,
        )
        failures = report.about.failures
        problems = [trouble(report), report.about.unwritten, report.about.unsaved, *failures]
        has_models = report.scenes["models"].any()
        say(summary(report))
        last = session.must_end() - WARNING_S
        models: list[SfmModel] = []
        try:
            with session.interrupt.raising():
                say(report_run(session.work_dir, out / PAGE, last, pairs))
                models = writer.next(last)
                writer.next(last)
            if models and report.ending.is_done:
                keep_former(out)
        except UserError as error:
            problems.append(f"{out} is not complete: {error}; the same command completes it")
        if report.ending.is_done and not has_models and not failures:
            models = []
            # A scene without models has its database and an empty table.
            remove_results(out, FOLDERS if writer.has_scene else RESULTS)
    return tuple(models), list(filter(None, problems))
