"""What a match offers: a relative pose, a plot."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sklearn.datasets import load_sample_image

from mkpc_kaggle import TwoStageMatcher
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import ModelKind
from mkpc_kaggle.pipeline.pair import PairMatch, UnitResult, with_estimate
from mkpc_kaggle.recipe import Recipe, Unit

pytestmark = pytest.mark.usefixtures("nowhere_else")

K0 = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
K1 = np.array([[650.0, 0, 300], [0, 640, 250], [0, 0, 1]])
R = Rotation.from_rotvec([0.05, -0.2, 0.1]).as_matrix()
T = np.array([0.8, 0.1, 0.59160798])
SIFT = Recipe((Unit(1, "sift", 640),))


@pytest.fixture(scope="module")
def pair() -> PairMatch:
    """Exact matches of points in front of two cameras, and 20 wrong ones."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-2, -2, 4), (2, 2, 9), (200, 3))
    pixels = []
    for K, in_camera in ((K0, points), (K1, points @ R.T + T)):
        x = in_camera @ K.T
        pixels.append((x[:, :2] / x[:, 2:]).astype(np.float32))
    for side in pixels:
        side[:20] = rng.uniform(0, 480, (20, 2))
    found = UnitResult(SIFT.units[0], Matches(*pixels, np.ones(200)))
    return PairMatch((found,), sizes=(Size(640, 480), Size(640, 480)))


@pytest.mark.parametrize("model", ["F", "E"])
@pytest.mark.parametrize("form", [np.asarray, np.ndarray.tolist])
def test_the_pose_is_that_of_the_cameras(pair, model, form):
    kind = ModelKind(model)
    match = with_estimate(pair, SIFT, kind, (K0, K1) if model == "E" else None)
    pose = match.pose(form(K0), form(K1))
    np.testing.assert_allclose(pose.R, R, atol=2e-3)
    np.testing.assert_allclose(pose.t, T / np.linalg.norm(T), atol=1e-2)
    assert np.linalg.norm(pose.t) == pytest.approx(1)
    # A mask over the matches: inliers alone, and all of the true ones.
    assert pose.in_front.shape == (200,)
    assert not (pose.in_front & ~match.estimate.inliers).any()
    assert pose.in_front[20:].sum() > 170
    relative, direction, in_front = pose
    assert relative is pose.R and direction is pose.t and in_front is pose.in_front


def test_a_homography_and_a_failed_estimate_have_no_pose(pair):
    homography = with_estimate(pair, SIFT, ModelKind.H)
    if homography.estimate:
        with pytest.raises(ValueError, match="a homography has no single pose"):
            homography.pose(K0, K1)
    with pytest.raises(UserError, match="no pose: not estimated yet"):
        pair.pose(K0, K1)
    with pytest.raises(ValueError, match="inhomogeneous"):
        pair.pose(K0, K1[:2])


def photographs(shift=30):
    whole = load_sample_image("china.jpg")
    return whole[60:300, 60:400], whole[60:300, 60 + shift : 400 + shift]


def test_a_match_plots_itself_on_its_images(tmp_path):
    pytest.importorskip("matplotlib")
    images = photographs()
    for name, image in zip("ab", images, strict=True):
        cv2.imwrite(str(tmp_path / f"{name}.png"), image[..., ::-1])
    files = [tmp_path / "a.png", tmp_path / "b.png"]
    match = TwoStageMatcher(Recipe((Unit(1, "sift", 320), Unit(2, "sift", 320))))(*files)
    for given in (files, images):
        figure = match.plot(*given)
        assert f"{match.estimate.inlier_count} inliers" in figure.axes[0].get_title(loc="left")
        assert len(figure.axes[0].images) == 2
    figure.savefig(tmp_path / "x.png")
    with pytest.raises(ValueError, match="another size"):
        match.plot(images[0], images[1][:-1])
