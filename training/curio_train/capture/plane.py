"""The plane that parts stand on: camera poses over it, its points at each pixel, and the pixels that ever changed.

The world's frame is that of ``--calibrate --views-out``: y up, the plane at y = 0, metres.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from curio_serve.files import read_json
from scipy.spatial.transform import Rotation

from curio_train.errors import CameraError, DataError
from curio_train.geometry import is_rotation

_MAX_BYTES = 1 << 26
_MAX_SHEAR = 1e-3
_SAME_TILT_DEG, _SAME_HEIGHT = 2.0, 0.05
_MAX_DISTANCE = 3.0  # of points on the plane, relative to the one on the optical axis
_MIN_CHANGE = 0.1  # of sRGB: noise, exposure and the rims of soft shadows stay below
_MIN_PHOTOGRAPHS = 0.02  # fraction of the photographs in which a pixel changed
_MIN_AREA = 0.002  # fraction of the frame


@dataclass(frozen=True, eq=False)
class CameraPoseFile:
    """The file of ``--plane`` and ``--views``: ``{"a.png": {"cam_from_world": [4x4], "plate": "plates/a.png"}, …}``.

    Photographs are named by their path from the file's folder, or by their file name; ``"folder": "around"`` says where
    one lies that has only its file name, because others may have the same. If the camera moves, each may name a
    background image of its own as "plate"; ``"unit": "m"`` says that the pose is in metres, which ``--views``
    requires; ``--plane`` refuses another unit.
    """

    file: Path
    """Path of the file."""
    entries: Mapping[str, Any]
    """What the file says of each photograph, by its name."""
    flag: str = "--plane"
    """The flag that named the file."""

    @classmethod
    def read(cls, file: Path, flag: str = "--plane") -> "CameraPoseFile":
        """Read the file.

        Raises:
            CameraError: It is missing, or no such file.
        """
        try:
            entries = read_json(file, _MAX_BYTES)
        except OSError as exc:
            raise CameraError(f"{flag} {file}: cannot be read ({exc.strerror})") from exc
        except ValueError as exc:
            raise CameraError(f"{flag} {file}: not JSON ({exc})") from exc
        if not isinstance(entries, dict) or not all(isinstance(entry, dict) for entry in entries.values()):
            raise CameraError(f"{flag} {file}: expected an object of photographs, each with its cam_from_world")
        return cls(file, entries, flag)

    def cam_from_world(self, photograph: Path) -> np.ndarray:
        """The camera pose of a photograph: rigid [4, 4].

        Raises:
            CameraError: The file has none, or it is not rigid.
        """
        if not self.is_known(photograph):
            others = f"only of {', '.join([*self.entries][:5])}" if self.entries else "nor of any other photograph"
            raise CameraError(
                f"{self.flag} {self.file}: has no pose of {photograph.name}, {others}. "
                "Photographs are named by their path from that file's folder, or by their file name"
            )
        return _rigid(self._entry(photograph)["cam_from_world"], self._where(photograph))

    def pose_above_plane(self, photograph: Path) -> np.ndarray:
        """The camera pose of a photograph, in metres, whose camera has to look down on the plane from above: [4, 4].

        Raises:
            CameraError: The file has no pose, another one, or says that it is not in metres.
        """
        matrix = self.cam_from_world(photograph)
        unit = self._entry(photograph).get("unit", "m")
        if unit != "m":
            raise CameraError(
                f"{self._where(photograph)}: the unit is {unit!r}, expected 'm'; make the file again with --distance-m "
                "or --objects beside --calibrate --views-out, which bring the scene to metres"
            )
        height, forward = (-matrix[:3, :3].T @ matrix[:3, 3])[1], matrix[2, 1]
        if height <= 0 or forward >= 0:
            raise CameraError(
                f"{self._where(photograph)}: the camera stands at a height of {height:.3g} m and looks "
                f"{'up' if forward >= 0 else 'down'}; expected one above the plane y = 0 that looks down on it. "
                "Is y up, and is it cam_from_world?"
            )
        return matrix

    def is_known(self, photograph: Path) -> bool:
        """Whether the file has a pose of this photograph."""
        return "cam_from_world" in self._entry(photograph)

    def in_metres(self, photograph: Path) -> bool:
        """Whether the file has a pose of this photograph in metres."""
        return self._entry(photograph).get("unit") == "m"

    def background_image(self, photograph: Path) -> Path | None:
        """The photograph's own image of the empty scene, if it has one."""
        name = self._entry(photograph).get("plate")
        return None if name is None else self.file.parent / str(name)

    @property
    def background_images(self) -> list[Path]:
        """All images of the empty scene that photographs name as their own."""
        names = (entry.get("plate") for entry in self.entries.values())
        return [self.file.parent / str(name) for name in names if name is not None]

    def check_same_viewpoint(self, photograph: Path, background: Path) -> None:
        """Refuse a photograph taken from another height or tilt than the background image, or from another place.

        The azimuth may differ where the photograph names its own image of the empty scene.

        Raises:
            CameraError: Says how they differ.
        """
        if not self.is_known(photograph):
            return
        one, other = (self.pose_above_plane(path) for path in (photograph, background))
        tilt = float(np.degrees(np.arccos(np.clip(one[:3, 1] @ other[:3, 1], -1, 1))))
        heights = [float((-matrix[:3, :3].T @ matrix[:3, 3])[1]) for matrix in (one, other)]
        if tilt > _SAME_TILT_DEG or abs(heights[0] / heights[1] - 1) > _SAME_HEIGHT:
            raise CameraError(
                f"{self.flag} {self.file}: {photograph.name} was taken {heights[0]:.3g} m above the plane and tilted "
                f"by {tilt:.1f} degrees to {background.name}, taken at {heights[1]:.3g} m; a camera that moves has to "
                f"keep its height within {_SAME_HEIGHT:.0%} and its tilt within {_SAME_TILT_DEG:g} degrees"
            )
        turned = np.degrees(Rotation.from_matrix(one[:3, :3] @ other[:3, :3].T).magnitude())
        centers = [-matrix[:3, :3].T @ matrix[:3, 3] for matrix in (one, other)]
        moved_m = float(np.linalg.norm(centers[0] - centers[1]))
        is_elsewhere = turned > _SAME_TILT_DEG or moved_m > _SAME_HEIGHT * heights[1]
        if is_elsewhere and self.background_image(photograph) is None:
            raise CameraError(
                f"{self.flag} {self.file}: {photograph.name} was taken {moved_m:.3g} m beside {background.name} and "
                f"turned by {turned:.0f} degrees to it, so that image does not show the scene behind its parts; name "
                'an image of the empty scene from there as its "plate"'
            )

    def _where(self, photograph: Path) -> str:
        return f"{self.flag} {self.file}, {photograph.name}"

    def _entry(self, photograph: Path) -> Mapping[str, Any]:
        relative = os.path.relpath(photograph, self.file.parent)
        named: Mapping[str, Any] = self.entries.get(photograph.name, {})
        if relative in self.entries:
            named = self.entries[relative]
        elif "folder" in named and _is_elsewhere(photograph, self.file.parent / str(named["folder"])):
            return {}
        return named


