"""The plane that parts stand on: where cameras stand over it, what they see of it, and where anything ever lay.

The world's frame is that of ``--calibrate --views-out``: y up, the plane at y = 0, metres.
"""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from curio_train.errors import CameraError, DataError

_LARGEST_SHEAR = 1e-3
_SAME_TILT_DEG, _SAME_HEIGHT = 2.0, 0.05
_FARTHEST = 3.0  # of a plane that reaches the horizon: times the distance of what the optical axis meets
_LEAST_CHANGE = 0.1  # of sRGB: noise, exposure and the rims of soft shadows stay below
_LEAST_OFTEN = 0.02  # share of the photographs
_LEAST_SHARE = 0.002  # of the frame


@dataclass(frozen=True, eq=False)
class CameraPoseFile:
    """The file of ``--plane`` and ``--views``: ``{"a.png": {"cam_from_world": [4x4], "plate": "plates/a.png"}, …}``.

    Photographs are named by their path from the file's folder, or by their file name. Those of a camera that moves may
    name a plate of their own; ``"unit": "m"`` says that the file's writer knew metres, which ``--views`` asks for.

    Attributes:
        file: Where it was read.
        entries: By photograph.
        flag: That named the file.
    """

    file: Path
    entries: Mapping[str, Any]
    flag: str = "--plane"

    @classmethod
    def read(cls, file: Path, flag: str = "--plane") -> "CameraPoseFile":
        """Read the file.

        Raises:
            CameraError: It is missing, or something else.
        """
        try:
            entries = json.loads(file.read_text(encoding="utf-8"))
        except OSError as exc:
            raise CameraError(f"{flag} {file}: cannot be read ({exc.strerror})") from exc
        except (json.JSONDecodeError, UnicodeDecodeError) as exc:
            raise CameraError(f"{flag} {file}: not JSON ({exc})") from exc
        if not isinstance(entries, dict) or not all(isinstance(entry, dict) for entry in entries.values()):
            raise CameraError(f"{flag} {file}: expected an object of photographs, each with its cam_from_world")
        return cls(file, entries, flag)

    def anywhere(self, photograph: Path) -> np.ndarray:
        """cam_from_world of a photograph: rigid [4, 4].

        Raises:
            CameraError: The file does not say, or it is not rigid.
        """
        entry = self._entry(photograph)
        if "cam_from_world" not in entry:
            raise CameraError(
                f"{self.flag} {self.file}: says nothing of {photograph.name}; it has {', '.join([*self.entries][:5])}. "
                "Photographs are named by their path from that file's folder, or by their file name"
            )
        return _rigid(entry["cam_from_world"], self._where(photograph))

    def cam_from_world(self, photograph: Path) -> np.ndarray:
        """The same of a photograph that was taken from above the plane, looking down on it.

        Raises:
            CameraError: The file does not say, or it is no such place.
        """
        matrix = self.anywhere(photograph)
        height, forward = (-matrix[:3, :3].T @ matrix[:3, 3])[1], matrix[2, 1]
        if height <= 0 or forward >= 0:
            raise CameraError(
                f"{self._where(photograph)}: the camera stands at a height of {height:.3g} m and looks "
                f"{'up' if forward >= 0 else 'down'}; expected one above the plane y = 0 that looks down on it. "
                "Is y up, and is it cam_from_world?"
            )
        return matrix

    def in_metres(self, photograph: Path) -> bool:
        """Whether the file says so of this photograph, and with that where it was taken."""
        return self._entry(photograph).get("unit") == "m"

    def plate(self, photograph: Path) -> Path | None:
        """The photograph's own plate, if it has one."""
        name = self._entry(photograph).get("plate")
        return None if name is None else self.file.parent / str(name)

    def sees_alike(self, photograph: Path, plate: Path) -> None:
        """Refuse a photograph taken from another height or tilt than a plate; round the scene is the same to a world.

        Raises:
            CameraError: Says how they differ.
        """
        if "cam_from_world" not in self._entry(photograph):
            return
        one, other = (self.cam_from_world(path) for path in (photograph, plate))
        tilt = float(np.degrees(np.arccos(np.clip(one[:3, 1] @ other[:3, 1], -1, 1))))
        heights = [float((-matrix[:3, :3].T @ matrix[:3, 3])[1]) for matrix in (one, other)]
        if tilt > _SAME_TILT_DEG or abs(heights[0] / heights[1] - 1) > _SAME_HEIGHT:
            raise CameraError(
                f"{self.flag} {self.file}: {photograph.name} was taken {heights[0]:.3g} m above the plane and tilted "
                f"by {tilt:.1f} degrees to {plate.name}, taken at {heights[1]:.3g} m; a camera that moves has to keep "
                f"its height within {_SAME_HEIGHT:.0%} and its tilt within {_SAME_TILT_DEG:g} degrees"
            )

    def _where(self, photograph: Path) -> str:
        return f"{self.flag} {self.file}, {photograph.name}"

    def _entry(self, photograph: Path) -> Mapping[str, Any]:
        relative = os.path.relpath(photograph, self.file.parent)
        entry: Mapping[str, Any] = self.entries.get(relative, self.entries.get(photograph.name, {}))
        return entry


