"""``curio-train capture --calibrate``: a camera file, and where on request the camera stood, from photographs."""

import json
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from curio_serve.files import write_whole

from curio_train.camera import Intrinsics, load_intrinsics, save_intrinsics
from curio_train.capture.board_plane import pose_over_board, save_plane
from curio_train.capture.calibration import Board, calibrate
from curio_train.capture.ground import scale_by_distance, to_world
from curio_train.capture.options import CalibrateCommand
from curio_train.capture.rig import calibrate_rig, save_rig
from curio_train.capture.structure import Structure, every_nth, recover
from curio_train.data.photographs import Photographs
from curio_train.errors import CameraError, DataError, UsageError

_CAMERA_FILE = Path("camera.json")
_NAMED = 3
_OUTPUTS = ("--camera-out", "--views-out", "--rig-out", "--plane-out")
_NEEDED = {
    "--square-mm": "--board",
    "--marker-mm": "--board",
    "--dictionary": "--marker-mm",
    "--plane-out": "--board",
    "--data": "--objects",
    "--camera": "--views-out",
}
"""Flags that have no effect without another one."""

ByObjects = Callable[[Path, Path | None, Intrinsics], Callable[[Structure], tuple[Structure, str]]]
"""Loads models of objects (their folder, their data, the photographs' camera), and returns what brings a structure to
metres by them and says how; networks are none of this module's business."""


def run(command: CalibrateCommand, by_objects: ByObjects) -> str:
    """Do it, and say in a few lines what was found.

    Args:
        command: The flags.
        by_objects: For ``--objects``.

    Raises:
        UsageError: Flags that contradict each other or have no effect, or an output that is no file.
        DataError: Photographs that cannot be used, or a file that cannot be written.
        CameraError: They do not determine a camera.
    """
    _check(command)
    if command.rig_out is not None:
        return _rig(command, command.rig_out)
    if command.board is None:
        return _from_scene(command, by_objects)
    board = _board(command, command.board)
    found = calibrate(command.images, board)
    camera_out = command.camera_out or _CAMERA_FILE
    last = Photographs(command.images).paths[-1]
    over_board = None if command.plane_out is None else pose_over_board(found, last)
    save_intrinsics(camera_out, found.camera)
    plane = "" if over_board is None else _plane(command, last, over_board)
    unused = f", not found in {', '.join(path.name for path in found.unused[:5])}" if found.unused else ""
    return (
        f"{camera_out}: focal length {found.camera.matrix[0, 0]:.1f} pixels ± {found.focal_uncertainty:.2%}, "
        f"corners off by {found.error_px:.2f} pixels in {found.num_views} photographs{unused}"
        + _reading(board, found.board)
        + found.doubt
        + plane
    )


def _plane(command: CalibrateCommand, photograph: Path, over_board: np.ndarray) -> str:
    """Write where the camera of a photograph stands over the board, and say it."""
    path = command.plane_out
    assert path is not None
    save_plane(path, over_board)
    height_m, steepness = -float(over_board[:3, 1] @ over_board[:3, 3]), -float(over_board[2, 1])
    down_deg = math.degrees(math.asin(np.clip(steepness, -1, 1)))
    return (
        f"\n{path}: in the last photograph, {photograph.name}, the camera stands {height_m:.3f} m above the board and "
        f"looks {down_deg:.0f} degrees down on it; that is right if squares are {command.square_mm:g} mm (--square-mm)"
    )


def _board(command: CalibrateCommand, size: tuple[int, int]) -> Board:
    marker_m = None if command.marker_mm is None else command.marker_mm / 1000
    return Board(*size, command.square_mm / 1000, marker_m, command.dictionary)


