"""Images in, cameras out: a folder by the engine, or a few images in this process."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.images import Image, ImageStore, Unreadable
from mkpc_kaggle.engine.console import warn
from mkpc_kaggle.engine.engine import RunReport
from mkpc_kaggle.engine.journal import Journal
from mkpc_kaggle.engine.records import CameraRecord, PairRecord, SceneRecord
from mkpc_kaggle.engine.session import Session, run_pairs
from mkpc_kaggle.errors import UserError, writing
from mkpc_kaggle.matchers.contract import Matcher
from mkpc_kaggle.pipeline.assembly import Assembly, assemble
from mkpc_kaggle.pipeline.pair import PairMatch
from mkpc_kaggle.recipe import CameraSharing, Recipe, SceneConfig, load_recipe
from mkpc_kaggle.reconstruction.choice import MAX_IMAGES, RunEndedError, choose_pairs
from mkpc_kaggle.reconstruction.directory import claim, settle
from mkpc_kaggle.reconstruction.folder import Datasets, Ends
from mkpc_kaggle.reconstruction.likeness import PARTNERS, local_features, most_alike, shortlist
from mkpc_kaggle.reconstruction.outputs import Cameras
from mkpc_kaggle.scene.export import Export
from mkpc_kaggle.scene.reconstruct import models_of, reconstruct_sharing
from mkpc_kaggle.scene.reconstruction import SfmModel
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair, ViewGraph, tracks_of


@dataclass(frozen=True)
class FolderResult:
    report: RunReport
    pairs: tuple[Pair, ...]
    cameras: Cameras


def for_cameras(recipe: Recipe, sharing: str | None = None) -> Recipe:
    """The recipe without steps that only improve the F of single pairs, and without extra pairs.

    ``sharing`` is a :class:`CameraSharing`; ``None``: as the recipe has it.
    """
    scene = replace(recipe.scene or SceneConfig(), pairs_per_image=0.0)
    return replace(recipe, focal=None, scene=replace(scene, cameras=CameraSharing(sharing or scene.cameras)))


def reconstruct_folder(
    datasets: Datasets,
    assembly: Assembly,
    session: Session,
    out: Path,
    *,
    listed: Sequence[Ends] | None = None,
    rotations: bool = False,
    publish: Callable[[Cameras], None] = lambda _: None,
) -> FolderResult:
    """Match the pairs of each dataset, those ``listed`` or of :func:`choose_pairs`, and reconstruct it.

    COLMAP's files of a dataset are in the folder of its name in ``out``. With ``rotations``, images that match
    nothing are turned. A scene's own process writes its files before the journal says that the scene is done, so
    a run that was killed makes what is lacking. ``publish`` is called with the cameras that there are, at first
    with none, and after each scene. Raises :class:`UserError` for what is in the way in ``out``.
    """
    assembly = replace(assembly, recipe=for_cameras(assembly.recipe))
    gone = claim(out, datasets)
    none: Cameras = {name: dict.fromkeys(files) for name, files in datasets.items()}
    belongs_to = {"images": {name: [file.name for file in files] for name, files in datasets.items()}}
    with Journal(session.work_dir / "images", belongs_to, fresh=session.fresh) as journal:
        settle(out, datasets, gone)
        for name in gone:
            warn(f"the images of {name} are gone, and so are its results in {out / name}")
        if not (out / "cameras.csv").exists():
            with writing(f"--out {out}"):
                publish(none)
        try:
            pairs = choose_pairs(datasets, assembly, session, journal, listed=listed, rotations=rotations)
        except RunEndedError as ended:
            return FolderResult(ended.report, (), none)
        turns = {path: times for pair in pairs for path, times in zip(pair.images, pair.turns, strict=True)}
        exports = {
            name: Export(
                out / name, files[0].parent, {file.stem: (file.name, turns.get(file, 0)) for file in files}
            )
            for name, files in datasets.items()
        }

        def write(records: Sequence[PairRecord], scenes: Iterable[SceneRecord]) -> None:
            publish(cameras_of(datasets, pairs, records, scenes))

        report = run_pairs(pairs, assembly, replace(session, exports=exports), write)
    return FolderResult(report, tuple(pairs), cameras_of(datasets, pairs, report.records, report.scenes))


def cameras_of(
    datasets: Datasets, pairs: Sequence[Pair], records: Sequence[PairRecord], scenes: Iterable[SceneRecord]
) -> Cameras:
    """The camera of each image. Files of one content have one camera, that of the largest model that has it."""
    versions: dict[Path, str] = {}
    for pair, record in zip(pairs, records, strict=True):
        # A pair that was not reached, or of which an image cannot be read, has no versions.
        versions |= zip(pair.images, record.versions, strict=True) if record.versions else ()
    cameras: dict[str, Mapping[Path, CameraRecord | None]] = {}
    placed = {scene.batch: scene.cameras for scene in scenes}
    for name, files in datasets.items():
        by_name = {file.name: versions.get(file) for file in files}
        known = {by_name[camera.image]: camera for camera in reversed(placed.get(name, ()))}
        cameras[name] = {file: known.get(by_name[file.name] or "") for file in files}
    return cameras


def reconstruct(
    images: Iterable[str | Path],
    recipe: Recipe | str = "auto",
    *,
    weights: Iterable[str | Path] = (),
    device: str = "auto",
    matchers: Mapping[str, Matcher[Any]] | None = None,
) -> tuple[SfmModel, ...]:
    """The models of images, given by their paths: the largest first, none where too little matches.

    What the command ``reconstruct`` does, in this process and without its budget and journal. Cameras are in
    pixels of what the files store, as COLMAP reads them. Raises :class:`UserError` for a recipe that cannot run
    here, and for an image that cannot be read.
    """
    files = sorted(map(Path, images))
    chosen = for_cameras(load_recipe(recipe) if isinstance(recipe, str) else recipe)
    assembly = assemble(chosen, weights=map(Path, weights), device=device, matchers=matchers)
    pipeline, store = assembly.pipeline(), ImageStore()

    def opened(path: Path) -> Image:
        image = store.get(path)
        if isinstance(image, Unreadable):
            raise UserError(str(image))
        return image

    pairs = []
    if len(files) <= MAX_IMAGES:
        ends = list(combinations(range(len(files)), 2))
    else:
        features = list(map(local_features, files))
        ends = shortlist(most_alike(lambda: features, PARTNERS))
    for path0, path1 in ((files[i], files[j]) for i, j in ends):
        (match,) = pipeline.match([PairMatch(images=(opened(path0), opened(path1)))], assembly.recipe.units)
        image0, image1 = (BatchImage(image.name, image.version, image.size) for image in match.images)
        pairs.append(BatchPair(image0, image1, match.matches, None, tracks_of(match.results)))
    pairs = Export(Path(), Path(), {str(file): (str(file), 0) for file in files}).stored(pairs)
    found, _ = reconstruct_sharing(ViewGraph.of_pairs(pairs), chosen.scene or SceneConfig())
    return tuple(sorted(models_of(found), key=lambda model: -len(model.images)))
