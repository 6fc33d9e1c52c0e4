"""The paper's tables, row by row, next to their published figures, with one command.

LIST is a list of pairs in the format of SuperGlue's evaluation (docs/benchmarks.md). IMAGES is the
root directory of its names. TRAIN_DIR is any train side of the Image Matching Challenge 2022. The
rows are in `paper_tables.toml`. The rows of a table share a work directory, so that common units
run once; the last column counts the units that a row ran. After a kill, a rerun resumes. `--pairs
N` takes a sample of each list or scene, and `--matcher` replaces all matchers. Usage:

python -m benchmarks.paper_tables --out DIR --weights DIR [--yfcc LIST IMAGES] [--scannet LIST IMAGES]
    [--imc TRAIN_DIR] [--rows "1200,1600 + 1400" ...] [--pairs N] [--matcher NAME]
"""

import argparse
import time
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import nan
from pathlib import Path
from statistics import mean
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.lists import read_pairs
from mkpc_kaggle.data.competition import TrainScene, TruePair, read_train_side
from mkpc_kaggle.data.images import read_size
from mkpc_kaggle.engine.budget import Budget
from mkpc_kaggle.engine.frames import Results, results
from mkpc_kaggle.engine.session import Session, run_pairs
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.evaluation.validate import validate
from mkpc_kaggle.geometry.cameras import Camera, relative_pose
from mkpc_kaggle.geometry.coordinates import Box, Matrix3, View
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.metrics import (
    AUC_THRESHOLDS,
    PoseError,
    pose_auc,
    rotation_angle,
)
from mkpc_kaggle.geometry.robust import calibrate, homogeneous
from mkpc_kaggle.geometry.two_view import cross_matrix
from mkpc_kaggle.recipe import Recipe, Unit, load_recipe
from mkpc_kaggle.setup.assembly import assemble
from mkpc_kaggle.signals import interruptible

# A correct match's maximum sum of both squared epipolar distances, on the planes z = 1.
CORRECT = 5e-4
FEWEST = 5  # matches that OpenCV needs for an E
FARTHEST = 1e9  # of points in front of both cameras
TABLES = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def correct_matches(matches: Matches, camera0: Camera, camera1: Camera) -> NDArray[np.bool_]:
    """Return an (N,) mask of the matches that fit the true cameras within :data:`CORRECT`."""
    R, t = relative_pose(camera0, camera1)
    E = cross_matrix(t) @ R
    x0 = homogeneous(calibrate(matches.points0, camera0.K))
    x1 = homogeneous(calibrate(matches.points1, camera1.K))
    lines0 = x1 @ E  # epipolar lines (N, 3) in image 0
    lines1 = x0 @ E.T
    # The squared distance of a point to its line is (x1^T E x0)^2 over the squared norm of the
    # line's normal, in each image.
    squared_normal0 = (lines0[:, :2] ** 2).sum(axis=1)
    squared_normal1 = (lines1[:, :2] ** 2).sum(axis=1)
    # With equal camera centres, no match is correct.
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / squared_normal0 + 1 / squared_normal1
        distances = (x1 * lines1).sum(axis=1) ** 2 * inverse
        return np.asarray(distances < CORRECT)


@dataclass(frozen=True)
class ListScore:
    """The score of a pair of a list by SuperGlue's evaluation.

    Correct matches over all matches (precision), and over keypoints of image 0 (matching score), which is
    NaN for matchers without keypoints.
    """

    error: PoseError
    precision: float
    matching_score: float


def recipe_of(table: str, row: str, given: argparse.Namespace) -> Recipe:
    """Return a row's recipe, with the matcher of the command, if given."""
    known_as = "imc2022" if table == "imc" else str(Path(__file__).with_name(f"{table}.toml"))
    whole = load_recipe(known_as)
    units: list[Unit] = []
    if table == "imc":
        # A row names one matcher of the ensemble, on whole images, or the whole ensemble.
        own = next((unit for unit in whole.units if unit.matcher == row), None)
        units += [replace(own, stage=1)] if own else whole.units
    else:
        # "1200,1600 + 1400": long sides of stage 1, then of stage 2.
        for stage, sides in enumerate(row.split(" + "), start=1):
            units += [sized(whole.units[0], stage, side) for side in sides.split(",")]
        # SuperGlue's script resizes by OpenCV's bilinear filter, without antialiasing.
        units = [replace(unit, antialias=False) for unit in units]
    # With one matcher for all, units may become equal; each runs once.
    known = {}
    for unit in units:
        changed = replace(unit, matcher=given.matcher or unit.matcher)
        known[changed.name] = changed
    options = {} if given.matcher else whole.matchers
    return replace(whole, units=tuple(known.values()), matchers=options)


