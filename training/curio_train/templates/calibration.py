"""Calibrates a template network's confidence as a probability, on renderings.

Distances are not calibrated: renderings that are augmented as training images are come out 1.6 % too near (can), real
frames 1.9 % too far, so a factor from renderings moves real poses the wrong way (docs/experiments/real_photographs.md).
"""

from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from curio_train.counting import counted
from curio_train.geometry import Pose
from curio_train.metrics.calibration import fit_calibration
from curio_train.metrics.poses import are_right
from curio_train.networks.templates.network import TemplateNetwork
from curio_train.scene_code import poses
from curio_train.threads import in_threads
from curio_train.worlds.single_object.world import SingleObjectWorld

_NUM_FRAMES, _BATCH_SIZE = 80, 2  # larger batches take longer a frame
_NUM_POINTS = 500  # vertices that ADD is measured at, about


@torch.no_grad()
def calibrate(network: TemplateNetwork, world: SingleObjectWorld, cache: Path, num_threads: int = 1) -> None:
    """Fit the two logits of the confidence on augmented whole frames.

    Frames with the object show whether its pose is correct; as many frames without it show its absence.

    Raises:
        DataError: The backgrounds cannot be read.
    """
    source, kind = world.source("validation", 0, with_code=True, cache=cache), world.object.kind
    points = world.object.mesh.thinned_m(_NUM_POINTS)
    steps = _NUM_FRAMES // _BATCH_SIZE
    true: list[Pose] = []

    def frames() -> Iterator[Tensor]:
        """Batches with the object and without it by turns."""
        for step in range(steps):
            batch, behind = source.batch(step, _BATCH_SIZE), source.backgrounds(steps + step, _BATCH_SIZE)
            assert batch.code is not None
            assert behind is not None  # these worlds always have some
            true.extend(poses(batch.code))
            yield world.augment(batch.images, (0, step)).clamp(0, 1)
            yield world.augment(behind, (1, step)).clamp(0, 1)

    read = in_threads(network.read, frames(), num_threads)
    answers = list(counted(read, 2 * steps, "calibrating the confidence, batches"))
    found = [pose for code, _ in answers[::2] for pose in poses(code)]
    full, empty = ([features for _, features in some] for some in (answers[::2], answers[1::2]))
    right = are_right(found, true, points, kind.info)
    network.reader.pose_correct[0] = _fit([features.right[:, 0] for features in full], right)
    there = [True] * len(right) + [False] * len(right)
    network.reader.presence[0] = _fit([features.there[:, 0] for features in (*full, *empty)], there)


def _fit(features: list[Tensor], is_so: list[bool]) -> Tensor:
    return torch.tensor(fit_calibration(torch.cat(features).numpy(), is_so))
