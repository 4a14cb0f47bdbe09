"""Corrects the distances of a detector for several objects, by parallax in photographs of a still scene."""

import logging

import numpy as np
import torch

from curio_train.capture.parallax import MIN_PAIRS, DistanceRatio, Predictions, distance_ratio
from curio_train.data.photographs import CameraPoses, UnlabelledPhotographs, read_frames
from curio_train.geometry import Pose, matrix_from_rotation_6d
from curio_train.metrics.poses import symmetry_poses
from curio_train.networks.several_objects.network import ObjectsNetwork
from curio_train.scene_code import CONFIDENCE, ROTATION_6D, TRANSLATION, SceneCode
from curio_train.worlds.several_objects.scenes import ObjectScenes
from curio_train.worlds.single_object.crop_pose_loss import SYMMETRY_STEP

_BATCH_SIZE = 4

_log = logging.getLogger(__name__)


@torch.no_grad()
def correct_distances(network: ObjectsNetwork, world: ObjectScenes, photographs: UnlabelledPhotographs) -> None:
    """Set the factors of the network's distances, in place; they are 1 before.

    The scale of a scene that structure from motion recovers is unknown. It is taken from the objects together: their
    errors have a mean of 0. Camera poses in metres tell it without them.

    Args:
        network: With calibrated confidences.
        world: Of its objects.
        photographs: Of a still scene that shows them; without camera poses all factors stay.

    Raises:
        DataError: A photograph cannot be read, or is not of the camera's size.
    """
    paths, cameras = photographs
    if cameras is None:
        return
    chosen = [path for path, known in zip(paths, cameras.known, strict=True) if known]
    frames = torch.from_numpy(read_frames(chosen, world.members[0].camera, world.camera.width, world.camera.height))
    network.eval()
    answers = [network(chunk.float() / 255) for chunk in frames.split(_BATCH_SIZE)]
    code = {name: torch.cat([one[name] for one in answers]) for name in answers[0]}
    for slot, factor in enumerate(distance_factors(code, cameras, world)):
        network.reader.distance_factor[slot] = factor


def distance_factors(code: SceneCode, cameras: CameraPoses, world: ObjectScenes) -> list[float]:
    """What distances must be multiplied by, one number an object; 1 where too few pairs of photographs agree.

    Args:
        code: Predictions in the photographs whose camera poses are known.
        cameras: Of all photographs.
        world: Of the objects.
    """
    cam_from_world = Pose.from_matrix(cameras.cam_from_world[cameras.known])
    found = [
        distance_ratio(cam_from_world, _predictions(code, slot), _symmetries(world, slot))
        for slot in range(len(world.members))
    ]
    measured = [ratio.log_ratio for ratio in found if ratio.num_pairs >= MIN_PAIRS]
    log_scale = float(np.mean(measured)) if measured and not cameras.in_metres else 0.0
    factors = [_factor(ratio, log_scale) for ratio in found]
    for kind, ratio, factor in zip(world.objects, found, factors, strict=True):
        _log.info(
            "%s: %d pairs of photographs correct distances by %+.1f %%", kind.name, ratio.num_pairs, 100 * factor - 100
        )
    return factors


def _factor(ratio: DistanceRatio, log_scale: float) -> float:
    return float(np.exp(ratio.log_ratio - log_scale)) if ratio.num_pairs >= MIN_PAIRS else 1.0


def _predictions(code: SceneCode, slot: int) -> Predictions:
    rotation = matrix_from_rotation_6d(code[ROTATION_6D][:, slot]).double().numpy()
    position_m = code[TRANSLATION][:, slot].double().numpy()
    return Predictions(Pose(rotation, position_m), code[CONFIDENCE][:, slot, 0].numpy())


def _symmetries(world: ObjectScenes, slot: int) -> np.ndarray:
    return np.stack([pose.rotation for pose in symmetry_poses(world.objects[slot].info, SYMMETRY_STEP)])
