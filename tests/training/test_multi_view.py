"""Photographs of a static scene correct each other's readings, and nothing is made up where they do not agree."""

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from curio_train.camera import Intrinsics
from curio_train.data.backgrounds import ClutterBackgrounds
from curio_train.data.photographs import CameraPoses
from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix, rotation_angle_deg
from curio_train.meshes.meshes import Mesh
from curio_train.meshes.shapes import chair, sphere
from curio_train.refinement.multi_view import Estimates, consensus_poses, estimate_scale
from curio_train.refinement.pseudo_labels import MIN_CONSENSUS, PseudoLabels
from curio_train.refinement.render_and_compare import RenderAndCompare
from curio_train.scene_code import CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION, SceneCode
from curio_train.worlds.base import ObjectKind
from curio_train.worlds.linemod import LinemodPhotographs
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import Object
from scipy.spatial.transform import Rotation
from torch import Tensor

K = np.array([[572.4, 0, 325.3], [0, 573.6, 242.0], [0, 0, 1]])
MESH = chair(0.12)
NUM, FLIPPED = 16, (2, 7, 11)
SCALE = 0.137  # metres a unit of the scene


def thing(mesh: Mesh = MESH, axes: Sequence[tuple[np.ndarray, np.ndarray]] = ()) -> Object:
    kind = ObjectKind("chair", (0,), mesh.diameter_m, mesh.box_corners_m, mesh.sha256, symmetry_axes=axes)
    pool = np.full((2, 480, 640, 3), 128, np.uint8)
    return Object(kind, mesh, Intrinsics(K, 640, 480), 0.5, 1.0, lambda _: ClutterBackgrounds(pool))


@pytest.fixture(scope="module")
def world() -> TwoStageWorld:
    return TwoStageWorld("linemod", thing())


@pytest.fixture(scope="module")
def truth(world: TwoStageWorld) -> SceneCode:
    return scenes(world)


@pytest.fixture(scope="module")
def frames(world: TwoStageWorld, truth: SceneCode) -> Tensor:
    return photographed(world, truth)


def scenes(world: TwoStageWorld) -> SceneCode:
    code = world.sample(NUM, (1,))
    code[TRANSLATION][..., :2] *= 0.5
    code[LIGHT] = torch.tensor([[0.2, -0.5, -0.6]]).expand(NUM, 3)
    return code


def photographed(world: TwoStageWorld, code: SceneCode) -> Tensor:
    behind = world.backgrounds(Path()).draw(NUM, 640, 480, (2,))
    return (world.render(code, behind).clamp(0, 1) * 255).round().byte()


