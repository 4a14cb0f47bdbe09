"""Rotations: group axioms and conventions, near identity and at degenerate input too."""

import math

import numpy as np
import pytest
import torch
from curio_train import geometry
from curio_train.geometry import Pose
from hypothesis import given, settings
from hypothesis import strategies as st

ATOL = 1e-9

# A shared machine's speed is not what is tested.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")

finite = st.floats(-3, 3, allow_nan=False)
vectors = st.tuples(finite, finite, finite).map(lambda v: torch.tensor(v, dtype=torch.float64))
seeds = st.integers(0, 2**32 - 1)


def rotation(seed: int, angle: float = math.pi) -> torch.Tensor:
    """A rotation of at most ``angle``: tiny ones test the neighbourhood of the identity."""
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal(3)
    axis *= rng.uniform(0, angle) / np.linalg.norm(axis)
    return torch.matrix_exp(torch.tensor([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]]))


rotations = st.builds(rotation, seeds, st.sampled_from([1e-12, 1e-7, 1e-3, 1.0, math.pi]))
transforms = st.builds(Pose, rotations, vectors)


def assert_rotation(matrix: torch.Tensor, atol: float = ATOL) -> None:
    eye = torch.eye(3, dtype=matrix.dtype).expand_as(matrix)
    torch.testing.assert_close(matrix @ matrix.transpose(-1, -2), eye, atol=atol, rtol=0)
    torch.testing.assert_close(torch.linalg.det(matrix), torch.ones_like(matrix[..., 0, 0]), atol=atol, rtol=0)


def close(a: Pose, b: Pose) -> None:
    for x, y in zip(a, b, strict=True):
        torch.testing.assert_close(x, y, atol=ATOL, rtol=0)


@given(rotations)
def test_6d_round_trip(matrix: torch.Tensor) -> None:
    again = geometry.matrix_from_rotation_6d(geometry.rotation_6d_from_matrix(matrix))
    torch.testing.assert_close(again, matrix, atol=ATOL, rtol=0)


def test_6d_is_columns_not_rows() -> None:
    matrix = rotation(3)
    code = geometry.rotation_6d_from_matrix(matrix)
    assert torch.equal(code[:3], matrix[:, 0])
    assert torch.equal(code[3:], matrix[:, 1])


@given(st.lists(st.floats(-(2.0**100), 2.0**100, width=32), min_size=6, max_size=6))
@settings(max_examples=300)
def test_6d_of_anything_is_a_rotation(values: list[float]) -> None:
    code = torch.tensor(values, dtype=torch.float32, requires_grad=True)
    matrix = geometry.matrix_from_rotation_6d(code)
    assert_rotation(matrix.detach(), atol=1e-4)
    (matrix * torch.arange(9.0).view(3, 3)).sum().backward()
    assert torch.isfinite(code.grad).all()


@pytest.mark.parametrize(
    "code",
    [
        [0, 0, 0, 0, 0, 0],
        [0, 0, 0, 1, 0, 0],
        [1, 0, 0, 0, 0, 0],
        [0, 2, 0, 0, 3, 0],
        [0, 0, 2, 0, 0, -3],
        [1, 1, 1, -1, -1, -1],
        [1e-30, 0, 0, 0, 1e-30, 0],
    ],
)
def test_6d_degenerate(code: list[float]) -> None:
    value = torch.tensor(code, dtype=torch.float32, requires_grad=True)
    matrix = geometry.matrix_from_rotation_6d(value)
    assert_rotation(matrix.detach(), atol=1e-5)
    matrix.square().sum().backward()
    (geometry.matrix_from_rotation_6d(value)[0, 1] + geometry.matrix_from_rotation_6d(value)[2, 0]).backward()
    assert torch.isfinite(value.grad).all()


def test_6d_gradient_is_the_derivative() -> None:
    code = torch.randn(4, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True)
    assert torch.autograd.gradcheck(geometry.matrix_from_rotation_6d, code)


@given(st.floats(-math.pi, math.pi), st.floats(1e-3, 1e3))
def test_yaw(angle: float, length: float) -> None:
    code = torch.tensor([length * math.cos(angle), length * math.sin(angle)], dtype=torch.float64)
    matrix = geometry.matrix_from_yaw(code)
    assert_rotation(matrix)
    # Right-handed about y: a quarter turn takes z to x.
    expected = torch.tensor([math.sin(angle), 0, math.cos(angle)], dtype=torch.float64)
    torch.testing.assert_close(matrix @ torch.tensor([0, 0, 1.0], dtype=torch.float64), expected, atol=ATOL, rtol=0)


@pytest.mark.parametrize("length", [0.0, 1e-38, 1e-20, 1e-7, 1e-5])
def test_yaw_near_zero_has_finite_gradients(length: float) -> None:
    code = torch.tensor([length, length], requires_grad=True)
    matrix = geometry.matrix_from_yaw(code)
    matrix[0, 2].backward()
    assert_rotation(matrix.detach(), atol=1e-6)
    assert torch.isfinite(code.grad).all()


