"""Errors of a 6-DoF pose, one estimate against one truth, by the published formulas.

Poses are cam_from_obj (:class:`~curio_train.geometry.Pose`, metres), points are the model's [num_points, 3] in metres,
object frame. Every error is 0 for a perfect estimate. Rotation and translation errors always stand beside ADD: a wrong
diameter or unit makes ADD look good when nothing is.

Hinterstoisser et al. 2012, "Model based training, detection and pose estimation of texture-less 3D objects …" (ADD,
ADD-S); Hodan et al. 2020, "BOP Challenge 2020 on 6D Object Localization" (MSSD, MSPD, discretised symmetries).
"""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from curio_train.data.bop import ModelInfo
from curio_train.geometry import Pose, rotation_angle_deg

ADD_THRESHOLD = 0.1
"""A pose counts as correct where ADD is below this fraction of the diameter."""

_LEVEL, _NUM_RESAMPLES = 0.95, 2000  # of bootstrap intervals


def rotation_error_deg(estimate: Pose, truth: Pose) -> float:
    """Angle between the two rotations, in [0, 180]."""
    return float(rotation_angle_deg(torch.as_tensor(estimate.rotation), torch.as_tensor(truth.rotation)))


def translation_error_m(estimate: Pose, truth: Pose) -> float:
    """Distance of the two origins."""
    return float(np.linalg.norm(estimate.translation_m - truth.translation_m))


def add_m(estimate: Pose, truth: Pose, points: np.ndarray) -> float:
    """ADD: mean distance of each model point under the two poses (Hinterstoisser et al. 2012)."""
    return float(np.linalg.norm(estimate.apply(points) - truth.apply(points), axis=1).mean())


def add_s_m(estimate: Pose, truth: Pose, points: np.ndarray) -> float:
    """ADD-S: mean distance from each true point to the closest estimated one (Hinterstoisser et al. 2012)."""
    distances, _ = KDTree(estimate.apply(points)).query(truth.apply(points))
    return float(np.mean(distances))


def add_or_add_s_m(estimate: Pose, truth: Pose, points: np.ndarray, info: ModelInfo) -> float:
    """ADD, or ADD-S where the object has a symmetry: what LineMOD tables report as ADD(-S)."""
    return (add_s_m if info.is_symmetric else add_m)(estimate, truth, points)


def are_right(found: Sequence[Pose], true: Sequence[Pose], points: np.ndarray, info: ModelInfo) -> list[bool]:
    """Whether ADD(-S) of each pose is below :data:`ADD_THRESHOLD` diameters."""
    errors_m = [add_or_add_s_m(one, other, points, info) for one, other in zip(found, true, strict=True)]
    return [error_m < ADD_THRESHOLD * info.diameter_m for error_m in errors_m]


def symmetry_poses(info: ModelInfo, max_step: float = 0.01) -> list[Pose]:
    """All motions of the object that leave its appearance unchanged, the identity first; continuous ones in steps.

    Of an object that turns any way these are but the turns about its axes; errors are then those to
    :func:`turned_alike`.

    Args:
        info: Discrete and continuous symmetries of the object.
        max_step: Largest displacement of the point farthest from a continuous axis per step, as a fraction of the
            diameter. The default is BOP's choice: 315 steps.
    """
    discrete = [Pose.identity(), *map(Pose.from_matrix, info.symmetries)]
    continuous = [
        rotation
        for axis, point in info.symmetry_axes
        for rotation in _rotations_about(axis, point, int(np.ceil(np.pi / max_step)))
    ]
    return [rotation @ pose for pose in discrete for rotation in continuous or [Pose.identity()]]


def turned_alike(truth: Pose, estimate: Pose, info: ModelInfo) -> Pose:
    """The true pose, of an object that turns any way the one that is turned as the estimate is.

    Args:
        truth: The true pose.
        estimate: The pose to judge.
        info: Symmetries of the object.
    """
    if not info.turns_any_way:
        return truth
    centre_m = _meeting_point(info.symmetry_axes)
    return Pose(estimate.rotation, truth.apply(centre_m) - estimate.rotation @ centre_m)


