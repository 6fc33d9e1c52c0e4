"""Images in, cameras out: a folder by the engine, or a few images in this process."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.data.pairs import turned_copy
from mkpc_kaggle.engine.engine import RunReport
from mkpc_kaggle.engine.records import CameraRecord
from mkpc_kaggle.engine.session import Session, run_pairs
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.matchers.contract import Matcher
from mkpc_kaggle.pipeline.assembly import Assembly
from mkpc_kaggle.pipeline.two_stage import TwoStageMatcher, to_image
from mkpc_kaggle.recipe import CameraSharing, Recipe, SceneConfig, load_recipe
from mkpc_kaggle.reconstruction.folder import Datasets, Ends, pairs_of
from mkpc_kaggle.reconstruction.likeness import find_turns
from mkpc_kaggle.reconstruction.outputs import Cameras
from mkpc_kaggle.scene.export import MODELS, Export
from mkpc_kaggle.scene.reconstruct import models_of, reconstruct_sharing
from mkpc_kaggle.scene.reconstruction import SfmModel
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair, ViewGraph, tracks_of


@dataclass(frozen=True)
class FolderResult:
    """What came of a folder: how the run went, its pairs, and the cameras."""

    report: RunReport
    pairs: tuple[Pair, ...]
    cameras: Cameras


def for_cameras(recipe: Recipe, sharing: str | None = None) -> Recipe:
    """The recipe without steps that only improve the F of single pairs, and without extra pairs.

    ``sharing`` is a :class:`CameraSharing`; ``None``: as the recipe has it.
    """
    scene = replace(recipe.scene or SceneConfig(), each_matcher=False, pairs_per_image=0.0)
    return replace(recipe, focal=None, scene=replace(scene, cameras=CameraSharing(sharing or scene.cameras)))


def reconstruct_folder(
    datasets: Datasets,
    assembly: Assembly,
    session: Session,
    out: Path,
    *,
    listed: Sequence[Ends] | None = None,
    rotations: bool = False,
) -> FolderResult:
    """Match the pairs of each dataset, those ``listed`` or by :func:`pairs_of`, and reconstruct it.

    COLMAP's files of a dataset are in the folder of its name in ``out``. With ``rotations``, images that match
    nothing are turned. A scene's own process writes its files before the journal says that the scene is done, so
    a run that was killed makes what is lacking.
    """
    assembly = replace(assembly, recipe=for_cameras(assembly.recipe))
    pairs, exports = [], {}
    for name, files in datasets.items():
        ends = pairs_of(files) if listed is None else [two for two in listed if two[0].parent == files[0].parent]
        turns = dict.fromkeys(files, 0) | (find_turns(files, assembly) if rotations and ends else {})
        shown = {file: turned_copy(file, turns[file], session.work_dir / "turned")[0] for file in files}
        stored = {shown[file].stem: (file.name, turns[file]) for file in files}
        exports[name] = Export(out / name, files[0].parent, stored)
        pairs += [Pair(f"{name}/{a.stem}/{b.stem}", name, str(shown[a]), str(shown[b])) for a, b in ends]
    report = run_pairs(pairs, assembly, replace(session, exports=exports))
    versions: dict[str, dict[str, str]] = {name: {} for name in datasets}
    for pair, record in zip(pairs, report.records, strict=True):
        # A pair that was not reached, or of which an image cannot be read, has no versions.
        for path, version in zip(pair.images if record.versions else (), record.versions, strict=True):
            versions[pair.group][exports[pair.group].files[path.stem][0]] = version
    placed = {scene.batch: scene.cameras for scene in report.scenes}
    cameras: dict[str, Mapping[Path, CameraRecord | None]] = {}
    for name, files in datasets.items():
        found = placed.get(name, ())
        if found and not (models := out / name / MODELS).is_dir():
            raise UserError(f"{models} was removed after it was made; start anew with --fresh")
        # Files of one content have one camera, that of the largest model that has it.
        known = {versions[name][camera.image]: camera for camera in reversed(found)}
        cameras[name] = {file: known.get(versions[name].get(file.name, "")) for file in files}
    return FolderResult(report, tuple(pairs), cameras)


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
    matcher = TwoStageMatcher(chosen, weights=weights, device=device, matchers=matchers)
    decoded = ((path, to_image(path)) for path in files)
    known = {path: BatchImage(str(path), image.name, image.size) for path, image in decoded}
    pairs = []
    for path0, path1 in pairs_of(files):
        match = matcher(path0, path1)
        pairs.append(BatchPair(known[path0], known[path1], match.matches, None, tracks_of(match.results)))
    pairs = Export(Path(), Path(), {str(file): (str(file), 0) for file in files}).stored(pairs)
    found, _ = reconstruct_sharing(ViewGraph.of_pairs(pairs), chosen.scene or SceneConfig())
    return tuple(sorted(models_of(found), key=lambda model: -len(model.images)))
