"""Make a stand-in capture: a folder as somebody with a camera, a table and a CAD file would bring it.

::

    OUT/NAME/calibration/*.png  a chessboard held before the camera
             camera.json        as calibrated from them: all of it a little off
             meshes/*.stl       metres, no colours
             photos/*.png       for training, from the first camera
             plates/a-*.png     the empty table from each place of the first camera; plates/b.png from the second
             test/a/ test/b/    one scene from both cameras, about 90° apart
             views.json         of every photograph its plate and cam_from_world (a little off, as after calibration)
             labels/*.json      what is where: for scoring alone, never for training

Every picture is a function of the scene's name and its number, and is written whole or not at all: an interrupted
command goes on where it stopped.
"""

import json
import os
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from curio_train.camera import save_intrinsics
from curio_train.errors import DataError, UsageError
from scipy.spatial.transform import Rotation

from synthetic_captures import scenes
from synthetic_captures.boards import calibrated, photograph_boards
from synthetic_captures.path_traced import PathTracedScene, Thing
from synthetic_captures.sensor import Sensor

_TABLE_M = 2.4
_APERTURE_M = 0.005
_TURN_ERROR_DEG, _SHIFT_ERROR_M = 0.15, 0.001
_EXPOSURE = 0.9
SECOND_CAMERA_DEG = 90.0


@dataclass(frozen=True)
class Amount:
    """How much to make.

    Attributes:
        num_photos: For training.
        num_tests: Scenes seen from both cameras.
        samples_per_pixel: Light paths a pixel; fewer are more noise than a sensor has.
    """

    num_photos: int = 200
    num_tests: int = 50
    samples_per_pixel: int = 48


@dataclass(frozen=True, eq=False)
class _Shot:
    """One picture to be taken: its file, its camera's azimuth, and the scene (None: empty)."""

    file: str
    azimuth_deg: float
    scene_seed: tuple[int, ...] | None


def make(name: str, folder: Path, amount: Amount, progress: Callable[[str], None]) -> int:
    """Make a stand-in, or what is missing of it.

    Args:
        name: sphere_real, bunny, shapes or part.
        folder: Where it goes: FOLDER/NAME.
        amount: How many pictures, and how good.
        progress: Told after each picture.

    Returns:
        Pictures taken now.

    Raises:
        UsageError: No such scene.
        DataError: The folder cannot be written.
        RendererError: The renderer cannot start.
    """
    if name not in scenes.NAMES:
        raise UsageError(f"found no stand-in {name!r}, expected one of {', '.join(scenes.NAMES)}")
    root = folder / name
    shots = list(_shots(name, amount))
    try:
        _describe(name, root, shots)
        missing = [shot for shot in shots if not (root / shot.file).exists()]
        taker = _Taker(name, amount.samples_per_pixel) if missing else None
        for number, shot in enumerate(missing):
            if taker is not None:
                _save(root / shot.file, taker.take(shot))
            progress(f"{name}: {len(shots) - len(missing) + number + 1} of {len(shots)} pictures")
    except OSError as exc:
        raise DataError(f"{root}: cannot be written ({exc.strerror}); name another folder") from exc
    return len(missing)


