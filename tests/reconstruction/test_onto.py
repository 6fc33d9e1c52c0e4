"""New photographs are registered in a finished model, whose cameras stay as they are."""

import re
import shutil
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from rectified import Seen, flat, number_of
from shared import run_command
from test_reconstruct import FIRST, RECIPE, MixedMatcher, write_flat

from benchmarks.synthetic_scene import SIZE, SyntheticScene, synthetic_scene
from mkpc_kaggle import reconstruct
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.intrinsics import CameraTable, KnownCamera, PlacedCamera
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.reconstruction.placed import placed_line, read_cameras, read_placed
from mkpc_kaggle.scene.align import find_similarity, model_size, moved_by
from mkpc_kaggle.scene.assumptions import placed_lenses
from mkpc_kaggle.scene.view_graph import BatchImage, ViewGraph

OLD = 4  # images of the finished model


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    """Six images of a scene in ``images``, and a model of the first four in ``old``."""
    home = tmp_path_factory.mktemp("onto")
    files = sorted(write_flat(home / "images", FIRST).iterdir())
    made(files[:OLD], home / "old")
    # COLMAP's models have no fixed scale and origin, and neither need those of others.
    model = pycolmap.Reconstruction(home / "old" / "colmap" / "models" / "0")
    turned = pycolmap.Rotation3d(np.array([0.1, -0.2, 0.3, 0.9]))
    model.transform(pycolmap.Sim3d(2.5, turned, np.array([30.0, -4.0, 7.0])))
    (home / "model").mkdir()
    model.write(home / "model")
    return home


def made(files, work: Path, **options):
    given = {"synthetic": MixedMatcher()}
    options = {"device": "cpu", "progress": False, "work_dir": work, "matchers": given} | options
    return reconstruct(files, RECIPE, **options)


def numbers_of(folder: Path) -> dict:
    """Each image's pose and camera as they are stored."""
    model = pycolmap.Reconstruction(folder)
    return {
        image.name: (
            image.cam_from_world().params.tolist(),
            image.camera.model_name,
            image.camera.params.tolist(),
        )
        for image in model.images.values()
        if image.has_pose
    }


def test_new_images_are_registered_and_no_other_camera_changes(home, tmp_path):
    files = sorted((home / "images").iterdir())
    (model,) = made(files, tmp_path / "new", onto=home / "model")
    before = numbers_of(home / "model")
    after = numbers_of(tmp_path / "new" / "colmap" / "models" / "0")
    assert len(before) == OLD
    assert len(after) == FIRST
    assert {name: after[name] for name in before} == before
    # The new cameras are those of the scene, in the world of the model.
    truth = {f"{number:02}.png": camera for number, camera in enumerate(cameras_of_scene())}
    found = {Path(image.image.name).name: image.camera for image in model.images}
    assert found.keys() == truth.keys()
    similarity = find_similarity(
        [truth[name] for name in sorted(before)], [found[name] for name in sorted(before)]
    )
    new = sorted(found.keys() - before.keys())
    targets = [similarity.of_camera(truth[name]) for name in new]
    size = model_size([found[name] for name in sorted(before)])
    assert moved_by([found[name] for name in new], targets).max() < 0.02 * size
    for name, target in zip(new, targets, strict=True):
        cosine = (np.trace(found[name].R.T @ target.R) - 1) / 2
        assert np.degrees(np.arccos(min(1, cosine))) < 0.5


@dataclass
class OneCamera(MixedMatcher):
    """The photographs of a scene by one camera."""

    @cached_property
    def scenes(self) -> tuple[SyntheticScene, SyntheticScene]:
        scene = synthetic_scene(FIRST, points=500, focals=[840.0] * FIRST)
        return scene, scene


@pytest.mark.parametrize("is_of_one_camera", [True, False])
def test_new_images_of_the_models_camera_share_its_intrinsics(home, tmp_path, is_of_one_camera):
    files = sorted((home / "images").iterdir())
    matchers = {"synthetic": OneCamera() if is_of_one_camera else MixedMatcher()}
    made(files[:OLD], tmp_path / "old", matchers=matchers)
    old = pycolmap.Reconstruction(tmp_path / "old" / "colmap" / "models" / "0")
    # As of a model whose images share a camera
    focal = float(np.median([camera.mean_focal_length() for camera in old.cameras.values()]))
    for camera in old.cameras.values():
        camera.params = [focal, *camera.params[1:]]
    (tmp_path / "shared").mkdir()
    old.write(tmp_path / "shared")
    made(files, tmp_path / "new", onto=tmp_path / "shared", matchers=matchers)
    after = numbers_of(tmp_path / "new" / "colmap" / "models" / "0")
    new = {tuple(after[name][2]) for name in ("04.png", "05.png")}
    assert (new == {(focal, SIZE.width / 2, SIZE.height / 2)}) == is_of_one_camera


