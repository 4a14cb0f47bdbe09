"""What the two stages of a two-stage network are taught: each cell what it can know, confidence whether the answer is
right."""

from dataclasses import replace

import numpy as np
import torch
from curio_train.config import NetworkConfig
from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix
from curio_train.networks.grid import per_cell
from curio_train.networks.two_stage.crop_pose import OBJECT_COORDINATES
from curio_train.networks.two_stage.localise import HEAT_MAP, PROPOSALS
from curio_train.scene_code import CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION
from curio_train.worlds.single_object.localisation_stage import LocalisationStage
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import Object
from scipy.spatial.transform import Rotation
from torch import Tensor, nn


def test_first_look_loss_rewards_cells_that_know_their_object(brick_world: TwoStageWorld) -> None:
    first: LocalisationStage = brick_world.stages[0]
    true = first.sample(3, (1,))
    grid = first.network(NetworkConfig()).grid
    place = true[TRANSLATION]
    here = grid.splat_weights(grid.project(place))
    every, images = here.cell.flatten(1), torch.arange(3)[:, None]
    places = grid.locate(grid.pixels, torch.zeros(len(grid.pixels), 1)).repeat(3, 1, 1)
    places[images, every] = place.repeat_interleave(4, dim=1)  # where two share a cell, the last one's
    nothing = torch.full((3, len(grid.pixels)), -12.0)
    found = nothing.clone()
    found[images, every] = torch.logit(here.weight.flatten(1), 1e-4)
    losses = [float(first.code_loss({PROPOSALS: places, HEAT_MAP: amounts}, true)) for amounts in (found, nothing)]
    assert losses[0] < 3 < losses[1] - 3
    for number, name in enumerate(("across", "across", "along")):
        worse = places.clone()
        worse[..., number] += 0.05
        assert float(first.code_loss({PROPOSALS: worse, HEAT_MAP: found}, true)) > losses[0] + 0.1, name
    elsewhere = found.clone()
    elsewhere[:, [7, 100, 200]] = 5.0
    assert float(first.code_loss({PROPOSALS: places, HEAT_MAP: elsewhere}, true)) > losses[0] + 1


def told_by_cells(code: dict[str, Tensor]) -> dict[str, Tensor]:
    """The code as 64 cells say it that all agree with the whole."""
    return code | {per_cell(name): code[name].expand(-1, 64, -1) for name in (TRANSLATION, ROTATION_6D)}


def test_second_look_loss_is_least_at_the_truth_and_knows_what_looks_alike(brick_world: TwoStageWorld) -> None:
    second = brick_world.stages[1]
    true = second.sample(5, (2,))
    true[CONFIDENCE][:] = 1
    points, seen = true[OBJECT_COORDINATES].split((3, 1), dim=1)
    surface = torch.cat([points, 20 * seen - 10], dim=1)
    perfect = float(second.code_loss(told_by_cells({**true, OBJECT_COORDINATES: surface}), true))
    assert perfect < 1e-3
    turned = dict(true)
    rotation = matrix_from_rotation_6d(true[ROTATION_6D][:, 0]) @ torch.diag(torch.tensor([-1.0, -1, 1]))
    turned[ROTATION_6D] = rotation[:, None, :, :2].transpose(-1, -2).flatten(-2)
    assert float(second.code_loss(told_by_cells({**turned, OBJECT_COORDINATES: surface}), true)) < 1e-3
    mirrored = surface * torch.tensor([-1.0, -1, 1, 1])[:, None, None]
    assert float(second.code_loss(told_by_cells({**true, OBJECT_COORDINATES: mirrored}), true)) < 1e-3
    for name, change in (
        (TRANSLATION, 0.05),
        (ROTATION_6D, 0.3),
        (LIGHT, 0.3),
        (OBJECT_COORDINATES, 0.3),
        (CONFIDENCE, -0.5),
    ):
        worse = {**true, OBJECT_COORDINATES: surface}
        worse[name] = worse[name] + change
        assert float(second.code_loss(told_by_cells(worse), true)) > perfect + 5e-3, name


