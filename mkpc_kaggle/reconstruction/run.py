"""Reconstruction of a folder of images in a run of the engine."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.masks import Masks
from mkpc_kaggle.engine.console import logger
from mkpc_kaggle.engine.plan.state import State
from mkpc_kaggle.engine.request import RunReport, name_below
from mkpc_kaggle.engine.scenes import scene_failures
from mkpc_kaggle.engine.session import Session, opened_engine, request_of
from mkpc_kaggle.errors import plural, writing
from mkpc_kaggle.recipe import CameraModel, CameraSharing, Recipe, SceneConfig
from mkpc_kaggle.reconstruction.causes import causes_in_files
from mkpc_kaggle.reconstruction.choice import choose_pairs
from mkpc_kaggle.reconstruction.folder import Datasets, Ends, batch_names
from mkpc_kaggle.reconstruction.outputs import (
    Cameras,
    PlacedImage,
    camera_rows,
    read_table_of_cameras,
)
from mkpc_kaggle.scene.align import REFERENCE
from mkpc_kaggle.scene.export import HeldDirectory, remove_files, versions_of
from mkpc_kaggle.scene.models import MIN_IMAGES
from mkpc_kaggle.setup.assembly import Assembly

AUTO_RECIPE = "auto"  # the recipe of all matchers whose weights are found
# Of MAGSAC on a pair, whose F is for the report alone. Pairs that do not overlap run all iterations.
# On 20 pairs of reichstag_26, 2,000 take 15 ms a pair and 10,000 take 24 ms. They find 1.00 of the
# inliers, and doubt the same pairs.
MAGSAC_ITERATIONS = 2_000
# ``all_tracks`` of [scene] for recipe auto. Cameras of 25 rendered photographs take 38 CPU seconds from all
# tracks and 18 from a few, with errors of 0.038 and 0.031 % of the model's size. Of 20 tourists'
# photographs, a few tracks lose 0.006 of 0.917 mAA (five draws).
ALL_TRACKS = 50
EARLIER = "its cameras and models are from an earlier run, as this one has no new ones yet"


@dataclass(frozen=True)
class FolderResult:
    """The outcome of a run on a folder.

    ``lost`` has the reason for each batch whose cameras could not be computed. ``earlier`` are the
    datasets that still have the cameras and files of an earlier run. ``causes`` are why images have no
    camera, as their files show.
    """

    report: RunReport
    pairs: tuple[Pair, ...]
    cameras: Cameras
    lost: Mapping[str, str]
    earlier: Collection[str] = ()
    held: Mapping[str, HeldDirectory] = field(default_factory=dict)  # of COLMAP's files, by dataset
    causes: tuple[str, ...] = ()


def for_cameras(recipe: Recipe, sharing: str | None = None) -> Recipe:
    """Return the recipe without extra pairs and without steps that only improve the F of single
    pairs.

    Recipe ``auto`` without weights keeps its first unit alone, and enlarges no image. ``sharing`` is a
    :class:`CameraSharing`; without it, the recipe's is kept.
    """
    scene = recipe.scene or SceneConfig()
    is_chosen = scene.camera_model is not CameraModel.AUTO
    scene = replace(
        scene,
        # The folder has its pairs already.
        pairs_per_image=0.0,
        cameras=CameraSharing(sharing or scene.cameras),
        camera_model=scene.camera_model if is_chosen else CameraModel.SIMPLE_RADIAL,
    )
    units = recipe.units
    if recipe.name == AUTO_RECIPE:
        scene = replace(scene, all_tracks=min(scene.all_tracks, ALL_TRACKS))
    # More views by RootSIFT cost three times as much, and two scenes scored 0.981 and 0.651 with
    # them, 0.985 and 0.637 without. Keypoints of enlarged images do not improve cameras either: the
    # mean of three scenes is 0.743 with them, 0.745 without. A recipe that the user names runs as it
    # is written.
    if recipe.name == AUTO_RECIPE and recipe.matcher_names == ("sift",):
        units = (replace(units[0], enlarge=False),)
    # F of a pair is for the report alone: its inliers, and doubts about the pair.
    magsac = recipe.magsac
    iterations = min(magsac.max_iterations, MAGSAC_ITERATIONS)
    magsac = replace(magsac, permutations=1, max_iterations=iterations)
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

    Until this run knows the cameras of a dataset, the dataset keeps the models and the rows of
    ``cameras.csv`` of the earlier run in ``out``, if any.
    """
    assembly = replace(assembly, recipe=for_cameras(assembly.recipe))
    folders = dict.fromkeys(file.parent for files in datasets.values() for file in files)
    with opened_engine(assembly, session, folders) as engine:
        # Not before this run has the journal: a run that is refused changes nothing.
        if session.fresh:
            forget_coordinates(out, datasets)
        table = out / "cameras.csv"
        earlier = read_table_of_cameras(table, root, datasets)
        if not table.exists():
            with writing(f"--out {out}"):
                publish(earlier)
        pairs = choose_pairs(
            engine, root, datasets, assembly, session, listed=listed, rotations=rotations
        )
        # Reports call the images directly below the root by the root's name.
        batches = batch_names(root, datasets)
        with writing(f"--out {out}"):
            exports = {batches[name]: HeldDirectory.of(out / name) for name in datasets}
            files_before = {name: versions_of(held.path) for name, held in exports.items()}

        # Called by the engine's publications, and by the watchdog at the end of the time
        def write(results: State) -> None:
            publish(cameras_of(datasets, root, results, earlier))

        names = {
            batches[name]: [name_below(str(root), str(file)) for file in files]
            for name, files in datasets.items()
        }
        engine.ask(
            request_of(pairs, assembly, session, str(root), names, exports=exports, publish=write)
        )
        state = engine.state
        assert state is not None
        # Models of an earlier run do not belong to tables without cameras.
        for batch in state.batches:
            is_without = batch not in state.scenes.in_use and is_decided(state, batch)
            if is_without and remove_files(exports[batch], files_before[batch]):
                logger.warning(
                    f"{batch}: its images have no matches; the models of an earlier run were removed"
                )
        lost = {batch: str(failure) for batch, failure in scene_failures(state).items()}
        cameras = cameras_of(datasets, root, state, earlier)
        standing = [
            name
            for name in unchanged(earlier, cameras, root)
            if is_unfinished(state, batches[name], lost)
        ]
        for name in standing:
            engine.log.fault(f"{batches[name]}: {EARLIER}")
        causes = tuple(causes_of_missing(state, cameras, root, assembly.masks))
        for cause in causes:
            engine.log.fault(cause)
        # Within the context: afterwards the store is closed.
        report = engine.report()
    held = {name: exports[batches[name]] for name in datasets}
    return FolderResult(report, tuple(pairs), cameras, lost, standing, held, causes)


