"""Cameras of pinholes against SIMPLE_RADIAL, the lens of `reconstruct`.

python -m benchmarks.lenses --train-dir DIR --out DIR [--scenes NAME ...] [--lenses K ...]
    [--images 8] [--seeds 4] [--first 14]

The photographs of a scene, seen through a lens with the radial coefficient K, are matched once by
RootSIFT, as by ``mkpc reconstruct``. Each draw of images is then reconstructed twice from the same
matches.

The table has the accuracy of poses: mAA over the pairs with a covisibility of at least 0.1, from the
two cameras with the true intrinsics, 0 without cameras; the largest error of a centre after a
similarity, as a share of the model's size (median over draws); and CPU seconds.
"""

import argparse
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from time import process_time

import cv2
import numpy as np

from benchmarks.similarity import find_similarity, model_size
from mkpc_kaggle.data.competition import TrainScene, TruePair, read_train_side
from mkpc_kaggle.engine.frames import results
from mkpc_kaggle.engine.store import Store
from mkpc_kaggle.evaluation.validate import error_of
from mkpc_kaggle.geometry.cameras import Camera, fundamental_of_cameras
from mkpc_kaggle.geometry.coordinates import Matrix3, Pixels, Size
from mkpc_kaggle.geometry.metrics import pair_accuracy
from mkpc_kaggle.recipe import CameraModel, SceneConfig
from mkpc_kaggle.scene.models import RegisteredImage, SfmModel, models_of
from mkpc_kaggle.scene.sfm import reconstruct_batch
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair

RECIPE = 'units = [{ stage = 1, matcher = "sift", long_side = 1024 }]\n'
MIN_COVISIBILITY = 0.1
ITERATIONS = 60  # of the inversion of a lens


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--train-dir", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scenes", nargs="+", default=["fountain_p11"])
    parser.add_argument("--lenses", type=float, nargs="+", default=[0.0])
    parser.add_argument("--images", type=int, default=8)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--first", type=int, default=14, help="images of a scene that are matched")
    arguments = parser.parse_args()
    heads = "scene", "k", "draws", "mAA", "error %", "s"
    print("|", " | ".join(heads), "|", flush=True)
    print("|", " | ".join(["---"] * len(heads)), "|", flush=True)
    for name in arguments.scenes:
        for k in arguments.lenses:
            (scene,) = read_train_side(
                arguments.train_dir, scenes=[name], min_covisibility=MIN_COVISIBILITY
            )
            out = arguments.out / f"{name}_{k:g}"
            match(scene, k, arguments.first, out)
            pairs = read_pairs(out)
            draws = [
                draw_of(scene, pairs, arguments.images, seed) for seed in range(arguments.seeds)
            ]
            print(row_of(name, k, draws), flush=True)


def match(scene: TrainScene, k: float, first: int, out: Path) -> None:
    """Match the first photographs of a scene, seen through a lens. A second run matches nothing."""
    cameras: dict[Path, Camera] = {}
    for true in scene.pairs:
        cameras.update(zip(true.pair.images, (true.camera0, true.camera1), strict=True))
    photographs = out / "photographs"
    photographs.mkdir(parents=True, exist_ok=True)
    for path in sorted(cameras)[:first]:
        copy = photographs / f"{path.stem}.png"
        if not copy.exists():
            pixels = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
            assert pixels is not None, path
            cv2.imwrite(str(copy), through_lens(np.asarray(pixels), cameras[path].K, k))
    recipe = out / "recipe.toml"
    recipe.write_text(RECIPE)
    command = [sys.executable, "-m", "mkpc_kaggle", "reconstruct", str(photographs)]
    command += ["--out", str(out / "results"), "--recipe", str(recipe)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def through_lens(pixels: Pixels, K: Matrix3, k: float) -> Pixels:
    """Return the picture of a camera K through a lens of SIMPLE_RADIAL: x_d = x (1 + k r^2)."""
    if not k:
        return pixels
    height, width = pixels.shape[:2]
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    distorted = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]], axis=-1)
    rays = distorted
    for _ in range(ITERATIONS):
        rays = distorted / (1 + k * (rays**2).sum(axis=-1, keepdims=True))
    at = (rays * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]).astype(np.float32)
    # OpenCV's types do not say that the pixels are bytes.
    return np.asarray(cv2.remap(pixels, at[..., 0], at[..., 1], cv2.INTER_CUBIC), np.uint8)


