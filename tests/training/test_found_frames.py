"""Poses that are found in frames whose codes nobody tells, and what the stages learn from them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from curio_train.data.backgrounds import ClutterBackgrounds
from curio_train.errors import TrainingError
from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix, rotation_angle_deg
from curio_train.meshes.shapes import box
from curio_train.refinement.crops import rotation_from_vector
from curio_train.refinement.found_frames import FrameExplainer, TrainingFrames, stage_sources
from curio_train.scene_code import CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION, SceneCode, index
from curio_train.worlds.single_object.crop_pose_stage import ABSENT_FRACTION
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import Object
from torch import Tensor

NUM = 12


@pytest.fixture(scope="module")
def frames(brick_world: TwoStageWorld, tmp_path_factory: pytest.TempPathFactory) -> TrainingFrames:
    return TrainingFrames(brick_world, 0, tmp_path_factory.mktemp("cache"), NUM)


@pytest.fixture(scope="module")
def true_code(brick_world: TwoStageWorld, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Tensor]:
    """What the frames show; only tests know it."""
    stream = brick_world.source("train", 0, with_code=True, cache=tmp_path_factory.mktemp("cache"))
    codes = [stream.batch(number, 1).code for number in range(NUM)]
    return {
        name: torch.cat([code[name] for code in codes if code is not None])
        for name in (TRANSLATION, ROTATION_6D, LIGHT, CONFIDENCE)
    }


def test_frames_are_those_of_the_training_stream(
    brick_world: TwoStageWorld, frames: TrainingFrames, tmp_path: Path
) -> None:
    stream = brick_world.source("train", 0, with_code=False, cache=tmp_path)
    assert len(frames) == NUM
    assert frames[2:5].shape == (3, 3, 480, 640)
    expected = (stream.batch(3, 1).images[0].clamp(0, 1) * 255).round().byte()
    assert torch.equal(frames[3:4][0], expected)
    assert len(frames[10:100]) == 2


@pytest.fixture(scope="module")
def colorful_world(brick: Object) -> TwoStageWorld:
    """A box of many colours before others."""
    mesh = box((0.09, 0.06, 0.12))
    colors = (mesh.vertices_m - mesh.vertices_m.min(axis=0)) / np.ptp(mesh.vertices_m, axis=0)
    pool = np.random.default_rng(0).integers(0, 255, (5, 24, 32, 3), np.uint8).repeat(10, 1).repeat(10, 2)
    one = replace(
        brick,
        kind=replace(brick.kind, symmetries=()),
        mesh=replace(mesh, vertex_colors_srgb=colors),
        backgrounds=lambda _: ClutterBackgrounds(pool),
    )
    return TwoStageWorld("linemod", one)


def test_poses_are_refined_and_those_that_explain_nothing_are_not_kept(
    colorful_world: TwoStageWorld, tmp_path: Path
) -> None:
    batch = colorful_world.source("train", 0, with_code=True, cache=tmp_path).batch(0, 20)
    assert batch.code is not None
    near = torch.arange(20) < 10
    turn = rotation_from_vector(torch.where(near[:, None], 0.1, 2.0) * torch.tensor([0.6, 0.0, 0.8]))
    rotation = matrix_from_rotation_6d(batch.code[ROTATION_6D][:, 0])
    rough = dict(batch.code) | {ROTATION_6D: rotation_6d_from_matrix(turn @ rotation)[:, None]}
    rows = iter(range(20))
    images = (batch.images.clamp(0, 1) * 255).round().byte()
    found = FrameExplainer(colorful_world, lambda _: index(rough, slice(row := next(rows), row + 1))).explain(images)
    kept = found[CONFIDENCE][:, 0, 0] > 0
    off = rotation_angle_deg(matrix_from_rotation_6d(found[ROTATION_6D][:, 0]), rotation)
    assert kept[near].sum() >= 3
    assert off[kept & near].median() < 2
    assert kept[~near].sum() <= 1


def test_stages_learn_from_kept_frames_alone(
    brick_world: TwoStageWorld, frames: TrainingFrames, true_code: SceneCode
) -> None:
    code = dict(true_code) | {CONFIDENCE: torch.zeros(NUM, 1, 1)}
    code[CONFIDENCE][[1, 4, 7]] = 1
    positions, crops = stage_sources(brick_world, frames, code, 0)
    whole, cut = positions.batch(0, 4), crops.batch(0, 14)
    assert whole.images.shape == (4, 3, 120, 160)
    assert cut.images.shape == (14, 3, 64, 64)
    assert cut.code is not None
    assert cut.code[CONFIDENCE].sum() == 14 - round(ABSENT_FRACTION * 14)
    again = crops.batch(0, 14)
    assert torch.equal(again.images, cut.images)
    assert not torch.equal(crops.batch(1, 14).images, cut.images)


def test_crops_show_what_their_codes_say(
    brick_world: TwoStageWorld, frames: TrainingFrames, true_code: SceneCode
) -> None:
    _, crops = stage_sources(brick_world, frames, true_code, 0)
    batch = crops.batch(0, 32)
    stage = brick_world.stages[1]
    assert batch.code is not None
    present = batch.code[CONFIDENCE][:, 0, 0] > 0
    code = {name: value[present] for name, value in batch.code.items()}
    other = {name: value.roll(1, dims=0) for name, value in code.items()}
    backgrounds = torch.full_like(batch.images[present], 128 / 255)
    with torch.no_grad():
        error, other_error = (
            (stage.render(one, backgrounds) - batch.images[present]).square().mean() for one in (code, other)
        )
    assert error < 0.4 * other_error  # exposures and gains are not part of the codes


def test_turned_frames_show_the_object_where_their_codes_say(
    brick_world: TwoStageWorld, frames: TrainingFrames, true_code: SceneCode
) -> None:
    positions, _ = stage_sources(brick_world, frames, true_code, 0)
    batch = positions.batch(0, 24)
    stage = brick_world.stages[0]
    assert batch.code is not None
    assert stage.camera.matrix is not None
    pixels = batch.code[TRANSLATION][:, 0].double().numpy() @ stage.camera.matrix.T
    columns, rows = np.rint(pixels[:, :2] / pixels[:, 2:]).astype(int).clip(0, (159, 119)).T
    shown = (batch.images[np.arange(24), :, rows, columns] - 128 / 255).abs().amax(dim=1)
    assert (shown > 0.02).float().mean() > 0.9  # all else is the grey wall


def test_nothing_found_is_an_error(brick_world: TwoStageWorld, frames: TrainingFrames, true_code: SceneCode) -> None:
    code = dict(true_code) | {CONFIDENCE: torch.zeros(NUM, 1, 1)}
    with pytest.raises(TrainingError, match="nothing to learn from; use --method sleep"):
        stage_sources(brick_world, frames, code, 0)
