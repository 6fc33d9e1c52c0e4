"""Whether a scene's best candidate can be chosen without truth: judges compared by draws of images.

python -m benchmarks.candidates --train-dir DIR [DIR ...] --journals DIR [DIR ...] --facts FILE
    [--scenes NAME ...] [--confirm NAME ...] [--images 8 10 12] [--seeds 4] [--supports 0.1]
    [--true-edges] [--held-out] [--processes N]

Journals, the work directories of `validate --min-covisibility 0` (or with scenes, which match extra
pairs), provide the matches and each pair's own F. A candidate is a reconstruction whose tracks come
from all units (today's rule) or from a single one. With ``--supports`` further candidates have tracks
from all units, without edges of less support (``min_support`` of [scene]). With ``--true-edges`` one has
no wrong edges, by truth. All candidates have the same pairs, and the same matches and own F of a pair.

Each draw of images is mapped once, and its facts become a line of ``--facts``: accuracies by truth, and
everything that a judge may use. A further run maps only the draws that the file lacks. The tables
compare each judge with today's rule, with each single candidate and with the oracle, which chooses
by truth. ``--confirm`` names scenes that were not used to choose the judge; they get tables of their
own. ``chosen`` is the share of draws in which a judge takes the better of the candidates, among draws
in which they differ by more than ``TIE``. A last table counts verified edges that are wrong by truth.
``--held-out`` maps a second time without every fifth pair, for judges by these pairs.
"""

import argparse
import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from statistics import fmean, median
from time import process_time
from typing import Any, TypeAlias

import numpy as np
import pycolmap

from mkpc_kaggle.data.competition import TrainScene, TruePair, read_train_side
from mkpc_kaggle.engine.store.database import Store
from mkpc_kaggle.engine.store.dataframes import pair_tables
from mkpc_kaggle.engine.store.published import Published, read_images
from mkpc_kaggle.evaluation.compare import paired_difference
from mkpc_kaggle.evaluation.validate import error_of
from mkpc_kaggle.geometry.cameras import Camera, fundamental_of_cameras
from mkpc_kaggle.geometry.coordinates import Matrix3
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.metrics import pair_accuracy, pose_error
from mkpc_kaggle.geometry.robust import sampson_distances
from mkpc_kaggle.pipeline.pair import UnitResult
from mkpc_kaggle.recipe import Recipe, SceneConfig, recipe_of
from mkpc_kaggle.scene import colmap
from mkpc_kaggle.scene.densify import extra_pairs
from mkpc_kaggle.scene.keypoints import MergedGraph
from mkpc_kaggle.scene.models import LOOSE_SIGMA, RegisteredImage
from mkpc_kaggle.scene.sfm import Solution, models_of, reconstruct_batch
from mkpc_kaggle.scene.view_graph import MIN_MATCHES, BatchImage, BatchPair, ViewGraph, tracks_of

TRUE = "!"  # suffix of a candidate without wrong edges
ALL = "all"  # the candidate of today: tracks from all units
SCALES_PX = (0.5, 1.0, 2.0)  # of the robust evidence of matches
HELD_OUT = 5  # every fifth pair is kept out of the second mapping
TIE = 0.005  # of mAA
SIGMAS = (0.01, 0.03, 0.1, LOOSE_SIGMA, 1.0, np.inf)  # upper bounds of classes, in model sizes
MARGINS = (
    0.01,
    0.02,
    0.03,
    0.05,
)  # of the product's judge: today's rule wins unless another is nearer
LOST = 90.0  # degrees; of a pair that a candidate has no F for
MAX_ANGLE = 10.0  # degrees; larger disagreements count as this
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


# Candidates


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


