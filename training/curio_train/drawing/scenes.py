"""Scenes to be drawn for people: lines of ``curio-detect`` and scene codes, read from JSON."""

import dataclasses
import functools
import json
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from curio_serve.files import read_file
from curio_serve.imaging.rotation import is_rotation

from curio_train.camera import check_matrix
from curio_train.errors import DataError
from curio_train.geometry import Pose
from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, TRANSLATION, SceneCode
from curio_train.worlds import WORLDS, build
from curio_train.worlds.base import World
from curio_train.worlds.generated.mesh_world import MeshWorld

_MAX_BYTES = 1 << 28
_SHEAR = 1e-2  # of a rotation times its transpose, as files round it
_VIDEO_FRAME = re.compile(r"(.+)#(\d+)", re.DOTALL)
EXPECTED = 'a line of curio-detect with "detections", or {"world": NAME, "code": {FIELD: numbers}}'


@dataclass(frozen=True, eq=False)
class Placed:
    """One object of a scene."""

    kind: str
    """Its name, by which its mesh is found."""
    pose: Pose
    """Cam_from_obj, metres."""
    color_srgb: tuple[float, ...] = (1.0, 1.0, 1.0)
    """Albedo [3] that multiplies the mesh's own."""
    confidence: float = 1.0
    """Opacity that the object is drawn with, 0 to 1."""
    box_px: np.ndarray | None = None
    """Corners of the object's box [8, 2] in the photograph, pixels, as they were detected; None: not known."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Objects before a camera."""

    name: str
    """Name of the picture's file, without its suffix."""
    width: int
    """Width of the image that the camera matrix belongs to, pixels."""
    height: int
    """Height of that image, pixels."""
    camera_matrix: np.ndarray
    """K [3, 3]."""
    objects: tuple[Placed, ...]
    """The objects; their poses are in the camera's frame."""
    light: np.ndarray | None
    """Camera frame, towards the light [3], or None: not known."""
    photograph: Path | None = None
    """Photograph that the objects were found in, or None; a frame of a video is ``clip.mp4#12``."""
    world: str | None = None
    """Name of the generated world that the scene is a code of, or None."""
    distortion: tuple[float, ...] = ()
    """OpenCV's coefficients of the camera that took the photograph: none, 4, 5 or 8; the scene itself has none."""
    exif_rotation: bool = False
    """Whether the photograph was rotated as EXIF says before objects were found in it."""


@functools.cache
def mesh_world(name: str) -> MeshWorld:
    """The generated world of that name.

    Raises:
        DataError: There is none, or it is not a world of generated meshes.
    """
    known = _without_files()
    world = build(WORLDS[name]()) if name in known else None
    if not isinstance(world, MeshWorld):
        solid = [kind for kind in known if kind != "circles"]
        raise DataError(f"world {name!r} has no meshes of its own; expected one of {', '.join(solid)}")
    return world


def _without_files() -> list[str]:
    """Names of the worlds that a name alone says: they have no options, and so no files."""
    return [kind for kind, options in WORLDS.items() if not dataclasses.fields(options)]


def read_scenes(path: Path) -> Iterator[Scene]:
    """The scenes of a JSON Lines file, or of one JSON object, in their order; lines that report an error are left out.

    Raises:
        DataError: The file cannot be read, or a line is no scene; it is named.
    """
    for number, record in _records(path):
        where = f"{path}, line {number}"
        if not isinstance(record, dict) or not {"detections", "code", "error"} & record.keys():
            raise DataError(f"{where}: found {_short(record)}, expected {EXPECTED}")
        if "error" in record:
            continue
        try:
            yield _from_code(record, number) if "code" in record else _from_detections(record, number, path)
        except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError) as exc:
            raise DataError(f"{where}: not a scene ({type(exc).__name__}: {exc}); expected {EXPECTED}") from exc


def _records(path: Path) -> Iterator[tuple[int, Any]]:
    try:
        text = read_file(path, _MAX_BYTES).decode("utf-8")
    except (OSError, UnicodeDecodeError) as exc:
        raise DataError(f"{path}: cannot be read ({exc}); expected {EXPECTED}") from exc
    if not text.strip():
        raise DataError(f"{path}: the file is empty; expected {EXPECTED}")
    try:
        yield 1, json.loads(text)
        return
    except (ValueError, RecursionError):
        pass  # more than one line, or damaged: the lines below tell
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip():
            try:
                yield number, json.loads(line)
            except (ValueError, RecursionError) as exc:
                raise DataError(f"{path}, line {number}: not JSON ({exc}); expected {EXPECTED}") from exc


def file_of(image: Path) -> tuple[Path, int | None]:
    """The file that holds an image of a result file, and the image's number in it if that is a video."""
    match = None if os.path.exists(image) else _VIDEO_FRAME.fullmatch(str(image))
    return (image, None) if match is None else (Path(match[1]), int(match[2]))