def _shots(name: str, amount: Amount) -> Iterator[_Shot]:
    world = scenes.NAMES.index(name)
    stations = scenes.NUM_STATIONS if name == "bunny" else 1
    for station in range(stations):
        yield _Shot(f"plates/a-{station}.png", scenes.azimuth_deg(name, station), None)
    yield _Shot("plates/b.png", SECOND_CAMERA_DEG, None)
    for number in range(amount.num_photos):
        # The moving camera's object lies still while the camera goes once along its arc.
        seed = (world, 0, number // stations)
        yield _Shot(f"photos/{number:04}.png", scenes.azimuth_deg(name, number), seed)
    for number in range(amount.num_tests):
        seed = (world, 1, number)
        yield _Shot(f"test/a/{number:04}.png", 0.0, seed)
        yield _Shot(f"test/b/{number:04}.png", SECOND_CAMERA_DEG, seed)


class _Taker:
    """The path traced scene and the sensor behind its lens."""

    def __init__(self, name: str, samples_per_pixel: int) -> None:
        meshes = [kind.mesh for kind in scenes.kinds(name) for _ in range(kind.count)]
        self._name, self._count = name, len(meshes)
        self._scene = PathTracedScene(
            [Thing(mesh, scenes.colour(slot)) for slot, mesh in enumerate(meshes)],
            scenes.table_look(),
            _TABLE_M,
            scenes.camera_matrix(name),
            scenes.frame_size(name),
            focus_m=scenes.DISTANCE_M,
            aperture_m=_APERTURE_M,
            samples_per_pixel=samples_per_pixel,
        )

    def take(self, shot: _Shot) -> np.ndarray:
        """The photograph [height, width, 3] uint8."""
        poses: list[np.ndarray | None] = [None] * self._count
        if shot.scene_seed is not None:
            for placed in scenes.draw(self._name, np.random.default_rng(shot.scene_seed)):
                poses[placed.slot] = placed.world_from_obj
        seed = zlib.crc32(shot.file.encode()) % 2**31
        radiance = self._scene.photograph(scenes.cam_from_world(shot.azimuth_deg), poses, seed)
        return Sensor(_EXPOSURE).develop(radiance, np.random.default_rng(seed))


def _describe(name: str, root: Path, shots: list[_Shot]) -> None:
    """Everything but the pictures; cheap enough to be written each time."""
    for folder in ("calibration", "meshes", "photos", "plates", "test/a", "test/b", "labels"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    for kind in scenes.kinds(name):
        shape = trimesh.Trimesh(kind.mesh.vertices_m, kind.mesh.faces, process=False)
        shape.export(root / "meshes" / f"{kind.name}.stl")
    seed = scenes.NAMES.index(name)
    photograph_boards(root / "calibration", scenes.camera_matrix(name), scenes.frame_size(name), seed)
    save_intrinsics(root / "camera.json", calibrated(root / "calibration"))
    random = np.random.default_rng(seed)
    measured = {azimuth: _measured(azimuth, random) for azimuth in dict.fromkeys(shot.azimuth_deg for shot in shots)}
    plates = {shot.azimuth_deg: shot.file for shot in shots if shot.scene_seed is None}
    views = {
        shot.file: {"plate": plates[shot.azimuth_deg], "cam_from_world": measured[shot.azimuth_deg]} for shot in shots
    }
    _write_json(root / "views.json", views)
    for part in ("photos", "test"):
        _write_json(
            root / "labels" / f"{part}.json", _labels(name, [shot for shot in shots if shot.file.startswith(part)])
        )


def _measured(azimuth_deg: float, random: np.random.Generator) -> list[list[float]]:
    """A camera's pose as structure from motion might give it."""
    pose = scenes.cam_from_world(azimuth_deg)
    error = np.eye(4)
    error[:3, :3] = Rotation.from_rotvec(random.normal(0, _TURN_ERROR_DEG, 3), degrees=True).as_matrix()
    error[:3, 3] = random.normal(0, _SHIFT_ERROR_M, 3)
    matrix: list[list[float]] = (error @ pose).tolist()
    return matrix


def _labels(name: str, shots: list[_Shot]) -> dict[str, Any]:
    """The true camera, and of each photograph the things in it with their poses cam_from_obj [4, 4], metres."""
    names = [kind.name for kind in scenes.kinds(name) for _ in range(kind.count)]
    labels: dict[str, Any] = {"camera_matrix": scenes.camera_matrix(name).tolist(), "photographs": {}}
    for shot in shots:
        camera = scenes.cam_from_world(shot.azimuth_deg)
        labels["photographs"][shot.file] = [
            {
                "mesh": names[placed.slot],
                "color_srgb": scenes.colour(placed.slot),
                "cam_from_obj": (camera @ placed.world_from_obj).tolist(),
            }
            for placed in scenes.draw(name, np.random.default_rng(shot.scene_seed))
        ]
    return labels


def _write_json(path: Path, content: dict[str, Any]) -> None:
    draft = path.with_name(f"{path.name}.part")
    draft.write_text(json.dumps(content) + "\n", encoding="utf-8")
    os.replace(draft, path)


def _save(path: Path, pixels: np.ndarray) -> None:
    _, content = cv2.imencode(".png", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))
    draft = path.with_name(f"{path.name}.part")
    draft.write_bytes(content.tobytes())
    os.replace(draft, path)