def edges_of(draw: "Draw", candidate: str) -> list[tuple[int, float, float]]:
    """Return each verified edge: inliers, their share that is right, and their median distance in
    pixels from the true F.
    """
    merged = MergedGraph(ViewGraph.of_pairs(batch_of(draw, draw.pairs, candidate)))
    config = draw.recipe.scene or SceneConfig()
    with pycolmap.Database.open(":memory:") as database:
        cameras = colmap._write_images(database, merged, {}, config.camera_model)
        geometries = colmap.verify(merged, cameras)
    found = []
    for edge, geometry in zip(merged.graph.edges, geometries, strict=True):
        indices = geometry.inlier_matches
        if len(indices) < MIN_MATCHES:
            continue
        names = (merged.graph.images[edge.first].name, merged.graph.images[edge.second].name)
        points0 = merged.keypoints[edge.first][indices[:, 0]]
        points1 = merged.keypoints[edge.second][indices[:, 1]]
        inliers = Matches(points0, points1, np.ones(len(indices)))
        F = draw.true_fundamental(names)
        distance = float(np.median(sampson_distances(F, inliers)))
        found.append((len(indices), share_right(F, inliers), distance))
    return found


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


def evidence(F: Matrix3 | None, pair: Stored) -> dict[str, list[float]]:
    """Return the robust number of each unit's matches that agree with F, at each scale.

    It is the sum of 1 / (1 + (r / scale)^2), with Sampson distances r.
    """
    found = {}
    for result in pair.results:
        sums = [0.0] * len(SCALES_PX)
        if F is not None and len(result.matches):
            distances = sampson_distances(F, result.matches)
            sums = [float(np.sum(1 / (1 + (distances / scale) ** 2))) for scale in SCALES_PX]
        found[result.unit.name] = sums
    return found


def apart(F: Matrix3 | None, ends: Sequence[RegisteredImage]) -> list[float]:
    """Return the angles in degrees between F's pose and the pose of two cameras: of rotation and of
    the direction of translation.
    """
    if F is None or not ends:
        return [LOST, LOST]
    error = pose_error(F, ends[0].camera, ends[1].camera, 1.0)
    return [error.rotation, error.translation_angle]


# Facts of a draw


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
            "edges": edges_of(draw, name),
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
            "evidence": [evidence(F, pair) for F, pair in zip(matrices[name], scored, strict=True)],
            "held_out": {
                str(number): evidence(scene_fundamental(rest, scored[number]), scored[number])
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
        "own_evidence": [evidence(pair.F, pair) for pair in scored],
        "candidates": candidates,
    }


def accuracy(F: Matrix3 | None, pair: Stored, scene: TrainScene) -> float:
    assert pair.true is not None
    return pair_accuracy(error_of(F, pair.true, scene))


# Judges: a value for each candidate of a draw; the highest wins, and today's rule wins ties

Facts: TypeAlias = Mapping[str, Any]
Judge: TypeAlias = Callable[[Facts], Mapping[str, float]]


def by_share(facts: Facts, name: str, scale: int, pairs: Iterable[int], key: str) -> float:
    """Return the mean over pairs of the share of own F's evidence that a candidate has, each unit
    counted equally.
    """
    shares = []
    for number in pairs:
        own = facts["own_evidence"][number]
        # Keys of JSON objects are texts.
        table = facts["candidates"][name][key]
        scene = table[str(number)] if key == "held_out" else table[number]
        by_unit = []
        for unit, values in own.items():
            if values[scale] >= 5:  # fewer agree by chance
                by_unit.append(min(1.5, scene[unit][scale] / values[scale]))
        if by_unit:
            shares.append(fmean(by_unit))
    return fmean(shares) if shares else 0.0


def evidence_judge(scale: int, key: str) -> Judge:
    def judge(facts: Facts) -> dict[str, float]:
        candidates = facts["candidates"]
        numbers: list[int] = list(range(len(facts["pairs"])))
        if key == "held_out":
            numbers = [int(number) for number in candidates[ALL]["held_out"]]
        return {name: by_share(facts, name, scale, numbers, key) for name in candidates}

    return judge


def matches_judge(scale: int) -> Judge:
    """Judge by the sum of the evidence of all matches of all units."""

    def judge(facts: Facts) -> dict[str, float]:
        return {
            name: sum(values[scale] for pair in candidate["evidence"] for values in pair.values())
            for name, candidate in facts["candidates"].items()
        }

    return judge


