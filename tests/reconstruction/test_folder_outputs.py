"""OUT: whose it must be, models in the coordinates of the former ones, folders for other programs."""

import shutil
from math import inf
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from mkpc_kaggle.data.images import Image, read_image
from mkpc_kaggle.engine.store import FILE_NAME
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.reconstruction import outputs
from mkpc_kaggle.reconstruction.outputs import (
    Writer,
    keep_former,
    remove_results,
    require_out,
    write_results,
)


def model_of(names: list[str], folder: Path, k: float = 0.0) -> pycolmap.Reconstruction:
    """Return a model with images of noise in ``folder``, whose lens has a distortion ``k``."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = len(names)
    options.num_cameras_per_rig = 1
    options.num_frames_per_rig = 1
    options.num_points3D = 60
    options.camera_width, options.camera_height = 160, 120
    options.camera_model_id = pycolmap.CameraModelId.SIMPLE_RADIAL
    options.camera_params = [200.0, 80.0, 60.0, k]
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(options)
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    for name, image in zip(names, model.images.values(), strict=True):
        image.name = name
        (folder / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(folder / name), rng.integers(0, 255, (120, 160, 3), np.uint8))
    if not k:
        for camera in model.cameras.values():
            camera.model = pycolmap.CameraModelId.SIMPLE_PINHOLE
            camera.params = [200.0, 80.0, 60.0]
    return model


def write_scene(model: pycolmap.Reconstruction, out: Path) -> None:
    """Write the files of a scene's job."""
    folder = out / "work" / "scene" / "models" / "0"
    shutil.rmtree(folder.parent.parent, ignore_errors=True)
    folder.mkdir(parents=True)
    model.write(folder)
    (folder.parent.parent / "database.db").write_bytes(b"database")


NAMES = ["a.png", "b.png", "inner/a.png", "inner_a.png"]


