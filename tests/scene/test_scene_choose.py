"""Which F a pair gets, which cameras are rejected, and the settings' keys."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from benchmarks.synthetic_scene import SIZE, SyntheticScene, synthetic_scene
from mkpc_kaggle.geometry.cameras import Camera
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.scene.choose import Choice, Reason, choose, contradicts
from mkpc_kaggle.scene.models import (
    RegisteredImage,
    SfmModel,
    filter_models,
)
from mkpc_kaggle.scene.view_graph import BatchImage, BatchPair


@pytest.fixture(scope="module")
def scene() -> SyntheticScene:
    return synthetic_scene(4, points=600, outliers=0.3)


def model(cameras: dict[str, Camera], points: int = 100) -> SfmModel:
    """Return a model with these cameras by name. Each camera sees all points."""
    registered = []
    for name, camera in cameras.items():
        image = BatchImage(name, f"digest of {name}", SIZE)
        registered.append(RegisteredImage(image, camera, points))
    return SfmModel(tuple(registered), np.zeros((points, 3)), 0.5)


def choice(models: list[SfmModel], scene: SyntheticScene, **changes: object) -> Choice:
    """Return the choice for the pair of images 0000 and 0001, with fields of the pair changed."""
    registered = []
    for each in models:
        by_digest = {found.image.digest: found for found in each.images}
        registered.append(by_digest)
    pair = replace(scene.pairs[0], **changes)
    return choose(pair, registered)


def test_a_pair_whose_cameras_make_no_fundamental_keeps_its_own(scene):
    first = scene.cameras["0000"]
    second = scene.cameras["0001"]
    all_but_first = {name: camera for name, camera in scene.cameras.items() if name != "0000"}
    assert choice([], scene).reason is Reason.UNREGISTERED
    incomplete = [model(all_but_first)]
    assert choice(incomplete, scene).reason is Reason.UNREGISTERED
    # The relative pose of two models is unknown.
    apart = [model({"0000": first}), model({"0001": second})]
    assert choice(apart, scene).reason is Reason.APART
    complete = [model(scene.cameras)]
    # A pair of an image with itself
    twice_the_first = choice(complete, scene, image1=scene.images[0])
    assert twice_the_first.reason is Reason.SAME_IMAGE
    # Without a baseline F is zero.
    together = [model(scene.cameras | {"0001": first})]
    assert choice(together, scene).reason is Reason.SAME_CENTRE


def test_a_wrong_camera_is_contradicted_by_the_pairs_matches(scene):
    camera = scene.cameras["0001"]
    # Enough that few matches stay near their epipolar lines.
    angles = np.array([np.radians(15), 0, 0])
    tilt, _ = cv2.Rodrigues(angles)
    tilted = Camera(camera.K, tilt @ camera.R, tilt @ camera.t)
    wrong = [model(scene.cameras | {"0001": tilted})]
    true_F = scene.true_fundamental(scene.pairs[0])
    assert choice(wrong, scene, pair_fundamental=true_F).reason is Reason.CONTRADICTION
    # Without an F of the pair, nothing contradicts the scene's.
    assert choice(wrong, scene).from_scene


# Images have 800 x 600 pixels, so 1e5 is a field of view below half a degree.
@pytest.mark.parametrize("focal", [-900.0, 0.0, 1e5, np.nan])
def test_an_absurd_focal_length_is_left_out(scene, focal):
    K = np.diag([focal, focal, 1.0])
    absurd = replace(scene.cameras["0000"], K=K)
    with_absurd = model(scene.cameras | {"0000": absurd})
    (kept,) = filter_models((with_absurd,))
    names = [found.image.name for found in kept.images]
    assert names == ["0001", "0002", "0003"]


def test_a_model_that_is_too_small_is_left_out(scene):
    two = {name: scene.cameras[name] for name in ("0000", "0001")}
    small = model(two)
    large = model(scene.cameras)
    kept = filter_models((small, large))
    sizes = [len(each.images) for each in kept]
    assert sizes == [4]


# F of a camera that moves along x, whose lines are the rows, and along y, whose lines are the columns
ALONG_X = np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0]]) / np.sqrt(2)
ALONG_Y = np.array([[0, 0, 1], [0, 0, 0], [-1, 0, 0]]) / np.sqrt(2)


def moved(along_y: int, along_x: int, pixels: float = 40.0) -> Matches:
    """Return matches that agree with ALONG_Y, and others that agree with ALONG_X."""
    points = (
        np.random.default_rng(0).uniform(50, 400, (along_y + along_x, 2)).astype(np.float32)
    )
    shift = np.zeros_like(points)
    shift[:along_y, 1] = pixels
    shift[along_y:, 0] = pixels
    return Matches(points, points + shift, np.ones(len(points), np.float32))


def pair_of(*by_unit: Matches, side: int = 640) -> BatchPair:
    images = (BatchImage(name, name, (side, side)) for name in "AB")
    return BatchPair(*images, by_unit, pair_fundamental=ALONG_Y)


@pytest.mark.parametrize(
    ("by_unit", "speaks_against"),
    [
        pytest.param([moved(100, 40)], True, id="less than half"),
        pytest.param([moved(100, 60)], False, id="more than half"),
        pytest.param([moved(40, 10)], False, id="too few matches"),
        # Cameras of one unit's points have its matches, whatever is right.
        pytest.param([moved(200, 40), moved(20, 30)], False, id="another unit disagrees"),
        pytest.param([moved(40, 0), moved(40, 30)], True, id="both units together"),
        pytest.param([moved(100, 40), Matches.empty()], True, id="a unit without matches"),
    ],
)
def test_half_of_the_evidence_speaks_against_the_scene(by_unit, speaks_against):
    assert contradicts(ALONG_X, pair_of(*by_unit)) is speaks_against


def test_the_evidence_of_a_larger_photograph_has_larger_errors():
    """A photograph of eight times the side has keypoints of eight times the error."""
    near = moved(0, 100)
    # 2.5 pixels from the rows: far in a small image, near in a large one
    off = replace(near, points1=near.points1 + np.array([0, 2.5], np.float32))
    by_unit = (Matches.concatenate([moved(100, 0), off]),)
    assert contradicts(ALONG_X, pair_of(*by_unit))
    assert not contradicts(ALONG_X, pair_of(*by_unit, side=8 * 1536))