def camera_sigmas(facts: Facts, name: str, which: int) -> list[float]:
    """Return one sigma of each image: infinite without a camera."""
    candidate = facts["candidates"][name]
    known = [each[which] if each else np.inf for each in candidate["sigmas"]]
    return known + [np.inf] * max(0, facts["present"] - len(known))


def sigma_judge(which: int) -> Judge:
    def judge(facts: Facts) -> dict[str, float]:
        return {name: -median(camera_sigmas(facts, name, which)) for name in facts["candidates"]}

    return judge


def capped(angles: Sequence[float]) -> float:
    return min(MAX_ANGLE, max(angles))


def own_judge(which: int | None) -> Judge:
    """Judge by the agreement of poses with those of the pairs' own F."""

    def judge(facts: Facts) -> dict[str, float]:
        values = {}
        for name, candidate in facts["candidates"].items():
            angles = [
                capped(both) if which is None else min(MAX_ANGLE, both[which])
                for both in candidate["own_apart"]
            ]
            values[name] = -fmean(angles)
        return values

    return judge


def agreement_judge(facts: Facts) -> dict[str, float]:
    """Judge by the agreement with the other candidates: the medoid."""
    values = {}
    for name, candidate in facts["candidates"].items():
        angles = []
        for pairs in candidate["apart"].values():
            angles += [MAX_ANGLE if both is None else capped(both) for both in pairs]
        values[name] = -fmean(angles)
    return values


def observations_judge(facts: Facts) -> dict[str, float]:
    return {name: float(sum(each["points"])) for name, each in facts["candidates"].items()}


def images_judge(facts: Facts) -> dict[str, float]:
    return {
        name: float(max(each["models"], default=0)) for name, each in facts["candidates"].items()
    }


JUDGES: dict[str, Judge] = {
    "most images": images_judge,
    "most observations": observations_judge,
    **{f"all matches, {scale:g} px": matches_judge(n) for n, scale in enumerate(SCALES_PX)},
    **{
        f"share of own F's, {scale:g} px": evidence_judge(n, "evidence")
        for n, scale in enumerate(SCALES_PX)
    },
    **{
        f"the same, pairs held out, {scale:g} px": evidence_judge(n, "held_out")
        for n, scale in enumerate(SCALES_PX)
    },
    "sigma of rotations": sigma_judge(0),
    "sigma of centres": sigma_judge(1),
    "sigma of focal lengths": sigma_judge(2),
    "rotations of own F": own_judge(0),
    "poses of own F": own_judge(None),
    "agreement of candidates": agreement_judge,
}


def choice_of(values: Mapping[str, float]) -> str:
    """Return the candidate with the highest value; of equal ones the first, today's."""
    return max(values, key=lambda name: values[name])


def by_rotations(facts: Facts, margin: float) -> str:
    """Return the choice of the product's judge (:mod:`mkpc_kaggle.scene.candidates`)."""
    angles = {name: -value for name, value in own_judge(0)(facts).items()}
    best = min(angles, key=lambda name: angles[name])
    return best if angles[best] < (1 - margin) * angles[ALL] else ALL


# Tables


def maa(facts: Facts, name: str) -> float:
    return fmean(facts["candidates"][name]["accuracies"])


def oracle(facts: Facts) -> dict[str, float]:
    return {name: maa(facts, name) for name in facts["candidates"]}


