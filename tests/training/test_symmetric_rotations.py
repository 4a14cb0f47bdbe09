"""Of the rotations that look like the true one, the nearest to a prediction is found."""

import numpy as np
import pytest
import torch
from curio_train.data.bop import ModelInfo
from curio_train.geometry import matrix_from_rotation_6d, random_rotations, rotation_6d_from_matrix, rotation_angle_deg
from curio_train.metrics.poses import symmetry_poses
from curio_train.metrics.symmetric_rotations import nearest_symmetric
from scipy.spatial.transform import Rotation
from torch import Tensor

AXIS = np.array([0.6, 0.0, 0.8])
ACROSS = np.array([0.0, 1.0, 0.0])


def about(axis: np.ndarray, *angles_deg: float) -> np.ndarray:
    return Rotation.from_rotvec(np.radians(angles_deg)[:, None] * axis).as_matrix()


def motions(rotations: np.ndarray) -> tuple[np.ndarray, ...]:
    result = np.tile(np.eye(4), (len(rotations), 1, 1))
    result[:, :3, :3] = rotations
    return tuple(result)


ROD = ModelInfo(0.1, motions(about(ACROSS, 180)), ((2 * AXIS, np.zeros(3)),))
CONE = ModelInfo(0.1, (), ((AXIS, np.zeros(3)),))
NUT = ModelInfo(0.1, motions(about(AXIS, 60, 120, 180, 240, 300)))
BALL = ModelInfo(0.1, (), ((AXIS, np.zeros(3)), (ACROSS, np.zeros(3))))
PLAIN = ModelInfo(0.1)


def codes(rotation: Tensor | np.ndarray) -> Tensor:
    """One slot."""
    return rotation_6d_from_matrix(torch.as_tensor(rotation).double())[:, None]


def angles_deg(predicted: np.ndarray, true: np.ndarray, info: ModelInfo) -> list[float]:
    nearest = nearest_symmetric(codes(predicted), codes(true), [info])[:, 0]
    found: list[float] = rotation_angle_deg(torch.from_numpy(predicted), matrix_from_rotation_6d(nearest)).tolist()
    return found


TRUE = about(np.array([1.0, 0, 0]), 37, 37, 37)


@pytest.mark.parametrize(
    ("info", "turns", "expected"),
    [
        pytest.param(ROD, about(AXIS, 71.3, -160, 0.01), [0, 0, 0], id="rod about its axis"),
        pytest.param(ROD, about(AXIS, 10, 20, 30) @ about(ACROSS, 180), [0, 0, 0], id="rod the other way round"),
        pytest.param(ROD, about(AXIS, 10, 20, 30) @ about(ACROSS, 5, 90, 175), [5, 90, 5], id="rod that is tilted"),
        pytest.param(CONE, about(AXIS, 10, 20, 30) @ about(ACROSS, 5, 90, 175), [5, 90, 175], id="cone"),
        pytest.param(NUT, about(AXIS, 120, 65, 330), [0, 5, 30], id="nut"),
        pytest.param(BALL, about(np.array([1.0, 0, 0]), 40, 120, 180), [0, 0, 0], id="ball"),
        pytest.param(PLAIN, about(AXIS, 120, 65, 180), [120, 65, 180], id="no symmetry"),
    ],
)
def test_what_is_left_of_an_angle(info: ModelInfo, turns: np.ndarray, expected: list[float]) -> None:
    assert angles_deg(TRUE @ turns, TRUE, info) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("info", [ROD, CONE, NUT], ids=["rod", "cone", "nut"])
def test_none_of_the_symmetric_poses_is_nearer(info: ModelInfo) -> None:
    """Compared with all of them in small steps, for any pair of rotations."""
    pairs = random_rotations(40, np.random.default_rng(0)).double()
    predicted, true = pairs[:20], pairs[20:]
    alike = torch.from_numpy(np.stack([pose.rotation for pose in symmetry_poses(info, 0.005)]))
    least = rotation_angle_deg(predicted[:, None], true[:, None] @ alike).amin(dim=1)
    found = torch.tensor(angles_deg(predicted.numpy(), true.numpy(), info), dtype=torch.float64)
    assert (found <= least + 1e-6).all()
    assert (least - found).max() < 0.3, "half a step"


def test_slots_have_their_own_symmetries_and_nothing_has_a_gradient() -> None:
    turned = codes(TRUE @ about(AXIS, 90, 90, 90)).requires_grad_()
    both = torch.cat([turned, turned], dim=1)
    true = torch.cat([codes(TRUE)] * 2, dim=1).float()
    nearest = nearest_symmetric(both, true, [PLAIN, ROD])
    assert torch.equal(nearest[:, 0], true[:, 0])
    assert torch.allclose(nearest[:, 1], turned[:, 0].float(), atol=1e-6)
    assert nearest.dtype == torch.float32
    assert not nearest.requires_grad
