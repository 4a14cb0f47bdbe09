"""What a two-stage network is taught of photographs agrees with what they show, and nothing is taught of what was not
found."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from curio_train.camera import Intrinsics
from curio_train.config import NetworkConfig, Recipe
from curio_train.data.backgrounds import ClutterBackgrounds
from curio_train.data.photographs import UnlabelledPhotographs
from curio_train.errors import UsageError
from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix, rotation_angle_deg
from curio_train.learning.self_training import ROUNDS, ROUNDS_OF_PRETRAINED, SelfTraining
from curio_train.meshes.shapes import chair
from curio_train.networks.two_stage.crop_pose import OBJECT_COORDINATES
from curio_train.refinement.pseudo_labels import PseudoLabels
from curio_train.scene_code import CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION, SceneCode
from curio_train.worlds.base import ObjectKind
from curio_train.worlds.single_object.crop_pose_loss import ASSUMED_DEPTH
from curio_train.worlds.single_object.crop_pose_stage import CROP_PX, MAX_LOG_SCALE, MAX_OFFSET
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import Object
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

K = np.array([[572.4, 0, 325.3], [0, 573.6, 242.0], [0, 0, 1]])
MESH = chair(0.12)
NUM = 6


@pytest.fixture(scope="module")
def world() -> TwoStageWorld:
    kind = ObjectKind("chair", (0,), MESH.diameter_m, MESH.box_corners_m, MESH.sha256)
    pool = np.full((2, 480, 640, 3), 128, np.uint8)
    thing = Object(kind, MESH, Intrinsics(K, 640, 480), 0.5, 1.0, lambda _: ClutterBackgrounds(pool))
    return TwoStageWorld("linemod", thing)


@pytest.fixture(scope="module")
def truth(world: TwoStageWorld) -> SceneCode:
    code = world.sample(NUM, (1,))
    code[TRANSLATION][..., :2] *= 0.5
    return code


@pytest.fixture(scope="module")
def behind(world: TwoStageWorld) -> Tensor:
    return world.backgrounds(Path()).draw(NUM, 640, 480, (2,))


@pytest.fixture(scope="module")
def frames(world: TwoStageWorld, truth: SceneCode, behind: Tensor) -> Tensor:
    return (world.render(truth, behind).clamp(0, 1) * 255).round().byte()


def roughly(code: SceneCode) -> dict[str, Tensor]:
    """The code as a network might read it: turned by six degrees, 3 % too far."""
    turn = torch.from_numpy(Rotation.from_rotvec(np.radians([6.0, 0, 0])).as_matrix()).float()
    rotation = rotation_6d_from_matrix(turn @ matrix_from_rotation_6d(code[ROTATION_6D][:, 0]))[:, None]
    return dict(code) | {TRANSLATION: code[TRANSLATION] * 1.03, ROTATION_6D: rotation}


def test_crops_look_like_what_their_codes_render(world: TwoStageWorld, truth: SceneCode, frames: Tensor) -> None:
    look = world.stages[1]
    code, crops = PseudoLabels(world, frames, truth).draw(16, (3,))
    assert crops.shape == (16, 3, CROP_PX, CROP_PX)
    rendered = look.render(code | {"exposure": torch.ones(16, 1, 3)}, torch.full_like(crops, 128 / 255))
    shifted = look.render(
        code | {TRANSLATION: code[TRANSLATION] + torch.tensor([0.1, 0, 0])}, torch.full_like(crops, 128 / 255)
    )
    # Exposure and gain are not in the code, so shapes are compared, not shades. Crops' corners show the background.
    seen, drawn, wrong = ((im - im[..., :1, :1]).abs().mean(1) > 0.03 for im in (crops, rendered, shifted))
    overlap = (seen & drawn).sum() / (seen | drawn).sum()
    assert overlap > 0.85
    assert (seen & wrong).sum() / (seen | wrong).sum() < overlap - 0.15


def test_codes_are_those_of_a_first_look_that_errs(world: TwoStageWorld, truth: SceneCode, frames: Tensor) -> None:
    code, _ = PseudoLabels(world, frames, truth).draw(64, (4,))
    slope = (code[TRANSLATION][..., :2] / code[TRANSLATION][..., 2:]).abs()
    assert 0.7 * MAX_OFFSET < slope.max() < 1.15 * MAX_OFFSET  # the crop's camera is turned, too
    logs = code[TRANSLATION][..., 2].log()
    assert logs.min() < -0.7 * MAX_LOG_SCALE
    assert logs.max() > 0.7 * MAX_LOG_SCALE
    assert logs.abs().max() < 1.1 * MAX_LOG_SCALE
    expected = {TRANSLATION, ROTATION_6D, LIGHT, CONFIDENCE, ASSUMED_DEPTH, OBJECT_COORDINATES}
    assert set(code) == expected
    assert (code[CONFIDENCE] == 1).all()
    strength = truth[LIGHT].norm(dim=1)
    assert ((code[LIGHT].norm(dim=1)[:, None] - strength).abs().min(1).values < 1e-4).all()


def test_the_same_seed_gives_the_same_crops(world: TwoStageWorld, truth: SceneCode, frames: Tensor) -> None:
    lessons = PseudoLabels(world, frames, truth)
    assert torch.equal(lessons.draw(4, (5,))[1], lessons.draw(4, (5,))[1])
    assert not torch.equal(lessons.draw(4, (5,))[1], lessons.draw(4, (6,))[1])


def test_what_is_read_is_refined_before_it_is_taught(world: TwoStageWorld, truth: SceneCode, frames: Tensor) -> None:
    read = roughly(truth)
    lessons = PseudoLabels.from_predictions(
        world, frames, lambda images: {n: v[: len(images)] for n, v in read.items()}
    )
    assert lessons is not None
    assert len(lessons) >= NUM - 1
    code, _ = lessons.draw(32, (7,))
    taught = matrix_from_rotation_6d(lessons._code[ROTATION_6D][:, 0])
    nearest = rotation_angle_deg(
        taught[:, None].expand(-1, NUM, 3, 3),
        matrix_from_rotation_6d(truth[ROTATION_6D][:, 0]).expand(len(lessons), NUM, 3, 3),
    ).min(dim=1)
    assert nearest.values.median() < 2
    assert all(value.isfinite().all() for value in code.values())


def test_nothing_is_learned_of_photographs_without_the_object(
    world: TwoStageWorld, truth: SceneCode, behind: Tensor
) -> None:
    empty = (behind * 255).byte()
    assert PseudoLabels.from_predictions(world, empty, lambda _: dict(truth)) is None


class Remembering(nn.Module):
    """Answers with a code, and counts how often it was asked."""

    def __init__(self, code: SceneCode) -> None:
        super().__init__()
        self.code, self.calls = code, 0

    def forward(self, images: Tensor) -> dict[str, Tensor]:
        assert not self.training
        self.calls += 1
        return {name: value[: len(images)] for name, value in self.code.items()}


class Photographs:
    """Photographs without camera poses."""

    def __init__(self, paths: list[Path]) -> None:
        self.paths = paths

    def unlabelled_paths(self) -> list[Path]:
        return self.paths

    def unlabelled(self) -> UnlabelledPhotographs:
        return UnlabelledPhotographs(self.paths)


def photographed(object_: Object, paths: list[Path]) -> TwoStageWorld:
    return TwoStageWorld("photographed", object_, Photographs(paths))


@pytest.fixture
def paths(frames: Tensor, tmp_path: Path) -> list[Path]:
    files = [tmp_path / f"{number}.png" for number in range(len(frames))]
    for file, frame in zip(files, frames, strict=True):
        cv2.imwrite(str(file), cv2.cvtColor(frame.permute(1, 2, 0).numpy(), cv2.COLOR_RGB2BGR))
    return files


def test_photographs_are_mixed_in_after_the_first_round(
    world: TwoStageWorld, truth: SceneCode, paths: list[Path]
) -> None:
    network = Remembering(roughly(truth)).train()
    training = SelfTraining(network, photographed(world.object, paths), 0.25, torch.device("cpu"))
    look = world.stages[1]
    code = look.sample(8, (1,))
    images = look.render(code)
    before, same = training.mix_in(code, images, (2,))
    assert torch.equal(same, images)
    assert set(before) == set(code)

    assert not training.is_due(ROUNDS[0] - 0.01)
    assert training.is_due(ROUNDS[0])
    training.run_round(ROUNDS[0])
    assert network.calls == 1
    assert network.training
    assert not training.is_due(ROUNDS[1] - 0.01)
    assert training.is_due(ROUNDS[1])

    mixed, crops = training.mix_in(code, images, (2,))
    assert torch.equal(crops[:6], images[2:])
    assert not torch.equal(crops[6:], images[:2])
    assert torch.equal(mixed[TRANSLATION][:6], code[TRANSLATION][2:])
    assert look.code_loss(look.network(NetworkConfig())(crops), mixed).isfinite()
    few, rendered = training.mix_in({name: value[:2] for name, value in code.items()}, images[:2], (2,))
    assert torch.equal(rendered, images[:2]), "a quarter of two rounds to none"
    assert torch.equal(few[TRANSLATION], code[TRANSLATION][:2])


def test_a_pretrained_network_has_earlier_rounds(world: TwoStageWorld, truth: SceneCode) -> None:
    """A round over no photographs counts as one."""
    network = Remembering(roughly(truth)).train()
    training = SelfTraining(network, photographed(world.object, []), 0.25, torch.device("cpu"), pretrained=True)
    assert ROUNDS_OF_PRETRAINED[0] < ROUNDS[0]
    assert training.is_due(ROUNDS_OF_PRETRAINED[0])
    training.run_round(ROUNDS_OF_PRETRAINED[0])
    assert not training.is_due(ROUNDS_OF_PRETRAINED[1] - 0.01)
    assert training.is_due(ROUNDS_OF_PRETRAINED[1])


def test_photographs_alone_are_refused() -> None:
    with pytest.raises(UsageError, match="--self-training"):
        Recipe(self_training=1.0)