def table(title: str, draws: Sequence[Facts]) -> list[str]:
    """Return a Markdown table: each rule's mAA by scene, its gain over today's rule, and how often
    it chooses the better candidate.
    """
    scenes = list(dict.fromkeys(facts["scene"] for facts in draws))
    counts = [f"{name} ({sum(each['scene'] == name for each in draws)})" for name in scenes]
    heads = [title, *counts, "mean", "gain over today's rule", "chosen", "of the oracle's"]
    lines = [f"| {' | '.join(heads)} |", "|" + " --- |" * len(heads)]
    units = [name for name in draws[0]["candidates"] if name != ALL]
    rules: dict[str, Callable[[Facts], str]] = {"today's rule: all units": lambda _: ALL}
    for unit in units:
        rules[f"always {unit}"] = lambda _, unit=unit: unit  # type: ignore[misc]
    for name, judge in JUDGES.items():
        rules[name] = lambda facts, judge=judge: choice_of(judge(facts))  # type: ignore[misc]
    for margin in MARGINS:
        rules[f"rotations of own F, {margin:.0%} nearer"] = partial(by_rotations, margin=margin)
    rules["the oracle"] = lambda facts: choice_of(oracle(facts))
    most = gain_over_today(draws, rules["the oracle"])[0]
    for name, rule in rules.items():
        means = []
        for scene in scenes:
            means.append(fmean(maa(each, rule(each)) for each in draws if each["scene"] == scene))
        gain, text = gain_over_today(draws, rule)
        cells = [f"{value:.3f}" for value in (*means, fmean(means))]
        cells += [text, f"{share_chosen(draws, rule):.2f}", f"{gain / most:.2f}" if most else ""]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def edge_table(draws: Sequence[Facts]) -> list[str]:
    """Return a Markdown table of verified edges by scene and candidate."""
    heads = ["edges of", "verified", "wrong", "inliers", "on wrong edges", "px on right edges"]
    lines = [f"| {' | '.join(heads)} |", "|" + " --- |" * len(heads)]
    for scene in dict.fromkeys(facts["scene"] for facts in draws):
        found = [facts["candidates"] for facts in draws if facts["scene"] == scene]
        for name in found[0]:
            edges = [edge for candidates in found for edge in candidates[name].get("edges", ())]
            if not edges:
                continue
            wrong = [inliers for inliers, share, _ in edges if share < MIN_RIGHT]
            total = sum(inliers for inliers, _, _ in edges)
            pixels = median(distance for _, share, distance in edges if share >= MIN_RIGHT)
            counts = f"{len(edges)} | {len(wrong)} | {total} | {sum(wrong)} | {pixels:.2f}"
            lines.append(f"| {scene}, {name} | {counts} |")
    return lines


def sigma_table(draws: Sequence[Facts]) -> list[str]:
    """Return a Markdown table: what F of the cameras gains over F of the pair, by the larger sigma of
    the two centres, over the pairs of all candidates.
    """
    gains: dict[float, list[float]] = {upper: [] for upper in SIGMAS}
    loose: dict[str, list[float]] = defaultdict(list)
    for facts in draws:
        for name, candidate in facts["candidates"].items():
            pairs = zip(candidate["by_scene"], facts["own"], candidate["pair_sigmas"], strict=True)
            for scene, own, sigmas in pairs:
                if not sigmas:
                    continue
                sigma = max(each[1] if each else np.inf for each in sigmas)
                gains[next(upper for upper in SIGMAS if sigma <= upper)].append(scene - own)
                # A pair that keeps its own F gains nothing by it.
                if name == ALL:
                    loose[facts["scene"]].append(own - scene if sigma > LOOSE_SIGMA else 0.0)
    lines = ["| sigma up to | pairs | gain of the cameras' F |", "| --- | --- | --- |"]
    for upper, found in gains.items():
        if found:
            lines.append(f"| {upper:g} | {len(found)} | {fmean(found):+.3f} |")
    kept = ", ".join(f"{scene} {fmean(found):+.3f}" for scene, found in loose.items())
    return [
        *lines,
        "",
        f"today's rule, F of the pair above {LOOSE_SIGMA:g}, mean over pairs: {kept}",
    ]


def gain_over_today(draws: Sequence[Facts], rule: Callable[[Facts], str]) -> tuple[float, str]:
    """Return the gain of a rule in mAA, the mean over scenes, and a text with its interval.

    Draws and scenes are resampled.
    """
    first = []
    second = []
    ends = []
    for number, facts in enumerate(draws):
        first.append(maa(facts, ALL))
        second.append(maa(facts, rule(facts)))
        ends.append((facts["scene"], f"draw {number}"))
    difference = paired_difference([(first, second, ends)])
    return difference.gain, str(difference)


