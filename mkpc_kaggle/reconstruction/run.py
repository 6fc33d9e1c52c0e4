"""Reconstruction of a folder in a run of the engine, or of a few images in this process."""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.images import Image, ImageStore, Unreadable
from mkpc_kaggle.data.masks import Masks
from mkpc_kaggle.engine.request import RunReport
from mkpc_kaggle.engine.session import Session, opened_engine, request_of
from mkpc_kaggle.engine.state import State, name_below
from mkpc_kaggle.errors import UserError, writing
from mkpc_kaggle.geometry.intrinsics import camera_of, written
from mkpc_kaggle.geometry.intrinsics import read as read_rows_of
from mkpc_kaggle.matchers.contract import Matcher
from mkpc_kaggle.pipeline.assembly import Assembly, assemble
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.recipe import CameraSharing, Recipe, SceneConfig
from mkpc_kaggle.reconstruction.choice import MAX_IMAGES, choose_pairs
from mkpc_kaggle.reconstruction.folder import Datasets, Ends, batch_names
from mkpc_kaggle.reconstruction.outputs import Cameras
from mkpc_kaggle.reconstruction.priors import read_intrinsics_table
from mkpc_kaggle.scene.likeness import PARTNERS, local_features, most_alike, shortlist
from mkpc_kaggle.scene.reconstruct import models_of, reconstruct_sharing
from mkpc_kaggle.scene.reconstruction import RegisteredImage, SfmModel
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair, ViewGraph, tracks_of

if TYPE_CHECKING:
    from mkpc_kaggle.reporting.view import View

AUTO = "auto"  # the recipe of all matchers whose weights are found


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
) -> Models:
    """Return the models of the images at these paths, the largest first; no model if too few images
    match.

    This is the command ``reconstruct`` in this process, without budget and journal. ``masks`` is a
    directory, and ``intrinsics`` a table, as for the command; their paths are relative to the common
    directory of the images. Cameras refer to the stored pixels of the files, as COLMAP reads them.
    Raises :class:`UserError` for a recipe that cannot run here, for unusable masks or intrinsics, and
    for an unreadable image.
    """
    files = sorted(map(Path, images))
    # Before weights are loaded, which takes long
    given_masks, known = priors_of(files, masks, intrinsics)
    assembly = assemble(recipe, weights=map(Path, weights), device=device, matchers=matchers)
    assembly = replace(
        assembly,
        recipe=for_cameras(assembly.recipe, intrinsics=known),
        masks=given_masks or assembly.masks,
    )
    pairs = []
    for match in matched_pairs(files, assembly):
        image0, image1 = map(batch_image, match.images)
        pairs.append(BatchPair(image0, image1, match.matches, None, tracks_of(match.results)))
    found, _ = reconstruct_sharing(
        ViewGraph.of_pairs(pairs), assembly.recipe.scene or SceneConfig()
    )
    return Models(models_of(found))


def priors_of(
    files: Sequence[Path], masks: str | Path | None, intrinsics: str | Path | None
) -> tuple[Masks | None, str]:
    """Return the masks of a directory, and the rows of a table for ``[scene] intrinsics``.

    Names in both are relative to the common directory of the files. Raises :class:`UserError` for
    unusable ones.
    """
    if not files:
        return None, ""
    # As the command's DIR, if all images are in one folder
    root = Path(os.path.commonpath([file.parent for file in files]))
    given = None if masks is None else Masks.of_folder(Path(masks), root, files)
    if intrinsics is None:
        return given, ""
    rows = read_rows_of(read_intrinsics_table(Path(intrinsics), root, files))
    # The images of the view graph have their whole paths as names, so each gets a row with its path.
    known = {str(file): camera_of(rows, file.relative_to(root).as_posix()) for file in files}
    return given, written([(name, camera) for name, camera in known.items() if camera is not None])


def matched_pairs(files: Sequence[Path], assembly: Assembly) -> Iterator[PairMatch]:
    """Yield the matches of all pairs of up to ``MAX_IMAGES`` files, or of a shortlist.

    Raises :class:`UserError` for an unreadable image.
    """
    pipeline = assembly.pipeline()
    store = ImageStore()

    # A few images of a notebook: one that is missing is a mistake, and no reason to go on without it.
    def opened(path: Path) -> Image:
        image = store.get(path)
        if isinstance(image, Unreadable):
            raise UserError(str(image))
        return image

    # As in the command
    ends = list(combinations(range(len(files)), 2))
    if len(files) > MAX_IMAGES:
        features = list(map(local_features, files))
        ends = shortlist(most_alike(lambda: features, PARTNERS))
    for i, j in ends:
        pair = PairMatch(images=(opened(files[i]), opened(files[j])))
        yield from pipeline.match([pair], assembly.recipe.units)


def batch_image(image: Image) -> BatchImage:
    return BatchImage(image.name, image.version, image.size, image.focal)
