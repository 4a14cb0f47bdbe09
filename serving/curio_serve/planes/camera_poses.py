"""The file of camera poses over a plane, as ``curio-train capture --calibrate --views-out`` writes it.

The world's frame: y up, the plane at y = 0, metres.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal, Self, TypeAlias

import numpy as np

from curio_serve.errors import CameraError
from curio_serve.files import read_json
from curio_serve.imaging.rotation import is_rotation
from curio_serve.planes.plane import FIND_PLANE, AnyPlane, Plane

_MAX_BYTES = 1 << 26
_MAX_SHEAR = 1e-3
_POSE = "cam_from_world"
_HIGHEST_M = 100.0
_MOST_UPWARD = 0.7  # sine of the angle: a camera that looks up farther hardly shows a plane below it


@dataclass(frozen=True, eq=False)
class CameraPoseFile:
    """The file of ``--plane`` and ``--views``: ``{"a.png": {"cam_from_world": [4x4]}, …}``.

    Photographs are named by their path from the file's folder, or by their file name; ``"folder": "around"`` says where
    one lies that has only its file name, because others may have the same. ``"unit": "m"`` says that the pose is in
    metres, which ``--views`` requires; ``--plane`` refuses another unit. Of a camera that stands still,
    ``{"cam_from_world": [4x4]}`` is the pose in all photographs.
    """

    file: Path
    """Path of the file, as it was given."""
    entries: Mapping[str, Any]
    """What the file says of each photograph, by its name."""
    flag: str = "--plane"
    """The flag that named the file."""
    of_all: Mapping[str, Any] | None = None
    """What it says of all photographs; None: of each that it names."""
    folder: Path = field(init=False)
    """The file's folder, absolute: another process may have another working folder."""

    error: ClassVar[type[Exception]] = CameraError
    """What is raised."""

    def __post_init__(self) -> None:
        """Remember where the file is."""
        object.__setattr__(self, "folder", self.file.parent.absolute())

    @classmethod
    def read(cls, file: Path, flag: str = "--plane") -> Self:
        """Read the file.

        Raises:
            CameraError: It is missing, or no such file.
        """
        try:
            entries = read_json(file, _MAX_BYTES)
        except OSError as exc:
            raise cls.error(f"{flag} {file}: cannot be read ({exc.strerror})") from exc
        except ValueError as exc:
            raise cls.error(f"{flag} {file}: not JSON ({exc})") from exc
        if isinstance(entries, dict) and _POSE in entries:
            return cls(file, {}, flag, entries)
        if not isinstance(entries, dict) or not all(isinstance(entry, dict) for entry in entries.values()):
            raise cls.error(f"{flag} {file}: expected an object of photographs, each with its cam_from_world")
        return cls(file, entries, flag)

    @classmethod
    def named(cls, given: str | None) -> "GivenPlane":
        """What ``--plane`` names.

        Args:
            given: A file, ``objects``, or None.

        Raises:
            CameraError: The file is missing, or no such file.
        """
        if given is None or given == FIND_PLANE:
            return None if given is None else FIND_PLANE
        return cls.read(Path(given))

    def cam_from_world(self, photograph: Path) -> np.ndarray:
        """The camera pose of a photograph: rigid [4, 4].

        Raises:
            CameraError: The file has none, or it is not rigid.
        """
        if not self.is_known(photograph):
            raise self.error(
                f"{self.flag} {self.file}: has no pose of {photograph.name}, {self._others(photograph)}. "
                "Photographs are named by their path from that file's folder, or by their file name"
            )
        return self._rigid(self._entry(photograph)[_POSE], self._where(photograph))

    def pose_above_plane(self, photograph: Path, most_upward: float = 0.0) -> np.ndarray:
        """The camera pose of a photograph, in metres, whose camera has to look down on the plane from above: [4, 4].

        Args:
            photograph: Its file.
            most_upward: Sine of the angle by which the camera may look up.

        Raises:
            CameraError: The file has no pose, another one, or says that it is not in metres.
        """
        matrix = self.cam_from_world(photograph)
        unit = self._entry(photograph).get("unit", "m")
        if unit != "m":
            raise self.error(
                f"{self._where(photograph)}: the unit is {unit!r}, expected 'm'; make the file again with --distance-m "
                "or --objects beside --calibrate --views-out, which bring the scene to metres"
            )
        if (distance_m := float(np.linalg.norm(matrix[:3, 3]))) > _HIGHEST_M:
            raise self.error(
                f"{self._where(photograph)}: the camera stands {distance_m:.4g} m from the plane's "
                "origin; expected metres, found millimetres?"
            )
        height, forward = (-matrix[:3, :3].T @ matrix[:3, 3])[1], matrix[2, 1]
        looks = "down" if forward < 0 else "up" if forward > 0 else "straight ahead"
        if height <= 0 or forward >= most_upward:
            raise self.error(
                f"{self._where(photograph)}: the camera stands at a height of {height:.3g} m and looks {looks}; "
                "expected one above the plane y = 0 that looks down on it. "
                "Is y up, and is it cam_from_world?"
            )
        return matrix

    def plane(self, photograph: Path) -> Plane:
        """The plane in the frame of the camera that took a photograph.

        Raises:
            CameraError: As :meth:`pose_above_plane`.
        """
        matrix = self.pose_above_plane(photograph, _MOST_UPWARD)
        return Plane(matrix[:3, 3], matrix[:3, 1])

    def refuse_impossible_planes(self) -> None:
        """Look at every pose, before any photograph is read.

        Raises:
            CameraError: As :meth:`pose_above_plane`, of a pose that is there.
        """
        for name in ["every image"] if self.of_all is not None else self.entries:
            photograph = self.folder / str(self.entries.get(name, {}).get("folder", "")) / name
            if self.is_known(photograph):
                self.pose_above_plane(photograph, _MOST_UPWARD)

    def is_known(self, photograph: Path) -> bool:
        """Whether the file has a pose of this photograph."""
        return _POSE in self._entry(photograph)

    def _others(self, photograph: Path) -> str:
        """What the file has poses of instead."""
        folder = self.entries.get(photograph.name, {}).get("folder")
        if folder is not None:
            return f"but of one of that name in {folder}"
        return f"only of {', '.join([*self.entries][:5])}" if self.entries else "nor of any other photograph"

    def _where(self, photograph: Path) -> str:
        return f"{self.flag} {self.file}, {photograph.name}"

    def _entry(self, photograph: Path) -> Mapping[str, Any]:
        if self.of_all is not None:
            return self.of_all
        relative = os.path.relpath(photograph, self.folder)
        named: Mapping[str, Any] = self.entries.get(relative, self.entries.get(photograph.name, {}))
        if "folder" in named and _is_elsewhere(photograph, self.folder / str(named["folder"])):
            return {}
        return named

    def _rigid(self, values: object, where: str) -> np.ndarray:
        try:
            matrix = np.array(values, dtype=np.float64)
        except (TypeError, ValueError) as exc:
            raise self.error(f"{where}: cam_from_world is no matrix ({exc})") from exc
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise self.error(f"{where}: cam_from_world has shape {matrix.shape}, expected 4x4 finite numbers")
        if not is_rotation(matrix[:3, :3], _MAX_SHEAR) or not np.allclose(matrix[3], [0, 0, 0, 1]):
            raise self.error(
                f"{where}: cam_from_world is not rigid; expected a rotation, a translation and (0, 0, 0, 1)"
            )
        return matrix


def _is_elsewhere(photograph: Path, folder: Path) -> bool:
    """Whether a photograph lies in another folder than one that is still there."""
    return folder.is_dir() and photograph.parent.is_dir() and not os.path.samefile(folder, photograph.parent)


GivenPlane: TypeAlias = CameraPoseFile | Literal["objects"] | None
"""Poses of cameras over the plane, or that it is to be found in each image, or none."""


def plane_of(given: GivenPlane, photograph: str) -> AnyPlane | None:
    """The plane in the frame of the camera that took a photograph.

    Raises:
        CameraError: The file has no pose of that camera.
    """
    return given.plane(Path(photograph)) if isinstance(given, CameraPoseFile) else given
