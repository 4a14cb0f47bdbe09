"""The world of parts on a plane from a user's files: meshes set upright, photographs through one camera, the plane."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from curio_train.camera import Intrinsics, load_intrinsics
from curio_train.capture.plane import CameraPoseFile, ever_changed, seen_points
from curio_train.data.photographs import Photographs, read_frames
from curio_train.errors import DataError
from curio_train.geometry import Pose
from curio_train.meshes.meshes import Mesh, load_mesh
from curio_train.meshes.symmetries import Symmetries, find_symmetries
from curio_train.scene_code import TRANSLATION, Field
from curio_train.worlds.base import Camera, ObjectKind, View
from curio_train.worlds.generated.ground import AMBIENT, SUN
from curio_train.worlds.generated.mesh_world import SceneSetup
from curio_train.worlds.options import CaptureOptions
from curio_train.worlds.single_object.world import resized
from curio_train.worlds.tabletop.world import Part, Pictures, Table

SIDE_PX = 128
_ALONG = 0.999  # cosine of an angle between an axis and the vertical that counts as none

# Rotations that carry the mesh's axis up to y; each keeps the frame right-handed.
_Y_FROM_UP = {
    "x": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    "y": np.eye(3),
    "z": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
}


def build_table(options: CaptureOptions) -> Table:
    """Read everything that the world is made of.

    Raises:
        UsageError: The flags do not fit each other.
        MeshError: A mesh is missing or broken.
        CameraError: The camera file or the file of the plane does not do.
        DataError: A photograph or plate is missing, broken or of another size, or they show no parts.
    """
    assert options.plane is not None  # what makes it a table
    assert options.background is not None  # refused by the options
    amounts, intrinsics = options.amounts, load_intrinsics(options.camera)
    cameras = CameraPoseFile.read(options.plane)
    parts = [
        _part(load_mesh(file, options.mesh_unit), file.stem, options, *amount)
        for file, amount in zip(options.mesh, amounts, strict=True)
    ]
    camera = resized(intrinsics, SIDE_PX, SIDE_PX)
    pose = _pose(cameras.cam_from_world(options.background))
    stage = SceneSetup(camera, pose, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), AMBIENT, (0.0, SUN, 0.0))
    highest = max(float(np.linalg.norm(part.mesh.vertices_m, axis=1).max()) for part in parts) if options.lying else 0.0
    pictures = _pictures(options, cameras, intrinsics, camera, highest)
    return Table(parts, stage, pictures, lying=options.lying, blur_px=options.blur_px)


def _part(mesh: Mesh, name: str, options: CaptureOptions, fewest: int, most: int) -> Part:
    """A mesh set upright, or with its middle at the origin."""
    turn = _Y_FROM_UP[options.up]
    turned = mesh.vertices_m @ turn.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    origin = (low + high) / 2
    if not options.lying:
        origin[1] = low[1]
    own = dataclasses.replace(mesh, vertices_m=turned - origin)
    found = find_symmetries(mesh)
    kind = ObjectKind(name, (), mesh.diameter_m, mesh.box_corners_m, mesh.sha256, found.discrete, found.continuous)
    unpainted = mesh.texture is None and mesh.vertex_colors_srgb is None
    fold = _fold(found, turn[1]) if unpainted else 1
    return Part(kind, own, Pose(turn.T, turn.T @ origin), fewest, most, fold, unpainted)


def _fold(found: Symmetries, up: np.ndarray) -> int:
    """How many turns about the vertical axis look alike, being none among them; 0: all."""
    if len(found.continuous) > 1 or any(abs(axis @ up) > _ALONG for axis, _ in found.continuous):
        return 0
    return 1 + sum(bool(up @ matrix[:3, :3] @ up > _ALONG) for matrix in found.discrete)


def _pictures(
    options: CaptureOptions, cameras: CameraPoseFile, intrinsics: Intrinsics, camera: Camera, highest_m: float
) -> Pictures:
    assert options.background is not None  # refused by the options
    paths = Photographs(options.photos).paths
    for path in paths:
        cameras.sees_alike(path, options.background)
    own_plates = [cameras.plate(path) or options.background for path in paths]
    frames = {plate: _frames([plate], intrinsics)[0] for plate in {*own_plates, options.background}}
    training = _frames(paths, intrinsics)
    behind = torch.stack([frames[plate] for plate in own_plates])
    occupied = ever_changed(list(training.numpy()), list(behind.numpy()))
    position = _position(camera, cameras.cam_from_world(options.background), occupied, highest_m)
    judged = Photographs(options.held_out).paths if options.held_out is not None else paths
    views, second = _views(options, cameras, intrinsics, judged, frames[options.background])
    one_plate = len(set(own_plates)) == 1 and own_plates[0] == options.background
    return Pictures(training, behind[:1] if one_plate else behind, views, second, occupied, position)


def _views(
    options: CaptureOptions, cameras: CameraPoseFile, intrinsics: Intrinsics, paths: Sequence[Path], plate: Tensor
) -> tuple[tuple[View, ...], Pose | None]:
    if options.second is None or options.second_background is None:
        return (View(_frames(paths, intrinsics), plate),), None
    others = {path.name: path for path in Photographs(options.second).paths}
    pairs = [path for path in paths if path.name in others]
    if not pairs:
        raise DataError(
            f"--second {options.second}: no photograph there is named like one in {paths[0].parent}; the two of a "
            f"scene have to have one name, such as {paths[0].name}"
        )
    second_plate = _frames([options.second_background], intrinsics)[0]
    second = View(_frames([others[path.name] for path in pairs], intrinsics), second_plate)
    return (View(_frames(pairs, intrinsics), plate), second), _pose(cameras.cam_from_world(options.second_background))


def _position(camera: Camera, cam_from_world: np.ndarray, occupied: np.ndarray, highest_m: float) -> Field:
    """The rectangle of the plane that is seen where parts ever were."""
    assert camera.matrix is not None  # it has a pinhole camera
    points = seen_points(camera.matrix, cam_from_world, camera.width, camera.height)[occupied]
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise DataError("parts are seen above the horizon of --plane alone; does the file fit to the photographs?")
    low, high = points.min(axis=0), points.max(axis=0)
    return Field(
        TRANSLATION,
        3,
        unit="m",
        frame="world",
        lower=(float(low[0]), 0.0, float(low[2])),
        upper=(float(high[0]), highest_m, float(high[2])),
    )


def _frames(paths: Sequence[Path], intrinsics: Intrinsics) -> Tensor:
    return torch.from_numpy(read_frames(paths, intrinsics, SIDE_PX, SIDE_PX))


def _pose(matrix: np.ndarray) -> Pose:
    return Pose(matrix[:3, :3], matrix[:3, 3])