def sized(unit: Unit, stage: int, side: str) -> Unit:
    """Return the unit with another long side, or stretched to a width x height."""
    width, _, height = side.partition("x")
    area = f"{height}x{width}" if height else ""
    long_side = 0 if area else int(side)
    return replace(unit, stage=stage, long_side=long_side, area=area, stretch=bool(area))


def largest_side(recipe: Recipe) -> int:
    """Return the largest long side of stage 1: the threshold counts its pixels."""
    sides = [unit for unit in recipe.units if unit.stage == 1]
    return max(unit.long_side or max(map(int, unit.area.split("x"))) for unit in sides)


def scores_of_list(
    found: Results, scene: TrainScene, method: str, side: int
) -> list[ListScore]:
    """Score the matches of a run by SuperGlue's evaluation, with an estimator."""
    names = [true.pair.id for true in scene.pairs]
    units = dict(list(found.units.groupby("pair")))
    scores = []
    for true, match in zip(scene.pairs, found.matches(*names), strict=True):
        matches = match.matches
        error = PoseError.failed()
        pose = pose_of(matches, true, method, side)
        if pose is not None:
            R, t = pose
            true_R, true_t = relative_pose(true.camera0, true.camera1)
            cosine = float(abs(t @ true_t) / np.linalg.norm(true_t))  # the sign is ignored
            angle = float(np.degrees(np.arccos(min(1.0, cosine))))
            error = PoseError(rotation_angle(R @ true_R.T), angle, nan)
        # All matches, not only inliers
        correct = int(correct_matches(matches, true.camera0, true.camera1).sum())
        ran = units.get(true.pair.id)
        keypoints = 0 if ran is None else int(ran["keypoints"].sum())
        # Dense matchers have matches and no keypoints.
        is_known = ran is None or ((ran["keypoints"] > 0) | (ran["matches"] == 0)).all()
        precision = correct / max(len(matches), 1)
        scores.append(
            ListScore(error, precision, correct / max(keypoints, 1) if is_known else nan)
        )
    return scores


