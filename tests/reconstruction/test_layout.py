"""The folders that other programs read, and the coordinates of a folder that grows."""

import os
import struct
from dataclasses import dataclass
from math import inf
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from test_reconstruct import FIRST, MixedMatcher, cameras, run, write_flat

from mkpc_kaggle.reconstruction import layout
from mkpc_kaggle.reconstruction.coordinates import keep_coordinates
from mkpc_kaggle.reconstruction.folder import read_folder
from mkpc_kaggle.reconstruction.layout import (
    link_names,
    write_images,
    write_layouts,
    write_sparse,
)
from mkpc_kaggle.reconstruction.run import forget_coordinates
from mkpc_kaggle.scene.align import REFERENCE


@dataclass
class Splats:
    """What gsplat's loader of COLMAP's files keeps: names, paths, K, poses, points and their
    colours.
    """

    names: list[str]
    paths: list[Path]
    intrinsics: list[np.ndarray]
    camera_to_world: np.ndarray
    points: np.ndarray
    colours: np.ndarray


def load_as_gsplat(data_dir: Path) -> Splats:
    """Read a folder by gsplat's rules: the binary files in sparse/0, and each image below images/
    by its name.

    The layout of the files is COLMAP's, from its documentation.
    """
    folder = data_dir / "sparse" / "0"
    stream = (folder / "cameras.bin").open("rb")

    def read(form: str) -> tuple:
        return struct.unpack(f"<{form}", stream.read(struct.calcsize(f"<{form}")))

    by_camera = {}
    for _ in range(read("Q")[0]):
        number, model, _, _ = read("iiQQ")
        # gsplat undistorts all others, which changes the images.
        assert model in (0, 1), "SIMPLE_PINHOLE or PINHOLE: no undistortion is needed"
        focals = read("d" if model == 0 else "dd")
        cx, cy = read("dd")
        by_camera[number] = np.array([[focals[0], 0, cx], [0, focals[-1], cy], [0, 0, 1]])
    stream.close()
    # Each image: pose, camera, name, and its points, which are skipped
    stream = (folder / "images.bin").open("rb")
    found = {}
    for _ in range(read("Q")[0]):
        _, w, x, y, z, *t, camera = read("I4d3dI")
        name = b""
        while (letter := stream.read(1)) != b"\0":
            name += letter
        stream.seek(24 * read("Q")[0], os.SEEK_CUR)
        # COLMAP's files have the real part first, pycolmap has it last.
        R = pycolmap.Rotation3d(np.array([x, y, z, w])).matrix()
        pose = np.block([[R, np.array(t)[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
        found[name.decode()] = pose, by_camera[camera]
    stream.close()
    stream = (folder / "points3D.bin").open("rb")
    points = []
    colours = []
    for _ in range(read("Q")[0]):
        _, *position, red, green, blue, _ = read("Q3d3Bd")
        stream.seek(8 * read("Q")[0], os.SEEK_CUR)
        points.append(position)
        colours.append((red, green, blue))
    stream.close()
    names = sorted(found)
    poses = np.linalg.inv(np.stack([found[name][0] for name in names]))
    paths = [data_dir / "images" / name for name in names]
    intrinsics = [found[name][1] for name in names]
    return Splats(names, paths, intrinsics, poses, np.array(points), np.array(colours))


@pytest.fixture(scope="module")
def laid_out(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    home = tmp_path_factory.mktemp("layout")
    root = write_flat(home / "images" / "set").parent
    run(root, home / "out")
    assert list(write_layouts(home / "out", root, read_folder(root), inf)) == []
    return root, home / "out"


def test_a_loader_by_the_rules_of_gsplat_finds_images_cameras_and_points(laid_out):
    root, out = laid_out
    found = load_as_gsplat(out / "set")
    assert found.names == [f"{n:02}.png" for n in range(FIRST)]
    for path in found.paths:
        assert path.read_bytes() == (root / "set" / path.name).read_bytes()
    truth = [MixedMatcher().scenes[0].cameras[f"{n:04}"] for n in range(FIRST)]
    # Relative poses do not depend on the world's axes.
    turned = found.camera_to_world[3, :3, :3].T @ found.camera_to_world[0, :3, :3]
    np.testing.assert_allclose(turned, truth[3].R @ truth[0].R.T, atol=0.01)
    for K, camera in zip(found.intrinsics, truth, strict=True):
        assert K[0, 0] == pytest.approx(camera.K[0, 0], rel=0.03)
    assert len(found.points) > 100
    # All images are flat and gray; a point has the mean of those that see it.
    greys = [float(cv2.imread(str(path)).mean()) for path in found.paths]
    assert min(greys) - 1 <= found.colours.min() <= found.colours.max() <= max(greys) + 1


def test_pycolmap_reads_each_model_with_plain_names(laid_out):
    _, out = laid_out
    for number in range(2):
        model = pycolmap.Reconstruction(out / "set" / "sparse" / str(number))
        original = pycolmap.Reconstruction(out / "set" / "models" / str(number))
        names = {image.name for image in model.images.values()}
        assert {f"set/{name}" for name in names} == {
            image.name for image in original.images.values()
        }, "the models for COLMAP have paths below the folder"
        assert model.num_points3D() == original.num_points3D()


def test_links_follow_the_folder_and_nothing_of_the_users_is_removed(tmp_path):
    root = write_flat(tmp_path / "images", 3)
    files = sorted(root.iterdir())
    out = tmp_path / "out"
    write_images(out, files)
    (out / "images" / "mine.txt").write_text("mine")
    write_images(out, files[1:])
    assert sorted(path.name for path in (out / "images").iterdir()) == [
        "01.png",
        "02.png",
        "mine.txt",
    ]
    assert (out / "images" / "01.png").readlink() == files[1].resolve()
    # A link to the former path would lead nowhere.
    moved = files[1].rename(tmp_path / "01.png")
    write_images(out, [moved, files[2]])
    assert (out / "images" / "01.png").readlink() == moved.resolve()


def test_where_links_fail_there_are_copies(tmp_path, monkeypatch):
    # As on a file system without links, such as a USB stick's
    def refuse(*_: object) -> None:
        raise OSError(1, "Operation not permitted")

    monkeypatch.setattr(Path, "symlink_to", refuse)
    (file, *_) = sorted(write_flat(tmp_path / "from", 1).iterdir())
    for content in (file.read_bytes(), b"changed"):
        file.write_bytes(content)
        write_images(tmp_path / "out", [file])
        copy = tmp_path / "out" / "images" / file.name
        assert not copy.is_symlink()
        assert copy.read_bytes() == content


def test_a_copy_that_was_cut_off_leaves_nothing(tmp_path, monkeypatch):
    def refuse(*_: object) -> None:
        raise OSError(1, "Operation not permitted")

    def copy_a_part(_: Path, part: Path) -> None:
        part.write_bytes(b"a part")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "symlink_to", refuse)
    monkeypatch.setattr(layout.shutil, "copy2", copy_a_part)
    files = sorted(write_flat(tmp_path / "from", 1).iterdir())
    with pytest.raises(OSError, match="No space left"):
        write_images(tmp_path / "out", files)
    assert list((tmp_path / "out" / "images").iterdir()) == []


def test_a_copy_that_cannot_fit_is_not_begun(tmp_path, monkeypatch):
    folder = tmp_path / "out" / "images"
    folder.mkdir(parents=True)
    # An earlier copy is in the place of the link.
    (folder / "00.png").write_bytes(b"a copy")
    huge = tmp_path / "00.png"
    with huge.open("wb") as stream:
        # Without blocks of the disk, but a copy would have them all
        stream.truncate(1 << 40)
    monkeypatch.setattr(layout.shutil, "copy2", lambda *_: pytest.fail("the copy was begun"))
    with pytest.raises(OSError, match="No space left"):
        write_images(tmp_path / "out", [huge])
    assert (folder / "00.png").read_bytes() == b"a copy"


def test_a_model_that_cannot_be_read_is_a_line_and_the_former_folder_stays(tmp_path, laid_out):
    _, out = laid_out
    folder = tmp_path / "set"
    (folder / "models" / "0").mkdir(parents=True)
    (folder / "sparse" / "0").mkdir(parents=True)
    (folder / "sparse" / "0" / "points3D.bin").write_text("former")
    # pycolmap ends its process on some damage; here it raises.
    (folder / "models" / "0" / "cameras.bin").write_text("damaged")
    assert write_sparse(folder, {}, None) != ""
    assert (folder / "sparse" / "0" / "points3D.bin").read_text() == "former"
    assert write_sparse(out / "set", {}, 0.0) == "no time was left"


def test_a_killed_undistortion_leaves_no_picture_behind(tmp_path):
    left = tmp_path / ".mkpc-new-killed" / "images"
    left.mkdir(parents=True)
    (left / "a.jpg").write_bytes(b"undistorted")
    write_sparse(tmp_path, {}, None)
    assert list(tmp_path.iterdir()) == []


def test_a_killed_copy_leaves_no_part_behind(tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / ".mkpc-new-a.jpg").write_bytes(b"a part")
    write_images(tmp_path, [])
    assert list((tmp_path / "images").iterdir()) == []


def test_a_folder_called_images_below_another_dataset_keeps_its_place(tmp_path):
    # OUT/images would be both a dataset and links.
    root = write_flat(tmp_path / "in", 4)
    write_flat(root / "images", 4)
    run(root, tmp_path / "out")
    lines = list(write_layouts(tmp_path / "out", root, read_folder(root), inf))
    assert [line for line in lines if "belongs to another dataset" in line] == lines
    assert len(lines) == 1
    assert (tmp_path / "out" / "images" / "sparse" / "0" / "cameras.bin").exists()
    assert not (tmp_path / "out" / "images" / "00.png").exists()


@pytest.mark.parametrize("dataset", [".", "set"])
def test_a_folder_that_grew_keeps_its_coordinates(tmp_path, dataset):
    root = tmp_path / "images"
    out = tmp_path / "out"
    folder = write_flat(root / dataset, FIRST)
    away = (folder / "05.png").rename(tmp_path / "05.png")
    before = run(root, out)
    assert list(keep_coordinates(out, root, before)) == [], "nothing to compare with"
    away.rename(folder / "05.png")
    after = run(root, out)
    (line,) = keep_coordinates(out, root, after)
    name = "images" if dataset == "." else dataset
    assert line.startswith(f"{name}: 5 cameras keep the coordinates of the last run and moved by ")
    old = cameras(before)
    new = cameras(after)
    assert (len(old), len(new)) == (5, 6)
    # Cameras move a little, since there are more matches.
    size = np.std([each.camera.centre for each in old.values()], axis=0).max()
    for name, found in old.items():
        np.testing.assert_allclose(new[name].camera.centre, found.camera.centre, atol=0.02 * size)
        np.testing.assert_allclose(new[name].camera.R, found.camera.R, atol=0.02)
    model = pycolmap.Reconstruction(out / dataset / "models" / "0")
    poses = {
        Path(image.name).name: image.cam_from_world().matrix() for image in model.images.values()
    }
    for name, found in new.items():
        np.testing.assert_allclose(
            poses[name][:, 3], found.camera.t, atol=1e-9, err_msg="files and tables agree"
        )
    forget_coordinates(out, [dataset])
    assert not (out / dataset / REFERENCE).exists()


def test_a_device_is_not_copied(tmp_path):
    # A copy of an earlier run is in the place of the link. /dev/zero would fill the disk here.
    folder = tmp_path / "out" / "images"
    folder.mkdir(parents=True)
    (folder / "0.png").write_bytes(b"a copy")
    device = tmp_path / "0.png"
    device.symlink_to("/dev/null")
    write_images(tmp_path / "out", [device])
    assert (folder / "0.png").read_bytes() == b"a copy"
    assert [path.name for path in folder.iterdir()] == ["0.png"]


def test_names_in_the_layout_are_unique_and_ascii():
    files = [
        Path("in/a.jpg"),
        Path("in/\N{LATIN SMALL LETTER E WITH ACUTE}1.jpg"),
        Path("in/e1.jpg"),
        Path("in/\N{CJK UNIFIED IDEOGRAPH-6A4B}.jpg"),
        Path("in/100/b.jpg"),
        Path("in/101/b.jpg"),
    ]
    names = [*link_names(files).values()]
    assert names == ["a.jpg", "e1_2.jpg", "e1.jpg", "_.jpg", "100_b.jpg", "101_b.jpg"]


def test_a_photograph_with_an_accent_has_an_ascii_name_for_other_programs(tmp_path):
    root = write_flat(tmp_path / "images", FIRST)
    name = "00\N{LATIN SMALL LETTER E WITH ACUTE}.png"
    (root / "00.png").rename(root / name)
    run(root, tmp_path / "out")
    assert list(write_layouts(tmp_path / "out", root, read_folder(root), inf)) == []
    found = load_as_gsplat(tmp_path / "out")
    assert "00e.png" in found.names
    assert all(path.is_file() for path in found.paths)
    original = pycolmap.Reconstruction(tmp_path / "out" / "models" / "0")
    assert name in {image.name for image in original.images.values()}


def test_points_of_webp_photographs_have_their_colours(tmp_path):
    root = write_flat(tmp_path / "images", FIRST)
    for path in root.iterdir():
        # The name says PNG: some programs save WebP under any name.
        path.write_bytes(
            cv2.imencode(".webp", cv2.imread(str(path)), [cv2.IMWRITE_WEBP_QUALITY, 101])[1]
        )
    run(root, tmp_path / "out")
    assert list(write_layouts(tmp_path / "out", root, read_folder(root), inf)) == []
    found = load_as_gsplat(tmp_path / "out")
    greys = [float(cv2.imread(str(path)).mean()) for path in found.paths]
    assert 0 < min(greys) - 1 <= found.colours.min() <= found.colours.max() <= max(greys) + 1
