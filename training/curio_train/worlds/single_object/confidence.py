"""A gaze's confidence as a probability, set by its own renderings when training is done."""

from itertools import repeat
from pathlib import Path

import torch
from torch import Tensor, nn

from curio_train.metrics.calibration import fit_calibration
from curio_train.metrics.poses import ADD_THRESHOLD, add_or_add_s_m
from curio_train.networks.two_stage.network import CalibrationFeatures, TwoStageNetwork
from curio_train.scene_code import poses
from curio_train.worlds.single_object.world import SingleObjectWorld

_NUM_FRAMES, _BATCH_SIZE = 300, 25
_NUM_POINTS = 500  # vertices that ADD is measured at, about


@torch.no_grad()
def calibrate(network: nn.Module, world: SingleObjectWorld, cache: Path) -> None:
    """Make the confidence of a gaze the probability of a right pose, by whole frames that nothing was learned from.

    Rightness is judged where the object is; as many empty frames tell what it looks like to the network if it is not.
    """
    assert isinstance(network, TwoStageNetwork)
    source, kind = world.source("validation", 0, with_code=True, cache=cache), world.object.kind
    points = world.object.mesh.vertices_m[:: max(1, len(world.object.mesh.vertices_m) // _NUM_POINTS)]
    network.eval()
    steps = _NUM_FRAMES // _BATCH_SIZE
    full: list[CalibrationFeatures] = []
    empty: list[CalibrationFeatures] = []
    right: list[bool] = []
    for step in range(steps):
        batch = source.batch(step, _BATCH_SIZE)
        assert batch.code is not None
        code, features = network.uncalibrated(batch.images.clamp(0, 1))
        errors = map(add_or_add_s_m, poses(code), poses(batch.code), repeat(points), repeat(kind.info))
        right += [error < ADD_THRESHOLD * kind.diameter_m for error in errors]
        full.append(features)
        behind = source.backgrounds(steps + step, _BATCH_SIZE)
        assert behind is not None  # of a gaze's world there always are
        empty.append(network.uncalibrated(behind.clamp(0, 1))[1])
    network.rightness.copy_(_fit([features.pose_correct for features in full], right))
    there = [True] * _NUM_FRAMES + [False] * _NUM_FRAMES
    network.presence.copy_(_fit([features.presence for features in (*full, *empty)], there))


def _fit(features: list[Tensor], correct: list[bool]) -> Tensor:
    return torch.tensor(fit_calibration(torch.cat(features).cpu().numpy(), correct))
