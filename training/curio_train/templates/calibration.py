"""A template network's confidence as a probability, and its distances unbiased, by renderings of its own."""

from itertools import repeat
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from curio_train.geometry import Pose
from curio_train.metrics.calibration import fit_calibration
from curio_train.metrics.poses import ADD_THRESHOLD, add_or_add_s_m
from curio_train.scene_code import poses
from curio_train.templates.network import Evidence, TemplateNetwork
from curio_train.worlds.single_object.world import SingleObjectWorld

_NUM_FRAMES, _BATCH_SIZE = 160, 8
_NUM_POINTS = 500  # vertices that ADD is measured at, about
_NEARLY = 0.5  # diameters: poses with a larger ADD say nothing about the bias of distances


@torch.no_grad()
def calibrate(network: TemplateNetwork, world: SingleObjectWorld, cache: Path) -> None:
    """Set the network's distance factor and its confidence by whole frames, disturbed as real cameras disturb them.

    Whether a pose is right is judged on frames with the object; as many frames without it teach how its absence looks.

    Raises:
        DataError: The backgrounds cannot be read.
    """
    source, kind = world.source("validation", 0, with_code=True, cache=cache), world.object.kind
    points = world.object.mesh.vertices_m[:: max(1, len(world.object.mesh.vertices_m) // _NUM_POINTS)]
    steps = _NUM_FRAMES // _BATCH_SIZE
    found: list[Pose] = []
    true: list[Pose] = []
    full: list[Evidence] = []
    empty: list[Evidence] = []
    network.depth_factor.fill_(1.0)
    for step in range(steps):
        batch = source.batch(step, _BATCH_SIZE)
        assert batch.code is not None
        code, evidence = network.read(world.augment(batch.images, (0, step)).clamp(0, 1))
        found, true = found + poses(code), true + poses(batch.code)
        full.append(evidence)
        behind = source.backgrounds(steps + step, _BATCH_SIZE)
        assert behind is not None  # these worlds always have some
        empty.append(network.read(world.augment(behind, (1, step)).clamp(0, 1))[1])

    def errors(factor: float) -> np.ndarray:
        moved = [Pose(pose.rotation, pose.translation_m * factor) for pose in found]
        return np.array(list(map(add_or_add_s_m, moved, true, repeat(points), repeat(kind.info)))) / kind.diameter_m

    factor = _depth_factor(found, true, errors(1.0) < _NEARLY)
    network.depth_factor.fill_(factor)
    right = (errors(factor) < ADD_THRESHOLD).tolist()
    network.rightness.copy_(_fit([evidence.right for evidence in full], right))
    there = [True] * len(right) + [False] * len(right)
    network.presence.copy_(_fit([evidence.there for evidence in (*full, *empty)], there))


def _depth_factor(found: list[Pose], true: list[Pose], nearly: np.ndarray) -> float:
    """Median ratio of true to predicted distance over poses that were nearly right; 1 if there are none."""
    ratios = [t.translation_m[2] / f.translation_m[2] for f, t in zip(found, true, strict=True)]
    return float(np.median(np.array(ratios)[nearly])) if nearly.any() else 1.0


def _fit(evidence: list[Tensor], is_so: list[bool]) -> Tensor:
    return torch.tensor(fit_calibration(torch.cat(evidence).numpy(), is_so))
