"""Calibrates the confidences of a detector for several objects as probabilities, on renderings."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from curio_train.counting import counted
from curio_train.metrics.calibration import fit_calibration
from curio_train.metrics.poses import are_right
from curio_train.networks.several_objects.network import ObjectsNetwork
from curio_train.networks.templates.reader import CalibrationFeatures
from curio_train.scene_code import CONFIDENCE, SceneCode, poses
from curio_train.worlds.several_objects.scenes import ObjectScenes

NUM_FRAMES = 160
"""Renderings that the confidence is calibrated on."""

_BATCH_SIZE = 2  # larger batches take longer a frame
_NUM_POINTS = 500  # vertices that ADD is measured at, about


@torch.no_grad()
def calibrate(network: ObjectsNetwork, world: ObjectScenes, cache: Path, *, by_heat_map: bool = False) -> None:
    """Make each object's confidence the probability of a correct pose, and its presence that it is there, in place.

    Frames that show the object tell whether its pose is correct; those that don't show its absence. They are not
    augmented: confidence calibrated on augmented ones is farther off in photographs
    (docs/experiments/real_photographs.md).

    Args:
        network: With all of its templates.
        world: Of its objects.
        cache: Folder with generated data.
        by_heat_map: Whether the locator's heat maps alone tell presence, in the same way for all objects, and not how
            well templates match, too. Of a locator that learned from photographs they say more about those than both.

    Raises:
        DataError: The backgrounds cannot be read.
    """
    source = world.source("validation", 0, with_code=True, cache=cache)
    network.eval()
    features: list[CalibrationFeatures] = []
    present: list[Tensor] = []
    correct: list[np.ndarray] = []
    num = NUM_FRAMES // _BATCH_SIZE
    for step in counted(range(num), num, "calibrating the confidence, batches"):
        batch = source.batch(step, _BATCH_SIZE)
        assert batch.code is not None
        code, found = network.read(batch.images.clamp(0, 1))
        features.append(found)
        present.append(batch.code[CONFIDENCE][..., 0] > 0)
        correct.append(_correct(world, code, batch.code))
    right, there = (torch.cat(parts).numpy() for parts in zip(*features, strict=True))
    shown, hit = torch.cat(present).numpy(), np.concatenate(correct)
    network.reader.ceiling.fill_(1)
    for number in range(len(world.members)):
        seen = shown[:, number]
        network.reader.pose_correct[number] = _fit(right[seen, number], hit[seen, number])
        network.reader.presence[number] = _fit(there[:, number], seen)
    if by_heat_map:
        network.reader.presence[:, 0] = 0
        network.reader.presence[:, 1:] = _fit(there[..., 1:].reshape(-1, 1), shown.ravel())


def _correct(world: ObjectScenes, found: SceneCode, true: SceneCode) -> np.ndarray:
    """Which objects' poses are correct, [batch, objects]."""
    by_object = [
        are_right(poses(found, number), poses(true, number), member.mesh.thinned_m(_NUM_POINTS), member.kind.info)
        for number, member in enumerate(world.members)
    ]
    return np.array(by_object).T


def _fit(features: np.ndarray, is_so: np.ndarray) -> Tensor:
    return torch.tensor(fit_calibration(features, is_so.tolist())).float()
