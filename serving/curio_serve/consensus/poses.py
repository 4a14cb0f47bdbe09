"""Poses on which several views of one object agree.

A single view is misread as often as not, but each in its own way, and half of all errors are in depth. Predictions of
several views, brought into one frame, that agree there are right together (after Labbé et al. 2020, "CosyPose",
section 3.2). Their mean weighs each by its inverse covariance, so that one view's depth is measured by what another
sees across.

Self-training uses it on photographs of a still scene, serving on the cameras of a rig.
"""

from dataclasses import dataclass

import numpy as np

Array = np.ndarray
_MEAN_STEPS = 3  # times that a pose becomes the mean of the predictions near it
_MAX_ANGLE_DEG = 20.0
_MAX_DISTANCE = 11.3  # squared Mahalanobis distance: 99 of 100 predictions of one position


@dataclass(frozen=True, eq=False)
class Predictions:
    """Predicted poses of one object in a common frame, one per row."""

    view: Array
    """Index of the view of each prediction, [n]."""
    rotation: Array
    """[n, 3, 3]."""
    translation_m: Array
    """[n, 3]."""
    covariance_m2: Array
    """Covariance of each position, [n, 3, 3]."""


@dataclass(frozen=True, eq=False)
class Consensus:
    """A pose on which views agree."""

    rotation: Array
    """[3, 3]."""
    translation_m: Array
    """[3]."""
    members: Array
    """Rows of the predictions that agree, ascending."""


def consensus(predictions: Predictions, symmetries: Array, *, min_predictions: int, min_views: int) -> list[Consensus]:
    """Poses on which predictions of several views agree, those of most predictions first.

    Args:
        predictions: In one frame.
        symmetries: Rotations [n, 3, 3] of the object onto itself, the identity among them.
        min_predictions: Fewest that may agree.
        min_views: Fewest views that they may be of.
    """
    rotation, translation_m, covariance = predictions.rotation, predictions.translation_m, predictions.covariance_m2
    gaps = translation_m[None] - translation_m[:, None]
    agree = mahalanobis(gaps, covariance[:, None] + covariance[None]) < _MAX_DISTANCE
    agree &= angles_deg(rotation[:, None], rotation, symmetries)[0] < _MAX_ANGLE_DEG
    remaining, found = np.ones(len(agree), dtype=bool), list[Consensus]()
    while remaining.any():
        seed = int((agree & remaining & remaining[:, None]).sum(axis=1).argmax())
        members = np.flatnonzero(agree[seed] & remaining)
        if len(members) < min_predictions:
            break
        for _ in range(_MEAN_STEPS):
            mean_rotation, mean_m = mean_pose(predictions, members, symmetries)
            near = mahalanobis(translation_m - mean_m, covariance) < _MAX_DISTANCE
            near &= angles_deg(rotation, mean_rotation, symmetries)[0] < _MAX_ANGLE_DEG
            if (near & remaining).sum() < min_predictions:
                break
            members = np.flatnonzero(near & remaining)
        remaining[members] = False
        if len(np.unique(predictions.view[members])) >= min_views:
            found.append(Consensus(*mean_pose(predictions, members, symmetries), members))
    return found


def mean_pose(predictions: Predictions, rows: Array, symmetries: Array) -> tuple[Array, Array]:
    """Mean rotation [3, 3] and position [3] of some predictions; positions are weighted by their inverse covariance."""
    rotations = predictions.rotation[rows]
    _, symmetry = angles_deg(rotations, rotations[0], symmetries)
    rotation = mean_rotation(rotations @ symmetries[symmetry])
    weight = np.linalg.inv(predictions.covariance_m2[rows])
    weighted = np.einsum("nij,nj->i", weight, predictions.translation_m[rows])
    return rotation, np.linalg.solve(weight.sum(axis=0), weighted)


def mean_rotation(rotations: Array) -> Array:
    """The rotation [3, 3] with the least sum of squared differences to rotations [n, 3, 3]."""
    left, _, right = np.linalg.svd(rotations.mean(axis=0))
    left[:, 2] *= np.linalg.det(left @ right)
    result: Array = left @ right
    return result


def mahalanobis(gaps: Array, covariance: Array) -> Array:
    """Squared Mahalanobis distance of gaps [..., 3]."""
    result: Array = (gaps * np.linalg.solve(covariance, gaps[..., None])[..., 0]).sum(axis=-1)
    return result


def angles_deg(one: Array, other: Array, symmetries: Array) -> tuple[Array, Array]:
    """Least angle over the symmetries between rotations [..., 3, 3], and the number of that symmetry."""
    cosines = np.stack([(np.einsum("...ij,...ij->...", one @ rotation, other) - 1) / 2 for rotation in symmetries])
    return np.degrees(np.arccos(cosines.max(axis=0).clip(-1, 1))), cosines.argmax(axis=0)


def position_covariance_m2(rays_m: Array, across_m: float, in_depth: float) -> Array:
    """Covariance [n, 3, 3] of positions that are more accurate across the view than in depth.

    Args:
        rays_m: From the camera to the object, in the common frame's axes, [n, 3].
        across_m: Standard deviation across the view.
        in_depth: Standard deviation of the distance, as a fraction of it.
    """
    distance_m = np.linalg.norm(rays_m, axis=1)
    along = rays_m[:, :, None] * rays_m[:, None] / distance_m[:, None, None] ** 2
    depth = (in_depth * distance_m)[:, None, None] ** 2
    result: Array = (np.eye(3) - along) * across_m**2 + along * depth
    return result