def _rigid(values: object, where: str) -> np.ndarray:
    try:
        matrix = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as exc:
        raise CameraError(f"{where}: cam_from_world is no matrix ({exc})") from exc
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise CameraError(f"{where}: cam_from_world has shape {matrix.shape}, expected 4x4 finite numbers")
    rotation = matrix[:3, :3]
    shear = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if shear > _LARGEST_SHEAR or np.linalg.det(rotation) < 0 or not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise CameraError(f"{where}: cam_from_world is not rigid; expected a rotation, a shift and (0, 0, 0, 1)")
    return matrix


def seen_points(matrix: np.ndarray, cam_from_world: np.ndarray, width: int, height: int) -> np.ndarray:
    """Where on the plane each pixel looks, [height, width, 3]; NaN above the horizon and far beyond the scene."""
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1).astype(np.float64)
    rotation, centre = cam_from_world[:3, :3], -cam_from_world[:3, :3].T @ cam_from_world[:3, 3]
    rays = pixels @ np.linalg.inv(matrix).T @ rotation
    with np.errstate(divide="ignore", invalid="ignore"):
        along = -centre[1] / rays[..., 1]
    farthest = -_FARTHEST * centre[1] / rotation[2, 1]
    along[~((along > 0) & (along <= farthest))] = np.nan
    points: np.ndarray = centre + along[..., None] * rays
    points[..., 1] = np.where(np.isnan(along), np.nan, 0.0)
    return points


def ever_changed(photographs: Sequence[np.ndarray], plates: Sequence[np.ndarray]) -> np.ndarray:
    """Pixels where things ever were: those that differ from the plate in more than a few photographs.

    Args:
        photographs: Each [3, height, width] uint8.
        plates: The plate of each.

    Returns:
        Mask [height, width].

    Raises:
        DataError: There are next to none.
    """
    changes = [_change(photo, plate) for photo, plate in zip(photographs, plates, strict=True)]
    often = (np.mean([change > _LEAST_CHANGE for change in changes], axis=0) > _LEAST_OFTEN).astype(np.uint8)
    mask: np.ndarray = cv2.morphologyEx(often, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)).astype(bool)
    if mask.mean() < _LEAST_SHARE:
        raise DataError(
            f"the {len(photographs)} photographs show nothing but the plate (a change on {mask.mean():.2%} of the "
            "frame); expected parts in them, and --background without"
        )
    return mask


def _change(photograph: np.ndarray, plate: np.ndarray) -> np.ndarray:
    """The largest difference of a channel, [height, width] in [0, 1], once noise is smoothed and exposure is evened."""
    seen, empty = (
        cv2.GaussianBlur(image.transpose(1, 2, 0).astype(np.float32) / 255, (5, 5), 0) for image in (photograph, plate)
    )
    gain = np.median(seen, axis=(0, 1)) / np.maximum(np.median(empty, axis=(0, 1)), 1e-3)
    change: np.ndarray = np.abs(seen - empty * gain).max(axis=2)
    return change