def _is_elsewhere(photograph: Path, folder: Path) -> bool:
    """Whether a photograph lies in another folder than one that is still there."""
    return folder.is_dir() and photograph.parent.is_dir() and not os.path.samefile(folder, photograph.parent)


def _rigid(values: object, where: str) -> np.ndarray:
    try:
        matrix = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as exc:
        raise CameraError(f"{where}: cam_from_world is no matrix ({exc})") from exc
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise CameraError(f"{where}: cam_from_world has shape {matrix.shape}, expected 4x4 finite numbers")
    if not is_rotation(matrix[:3, :3], _MAX_SHEAR) or not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise CameraError(f"{where}: cam_from_world is not rigid; expected a rotation, a translation and (0, 0, 0, 1)")
    return matrix


def points_on_plane(matrix: np.ndarray, cam_from_world: np.ndarray, width: int, height: int) -> np.ndarray:
    """The point of the plane at each pixel, metres, world frame.

    Args:
        matrix: K [3, 3].
        cam_from_world: [4, 4].
        width: Of the image, pixels.
        height: Of the image, pixels.

    Returns:
        [height, width, 3]; NaN above the horizon and far beyond the scene.
    """
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1).astype(np.float64)
    rotation, centre = cam_from_world[:3, :3], -cam_from_world[:3, :3].T @ cam_from_world[:3, 3]
    rays = pixels @ np.linalg.inv(matrix).T @ rotation
    with np.errstate(divide="ignore", invalid="ignore"):
        along = -centre[1] / rays[..., 1]
    farthest = -_MAX_DISTANCE * centre[1] / rotation[2, 1]
    along[~((along > 0) & (along <= farthest))] = np.nan
    points: np.ndarray = centre + along[..., None] * rays
    points[..., 1] = np.where(np.isnan(along), np.nan, 0.0)
    return points


def changed_pixels(photographs: Sequence[np.ndarray], backgrounds: Sequence[np.ndarray]) -> np.ndarray:
    """Pixels that differ from the background image in more than a few photographs: things ever were there.

    Args:
        photographs: Each [3, height, width] uint8.
        backgrounds: The background image of each.

    Returns:
        Mask [height, width].

    Raises:
        DataError: There are next to none.
    """
    changes = [_change(photo, background) for photo, background in zip(photographs, backgrounds, strict=True)]
    often = (np.mean([change > _MIN_CHANGE for change in changes], axis=0) > _MIN_PHOTOGRAPHS).astype(np.uint8)
    mask: np.ndarray = cv2.morphologyEx(often, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)).astype(bool)
    if mask.mean() < _MIN_AREA:
        raise DataError(
            f"the {len(photographs)} photographs show nothing but the background (a change on {mask.mean():.2%} of the "
            "frame); expected parts in them, and --background without"
        )
    return mask


def _change(photograph: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Largest difference of a channel after smoothing and equalising the exposures, [height, width] in [0, 1]."""
    photo, empty = (
        cv2.GaussianBlur(image.transpose(1, 2, 0).astype(np.float32) / 255, (5, 5), 0)
        for image in (photograph, background)
    )
    gain = np.median(photo, axis=(0, 1)) / np.maximum(np.median(empty, axis=(0, 1)), 1e-3)
    change: np.ndarray = np.abs(photo - empty * gain).max(axis=2)
    return change
