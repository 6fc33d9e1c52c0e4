"""Draws of a scene's images, and the facts of their candidates, for :mod:`benchmarks.candidates`."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time
from typing import Any, TypeAlias

import numpy as np
import pycolmap

from mkpc_kaggle.data.competition import TrainScene, TruePair
from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.dataframes import pair_tables
from mkpc_kaggle.engine.store.published import Published, read_images
from mkpc_kaggle.evaluation.validate import error_of
from mkpc_kaggle.geometry.cameras import Camera, fundamental_of_cameras
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.metrics import pair_accuracy, pose_error
from mkpc_kaggle.geometry.robust import sampson_distances
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Recipe, SceneConfig, recipe_of
from mkpc_kaggle.scene import colmap
from mkpc_kaggle.scene.choose import evidence
from mkpc_kaggle.scene.densify import extra_pairs
from mkpc_kaggle.scene.keypoints import MergedGraph
from mkpc_kaggle.scene.models import RegisteredImage, models_of
from mkpc_kaggle.scene.sfm import Solution, reconstruct_batch
from mkpc_kaggle.scene.view_graph import MIN_MATCHES, BatchImage, BatchPair, ViewGraph, tracks_of

TRUE = "!"  # suffix of a candidate without wrong edges
ALL = "all"  # the candidate of today: tracks from all units
SCALES_PX = (0.5, 1.0, 2.0)  # of the robust evidence of matches
HELD_OUT = 5  # every fifth pair is kept out of the second mapping
LOST = 90.0  # degrees; of a pair that a candidate has no F for
RIGHT_PX = 2.0  # Sampson distance of a right match from the true F
MIN_RIGHT = 0.5  # share of the inliers of a right edge
# The same of matches before verification, of which many are wrong on right edges, too
RIGHT_MATCH_PX = 3.0
MIN_RIGHT_MATCHES = 0.3


@dataclass(frozen=True, eq=False)
class Stored:
    """A pair of a journal. ``true`` is ``None`` for an extra pair, which has no score and no F."""

    images: tuple[BatchImage, BatchImage]
    results: tuple[UnitResult, ...]
    F: Matrix3 | None = None
    true: TruePair | None = None

    @property
    def names(self) -> tuple[str, str]:
        return self.images[0].name, self.images[1].name

    def batch_pair(self, tracks: Matches) -> BatchPair:
        by_unit = tuple(result.matches for result in self.results)
        return BatchPair(*self.images, by_unit, self.F, tracks)


def read_journals(
    directories: Iterable[Path], scenes: Mapping[str, TrainScene]
) -> dict[str, tuple[Recipe, list[Stored]]]:
    """Return the recipe and the pairs of each scene, the scored pairs first."""
    found: dict[str, tuple[Recipe, list[Stored]]] = {}
    for directory in directories:
        with Store.read(directory) as store:
            published = Published.of(store)
            settings = dict(published.run.about.recipe)
            recipe = recipe_of(settings, settings.pop("name"))
            units = {unit.name: unit for unit in recipe.units}
            tables = pair_tables(store, published)
            for row in published.pairs:
                points = published.points_of(store, row)
                images = read_images(store, row)
                if row.batch not in scenes or not points:
                    continue
                # As in the engine: file names, without folders
                first, second = (
                    BatchImage(Path(image.name).name, image.digest, image.size, image.focal)
                    for image in images
                )
                results = tuple(UnitResult(units[name], of) for name, of in points.items())
                true = true_pair(scenes[row.batch], first.name, second.name)
                own = None
                if true is None:
                    # The engine matches an extra pair by the first unit alone, without an F.
                    results = results[:1]
                elif row.number < published.run.rows and not tables.pairs["failure"][row.number]:
                    own = tables.estimates["F"][row.number]
                pairs = found.setdefault(row.batch, (recipe, []))[1]
                pairs.append(Stored((first, second), results, own, true))
    return found


def true_pair(scene: TrainScene, first: str, second: str) -> TruePair | None:
    """Return the pair of two images in this order, if the scene scores it."""
    return next((true for true in scene.pairs if true.pair.names == (first, second)), None)


def drawn(pairs: Sequence[Stored], images: int, seed: int) -> list[Stored]:
    """Return the pairs of random images, or of all if ``images`` is 0, as a user's batch has them:
    the scored pairs, and the extra pairs that the engine would add.
    """
    names = sorted({name for pair in pairs for name in pair.names})
    order = np.random.default_rng(seed).permutation(names)
    chosen = set(order[: images or None].tolist())
    inside = [pair for pair in pairs if chosen >= set(pair.names)]
    scored = [pair for pair in inside if pair.true is not None]
    number: dict[str, int] = {}
    ends = []
    for pair in scored:
        first, second = (number.setdefault(name, len(number)) for name in pair.names)
        ends.append((first, second))
    wanted = extra_pairs(len(number), ends, SceneConfig().pairs_per_image)
    listed = list(number)
    more = {frozenset((listed[i], listed[j])) for i, j in wanted}
    extra = [pair for pair in inside if pair.true is None and frozenset(pair.names) in more]
    return scored + extra


def settings_of(candidate: str) -> tuple[str, float]:
    """Return a candidate's unit, or ALL, and the minimum support of its edges."""
    unit, _, share = candidate.partition("+")
    return unit, float(share or 0)


