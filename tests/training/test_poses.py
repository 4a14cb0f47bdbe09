"""Pose errors on cases that can be worked out by hand."""

import numpy as np
import pytest
from curio_train.data.bop import ModelInfo
from curio_train.geometry import Pose
from curio_train.metrics import poses
from scipy.spatial.transform import Rotation

K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
ORIGIN = Pose(np.eye(3), np.array([0.0, 0, 1]))
SQUARE = np.array([[1.0, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]]) * 0.1
CLOUD = np.random.default_rng(0).uniform(-0.1, 0.1, (200, 3))
PLAIN = ModelInfo(diameter_m=0.3)
ABOUT_Z = np.diag([-1.0, -1, 1, 1])


def turned(axis: str, degrees: float, translation: tuple[float, float, float] = (0, 0, 1)) -> Pose:
    return Pose(Rotation.from_euler(axis, degrees, degrees=True).as_matrix(), np.array(translation, dtype=float))


def moved(x: float, y: float, z: float) -> Pose:
    return Pose(np.eye(3), ORIGIN.translation_m + np.array([x, y, z]))


def test_perfect_is_zero() -> None:
    pose = turned("xyz"[0], 40, (0.1, -0.2, 1.3))
    same = poses.symmetry_poses(PLAIN)
    assert poses.add_m(pose, pose, CLOUD) == 0
    assert poses.add_s_m(pose, pose, CLOUD) == 0
    assert poses.mssd_m(pose, pose, CLOUD, same) == 0
    assert poses.mspd_px(pose, pose, CLOUD, same, K) == 0
    assert poses.rotation_error_deg(pose, pose) == pytest.approx(0, abs=1e-6)
    assert poses.translation_error_m(pose, pose) == 0


def test_translation() -> None:
    estimate = moved(0.03, 0.0, 0.04)
    assert poses.add_m(estimate, ORIGIN, CLOUD) == pytest.approx(0.05)
    assert poses.mssd_m(estimate, ORIGIN, CLOUD, poses.symmetry_poses(PLAIN)) == pytest.approx(0.05)
    assert poses.translation_error_m(estimate, ORIGIN) == pytest.approx(0.05)
    assert poses.add_s_m(estimate, ORIGIN, CLOUD) < 0.05, "another point is closer to most"
    # A lone point has no other.
    assert poses.add_s_m(estimate, ORIGIN, CLOUD[:1]) == pytest.approx(0.05)


def test_rotation() -> None:
    estimate = turned("z", 90)
    assert poses.rotation_error_deg(estimate, ORIGIN) == pytest.approx(90)
    # Each corner of the square moves along one of its sides.
    assert poses.add_m(estimate, ORIGIN, SQUARE) == pytest.approx(0.2)
    assert poses.add_s_m(estimate, ORIGIN, SQUARE) == pytest.approx(0, abs=1e-12)
    half = turned("z", 180)
    assert poses.rotation_error_deg(half, ORIGIN) == pytest.approx(180)
    assert poses.add_m(half, ORIGIN, SQUARE) == pytest.approx(0.2 * 2**0.5)


def test_add_s_is_not_symmetric_in_its_arguments() -> None:
    # Mean over the true points of the distance to the closest estimated one, worked out for three points on a line.
    line = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.5, 0, 0]])
    estimate = moved(0.1, 0, 0)  # estimated at 0.1, 0.2, 0.6; true at 0, 0.1, 0.5
    assert poses.add_s_m(estimate, ORIGIN, line) == pytest.approx((0.1 + 0 + 0.1) / 3)
    assert poses.add_s_m(ORIGIN, estimate, line) == pytest.approx((0 + 0.1 + 0.1) / 3)
    estimate = moved(0.3, 0, 0)  # estimated at 0.3, 0.4, 0.8
    assert poses.add_s_m(estimate, ORIGIN, line) == pytest.approx((0.3 + 0.2 + 0.1) / 3)
    assert poses.add_s_m(ORIGIN, estimate, line) == pytest.approx((0.2 + 0.1 + 0.3) / 3)


def test_symmetric_objects_use_add_s() -> None:
    symmetric = ModelInfo(diameter_m=0.3, symmetries=(ABOUT_Z,))
    half = turned("z", 180)
    assert poses.add_or_add_s_m(half, ORIGIN, SQUARE, PLAIN) == poses.add_m(half, ORIGIN, SQUARE)
    assert poses.add_or_add_s_m(half, ORIGIN, SQUARE, symmetric) == pytest.approx(0, abs=1e-12)


def test_discrete_symmetry_about_a_line_beside_the_origin() -> None:
    # A half turn about the line x = 0.05 along z maps (x, y) to (0.1 - x, -y).
    matrix = ABOUT_Z.copy()
    matrix[0, 3] = 0.1
    same = poses.symmetry_poses(ModelInfo(diameter_m=0.3, symmetries=(matrix,)))
    assert len(same) == 2
    estimate = Pose(ABOUT_Z[:3, :3], ORIGIN.translation_m + np.array([0.1, 0, 0]))
    assert poses.mssd_m(estimate, ORIGIN, CLOUD, same) == pytest.approx(0, abs=1e-12)
    assert poses.mspd_px(estimate, ORIGIN, CLOUD, same, K) == pytest.approx(0, abs=1e-9)
    assert poses.mssd_m(estimate, ORIGIN, CLOUD, poses.symmetry_poses(PLAIN)) > 0.1


