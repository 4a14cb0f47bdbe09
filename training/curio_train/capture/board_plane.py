"""Where a camera stands over a board that lies on a table: for ``curio-detect --plane``."""

import json
from pathlib import Path

import cv2
import numpy as np
from curio_serve.files import write_whole
from jaxtyping import Float

from curio_train.capture.calibration import Calibration
from curio_train.errors import CameraError, DataError


def pose_over_board(found: Calibration, photograph: Path) -> Float[np.ndarray, "4 4"]:
    """The cam_from_world of a photograph: y up, the board at y = 0, the origin at one of its corners, metres.

    Args:
        found: The camera, from this photograph and others.
        photograph: That shows the board where it lies.

    Raises:
        CameraError: It does not show the board.
    """
    if photograph not in found.seen:
        raise CameraError(
            f"--plane-out: {photograph.name}, the last photograph, does not show the whole board; let it show how the "
            "board lies where the objects will stand"
        )
    points_m, pixels = found.seen[photograph]
    matrix, lens = found.camera.matrix, np.array(found.camera.lens)
    _, vector, shift = cv2.solvePnP(points_m.astype(np.float64), pixels.astype(np.float64), matrix, lens)
    rotation, origin_m = cv2.Rodrigues(vector)[0], np.asarray(shift).ravel()
    up = rotation[:, 2] if rotation[:, 2] @ origin_m < 0 else -rotation[:, 2]
    pose = np.eye(4)
    pose[:3, :3] = np.stack([rotation[:, 0], up, np.cross(rotation[:, 0], up)], axis=1)
    pose[:3, 3] = origin_m
    return pose


def save_plane(path: Path, cam_from_world: Float[np.ndarray, "4 4"]) -> None:
    """Write the pose of a camera that stands still, whole or not at all.

    Raises:
        DataError: It cannot be written.
    """
    try:
        write_whole(path, json.dumps({"cam_from_world": cam_from_world.tolist(), "unit": "m"}) + "\n")
    except OSError as exc:
        raise DataError(f"{path}: cannot be written ({exc.strerror}); name another file: --plane-out") from exc
