"""The data set on disk, in the layout of the competition's train and test sides."""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np

from mkpc_kaggle.demo.camera import Camera, Floats
from mkpc_kaggle.demo.covisibility import covisibility
from mkpc_kaggle.demo.photo import develop
from mkpc_kaggle.demo.photographs import load_photographs
from mkpc_kaggle.demo.scene import Scene
from mkpc_kaggle.demo.scenes import SCENE_NAMES, build_scene
from mkpc_kaggle.demo.texture import FloatImage, Picture
from mkpc_kaggle.geometry.cameras import fundamental_of_cameras

LEAST_COVISIBILITY = 0.1  # what the competition scores
TEST_PAIRS = 8  # a scene

_TEST_HEADER = "sample_id,batch_id,image_1_id,image_2_id"
_TRUTH_HEADER = "sample_id,scene,image_1_id,image_2_id"


@dataclass(frozen=True)
class DemoSet:
    """Where a demo set lies; `truth_csv` says which train pictures a test pair shows."""

    root: Path
    train_dir: Path
    test_dir: Path
    truth_csv: Path


@dataclass(frozen=True, eq=False)
class Shown:
    """A photograph with its truth: picture (H, W, 3) uint8 BGR, depth (H, W) float32 in world units."""

    image_id: str
    camera: Camera
    picture: Picture
    depth: FloatImage


@dataclass(frozen=True)
class Pair:
    """Two images of a scene; `first.image_id > second.image_id`."""

    first: Shown
    second: Shown
    covisibility: float


def write_demo(
    directory: Path, *, seed: int = 0, scenes: Sequence[str] | None = None, image_scale: float = 1.0
) -> DemoSet:
    """Render the scenes (all of them by default) and write both sides under `directory`.

    The same arguments give the same bytes. `image_scale` makes all images and their K smaller (or larger).
    Raises ValueError for an unknown scene, a scene given twice, or a scale that is not positive.
    """
    names = SCENE_NAMES if scenes is None else tuple(scenes)
    if len(set(names)) != len(names):
        raise ValueError(f"a scene is given twice: {', '.join(names)}")
    if not image_scale > 0:
        raise ValueError(f"image_scale must be positive, not {image_scale}")
    demo = DemoSet(directory, directory / "train", directory / "test", directory / "test_truth.csv")
    photographs = load_photographs()
    factors, samples, truths = [], [], []
    for name in names:
        scene = build_scene(name, photographs, seed=seed, image_scale=image_scale)
        shown = _photograph(scene, seed)
        pairs = [_pair(a, b) for a, b in combinations(shown, 2)]
        _write_train(demo.train_dir / name, shown, pairs)
        scene_samples, scene_truths = _write_test(demo.test_dir, name, _selected(pairs), seed)
        factors.append(f"{name},{scene.metres_per_unit:.17g}")
        samples += scene_samples
        truths += scene_truths
    _write_rows(demo.train_dir / "scaling_factors.csv", "scene,scaling_factor", factors)
    _write_rows(demo.test_dir / "test.csv", _TEST_HEADER, samples)
    _write_rows(demo.truth_csv, _TRUTH_HEADER, truths)
    return demo


def _photograph(scene: Scene, seed: int) -> list[Shown]:
    shown = []
    for i, view in enumerate(scene.views):
        image, depth = scene.render(view)
        rng = np.random.default_rng([seed, i, *scene.name.encode()])
        shown.append(Shown(f"{scene.name}_{i:04d}", view.camera, develop(image, rng), depth))
    return shown


def _pair(a: Shown, b: Shown) -> Pair:
    first, second = (a, b) if a.image_id > b.image_id else (b, a)
    return Pair(first, second, covisibility(a.camera, a.depth, b.camera, b.depth))


def _selected(pairs: Sequence[Pair]) -> list[Pair]:
    """The pairs of the test side: scored ones, spread evenly from the least covisible to the most."""
    scored = sorted((p for p in pairs if p.covisibility >= LEAST_COVISIBILITY), key=lambda p: p.covisibility)
    if len(scored) <= TEST_PAIRS:
        return scored
    return [scored[i] for i in np.linspace(0, len(scored) - 1, TEST_PAIRS).round().astype(int)]


def _write_train(directory: Path, shown: Sequence[Shown], pairs: Sequence[Pair]) -> None:
    (directory / "images").mkdir(parents=True, exist_ok=True)
    for each in shown:
        _write_image(directory / "images" / f"{each.image_id}.jpg", each.picture, cv2.IMWRITE_JPEG_QUALITY, 95)
    _write_rows(
        directory / "calibration.csv",
        "image_id,camera_intrinsics,rotation_matrix,translation_vector",
        (f"{s.image_id},{_numbers(s.camera.K)},{_numbers(s.camera.R)},{_numbers(s.camera.t)}" for s in shown),
    )
    _write_rows(
        directory / "pair_covisibility.csv",
        "pair,covisibility,fundamental_matrix",
        (
            f"{p.first.image_id}-{p.second.image_id},{p.covisibility:.17g},"
            f"{_numbers(fundamental_of_cameras(p.first.camera, p.second.camera))}"
            for p in pairs
        ),
    )


def _write_test(directory: Path, scene: str, pairs: Sequence[Pair], seed: int) -> tuple[list[str], list[str]]:
    """Write the images of one batch; the rows of test.csv and of test_truth.csv."""
    batch = _digest(f"{seed}/{scene}")[:8]
    folder = directory / "test_images" / batch
    folder.mkdir(parents=True, exist_ok=True)
    shown = {s.image_id: s for pair in pairs for s in (pair.first, pair.second)}
    hidden = {name: _digest(f"{seed}/{scene}/{name}")[:32] for name in shown}
    for name, each in shown.items():
        _write_image(folder / f"{hidden[name]}.png", each.picture, cv2.IMWRITE_PNG_COMPRESSION, 1)
    samples, truths = [], []
    for pair in pairs:
        one, two = sorted((pair.first.image_id, pair.second.image_id), key=hidden.__getitem__, reverse=True)
        sample = f"{scene};{batch};{hidden[one]}-{hidden[two]}"
        samples.append(f"{sample},{batch},{hidden[one]},{hidden[two]}")
        truths.append(f"{sample},{scene},{one},{two}")
    return samples, truths


def _write_image(path: Path, picture: Picture, option: int, value: int) -> None:
    done, data = cv2.imencode(path.suffix, picture, [option, value])
    if not done:
        raise OSError(f"OpenCV could not encode {path}")
    path.write_bytes(data.tobytes())


def _write_rows(path: Path, header: str, rows: Iterable[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8", newline="\n")


def _numbers(values: Floats) -> str:
    """Row by row, with all the digits that a float64 has."""
    return " ".join(f"{value:.17g}" for value in values.ravel())


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