@given(st.floats(-50, 50), st.floats(-50, 50))
def test_hemisphere_is_above_the_ground(x: float, z: float) -> None:
    direction = geometry.direction_from_hemisphere(torch.tensor([x, z], dtype=torch.float64))
    assert direction.norm().item() == pytest.approx(1)
    assert direction[1] > 0
    torch.testing.assert_close(direction[[0, 2]] / direction[1], torch.tensor([x, z], dtype=torch.float64))


def test_random_rotations_are_uniform() -> None:
    matrices = geometry.random_rotations(20_000, np.random.default_rng(0)).double()
    assert_rotation(matrices, atol=1e-5)
    assert matrices.mean(dim=0).abs().max() < 0.02
    # The angle of a uniform rotation has density (1 - cos a) / pi (Haar measure), its mean is pi / 2 + 2 / pi.
    angles = geometry.rotation_angle_deg(matrices, torch.eye(3, dtype=torch.float64))
    assert angles.mean().item() == pytest.approx(math.degrees(math.pi / 2 + 2 / math.pi), abs=1)
    again = geometry.random_rotations(20_000, np.random.default_rng(0)).double()
    assert torch.equal(matrices, again)


@given(rotations, st.floats(0, 180))
def test_angle_is_exact_at_both_ends(matrix: torch.Tensor, angle_deg: float) -> None:
    angle = math.radians(angle_deg)
    turn = geometry.matrix_from_yaw(torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64))
    assert geometry.rotation_angle_deg(matrix, matrix @ turn).item() == pytest.approx(angle_deg, abs=1e-6)
    assert geometry.rotation_angle_deg(matrix @ turn, matrix).item() == pytest.approx(angle_deg, abs=1e-6)


@given(transforms, transforms, transforms)
def test_group_axioms(a: Pose, b: Pose, c: Pose) -> None:
    identity = Pose.identity().to(a.rotation)
    close(a @ (b @ c), (a @ b) @ c)
    close(a @ identity, a)
    close(a @ a.inverse(), identity)
    close(a.inverse() @ a, identity)


@given(transforms, transforms, vectors)
def test_points_follow_the_composition(a: Pose, b: Pose, point: torch.Tensor) -> None:
    torch.testing.assert_close(a.apply(b.apply(point)), (a @ b).apply(point), atol=ATOL, rtol=0)


def test_a_batch_of_poses_in_numpy_moves_each_its_own_points() -> None:
    rng = np.random.default_rng(0)
    matrices = np.tile(np.eye(4), (5, 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = geometry.random_rotations(5, rng).numpy(), rng.standard_normal((5, 3))
    poses, points = Pose.from_matrix(matrices), rng.standard_normal((5, 7, 3))
    moved = (poses @ poses).apply(points)
    for number, matrix in enumerate(matrices):
        homogeneous = np.concatenate([points[number], np.ones((7, 1))], axis=1)
        np.testing.assert_allclose(moved[number], (homogeneous @ (matrix @ matrix).T)[:, :3], atol=1e-6)
    np.testing.assert_allclose(poses.inverse().apply(poses.apply(points)), points, atol=1e-6)


@given(rotations, vectors.filter(lambda v: v.norm() > 1e-2))
def test_rotation_between(matrix: torch.Tensor, source: torch.Tensor) -> None:
    target = matrix @ source
    angle = math.degrees(torch.atan2(torch.linalg.cross(source, target).norm(), (source * target).sum()).item())
    if angle > 179:
        return
    between = geometry.rotation_between(source, 3 * target)
    assert_rotation(between, atol=1e-7)
    torch.testing.assert_close(between @ source, target, atol=1e-7, rtol=0)
    turned = geometry.rotation_angle_deg(between, torch.eye(3, dtype=torch.float64)).item()
    assert turned == pytest.approx(angle, abs=1e-5), "not the smallest rotation"


def test_camera_looking_at() -> None:
    eye = torch.tensor([0.0, 2.0, -5.0])
    pose = geometry.camera_looking_at(eye, torch.zeros(3))
    assert_rotation(pose.rotation, atol=1e-6)

    def seen(point: list[float]) -> torch.Tensor:
        return pose.apply(torch.tensor(point, dtype=torch.float32))

    torch.testing.assert_close(seen([0, 0, 0]), torch.tensor([0.0, 0.0, eye.norm()]))
    assert seen([0, 1, 0])[1] < 0, "up in the world is up in the image: smaller y"
    # Looking along +z with y up, right-handed: the world's +x is to the left.
    assert seen([1, 0, 0])[0] < 0
    assert_rotation(geometry.camera_looking_at(torch.tensor([0.0, 3.0, 0.0]), torch.zeros(3)).rotation, atol=1e-6)
