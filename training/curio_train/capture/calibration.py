"""A camera's K and distortion from photographs of a flat board (Zhang 2000, by OpenCV)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from curio_train.camera import Intrinsics, check_matrix
from curio_train.capture.lens import LARGEST_UNCERTAINTY_PX, fitted
from curio_train.data.photographs import Photographs, read_photograph
from curio_train.errors import CameraError, DataError

_SMALLEST_SQUARE_M, _LARGEST_SQUARE_M = 0.001, 1.0
_FEWEST_VIEWS = 6
_FEWEST_INNER = 3  # corners a side that OpenCV finds a plain chessboard by
_FEWEST_CORNERS = 6  # of a board that is partly seen
_LARGEST_ERROR_PX = 1.5
_LEAST_SPREAD_DEG = 10.0
_LARGEST_UNCERTAINTY = 0.01  # of the focal length, one standard deviation

Corners = tuple[np.ndarray, np.ndarray]
"""Points of the board [n, 3], metres, and where they are seen [n, 2], pixels."""


@dataclass(frozen=True)
class Board:
    """The calibration board that the photographs show."""

    columns: int
    """Squares along the longer side."""
    rows: int
    """Squares along the other."""
    square_m: float
    """Side of a square."""
    marker_m: float | None = None
    """Side of a ChArUco marker; None: a plain chessboard."""
    dictionary: str = "DICT_4X4_50"
    """OpenCV's name of the markers' dictionary."""

    def __post_init__(self) -> None:
        """Refuse boards that cannot be.

        Raises:
            CameraError: Too few squares, impossible sizes, or an unknown dictionary.
        """
        if min(self.columns, self.rows) < 3:
            raise CameraError(f"a board of {self.columns}x{self.rows} squares; expected at least 3x3")
        if self.square_m <= 0 or (self.marker_m is not None and not 0 < self.marker_m < self.square_m):
            raise CameraError(
                f"squares of {self.square_m} m with markers of {self.marker_m} m; expected 0 < marker < square"
            )
        if not _SMALLEST_SQUARE_M <= self.square_m <= _LARGEST_SQUARE_M:
            raise CameraError(
                f"squares of {1000 * self.square_m:g} mm; expected {1000 * _SMALLEST_SQUARE_M:g} to "
                f"{1000 * _LARGEST_SQUARE_M:g} mm: sizes of the board are in millimetres (--square-mm, --marker-mm)"
            )
        if not self.dictionary.startswith("DICT_") or not hasattr(cv2.aruco, self.dictionary):
            raise CameraError(f"{self.dictionary!r} is no dictionary of OpenCV; expected one like DICT_4X4_50")

    @property
    def readings(self) -> "tuple[Board, ...]":
        """Boards that the counts may mean: of inner corners, as OpenCV counts on a plain chessboard, or of squares.

        The larger board comes first: a part of it may be taken for the smaller one, but not the other way round.
        """
        larger = replace(self, columns=self.columns + 1, rows=self.rows + 1)
        if self.marker_m is not None:
            return (self,)
        return tuple(board for board in (larger, self) if min(board.columns, board.rows) > _FEWEST_INNER)

    def find(self, grey: np.ndarray) -> Corners | None:
        """The board's inner corners in an image.

        Args:
            grey: [height, width] uint8.

        Returns:
            None where it is not seen.
        """
        return self._find_plain(grey) if self.marker_m is None else self._find_charuco(grey, self.marker_m)

    def _find_plain(self, grey: np.ndarray) -> Corners | None:
        inner = (self.columns - 1, self.rows - 1)
        found, corners = cv2.findChessboardCornersSB(grey, inner, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not found:
            return None
        column, row = np.meshgrid(np.arange(inner[0]), np.arange(inner[1]))
        points = np.stack([column, row, np.zeros_like(row)], axis=-1).reshape(-1, 3) * self.square_m
        return points.astype(np.float32), corners.reshape(-1, 2)

    def _find_charuco(self, grey: np.ndarray, marker_m: float) -> Corners | None:
        board = self._charuco(marker_m)
        corners, numbers, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
        if numbers is None or len(numbers) < _FEWEST_CORNERS:
            return None
        points = np.asarray(board.getChessboardCorners())[np.asarray(numbers).ravel()]
        return points.astype(np.float32), np.asarray(corners).reshape(-1, 2)

    def _charuco(self, marker_m: float) -> cv2.aruco.CharucoBoard:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_m, marker_m, dictionary)


@dataclass(frozen=True)
class Calibration:
    """A camera, and how well it is known."""

    camera: Intrinsics
    """K and distortion."""
    error_px: float
    """Root mean square distance of corners from where the camera should see them."""
    focal_uncertainty: float
    """Standard deviation of the focal length, as a fraction of it."""
    border_px: float
    """Standard deviation of where it sees a direction, at the worst place of the frame."""
    seen: Mapping[Path, Corners]
    """Photographs in which the board was found, and its corners there."""
    unused: tuple[Path, ...]
    """Photographs in which the board was not found."""
    board: Board
    """The board as it was found: its counts were given in squares, or in inner corners."""

    @property
    def num_views(self) -> int:
        """Photographs in which the board was found."""
        return len(self.seen)

    @property
    def doubt(self) -> str:
        """What to do where no board was near the frame's border; empty if the lens is known there."""
        if self.border_px <= LARGEST_UNCERTAINTY_PX:
            return ""
        return (
            f"; towards the frame's border the lens is uncertain by up to {self.border_px:.0f} pixels: photograph the "
            "board there, too"
        )


