"""Which lens photographs of a board determine: of OpenCV's models the largest that is known all over the frame."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

_MODELS = (
    (0, (0, 1, 2, 3, 4)),
    (cv2.CALIB_FIX_K3, (0, 1, 2, 3)),
    (cv2.CALIB_FIX_K3 | cv2.CALIB_FIX_K2, (0, 2, 3)),
)
"""Flags of cv2.calibrateCamera, and which of (k1, k2, p1, p2, k3) are free with them."""

LARGEST_UNCERTAINTY_PX = 1.0
"""Of a lens that is known, see :class:`Lens`."""

_GRID = 9  # places a side of the frame
_MISFIT = 1.1  # of the corners' distances, by a model without coefficients that the lens has
_K2 = 1


class Lens(NamedTuple):
    """A camera as a model of OpenCV fits it."""

    error_px: float
    """Root mean square distance of corners from where the camera should see them."""
    matrix: np.ndarray
    """K, [3, 3]."""
    distortion: np.ndarray
    """(k1, k2, p1, p2, k3), [5]."""
    rotation_vectors: Sequence[np.ndarray]
    """Of each board, [3, 1]."""
    focal_deviation_px: float
    """Standard deviation of fx."""
    uncertainty_px: float
    """Standard deviation of where the camera sees a direction, at the worst place of the frame; of a lens without k2
    what it would be with it, because a real one has some."""


def fitted(points: Sequence[np.ndarray], pixels: Sequence[np.ndarray], size: tuple[int, int]) -> Lens:
    """The first model that the corners determine up to the frame's border, or else the smallest that fits them.

    Where no board comes near the border, a polynomial of three coefficients fits the middle, and beyond it is off by
    tens of pixels.

    Args:
        points: Of the board, metres, [n, 3] for each photograph.
        pixels: Where they are seen, [n, 2].
        size: Width and height of the photographs.

    Raises:
        cv2.error: No camera sees boards so.
    """
    chosen: Lens | None = None
    for flags, free in _MODELS:
        error, matrix, distortion, rotations, shifts, deviations, _, _ = cv2.calibrateCameraExtended(
            points, pixels, size, np.zeros((3, 3)), np.zeros(5), flags=flags
        )
        if chosen is not None and error > _MISFIT * chosen.error_px:
            break  # the lens has what this model has not
        distortion = np.asarray(distortion).ravel()[:5]
        covariance = error**2 / 2 * _inverse_information(points, rotations, shifts, matrix, distortion, free)
        uncertain_px = _uncertainty_px(covariance, size, matrix, distortion, free)
        if chosen is not None and _K2 not in free:
            uncertain_px = chosen.uncertainty_px
        chosen = Lens(float(error), matrix, distortion, rotations, float(deviations[0, 0]), uncertain_px)
        if uncertain_px <= LARGEST_UNCERTAINTY_PX:
            break
    assert chosen is not None  # there are models
    return chosen


def _columns(free: Sequence[int]) -> list[int]:
    """Of cv2.projectPoints' Jacobian: fx, fy, cx, cy and the free coefficients."""
    return [6, 7, 8, 9, *(10 + number for number in free)]


def _inverse_information(
    points: Sequence[np.ndarray],
    rotations: Sequence[np.ndarray],
    shifts: Sequence[np.ndarray],
    matrix: np.ndarray,
    distortion: np.ndarray,
    free: Sequence[int],
) -> np.ndarray:
    """Covariance of K and coefficients where each coordinate of a corner has variance 1, the boards' poses unknown."""
    columns = _columns(free)
    information = np.zeros((len(columns), len(columns)))
    for of_board, rotation, shift in zip(points, rotations, shifts, strict=True):
        _, jacobian = cv2.projectPoints(of_board, rotation, shift, matrix, distortion)
        pose, camera = jacobian[:, :6], jacobian[:, columns]
        # What a pose can explain says nothing about the camera.
        camera = camera - pose @ np.linalg.lstsq(pose, camera, rcond=None)[0]
        information += camera.T @ camera
    return np.asarray(np.linalg.pinv(information))


def _uncertainty_px(
    covariance: np.ndarray, size: tuple[int, int], matrix: np.ndarray, distortion: np.ndarray, free: Sequence[int]
) -> float:
    """Largest deviation over the frame; a turn of the camera, which poses of boards cannot tell from K, counts not."""
    across, down = np.meshgrid(*(np.linspace(0, length - 1, _GRID) for length in size))
    places = np.stack([across, down], axis=-1).reshape(-1, 1, 2)
    rays = np.ones((len(places), 3))
    rays[:, :2] = cv2.undistortPoints(places, matrix, distortion)[:, 0]
    _, jacobian = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, distortion)
    turned, moved = jacobian[:, :3], jacobian[:, _columns(free)]
    moved = moved - turned @ np.linalg.lstsq(turned, moved, rcond=None)[0]
    variances = np.einsum("ij,jk,ik->i", moved, covariance, moved).reshape(-1, 2).sum(axis=1)
    return float(np.sqrt(variances.max()))
