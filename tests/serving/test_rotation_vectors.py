"""Serving's own rotations and assignment, which spare the base install scipy, agree with scipy's."""

import numpy as np
import pytest
from curio_serve.consensus.poses import mean_rotation
from curio_serve.imaging.rotation import from_rotation_vector, rotation_vector
from curio_serve.tracking.assignment import assigned
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation


def test_rotations_about_axes() -> None:
    vectors = np.random.default_rng(0).normal(size=(50, 3))
    vectors[0] = 0
    vectors[1] *= 1e-9
    expected = Rotation.from_rotvec(vectors)
    np.testing.assert_allclose(from_rotation_vector(vectors), expected.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(from_rotation_vector(vectors[5]), expected[5].as_matrix(), atol=1e-12)
    for vector, rotation in zip(expected.as_rotvec(), expected.as_matrix(), strict=True):
        np.testing.assert_allclose(rotation_vector(rotation), vector, atol=1e-7)


def test_a_half_turn() -> None:
    found = rotation_vector(np.diag([1.0, -1.0, -1.0]))
    np.testing.assert_allclose(np.abs(found), [np.pi, 0, 0], atol=1e-12)


def test_means_of_rotations() -> None:
    around = Rotation.from_rotvec(np.random.default_rng(1).normal(size=(20, 3), scale=0.4))
    found = mean_rotation((Rotation.from_rotvec([0.3, 2.0, -1.0]) * around).as_matrix())
    expected = (Rotation.from_rotvec([0.3, 2.0, -1.0]) * around).mean().as_matrix()
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert np.linalg.det(found) == pytest.approx(1)


@pytest.mark.parametrize("shape", [(1, 1), (3, 3), (2, 7), (7, 2), (20, 20)])
def test_pairs_have_the_least_sum(shape: tuple[int, int]) -> None:
    random = np.random.default_rng(2)
    for _ in range(40):
        distance = random.uniform(size=shape)
        distance[random.uniform(size=shape) < 0.4] = 1e6
        pairs = assigned(distance)
        assert len(set(pairs.values())) == len(pairs) == min(shape)
        rows, columns = linear_sum_assignment(distance)
        assert sum(distance[pair] for pair in pairs.items()) == pytest.approx(distance[rows, columns].sum())
