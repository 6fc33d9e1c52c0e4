"""What a match offers: a relative pose, keypoints with indices, descriptors, a plot."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from rectified import RectifiedMatcher
from scipy.spatial.transform import Rotation
from sklearn.datasets import load_sample_image

from mkpc_kaggle import TwoStageMatcher
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Size
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.robust import FailedEstimate, ModelKind
from mkpc_kaggle.matchers.adapters.sift import SiftMatcher, SiftOptions
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
    failed = replace(pair, estimate=FailedEstimate.of(pair.estimate))
    with pytest.raises(UserError, match="no F was found: not estimated yet"):
        failed.pose(K0, K1)
    with pytest.raises(ValueError, match=r"intrinsics\[1\] has the shape \(2, 3\)"):
        pair.pose(K0, K1[:2])


def photographs(shift=30):
    whole = load_sample_image("china.jpg")
    return whole[60:300, 60:400], whole[60:300, 60 + shift : 400 + shift]


def test_keypoints_have_the_points_of_matches_at_their_indices():
    recipe = Recipe(
        (Unit(1, "sift", 320), Unit(1, "sift", 400, max_matches=50), Unit(2, "sift", 300))
    )
    match = TwoStageMatcher(recipe)(*photographs())
    keypoints = match.keypoints
    for side, points in enumerate((match.matches.points0, match.matches.points1)):
        own = (keypoints.points0, keypoints.points1)[side]
        assert len(own) > len(points)
        np.testing.assert_array_equal(own[keypoints.indices[:, side]], points)
    assert keypoints.descriptors0 is None
    # Of one unit: the numbers that its result states.
    for result in match.results:
        assert len(result.detected.points0) == result.keypoints
        np.testing.assert_array_equal(
            result.detected.points1[result.detected.indices[:, 1]], result.matches.points1
        )


def test_descriptors_come_on_request_and_explain_the_matches():
    matcher = TwoStageMatcher(SIFT)
    images = photographs()
    for match in (
        matcher(*images, descriptors=True),
        *matcher.match_pairs([images], descriptors=True),
    ):
        found = match.keypoints
        assert found.descriptors0.shape == (len(found.points0), 128)
        assert found.descriptors1.shape == (len(found.points1), 128)
        # Mutual nearest neighbours by their cosine
        similarity = found.descriptors0 @ found.descriptors1.T
        index0, index1 = found.indices.T
        best = similarity[index0].max(axis=1)
        np.testing.assert_allclose(similarity[index0, index1], best, atol=1e-5)
    assert matcher(*images).keypoints.descriptors0 is None


def test_matchers_without_keypoints_have_no_indices_and_others_keep_theirs():
    units = (Unit(1, "rectified", 320), Unit(1, "sift", 320))
    matchers = {"rectified": RectifiedMatcher(), "sift": SiftMatcher(SiftOptions(), "cpu")}
    match = TwoStageMatcher(Recipe(units), matchers=matchers)(*photographs())
    first = len(match.results[0].matches)
    assert first > 0
    assert (match.keypoints.indices[:first] == -1).all()
    rest = match.keypoints.indices[first:]
    points = match.matches.points0[first:]
    np.testing.assert_array_equal(match.keypoints.points0[rest[:, 0]], points)


def test_a_match_of_files_plots_itself_and_others_need_their_images(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    images = photographs()
    monkeypatch.chdir(tmp_path)
    for name, image in zip("ab", images, strict=True):
        cv2.imwrite(f"{name}.png", image[..., ::-1])
    matcher = TwoStageMatcher(Recipe((Unit(1, "sift", 320), Unit(2, "sift", 320))))
    of_files = matcher("a.png", "b.png")
    (of_pairs,) = matcher.match_pairs([("a.png", images[1])])
    of_arrays = matcher(*images)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    for figure in (of_files.plot(), of_arrays.plot(*images), of_pairs.plot(image1=images[1])):
        panel = figure.axes[0]
        assert f"{of_files.estimate.inlier_count} inliers" in panel.get_title(loc="left")
        assert len(panel.images) == 2
        figure.savefig("x.png")
    with pytest.raises(ValueError, match=r"not of files: call plot\(image0, image1\)"):
        of_arrays.plot()
    with pytest.raises(ValueError, match="image1 has another size"):
        of_arrays.plot(images[0], images[1][:-1])
    (tmp_path / "a.png").unlink()
    with pytest.raises(UserError, match=r"a\.png: no such file"):
        of_files.plot()