def test_each_cell_that_sees_the_object_is_to_say_its_pose(brick_world: TwoStageWorld) -> None:
    """Cells count by how much of it they see; those that see the background alone may say anything."""
    second = brick_world.stages[1]
    true = second.sample(5, (2,))
    true[CONFIDENCE][:] = 1
    right = told_by_cells(true | {OBJECT_COORDINATES: torch.zeros(5, 4, 16, 16)})
    seen = nn.functional.avg_pool2d(true[OBJECT_COORDINATES][:, 3:], 2).flatten(1)
    empty = torch.where(seen == 0, 1.0, 0.0)[..., None]
    assert 0 < empty.mean() < 1
    best = float(second.code_loss(right, true))
    for name, change in ((TRANSLATION, 0.05), (ROTATION_6D, 0.3)):
        for cells, counts in ((empty, False), (1 - empty, True)):
            worse = float(second.code_loss(right | {per_cell(name): right[per_cell(name)] + change * cells}, true))
            assert (worse > best + 5e-3) == counts, name


def test_confidence_is_to_foretell_whether_the_pose_is_right(brick_world: TwoStageWorld) -> None:
    """Certainty pays where ADD is below a tenth of the diameter, doubt where it is not or where nothing is there."""
    second = brick_world.stages[1]
    true = second.sample(6, (2,))
    surface = torch.zeros(6, 4, 16, 16)

    def doubt_pays(there: float, shift: float) -> bool:
        scene = true | {CONFIDENCE: torch.full((6, 1, 1), there)}
        read = scene | {TRANSLATION: true[TRANSLATION] + torch.tensor([shift, 0, 0]), OBJECT_COORDINATES: surface}
        read = told_by_cells(read)
        sure, unsure = (read | {CONFIDENCE: torch.full((6, 1, 1), value)} for value in (0.9, 0.1))
        return bool(second.code_loss(unsure, scene) < second.code_loss(sure, scene))

    assert not doubt_pays(1.0, 0.08)
    assert doubt_pays(1.0, 0.12)
    assert doubt_pays(0.0, 0.0)


def test_rotation_is_learned_from_where_nothing_is_known(brick: Object) -> None:
    """Numbers near zero that mean opposite rotations err as little; the right ones, at full length, err least."""
    look = TwoStageWorld("capture", brick).stages[1]
    true = look.sample(8, (1,))
    true[CONFIDENCE][:] = 1
    told = {**true, CONFIDENCE: torch.full_like(true[CONFIDENCE], 0.5)}

    def loss(numbers: torch.Tensor) -> float:
        return float(look.code_loss(told_by_cells({**told, ROTATION_6D: numbers}), true))

    right = true[ROTATION_6D]
    quarter = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    wrong = rotation_6d_from_matrix(matrix_from_rotation_6d(right) @ quarter)
    assert loss(right) < loss(0.5 * right) < loss(0.001 * right)
    assert loss(0.001 * wrong) < loss(wrong)


def test_gradients_reach_every_weight_of_both_looks(brick_world: TwoStageWorld, tmp_path) -> None:
    for look in brick_world.stages:
        network = look.network(NetworkConfig())
        code = look.sample(4, (1,))
        look.code_loss(network(look.render(code)), code).backward()
        assert all(p.grad is not None and p.grad.isfinite().all() for p in network.parameters())


def test_every_rotation_of_a_ball_is_right(brick: Object) -> None:
    """Whatever is read of it, the loss is that of the truth, and a confidence of 1 is right."""
    axes = tuple((np.eye(3)[number], np.zeros(3)) for number in (0, 2))
    ball = replace(brick, kind=replace(brick.kind, symmetries=(), symmetry_axes=axes))
    second = TwoStageWorld("linemod", ball).stages[1]
    true = second.sample(4, (2,))
    true[CONFIDENCE][:] = 1
    points, seen = true[OBJECT_COORDINATES].split((3, 1), dim=1)
    surface = torch.cat([points, 20 * seen - 10], dim=1)
    turns = torch.from_numpy(Rotation.random(4, random_state=0).as_matrix()).float()
    rotation = matrix_from_rotation_6d(true[ROTATION_6D][:, 0]) @ turns
    turned = {**true, OBJECT_COORDINATES: surface, ROTATION_6D: rotation_6d_from_matrix(rotation)[:, None]}
    assert float(second.code_loss(told_by_cells(turned), true)) < 1e-3
    farther = turned | {TRANSLATION: true[TRANSLATION] * torch.tensor([1, 1, 1.2])}
    assert float(second.code_loss(told_by_cells(farther), true)) > 0.1