def _meeting_point(axes: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """The point [3] closest to all axes, each (axis, point on it)."""
    across = [np.eye(3) - np.outer(axis, axis) / (axis @ axis) for axis, _ in axes]
    offsets = [matrix @ point for matrix, (_, point) in zip(across, axes, strict=True)]
    return np.linalg.lstsq(np.concatenate(across), np.concatenate(offsets))[0]


def _rotations_about(axis: np.ndarray, point: np.ndarray, num_steps: int) -> list[Pose]:
    """Rotations about a line, the identity first."""
    angles = np.arange(num_steps) * 2 * np.pi / num_steps
    rotations = Rotation.from_rotvec(angles[:, None] * (axis / np.linalg.norm(axis))).as_matrix()
    return [Pose(rotation, point - rotation @ point) for rotation in rotations]


def mssd_m(estimate: Pose, truth: Pose, points: np.ndarray, symmetries: Sequence[Pose]) -> float:
    """Maximum symmetry-aware surface distance (BOP Challenge 2020).

    Args:
        estimate: The pose to judge.
        truth: The true one.
        points: Of the evaluation model.
        symmetries: From :func:`symmetry_poses`.
    """
    estimated = estimate.apply(points)
    same = (truth.apply(symmetry.apply(points)) for symmetry in symmetries)
    return float(min(np.linalg.norm(estimated - points_of, axis=1).max() for points_of in same))


def mspd_px(estimate: Pose, truth: Pose, points: np.ndarray, symmetries: Sequence[Pose], matrix: np.ndarray) -> float:
    """Maximum symmetry-aware projection distance (BOP Challenge 2020), pixels of the image of K."""
    estimated = project(estimate.apply(points), matrix)
    same = (project(truth.apply(symmetry.apply(points)), matrix) for symmetry in symmetries)
    return float(min(np.linalg.norm(estimated - pixels, axis=1).max() for pixels in same))


def project(points_in_camera: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Pixels [..., 2] of points [..., 3] in the camera frame; infinite for points behind the camera."""
    homogeneous = points_in_camera @ matrix.T
    in_front = homogeneous[..., 2:] > 0
    return np.where(in_front, homogeneous[..., :2] / np.where(in_front, homogeneous[..., 2:], 1), np.inf)


def in_view(positions_m: np.ndarray, matrix: np.ndarray, width: int, height: int) -> np.ndarray:
    """Whether positions [..., 3] in the camera frame project into the frame of K; false where they are NaN."""
    pixels = project(positions_m, matrix)
    inside: np.ndarray = np.all((pixels > 0) & (pixels < (width, height)), axis=-1)
    return inside


def recall(errors: Sequence[float], threshold: float) -> float:
    """Fraction of the errors below the threshold, in [0, 1]. A missing estimate counts as infinity.

    Raises:
        ValueError: There are no errors.
    """
    if len(errors) == 0:
        raise ValueError("recall of no estimates: there must be at least one target")
    return float((np.asarray(errors) < threshold).mean())


def bootstrap_interval(*groups: Sequence[float]) -> tuple[float, float]:
    """95 % percentile bootstrap interval of a mean (for a recall: of zeros and ones), or of the mean of several means.

    Args:
        groups: Values; of several objects those of each, which are drawn anew by themselves.

    Raises:
        ValueError: There are no values.
    """
    if not groups or any(len(group) == 0 for group in groups):
        raise ValueError("an interval of no values: there must be at least one")
    found = [np.asarray(group, dtype=np.float64) for group in groups]
    rng = np.random.default_rng(0)
    # One resample at a time: a table of all of them would be gigabytes for a whole data set.
    means = [np.mean([rng.choice(group, size=len(group)).mean() for group in found]) for _ in range(_NUM_RESAMPLES)]
    low, high = np.quantile(means, [(1 - _LEVEL) / 2, (1 + _LEVEL) / 2])
    return float(low), float(high)
