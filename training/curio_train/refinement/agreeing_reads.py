"""Whether all reads of a photograph agree: what tells right poses from wrong ones without a label.

A network reads each photograph through a few slightly turned cameras. Where it is wrong, it mostly is so in another way
each time; where all reads agree to within a twentieth of the diameter, it mostly is right
(docs/experiments/captures.md).
"""

from collections.abc import Sequence

import numpy as np
from curio_serve.consensus.poses import Predictions, mean_pose
from jaxtyping import Bool

from curio_train.geometry import Pose
from curio_train.metrics.poses import add_or_add_s_m, symmetry_poses
from curio_train.refinement.scene_poses import Reads
from curio_train.scene_code import poses
from curio_train.worlds.single_object.crop_pose_loss import SYMMETRY_STEP
from curio_train.worlds.single_object.world import Object

NUM_READS = 5
"""Reads of each photograph by a trained network."""

NUM_READS_BY_TEMPLATES = 2
"""Reads of each photograph by templates, whose poses are spread more: of five, all agree in too few photographs."""

_NEAR = 0.05  # diameters, of ADD(-S) to the mean
_NUM_POINTS = 500  # vertices that ADD is measured at, about


def all_agree(reads: Reads, one: Object, slot: int = 0) -> Bool[np.ndarray, " photographs"]:
    """Whether ADD(-S) of each read of a photograph to their mean is below a twentieth of the diameter.

    Args:
        reads: Of every photograph.
        one: The object whose poses were read.
        slot: Its slot in the scene codes of the reads.
    """
    read, num = poses(reads.code, slot), int(reads.photograph.max()) + 1
    points = one.mesh.thinned_m(_NUM_POINTS)
    symmetries = np.stack([pose.rotation for pose in symmetry_poses(one.kind.info, SYMMETRY_STEP)])

    def agree(some: Sequence[Pose]) -> bool:
        mean, largest_m = _mean(some, symmetries), _NEAR * one.kind.diameter_m
        return all(add_or_add_s_m(pose, mean, points, one.kind.info) < largest_m for pose in some)

    rows = [np.flatnonzero(reads.photograph == number) for number in range(num)]
    return np.array([agree([read[row] for row in of_photograph]) for of_photograph in rows])


def _mean(read: Sequence[Pose], symmetries: np.ndarray) -> Pose[np.ndarray]:
    rotation = np.stack([pose.rotation for pose in read])
    position_m = np.stack([pose.translation_m for pose in read])
    rows, alike = np.arange(len(read)), np.broadcast_to(np.eye(3), rotation.shape)
    return Pose(*mean_pose(Predictions(rows, rotation, position_m, alike), rows, symmetries))