def located(image: Path, folder: Path) -> Path:
    """An image by the path in a result file, which counts from where ``curio-detect`` was called.

    Args:
        image: As in the file.
        folder: Of the result file; the image is looked for there if it is not found.
    """
    is_beside = not os.path.exists(file_of(image)[0]) and os.path.exists(file_of(folder / image)[0])
    return folder / image if is_beside else image


def _from_detections(record: Mapping[str, Any], number: int, path: Path) -> Scene:
    where = f"{path}, line {number}"
    if record["camera_matrix"] is None:
        raise DataError(f"{where}: it has no camera_matrix, so it is flat; expected poses in three dimensions")
    width, height = int(record["width"]), int(record["height"])
    light, world, cam_from_rig = record.get("light"), record.get("world"), _cam_from_rig(record, where)
    image = None if record["image"] is None else Path(record["image"])
    return Scene(
        f"{number:06d}-{'scene' if image is None else image.stem}",
        width,
        height,
        check_matrix(record["camera_matrix"], width, height, f"{where}, camera_matrix"),
        tuple(_placed(detection, cam_from_rig) for detection in record["detections"]),
        None if light is None else _numbers(light, (3,), "light"),
        located(image, path.parent) if image is not None and world is None else None,
        None if world is None else mesh_world(str(world)).name,
        distortion=tuple(map(float, record.get("distortion") or ())),
        exif_rotation=record.get("exif_rotation") is True,
    )


def _cam_from_rig(record: Mapping[str, Any], where: str) -> Pose:
    """The pose of the camera that took the image, where detections are in the frame of a rig; else the identity.

    Raises:
        DataError: The line is of a rig and does not say the pose.
    """
    if "cam_from_rig" in record:
        return Pose.from_matrix(_numbers(record["cam_from_rig"], (4, 4), "cam_from_rig"))
    if "views" in record:
        raise DataError(
            f"{where}: its poses are in the frame of a rig, and it has no cam_from_rig of the image's camera; run "
            "curio-detect --rig again, which writes it"
        )
    return Pose.identity()


def _placed(detection: Mapping[str, Any], cam_from_rig: Pose) -> Placed:
    rotation, color, box_px = detection["rotation"], detection["color"], detection.get("box_px")
    return Placed(
        str(detection["object"]),
        cam_from_rig
        @ Pose(
            np.eye(3) if rotation is None else _rotation(rotation),
            _numbers(detection["translation_m"], (3,), "translation_m"),
        ),
        (1.0, 1.0, 1.0) if color is None else tuple(_numbers(color, (3,), "color").tolist()),
        float(detection["confidence"]),
        _corners(box_px),
    )


def _rotation(values: Any) -> np.ndarray:
    found = _numbers(values, (3, 3), "rotation")
    if not is_rotation(found, _SHEAR):
        raise ValueError(f"rotation is {_short(values)}, expected rows at right angles of length 1, and no reflection")
    return found


def _corners(box_px: Any) -> np.ndarray | None:
    """The corners of a box as they were detected; None where they are not written or one is behind the camera."""
    if box_px is None or any(value is None for corner in box_px for value in corner):
        return None
    return _numbers(box_px, (8, 2), "box_px")


def _from_code(record: Mapping[str, Any], number: int) -> Scene:
    world = mesh_world(str(record["world"]))
    code = {name: torch.tensor([values], dtype=torch.float32) for name, values in record["code"].items()}
    world.layout.check(code)
    return scene_of_code(world, code, number)


def scene_of_code(world: World, code: SceneCode, number: int) -> Scene:
    """The scene of a code.

    Args:
        world: Before a pinhole camera.
        code: Of one image (batch size 1).
        number: Goes into the scene's name.
    """
    seen = {name: values[0].double().numpy() for name, values in world.outputs.from_code(code).items()}
    slots = len(seen[TRANSLATION])
    rotation = seen.get("rotation", np.broadcast_to(np.eye(3), (slots, 3, 3)))
    color, confidence = seen.get(COLOR, np.ones((slots, 3))), seen.get(CONFIDENCE, np.ones(slots))
    kinds = {slot: kind.name for kind in world.objects for slot in kind.slots}
    objects = [
        Placed(kinds[i], Pose(rotation[i], seen[TRANSLATION][i]), tuple(color[i].tolist()), float(confidence[i]))
        for i in range(slots)
    ]
    camera = world.camera
    assert camera.matrix is not None  # only worlds with a pinhole camera come here
    name = f"{number:06d}-{world.name}"
    light = seen.get(LIGHT)
    named = world.name if world.name in _without_files() else None
    return Scene(name, camera.width, camera.height, camera.matrix, tuple(objects), light, world=named)


def _numbers(values: Any, shape: tuple[int, ...], name: str) -> np.ndarray:
    found = np.asarray(values, dtype=np.float64)
    if found.shape != shape or not np.isfinite(found).all():
        raise ValueError(f"{name} is {_short(values)}, expected finite numbers of shape {list(shape)}")
    return found


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