def share_chosen(draws: Sequence[Facts], rule: Callable[[Facts], str]) -> float:
    """Return in which share of the comparisons with a candidate the chosen one is the better."""
    right = []
    for facts in draws:
        chosen = rule(facts)
        for name in facts["candidates"]:
            gain = maa(facts, chosen) - maa(facts, name)
            if abs(gain) > TIE:
                right.append(gain > 0)
    return fmean(right) if right else np.nan


def read_facts(path: Path) -> list[dict[str, Any]]:
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def key_of(facts: Facts) -> tuple[str, int, int]:
    return facts["scene"], facts["images"], facts["seed"]


def draws_of(arguments: argparse.Namespace) -> Iterator[Draw]:
    """Yield the draws of all scenes that the journals have."""
    scenes: dict[str, TrainScene] = {}
    cameras: dict[str, dict[str, Camera]] = {}
    for directory in arguments.train_dir:
        for scene in read_train_side(directory, min_covisibility=0):
            of = cameras.setdefault(scene.name, {})
            for true in scene.pairs:
                of |= zip(true.pair.names, (true.camera0, true.camera1), strict=True)
        for scene in read_train_side(directory):
            if not arguments.scenes or scene.name in arguments.scenes:
                scenes[scene.name] = scene
    for name, (recipe, pairs) in read_journals(arguments.journals, scenes).items():
        units = [unit.name for unit in recipe.units if unit.tracks]
        supports = [f"{ALL}+{share:g}" for share in arguments.supports]
        true_edges = [ALL + TRUE] if arguments.true_edges else []
        number = len({image for pair in pairs for image in pair.names})
        for images in arguments.images:
            # All images of a scene make a single draw.
            seeds = arguments.seeds if 0 < images < number else 1
            for seed in range(seeds):
                yield Draw(
                    scenes[name],
                    images,
                    seed,
                    recipe,
                    tuple(drawn(pairs, images, seed)),
                    (ALL, *units, *supports, *true_edges),
                    cameras[name],
                    arguments.held_out,
                )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--train-dir", type=Path, nargs="+", required=True)
    parser.add_argument("--journals", type=Path, nargs="+", default=())
    parser.add_argument("--facts", type=Path, required=True)
    parser.add_argument("--scenes", nargs="*", default=())
    parser.add_argument("--confirm", nargs="*", default=())
    parser.add_argument("--images", nargs="+", type=int, default=[8, 10, 12])
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--supports", nargs="*", type=float, default=(0.1,))
    parser.add_argument("--true-edges", action="store_true")
    parser.add_argument("--held-out", action="store_true")
    parser.add_argument("--processes", type=int, default=1)
    arguments = parser.parse_args()
    done = {key_of(facts) for facts in read_facts(arguments.facts)}
    tasks = [draw for draw in draws_of(arguments) if draw.key not in done]
    # All scenes in turns, so that a run that is cut off has draws of all.
    tasks.sort(key=lambda draw: (draw.seed, draw.images))
    # A new process for each draw, since pycolmap's memory does not return.
    pool = ProcessPoolExecutor(arguments.processes, get_context("spawn"), max_tasks_per_child=1)
    with pool, arguments.facts.open("a", encoding="utf-8") as stream:
        for future in as_completed([pool.submit(facts_of, draw) for draw in tasks]):
            # Infinite errors are Python's JSON.
            stream.write(json.dumps(future.result()) + "\n")
            stream.flush()
    # In a fixed order, whatever process was first
    draws = sorted(read_facts(arguments.facts), key=key_of)
    draws = [each for each in draws if not arguments.scenes or each["scene"] in arguments.scenes]
    groups: dict[str, list[Facts]] = defaultdict(list)
    for facts in draws:
        groups["confirmed on" if facts["scene"] in arguments.confirm else "chosen on"].append(facts)
    if len(groups) > 1:
        groups["all"] = [*draws]
    for title, group in groups.items():
        print("\n".join(table(title, group)), "\n", flush=True)
    print("\n".join([*edge_table(draws), "", *sigma_table(draws)]), flush=True)


if __name__ == "__main__":
    main()
