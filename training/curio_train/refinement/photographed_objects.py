"""What photographs teach a trained detector for several objects: how the objects look, and how sure to be."""

from pathlib import Path

import numpy as np
import torch

from curio_train.geometry import Pose
from curio_train.metrics.calibration import fit_calibration
from curio_train.metrics.poses import ADD_THRESHOLD, add_or_add_s_m
from curio_train.networks.several_objects.network import ObjectsNetwork
from curio_train.refinement.scene_labels import SceneLabels
from curio_train.scene_code import poses
from curio_train.templates.photographed import learn_appearance
from curio_train.worlds.several_objects.world import SeveralObjectsWorld

_NUM_POINTS = 500  # vertices that ADD is measured at, about
_FEWEST = 8  # correct poses, and wrong ones, that a calibration needs
_READ_AT_ONCE = 2


@torch.no_grad()
def learn_from_photographs(
    network: ObjectsNetwork, world: SeveralObjectsWorld, labels: SceneLabels, cache: Path
) -> None:
    """Let templates look as photographs do, and calibrate the confidence there.

    A pose is taken as correct where it agrees with the pseudo-label, and as wrong where there is none: what was read
    there agreed with nothing. Each photograph is read by templates that only the other half of the photographs changed,
    because a network is surer of what it has learned from.

    Raises:
        DataError: The backgrounds cannot be read.
    """
    network.eval()
    features, correct = _read_by_others(network, world, labels)
    learn_appearance(network, labels.frames, labels.poses)
    world.calibrate_confidence(network, cache)
    for number in range(len(labels.poses)):
        hits = correct[:, number]
        if min(hits.sum(), (~hits).sum()) >= _FEWEST:
            weights = fit_calibration(features[:, number], hits.tolist())
            network.reader.pose_correct[number] = torch.tensor(weights).float()


def _read_by_others(
    network: ObjectsNetwork, world: SeveralObjectsWorld, labels: SceneLabels
) -> tuple[np.ndarray, np.ndarray]:
    """Features of each object's pose in each photograph [photographs, objects, …], and whether the pose is correct."""
    rendered = {name: value.clone() for name, value in network.reader.banks.state_dict().items()}
    num = len(labels.frames)
    features, correct = np.zeros((num, len(labels.poses), 3)), np.zeros((num, len(labels.poses)), dtype=bool)
    for half in range(2):
        others = [Pose(pose.rotation[1 - half :: 2], pose.translation_m[1 - half :: 2]) for pose in labels.poses]
        learn_appearance(network, labels.frames[1 - half :: 2], others)
        for rows in np.array_split(np.arange(half, num, 2), -(-num // (2 * _READ_AT_ONCE))):
            if len(rows) == 0:
                continue
            code, found = network.read(labels.frames[torch.from_numpy(rows)].float() / 255)
            features[rows] = found.right.numpy()
            for slot, member in enumerate(world.members):
                points = member.mesh.vertices_m[:: max(1, len(member.mesh.vertices_m) // _NUM_POINTS)]
                for row, pose in zip(rows, poses(code, slot), strict=True):
                    true = Pose(labels.poses[slot].rotation[row], labels.poses[slot].translation_m[row])
                    if np.isfinite(true.translation_m).all():
                        error_m = add_or_add_s_m(pose, true, points, member.kind.info)
                        correct[row, slot] = error_m < ADD_THRESHOLD * member.kind.diameter_m
        network.reader.banks.load_state_dict(rendered)
    return features, correct
