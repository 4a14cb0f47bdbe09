"""Several cameras fixed to each other, and the file that describes them.

    {"cameras": [{"name": "left", "camera_matrix": [[fx,0,cx],[0,fy,cy],[0,0,1]], "width": w, "height": h,
                  "distortion": [...], "cam_from_rig": [[…4 values],[…],[…],[0,0,0,1]]}, …]}

Distances in metres. The rig's frame may be anywhere; ``curio-train capture --calibrate --rig-out`` puts it into the
first camera.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from curio_serve.errors import CameraError
from curio_serve.files import read_file
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.camera_files import camera_of_entry

Array = np.ndarray
LEAST_VIEWS, MOST_VIEWS = 2, 16
_MAX_BYTES = 1 << 20
_TOLERANCE = 1e-3  # of a rotation's entries, as files round them
_FARTHEST_M = 1e4
_FARTHEST_APART_M = 20.0


@dataclass(frozen=True, eq=False)
class RigCamera:
    """One camera of a rig."""

    name: str
    """Name for messages."""
    camera: PinholeCamera
    """Intrinsics."""
    cam_from_rig: Array
    """[4, 4], metres."""


def read_rig_file(path: str | Path) -> list[RigCamera]:
    """The cameras in a file, in its order.

    Raises:
        CameraError: It cannot be read, or describes no rig; says which camera and why.
    """
    try:
        content = json.loads(read_file(path, _MAX_BYTES))
    except OSError as exc:
        raise CameraError(f"rig file {path} cannot be read: {exc.strerror}") from exc
    except (ValueError, RecursionError) as exc:
        raise CameraError(f"rig file {path} is not JSON: {exc}") from exc
    entries = content.get("cameras") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not LEAST_VIEWS <= len(entries) <= MOST_VIEWS:
        num = len(entries) if isinstance(entries, list) else "no list of"
        raise CameraError(f'{path} has {num} cameras under "cameras"; expected {LEAST_VIEWS} to {MOST_VIEWS}')
    cameras = [_rig_camera(entry, f"{path}: cameras[{number}]", number) for number, entry in enumerate(entries)]
    check_baselines([camera.cam_from_rig for camera in cameras], str(path))
    return cameras


def check_baselines(cam_from_rig: Sequence[Array], where: str) -> None:
    """Refuse cameras that are too far apart to see the same object: their places are in another unit than metres.

    Args:
        cam_from_rig: Of each camera, [4, 4].
        where: For messages.

    Raises:
        CameraError: Names two cameras by their numbers.
    """
    places_m = np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in cam_from_rig])
    apart_m = np.linalg.norm(places_m[:, None] - places_m, axis=2)
    first, second = np.unravel_index(apart_m.argmax(), apart_m.shape)
    if apart_m[first, second] > _FARTHEST_APART_M:
        raise CameraError(
            f"{where}: cameras {first} and {second} are {apart_m[first, second]:.4g} m apart, expected at most "
            f"{_FARTHEST_APART_M:g}; cam_from_rig is in metres: are these millimetres?"
        )


def _rig_camera(entry: Any, where: str, number: int) -> RigCamera:
    if not isinstance(entry, Mapping) or not {"camera_matrix", "cam_from_rig"} <= entry.keys():
        raise CameraError(f"{where} is no object with camera_matrix and cam_from_rig")
    try:
        camera = camera_of_entry(entry)
        pose = np.array(entry["cam_from_rig"], float)
    except (TypeError, ValueError, OverflowError) as exc:
        raise CameraError(f"{where} has values that are no numbers: {exc}") from exc
    except CameraError as exc:
        raise CameraError(f"{where}: {exc}") from exc
    return RigCamera(str(entry.get("name", number)), camera, check_cam_from_rig(pose, f"{where}.cam_from_rig"))


def check_cam_from_rig(matrix: Array | Sequence[float], where: str) -> Array:
    """Check that a matrix is a rigid transform.

    Args:
        matrix: [4, 4], or its 16 values row after row.
        where: For messages.

    Returns:
        [4, 4], its rotation exactly orthonormal.

    Raises:
        CameraError: Not 16 finite values, singular, left-handed, or not rigid.
    """
    values = np.asarray(matrix, float)
    if values.size != 16:
        raise CameraError(f"{where} has {values.size} values; expected 16: a 4x4 matrix row after row")
    pose = values.reshape(4, 4)
    if not np.isfinite(pose).all() or np.abs(pose).max() > _FARTHEST_M:
        raise CameraError(f"{where} has values that are not finite or beyond {_FARTHEST_M:g} m")
    if np.abs(pose[3] - (0, 0, 0, 1)).max() > _TOLERANCE:
        raise CameraError(f"{where} has the last row {pose[3].tolist()}; expected [0, 0, 0, 1]")
    rotation = pose[:3, :3]
    determinant = float(np.linalg.det(rotation))
    if abs(determinant) < _TOLERANCE:
        raise CameraError(f"{where} is singular: its rotation has the determinant {determinant:.3g}; expected 1")
    if determinant < 0:
        raise CameraError(
            f"{where} is left-handed: its rotation has the determinant {determinant:.3g}, which mirrors the scene; "
            "expected 1. Are two axes exchanged?"
        )
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 10 * _TOLERANCE:
        raise CameraError(f"{where} is not rigid: rows of its rotation are not unit vectors at right angles")
    left, _, right = np.linalg.svd(rotation)
    exact = np.eye(4)
    exact[:3, :3], exact[:3, 3] = left @ right, pose[:3, 3]
    return exact