def cameras(code: SceneCode, place_m: tuple[float, float, float] = (0.3, -0.2, 0.5)) -> np.ndarray:
    """Where cameras stood that see a chair of one pose in the scene as the code says."""
    in_scene = Rotation.from_rotvec([0.4, -0.7, 0.2]).as_matrix()
    turn = matrix_from_rotation_6d(code[ROTATION_6D][:, 0]).double().numpy() @ in_scene.T
    shift = code[TRANSLATION][:, 0].double().numpy() - turn @ np.array(place_m)
    matrices = np.tile(np.eye(4), (len(turn), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = turn, shift / SCALE
    return matrices


def roughly(code: SceneCode, turned: tuple[int, ...] = FLIPPED) -> dict[str, Tensor]:
    """As a network might read it: a few degrees and a few per cent of the depth off, some turned by half a turn."""
    random = np.random.default_rng(0)
    rotation = matrix_from_rotation_6d(code[ROTATION_6D][:, 0]).double().numpy()
    rotation = Rotation.from_rotvec(random.normal(size=(NUM, 3)) * np.radians(4)).as_matrix() @ rotation
    rotation[list(turned)] = rotation[list(turned)] @ Rotation.from_euler("z", 180, degrees=True).as_matrix()
    far = torch.from_numpy(np.exp(random.normal(size=(NUM, 1, 1)) * 0.03)).float()
    six = rotation_6d_from_matrix(torch.from_numpy(rotation).float())[:, None]
    return dict(code) | {TRANSLATION: code[TRANSLATION] * far, ROTATION_6D: six}


def agree(
    world: TwoStageWorld, frames: Tensor, matrices: np.ndarray, read: SceneCode
) -> tuple[dict[str, Tensor], Tensor]:
    estimates, info = Estimates(read, read, torch.ones(NUM, dtype=torch.bool)), world.object.kind.info
    return consensus_poses(RenderAndCompare.in_world(world), frames, CameraPoses(matrices), estimates, info)


def errors(found: SceneCode, true: SceneCode) -> tuple[Tensor, Tensor]:
    """Degrees, and metres in depth."""
    pair = (matrix_from_rotation_6d(code[ROTATION_6D][:, 0]) for code in (found, true))
    return rotation_angle_deg(*pair), (found[TRANSLATION] - true[TRANSLATION])[:, 0, 2].abs()


def test_what_most_read_rightly_corrects_the_others(world: TwoStageWorld, truth: SceneCode, frames: Tensor) -> None:
    read = roughly(truth)
    code, chosen = agree(world, frames, cameras(truth), read)
    assert chosen.sum() >= NUM - 2
    degrees, depth_m = errors(code, truth)
    before_degrees, before_depth_m = errors(read, truth)
    assert before_degrees[list(FLIPPED)].min() > 150
    assert degrees[chosen].max() < 5
    assert depth_m[chosen].median() < before_depth_m.median()
    assert set(code) == set(read)


def test_metres_correct_what_an_object_is_read_too_far_by(
    world: TwoStageWorld, truth: SceneCode, frames: Tensor
) -> None:
    """All readings err to one side, and the scale that they tell with them; another scale says so."""
    read = roughly(truth)
    read[TRANSLATION] = read[TRANSLATION] * 1.04
    of_any_scale, metres = cameras(truth), cameras(truth)
    metres[:, :3, 3] *= SCALE
    estimates, info = Estimates(read, read, torch.ones(NUM, dtype=torch.bool)), world.object.kind.info
    off = []
    for where in (CameraPoses(of_any_scale), CameraPoses(metres, in_metres=True)):
        code, chosen = consensus_poses(RenderAndCompare.in_world(world), frames, where, estimates, info)
        assert chosen.sum() >= NUM - 4
        off.append((code[TRANSLATION][chosen, 0, 2] / truth[TRANSLATION][chosen, 0, 2]).log().median())
    assert off[0] == pytest.approx(np.log(1.04), abs=0.01)
    assert off[1] == pytest.approx(0, abs=0.01)


def test_an_object_that_is_read_tells_the_scale(world: TwoStageWorld, truth: SceneCode) -> None:
    taken = torch.ones(NUM, dtype=torch.bool)
    diameter_m = world.object.kind.diameter_m
    assert estimate_scale(CameraPoses(cameras(truth)), roughly(truth), taken, diameter_m) == pytest.approx(
        SCALE, rel=0.03
    )
    assert estimate_scale(CameraPoses(cameras(truth)), world.sample(NUM, (9,)), taken, diameter_m) is None


def test_photographs_whose_camera_is_unknown_teach_nothing(
    world: TwoStageWorld, truth: SceneCode, frames: Tensor
) -> None:
    matrices = cameras(truth)
    matrices[3:6] = np.nan
    _, chosen = agree(world, frames, matrices, roughly(truth))
    assert not chosen[3:6].any()
    assert chosen.sum() >= NUM - 5


def test_an_object_that_was_moved_has_a_pose_at_each_place(
    world: TwoStageWorld, truth: SceneCode, frames: Tensor
) -> None:
    """The second half of the photographs was taken after it had been put elsewhere."""
    matrices = cameras(truth)
    matrices[NUM // 2 :] = cameras(truth, (-0.4, 0.1, 0.2))[NUM // 2 :]
    code, chosen = agree(world, frames, matrices, roughly(truth))
    degrees, _ = errors(code, truth)
    assert chosen[: NUM // 2].sum() >= NUM // 2 - 2
    assert chosen[NUM // 2 :].sum() >= NUM // 2 - 2
    assert degrees[chosen].max() < 7


def test_a_ball_has_no_rotation_that_photographs_could_disagree_on() -> None:
    """Nor one that a photograph's own reading could contradict, also where that reading is exact."""
    ball = TwoStageWorld("linemod", thing(sphere(0.06), [(axis, np.zeros(3)) for axis in np.eye(3)[:2]]))
    truth = scenes(ball)
    frames, turns = photographed(ball, truth), Rotation.random(NUM, random_state=3).as_matrix()
    turned = {ROTATION_6D: rotation_6d_from_matrix(torch.from_numpy(turns).float())[:, None]}
    for read in (truth, roughly(truth, ())):
        code, chosen = agree(ball, frames, cameras(truth), dict(read) | turned)
        assert chosen.all()
        assert errors(code, truth)[1].median() < 0.1 * ball.object.kind.diameter_m


def test_readings_that_do_not_agree_teach_nothing(world: TwoStageWorld, truth: SceneCode, frames: Tensor) -> None:
    elsewhere = world.sample(NUM, (9,))
    _, chosen = agree(world, frames, cameras(truth), elsewhere)
    assert not chosen.any()


def test_lessons_are_of_agreed_poses_where_the_camera_moved(
    world: TwoStageWorld, truth: SceneCode, frames: Tensor
) -> None:
    read = roughly(truth)
    reader = iter([dict(read)])  # photographs are read once, all together: there are fewer than are read at once
    lessons = PseudoLabels.from_predictions(world, frames, lambda _: next(reader), CameraPoses(cameras(truth)))
    assert lessons is not None
    assert len(lessons) >= MIN_CONSENSUS
    taught = matrix_from_rotation_6d(lessons._code[ROTATION_6D][:, 0])
    true = matrix_from_rotation_6d(truth[ROTATION_6D][:, 0])
    nearest = rotation_angle_deg(taught[:, None].expand(-1, NUM, 3, 3), true.expand(len(taught), NUM, 3, 3))
    assert nearest.min(dim=1).values.max() < 5
    code, crops = lessons.draw(8, (1,))
    assert (code[CONFIDENCE] == 1).all()
    assert crops.isfinite().all()


def test_photographs_without_texture_teach_one_by_one_and_say_why(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cv2 = pytest.importorskip("cv2")
    for number in range(4):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((480, 640, 3), 40 * number, np.uint8))
    with caplog.at_level(logging.WARNING):
        assert LinemodPhotographs(tmp_path, thing().camera).unlabelled().cameras is None
    assert "do not correct each other" in caplog.text
