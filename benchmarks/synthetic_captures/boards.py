"""A stand-in's camera, calibrated as a user's is: from photographs of a chessboard held before it.

So what the camera file gets wrong is what :mod:`~curio_train.capture.calibration` gets wrong at this many pixels.
"""

from pathlib import Path

import cv2
import numpy as np
from curio_train.camera import Intrinsics
from curio_train.capture.calibration import Board, calibrate
from scipy.spatial.transform import Rotation

from synthetic_captures.sensor import Sensor

BOARD = Board(9, 6, 0.03)
_NUM_PHOTOGRAPHS = 20
_LARGEST_TILT_DEG, _LARGEST_ROLL_DEG = 35.0, 20.0
_LARGEST_SHIFT_M, _NEAR_M, _FAR_M = 0.05, 0.42, 0.6
_SUBPIXELS = 4  # a side of a pixel, averaged: what a pixel sees is an area
_PX_PER_SQUARE = 60
_PAPER, _INK, _DESK = 0.8, 0.04, 0.25  # linear radiance


def photograph_boards(folder: Path, matrix: np.ndarray, size: tuple[int, int], seed: int) -> None:
    """Take photographs of the board from all sides, as FOLDER/00.png and on; those that are there are kept.

    Args:
        folder: Exists.
        matrix: The true K [3, 3].
        size: Width and height, pixels.
        seed: Of tilts, places and noise.

    Raises:
        OSError: It cannot be written.
    """
    board = _print()
    for number in range(_NUM_PHOTOGRAPHS):
        path, random = folder / f"{number:02}.png", np.random.default_rng((seed, number))
        if path.exists():
            continue
        radiance = _seen(board, _hold(random), matrix, size)
        pixels = Sensor().develop(np.repeat(radiance[..., None], 3, axis=2), random)
        path.write_bytes(cv2.imencode(".png", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))[1].tobytes())


def calibrated(folder: Path) -> Intrinsics:
    """The camera as found from the board's photographs.

    Raises:
        DataError: A photograph is broken.
        CameraError: They do not determine a camera.
    """
    return calibrate(folder, BOARD).camera


def _print() -> np.ndarray:
    """Radiance of the board with half a square of paper round it, [rows, columns]."""
    row, column = np.indices((BOARD.rows * _PX_PER_SQUARE, BOARD.columns * _PX_PER_SQUARE)) // _PX_PER_SQUARE
    squares = np.where((row + column) % 2, _PAPER, _INK)
    return np.pad(squares, _PX_PER_SQUARE // 2, constant_values=_PAPER)


def _hold(random: np.random.Generator) -> np.ndarray:
    """Where the board is: its x axis, y axis and middle in the camera's frame as columns [3, 3], metres."""
    tilt = random.uniform(-_LARGEST_TILT_DEG, _LARGEST_TILT_DEG, 2)
    roll = random.uniform(-_LARGEST_ROLL_DEG, _LARGEST_ROLL_DEG)
    turn = Rotation.from_euler("xyz", [*tilt, roll], degrees=True).as_matrix()
    middle = [*random.uniform(-_LARGEST_SHIFT_M, _LARGEST_SHIFT_M, 2), random.uniform(_NEAR_M, _FAR_M)]
    return np.stack([turn[:, 0], turn[:, 1], middle], axis=1)


def _seen(board: np.ndarray, held: np.ndarray, matrix: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Radiance of each pixel [height, width], the mean over its area."""
    step = BOARD.square_m / _PX_PER_SQUARE
    rows, columns = board.shape
    metres = np.array([[step, 0, -step * (columns - 1) / 2], [0, step, -step * (rows - 1) / 2], [0, 0, 1]])
    finer = np.diag([_SUBPIXELS, _SUBPIXELS, 1.0])
    finer[:2, 2] = (_SUBPIXELS - 1) / 2  # pixel 0 spans subpixels 0 to 3
    fine = cv2.warpPerspective(
        board, finer @ matrix @ held @ metres, (_SUBPIXELS * size[0], _SUBPIXELS * size[1]), borderValue=_DESK
    )
    return cv2.resize(fine, size, interpolation=cv2.INTER_AREA)
