"""Calibration of a two-stage detector's confidence, on renderings after training."""

from pathlib import Path

import torch
from torch import Tensor

from curio_train.counting import counted
from curio_train.metrics.calibration import fit_calibration
from curio_train.metrics.poses import are_right
from curio_train.networks.two_stage.network import CalibrationFeatures, TwoStageNetwork
from curio_train.scene_code import poses
from curio_train.worlds.single_object.world import SingleObjectWorld

NUM_FRAMES = 300
"""Frames with the object that calibrate the confidence, and as many without; a multiple of 25."""

_BATCH_SIZE = 25
_NUM_POINTS = 500  # about so many vertices for ADD


@torch.no_grad()
def calibrate(network: TwoStageNetwork, world: SingleObjectWorld, cache: Path) -> None:
    """Make the network's confidence the probability of a correct pose, in place.

    Frames with the object calibrate the probability that the pose is correct if it is present; as many frames without
    it calibrate the probability that it is present.

    Args:
        network: With both stages.
        world: Renders the frames; those of its validation split, which no network is trained with.
        cache: Of backgrounds.
    """
    source, kind = world.source("validation", 0, with_code=True, cache=cache), world.object.kind
    points = world.object.mesh.thinned_m(_NUM_POINTS)
    network.eval()
    steps = NUM_FRAMES // _BATCH_SIZE
    with_object: list[CalibrationFeatures] = []
    without: list[CalibrationFeatures] = []
    correct: list[bool] = []
    for step in counted(range(steps), steps, "calibrating the confidence, batches"):
        batch = source.batch(step, _BATCH_SIZE)
        assert batch.code is not None
        code, features = network.uncalibrated(batch.images.clamp(0, 1))
        correct += are_right(poses(code), poses(batch.code), points, kind.info)
        with_object.append(features)
        empty = source.backgrounds(steps + step, _BATCH_SIZE)
        without.append(network.uncalibrated(empty.clamp(0, 1))[1])
    network.rightness.copy_(_fit([features.pose_correct for features in with_object], correct))
    present = [True] * NUM_FRAMES + [False] * NUM_FRAMES
    network.presence.copy_(_fit([features.presence for features in (*with_object, *without)], present))


def _fit(features: list[Tensor], correct: list[bool]) -> Tensor:
    return torch.tensor(fit_calibration(torch.cat(features).cpu().numpy(), correct))
