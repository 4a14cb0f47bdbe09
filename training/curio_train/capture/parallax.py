"""The systematic error of a detector's distances, measured by parallax: no label.

A detector tells from an object's apparent size how far away it is, and errs for each object to one side, by some per
cent: scanned meshes are too thick or too thin, and cameras sharpen or blur contours. Its bearings have no such error.
Where the camera's motion is known, two photographs that show an object at one place from two sides tell the distance by
triangulation of the bearings, and the ratio of both distances is the error.

Most pairs of predictions are of no use: the object was misread, or moved in between. What remains agrees in rotation,
has bearings that meet, and predicts the ratio of the two distances that triangulation finds.
"""

from typing import NamedTuple

import numpy as np
from curio_serve.consensus.poses import angles_deg
from jaxtyping import Bool, Float

from curio_train.geometry import Pose

MIN_PAIRS = 12
"""With fewer pairs of photographs an object's distances stay as they are."""

_MIN_CONFIDENCE = 0.1
_MAX_GAP = 0.01  # between the bearings where they are closest, relative to the distance
_ANGLES_DEG = 10.0, 100.0  # between the bearings
_MAX_ANGLE_DEG = 20.0  # between the rotations
_MAX_RATIO = 0.15  # logarithm, of the two distances as predicted and as triangulated
_WINDOW = 0.05  # logarithm, around the mode
_SPREAD = 0.025  # standard deviation of the weights around the mode, logarithm
_MEAN_STEPS = 10


class Predictions(NamedTuple):
    """Poses of one object in photographs of a still scene, one a row."""

    cam_from_obj: Pose[np.ndarray]
    """Metres."""
    confidence: Float[np.ndarray, " num"]
    """Probability of a correct pose."""


class DistanceRatio(NamedTuple):
    """How far away an object is by triangulation, over how far away predictions say that it is."""

    log_ratio: float
    """Logarithm, in units of the scene a metre; 0 without enough pairs."""
    num_pairs: int
    """Pairs of photographs that agree."""


def distance_ratio(
    cam_from_world: Pose[np.ndarray], predictions: Predictions, symmetries: Float[np.ndarray, "symmetries 3 3"]
) -> DistanceRatio:
    """The ratio on which pairs of photographs agree.

    Args:
        cam_from_world: Of the photographs' cameras, [num, …], in units of the scene.
        predictions: In these photographs.
        symmetries: Rotations of the object onto itself, the identity among them.
    """
    world_from_cam = cam_from_world.inverse()
    position_m = predictions.cam_from_obj.translation_m
    predicted_m = np.linalg.norm(position_m, axis=1)
    rays = np.einsum("nij,nj->ni", world_from_cam.rotation, position_m / predicted_m[:, None])
    first, second = np.triu_indices(len(rays), 1)
    angle = np.arccos((rays[first] * rays[second]).sum(axis=1).clip(-1, 1))
    sure = predictions.confidence > _MIN_CONFIDENCE
    wide = (np.radians(_ANGLES_DEG[0]) < angle) & (angle < np.radians(_ANGLES_DEG[1]))
    first, second, angle = (values[wide & sure[first] & sure[second]] for values in (first, second, angle))

    centres = world_from_cam.translation_m
    found, gap = _triangulated(centres[first], rays[first], centres[second], rays[second])
    in_front = (found > 0).all(axis=1)
    told_m = np.stack([predicted_m[first], predicted_m[second]], axis=1)
    log_ratios = np.log(np.where(in_front[:, None], found, 1.0) / told_m)
    rotation = world_from_cam.rotation @ predictions.cam_from_obj.rotation
    agree = (
        in_front
        & (gap < _MAX_GAP * found.mean(axis=1))
        & (np.abs(log_ratios[:, 0] - log_ratios[:, 1]) < _MAX_RATIO)
        & (angles_deg(rotation[first], rotation[second], symmetries)[0] < _MAX_ANGLE_DEG)
    )
    if agree.sum() < MIN_PAIRS:
        return DistanceRatio(0.0, int(agree.sum()))
    return DistanceRatio(_mode(log_ratios[agree].mean(axis=1), np.sin(angle[agree]) ** 2), int(agree.sum()))


def _triangulated(
    centre: np.ndarray, ray: np.ndarray, other_centre: np.ndarray, other_ray: np.ndarray
) -> tuple[Float[np.ndarray, "pairs 2"], Float[np.ndarray, " pairs"]]:
    """Distances along unit rays [pairs, 3] to where they are closest to each other, and how close they are there."""
    between, cosine = other_centre - centre, (ray * other_ray).sum(axis=1)
    along, along_other = (between * ray).sum(axis=1), (between * other_ray).sum(axis=1)
    far = np.stack([along - cosine * along_other, cosine * along - along_other], axis=1) / (1 - cosine**2)[:, None]
    apart = between + far[:, 1:] * other_ray - far[:, :1] * ray
    return far, np.linalg.norm(apart, axis=1)


def _mode(values: Float[np.ndarray, " num"], weights: Float[np.ndarray, " num"]) -> float:
    """The value around which most weight lies; misread poses that happen to agree lie elsewhere."""
    near: Bool[np.ndarray, "num num"] = np.abs(values - values[:, None]) < _WINDOW
    mode = float(values[(near * weights).sum(axis=1).argmax()])
    for _ in range(_MEAN_STEPS):
        mode = float(np.average(values, weights=weights * np.exp(-((values - mode) ** 2) / (2 * _SPREAD**2))))
    return mode
