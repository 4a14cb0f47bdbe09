"""How the cameras of a rig stand to each other, from photographs that they took of one board at the same instants.

Each camera's K and lens are found from all its photographs (:mod:`~curio_train.capture.calibration`). Then the first
camera and each other one are related by the instants in which both see the board (OpenCV's stereo calibration).
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from curio_serve.consensus.poses import angles_deg
from curio_serve.files import write_whole

from curio_train.camera import Intrinsics
from curio_train.capture.calibration import Board, Calibration, Corners, calibrate
from curio_train.errors import CameraError, DataError

LEAST_CAMERAS, MOST_CAMERAS = 2, 16
_FEWEST_INSTANTS = 4
_FEWEST_POINTS = 6
_LARGEST_ERROR_PX = 1.5


@dataclass(frozen=True)
class RigCalibration:
    """The cameras of a rig, the first of which is its frame."""

    names: tuple[str, ...]
    """Names of the folders."""
    cameras: tuple[Calibration, ...]
    """Intrinsics of each."""
    cam_from_rig: tuple[np.ndarray, ...]
    """Pose of each [4, 4], metres."""
    num_instants: tuple[int, ...]
    """Instants at which this camera and the first one see the board; for the first, at which it does."""
    error_px: float
    """Largest root mean square distance of corners from where a pair of cameras should see them."""


def calibrate_rig(folder: Path, board: Board) -> RigCalibration:
    """The rig whose cameras took a folder of photographs each.

    Args:
        folder: Holds a folder a camera, beside hidden ones; photographs of one instant have the same name in each.
        board: That they show.

    Raises:
        DataError: The folder cannot be listed, a wrong number of folders, or photographs that cannot be used.
        CameraError: They do not determine a camera, or too few instants show the board to a pair.
    """
    try:
        folders = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    except OSError as exc:
        raise DataError(f"{folder}: cannot be listed ({exc.strerror}); expected a folder of each camera in it") from exc
    if not LEAST_CAMERAS <= len(folders) <= MOST_CAMERAS:
        raise DataError(
            f"{folder} has {len(folders)} folders; expected one a camera, {LEAST_CAMERAS} to {MOST_CAMERAS}, with "
            "photographs of the same names"
        )
    cameras = [calibrate(path, board) for path in folders]
    seen = [{path.stem: corners for path, corners in camera.seen.items()} for camera in cameras]
    poses, counts, errors = [np.eye(4)], [len(seen[0])], [0.0]
    for number in range(1, len(folders)):
        names = f"{folders[0].name} and {folders[number].name}"
        pose, count, error = _relative(names, seen[0], seen[number], cameras[0], cameras[number])
        poses.append(pose)
        counts.append(count)
        errors.append(error)
    return RigCalibration(
        tuple(path.name for path in folders), tuple(cameras), tuple(poses), tuple(counts), max(errors)
    )


def save_rig(path: Path, rig: RigCalibration) -> None:
    """Write a rig file (:mod:`curio_serve.rigs.rig` reads it), whole or not at all.

    Raises:
        CameraError: The file cannot be written.
    """
    entries = [
        {"name": name, **found.camera.entry(), "cam_from_rig": pose.tolist()}
        for name, found, pose in zip(rig.names, rig.cameras, rig.cam_from_rig, strict=True)
    ]
    try:
        write_whole(path, json.dumps({"cameras": entries}, indent=2) + "\n")
    except OSError as exc:
        raise CameraError(f"{path}: cannot be written ({exc.strerror}); name another file: --rig-out") from exc


def _relative(
    names: str, first: Mapping[str, Corners], other: Mapping[str, Corners], one: Calibration, two: Calibration
) -> tuple[np.ndarray, int, float]:
    """Pose of the other camera in the first one's frame (other_from_first), instants, error in pixels."""
    pairs = [_common(first[name], other[name]) for name in sorted(first.keys() & other.keys())]
    pairs = [pair for pair in pairs if len(pair[0]) >= _FEWEST_POINTS]
    if len(pairs) < _FEWEST_INSTANTS:
        raise CameraError(
            f"{names} both see the board in {len(pairs)} photographs of the same name; expected {_FEWEST_INSTANTS} or "
            "more: hold it where both cameras see it, and name the photographs of one instant alike"
        )
    ways = len(_counted(pairs[0][2], two.board))
    found = [_solve(_turned(pairs, reference, one, two), one.camera, two.camera) for reference in range(ways)]
    pose, error = min(found, key=lambda result: result[1])
    if not error <= _LARGEST_ERROR_PX:
        raise CameraError(
            f"{names}: corners lie {error:.2g} pixels from where the best pair of cameras sees them, expected at most "
            f"{_LARGEST_ERROR_PX:g}; did a camera or the board move between the two photographs of an instant?"
        )
    return pose, len(pairs), error