def _rig(command: CalibrateCommand, path: Path) -> str:
    if command.board is None:
        raise UsageError("--rig-out needs photographs of a board: say which by --board")
    found = calibrate_rig(command.images, _board(command, command.board))
    save_rig(path, found)
    lines = [
        f"{path}: {len(found.names)} cameras, corners off by at most {found.error_px:.2f} pixels; distances are right "
        f"if squares are {command.square_mm:g} mm (--square-mm)"
    ]
    for name, camera, pose, count in zip(
        found.names, found.cameras, found.cam_from_rig, found.num_instants, strict=True
    ):
        away_m = float(np.linalg.norm(pose[:3, 3]))
        angle = float(np.degrees(np.arccos(np.clip((np.trace(pose[:3, :3]) - 1) / 2, -1, 1))))
        lines.append(
            f"  {name}: focal length {camera.camera.matrix[0, 0]:.1f} pixels, {away_m:.3f} m and {angle:.1f} degrees "
            f"from {found.names[0]}, by {count} photographs{camera.doubt}"
        )
    return "\n".join(lines)


def _reading(given: Board, found: Board) -> str:
    if found == given:
        return f"; --board {given.columns} {given.rows} counts squares"
    return (
        f"; --board {given.columns} {given.rows} counts the inner corners of a board of {found.columns}x{found.rows} "
        "squares"
    )


def _from_scene(command: CalibrateCommand, by_objects: ByObjects) -> str:
    known = None if command.camera is None else load_intrinsics(command.camera)
    scale = None
    if command.objects is not None and known is not None:  # which it needs, as was checked
        scale = by_objects(command.objects, command.data, known)
    given = every_nth(Photographs(command.images).paths, command.every)
    found = recover(given, known)
    missing = [path.name for path in given if path not in found.photographs]
    if command.distance_m is not None:
        _check_ends_placed(given, missing, command.distance_m)
    unplaced = f" (not placed: {_shortly(missing)})" if missing else ""
    lines = [
        f"placed {len(found.photographs)} of {len(given)} photographs{unplaced}, points off by {found.error_px:.2f} "
        "pixels"
    ]
    if known is None:
        lines.append(_save_found_camera(command.camera_out, found.camera))
    if command.views_out is not None:
        world = to_world(found)
        if command.distance_m is not None:
            world = scale_by_distance(world, 0, len(world.photographs) - 1, command.distance_m)
        elif scale is not None:
            world, line = scale(world)
            lines.append(line)
        in_metres = command.distance_m is not None or command.objects is not None
        _save_views(command.views_out, world, "m" if in_metres else None)
        unit = "metres" if in_metres else "no known unit: give --distance-m or --objects for metres"
        if command.distance_m is not None:
            unit += f", {command.distance_m:g} from {given[0].name} to {given[-1].name}"
        lines.append(f"{command.views_out}: cam_from_world of each, in {unit}")
    return "\n".join(lines)


def _save_found_camera(named: Path | None, camera: Intrinsics) -> str:
    """Write a scene's camera, but not over one that may come from a board and was not named; says what was done."""
    found = f"focal length {camera.matrix[0, 0]:.1f} pixels"
    if named is None and _CAMERA_FILE.exists():
        return f"{found}; {_CAMERA_FILE} is there already and was left as it is: to write this camera, add --camera-out"
    path = named or _CAMERA_FILE
    save_intrinsics(path, camera)
    return f"{path}: {found}"


def _check_ends_placed(given: Sequence[Path], missing: Sequence[str], distance_m: float) -> None:
    """Refuse a distance of two cameras one of which has no place: those beside it stand elsewhere."""
    ends = {"first": given[0].name, "last": given[-1].name}
    for end, name in ends.items():
        if name in missing:
            raise CameraError(
                f"--distance-m {distance_m:g} is from {ends['first']} to {ends['last']}, but {name} was not placed. "
                f"Take a new {end} photograph that shows more of what the others show, or remove it and measure the "
                f"distance to the photograph that is {end} then"
            )


