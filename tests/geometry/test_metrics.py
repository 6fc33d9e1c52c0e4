"""The scores, against answers known by construction or by hand."""

from math import inf, isnan

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.paper_tables import correct_matches
from mkpc_kaggle.geometry.cameras import Camera, fundamental_of_cameras, relative_pose
from mkpc_kaggle.geometry.matches import Matches
from mkpc_kaggle.geometry.metrics import (
    PoseError,
    pair_accuracy,
    pose_auc,
    pose_error,
    rotation_angle,
)

SEEDS = st.integers(0, 2**32 - 1)


def rotation(axis, degrees):
    direction = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    matrix, _ = cv2.Rodrigues(np.radians(degrees) * direction)
    return matrix


def random_camera(rng):
    focal, cx, ratio, cy = rng.uniform((300, 200, 0.8, 200), (3000, 900, 1.25, 900))
    K = np.array(
        [
            [focal, 0, cx],
            [0, focal * ratio, cy],
            [0, 0, 1],
        ]
    )
    axis = rng.normal(size=3)
    R = rotation(axis, rng.uniform(0, 180))
    t = 3 * rng.normal(size=3)
    return Camera(K, R, t)


def random_cameras(seed):
    rng = np.random.default_rng(seed)
    first = random_camera(rng)
    return first, random_camera(rng)


def at_origin(camera):
    """The camera of a pair's first image, for a wrong pose of the second one."""
    return Camera(camera.K, np.eye(3), np.zeros(3))


def errors(*angles):
    return [PoseError(angle, 0.0, 0.0) for angle in angles]


@pytest.mark.parametrize(
    ("rotation", "translation", "accuracy"),
    [
        (0, 0, 1.0),
        (0.999, 0.1999, 1.0),
        (1.0, 0, 0.9),  # on a threshold is not within it
        (0, 0.2, 0.9),
        (9.999, 0, 0.1),
        (10.001, 0, 0.0),
        (0, 4.999, 0.1),
        (0, 5.001, 0.0),
        # Both errors must meet a pair of thresholds: the translation decides
        (4.5, 0.2 * 25 ** (6.5 / 9), 0.3),
        (7.5, 0.5, 0.3),  # here the rotation
        (inf, inf, 0.0),
    ],
)
def test_the_accuracy_of_a_pair_is_the_share_of_threshold_pairs_that_it_meets(
    rotation, translation, accuracy
):
    found = pair_accuracy(PoseError(rotation, 0.0, translation))
    assert found == pytest.approx(accuracy, abs=1e-12)


@given(seed=SEEDS)
@settings(max_examples=60, deadline=None)
def test_the_fundamental_matrix_of_two_cameras_meets_the_epipolar_constraint(seed):
    cameras = random_cameras(seed)
    F = fundamental_of_cameras(*cameras)
    rng = np.random.default_rng(seed)
    X = 10 * rng.normal(size=(50, 3))
    projected = []
    for camera in cameras:
        x = (X @ camera.R.T + camera.t) @ camera.K.T
        # Homogeneous and of norm 1: some points are behind a camera or near its plane.
        projected.append(x / np.linalg.norm(x, axis=1, keepdims=True))
    x0, x1 = projected
    lines = x0 @ F.T
    residual = np.abs(np.sum(x1 * lines, axis=1))
    assert (residual < 1e-9 * np.linalg.norm(F)).all()
    # A matrix that maps every point to nearly nothing would pass the line above.
    wrong = np.abs(np.sum(x1[::-1] * lines, axis=1))
    longest = np.linalg.norm(lines, axis=1).max()
    assert wrong.max() > 1e-6 * longest
    assert np.linalg.norm(F) == pytest.approx(1, abs=1e-12)
    assert np.linalg.svd(F, compute_uv=False)[2] < 1e-12


