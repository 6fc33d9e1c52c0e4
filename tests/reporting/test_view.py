"""The interactive view: its data, and the page in a real browser."""

import base64
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from browser import Page, needs_browser, opened_browser

from mkpc_kaggle.engine.store.tables import SceneRecord
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.intrinsics import KnownCamera
from mkpc_kaggle.reporting.points import clouds_of
from mkpc_kaggle.reporting.view import picture_at, point_colours, show, view_data
from mkpc_kaggle.scene.models import MAX_POINTS, RegisteredImage, SfmModel, Sigmas
from mkpc_kaggle.scene.view_graph import BatchImage

SIZE = Size(400, 300)
WALL = 6.0  # distance of a wall of points
CAMERAS = 5


def a_model(folder: Path, points: int = 2000, cameras: int = CAMERAS) -> SfmModel:
    """Cameras in a row that look at a wall; the wall is red to the left and blue to the right."""
    rng = np.random.default_rng(0)
    # All points in a plane, and the cameras in a row before it
    cloud = np.column_stack(
        [rng.uniform(-3, 3, points), rng.uniform(-2, 2, points), np.full(points, WALL)]
    )
    K = np.array(
        [
            [400.0, 0, 199.5],
            [0, 400.0, 149.5],
            [0, 0, 1],
        ]
    )
    placed = []
    for number in range(cameras):
        path = folder / f"{number}.png"
        pixels = np.zeros((SIZE.height, SIZE.width, 3), np.uint8)
        x = (number - (cameras - 1) / 2) / 2
        # A pixel left of it sees the red half.
        left = int(199.5 + 400 * (0 - x) / WALL)  # of the wall's middle
        pixels[:, : max(left, 0)] = (0, 0, 255)
        pixels[:, max(left, 0) :] = (255, 0, 0)
        cv2.imwrite(str(path), pixels)
        camera = Camera(K, np.eye(3), np.array([-x, 0.0, 0.0]))
        sigmas = Sigmas(0.01, 0.002 * (1 + number), 0.3) if number else ()
        placed.append(
            RegisteredImage(BatchImage(str(path), str(number), SIZE), camera, points, sigmas)
        )
    return SfmModel(tuple(placed), cloud, 0.3)


def decoded(model: dict) -> tuple[np.ndarray, np.ndarray]:
    steps = np.frombuffer(base64.b64decode(model["points"]), "<i2").reshape(-1, 3)
    colours = np.frombuffer(base64.b64decode(model["colours"]), np.uint8).reshape(-1, 3)
    return steps * model["range"] / 32767, colours


def test_points_keep_their_shape_and_cameras_their_place_among_them(tmp_path):
    model = a_model(tmp_path)
    (shown,) = view_data([model], read=lambda _: None, partners={})["models"]
    points, _ = decoded(shown)
    # A view has its own scale and origin.
    scale = np.ptp(points[:, 0]) / np.ptp(model.points[:, 0])
    # The cameras look along z: the frame is not rotated
    offset = points[0] - scale * model.points[0]
    np.testing.assert_allclose(points, scale * model.points + offset, atol=1e-4)
    for camera, found in zip(shown["cameras"], model.images, strict=True):
        np.testing.assert_allclose(
            camera["centre"], scale * found.camera.centre + offset, atol=1e-4
        )
        assert camera["wide"] == pytest.approx(0.5)
    assert np.abs(points).max() <= 1.1


def test_only_the_longest_tracks_are_kept(tmp_path):
    model = a_model(tmp_path, points=MAX_POINTS + 500)
    data = view_data([model], read=lambda _: None, partners={})
    assert data["models"][0]["count"] == MAX_POINTS
    assert (
        len(data["models"][0]["points"]) + len(data["models"][0]["colours"]) == 4 * 3 * MAX_POINTS
    )


def test_points_have_the_colours_of_the_images(tmp_path):
    model = a_model(tmp_path)
    pictures = {
        found.image.name: cv2.imread(found.image.name)[:, :, ::-1] for found in model.images
    }
    colours = point_colours(model.points, model.images, pictures)
    # Near the border of the colours, a pixel decides.
    sides = np.abs(model.points[:, 0]) > 0.1
    is_left = model.points[:, 0] < 0
    np.testing.assert_array_equal(
        colours[sides & is_left], np.tile([255, 0, 0], (np.sum(sides & is_left), 1))
    )
    np.testing.assert_array_equal(
        colours[sides & ~is_left], np.tile([0, 0, 255], (np.sum(sides & ~is_left), 1))
    )