def pose_of(
    matches: Matches, true: TruePair, method: str, side: int
) -> tuple[Matrix3, NDArray[np.float64]] | None:
    """Return R and t of E, by OpenCV's ``method`` at a pixel of pictures with this long side.

    ``None`` without an E, or with an image that cannot be read.
    """
    Ks = (true.camera0.K, true.camera1.K)
    sizes = [read_size(path) for path in true.pair.images]
    if len(matches) < FEWEST or None in sizes:
        return None
    rays = [calibrate(matches.points0, Ks[0]), calibrate(matches.points1, Ks[1])]
    focals = np.array([K.diagonal()[:2] for K in Ks])
    views = [View.fit(Box.whole(size), long_side=side) for size in sizes if size is not None]
    scaled = focals * [view.scale for view in views]
    # MAGSAC integrates its score up to a fixed number of pixels, so it needs points in pixels.
    is_magsac = method == "magsac"
    focal = float(focals.mean()) if is_magsac else 1.0
    found: Any = cv2.findEssentialMat(
        focal * rays[0],
        focal * rays[1],
        np.diag([focal, focal, 1.0]),
        method=cv2.USAC_MAGSAC if is_magsac else cv2.RANSAC,
        prob=0.99999,
        threshold=focal / float(scaled.mean()),
        maxIters=1000,
    )
    stacked, mask = found
    if stacked is None:
        return None
    # Five points have up to ten solutions: the one with most inliers in front of both cameras.
    best: tuple[int, Any, Any] = (0, None, None)
    for E in np.split(stacked, len(stacked) // 3):
        # OpenCV changes the mask.
        count, R, t, *_ = cv2.recoverPose(
            E, rays[0], rays[1], np.eye(3), FARTHEST, mask=mask.copy()
        )
        if count > best[0]:
            best = (count, R, t.ravel())
    return None if best[1] is None else best[1:]


def table(name: str, given: argparse.Namespace) -> Iterator[str]:
    """Yield the lines of the table in Markdown, each row after its run."""
    scenes = scenes_of(name, given)
    is_imc = name == "imc"
    if is_imc:
        ours = ["mAA"]
        # Of the leaderboard; one score of ours is compared to both
        theirs = ["public", "private"]
    else:
        theirs = [f"AUC {limit:g}" for limit in AUC_THRESHOLDS]
        ours = [*theirs, "precision", "matching score"]
    heads = [*ours, *(f"published {head}" for head in theirs), "units run"]
    count = sum(len(scene.pairs) for scene in scenes)
    yield row_of([f"{name}: {count} pairs", "estimator", *heads])
    yield "| --- " * (2 + len(heads)) + "|"
    differences = []
    for row, method, *published in TABLES[name]:
        if row not in (given.rows or [row]):
            continue
        recipe = replace(recipe_of(name, row, given), name=f"{row} {method}")
        report, compared, cells = run(name, recipe, method, scenes, given)
        both = zip(compared, published, strict=True)
        differences.append([own - other for own, other in both])
        figures = [str(figure) for figure in published]
        yield row_of([row, method, *cells, *figures, str(report.about.units_run)])
    means = [f"{mean(column):+.4f}" for column in zip(*differences, strict=True)]
    # Below the published figures.
    empty = [""] * (len(heads) - len(means))
    yield row_of(["mean difference", *empty, *means, ""])


def row_of(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def scenes_of(name: str, given: argparse.Namespace) -> tuple[TrainScene, ...]:
    """Return the pairs of a table, from a train side or a list."""
    if name == "imc":
        return read_train_side(*given.imc, pairs_per_scene=given.pairs)
    return (read_pairs(*vars(given)[name], most=given.pairs),)


def run(
    name: str,
    recipe: Recipe,
    method: str,
    scenes: tuple[TrainScene, ...],
    given: argparse.Namespace,
) -> tuple[Results, list[float], list[str]]:
    """Run a row's recipe. Return its report, the compared figures, and all figures as text.

    Raise ``KeyboardInterrupt`` if it was interrupted: the engine ends an interrupted run in order, with
    results of a part of the pairs.
    """
    assembly = assemble(recipe, weights=given.weights)
    root = str(vars(given)[name][-1])
    with interruptible() as interrupt:
        session = Session(given.out / name, Budget(time.monotonic()), interrupt, workers=None)
        if name == "imc":
            scores = validate(scenes, assembly, session, root)
            report = scores.report
            assert report is not None
        else:
            (scene,) = scenes
            report = run_pairs([true.pair for true in scene.pairs], assembly, session, root)
    if interrupt.is_set():
        raise KeyboardInterrupt
    if name == "imc":
        return report, [scores.maa()] * 2, [f"{scores.maa():.4f}"]
    found = scores_of_list(results(session.work_dir), scene, method, largest_side(recipe))
    errors = [score.error for score in found]
    # In percent, as published.
    compared = [100 * pose_auc(errors, limit) for limit in AUC_THRESHOLDS]
    precision = 100 * mean(score.precision for score in found)
    matching = 100 * mean(score.matching_score for score in found)
    return report, compared, [f"{cell:.2f}" for cell in (*compared, precision, matching)]


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--weights", type=Path, action="append", default=[])
    parser.add_argument("--yfcc", type=Path, nargs=2, metavar=("LIST", "IMAGES"))
    parser.add_argument("--scannet", type=Path, nargs=2, metavar=("LIST", "IMAGES"))
    parser.add_argument("--imc", type=Path, nargs=1, metavar="TRAIN_DIR")
    rows = sorted({row for rows in TABLES.values() for row, *_ in rows})
    parser.add_argument("--rows", nargs="+", choices=rows, help="default: all")
    parser.add_argument(
        "--pairs", type=int, help="of each list or scene, evenly spread; default: all"
    )
    parser.add_argument("--matcher")
    given = parser.parse_args(arguments)
    # Line by line: a table takes hours, and its rows are worth reading before the last one.
    try:
        for name in TABLES:
            # A table without its data is left out.
            if vars(given)[name]:
                for line in table(name, given):
                    print(line, flush=True)
    except UserError as error:
        parser.exit(2, f"{error}\n")


if __name__ == "__main__":
    main()
