"""The demo set on disk, in the layout of the competition's train and test sides."""

import hashlib
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np

from mkpc_kaggle.demo.camera import FloatImage, Floats, SizedCamera, covisibility
from mkpc_kaggle.demo.render import Picture, render
from mkpc_kaggle.demo.world import SCENE_NAMES, World, build_world
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.cameras import fundamental_of_cameras

MIN_COVISIBILITY = 0.1  # the competition scores pairs from this value on
TEST_PAIRS = 8  # per scene
MARK = "demo.txt"
MARK_TEXT = "Rendered by mkpc_kaggle. The command `demo` replaces train/, test/ and test_truth.csv.\n"


@dataclass(frozen=True)
class DemoSet:
    """The folders of a demo set; `truth_csv` lists the train pictures of each test pair."""

    root: Path
    train_dir: Path
    test_dir: Path
    truth_csv: Path


@dataclass(frozen=True, eq=False)
class Photograph:
    """A picture (H, W, 3) uint8 BGR with its camera and its depth, (H, W) float32 in world units."""

    image_id: str
    camera: SizedCamera
    picture: Picture
    depth: FloatImage


@dataclass(frozen=True)
class DemoPair:
    """Two images of a scene; `first.image_id > second.image_id`."""

    first: Photograph
    second: Photograph
    covisibility: float


def write_demo(
    directory: Path, *, seed: int = 0, scenes: Sequence[str] | None = None, image_scale: float = 1.0
) -> DemoSet:
    """Render the scenes (all of them by default) and write both sides under `directory`.

    The same arguments give the same bytes. `image_scale` scales all images and their K.
    Raises :class:`UserError` if the directory has a train or test side that no demo wrote.
    """
    demo = DemoSet(directory, directory / "train", directory / "test", directory / "test_truth.csv")
    _claim(demo)
    worlds = [build_world(name, seed=seed, image_scale=image_scale) for name in scenes or SCENE_NAMES]
    rows: list[tuple[str, str]] = []
    for world in worlds:
        photographs = take_photographs(world, seed)
        ends = combinations(photographs, 2)  # the competition's pairs begin with the greater id
        pairs = [DemoPair(b, a, covisibility(b.camera, b.depth, a.camera, a.depth)) for a, b in ends]
        _write_train(demo.train_dir / world.name, photographs, pairs)
        rows += _write_test(demo.test_dir, world.name, _selected(pairs), seed)
    factors = (f"{world.name},{world.metres_per_unit:.17g}" for world in worlds)
    _write_rows(demo.train_dir / "scaling_factors.csv", "scene,scaling_factor", factors)
    _write_rows(demo.test_dir / "test.csv", "sample_id,batch_id,image_1_id,image_2_id", (row[0] for row in rows))
    _write_rows(demo.truth_csv, "sample_id,scene,image_1_id,image_2_id", (row[1] for row in rows))
    return demo


def _claim(demo: DemoSet) -> None:
    """Mark the directory as a demo set's; raise :class:`UserError` if it has another's files."""
    mark = demo.root / MARK
    is_ours = mark.is_file() and mark.read_text(errors="replace") == MARK_TEXT
    for path in () if is_ours else (mark, demo.train_dir, demo.test_dir, demo.truth_csv):
        if os.path.lexists(path):
            raise UserError(f"{path} is in the way: `demo` did not write it; name an empty directory")
    demo.root.mkdir(parents=True, exist_ok=True)
    mark.write_text(MARK_TEXT)


def take_photographs(world: World, seed: int) -> list[Photograph]:
    """Render the views of the world's cameras, each with its own exposure, tint and noise."""
    photographs = []
    for number, camera in enumerate(world.cameras):
        image, depth = render(world.surfaces, camera)
        rng = np.random.default_rng([seed, number, *world.name.encode()])
        photographs.append(Photograph(f"{world.name}_{number:04d}", camera, _developed(image, rng), depth))
    return photographs


def _developed(image: FloatImage, rng: np.random.Generator) -> Picture:
    """Convert (H, W, 3) float32 in 0..255 to uint8 with exposure, tint and noise, without changing geometry."""
    gain, gamma, balance = rng.uniform(0.75, 1.25), rng.uniform(0.85, 1.2), rng.uniform(0.93, 1.07, 3)
    light = np.clip(image * (balance * gain / 255).astype(np.float32), 0, 1) ** np.float32(gamma)
    blurred = cv2.GaussianBlur(light, (5, 5), float(rng.uniform(0.3, 0.7)))
    noise = np.float32(rng.uniform(0.006, 0.016)) * rng.standard_normal(light.shape, dtype=np.float32)
    return np.asarray(np.clip((blurred + noise) * 255, 0, 255).round(), dtype=np.uint8)


def _selected(pairs: Sequence[DemoPair]) -> list[DemoPair]:
    """Select the test side's pairs: scored ones, spread evenly over covisibility."""
    scored = sorted((p for p in pairs if p.covisibility >= MIN_COVISIBILITY), key=lambda p: p.covisibility)
    chosen = np.linspace(0, len(scored) - 1, min(TEST_PAIRS, len(scored))).round().astype(int)
    return [scored[index] for index in chosen]


def _write_train(directory: Path, photographs: Sequence[Photograph], pairs: Sequence[DemoPair]) -> None:
    for each in photographs:
        _write_image(directory / "images" / f"{each.image_id}.jpg", each.picture, cv2.IMWRITE_JPEG_QUALITY, 95)
    cameras = ((each.image_id, each.camera) for each in photographs)
    _write_rows(
        directory / "calibration.csv",
        "image_id,camera_intrinsics,rotation_matrix,translation_vector",
        (f"{name},{_numbers(camera.K)},{_numbers(camera.R)},{_numbers(camera.t)}" for name, camera in cameras),
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


def _write_test(directory: Path, scene: str, pairs: Sequence[DemoPair], seed: int) -> list[tuple[str, str]]:
    """Write the images of one batch; return each pair's rows of test.csv and test_truth.csv."""
    batch = _digest(f"{seed}/{scene}")[:8]
    photographs = {each.image_id: each for pair in pairs for each in (pair.first, pair.second)}
    hidden = {name: _digest(f"{seed}/{scene}/{name}")[:32] for name in photographs}
    for name, each in photographs.items():
        path = directory / "test_images" / batch / f"{hidden[name]}.png"
        _write_image(path, each.picture, cv2.IMWRITE_PNG_COMPRESSION, 1)
    rows = []
    for pair in pairs:
        names = sorted((pair.first.image_id, pair.second.image_id), key=hidden.__getitem__, reverse=True)
        ids = [hidden[name] for name in names]
        sample = f"{scene};{batch};{'-'.join(ids)}"
        rows.append((f"{sample},{batch},{','.join(ids)}", f"{sample},{scene},{','.join(names)}"))
    return rows


def _write_image(path: Path, picture: Picture, option: int, value: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    done, data = cv2.imencode(path.suffix, picture, [option, value])
    if not done:
        raise OSError(f"OpenCV could not encode {path}")
    path.write_bytes(data.tobytes())


def _write_rows(path: Path, header: str, rows: Iterable[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8", newline="\n")


def _numbers(values: Floats) -> str:
    """Format values row by row, with all digits of a float64."""
    return " ".join(f"{value:.17g}" for value in values.ravel())


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
