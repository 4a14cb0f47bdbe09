"""The world of parts on a plane from a user's files: meshes set upright, photographs of one camera, the plane."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from curio_train.camera import Intrinsics, load_intrinsics
from curio_train.capture.plane import CameraPoseFile, changed_pixels, points_on_plane
from curio_train.data.bop import ModelInfo
from curio_train.data.part_color import is_unpainted
from curio_train.data.photographs import Photographs, read_frames
from curio_train.errors import CameraError, DataError, UsageError
from curio_train.geometry import Pose
from curio_train.meshes.meshes import Mesh, load_mesh
from curio_train.meshes.of_model import refuse_changed_mesh
from curio_train.meshes.symmetries import Symmetries, find_symmetries
from curio_train.scene_code import TRANSLATION, Field
from curio_train.worlds.base import Camera, ObjectKind, PhotographSet
from curio_train.worlds.generated.ground import AMBIENT, GROUND_SRGB, OUTLINE_SAMPLES, SUN, standing_kind
from curio_train.worlds.generated.scene_setup import SceneSetup
from curio_train.worlds.options import CaptureOptions
from curio_train.worlds.single_object.world import resized
from curio_train.worlds.tabletop.world import Part, TabletopPhotographs, TabletopWorld

SIDE_PX = 128
_SMALLEST_PX = 2.0  # smaller parts are no more than noise, and their files are of another unit
_MOST_COVERED = 4.0  # of a plane, by the discs around parts; those of long parts that lie overlap, and parts do not
_SAME_PLACE_M = 0.01  # within which two cameras are one
_OFF_AXIS = 0.01  # of the diameter; symmetries are not found exactly enough to correct the box's middle by less
_UP = np.array([0.0, 1.0, 0.0])
_PARALLEL, _LEVEL = 0.999, 0.04  # cosine of the angle between an axis and the vertical: the same, and across it

# Rotations from the mesh file's frame, with the named axis up, to one with y up; right-handed.
_Y_UP_FROM = {
    "x": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    "y": np.eye(3),
    "z": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
}


def build_tabletop(options: CaptureOptions) -> TabletopWorld:
    """Read everything that the world is made of.

    Args:
        options: With a plane and a background.

    Raises:
        UsageError: The flags do not fit each other.
        MeshError: A mesh is missing or broken.
        CameraError: The camera file or the file of the plane cannot be used.
        DataError: A photograph or background image is missing, broken or of another size, or they show no parts.
    """
    assert options.plane is not None
    assert options.background is not None  # the options have refused a plane without one
    count_ranges, intrinsics = options.count_ranges, load_intrinsics(options.camera)
    cameras = CameraPoseFile.read(options.plane)
    parts = [
        _part(_mesh(options, number), options.mesh[number].stem, options, *counts)
        for number, counts in enumerate(count_ranges)
    ]
    setup = SceneSetup(
        resized(intrinsics, SIDE_PX, SIDE_PX),
        Pose.from_matrix(cameras.pose_above_plane(options.background)),
        center_m=(0.0, 0.0, 0.0),
        up=(0.0, 1.0, 0.0),
        ambient=AMBIENT,
        sun=(0.0, SUN, 0.0),
        ground_srgb=GROUND_SRGB,
        outline_samples=OUTLINE_SAMPLES,
    )
    _refuse_invisible(setup, max(part.kind.diameter_m for part in parts), options.plane)
    highest_m = max(part.radius_m for part in parts) if options.lying else 0.0
    photographs = _photographs(options, options.background, cameras, intrinsics, setup, highest_m)
    _refuse_crowded(parts, photographs.position)
    return TabletopWorld(parts, setup, photographs, lying=options.lying, blur_px=options.blur_px)


def _refuse_crowded(parts: Sequence[Part], position: Field) -> None:
    """So many that each scene takes long to draw, and no photograph shows them."""
    radii = np.repeat([part.radius_m for part in parts], [part.max_count for part in parts])
    sides = (np.asarray(position.upper) - np.asarray(position.lower))[[0, 2]] + 2 * radii.mean()
    if np.pi * (radii**2).sum() > _MOST_COVERED * sides.prod():
        counts = " ".join(f"{part.min_count}-{part.max_count}" for part in parts)
        raise UsageError(
            f"--counts {counts}: so many parts do not fit where the photographs show parts, "
            f"{sides[0]:.2g} by {sides[1]:.2g} m; give the counts of your photographs, and check --mesh-unit"
        )


def _refuse_invisible(setup: SceneSetup, diameter_m: float, file: Path) -> None:
    """Camera poses in millimetres make parts of less than a pixel."""
    matrix, pose = setup.camera.matrix, setup.cam_from_world
    assert matrix is not None  # it has a pinhole camera
    height_m = float(-(pose.rotation.T @ pose.translation_m)[1])
    distance_m = height_m / -float(pose.rotation[2, 1])  # along the optical axis, to the plane
    size_px = float(matrix[0, 0]) * diameter_m / distance_m
    if size_px < _SMALLEST_PX:
        raise CameraError(
            f"--plane {file}: the camera is {distance_m:.3g} m away from the plane, so the largest part, whose "
            f"diameter is {diameter_m:.3g} m, is {size_px:.2g} pixels large in images of {SIDE_PX}; expected at least "
            f"{_SMALLEST_PX:g}. cam_from_world is in metres; check --mesh-unit, too"
        )


def _mesh(options: CaptureOptions, number: int) -> Mesh:
    file = options.mesh[number]
    mesh = load_mesh(file, options.mesh_unit, options.body)
    refuse_changed_mesh(mesh, options.sha256_of(number), file)
    return mesh


def _part(mesh: Mesh, name: str, options: CaptureOptions, min_count: int, max_count: int) -> Part:
    """A mesh set upright, or with its middle at the origin."""
    rotation = _Y_UP_FROM[options.up]
    rotated = mesh.vertices_m @ rotation.T
    low, high = rotated.min(axis=0), rotated.max(axis=0)
    unpainted = is_unpainted(mesh)
    found = find_symmetries(mesh) if unpainted else Symmetries((), ())
    alike = found.in_frame(rotation, np.zeros(3))
    origin = (low + high) / 2
    if options.centered:
        origin = _left_in_place(alike if options.lying else alike.about(_UP), origin, mesh.diameter_m)
    if not options.lying:
        origin[1] = low[1]
    own = dataclasses.replace(mesh, vertices_m=rotated - origin)
    radius_m = float(np.linalg.norm(own.vertices_m, axis=1).max())
    if not options.lying:
        radius_m = standing_kind(name, own, 1).radius_m
    kind = ObjectKind(name, (), mesh.diameter_m, mesh.box_corners_m, mesh.sha256, found.discrete, found.continuous)
    fold = yaw_fold(alike, _UP)
    file_from_own = Pose(rotation.T, rotation.T @ origin)
    in_own = alike.leaving(origin, _OFF_AXIS * mesh.diameter_m).in_frame(np.eye(3), -origin)
    info = ModelInfo(mesh.diameter_m, in_own.discrete, in_own.continuous)
    return Part(kind, own, file_from_own, info, radius_m, min_count, max_count, fold, unpainted)


def _left_in_place(alike: Symmetries, middle_m: np.ndarray, diameter_m: float) -> np.ndarray:
    """The middle of the box [3], or the nearest point that symmetries leave in its place if they move the middle.

    Those of a triangular part do.
    """
    left_m = alike.point_left(middle_m)
    return left_m if np.linalg.norm(left_m - middle_m) > _OFF_AXIS * diameter_m else middle_m


def yaw_fold(found: Symmetries, up: np.ndarray) -> int:
    """Order of the rotational symmetry about the vertical axis, 1 without one; 0: of revolution."""
    if len(found.continuous) > 1 or any(abs(axis @ up) > _PARALLEL for axis, _ in found.continuous):
        return 0
    for axis, _ in found.continuous:
        # A turn about a level axis and a flip of it make half a turn about the vertical.
        if abs(axis @ up) < _LEVEL and any(axis @ matrix[:3, :3] @ axis < -_PARALLEL for matrix in found.discrete):
            return 2
    return 1 + sum(bool(up @ matrix[:3, :3] @ up > _PARALLEL) for matrix in found.discrete)


def _photographs(
    options: CaptureOptions,
    background: Path,
    cameras: CameraPoseFile,
    intrinsics: Intrinsics,
    setup: SceneSetup,
    highest_m: float,
) -> TabletopPhotographs:
    empty = empty_scenes(options, background, cameras)
    paths = Photographs(options.photos, empty).paths
    for path in paths:
        cameras.check_same_viewpoint(path, background)
    own_backgrounds = [cameras.background_image(path) or background for path in paths]
    images = {path: _frames([path], intrinsics)[0] for path in {*own_backgrounds, background}}
    training = _frames(paths, intrinsics)
    backgrounds = torch.stack([images[path] for path in own_backgrounds])
    occupied = changed_pixels(list(training.numpy()), list(backgrounds.numpy()))
    position = _position_field(setup.camera, cameras.pose_above_plane(background), occupied, highest_m)
    judged = Photographs(options.held_out, empty).paths if options.held_out is not None else paths
    second = second_pose = None
    if options.second is not None and options.second_background is not None:
        judged, others = _pairs(options.second, judged, empty)
        second = PhotographSet(_frames(others, intrinsics), _frames([options.second_background], intrinsics)[0])
        second_pose = Pose.from_matrix(cameras.pose_above_plane(options.second_background))
        _refuse_same_view(second_pose, Pose.from_matrix(cameras.pose_above_plane(background)), options)
    own = PhotographSet(_frames(judged, intrinsics), images[background], [path.name for path in judged])
    differ = any(path != background for path in own_backgrounds)
    return TabletopPhotographs(training, backgrounds if differ else None, own, second, second_pose, occupied, position)


def _refuse_same_view(second: Pose[np.ndarray], own: Pose[np.ndarray], options: CaptureOptions) -> None:
    """From where the own camera stands, a second one cannot tell depth, which is what it is for."""
    if np.allclose(second.inverse().translation_m, own.inverse().translation_m, atol=_SAME_PLACE_M):
        raise UsageError(
            f"--second-background {options.second_background}: by --plane {options.plane} its camera stands where that "
            f"of --background {options.background} does; expected another viewpoint, or no --second"
        )


def empty_scenes(options: CaptureOptions, background: Path, cameras: CameraPoseFile) -> Sequence[Path]:
    """All images of the empty scene: they may lie among the photographs, and are none of them."""
    of_second = () if options.second_background is None else (options.second_background,)
    return (background, *of_second, *cameras.background_images)


def _pairs(folder: Path, paths: Sequence[Path], empty: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """The photographs that have a namesake in the second camera's folder, and those namesakes."""
    others = {path.name: path for path in Photographs(folder, empty).paths}
    own = [path for path in paths if path.name in others]
    if not own:
        raise DataError(
            f"--second {folder}: no photograph there is named like one in {paths[0].parent}; the two of a "
            f"scene have to have one name, such as {paths[0].name}"
        )
    return own, [others[path.name] for path in own]


def _position_field(camera: Camera, cam_from_world: np.ndarray, occupied: np.ndarray, highest_m: float) -> Field:
    """The rectangle of the plane around all points that project to occupied pixels."""
    assert camera.matrix is not None  # it has a pinhole camera
    points = points_on_plane(camera.matrix, cam_from_world, camera.width, camera.height)[occupied]
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