def read_pairs(out: Path) -> list[BatchPair]:
    """Return the pairs of a journal with their matches."""
    pairs = []
    with Store.read(out / "results/work") as store:
        columns = "name, digest, width, height, focal"
        images = {
            row[0]: BatchImage(Path(row[0]).stem, row[1], Size(*row[2:4]), row[4])
            for row in store.db.execute(f"SELECT {columns} FROM image")
        }
    found = results(out / "results/work")
    for row in found.pairs.to_dict("records"):
        (match,) = found.matches(row["pair"])
        first, second = (images[row[name]] for name in ("image0", "image1"))
        pairs.append(BatchPair(first, second, (match.matches,)))
    return pairs


@dataclass(frozen=True)
class Scores:
    """Scores of the cameras of a draw; errors of centres are shares of the model's size."""

    accuracy: float
    error: float
    seconds: float


@dataclass(frozen=True)
class Draw:
    """Scores by pinholes and by lenses."""

    pinholes: Scores
    lenses: Scores


def draw_of(scene: TrainScene, pairs: Sequence[BatchPair], images: int, seed: int) -> Draw:
    """Reconstruct random images of a scene with both settings."""
    names = sorted({image.name for pair in pairs for image in (pair.image0, pair.image1)})
    chosen = set(np.random.default_rng(seed).permutation(names)[:images].tolist())
    drawn = [pair for pair in pairs if chosen >= {pair.image0.name, pair.image1.name}]
    true = [pair for pair in scene.pairs if chosen >= set(stems_of(pair))]
    scores = []
    for model in (CameraModel.SIMPLE_PINHOLE, CameraModel.SIMPLE_RADIAL):
        models, seconds = reconstructed(drawn, model)
        scores.append(scores_of(models, true, scene, seconds))
    return Draw(*scores)


def reconstructed(pairs: Sequence[BatchPair], model: CameraModel) -> tuple[list[SfmModel], float]:
    """Return the models with a setting, the largest first, and their CPU seconds."""
    begin = process_time()
    solution = reconstruct_batch(pairs, SceneConfig(camera_model=model), is_whole=True)
    return list(models_of(solution.reconstructions)), process_time() - begin


def stems_of(true: TruePair) -> tuple[str, str]:
    first, second = (path.stem for path in true.pair.images)
    return first, second


def scores_of(
    models: Sequence[SfmModel], true: Sequence[TruePair], scene: TrainScene, seconds: float
) -> Scores:
    """Compare the cameras of a draw with the true ones."""
    by_name = [{found.image.name: found for found in model.images} for model in models]
    accuracies = [pair_accuracy(error_of(pose_of(by_name, pair), pair, scene)) for pair in true]
    targets: dict[str, Camera] = {}
    for pair in true:
        targets.update(zip(stems_of(pair), (pair.camera0, pair.camera1), strict=True))
    images = [each for each in models[0].images if each.image.name in targets] if models else []
    errors = [*centre_errors(images, targets)]
    return Scores(fmean(accuracies), max(errors, default=np.nan), seconds)


def pose_of(models: Sequence[dict[str, RegisteredImage]], pair: TruePair) -> Matrix3 | None:
    """Return F of a pair from the poses of its cameras and the true intrinsics, ``None`` without
    cameras.
    """
    names = stems_of(pair)
    model = next((model for model in models if model.keys() >= set(names)), None)
    if model is None:
        return None
    first, second = (model[name].camera for name in names)
    return fundamental_of_cameras(
        replace(first, K=pair.camera0.K), replace(second, K=pair.camera1.K)
    )


def centre_errors(images: Sequence[RegisteredImage], targets: dict[str, Camera]) -> Iterator[float]:
    """Yield the error of each centre after a similarity, as a share of the true model's size."""
    cameras = [found.camera for found in images]
    true = [targets[found.image.name] for found in images]
    similarity = find_similarity(cameras, true)
    if similarity is None:
        return
    size = model_size(true)
    for camera, target in zip(cameras, true, strict=True):
        moved = similarity.of_camera(camera)
        yield float(np.linalg.norm(moved.centre - target.centre)) / size


def row_of(name: str, k: float, draws: Sequence[Draw]) -> str:
    """Return a row of the table: each cell by pinholes and by lenses."""

    def both(values: Sequence[tuple[float, float]], form: str, mean: bool = False) -> str:
        columns = zip(*values, strict=True)
        return ", ".join(
            f"{fmean(each) if mean else np.nanmedian(each):{form}}" for each in columns
        )

    cells = [
        name,
        f"{k:g}",
        str(len(draws)),
        both([(draw.pinholes.accuracy, draw.lenses.accuracy) for draw in draws], ".3f", mean=True),
        both([(100 * draw.pinholes.error, 100 * draw.lenses.error) for draw in draws], ".2f"),
        both([(draw.pinholes.seconds, draw.lenses.seconds) for draw in draws], ".1f"),
    ]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
