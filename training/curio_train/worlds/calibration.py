"""A gaze's confidence as a probability, set by its own renderings when training is done."""

from itertools import repeat
from pathlib import Path

import torch
from torch import nn

from curio_train.metrics.certainty import calibration
from curio_train.metrics.poses import ADD_THRESHOLD, add_or_add_s_m
from curio_train.networks.gaze import GazeNetwork
from curio_train.scene_code import CONFIDENCE, poses
from curio_train.worlds.single_object import SingleObjectWorld

_NUM_FRAMES, _BATCH_SIZE = 300, 25
_NUM_POINTS = 500  # vertices that ADD is measured at, about


@torch.no_grad()
def calibrate(network: nn.Module, world: SingleObjectWorld, cache: Path) -> None:
    """Make the confidence of a gaze the probability of a right pose, by whole frames that nothing was learned from."""
    source, kind = world.source("validation", 0, with_code=True, cache=cache), world.object.kind
    info = kind.info
    points = world.object.mesh.vertices_m[:: max(1, len(world.object.mesh.vertices_m) // _NUM_POINTS)]
    assert isinstance(network, GazeNetwork)
    network.calibration.copy_(torch.tensor([1.0, 0.0]))
    network.eval()
    confidences: list[float] = []
    right: list[bool] = []
    for step in range(_NUM_FRAMES // _BATCH_SIZE):
        batch = source.batch(step, _BATCH_SIZE)
        assert batch.code is not None
        code = network(batch.images.clamp(0, 1))
        confidences += code[CONFIDENCE].flatten().tolist()
        errors = map(add_or_add_s_m, poses(code), poses(batch.code), repeat(points), repeat(info))
        right += [error < ADD_THRESHOLD * kind.diameter_m for error in errors]
    network.calibration.copy_(torch.tensor(calibration(confidences, right)))