def _shortly(names: Sequence[str]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return f"{', '.join(names[:_NAMED])}{more}"


def _check(command: CalibrateCommand) -> None:
    """Refuse before any work what cannot be done, and flags that would change nothing."""
    if command.every < 1:
        raise UsageError(f"--every {command.every}, expected 1 or more")
    if command.every > 1 and command.board is not None:
        raise UsageError(f"--every {command.every} is for photographs of a scene; leave it out, or leave out --board")
    _check_scale(command)
    for flag in ("--board", "--rig-out"):
        is_given = getattr(command, _field(flag)) is not None
        if is_given and (command.views_out is not None or command.camera is not None):
            raise UsageError(
                f"--views-out and --camera are for photographs of a scene; leave them out, or leave out {flag}"
            )
    for flag, needed in _NEEDED.items():
        given = getattr(command, _field(flag))
        if given != getattr(CalibrateCommand, _field(flag)) and getattr(command, _field(needed)) is None:
            raise UsageError(f"{flag} {given} has no effect without {needed}; add that, or leave out {flag}")
    for flag in ("--rig-out", "--camera"):
        if command.camera_out is not None and getattr(command, _field(flag)) is not None:
            raise UsageError(f"--camera-out {command.camera_out} is not written with {flag}; leave out one of them")
    if command.rig_out is not None and command.plane_out is not None:
        raise UsageError(f"--plane-out {command.plane_out} is of one camera; leave it out, or leave out --rig-out")
    _check_distinct(command)
    for flag in _OUTPUTS:
        _check_output(flag, getattr(command, _field(flag)))


def _check_distinct(command: CalibrateCommand) -> None:
    """Refuse to write two files into one, or over the camera that is read."""
    files = {flag: getattr(command, _field(flag)) for flag in ("--camera", *_OUTPUTS)}
    if command.camera is None and command.camera_out is None and command.rig_out is None:
        files["--camera-out"] = _CAMERA_FILE
    seen: dict[str, str] = {}
    for flag, path in files.items():
        if path is not None and (other := seen.setdefault(os.path.realpath(path), flag)) != flag:
            raise UsageError(f"{flag} {path} is the file of {other}, too; name another one")


def _field(flag: str) -> str:
    return flag.removeprefix("--").replace("-", "_")


def _check_output(flag: str, path: Path | None) -> None:
    if path is not None and os.path.isdir(path):
        raise UsageError(f"{flag} {path}: this is a folder, expected a file; name one in it")
    if path is not None and not os.path.isdir(path.parent):
        raise UsageError(f"{flag} {path}: there is no folder {path.parent}; make it first, or name another file")


def _check_scale(command: CalibrateCommand) -> None:
    ways = {"--distance-m": command.distance_m, "--objects": command.objects}
    given = [f"{flag} {value}" for flag, value in ways.items() if value is not None]
    if command.distance_m is not None and not 0 < command.distance_m < math.inf:
        raise UsageError(f"--distance-m {command.distance_m:g}: expected a distance in metres, more than 0")
    if given and command.views_out is None:
        raise UsageError(f"{given[0]} is for poses; name a file for them: --views-out")
    if len(given) > 1:
        raise UsageError(f"{' and '.join(given)} both say how large the scene is; leave one out")
    if command.objects is not None and command.camera is None:
        raise UsageError(f"--objects {command.objects}: give the camera that their networks know, too: --camera")


def _from(start: Path, folder: Path) -> str:
    """The path of a folder from another; the whole path where Windows has them on two drives."""
    try:
        return os.path.relpath(folder, start)
    except ValueError:
        return str(folder.absolute())


def _save_views(path: Path, structure: Structure, unit: str | None) -> None:
    views = {
        photo.name: {
            "cam_from_world": matrix.tolist(),
            "unit": unit,
            "folder": _from(path.absolute().parent, photo.parent),
        }
        for photo, matrix in zip(structure.photographs, structure.cam_from_world, strict=True)
    }
    try:
        write_whole(path, json.dumps(views) + "\n")
    except OSError as exc:
        raise DataError(f"{path}: cannot be written ({exc.strerror}); name another file: --views-out") from exc