def forget_coordinates(out: Path, datasets: Iterable[str]) -> None:
    """Remove the cameras of the last complete run, so that the next models have new coordinates."""
    with writing(f"--out {out}"):
        for dataset in datasets:
            # A first run has none.
            (out / dataset / REFERENCE).unlink(missing_ok=True)


def causes_of_missing(results: State, cameras: Cameras, root: Path, masks: Masks) -> Iterator[str]:
    """Yield why images of finished batches have no camera, if their files show a cause."""
    digests = results.digests
    for name, batch in batch_names(root, cameras).items():
        # A batch of one pair is none.
        is_unmatched = batch in results.batches and results.is_unmatched(batch)
        if batch not in results.scenes.in_use and not is_unmatched:
            continue
        # Images in no pair were not read.
        paired = {name for index in results.rows_of(batch) for name in results.names[index]}
        names = {file: name_below(str(root), str(file)) for file in cameras[name]}
        files = [file for file in names if names[file] in paired]
        contents = {digests.get(names[file], "") for file in files} - {""}
        if len(contents) < MIN_IMAGES:
            be = "is" if len(contents) == 1 else "are"
            where = " in pairs" if len(files) < len(names) else ""
            yield (
                f"{batch}: only {len(contents)} of {plural(len(files), 'file')}{where} can be read and {be} no "
                "copy of another; cameras need three different photographs"
            )
            continue
        missing = [file for file in files if cameras[name][file] is None]
        yield from (f"{batch}: {cause}" for cause in causes_in_files(missing, masks))


def is_decided(results: State, batch: str) -> bool:
    """Return whether a run knows the cameras of a batch, or that it has none."""
    if batch in results.scenes.in_use:
        return True
    # A batch of one pair is none. Units that failed say nothing about the images.
    return (
        batch in results.batches
        and results.is_unmatched(batch)
        and bool(results.current[results.rows_of(batch)].all())
    )


def is_unfinished(results: State, batch: str, lost: Collection[str]) -> bool:
    """Return whether the cameras in use, if any, are not from all of today's results."""
    return batch not in results.batches or batch in results.scenes.stale or batch in lost


def unchanged(before: Cameras, after: Cameras, root: Path) -> list[str]:
    """Return the datasets that have cameras, and the same ones as before."""
    return [
        name
        for name, placed in before.items()
        if any(placed.values())
        and [*camera_rows({name: placed}, root)] == [*camera_rows({name: after[name]}, root)]
    ]


def cameras_of(datasets: Datasets, root: Path, results: State, earlier: Cameras) -> Cameras:
    """Return the camera of each image. Identical files share one camera, from the largest model
    that has it.

    Datasets that the run has not decided yet have the cameras of an ``earlier`` run.
    """
    cameras: dict[str, Mapping[Path, PlacedImage | None]] = {}
    # A file that was not read has no digest, and no camera.
    known_digests = results.digests
    batches = batch_names(root, datasets)
    for name, files in datasets.items():
        if not is_decided(results, batches[name]):
            cameras[name] = earlier[name]
            continue
        scene = results.scenes.in_use.get(batches[name])
        models = () if scene is None else scene.models
        # The largest model is the first, so it comes last into the dictionary and stays there.
        by_digest: dict[str, PlacedImage] = {}
        for number, model in reversed([*enumerate(models)]):
            for image in reversed(model.images):
                content = image.image.digest
                by_digest[content] = PlacedImage(
                    number, image.camera, image.points, image.lens, content
                )
        digests = {file: known_digests.get(name_below(str(root), str(file)), "") for file in files}
        cameras[name] = {file: by_digest.get(digests[file]) for file in files}
    return cameras