_Pair = tuple[np.ndarray, np.ndarray, np.ndarray]


def _common(first: Corners, other: Corners) -> _Pair:
    """Points that both see [n, 3], and their pixels in either [n, 2]."""
    rows = {tuple(point): row for row, point in enumerate(other[0].round(6).tolist())}
    shared = [(row, rows[tuple(point)]) for row, point in enumerate(first[0].round(6).tolist()) if tuple(point) in rows]
    mine, theirs = np.array(shared, int).reshape(-1, 2).T
    return first[0][mine], first[1][mine], other[1][theirs]


def _counted(corners: np.ndarray, board: Board) -> list[np.ndarray]:
    """The orders in which the corners [n, 2] that a camera sees may be meant.

    A chessboard looks the same after half a turn, and a square one nearly so after a quarter; markers tell the corner.
    """
    if board.marker_m is not None:
        return [corners]
    if board.columns != board.rows:
        return [corners, corners[::-1]]
    side = math.isqrt(len(corners))
    grid = corners.reshape(side, side, 2)
    return [np.rot90(grid, quarters).reshape(-1, 2) for quarters in range(4)]


def _turned(pairs: list[_Pair], reference: int, one: Calibration, two: Calibration) -> list[_Pair]:
    """The pairs with the other camera's corners so ordered that the cameras stand alike in all of them.

    In one of two photographs a chessboard's corners may be counted from another end. That is told by the pose of the
    cameras, which has to be the same at every instant.

    Args:
        pairs: As found.
        reference: Which order of the first pair is meant.
        one: The first camera, and the board.
        two: The other camera, and the board.
    """
    expected, chosen = None, []
    for points, mine, theirs in pairs:
        orders = _counted(theirs, two.board)
        poses = [_rotation(points, order, two.camera) @ _rotation(points, mine, one.camera).T for order in orders]
        if expected is None:
            expected = poses[reference]
        nearest = int(angles_deg(np.stack(poses), expected, np.eye(3)[None])[0].argmin())
        chosen.append((points, mine, orders[nearest]))
    return chosen


def _rotation(points: np.ndarray, pixels: np.ndarray, camera: Intrinsics) -> np.ndarray:
    """cam_from_board."""
    is_found, rotation_vector, _ = cv2.solvePnP(points, pixels, camera.matrix, np.array(camera.lens))
    return np.asarray(cv2.Rodrigues(rotation_vector)[0]) if is_found else np.eye(3)


def _solve(pairs: list[_Pair], one: Intrinsics, two: Intrinsics) -> tuple[np.ndarray, float]:
    points, mine, theirs = (list(values) for values in zip(*pairs, strict=True))
    error, *_, rotation, translation, _, _ = cv2.stereoCalibrate(
        points,
        mine,
        theirs,
        one.matrix,
        np.array(one.lens),
        two.matrix,
        np.array(two.lens),
        (one.width, one.height),
        flags=cv2.CALIB_FIX_INTRINSIC,
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation.ravel()
    return pose, float(error)