def test_continuous_symmetry() -> None:
    axis = (np.array([0.0, 0, 2]), np.array([0.05, 0, 0.3]))
    info = ModelInfo(diameter_m=0.3, symmetry_axes=(axis,))
    same = poses.symmetry_poses(info)
    assert len(same) == 315
    np.testing.assert_allclose(same[0].rotation, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(same[0].translation_m, 0, atol=1e-12)
    on_axis = np.array([[0.05, 0, -0.2]])
    for pose in same:
        np.testing.assert_allclose(pose.apply(on_axis), on_axis, atol=1e-12)
    turn = same[100]
    estimate = Pose(turn.rotation, turn.translation_m + ORIGIN.translation_m)
    assert poses.mssd_m(estimate, ORIGIN, CLOUD, same) == pytest.approx(0, abs=1e-12)
    # Between two steps, the farthest point is at most half a step from its place.
    angle = 100.5 * 2 * np.pi / 315
    between = Rotation.from_rotvec([0, 0, angle]).as_matrix()
    point = np.array([0.05, 0, 0.3])
    estimate = Pose(between, point - between @ point + ORIGIN.translation_m)
    radius = np.linalg.norm(CLOUD[:, :2] - point[:2], axis=1).max()
    assert poses.mssd_m(estimate, ORIGIN, CLOUD, same) == pytest.approx(radius * 2 * np.pi / 315 / 2, rel=1e-3)
    both = ModelInfo(diameter_m=0.3, symmetries=(np.diag([1.0, -1, -1, 1]),), symmetry_axes=(axis,))
    assert len(poses.symmetry_poses(both)) == 630


BALL_AXES = ((np.array([0.0, 0, 2]), np.array([0.1, 0.02, 5])), (np.array([1.0, 1, 0]), np.array([0.2, 0.12, -0.03])))
BALL_CENTRE = np.array([0.1, 0.02, -0.03])  # where they meet


def test_a_ball_turns_any_way() -> None:
    info = ModelInfo(diameter_m=0.2, symmetry_axes=BALL_AXES)
    points = CLOUD / np.linalg.norm(CLOUD, axis=1, keepdims=True) * 0.1 + BALL_CENTRE
    turn, true_turn = Rotation.random(2, random_state=3).as_matrix()
    moved_m = np.array([0.003, 0, 0.004])
    truth = Pose(true_turn, np.array([0.1, 0.2, 0.8]))
    estimate = Pose(turn, truth.apply(BALL_CENTRE) + moved_m - turn @ BALL_CENTRE)
    alike = poses.turned_alike(truth, estimate, info)
    assert alike.apply(BALL_CENTRE) == pytest.approx(truth.apply(BALL_CENTRE))
    assert poses.rotation_error_deg(estimate, alike) == pytest.approx(0, abs=1e-9)
    assert poses.mssd_m(estimate, alike, points, poses.symmetry_poses(info)) == pytest.approx(0.005)
    still = Pose(turn, estimate.translation_m - moved_m)
    assert poses.mspd_px(still, alike, points, poses.symmetry_poses(info), K) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("axes", [BALL_AXES[:1], (BALL_AXES[0], (np.array([0.0, 0, -1]), np.zeros(3))), ()])
def test_what_has_one_axis_is_no_ball(axes: tuple[tuple[np.ndarray, np.ndarray], ...]) -> None:
    info = ModelInfo(diameter_m=0.2, symmetry_axes=axes)
    assert not info.turns_any_way
    assert poses.turned_alike(ORIGIN, turned("x", 20), info) is ORIGIN


def test_projection() -> None:
    # 1 cm sideways at 1 m through a focal length of 500 px is 5 px for points of depth 1 m.
    estimate = moved(0.01, 0, 0)
    assert poses.mspd_px(estimate, ORIGIN, SQUARE, poses.symmetry_poses(PLAIN), K) == pytest.approx(5)
    # Twice as near: each corner, 50 * sqrt(2) px from the centre, goes out to twice that.
    identity = poses.symmetry_poses(PLAIN)
    assert poses.mspd_px(moved(0, 0, -0.5), ORIGIN, SQUARE, identity, K) == pytest.approx(50 * 2**0.5)
    assert poses.project(np.array([[0.0, 0, 1]]), K).tolist() == [[320, 240]]
    assert poses.mspd_px(moved(0, 0, -2), ORIGIN, SQUARE, identity, K) == np.inf


def test_recall() -> None:
    assert poses.recall([0.01, 0.03, np.inf, 0.02], 0.03) == 0.5
    with pytest.raises(ValueError, match="at least one"):
        poses.recall([], 0.1)


def test_bootstrap() -> None:
    assert poses.bootstrap_interval([1.0]) == (1, 1)
    assert poses.bootstrap_interval([0.0] * 50) == (0, 0)
    coin = [0.0, 1.0] * 200
    low, high = poses.bootstrap_interval(coin)
    # The normal approximation: 0.5 ± 1.96 * 0.5 / sqrt(400).
    assert low == pytest.approx(0.451, abs=0.006)
    assert high == pytest.approx(0.549, abs=0.006)
    assert poses.bootstrap_interval(coin) == (low, high)
    # The mean of two means varies half as much where one of them is certain, not as the mean of two intervals does.
    low, high = poses.bootstrap_interval(coin, [1.0] * 10)
    assert (low, high) == (pytest.approx(0.7255, abs=0.006), pytest.approx(0.7745, abs=0.006))
    low, high = poses.bootstrap_interval(coin, coin)
    assert high - low == pytest.approx(2 * 1.96 * 0.5 / 800**0.5, rel=0.1)
    with pytest.raises(ValueError, match="at least one"):
        poses.bootstrap_interval([])
