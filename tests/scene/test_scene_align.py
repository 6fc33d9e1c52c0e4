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
from mkpc_kaggle.scene.models import Reconstruction, RegisteredImage, SfmModel
from mkpc_kaggle.scene.view_graph import BatchImage

# Far from the identity in scale, rotation and translation, so that an omitted part shows.
WORLD = Similarity(
    scale=3.5,
    R=Rotation.from_euler("xyz", [20, -60, 130], degrees=True).as_matrix(),
    t=np.array([1.0, -2, 5]),
)

# Parameters have magnitudes of up to 10, so this is rounding alone.
ROUNDING = 1e-9


def cameras_of(count: int, *, on_a_line: bool = False) -> dict[str, Camera]:
    """Return cameras by file name, with different orientations and different centres."""
    rng = np.random.default_rng(1)
    turns = rng.normal(0, 0.3, (count, 3))
    rotations = Rotation.from_rotvec(turns).as_matrix()
    centres = rng.normal(0, 1, (count, 3))
    if on_a_line:
        # Centres on a line leave the rotation about that line open. Orientations decide it.
        centres[:, 1:] = 0
    cameras = {}
    for number, (R, centre) in enumerate(zip(rotations, centres, strict=True)):
        cameras[f"{number}.png"] = Camera(np.eye(3), R, -R @ centre)
    return cameras


def moved(cameras: dict[str, Camera]) -> dict[str, Camera]:
    """Return the same cameras in the coordinates of `WORLD`."""
    return {name: WORLD.of_camera(camera) for name, camera in cameras.items()}


def model_of(cameras: dict[str, Camera]) -> SfmModel:
    images = []
    for name, camera in cameras.items():
        image = BatchImage(name, name, Size(10, 10))
        images.append(RegisteredImage(image, camera, 50))
    points = np.random.default_rng(2).normal(0, 1, (40, 3))
    return SfmModel(tuple(images), points, 0.3)


def points_in_camera(model: SfmModel, name: str) -> np.ndarray:
    """Return the model's points in the coordinates of the named image's camera, (N, 3)."""
    (camera,) = (found.camera for found in model.images if found.image.name == name)
    return model.points @ camera.R.T + camera.t


@pytest.mark.parametrize("on_a_line", [False, True])
def test_a_similarity_is_found_even_from_cameras_on_a_line(on_a_line):
    cameras = cameras_of(5, on_a_line=on_a_line)
    targets = moved(cameras)
    found = find_similarity([*cameras.values()], [*targets.values()])
    assert found is not None
    assert found.scale == pytest.approx(WORLD.scale)
    np.testing.assert_allclose(found.R, WORLD.R, atol=ROUNDING)
    np.testing.assert_allclose(found.t, WORLD.t, atol=ROUNDING)


def test_a_camera_that_is_elsewhere_does_not_move_the_others():
    cameras = cameras_of(8)
    targets = moved(cameras)
    # Least squares over all cameras would spread this error over the others.
    right = targets["3.png"]
    targets["3.png"] = Camera(np.eye(3), right.R, right.t + 5)
    found = find_similarity([*cameras.values()], [*targets.values()])
    assert found is not None
    assert found.scale == pytest.approx(WORLD.scale)


@pytest.mark.parametrize("names", [["0.png", "1.png"], []])
def test_models_with_too_few_common_cameras_stay_where_they_are(names):
    cameras = cameras_of(5)
    former = moved({name: cameras[name] for name in names})
    reconstruction = Reconstruction((), (model_of(cameras),))
    (kept,) = align([reconstruction], [former])
    first_image = kept.models[0].images[0]
    np.testing.assert_array_equal(first_image.camera.t, cameras["0.png"].t)


def test_each_model_is_moved_onto_the_earlier_model_of_its_images():
    cameras = cameras_of(7)
    first = {name: cameras[name] for name in ("0.png", "1.png", "2.png", "3.png")}
    second = {name: cameras[name] for name in ("4.png", "5.png", "6.png")}
    targets = moved(first)
    # The new image of the first model must move with the others.
    known = {name: camera for name, camera in targets.items() if name != "3.png"}
    # The order of models may change between runs.
    reference = [second, known]
    reconstruction = Reconstruction((), (model_of(first), model_of(second)))
    (made,) = align([reconstruction], reference)
    moved_model, kept_model = made.models
    for found in moved_model.images:
        expected = targets[found.image.name]
        np.testing.assert_allclose(found.camera.t, expected.t, atol=ROUNDING)
    # In a camera's coordinates, a similarity of the world changes only the scale.
    before = points_in_camera(model_of(first), "3.png")
    after = points_in_camera(moved_model, "3.png")
    np.testing.assert_allclose(
        after, WORLD.scale * before, atol=ROUNDING, err_msg="points move with the cameras"
    )
    kept_image = kept_model.images[0]
    np.testing.assert_allclose(kept_image.camera.t, second["4.png"].t, atol=ROUNDING)


def test_a_reference_is_read_as_written_and_a_damaged_one_is_none(tmp_path: Path):
    cameras = cameras_of(3)
    stream = StringIO()
    write_reference(stream, [cameras])
    (tmp_path / REFERENCE).write_text(stream.getvalue())
    (known,) = read_reference(tmp_path)
    for name, camera in known.items():
        np.testing.assert_array_equal(camera.R, cameras[name].R)
        np.testing.assert_array_equal(camera.t, cameras[name].t)
    damages = {
        "no JSON": "",
        "a number instead of a model": "[1]",
        "too few numbers": '[{"a": [1]}]',
        "a word instead of a number": '[{"a": ["x"]}]',
        "nesting that no parser takes": "[" * 100_000,
    }
    for damage, text in damages.items():
        (tmp_path / REFERENCE).write_text(text)
        assert read_reference(tmp_path) == [], damage
    assert read_reference(tmp_path / "none") == []