def calibrate(folder: Path, board: Board) -> Calibration:
    """The camera that took a folder of photographs of the board.

    Raises:
        DataError: No photographs, broken ones, or of several sizes.
        CameraError: The board is seen in too few of them, or they do not determine a camera.
    """
    greys, size = {}, (0, 0)
    for path in Photographs(folder).paths:
        grey = greys[path] = cv2.cvtColor(read_photograph(path), cv2.COLOR_RGB2GRAY)
        if size not in ((0, 0), grey.shape[::-1]):
            raise DataError(
                f"{path} has {grey.shape[1]}x{grey.shape[0]} pixels, others {size[0]}x{size[1]}; expected one size"
            )
        size = (grey.shape[1], grey.shape[0])
    for reading in board.readings:
        found = {path: reading.find(grey) for path, grey in greys.items()}
        seen = {path: corners for path, corners in found.items() if corners is not None}
        if len(seen) >= _FEWEST_VIEWS:
            return _solve(folder, seen, size, tuple(path for path in found if path not in seen), reading)
    counts = "nor of as many inner corners " if len(board.readings) > 1 else ""
    raise CameraError(
        f"{folder}: found no board of {board.columns}x{board.rows} squares {counts}in {_FEWEST_VIEWS} or more of "
        f"{len(greys)} photographs; are the counts right, is the board sharp and wholly in the frame, and has "
        "it markers (ChArUco: --marker-mm)?"
    )


def _solve(
    folder: Path,
    seen: Mapping[Path, Corners],
    size: tuple[int, int],
    unused: tuple[Path, ...],
    board: Board,
) -> Calibration:
    points, pixels = zip(*seen.values(), strict=True)
    try:
        lens = fitted(points, pixels, size)
    except cv2.error as exc:
        raise CameraError(f"{folder}: OpenCV finds no camera that sees the boards so ({exc.err})") from exc
    error, matrix, uncertainty = lens.error_px, lens.matrix, lens.focal_deviation_px / float(lens.matrix[0, 0])
    if error > _LARGEST_ERROR_PX:
        raise CameraError(
            f"{folder}: corners lie {error:.2g} pixels from where the best camera sees them, expected at most "
            f"{_LARGEST_ERROR_PX:g}; is the board flat, the zoom fixed, and all taken with one camera?"
        )
    # Where all boards are parallel the estimate itself is wrong, and its deviation too small.
    if not uncertainty < _LARGEST_UNCERTAINTY or _spread_deg(lens.rotation_vectors) < _LEAST_SPREAD_DEG:
        raise CameraError(
            f"{folder}: the views are too alike: boards are tilted by "
            f"{_spread_deg(lens.rotation_vectors):.0f} degrees to each other, "
            f"the focal length is uncertain by {uncertainty:.1%}; tilt the board by 30 degrees to all sides"
        )
    width, height = size
    camera = Intrinsics(
        check_matrix(matrix, width, height, str(folder)), width, height, tuple(lens.distortion.tolist())
    )
    return Calibration(camera, error, uncertainty, lens.uncertainty_px, seen, unused, board)


def _spread_deg(rotation_vectors: Sequence[np.ndarray]) -> float:
    """Largest angle between the normals of two boards, given as rotation vectors [3, 1]."""
    normals = np.stack([cv2.Rodrigues(np.asarray(vector))[0][:, 2] for vector in rotation_vectors])
    return float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1).min())))