def test_points_and_colours_come_from_the_files_of_a_reconstruction(tmp_path):
    settings = {
        "num_rigs": 1,
        "num_cameras_per_rig": 1,
        "num_frames_per_rig": 5,
        "num_points3D": 40,
    }
    model = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(settings))
    for number, point in model.points3D.items():
        point.color = np.array([number, 2 * number, 3 * number], np.uint8)
        # Tracks of different lengths
        for element in point.track.elements[: number % 3]:
            model.delete_observation(element.image_id, element.point2D_idx)
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    model.write(tmp_path / "sparse" / "0")
    scene = SceneRecord("set", points=40, models=(a_model(tmp_path),))
    (cloud,) = clouds_of(scene, tmp_path)
    expected = sorted(model.points3D.items(), key=lambda item: (-item[1].track.length(), item[0]))
    np.testing.assert_array_equal(cloud.points, [point.xyz for _, point in expected])
    np.testing.assert_array_equal(cloud.colours, [point.color for _, point in expected])
    assert clouds_of(replace(scene, points=41), tmp_path) == (), "of another run"
    path = tmp_path / "sparse" / "0" / "points3D.bin"
    for damaged in (path.read_bytes()[:-100], b"", b"\xff" * 100):
        path.write_bytes(damaged)
        assert clouds_of(scene, tmp_path) == ()


