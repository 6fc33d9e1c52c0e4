"""The focal lengths that cameras start with, by EXIF or not, and the cameras that images are told
to share.
"""

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
from mkpc_kaggle.scene.reconstruct import reconstruct_batch, reconstruct_sharing
from mkpc_kaggle.scene.shared_intrinsics import given_intrinsics
from mkpc_kaggle.scene.view_graph import BatchImage, ViewGraph

IMAGES = [
    BatchImage(f"{n}", f"{n}", SIZE, focal) for n, focal in enumerate((0.0, 900.0, 1000.0, 1040.0))
]
TALL = BatchImage("tall", "tall", Size(*reversed(SIZE)))
# Without EXIF
GUESS = 1.1 * max(SIZE)


def config(cameras: str) -> SceneConfig:
    scene = for_cameras(Recipe((Unit(1, "sift", 640),)), cameras).scene
    assert scene is not None
    return scene


def focals_of(directory: Path, settings: SceneConfig) -> list[float]:
    """The focal length that each image's camera starts with, and the number of cameras."""
    graph = ViewGraph((*IMAGES, TALL), ())
    write_files(directory, MergedGraph(graph), given_intrinsics(graph.images, settings), [])
    with pycolmap.Database.open(str(directory / "database.db")) as database:
        known = {camera.camera_id: camera.focal_length for camera in database.read_all_cameras()}
        return [*(known[image.camera_id] for image in database.read_all_images()), len(known)]


@pytest.mark.parametrize(
    ("cameras", "focals"),
    [
        ("auto", [GUESS, 900, 1000, 1040, GUESS, 5]),
        ("folder", [1000] * 4 + [GUESS, 2]),  # the median of each size
    ],
)
def test_cameras_start_with_the_focal_length_of_exif(tmp_path, cameras, focals):
    assert focals_of(tmp_path, config(cameras)) == pytest.approx(focals)


def test_a_focal_length_of_exif_is_not_fixed():
    scene = synthetic_scene(5, points=500)

    def told(image):
        return replace(image, focal=1.08 * float(scene.cameras[image.name].K[0, 0]))

    pairs = [
        replace(pair, image0=told(pair.image0), image1=told(pair.image1)) for pair in scene.pairs
    ]
    solution = reconstruct_batch(pairs, config("image"))
    found = registered_images(solution)
    assert len(found) == 5
    for image in scene.images:
        assert found[image.digest].focal == pytest.approx(
            scene.cameras[image.name].K[0, 0], rel=0.03
        )


def test_images_that_one_camera_took_have_one_focal_length_however_few_they_are():
    scene = synthetic_scene(4, points=500, focals=[900.0] * 4)
    graph = ViewGraph.of_pairs(scene.pairs)
    # Four images: too few for the detection of a common focal length
    alone, together = (reconstruct_sharing(graph, config(name)) for name in ("image", "folder"))
    assert alone[1] == {}
    focals = [
        [image.focal for image in found[0].models[0].images] for found, _ in (alone, together)
    ]
    assert len(set(focals[0])) == len(focals[0]) == 4
    assert focals[1] == pytest.approx([focals[1][0]] * 4)
    assert focals[1][0] == pytest.approx(900, rel=0.03)
    assert together[1] == {image.digest: focals[1][0] for image in graph.images}
