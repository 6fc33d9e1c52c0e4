"""Pictures and pinholes in place of cameras with distortion, for programs that know no other ones."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from mkpc_kaggle.data.images import Image, read_image
from mkpc_kaggle.reconstruction.layout import write_images, write_sparse
from mkpc_kaggle.reconstruction.undistort import encoded

SIZE = (320, 200)
LENSES = {
    "a.jpg": ("SIMPLE_RADIAL", [260.0, 160.0, 100.0, -0.2]),
    "b.png": ("OPENCV", [250.0, 255.0, 161.0, 99.0, -0.15, 0.02, 0.001, -0.001]),
    "c.jpg": ("SIMPLE_PINHOLE", [260.0, 160.0, 100.0]),
}
# A point of the world lies on the pixel of each image that shows it, far from the middle.
PIXELS = {"a.jpg": (40.0, 30.0), "b.png": (280.0, 170.0), "c.jpg": (100.0, 60.0)}


def write_dataset(home: Path) -> tuple[Path, Path]:
    """Write photographs with a bright spot each, and a model that sees the spots."""
    photographs = home / "photographs"
    photographs.mkdir()
    model = pycolmap.Reconstruction()
    for number, (name, (lens, parameters)) in enumerate(LENSES.items(), start=1):
        x, y = PIXELS[name]
        rows, columns = np.mgrid[: SIZE[1], : SIZE[0]]
        # COLMAP's pixels: (0.5, 0.5) is the middle of the first one.
        distance = np.hypot(columns + 0.5 - x, rows + 0.5 - y)
        spot = (255 * np.exp(-((distance / 4) ** 2))).astype(np.uint8)
        cv2.imwrite(str(photographs / name), np.stack([spot] * 3, axis=2))
        camera = pycolmap.Camera(
            model=lens, width=SIZE[0], height=SIZE[1], params=parameters, camera_id=number
        )
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=name, camera_id=number, image_id=number)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.array(PIXELS[name]))])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    out = home / "out"
    folder = out / "models" / "0"
    folder.mkdir(parents=True)
    model.write(folder)
    return photographs, out


def lay_out(photographs: Path, out: Path) -> None:
    write_images(out, sorted(photographs.iterdir()))
    assert write_sparse(out, {}, None) == ""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    photographs, out = write_dataset(tmp_path_factory.mktemp("undistorted"))
    lay_out(photographs, out)
    return photographs, out


def spot_of(path: Path) -> tuple[float, float]:
    """Return the middle of the bright spot of a picture, in COLMAP's pixels."""
    picture = read_image(path)
    assert isinstance(picture, Image)
    weights = picture.gray.astype(float) ** 2
    rows, columns = np.mgrid[: weights.shape[0], : weights.shape[1]]
    total = weights.sum()
    return (columns * weights).sum() / total + 0.5, (rows * weights).sum() / total + 0.5


def test_other_programs_get_pinholes_whose_pictures_show_the_same(dataset):
    _, out = dataset
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    original = pycolmap.Reconstruction(out / "models" / "0")
    for number, image in model.images.items():
        camera = image.camera
        assert camera.model_name in ("SIMPLE_PINHOLE", "PINHOLE")
        picture = read_image(out / "images" / image.name)
        assert isinstance(picture, Image)
        assert picture.size == (camera.width, camera.height)
        (point,) = image.points2D
        # The spot is where the model says, and its ray is that of the photograph.
        assert spot_of(out / "images" / image.name) == pytest.approx(point.xy, abs=0.3)
        ray = original.images[number].camera.cam_from_img(np.array(PIXELS[image.name]))
        np.testing.assert_allclose(camera.cam_from_img(point.xy), ray, atol=1e-4)


def test_photographs_of_pinholes_stay_links_and_no_photograph_changes(dataset):
    photographs, out = dataset
    assert (out / "images" / "c.jpg").is_symlink()
    for name in ("a.jpg", "b.png"):
        assert not (out / "images" / name).is_symlink()
        assert spot_of(photographs / name) == pytest.approx(PIXELS[name], abs=0.3)


def test_the_same_command_writes_the_same_bytes(dataset):
    photographs, out = dataset
    files = [*(out / "images").iterdir(), *(out / "sparse" / "0").iterdir()]
    before = {path: path.read_bytes() for path in files}
    lay_out(photographs, out)
    assert {path: path.read_bytes() for path in before} == before
    assert not list(out.glob(".mkpc*"))


@pytest.mark.parametrize("suffix", [".jpg", ".jfif", ".png", ".webp", ".tif", ".bmp", ".ppm"])
def test_pictures_of_all_formats_are_written(tmp_path, suffix):
    columns = np.tile(np.linspace(0, 255, 64, dtype=np.uint8), (48, 1))
    pixels = np.stack([columns, columns[:, ::-1], np.full_like(columns, 90)], axis=2)
    path = tmp_path / f"a{suffix}"
    path.write_bytes(encoded(pixels, suffix))
    picture = read_image(path)
    assert isinstance(picture, Image)
    assert np.abs(picture.pixels.astype(int) - pixels).mean() < 4


def test_a_camera_that_no_image_has_may_have_any_parameters(tmp_path):
    photographs, out = write_dataset(tmp_path)
    folder = out / "models" / "0"
    model = pycolmap.Reconstruction(folder)
    # As the mapper leaves one for an image of another kind
    parameters = [-1422.6, SIZE[0] / 2, SIZE[1] / 2]
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=SIZE[0], height=SIZE[1], params=parameters, camera_id=9
    )
    model.add_camera_with_trivial_rig(camera)
    model.write(folder)
    lay_out(photographs, out)
    written = pycolmap.Reconstruction(out / "sparse" / "0")
    assert len(written.images) == len(LENSES)