@pytest.mark.parametrize("degrees", [0.5, 3.0, 20.0])
@pytest.mark.parametrize("seed", range(2))
def test_a_rotation_about_the_baseline_is_an_error_of_rotation_alone(seed, degrees):
    # Camera 1 turns about the direction of t, so that t stays; F's other rotation is 180 - degrees
    # off.
    first, second = random_cameras(seed)
    R, t = relative_pose(first, second)
    wrong = Camera(second.K, rotation(t, degrees) @ R, t)
    F = fundamental_of_cameras(at_origin(first), wrong)
    error = pose_error(F, first, second, 1.0)
    assert error.rotation == pytest.approx(degrees, rel=1e-5)
    assert error.translation_angle < 1e-4
    assert error.translation < 1e-5
    assert error.angle == error.rotation


# E leaves the sign of t open, so a turn of 120 degrees is an error of 60.
TURNED = [(0.5, 0.5), (90.0, 90.0), (120.0, 60.0)]


@pytest.mark.parametrize(("degrees", "expected"), TURNED)
@pytest.mark.parametrize("seed", range(2))
def test_the_translation_is_scaled_to_metres_and_its_sign_is_free(seed, degrees, expected):
    first, second = random_cameras(seed)
    R, t = relative_pose(first, second)
    across = np.cross(t, (1.0, 2.0, 3.0))
    # The length of t is not known from F.
    turned = 7 * rotation(across, degrees) @ t
    wrong = Camera(second.K, R, turned)
    F = fundamental_of_cameras(at_origin(first), wrong)
    error = pose_error(F, first, second, 2.5)
    assert error.translation_angle == pytest.approx(expected, rel=1e-5, abs=1e-4)
    chord = 2 * np.linalg.norm(t) * np.sin(np.radians(expected) / 2)
    assert error.translation == pytest.approx(2.5 * chord, rel=1e-5, abs=1e-5)
    assert error.angle == max(error.rotation, error.translation_angle)


@pytest.mark.parametrize(
    ("angles", "threshold", "area"),
    [
        ((8, 2), 10, (0.5 + 4.5 + 2) / 10),  # 2 x .5 / 2, then 6 x (.5 + 1) / 2, then 2 x 1
        ((2, 8, 30, inf), 10, (0.25 + 2.25 + 1) / 10),
        # Two of one size: the curve steps to 2/3, then to 1
        ((4, 1, 4), 5, (1 / 6 + 3 * 0.5 + 1) / 5),
        ((0, 3), 5, (3 * 0.75 + 2) / 5),
        ((6, 60, inf), 5, 0),
    ],
)
def test_the_pose_auc_is_the_area_computed_by_hand(angles, threshold, area):
    assert pose_auc(errors(*angles), threshold) == pytest.approx(area)
    # The larger of both angles counts, and metres do not.
    of_translation = [PoseError(1e-9, angle, 9.0) for angle in angles]
    assert pose_auc(of_translation, threshold) == pytest.approx(area)
    assert isnan(pose_auc([], threshold))


@pytest.mark.parametrize("R", [np.full((3, 3), np.nan), -1e100 * np.eye(3)])
def test_a_matrix_that_is_no_rotation_has_an_angle_and_raises_nothing(R):
    # Files of users may hold any matrix.
    assert isinstance(rotation_angle(R), float)


def test_matches_are_correct_within_superglues_distance_of_both_epipolar_lines():
    # Cameras side by side: a line is a row, and 2 (dy / 800)^2 the distance
    K = np.diag([800.0, 800, 1])
    left = Camera(K, np.eye(3), np.zeros(3))
    right = Camera(K, np.eye(3), np.array([1.0, 0, 0]))
    points0 = np.array([(5, 0), (5, 0), (5, 0)])
    # 5e-4 is the limit, which is 12.65 rows.
    points1 = np.array([(90, 12.6), (7, -12.7), (0, 0)])
    matches = Matches(points0, points1, np.ones(3))
    is_correct = correct_matches(matches, left, right)
    assert is_correct.tolist() == [True, False, True]
