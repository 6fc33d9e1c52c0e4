"""The demo set on disk, in the layout of the competition's train and test data."""

import hashlib
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from mkpc_kaggle.demo.camera import FloatImage, Floats, SizedCamera, covisibility
from mkpc_kaggle.demo.render import render
from mkpc_kaggle.demo.world import SCENES, build_world
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.cameras import fundamental_of_cameras
from mkpc_kaggle.geometry.coordinates import Pixels
from mkpc_kaggle.progress import counted

MIN_COVISIBILITY = 0.1  # minimum of a pair that the competition scores
TEST_PAIRS = 8  # per scene
METRES_PER_UNIT = 2.5  # of the written poses
MARK = "demo.txt"  # the file that says that a directory is ours to overwrite
MARK_TEXT = "The command `demo` replaces train/, test/ and test_truth.csv.\n"


@dataclass(frozen=True)
class DemoSet:
    """The folders of a demo set; `truth_csv` names the train images of each test pair."""

    train_dir: Path
    test_dir: Path
    truth_csv: Path


class Photograph(NamedTuple):
    """A picture (H, W, 3) uint8 BGR with its camera and its nearness, (H, W) float32."""

    name: str
    camera: SizedCamera
    picture: Pixels
    nearness: FloatImage


class DemoPair(NamedTuple):
    """Two images of a scene; the first has the greater name, as in the competition."""

    first: Photograph
    second: Photograph
    covisibility: float


def write_demo(
    directory: Path, *, scenes: Sequence[str] | None = None, image_scale: float = 1.0
) -> DemoSet:
    """Render the scenes, by default all, and write their train and test data under `directory`.

    The same arguments give the same bytes. `image_scale` scales all images and their K.
    Raises :class:`UserError` if `directory` has train or test data that `demo` did not write.
    """
    demo = DemoSet(directory / "train", directory / "test", directory / "test_truth.csv")
    _claim(directory, demo)
    scenes = scenes or tuple(SCENES)
    rows: list[tuple[str, str]] = []
    for scene in scenes:
        photographs = take_photographs(scene, image_scale)
        pairs = []
        for a, b in combinations(photographs, 2):
            share = covisibility(b.camera, b.nearness, a.camera, a.nearness)
            pairs.append(DemoPair(b, a, share))
        _write_train(demo.train_dir / scene, photographs, pairs)
        rows += _write_test(demo.test_dir, scene, _selected(pairs))
    samples, truths = zip(*rows, strict=True)
    factors = (f"{scene},{METRES_PER_UNIT}" for scene in scenes)
    _write_rows(demo.train_dir / "scaling_factors.csv", "scene,scaling_factor", factors)
    _write_rows(
        demo.test_dir / "test.csv", "sample_id,batch_id,image_1_id,image_2_id", samples
    )
    _write_rows(demo.truth_csv, "sample_id,scene,image_1_id,image_2_id", truths)
    return demo


def _claim(directory: Path, demo: DemoSet) -> None:
    """Mark the directory as a demo set.

    Raises :class:`UserError` if it has data that `demo` did not write.
    """
    mark = directory / MARK
    for path in (demo.train_dir, demo.test_dir, demo.truth_csv):
        # ``exists`` is False for a broken link, which writing would follow.
        if os.path.lexists(path) and not mark.is_file():
            raise UserError(
                f"{path} is in the way: `demo` did not write it; name an empty directory"
            )
    directory.mkdir(parents=True, exist_ok=True)
    # Before the data: a set that was cut half way is still known as ours.
    mark.write_text(MARK_TEXT)


def take_photographs(scene: str, image_scale: float) -> list[Photograph]:
    """Render the view of each camera of a scene, with its own exposure, tint and noise."""
    photographs = []
    surfaces, cameras = build_world(scene, image_scale=image_scale)
    for number, camera in enumerate(counted(cameras, f"rendering {scene}", "image")):
        image, nearness = render(surfaces, camera)
        rng = np.random.default_rng([0, number, *scene.encode()])
        name = f"{scene}_{number:04d}"
        photographs.append(Photograph(name, camera, _developed(image, rng), nearness))
    return photographs