def batch_of(draw: "Draw", pairs: Sequence[Stored], candidate: str) -> list[BatchPair]:
    """Return the pairs of a candidate, without tracks on wrong edges if its name ends with TRUE."""
    batch = []
    for pair in pairs:
        tracks = tracks_from(pair, candidate.removesuffix(TRUE))
        if candidate.endswith(TRUE):
            F = draw.true_fundamental(pair.names)
            if share_right(F, tracks, RIGHT_MATCH_PX) < MIN_RIGHT_MATCHES:
                tracks = Matches.empty()
        batch.append(pair.batch_pair(tracks))
    return batch


def share_right(F: Matrix3, matches: Matches, pixels: float = RIGHT_PX) -> float:
    """Return the share of matches that agree with the true F."""
    if not len(matches):
        return 0.0
    return float(np.mean(sampson_distances(F, matches) < pixels))


@dataclass(frozen=True, eq=False)
class VerifiedEdge:
    """Two images, the matches that verify them, and the true F."""

    images: tuple[BatchImage, BatchImage]
    inliers: Matches
    F: Matrix3

    @property
    def share_right(self) -> float:
        return share_right(self.F, self.inliers)

    @property
    def is_wrong(self) -> bool:
        return self.share_right < MIN_RIGHT

    @property
    def distance(self) -> float:
        """The median distance of the inliers from the true F, in pixels."""
        return float(np.median(sampson_distances(self.F, self.inliers)))


def verified_edges(draw: "Draw", candidate: str) -> Iterator[VerifiedEdge]:
    """Yield the edges of a candidate's view graph that COLMAP verifies."""
    merged = MergedGraph(ViewGraph.of_pairs(batch_of(draw, draw.pairs, candidate)))
    config = draw.recipe.scene or SceneConfig()
    with pycolmap.Database.open(":memory:") as database:
        cameras = colmap._write_images(database, merged, {}, config.camera_model)
        geometries = colmap.verify(merged, cameras)
    for edge, geometry in zip(merged.graph.edges, geometries, strict=True):
        indices = geometry.inlier_matches
        if len(indices) < MIN_MATCHES:
            continue
        images = (merged.graph.images[edge.first], merged.graph.images[edge.second])
        points0 = merged.keypoints[edge.first][indices[:, 0]]
        points1 = merged.keypoints[edge.second][indices[:, 1]]
        inliers = Matches(points0, points1, np.ones(len(indices)))
        F = draw.true_fundamental((images[0].name, images[1].name))
        yield VerifiedEdge(images, inliers, F)


def tracks_from(pair: Stored, candidate: str) -> Matches:
    """Return the matches that a candidate maps from."""
    unit, _ = settings_of(candidate)
    if unit == ALL:
        return tracks_of(pair.results)
    return Matches.concatenate(each.matches for each in pair.results if each.unit.name == unit)


def mapped(draw: "Draw", pairs: Sequence[Stored], candidate: str) -> tuple[Solution, float]:
    """Return a candidate's cameras and choices, and its CPU seconds."""
    batch = batch_of(draw, pairs, candidate)
    recipe = draw.recipe
    start = process_time()
    share = settings_of(candidate.removesuffix(TRUE))[1]
    config = replace(recipe.scene or SceneConfig(), min_support=share)
    solution = reconstruct_batch(batch, config, recipe.focal, recipe.magsac)
    return solution, process_time() - start


CamerasOfModel: TypeAlias = Mapping[str, RegisteredImage]


def cameras_by_digest(solution: Solution) -> list[CamerasOfModel]:
    models = models_of(solution.reconstructions)
    return [{image.image.digest: image for image in model.images} for model in models]


def ends_of(models: Sequence[CamerasOfModel], pair: Stored) -> list[RegisteredImage]:
    """Return both images of a pair in the first model that has both, or nothing."""
    digests = [image.digest for image in pair.images]
    for model in models:
        if model.keys() >= set(digests):
            return [model[digest] for digest in digests]
    return []


def scene_fundamental(models: Sequence[CamerasOfModel], pair: Stored) -> Matrix3 | None:
    """Return F from a pair's cameras, even if the pair contradicts it."""
    ends = ends_of(models, pair)
    if not ends:
        return None
    try:
        return fundamental_of_cameras(ends[0].camera, ends[1].camera)
    except ValueError:
        return None


