"""Shared intrinsics: recognised by focal lengths, and kept only if they explain the matches."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
import pycolmap
import pytest

from benchmarks.synthetic_scene import (
    SyntheticScene,
    batch_of,
    front,
    pointed,
    registered_images,
    synthetic_scene,
)
from mkpc_kaggle.geometry.cameras import Camera, relative_pose
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.recipe import CameraSharing, SceneConfig
from mkpc_kaggle.scene import colmap
from mkpc_kaggle.scene.models import RegisteredImage, SfmModel
from mkpc_kaggle.scene.sfm import Solution, reconstruct_batch, reconstruct_graph
from mkpc_kaggle.scene.shared_intrinsics import shared_intrinsics, undecided_zooms
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair, ViewGraph

WIDE = Size(800, 600)
TALL = Size(600, 800)
FOCAL = 840.0
CONFIG = SceneConfig()
OWN = SceneConfig(cameras=CameraSharing.IMAGE)


def images(count: int, size: Size = WIDE, prefix: str = "") -> list[BatchImage]:
    return [
        BatchImage(f"{prefix}{number}", f"{prefix}{number}", size) for number in range(count)
    ]


def model(
    registered: Sequence[BatchImage], focals: Sequence[float], points: Sequence[int] = ()
) -> SfmModel:
    """Return a model of images with these focal lengths and numbers of points, by default 100."""
    points = points or [100] * len(focals)
    found = []
    for image, focal, seen in zip(registered, focals, points, strict=True):
        # Only the focal length and the number of points decide; poses do not.
        K = np.diag([focal, focal, 1.0])
        camera = Camera(K, np.eye(3), np.zeros(3))
        found.append(RegisteredImage(image, camera, seen))
    return SfmModel(tuple(found), np.zeros((0, 3)), 0.5)


def shared(*focals: float, points: Sequence[int] = ()) -> dict[str, float]:
    """Return the shared focal length by digest, of wide images reconstructed with these."""
    every = images(len(focals))
    reconstructed = model(every, focals, points)
    return dict(shared_intrinsics(every, [reconstructed]))


@pytest.mark.parametrize(
    ("focals", "points", "expected"),
    [
        ((838, 839, 840, 841, 842), (), dict.fromkeys("01234", 840)),
        # Few points say little: the image shares the camera at any focal length. With many
        # points, another focal length is another zoom.
        ((838, 840, 841, 2900, 880), (100, 100, 100, 4, 49), dict.fromkeys("01234", 841)),
        ((838, 840, 841, 420, 842), (100, 100, 100, 90, 100), dict.fromkeys("0124", 840)),
        ((), (), {}),
        # Four images of a size are one too few.
        ((FOCAL,) * 4, (), {}),
        # Two cameras with half of the images each
        ((840, 840, 840, 900, 900, 900), (), {}),
        ((600, 700, 840, 950, 1100), (), {}),
        # Impossible focal lengths
        ((-840,) * 3 + (np.nan,) * 3, (), {}),
    ],
)
def test_most_images_of_a_size_tell_its_focal_length(focals, points, expected):
    assert shared(*focals, points=points) == expected


def test_an_image_without_a_camera_shares_that_of_its_size():
    wide = images(6)
    tall = images(1, TALL, "tall")
    # Neither the sixth wide image nor the tall one is registered.
    registered = model(wide[:5], [FOCAL] * 5)
    found = shared_intrinsics([*wide, *tall], [registered])
    assert found == dict.fromkeys("012345", FOCAL)


# Focal lengths of EXIF: of the four images that agree, and of the last one, which seems to be zoomed
EXIF = {
    "unknown": (0, 0, dict.fromkeys("01234", 840), {"4"}),
    "the same": (800, 800, dict.fromkeys("01234", 840), set()),
    "rounded": (800, 840, dict.fromkeys("01234", 840), set()),
    "another zoom": (800, 1200, dict.fromkeys("0123", 840), set()),
    "unknown of the others": (0, 1200, dict.fromkeys("01234", 840), {"4"}),
}


@pytest.mark.parametrize(("exif", "last", "expected", "undecided"), EXIF.values(), ids=EXIF)
def test_exif_decides_whether_an_image_that_seems_zoomed_may_share(
    exif, last, expected, undecided
):
    every = [replace(image, focal=exif) for image in images(4)]
    every.append(replace(images(5)[4], focal=last))
    models = [model(every, [840, 839, 840, 841, 1200])]
    assert shared_intrinsics(every, models) == dict.fromkeys("0123", 840)
    assert shared_intrinsics(every, models, with_zoomed=True) == expected
    assert undecided_zooms(every, models) == undecided


def views(flat: bool, zoom: float = 1.0) -> list[BatchPair]:
    """Return the pairs of seven views of a wall; the middle one is frontal, and zoomed."""
    world = front(np.random.default_rng(0), 800)
    if flat:
        world[:, 2] = 0
    cameras = []
    for number in range(7):
        angle = np.radians(14 * (number - 3))
        height = 0.6 * np.sin(2.0 * number)
        centre = np.array([12 * np.sin(angle), height, -12 * np.cos(angle)])
        focal = zoom * FOCAL if number == 3 else FOCAL
        cameras.append(pointed(centre, -centre / np.linalg.norm(centre), focal))
    ends = list(combinations(range(7), 2))
    return list(batch_of(np.random.default_rng(1), world, cameras, ends, 0.4, 0.1).pairs)


def test_a_frontal_view_of_a_flat_scene_shares_the_focal_length_of_the_others():
    # Alone it has any focal length: the plane and the distance make up for it.
    assert max(focals_of(reconstruct_batch(views(flat=True), OWN))) > 1.2 * FOCAL
    found = focals_of(reconstruct_batch(views(flat=True), CONFIG))
    assert found == pytest.approx([FOCAL] * 7, rel=0.01)


def test_a_view_of_another_zoom_keeps_its_focal_length():
    found = focals_of(reconstruct_batch(views(flat=False, zoom=1.3), CONFIG))
    expected = [FOCAL] * 3 + [1.3 * FOCAL] + [FOCAL] * 3
    assert found == pytest.approx(expected, rel=0.01)


def focals_of(solution: Solution) -> list[float]:
    """Return the focal lengths of all registered images, in pixels."""
    focals = []
    for reconstruction in solution.reconstructions:
        for each in reconstruction.models:
            focals += [found.focal for found in each.images]
    return focals


def mean_angle(solution: Solution, scene: SyntheticScene) -> float:
    """Return the mean angle between the found and the true translation of a pair, in degrees."""
    angles = []
    registered = registered_images(solution)
    for pair in scene.pairs:
        camera0 = registered[pair.image0.digest].camera
        camera1 = registered[pair.image1.digest].camera
        _, found = relative_pose(camera0, camera1)
        _, true = relative_pose(*scene.true_cameras(pair))
        # Translations have no common scale, only a direction.
        cosine = found @ true / np.linalg.norm(found) / np.linalg.norm(true)
        angles.append(np.degrees(np.arccos(cosine)))
    return float(np.mean(angles))


def test_a_scene_with_shared_intrinsics_is_nearer_to_the_truth():
    # Few points with much noise: focal lengths of single images are uncertain.
    scene = synthetic_scene(7, 12, points=250, noise=1.0, focals=[FOCAL] * 7, seed=1)
    own = reconstruct_batch(scene.pairs, OWN)
    sharing = reconstruct_batch(scene.pairs, CONFIG)
    assert len(set(focals_of(own))) == 7
    (focal,) = set(focals_of(sharing))
    assert focal == pytest.approx(FOCAL, rel=0.01)
    assert mean_angle(sharing, scene) < 0.6 * mean_angle(own, scene)


@pytest.mark.parametrize(("least", "cameras"), [(0.99, 6), (0.0, 1)])
def test_shared_intrinsics_stay_unless_they_explain_fewer_points_and_the_files_are_of_what_stays(
    tmp_path, monkeypatch, least, cameras
):
    scene = synthetic_scene(6, points=300)
    # The images have different focal lengths, so sharing loses points.
    everything = {image.digest: FOCAL for image in scene.images}
    monkeypatch.setattr(
        "mkpc_kaggle.scene.shared_intrinsics.shared_intrinsics", lambda *_, **__: everything
    )
    monkeypatch.setattr("mkpc_kaggle.scene.shared_intrinsics.MIN_OBSERVATIONS", least)
    solution = reconstruct_batch(scene.pairs, CONFIG)
    assert len(set(focals_of(solution))) == cameras

    graph = ViewGraph.of_pairs(scene.pairs)
    (found,), _ = reconstruct_graph(graph, CONFIG, tmp_path)
    written = pycolmap.Reconstruction(tmp_path / "models" / "0").cameras.values()
    written_focals = {camera.focal_length for camera in written}
    assert written_focals == {image.focal for image in found.models[0].images}
    assert len(written) == cameras
    with pycolmap.Database.open(str(tmp_path / "database.db")) as database:
        assert database.num_cameras() == cameras


@pytest.fixture
def mappings(monkeypatch) -> list[int]:
    """The number of images of each run of the global mapper."""
    sizes = []
    run = colmap.run_mapper

    def counted(database, graph, config):
        sizes.append(len(graph.images))
        return run(database, graph, config)

    monkeypatch.setattr(colmap, "run_mapper", counted)
    return sizes


def test_an_incomplete_reconstruction_is_mapped_again_with_shared_intrinsics(mappings):
    scene = synthetic_scene(7, points=300, focals=[FOCAL] * 7)
    first = scene.images[0]
    # Random matches connect it with the scene, but no camera explains them.
    stray = BatchImage("stray", "stray", first.size)
    random = np.random.default_rng(0).uniform(0, 600, (2, 40, 2))
    points0, points1 = random.astype(np.float32)
    matches = Matches(points0, points1, np.ones(40, np.float32))
    wrong = BatchPair(first, stray, (matches,))
    (found,) = reconstruct_batch([*scene.pairs, wrong], CONFIG).reconstructions
    assert found.registered == 7
    assert mappings == [8, 8]


def test_shared_intrinsics_verify_no_edge_again(tmp_path, monkeypatch):
    verified = []
    estimate = pycolmap.estimate_two_view_geometry

    def counted(*arguments: object) -> object:
        verified.append(arguments)
        return estimate(*arguments)

    monkeypatch.setattr(pycolmap, "estimate_two_view_geometry", counted)
    scene = synthetic_scene(7, 15, points=250, focals=[FOCAL] * 7, seed=1)
    solution = reconstruct_batch(scene.pairs, CONFIG, folder=tmp_path)
    assert len(set(focals_of(solution))) == 1
    assert len(verified) == len(scene.pairs)
    with pycolmap.Database.open(str(tmp_path / "database.db")) as database:
        assert database.num_cameras() == 1
        for geometry in database.read_two_view_geometries()[1]:
            assert len(geometry.inlier_matches) > 15
            # Of the camera before, E would be wrong.
            assert geometry.E is None or not geometry.E.any()
