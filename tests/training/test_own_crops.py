"""Crops around a detector's own first answers, and image loss and critic on them."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from curio_train.config import Recipe, RunConfig
from curio_train.data.photographs import UnlabelledPhotographs
from curio_train.errors import UsageError
from curio_train.learning.parallel import Ranks
from curio_train.learning.trainer import Trainer
from curio_train.networks.base import StageNetwork
from curio_train.refinement.own_crops import OwnCrops
from curio_train.scene_code import CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION
from curio_train.worlds.options import LinemodOptions
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object.crop_pose_loss import ASSUMED_DEPTH
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import EXPOSURE, Object
from PIL import Image
from torch import Tensor

CONFIG = RunConfig(
    LinemodOptions("brick"),
    method="our",
    init=Path("runs/found"),
    recipe=Recipe(batch_size=8, micro_batch_size=8, learning_rate=1e-3, critic_learning_rate=1e-4, critic_weight=0.1),
)


class Knowing(StageNetwork):
    """Answers with positions that it was given, one frame after the other."""

    def __init__(self, position_m: Tensor) -> None:
        super().__init__()
        self.encoder = torch.nn.Sequential()
        self.position_m, self.asked = position_m, 0

    def decode(self, features: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        self.asked += len(features)
        return {}, {TRANSLATION: self.position_m[self.asked - len(features) : self.asked]}


def test_crops_lie_around_first_answers(brick_world: TwoStageWorld, tmp_path: Path) -> None:
    frames = brick_world.source("train", 0, with_code=True, cache=tmp_path)
    true = [frames.batch(number, 1).code for number in range(4)]
    position_m = torch.cat([code[TRANSLATION] for code in true if code is not None])
    source = OwnCrops(brick_world, Knowing(position_m), frames, 0, num_frames=4)
    batch = source.batch(0, 16)
    assert batch.code is None
    assert batch.backgrounds is not None
    assert batch.images.shape == batch.backgrounds.shape == (16, 3, 64, 64)
    object_pixels = ((batch.images - batch.backgrounds).abs().amax(1) > 0.02).float().mean((1, 2))
    assert object_pixels.median() > 0.05  # the object's diameter spans 0.6 of the side
    assert (batch.given[ASSUMED_DEPTH] > 0.3).all()
    assert torch.equal(source.batch(0, 16).images, batch.images)


class Files:
    """Photographs."""

    def __init__(self, paths: list[Path]) -> None:
        self.paths = paths

    def unlabelled_paths(self) -> list[Path]:
        return self.paths

    def unlabelled(self) -> UnlabelledPhotographs:
        raise AssertionError("nobody asks for camera poses")


def test_backgrounds_of_photographs_are_what_surrounds_the_object(brick: Object, tmp_path: Path) -> None:
    world = TwoStageWorld("linemod", brick)
    frames = world.source("train", 0, with_code=True, cache=tmp_path)
    shown = [frames.batch(number, 1) for number in range(4)]
    position_m = torch.cat([batch.code[TRANSLATION] for batch in shown if batch.code is not None])
    grey = torch.full((1, 3, 480, 640), 0.5)
    paths = []
    for number, batch in enumerate(shown):
        assert batch.code is not None
        pixels = (world.render(batch.code, grey)[0].permute(1, 2, 0).clamp(0, 1) * 255).byte().numpy()
        paths.append(tmp_path / f"{number}.png")
        Image.fromarray(pixels).save(paths[-1])
    world = TwoStageWorld("linemod", brick, Files(paths))
    asked = Knowing(torch.cat([position_m, position_m]))  # for the frames, then for the photographs
    source = OwnCrops(world, asked, frames, 0, photographed=0.5, num_frames=4)
    batch = source.batch(0, 16)
    assert batch.backgrounds is not None
    behind, differing = batch.backgrounds[:8], (batch.images - batch.backgrounds).abs().amax(1) > 0.02
    assert (behind - 0.5).abs().max() < 0.1  # the wall, not the object
    assert differing[:8].float().mean((1, 2)).median() > 0.05  # which the crops show


@pytest.mark.parametrize(
    ("method", "terms"),
    [("our", {"image", "curiosity", "critic"}), ("noncur", {"image"}), ("wake_sleep", {"image", "sleep"})],
)
def test_image_loss_teaches_the_second_stage_alone(
    brick_world: TwoStageWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str, terms: set[str]
) -> None:
    monkeypatch.setattr("curio_train.learning.trainer.OwnCrops", partial(OwnCrops, num_frames=2))
    frames = brick_world.source("train", 0, with_code=False, cache=tmp_path)
    crops = brick_world.stages[1].source("train", 0, with_code=False, cache=tmp_path)
    trainer = Trainer(replace(CONFIG, method=method), brick_world, [frames, crops], Ranks(0, 1, torch.device("cpu")))
    before = [[value.clone() for value in stage.parameters()] for stage in trainer.state.stages]
    losses = trainer.step(1.0)
    assert set(losses) == terms
    changed = [
        any(not torch.equal(*pair) for pair in zip(old, stage.parameters(), strict=True))
        for old, stage in zip(before, trainer.state.stages, strict=True)
    ]
    assert changed == [False, True]


def test_a_detector_whose_first_stage_is_not_trained_is_refused(brick_world: TwoStageWorld, tmp_path: Path) -> None:
    frames = brick_world.source("train", 0, with_code=False, cache=tmp_path)
    with pytest.raises(UsageError, match="add --init RUN, of --method hypotheses or sleep"):
        Trainer(replace(CONFIG, init=None), brick_world, [frames], Ranks(0, 1, torch.device("cpu")))


def test_a_detector_whose_poses_are_those_of_templates_is_refused(brick: Object) -> None:
    world = SeveralObjectsWorld("bricks", [brick])
    with pytest.raises(UsageError, match=r"--method our .*templates: use --method sleep"):
        Trainer(CONFIG, world, [], Ranks(0, 1, torch.device("cpu")))


def test_the_exposure_of_crops_is_found(brick_world: TwoStageWorld) -> None:
    stage = brick_world.stages[1]
    code = stage.sample(6, (0,))
    code[CONFIDENCE] = torch.ones(6, 1, 1)
    code[EXPOSURE] = torch.rand(6, 1, 3, generator=torch.Generator().manual_seed(0)) * 0.6 + 0.3
    code[LIGHT] = torch.tensor([0.0, 0.0, -0.5]).expand(6, 3)
    images = stage.render(code)
    said = {name: code[name] for name in (TRANSLATION, ROTATION_6D, LIGHT, CONFIDENCE, ASSUMED_DEPTH)}
    found = stage.comparable(said | {CONFIDENCE: torch.full((6, 1, 1), 0.3)}, images)
    assert CONFIDENCE not in found  # it is no transparency
    torch.testing.assert_close(found[EXPOSURE], code[EXPOSURE], atol=0.02, rtol=0)
