"""A lens with distortion that the photographs show: a folder's cameras, tables, files and F."""

import csv
import time
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from math import inf
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from synthetic import QUICK
from test_reconstruct import FIRST, MixedMatcher, contents, pairs_of, run, write_flat

from benchmarks.synthetic_scene import SIZE, SyntheticScene, synthetic_scene
from mkpc_kaggle.data.competition import Pair
from mkpc_kaggle.engine.plan.budget import Budget
from mkpc_kaggle.engine.session import Interrupt, Session, run_pairs
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.recipe import Recipe, SceneConfig, Unit
from mkpc_kaggle.reconstruction.folder import read_folder
from mkpc_kaggle.reconstruction.layout import write_layouts
from mkpc_kaggle.scene.choose import Reason
from mkpc_kaggle.setup.assembly import assemble

FOCAL = 840.0
COEFFICIENT = -0.2
CENTRE = np.array([SIZE.width / 2 - 0.5, SIZE.height / 2 - 0.5])


def bent(points: np.ndarray) -> np.ndarray:
    """Return pixels as the lens shows them."""
    rays = (points - CENTRE) / FOCAL
    return rays * (1 + COEFFICIENT * (rays**2).sum(axis=1, keepdims=True)) * FOCAL + CENTRE


@dataclass
class LensMatcher(MixedMatcher):
    """Matches of one scene through a lens with distortion."""

    @cached_property
    def scenes(self) -> tuple[SyntheticScene, SyntheticScene]:
        scene = synthetic_scene(FIRST, points=500, focals=[FOCAL] * FIRST)
        pairs = []
        for pair in scene.pairs:
            points0 = bent(pair.matches.points0).astype(np.float32)
            points1 = bent(pair.matches.points1).astype(np.float32)
            pairs.append(replace(pair, by_unit=(Matches(points0, points1, pair.matches.scores),)))
        return replace(scene, pairs=tuple(pairs)), scene


def write_results(root: Path, out: Path) -> None:
    """Run as the command does, with the folders for other programs."""
    result = run(root, out, LensMatcher())
    assert list(write_layouts(out, root, read_folder(root), inf, result.held)) == []


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    home = tmp_path_factory.mktemp("lens")
    root = write_flat(home / "images", FIRST)
    write_results(root, home / "out")
    return root, home / "out"


def test_cameras_and_models_have_the_lens(folder):
    _, out = folder
    with (out / "cameras.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == FIRST
    for row in rows:
        assert row["camera_model"] == "SIMPLE_RADIAL"
        focal, _, _, k = map(float, row["parameters"].split())
        assert (focal, k) == pytest.approx((FOCAL, COEFFICIENT), rel=0.05)
    model = pycolmap.Reconstruction(out / "models" / "0")
    assert {camera.model_name for camera in model.cameras.values()} == {"SIMPLE_RADIAL"}


def test_other_programs_get_pinholes_and_pictures_of_their_sizes(folder):
    _, out = folder
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    assert len(model.images) == FIRST
    # Without distortion, points are where pinholes see them.
    assert model.compute_mean_reprojection_error() == pytest.approx(
        pycolmap.Reconstruction(out / "models" / "0").compute_mean_reprojection_error(), rel=0.2
    )
    errors = []
    for image in model.images.values():
        assert image.camera.model_name == "PINHOLE"
        assert not (out / "images" / image.name).is_symlink()
        for point in image.points2D:
            if point.has_point3D():
                seen = image.project_point(model.points3D[point.point3D_id].xyz)
                errors.append(np.linalg.norm(seen - point.xy))
    assert np.median(errors) < 1


def test_f_of_distorted_cameras_is_that_of_the_matches(folder):
    _, out = folder
    pairs = pairs_of(out)
    assert set(pairs["choice"]) == {str(Reason.DISTORTED)}
    assert set(pairs["source"]) == {"pair"}
    assert (pairs["inliers"] > 20).all()


def test_a_resumed_run_leaves_the_same_bytes(folder):
    root, out = folder
    before = contents(out)
    write_results(root, out)
    assert contents(out) == before


def test_cameras_for_f_are_pinholes_and_the_lens_is_reported(folder, tmp_path):
    root, _ = folder
    files = sorted(root.iterdir())
    pairs = [
        Pair(f"{first.stem}-{second.stem}", "batch", str(first), str(second))
        for first, second in combinations(files, 2)
    ]
    recipe = Recipe((Unit(1, "synthetic", SIZE.width),), magsac=QUICK, scene=SceneConfig())
    assembly = assemble(recipe, matchers={"synthetic": LensMatcher()}, device="cpu")
    session = Session(tmp_path, Budget(time.monotonic()), Interrupt(), progress=False, workers=0)
    (scene,) = run_pairs(pairs, assembly, session).scenes
    (model,) = scene.models
    assert {image.lens.model for image in model.images if image.lens} == {"SIMPLE_PINHOLE"}
