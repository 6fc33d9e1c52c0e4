"""Initial focal lengths, with and without EXIF, and cameras that several images share."""

from dataclasses import replace
from pathlib import Path

import pycolmap
import pytest

from benchmarks.synthetic_scene import SIZE, registered_images, synthetic_scene
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.recipe import Recipe, SceneConfig, Unit
from mkpc_kaggle.reconstruction.run import for_cameras
from mkpc_kaggle.scene.colmap import write_files
from mkpc_kaggle.scene.keypoints import MergedGraph
from mkpc_kaggle.scene.sfm import reconstruct_batch, reconstruct_graph
from mkpc_kaggle.scene.shared_intrinsics import given_intrinsics
from mkpc_kaggle.scene.view_graph import BatchImage, ViewGraph

# The last number is the focal length by EXIF in pixels, 0 without EXIF.
IMAGES = [
    BatchImage("0", "0", SIZE, 0.0),
    BatchImage("1", "1", SIZE, 900.0),
    BatchImage("2", "2", SIZE, 1000.0),
    BatchImage("3", "3", SIZE, 1040.0),
]
# Another size, so another camera; also without EXIF.
TALL = BatchImage("tall", "tall", Size(SIZE.height, SIZE.width))
# Start without EXIF: 1.1 of the long side.
GUESS = 1.1 * max(SIZE)


def config(cameras: str) -> SceneConfig:
    recipe = Recipe((Unit(1, "sift", 640),))
    scene = for_cameras(recipe, cameras).scene
    assert scene is not None
    return scene


def start_focals(directory: Path, settings: SceneConfig) -> tuple[list[float], int]:
    """Return the focal length that each image's camera starts with, and the number of cameras."""
    graph = ViewGraph((*IMAGES, TALL), ())
    intrinsics = given_intrinsics(graph.images, settings)
    write_files(directory, MergedGraph(graph), intrinsics, [], settings)
    with pycolmap.Database.open(str(directory / "database.db")) as database:
        cameras = database.read_all_cameras()
        images = database.read_all_images()
    focal_of = {camera.camera_id: camera.focal_length for camera in cameras}
    return [focal_of[image.camera_id] for image in images], len(cameras)


@pytest.mark.parametrize(
    ("cameras", "focals", "count"),
    [
        ("auto", [GUESS, 900, 1000, 1040, GUESS], 5),
        # One camera for each size, with the median of its focal lengths by EXIF.
        ("folder", [1000, 1000, 1000, 1000, GUESS], 2),
    ],
)
def test_cameras_start_with_the_focal_length_of_exif(tmp_path, cameras, focals, count):
    found_focals, found_count = start_focals(tmp_path, config(cameras))
    assert found_focals == pytest.approx(focals)
    assert found_count == count


def test_a_focal_length_of_exif_is_not_fixed():
    scene = synthetic_scene(5, points=500)

    def with_exif(image: BatchImage) -> BatchImage:
        # Wrong by 8 %, more than twice the tolerance below: a fixed focal length fails the test.
        true_focal = float(scene.cameras[image.name].K[0, 0])
        return replace(image, focal=1.08 * true_focal)

    pairs = []
    for pair in scene.pairs:
        image0 = with_exif(pair.image0)
        image1 = with_exif(pair.image1)
        pairs.append(replace(pair, image0=image0, image1=image1))
    solution = reconstruct_batch(pairs, config("image"))
    registered = registered_images(solution)
    assert len(registered) == 5
    for image in scene.images:
        true_focal = scene.cameras[image.name].K[0, 0]
        assert registered[image.digest].focal == pytest.approx(true_focal, rel=0.03)


def test_images_that_one_camera_took_have_one_focal_length_however_few_they_are():
    scene = synthetic_scene(4, points=500, focals=[900.0] * 4)
    graph = ViewGraph.of_pairs(scene.pairs)
    # Four images: too few for the detection of a common focal length.
    (alone,), nothing_shared = reconstruct_graph(graph, config("image"))
    assert nothing_shared == {}
    focals = [image.focal for image in alone.models[0].images]
    assert len(focals) == 4
    assert len(set(focals)) == 4

    (together,), shared = reconstruct_graph(graph, config("folder"))
    focals = [image.focal for image in together.models[0].images]
    assert focals == pytest.approx([focals[0]] * 4)
    assert focals[0] == pytest.approx(900, rel=0.03)
    assert shared == {image.digest: focals[0] for image in graph.images}