def test_new_images_start_with_the_distorted_lens_of_the_model():
    def image(name: str, size: Size) -> BatchImage:
        return BatchImage(name, name, size)

    lens = ("SIMPLE_RADIAL", (500.0, 320.0, 240.0, -0.1))
    images = (image("old", SIZE), image("new", SIZE), image("other camera", Size(100, 90)))
    placed = PlacedCamera(*lens, pose=(0, 0, 0, 1, 0, 0, 0))
    graph = ViewGraph(images, ()).with_intrinsics([("old", placed)])
    assert placed_lenses(graph) == {"new": KnownCamera(*lens)}
    pinhole = PlacedCamera("SIMPLE_PINHOLE", lens[1][:3], pose=placed.pose)
    assert placed_lenses(ViewGraph(images, ()).with_intrinsics([("old", pinhole)])) == {}


def cameras_of_scene():
    scene = MixedMatcher().scenes[0]
    return [scene.cameras[name] for name in sorted(scene.cameras)]


def test_the_command_reads_the_model_first(home, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(home)
    command = ["reconstruct", "images", "--out", tmp_path / "out", "--onto", "images"]
    assert run_command(*command) == 2
    assert "--onto images: images/cameras.bin cannot be read" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_model_that_the_run_would_replace_is_refused_and_stays(home, tmp_path, capsys):
    shutil.copytree(home / "model", tmp_path / "out" / "models" / "0")
    shutil.copytree(home / "old", tmp_path / "work")
    refused = r"contains, or lies in, the input .*; name another folder"
    before = contents(tmp_path)
    command = ["reconstruct", home / "images", "--out", tmp_path / "out"]
    assert run_command(*command, "--onto", tmp_path / "out" / "models" / "0") == 2
    assert re.search(refused, capsys.readouterr().err)
    with pytest.raises(UserError, match=refused):
        model = tmp_path / "work" / "colmap" / "models" / "0"
        made(sorted((home / "images").iterdir()), tmp_path / "work", onto=model)
    assert contents(tmp_path) == before


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", ["masks", "intrinsics", "recipe", "weights"])
def test_no_input_of_a_python_program_lies_among_its_results(home, tmp_path, name):
    shutil.copytree(home / "old", tmp_path / "work")
    given = tmp_path / "work" / "colmap" / name
    given.write_text("mine")
    options = {"device": "cpu", "progress": False, "work_dir": tmp_path / "work"}
    files = sorted((home / "images").iterdir())
    # Files that are read before this check would be refused for their content.
    if name == "recipe":
        given = given.rename(given.with_suffix(".toml"))
        given.write_text('units = [{ stage = 1, matcher = "sift", long_side = 800 }]\n')
    if name == "masks":
        given.unlink()
        given.mkdir()
        for file in files:
            shutil.copy(file, given / f"{file.name}.png")
    if name == "intrinsics":
        given.write_text("image,model,parameters,sigma\n*,SIMPLE_PINHOLE,900 400 300,fixed\n")
    if name == "weights":
        given.unlink()
        given.mkdir()
    with pytest.raises(UserError, match=f"the input {given}; name another folder"):
        reconstruct(files, **({"recipe": "sift"} | options | {name: given}))


def test_a_line_counts_the_images_that_keep_their_cameras(home):
    files = sorted((home / "images").iterdir())
    rows = read_placed(home / "model", home / "images", {".": files})
    line = placed_line(rows, Path("model"), files, home / "images")
    assert line == "onto model: 4 of 6 images keep the model's cameras; the first new one is 04.png"


def test_a_camera_is_placed_by_its_path_alone():
    camera = PlacedCamera("SIMPLE_PINHOLE", (500.0, 320, 240), pose=(0, 0, 0, 1, 0, 0, 0))
    rows = [("a.jpg", camera), ("b[1].jpg", camera)]
    assert CameraTable(rows).camera_of("a.jpg") is camera
    assert CameraTable(rows).camera_of("b[1].jpg") is camera
    # Other photographs that only a pattern or a file name would name
    for name in ("left/a.jpg", "b1.jpg"):
        assert CameraTable(rows).camera_of(name) is None
    with pytest.raises(ValueError, match="seven finite numbers"):
        PlacedCamera("SIMPLE_PINHOLE", (500.0, 320, 240), pose=(0, 0, 0, 1))


def test_a_model_is_read_as_pycolmap_reads_it(home):
    for name, (camera, size) in read_cameras(home / "model").items():
        assert size == SIZE
        assert numbers_of(home / "model")[name] == (
            list(camera.pose),
            camera.model,
            list(camera.parameters),
        )


def test_names_of_a_model_may_be_below_the_dataset(home):
    files = sorted((home / "images").iterdir())
    (row, *_) = read_placed(home / "model", home, {"images": files})
    assert row[0] == f"images/{files[0].name}"


def cut(folder: Path) -> None:
    (folder / "images.bin").write_bytes((folder / "images.bin").read_bytes()[:100])


def fisheye(folder: Path) -> None:
    data = bytearray((folder / "cameras.bin").read_bytes())
    data[12] = 5  # the number of the first camera's model
    (folder / "cameras.bin").write_bytes(bytes(data))


def without_rotation(folder: Path) -> None:
    data = bytearray((folder / "images.bin").read_bytes())
    data[12:44] = bytes(32)  # the first image's quaternion
    (folder / "images.bin").write_bytes(bytes(data))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (
            lambda folder: (folder / "images.bin").unlink(),
            "images.bin cannot be read: No such file",
        ),
        (lambda folder: (folder / "cameras.bin").write_bytes(b""), "is not a model of COLMAP"),
        (cut, "is not a model of COLMAP"),
        (without_rotation, "is not a model of COLMAP: the rotation of a placed camera is no unit"),
        (fisheye, "a camera has model 5; known: SIMPLE_PINHOLE, PINHOLE"),
    ],
)
def test_another_folder_is_refused_before_any_work(home, tmp_path, spoil, words):
    folder = tmp_path / "model"
    folder.mkdir()
    for name in ("cameras.bin", "images.bin"):
        (folder / name).write_bytes((home / "model" / name).read_bytes())
    spoil(folder)
    with pytest.raises(UserError, match=re.escape(words)):
        made(sorted((home / "images").iterdir()), tmp_path / "work", onto=folder)
    assert not (tmp_path / "work").exists()


