"""Distances that are corrected by parallax, in synthetic camera motions whose true distances are known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from curio_train.camera import Intrinsics
from curio_train.capture.parallax import MIN_PAIRS, Predictions, distance_ratio
from curio_train.data.photographs import CameraPoses
from curio_train.geometry import Pose, rotation_6d_from_matrix
from curio_train.meshes.shapes import chair
from curio_train.scene_code import CONFIDENCE, ROTATION_6D, TRANSLATION
from curio_train.worlds.base import ObjectKind
from curio_train.worlds.several_objects.distances import distance_factors
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object.world import Object
from scipy.spatial.transform import Rotation

IDENTITY = np.eye(3)[None]
K = np.array([[572.4, 0, 325.3], [0, 573.6, 242.0], [0, 0, 1]])


def cameras(num: int) -> Pose:
    """On half a circle of radius 0.8 m around the origin, looking at it."""
    turns = Rotation.from_rotvec(np.linspace(0, np.pi, num)[:, None] * np.array([0.0, 1.0, 0.0])).as_matrix()
    return Pose(turns, np.tile([0.0, 0.0, 0.8], (num, 1)))


def seen(cam_from_world: Pose, position_m: np.ndarray, factor: float, noise: float, seed: int) -> Pose:
    """An object's poses as a detector tells them: all distances multiplied, each with an error of its own besides."""
    random, num = np.random.default_rng(seed), len(cam_from_world.rotation)
    own = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix()
    true_m = cam_from_world.apply(position_m[None])[:, 0]
    off = factor * np.exp(random.normal(0, noise, (num, 1)))
    wobble = Rotation.from_rotvec(random.normal(0, 0.05, (num, 3))).as_matrix()
    return Pose(wobble @ cam_from_world.rotation @ own, true_m * off)


def sure(poses: Pose) -> Predictions:
    return Predictions(poses, np.full(len(poses.rotation), 0.9))


def test_the_ratio_is_found_among_misread_and_moved_objects() -> None:
    around, random = cameras(60), np.random.default_rng(1)
    poses = seen(around, np.array([0.05, 0.02, -0.1]), 0.97, 0.01, 0)
    rotation, position_m = poses.rotation.copy(), poses.translation_m.copy()
    misread = random.permutation(60)[:25]
    rotation[misread] = Rotation.random(25, random_state=2).as_matrix()
    position_m[misread] *= random.uniform(0.8, 1.3, (25, 1))
    position_m[45:] += [0.0, 0.06, 0.0]  # seen by a camera that stands upright: moved in between
    found = distance_ratio(around, sure(Pose(rotation, position_m)), IDENTITY)
    assert found.num_pairs >= MIN_PAIRS
    assert found.log_ratio == pytest.approx(-np.log(0.97), abs=0.005)


def test_scenes_of_another_scale_have_another_ratio() -> None:
    around = cameras(40)
    poses = seen(around, np.array([0.0, 0.0, 0.1]), 1.0, 0.005, 0)
    scaled = Pose(around.rotation, 3.0 * around.translation_m)
    assert distance_ratio(scaled, sure(poses), IDENTITY).log_ratio == pytest.approx(np.log(3.0), abs=0.005)


def test_rotations_that_a_symmetry_makes_equal_agree() -> None:
    around = cameras(40)
    half_turn = Rotation.from_euler("z", 180, degrees=True).as_matrix()
    poses = seen(around, np.array([0.0, 0.0, 0.1]), 1.02, 0.005, 0)
    turned = np.where(np.arange(40)[:, None, None] % 2, poses.rotation @ half_turn, poses.rotation)
    alone = distance_ratio(around, sure(Pose(turned, poses.translation_m)), IDENTITY)
    both = distance_ratio(around, sure(Pose(turned, poses.translation_m)), np.stack([np.eye(3), half_turn]))
    assert both.num_pairs > 1.5 * alone.num_pairs
    assert both.log_ratio == pytest.approx(-np.log(1.02), abs=0.005)


def test_a_still_camera_and_unsure_predictions_tell_nothing() -> None:
    still = Pose(np.tile(np.eye(3), (30, 1, 1)), np.tile([0.0, 0.0, 0.8], (30, 1)))
    assert distance_ratio(still, sure(seen(still, np.zeros(3), 0.9, 0.0, 0)), IDENTITY) == (0.0, 0)
    around = cameras(30)
    unsure = Predictions(seen(around, np.zeros(3), 0.9, 0.0, 0), np.zeros(30))
    assert distance_ratio(around, unsure, IDENTITY) == (0.0, 0)


@pytest.fixture(scope="module")
def world() -> SeveralObjectsWorld:
    mesh = chair(0.1)
    kinds = [ObjectKind(f"chair{slot}", (slot,), mesh.diameter_m, mesh.box_corners_m) for slot in range(3)]
    one = Object(kinds[0], mesh, Intrinsics(K, 640, 480), 0.5, 1.5, lambda _: pytest.fail(f"{Path()} is not drawn"))
    return SeveralObjectsWorld("linemod", [replace(one, kind=kind) for kind in kinds])


def code_of(poses: list[Pose]) -> dict[str, torch.Tensor]:
    return {
        TRANSLATION: torch.from_numpy(np.stack([pose.translation_m for pose in poses], axis=1)).float(),
        ROTATION_6D: rotation_6d_from_matrix(torch.from_numpy(np.stack([pose.rotation for pose in poses], axis=1))),
        CONFIDENCE: torch.full((len(poses[0].rotation), len(poses), 1), 0.9),
    }


@pytest.mark.parametrize("in_metres", [True, False])
def test_factors_are_of_each_object(world: SeveralObjectsWorld, in_metres: bool) -> None:
    around, errors = cameras(40), (0.96, 1.03, 1.02)
    places = np.array([[0.1, 0.0, 0.0], [-0.1, 0.0, 0.05], [0.0, 0.0, -0.1]])
    code = code_of([seen(around, place, error, 0.005, 0) for place, error in zip(places, errors, strict=True)])
    matrices = np.tile(np.eye(4), (41, 1, 1))
    matrices[:40, :3, :3], matrices[:40, :3, 3] = around.rotation, around.translation_m * (1 if in_metres else 7)
    matrices[40] = np.nan  # a photograph that was not placed
    found = np.array(distance_factors(code, CameraPoses(matrices, in_metres=in_metres), world))
    wanted = 1 / np.array(errors)
    np.testing.assert_allclose(found, wanted if in_metres else wanted / np.exp(np.log(wanted).mean()), atol=0.005)


def test_an_object_that_is_hardly_seen_keeps_its_distances(world: SeveralObjectsWorld) -> None:
    around = cameras(40)
    code = code_of([seen(around, np.array([0.1 * slot, 0.0, 0.0]), 1.05, 0.005, slot) for slot in range(3)])
    code[CONFIDENCE][3:, 1] = 0.0
    matrices = np.tile(np.eye(4), (40, 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = around.rotation, around.translation_m
    found = distance_factors(code, CameraPoses(matrices, in_metres=True), world)
    assert found[1] == 1.0
    assert found[0] == pytest.approx(1 / 1.05, abs=0.005)
