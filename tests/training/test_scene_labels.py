"""Photographs of a scene with several objects teach where those are, from what a network reads there, never labels."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from curio_train.camera import Intrinsics
from curio_train.data.backgrounds import ClutterBackgrounds
from curio_train.data.photographs import CameraPoses, UnlabelledPhotographs
from curio_train.geometry import Pose, rotation_6d_from_matrix, rotation_angle_deg
from curio_train.meshes.shapes import chair
from curio_train.networks.several_objects.locator import HEAT_MAPS, PROPOSALS
from curio_train.networks.templates.geometry import FRAME_STRIDE
from curio_train.refinement.scene_labels import SceneLabels
from curio_train.refinement.scene_poses import Reads, scene_poses
from curio_train.scene_code import CONFIDENCE, ROTATION_6D, TRANSLATION
from curio_train.worlds.base import ObjectKind
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object.world import Object
from scipy.spatial.transform import Rotation

K = np.array([[572.4, 0, 325.3], [0, 573.6, 242.0], [0, 0, 1]])
MESHES = chair(0.12), chair(0.2)
NUM, MOVED_AT, READS_EACH = 16, 9, 2
SCALE = 0.137  # metres a unit of the scene


def member(slot: int) -> Object:
    mesh = MESHES[slot]
    kind = ObjectKind(f"chair-{slot}", (slot,), mesh.diameter_m, mesh.box_corners_m, mesh.sha256)
    pool = np.full((2, 480, 640, 3), 128, np.uint8)
    return Object(kind, mesh, Intrinsics(K, 640, 480), 0.5, 1.5, lambda _: ClutterBackgrounds(pool))


@pytest.fixture(scope="module")
def world() -> SeveralObjectsWorld:
    return SeveralObjectsWorld("linemod", [member(0), member(1)])


@pytest.fixture(scope="module")
def cam_from_world() -> Pose[np.ndarray]:
    """A camera that moves around the scene's origin, 0.9 m away."""
    angles = np.linspace(-70, 70, NUM)
    rotation = Rotation.from_euler("YX", np.stack([angles, np.full(NUM, 25.0)], axis=1), degrees=True).as_matrix()
    return Pose(rotation, np.tile([0.0, 0.0, 0.9], (NUM, 1)))


@pytest.fixture(scope="module")
def truth(cam_from_world: Pose[np.ndarray]) -> list[Pose[np.ndarray]]:
    """One chair rests; the other is put elsewhere while the camera moves."""
    rests = Pose(np.tile(np.eye(3), (NUM, 1, 1)), np.tile([0.1, 0.02, -0.05], (NUM, 1)))
    moved = Pose(np.tile(np.eye(3), (NUM, 1, 1)), np.tile([-0.15, 0.0, 0.05], (NUM, 1)))
    moved.translation_m[MOVED_AT:] = [-0.02, 0.0, 0.2]
    moved.rotation[MOVED_AT:] = Rotation.from_euler("y", 80, degrees=True).as_matrix()
    return [cam_from_world @ rests, cam_from_world @ moved]