def centres(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    return {image.name: image.projection_center() for image in model.images.values()}


def test_an_empty_out_and_that_of_an_earlier_run_are_taken(tmp_path):
    out = tmp_path / "out"
    require_out(out, [])
    (out / ".DS_Store").touch()
    # A run that was killed before it had a journal
    require_out(out, [])
    (out / "models").mkdir()
    (out / "work").rmdir()
    with pytest.raises(UserError, match="has models, and no run of this command"):
        require_out(out, [])
    assert sorted(path.name for path in out.iterdir()) == [".DS_Store", "models"]
    (out / "work").mkdir()
    (out / "work" / FILE_NAME).touch()
    require_out(out, [])


@pytest.mark.parametrize("out", ["images", "images/out", "."])
def test_an_out_in_an_input_or_around_it_is_refused(tmp_path, out):
    (tmp_path / "images").mkdir()
    with pytest.raises(UserError, match="contains, or lies in, the input"):
        require_out(tmp_path / out, [tmp_path / "images"])
    assert [path.name for path in tmp_path.iterdir()] == ["images"]


def test_files_of_a_writer_that_was_killed_are_removed(tmp_path):
    out = tmp_path / "out"
    (out / ".mkpc-new-x" / "models").mkdir(parents=True)
    with Writer(tmp_path, out) as writer:
        writer.update("none")
        with pytest.raises(UserError, match="No such file"):
            writer.next(inf)
    assert list(out.iterdir()) == []


def test_pinholes_are_links_that_move_with_the_folders(tmp_path):
    out = tmp_path / "project" / "out"
    write_scene(model_of(NAMES, tmp_path / "project" / "images"), out)
    # All is written before the first value, for which a child waits until it is read.
    next(write_results(tmp_path / "project" / "images", out, out / "work" / "scene"))
    assert (out / "database.db").stat().st_nlink == 1, "COLMAP may write to it"
    (tmp_path / "project").rename(tmp_path / "renamed")
    out = tmp_path / "renamed" / "out"
    assert sorted(path.name for path in (out / "images").iterdir()) == [
        *("_inner_a.png", "a.png", "b.png", "inner_a.png")
    ]
    assert (out / "images" / "_inner_a.png").resolve().name == "inner_a.png"
    for path in (out / "images").iterdir():
        assert path.is_symlink() and path.exists()
    assert sorted(path.name for path in out.iterdir()) == [
        *("cameras.csv", "database.db", "images", "models", "sparse", "work")
    ]
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    assert {image.name for image in model.images.values()} == {
        path.name for path in (out / "images").iterdir()
    }
    # Colours of points are those of the photographs.
    assert len({tuple(point.color) for point in model.points3D.values()}) > 10
    assert set(centres(pycolmap.Reconstruction(out / "models" / "0"))) == set(NAMES)


def test_a_distorted_lens_gets_undistorted_copies(tmp_path):
    write_scene(model_of(NAMES, tmp_path / "images", k=-0.1), tmp_path / "out")
    list(
        write_results(
            tmp_path / "images", tmp_path / "out", tmp_path / "out" / "work" / "scene"
        )
    )
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    for image in model.images.values():
        picture = read_image(tmp_path / "out" / "images" / image.name)
        assert isinstance(picture, Image)
        assert image.camera.model_name == "PINHOLE"
        assert picture.size == (image.camera.width, image.camera.height)
        assert not (tmp_path / "out" / "images" / image.name).is_symlink()


def test_models_of_a_folder_that_grows_keep_their_coordinates(tmp_path):
    out = tmp_path / "out"
    first = model_of(NAMES, tmp_path / "images")
    write_scene(first, out)
    list(write_results(tmp_path / "images", out, out / "work" / "scene"))
    grown = model_of(NAMES, tmp_path / "images")
    turn = pycolmap.Rotation3d(np.array([0.1, 0.2, 0.3, 0.9]))
    grown.transform(pycolmap.Sim3d(2.5, turn, np.array([3.0, -4.0, 7.0])))
    write_scene(grown, out)
    keep_former(out)
    (found,), _ = write_results(tmp_path / "images", out, out / "work" / "scene")
    for image in found.images:
        expected = centres(first)[image.image.name]
        np.testing.assert_allclose(image.camera.centre, expected, atol=1e-6)
    # Without a change, the bytes stay.
    before = (out / "models" / "0" / "images.bin").read_bytes()
    write_scene(pycolmap.Reconstruction(out / "models" / "0"), out)
    keep_former(out)
    list(write_results(tmp_path / "images", out, out / "work" / "scene"))
    assert (out / "models" / "0" / "images.bin").read_bytes() == before


def test_a_full_disk_leaves_the_former_results(tmp_path, monkeypatch):
    out = tmp_path / "out"
    write_scene(model_of(NAMES, tmp_path / "images"), out)
    list(write_results(tmp_path / "images", out, out / "work" / "scene"))
    before = sorted(path.relative_to(out) for path in out.rglob("*"))

    def full(_: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(outputs, "sync", full)
    with pytest.raises(OSError, match="No space left"):
        list(write_results(tmp_path / "images", out, out / "work" / "scene"))
    assert sorted(path.relative_to(out) for path in out.rglob("*")) == before


def test_a_link_to_a_folder_of_the_users_is_replaced_and_not_emptied(tmp_path):
    out = tmp_path / "out"
    write_scene(model_of(NAMES, tmp_path / "images"), out)
    (out / "images").symlink_to(tmp_path / "images")
    list(write_results(tmp_path / "images", out, out / "work" / "scene"))
    remove_results(out)
    assert (tmp_path / "images" / "inner" / "a.png").exists()
    assert [path.name for path in out.iterdir()] == ["work"]


def test_a_scene_without_models_has_its_database_and_an_empty_table(tmp_path):
    out = tmp_path / "out"
    write_scene(model_of(NAMES, tmp_path / "images"), out)
    list(write_results(tmp_path / "images", out, out / "work" / "scene"))
    shutil.rmtree(out / "work" / "scene" / "models" / "0")
    assert list(write_results(tmp_path / "images", out, out / "work" / "scene")) == [[], []]
    remove_results(out, outputs.FOLDERS)
    assert sorted(path.name for path in out.iterdir()) == [
        "cameras.csv",
        "database.db",
        "work",
    ]
    assert len((out / "cameras.csv").read_text().splitlines()) == 1
