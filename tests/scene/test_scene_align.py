"""Reconstructions that keep the coordinates of an earlier one."""

from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.scene.align import (
    REFERENCE,
    Similarity,
    align,
    find_similarity,
    read_reference,
    write_reference,
)
from mkpc_kaggle.scene.reconstruction import Reconstruction, RegisteredImage, SfmModel
from mkpc_kaggle.scene.view_graph import BatchImage

# Far from the identity in each of its parts
WORLD = Similarity(
    3.5,
    Rotation.from_euler("xyz", [20, -60, 130], degrees=True).as_matrix(),
    np.array([1.0, -2, 5]),
)


def cameras_of(count: int, *, on_a_line: bool = False) -> dict[str, Camera]:
    rng = np.random.default_rng(1)
    rotations = Rotation.from_rotvec(rng.normal(0, 0.3, (count, 3))).as_matrix()
    centres = rng.normal(0, 1, (count, 3)) * ((1, 0, 0) if on_a_line else (1, 1, 1))
    return {
        f"{n}.png": Camera(np.eye(3), R, -R @ c)
        for n, (R, c) in enumerate(zip(rotations, centres, strict=True))
    }


def model_of(cameras: dict[str, Camera]) -> SfmModel:
    images = [
        RegisteredImage(BatchImage(name, name, Size(10, 10)), each, 50)
        for name, each in cameras.items()
    ]
    return SfmModel(tuple(images), np.random.default_rng(2).normal(0, 1, (40, 3)), 0.3)


@pytest.mark.parametrize("on_a_line", [False, True])
def test_a_similarity_is_found_even_from_cameras_on_a_line(on_a_line):
    cameras = [*cameras_of(5, on_a_line=on_a_line).values()]
    found = find_similarity(cameras, [WORLD.of_camera(camera) for camera in cameras])
    assert found is not None
    assert found.scale == pytest.approx(WORLD.scale)
    np.testing.assert_allclose(found.R, WORLD.R, atol=1e-9)
    np.testing.assert_allclose(found.t, WORLD.t, atol=1e-9)


def test_a_camera_that_is_elsewhere_does_not_move_the_others():
    cameras = [*cameras_of(8).values()]
    targets = [WORLD.of_camera(camera) for camera in cameras]
    # Least squares over all cameras would spread this error over the others.
    targets[3] = Camera(np.eye(3), targets[3].R, targets[3].t + 5)
    found = find_similarity(cameras, targets)
    assert found is not None
    assert found.scale == pytest.approx(WORLD.scale)


@pytest.mark.parametrize("names", [["0.png", "1.png"], []])
def test_models_with_too_few_common_cameras_stay_where_they_are(names):
    cameras = cameras_of(5)
    former = {name: WORLD.of_camera(cameras[name]) for name in names}
    (kept,) = align([Reconstruction((), (model_of(cameras),))], [former])
    np.testing.assert_array_equal(kept.models[0].images[0].camera.t, cameras["0.png"].t)


def test_each_model_is_moved_onto_the_earlier_model_of_its_images():
    cameras = cameras_of(7)
    first = {name: cameras[name] for name in ("0.png", "1.png", "2.png", "3.png")}
    second = {name: cameras[name] for name in ("4.png", "5.png", "6.png")}
    # In the other order, and one camera of the first model is new.
    reference = [
        second,
        {name: WORLD.of_camera(camera) for name, camera in first.items() if name != "3.png"},
    ]
    (made,) = align([Reconstruction((), (model_of(first), model_of(second)))], reference)
    model = made.models[0]
    for found in model.images:
        np.testing.assert_allclose(
            found.camera.t, WORLD.of_camera(first[found.image.name]).t, atol=1e-9
        )
    # A point keeps its place in front of a camera, but for the scale.
    ray = model_of(first).points @ first["3.png"].R.T + first["3.png"].t
    moved = model.points @ model.images[3].camera.R.T + model.images[3].camera.t
    np.testing.assert_allclose(
        moved, WORLD.scale * ray, atol=1e-9, err_msg="points move with the cameras"
    )
    np.testing.assert_allclose(made.models[1].images[0].camera.t, second["4.png"].t, atol=1e-9)


def test_a_reference_is_read_as_written_and_a_damaged_one_is_none(tmp_path: Path):
    cameras = cameras_of(3)
    stream = StringIO()
    write_reference(stream, [cameras])
    (tmp_path / REFERENCE).write_text(stream.getvalue())
    (known,) = read_reference(tmp_path)
    for name, camera in known.items():
        np.testing.assert_array_equal(camera.R, cameras[name].R)
        np.testing.assert_array_equal(camera.t, cameras[name].t)
    # No JSON, other JSON, too few numbers, no numbers, and nesting that no parser takes
    for damaged in ("", "[1]", '[{"a": [1]}]', '[{"a": ["x"]}]', "[" * 100_000):
        (tmp_path / REFERENCE).write_text(damaged)
        assert read_reference(tmp_path) == []
    assert read_reference(tmp_path / "none") == []