def _developed(image: FloatImage, rng: np.random.Generator) -> Pixels:
    """Convert an image (H, W, 3) float32 in 0..255 to uint8, with exposure, tint and noise."""
    gain = rng.uniform(0.75, 1.25)
    gamma = rng.uniform(0.85, 1.2)
    # Of blue, green and red
    tint = rng.uniform(0.93, 1.07, 3)
    factors = (tint * gain / 255).astype(np.float32)
    light = np.clip(image * factors, 0, 1) ** gamma
    # The lens first, then the sensor: noise is not blurred.
    blurred = cv2.GaussianBlur(light, (5, 5), rng.uniform(0.3, 0.7))
    sigma = rng.uniform(0.006, 0.016)  # 1.5 to 4 of 255 grey levels
    noise = sigma * rng.standard_normal(light.shape, dtype=np.float32)
    levels = np.clip((blurred + noise) * 255, 0, 255)
    return np.asarray(levels.round(), dtype=np.uint8)


def _selected(pairs: Sequence[DemoPair]) -> list[DemoPair]:
    """Select the test pairs among scored pairs, spread evenly over the ranks of covisibility."""
    scored = [pair for pair in pairs if pair.covisibility >= MIN_COVISIBILITY]
    scored.sort(key=lambda pair: pair.covisibility)
    count = min(TEST_PAIRS, len(scored))
    ranks = np.linspace(0, len(scored) - 1, count)
    return [scored[rank] for rank in ranks.round().astype(int)]


def _write_train(
    directory: Path, photographs: Sequence[Photograph], pairs: Sequence[DemoPair]
) -> None:
    """Write a scene's images, its cameras in the scene's own units, and its pairs."""
    cameras = []
    for each in photographs:
        path = directory / "images" / f"{each.name}.jpg"
        _write_image(path, each.picture)
        camera = each.camera
        matrices = (camera.K, camera.R, camera.t / METRES_PER_UNIT)
        cameras.append(",".join([each.name, *map(_numbers, matrices)]))
    header = "image_id,camera_intrinsics,rotation_matrix,translation_vector"
    _write_rows(directory / "calibration.csv", header, cameras)

    rows = []
    for first, second, share in pairs:
        F = fundamental_of_cameras(first.camera, second.camera)
        rows.append(f"{first.name}-{second.name},{share:.17g},{_numbers(F)}")
    header = "pair,covisibility,fundamental_matrix"
    _write_rows(directory / "pair_covisibility.csv", header, rows)


def _write_test(
    directory: Path, scene: str, pairs: Sequence[DemoPair]
) -> Iterator[tuple[str, str]]:
    """Write the images of one batch.

    Yield each pair's row of test.csv and its row of test_truth.csv.
    """
    # Ids of batches and images are digests: like the competition's, they say nothing of the order.
    batch = _digest(f"0/{scene}")[:8]
    hidden = {}
    shown = {each.name: each for pair in pairs for each in pair[:2]}
    for each in shown.values():
        hidden[each.name] = _digest(f"0/{scene}/{each.name}")[:32]
        path = directory / "test_images" / batch / f"{hidden[each.name]}.png"
        _write_image(path, each.picture)

    for first, second, _ in pairs:
        # The greater id comes first, as in the competition's files.
        names = sorted((first.name, second.name), key=hidden.__getitem__, reverse=True)
        ids = [hidden[name] for name in names]
        sample = f"{scene};{batch};{'-'.join(ids)}"
        yield f"{sample},{batch},{','.join(ids)}", f"{sample},{scene},{','.join(names)}"


def _write_image(path: Path, picture: Pixels) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    done, data = cv2.imencode(path.suffix, picture)
    if not done:
        raise OSError(f"OpenCV could not encode {path}")
    path.write_bytes(data.tobytes())


def _write_rows(path: Path, header: str, rows: Iterable[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    # The same bytes on every system.
    lines = "\n".join([header, *rows])
    path.write_text(lines + "\n", encoding="utf-8", newline="\n")


def _numbers(values: Floats) -> str:
    """Format values row by row, with all digits of a float64."""
    return " ".join(f"{value:.17g}" for value in values.ravel())


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