def test_degenerate_models_give_a_view_of_finite_numbers(tmp_path):
    model = a_model(tmp_path, cameras=3)
    at_one_point = tuple(replace(each, camera=model.images[0].camera) for each in model.images)
    upside_down = Camera(model.images[0].camera.K, np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    # No common vertical, and no common direction
    opposed = (model.images[0], replace(model.images[1], camera=upside_down))
    for images, points in ((at_one_point, np.zeros((0, 3))), (opposed, model.points)):
        made = SfmModel(images, points, 0.0)
        (shown,) = view_data([made], read=lambda _: None, partners={})["models"]
        values = [
            number
            for camera in shown["cameras"]
            for row in (camera["centre"], *camera["R"])
            for number in row
        ]
        assert np.isfinite(values).all()


def test_a_notebook_shows_the_view_in_a_frame_without_access_to_the_notebook(tmp_path):
    html = show([a_model(tmp_path)])._repr_html_()
    assert html.startswith('<iframe sandbox="allow-scripts" ')
    (inner,) = re.findall(r'srcdoc="([^"]*)"', html)
    assert "&lt;canvas" in inner


def test_names_from_files_are_escaped(tmp_path):
    model = a_model(tmp_path, cameras=2)
    # A name that ends the script of the data
    evil = "</script><script>alert(1)</script>"
    image = replace(model.images[0].image, name=evil)
    page = show(
        [replace(model, images=(replace(model.images[0], image=image), model.images[1]))]
    ).page
    assert "<script>alert" not in page
    assert page.count("</script>") == 2, "of the data, and of the program"


CANVAS = "document.querySelector('canvas')"
PIXELS = f"""(() => {{
    const canvas = {CANVAS}, data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
    let sum = 7, lit = 0;
    for (let i = 0; i < data.length; i += 4) {{
        sum = (sum * 31 + data[i] + 256 * data[i + 1] + 65536 * data[i + 2]) % 4294967291;
        lit += data[i] + data[i + 1] + data[i + 2] > 150;
    }}
    return [sum, lit];
}})()"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Page]:
    with opened_browser() as page:
        yield page


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("view")
    model = a_model(folder)
    # Two models stand side by side, without a bar.
    show([model, a_model(folder)], metres_per_unit=2.0).save(folder / "view.html")
    show([model], metres_per_unit=2.0).save(folder / "one.html")
    return folder / "view.html"


def middle(browser: Page) -> tuple[float, float]:
    x, y, width, height = browser.value(
        f"(({{x, y, width, height}}) => [x, y, width, height])({CANVAS}.getBoundingClientRect())"
    )
    return x + width / 2, y + height / 2


def find_camera(browser: Page, x: float, y: float) -> tuple[float, float]:
    """Return a position below the middle at which the view names a camera."""
    # Cameras are before the wall, so they are drawn lower.
    for dy in range(0, 260, 8):
        for dx in range(-160, 170, 8):
            browser.mouse("moved", x + dx, y + dy)
            if not browser.value("document.querySelector('.tip').hidden"):
                return x + dx, y + dy
    raise AssertionError("no camera under the pointer")


@needs_browser
@pytest.mark.parametrize("width", [1280, 400])
def test_the_view_draws_and_turns_zooms_and_moves_by_mouse(browser, page, width):
    browser.open(page, width)
    x, y = middle(browser)
    states = [browser.value(PIXELS)]
    assert states[0][1] > 500, "points and cameras are drawn"
    browser.drag(x, y, 80)
    states.append(browser.value(PIXELS))
    browser.mouse("wheel", x, y, deltaX=0, deltaY=-200)
    browser.drag(x, y, 0, 40)
    states.append(browser.value(PIXELS))
    # Keys turn, too; the button undoes all of it.
    browser.ask("Input.dispatchKeyEvent", type="keyDown", key="ArrowLeft")
    browser.value("document.querySelector('.reset').click()")
    browser.drag(x, y, 1)  # waits for a frame
    assert browser.value(PIXELS) == states[0], "the button shows the whole scene again"
    assert len({total for total, _ in states}) == len(states), "each changes the picture"
    assert browser.value("document.documentElement.scrollWidth") <= width
    assert browser.errors == []
    assert all(address.startswith(("file:", "data:")) for address in browser.requests)


@needs_browser
def test_hover_names_an_image_a_click_shows_it_and_a_double_click_looks_through_it(browser, page):
    browser.open(page.with_name("one.html"), 1280)
    at = find_camera(browser, *middle(browser))
    name = browser.value("document.querySelector('.tip').textContent")
    assert re.fullmatch(r"\d\.png", name)
    assert browser.value("document.querySelector('.camera').hidden")
    browser.click(*at)
    text = browser.value("document.querySelector('.camera').textContent")
    assert name in text
    assert "expected errors" in text
    assert browser.value("document.querySelector('.camera img').naturalWidth") > 100
    before = browser.value(PIXELS)
    browser.click(*at, times=2)
    # Seen through its camera, the photograph covers the middle half of the wall in red and blue.
    after = browser.value(PIXELS)
    assert after[1] > 4 * before[1]
    assert browser.errors == []


@needs_browser
@pytest.mark.parametrize("width", [1280, 400])
def test_the_view_turns_and_zooms_by_touch(browser, page, width):
    browser.open(page, width, is_mobile=True)
    x, y = middle(browser)
    states = [browser.value(PIXELS)]
    browser.touch([(x, y)], [(x + 30, y)], [(x + 60, y + 10)])
    states.append(browser.value(PIXELS))
    browser.touch(
        [(x - 30, y), (x + 30, y)], [(x - 50, y), (x + 50, y)], [(x - 70, y), (x + 70, y)]
    )
    states.append(browser.value(PIXELS))
    assert len({total for total, _ in states}) == len(states)
    assert states[2][1] > states[1][1], "spread fingers enlarge"
    browser.touch([(x, y + 100)])
    assert browser.value("window.scrollY") == 0
    assert browser.errors == []


def test_a_picture_through_a_distorted_lens_is_shown_as_its_pinhole_sees_the_world(tmp_path):
    lens = KnownCamera("SIMPLE_RADIAL", (400.0, 200.0, 150.0, -0.2))
    plain = pycolmap.Camera(model=lens.model, width=400, height=300, params=lens.parameters)
    wider = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), plain)
    assert wider.width > 400
    ray = np.array([-0.35, -0.25, 1.0])
    # The photograph, and the file in OUT/images, which has no distortion
    seen = {"photograph": plain, "file of the results": wider}
    for name, camera in seen.items():
        path = tmp_path / f"{name}.png"
        rows, columns = np.mgrid[: camera.height, : camera.width]
        x, y = camera.img_from_cam(ray)
        spot = 255 * np.exp(-(((columns + 0.5 - x) ** 2 + (rows + 0.5 - y) ** 2) / 25))
        cv2.imwrite(str(path), spot.astype(np.uint8))
        model = a_model(tmp_path, cameras=3)
        image = replace(model.images[0], lens=lens)
        model = replace(model, images=(image, *model.images[1:]))
        data = view_data([model], read=lambda _, path=path: picture_at(str(path)), partners={})
        encoded = data["models"][0]["cameras"][0]["thumbnail"].partition(",")[2]
        jpeg = np.frombuffer(base64.b64decode(encoded), np.uint8)
        thumbnail = cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE)
        scale = thumbnail.shape[1] / 400
        assert thumbnail.shape == (round(300 * scale), round(400 * scale))
        row, column = np.unravel_index(int(thumbnail.argmax()), thumbnail.shape)
        # K of the camera, without distortion
        expected = np.array([200 - 0.35 * 400, 150 - 0.25 * 400]) * scale
        assert (column + 0.5, row + 0.5) == pytest.approx(tuple(expected), abs=1.5), name