def cameras(cam_from_world: Pose[np.ndarray]) -> CameraPoses:
    matrices = np.tile(np.eye(4), (NUM, 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = cam_from_world.rotation, cam_from_world.translation_m / SCALE
    return CameraPoses(matrices)


def reads(truth: Sequence[Pose[np.ndarray]], misread: Sequence[int] = ()) -> Reads:
    """Each photograph read twice: a few degrees and per cent of the depth off, some photographs wrong altogether."""
    random, photograph = np.random.default_rng(0), np.repeat(np.arange(NUM), READS_EACH)
    rotation, position_m = [], []
    for pose in truth:
        off = Rotation.from_rotvec(random.normal(size=(len(photograph), 3)) * np.radians(3)).as_matrix()
        rotation.append(off @ pose.rotation[photograph])
        position_m.append(pose.translation_m[photograph] * np.exp(random.normal(size=(len(photograph), 1)) * 0.02))
        wrong = np.isin(photograph, misread)
        position_m[-1][wrong] += random.uniform(-0.4, 0.4, (wrong.sum(), 3))
    code = {
        ROTATION_6D: rotation_6d_from_matrix(torch.from_numpy(np.stack(rotation, axis=1)).float()),
        TRANSLATION: torch.from_numpy(np.stack(position_m, axis=1)).float(),
        CONFIDENCE: torch.full((len(photograph), len(truth), 1), 0.6),
    }
    return Reads(code, photograph)


def test_what_photographs_agree_on_is_nearer_to_the_truth_than_any_of_them_also_after_a_move(
    world: SeveralObjectsWorld, cam_from_world: Pose[np.ndarray], truth: list[Pose[np.ndarray]]
) -> None:
    misread = (3, 12)
    found = scene_poses(reads(truth, misread), cameras(cam_from_world), world.objects)
    for pose, true, kind in zip(found, truth, world.objects, strict=True):
        assert np.isfinite(pose.translation_m).all(), "also where misread: neighbours tell"
        off_m = np.linalg.norm(pose.translation_m - true.translation_m, axis=1)
        assert np.median(off_m) < 0.1 * kind.diameter_m
        angles = rotation_angle_deg(torch.from_numpy(pose.rotation), torch.from_numpy(true.rotation))
        assert float(angles.max()) < 4


def test_poses_in_metres_need_no_scale(
    world: SeveralObjectsWorld, cam_from_world: Pose[np.ndarray], truth: list[Pose[np.ndarray]]
) -> None:
    where = cameras(cam_from_world)
    matrices = where.cam_from_world.copy()
    matrices[:, :3, 3] *= SCALE
    too_far = reads(truth)
    too_far.code[TRANSLATION].mul_(1.04)  # all objects alike, which nothing but metres can tell
    found = scene_poses(too_far, CameraPoses(matrices, in_metres=True), world.objects)
    ratio = found[0].translation_m[:, 2] / truth[0].translation_m[:, 2]
    assert abs(np.median(ratio) - 1) < 0.01


def test_a_ball_needs_to_agree_on_its_position_alone(
    world: SeveralObjectsWorld, cam_from_world: Pose[np.ndarray], truth: list[Pose[np.ndarray]]
) -> None:
    axes = [(axis, np.zeros(3)) for axis in np.eye(3)[:2]]
    turned, kinds = reads(truth), [replace(kind, symmetry_axes=axes) for kind in world.objects]
    turns = Rotation.random(len(turned.photograph), random_state=0).as_matrix()
    turned.code[ROTATION_6D][:] = rotation_6d_from_matrix(torch.from_numpy(turns).float())[:, None]
    for pose, true in zip(scene_poses(turned, cameras(cam_from_world), kinds), truth, strict=True):
        assert np.median(np.linalg.norm(pose.translation_m - true.translation_m, axis=1)) < 0.02
    for pose in scene_poses(turned, cameras(cam_from_world), world.objects):
        assert np.isnan(pose.translation_m).all(), "chairs that are read so are misread"


def test_nothing_is_made_up(
    world: SeveralObjectsWorld, cam_from_world: Pose[np.ndarray], truth: list[Pose[np.ndarray]]
) -> None:
    unsure = reads(truth)
    unsure.code[CONFIDENCE][:, 1] = 0.01
    found = scene_poses(unsure, cameras(cam_from_world), world.objects)
    assert np.isfinite(found[0].translation_m).all()
    assert np.isnan(found[1].translation_m).all()

    all_wrong = scene_poses(reads(truth, range(NUM)), cameras(cam_from_world), world.objects)
    assert all(np.isnan(pose.translation_m).all() for pose in all_wrong)

    lost = cameras(cam_from_world)
    lost.cam_from_world[5:] = np.nan
    some = scene_poses(reads(truth), lost, world.objects)
    assert all(np.isnan(pose.translation_m[5:]).all() for pose in some)


@pytest.mark.parametrize(("num_agreeing", "is_found"), [(1, False), (2, True)])
def test_what_one_of_three_reads_takes_for_an_object_labels_none(
    world: SeveralObjectsWorld,
    cam_from_world: Pose[np.ndarray],
    truth: list[Pose[np.ndarray]],
    num_agreeing: int,
    is_found: bool,
) -> None:
    """Of each photograph; the first chair's other reads are somewhere else each time."""
    twice, once = reads(truth), np.repeat(np.arange(NUM), 3)
    rows = np.stack([2 * np.arange(NUM), 2 * np.arange(NUM) + 1, 2 * np.arange(NUM)], axis=1).ravel()
    read = Reads({name: values[rows].clone() for name, values in twice.code.items()}, once)
    wrong = torch.arange(3).repeat(NUM) >= num_agreeing
    random = torch.Generator().manual_seed(0)
    read.code[TRANSLATION][wrong, 0] += torch.rand(int(wrong.sum()), 3, generator=random) - 0.5
    found = scene_poses(read, cameras(cam_from_world), world.objects)
    assert np.isfinite(found[0].translation_m).all() == is_found
    assert np.isfinite(found[0].translation_m).any() == is_found
    assert np.isfinite(found[1].translation_m).all()


class OnePhotographEach:
    """Photographs that are files of one grey."""

    def __init__(self, paths: list, cameras: CameraPoses | None) -> None:
        self._found = UnlabelledPhotographs(paths, cameras)

    def unlabelled_paths(self) -> Sequence:
        return self._found.paths

    def unlabelled(self) -> UnlabelledPhotographs:
        return self._found


def marked(truth: Sequence[Pose[np.ndarray]]) -> torch.Tensor:
    """Frames with a white square where the first chair's origin is."""
    frames = torch.zeros(NUM, 3, 480, 640, dtype=torch.uint8)
    for frame, position_m in zip(frames, truth[0].translation_m, strict=True):
        x, y = (K @ position_m)[:2] / position_m[2]
        frame[:, round(y) - 4 : round(y) + 5, round(x) - 4 : round(x) + 5] = 255
    return frames


def test_drawn_frames_show_the_objects_where_their_labels_say(
    world: SeveralObjectsWorld, truth: list[Pose[np.ndarray]]
) -> None:
    labels = SceneLabels(world, marked(truth), truth)
    code, images = labels.draw(12, (1,))
    assert images.shape == (12, 3, 480 // FRAME_STRIDE, 640 // FRAME_STRIDE)
    again, same = labels.draw(12, (1,))
    assert torch.equal(images, same)
    assert torch.equal(code[TRANSLATION], again[TRANSLATION])
    half = np.diag([1 / FRAME_STRIDE, 1 / FRAME_STRIDE, 1]) @ K
    shown = 0
    for image, position_m, there in zip(images, code[TRANSLATION][:, 0], code[CONFIDENCE][:, 0, 0], strict=True):
        if there == 1:
            x, y = (half @ position_m.double().numpy())[:2] / float(position_m[2])
            row, column = divmod(int(image.mean(dim=0).argmax()), image.shape[2])
            shown += abs(column - x) < 5 and abs(row - y) < 5
    assert shown >= 9, "something may be drawn in front of a few"


def test_what_continues_a_photograph_beyond_its_border_shows_no_object(world: SeveralObjectsWorld) -> None:
    beside = Pose(np.tile(np.eye(3), (NUM, 1, 1)), np.tile([-0.54, 0.0, 0.9], (NUM, 1)))  # at column -18
    ahead = Pose(beside.rotation, np.tile([0.0, 0.0, 0.9], (NUM, 1)))
    code, _ = SceneLabels(world, torch.zeros(NUM, 3, 480, 640, dtype=torch.uint8), [beside, ahead]).draw(32, (4,))
    assert (code[CONFIDENCE][:, 0] == 0).all()
    assert (code[CONFIDENCE][:, 1] == 1).all()


def test_an_object_whose_place_nobody_knows_teaches_nothing(
    world: SeveralObjectsWorld, truth: list[Pose[np.ndarray]]
) -> None:
    unknown = Pose(np.full((NUM, 3, 3), np.nan), np.full((NUM, 3), np.nan))
    code, _ = SceneLabels(world, marked(truth), [truth[0], unknown]).draw(4, (2,))
    assert code[CONFIDENCE][:, 1].isnan().all()
    assert code[TRANSLATION].isfinite().all()
    (stage,) = world.stages
    num_cells = (480 // FRAME_STRIDE // 8) * (640 // FRAME_STRIDE // 8)
    heat = torch.zeros(4, 2, num_cells, requires_grad=True)
    proposals = torch.rand(4, 2, num_cells, 3) + 0.5
    stage.code_loss({HEAT_MAPS: heat, PROPOSALS: proposals}, code).backward()
    assert heat.grad is not None
    assert heat.grad[:, 0].abs().sum() > 0
    assert heat.grad[:, 1].abs().sum() == 0


def test_no_photographs_or_no_camera_poses_give_no_labels(
    world: SeveralObjectsWorld, caplog: pytest.LogCaptureFixture
) -> None:
    def never(_: torch.Tensor) -> dict[str, torch.Tensor]:
        raise AssertionError("nothing is there to be read")

    assert SceneLabels.from_photographs(world, never) is None
    alone = SeveralObjectsWorld("linemod", [member(0), member(1)], OnePhotographEach(["a.png"], None))
    assert SceneLabels.from_photographs(alone, never) is None
    nowhere = CameraPoses(np.full((1, 4, 4), np.nan))
    alone = SeveralObjectsWorld("linemod", [member(0), member(1)], OnePhotographEach(["a.png"], nowhere))
    assert SceneLabels.from_photographs(alone, never) is None
    assert caplog.text.count("not learned from") == 2


def test_photographs_whose_camera_nobody_knows_are_left_out(world: SeveralObjectsWorld, tmp_path: Path) -> None:
    """They would count as misread, since what is read in them agrees with nothing."""
    paths = [tmp_path / f"{number}.png" for number in range(6)]
    for number, path in enumerate(paths):
        cv2.imwrite(str(path), np.full((480, 640, 3), 40 * number, np.uint8))
    cam_from_world = np.tile(np.eye(4), (6, 1, 1))
    cam_from_world[[1, 4]] = np.nan
    photographs = OnePhotographEach(paths, CameraPoses(cam_from_world, in_metres=True))
    some = SeveralObjectsWorld("linemod", [member(0), member(1)], photographs)

    def predict(images: torch.Tensor) -> dict[str, torch.Tensor]:
        code = some.sample(len(images), (1,))
        code[CONFIDENCE] = torch.ones_like(code[CONFIDENCE])
        code[TRANSLATION] = torch.tensor([[[0.0, 0.0, 0.8], [0.1, 0.0, 0.8]]])
        code[ROTATION_6D] = torch.tensor([1.0, 0, 0, 0, 1, 0]).expand(1, 2, 6)
        return dict(code)

    labels = SceneLabels.from_photographs(some, predict)
    assert labels is not None
    assert labels.frames[:, 0, 0, 0].tolist() == [0, 80, 120, 200]