def evidence_by_unit(F: Matrix3 | None, pair: Stored) -> dict[str, list[float]]:
    """Return the evidence of each unit's matches for F, at each scale."""
    return {
        result.unit.name: [0.0 if F is None else evidence(F, result.matches, s) for s in SCALES_PX]
        for result in pair.results
    }


def apart(F: Matrix3 | None, ends: Sequence[RegisteredImage]) -> list[float]:
    """Return the angles in degrees between F's pose and the pose of two cameras: of rotation and of
    the direction of translation.
    """
    if F is None or not ends:
        return [LOST, LOST]
    error = pose_error(F, ends[0].camera, ends[1].camera, 1.0)
    return [error.rotation, error.translation_angle]


@dataclass(frozen=True, eq=False)
class Draw:
    """A task of the pool: a draw of a scene, with its pairs."""

    scene: TrainScene
    images: int
    seed: int
    recipe: Recipe
    pairs: tuple[Stored, ...]
    candidates: tuple[str, ...]
    cameras: Mapping[str, Camera]  # true ones, by image name
    is_held_out: bool = False

    def true_fundamental(self, names: tuple[str, str]) -> Matrix3:
        return fundamental_of_cameras(*(self.cameras[name] for name in names))

    @property
    def key(self) -> tuple[str, int, int]:
        return self.scene.name, self.images, self.seed


def facts_of(draw: Draw) -> dict[str, Any]:
    """Map all candidates of a draw. Return JSON values for judges and scores."""
    scored = [pair for pair in draw.pairs if pair.true is not None]
    # Every fifth of the scored pairs in a random order, the same for all candidates
    order = np.random.default_rng(draw.seed).permutation(len(scored)).tolist()
    out = set(order[::HELD_OUT] if draw.is_held_out else [])
    kept = [pair for number, pair in enumerate(scored) if number not in out]
    kept += [pair for pair in draw.pairs if pair.true is None]
    candidates: dict[str, Any] = {}
    models: dict[str, list[CamerasOfModel]] = {}
    matrices: dict[str, list[Matrix3 | None]] = {}
    for name in draw.candidates:
        solution, seconds = mapped(draw, draw.pairs, name)
        models[name] = cameras_by_digest(solution)
        matrices[name] = [scene_fundamental(models[name], pair) for pair in scored]
        accuracies = []
        reasons = []
        for pair, choice in zip(scored, solution.choices, strict=False):  # without extra pairs
            F = pair.F if choice.F is None else choice.F
            accuracies.append(accuracy(F, pair, draw.scene))
            reasons.append(choice.reason.name)
        rest: list[CamerasOfModel] = []
        if out:
            rest = cameras_by_digest(mapped(draw, kept, name)[0])
        candidates[name] = {
            "seconds": seconds,
            "edges": [
                (len(edge.inliers), edge.share_right, edge.distance)
                for edge in verified_edges(draw, name)
            ],
            "accuracies": accuracies,
            "reasons": reasons,
            "models": [len(model) for model in models[name]],
            "points": [image.points for model in models[name] for image in model.values()],
            "sigmas": [
                list(image.sigmas) or None for model in models[name] for image in model.values()
            ],
            "reprojection": [
                model.reprojection_error for model in models_of(solution.reconstructions)
            ],
            "by_scene": [
                accuracy(F, pair, draw.scene)
                for F, pair in zip(matrices[name], scored, strict=True)
            ],
            "evidence": [
                evidence_by_unit(F, pair) for F, pair in zip(matrices[name], scored, strict=True)
            ],
            "held_out": {
                str(number): evidence_by_unit(
                    scene_fundamental(rest, scored[number]), scored[number]
                )
                for number in sorted(out)
            },
            "own_apart": [apart(pair.F, ends_of(models[name], pair)) for pair in scored],
            "pair_sigmas": [
                [list(end.sigmas) or None for end in ends_of(models[name], pair)] for pair in scored
            ],
        }
    for name, candidate in candidates.items():
        candidate["apart"] = {
            other: [
                apart(F, ends_of(models[name], pair)) if ends_of(models[name], pair) else None
                for F, pair in zip(matrices[other], scored, strict=True)
            ]
            for other in candidates
            if other != name
        }
    return {
        "scene": draw.scene.name,
        "images": draw.images,
        "seed": draw.seed,
        "present": len({image.digest for pair in draw.pairs for image in pair.images}),
        "pairs": [list(pair.names) for pair in scored],
        "own": [accuracy(pair.F, pair, draw.scene) for pair in scored],
        "own_evidence": [evidence_by_unit(pair.F, pair) for pair in scored],
        "candidates": candidates,
    }


def accuracy(F: Matrix3 | None, pair: Stored, scene: TrainScene) -> float:
    assert pair.true is not None
    return pair_accuracy(error_of(F, pair.true, scene))