def test_a_model_of_other_photographs_is_refused_with_one_of_its_names(home, tmp_path):
    files = sorted((home / "images").iterdir())
    model = home / "model"
    with pytest.raises(UserError, match=r"1 image of .* of the model's 4 images, such as 00\.png"):
        read_placed(model, home / "images", {".": files[OLD - 1 :]})
    cv2.imwrite(str(tmp_path / files[0].name), np.zeros((60, 80), np.uint8))
    reduced = [tmp_path / files[0].name]
    with pytest.raises(UserError, match=r"00\.png with 800 x 600 pixels, and .* has 80 x 60"):
        read_placed(model, tmp_path, {".": reduced})
    with pytest.raises(UserError, match=r"is for one dataset, and .* has 2: .* --join"):
        read_placed(model, home, {"a": files[:2], "b": files[2:]})


class AnyOrder(MixedMatcher):
    """Matches a pair of the scene in both orders."""

    def _match(self, seen0: Seen, seen1: Seen) -> Matches:
        if number_of(seen0) < number_of(seen1):
            return super()._match(seen0, seen1)
        found = super()._match(seen1, seen0)
        return Matches(found.points1, found.points0, found.scores)


def test_another_picture_under_a_name_of_the_model_is_registered_as_new(home, tmp_path):
    files = []
    for number, file in enumerate(sorted((home / "images").iterdir())):
        # The first and the last photograph have exchanged their names.
        shown = {0: FIRST - 1, FIRST - 1: 0}.get(number, number)
        files.append(tmp_path / "images" / file.name)
        files[-1].parent.mkdir(exist_ok=True)
        cv2.imwrite(str(files[-1]), flat(shown, SIZE))
    given = {"synthetic": AnyOrder()}
    (model,) = made(files, tmp_path / "new", onto=home / "model", matchers=given)
    assert [Path(name).name for name in model.comparison.misplaced] == ["00.png"]
    truth = cameras_of_scene()
    shown = [truth[number] for number in (FIRST - 1, *range(1, FIRST - 1), 0)]
    found = {Path(image.image.name).name: image.camera for image in model.images}
    cameras = [found[file.name] for file in files]
    similarity = find_similarity(shown[1:OLD], cameras[1:OLD])
    moved = [similarity.of_camera(camera) for camera in shown]
    assert moved_by(cameras, moved).max() < 0.03 * model_size(cameras)
    # Cameras that fit stay.
    before = numbers_of(home / "model")
    after = numbers_of(tmp_path / "new" / "colmap" / "models" / "0")
    for name in ("01.png", "02.png", "03.png"):
        assert after[name][0] == pytest.approx(before[name][0], rel=0, abs=1e-14)


def test_a_model_of_other_pictures_is_a_failure_with_its_reason(home, tmp_path, capfd):
    files = []
    for number in range(FIRST):
        files.append(tmp_path / "images" / f"{number:02}.png")
        files[-1].parent.mkdir(exist_ok=True)
        cv2.imwrite(str(files[-1]), flat((number * 5 + 2) % FIRST, SIZE))
    given = {"synthetic": AnyOrder()}
    assert made(files, tmp_path / "new", onto=home / "model", matchers=given) == ()
    assert "the photographs contradict all cameras of the model of --onto" in capfd.readouterr().err
