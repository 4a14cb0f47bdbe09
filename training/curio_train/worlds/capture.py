"""Parts of your own in free space: meshes, one camera, six degrees of freedom, no labels.

One part is detected in two stages, or by templates alone; several by a locator and templates.

Images are rendered without end, as for LineMOD. What a data set's authors publish there is given or found out here:

* distances are given (0.3 to 1 m unless said otherwise), the part's middle is anywhere in the frame;
* the network reads where the middle is, wherever a CAD file has its origin, and the graph answers where the origin is;
* the part is seen from all sides alike, or from above alone;
* its symmetries are found from its shape; poses that differ by one count as equal, whatever is painted on it;
* one part without colours has a random base colour in each image, which the scene code holds: near ``--paint`` or the
  colour that photographs show where they differ from the background image, else any; several parts have a fixed one;
* light comes from the camera's half space, as LineMOD's does, over an ambient radiance of 0.4; in a known scene (with a
  background image) it is no weaker than that of a lamp or a window.

Parts on a plane are the world of ``tabletop``.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from curio_train.camera import Intrinsics, load_intrinsics
from curio_train.data.background_image import BACKGROUND_IMAGE_FRACTION, BackgroundImages, MixedBackgrounds
from curio_train.data.backgrounds import Backgrounds, ClutterBackgrounds, PhotographBackgrounds
from curio_train.data.part_color import is_unpainted
from curio_train.data.photographs import (
    FEWEST_TO_LEARN_FROM,
    MAX_UNLABELLED,
    NUM_JUDGED,
    Photographs,
    UnlabelledPhotographs,
    read_frames,
    spread,
)
from curio_train.errors import UsageError
from curio_train.geometry import random_rotations
from curio_train.meshes.meshes import Mesh, load_mesh
from curio_train.meshes.of_model import refuse_changed_mesh
from curio_train.meshes.symmetries import find_symmetries
from curio_train.worlds.base import Camera, ObjectKind, World
from curio_train.worlds.options import CaptureOptions, srgb_of
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object.base_colors import MIDDLE_GREY, any_base_color, base_colors_near
from curio_train.worlds.single_object.crop_pose_stage import MAX_LOG_SCALE
from curio_train.worlds.single_object.two_stage import LONGEST_SIDE_PX, TwoStageWorld, frame_camera
from curio_train.worlds.single_object.viewpoints import upper_hemisphere_rotations
from curio_train.worlds.single_object.world import Object
from curio_train.worlds.tabletop.files import build_tabletop

_SMALLEST_PX = 8.0  # of a part at its largest distance; a pose cannot be read from less


class CapturePhotographs:
    """The user's photographs of a part, without the lens's distortion, in the size of the world's camera."""

    def __init__(
        self,
        folder: Path,
        background: Path | None,
        intrinsics: Intrinsics,
        camera: Camera,
        judged: Collection[str] = (),
    ) -> None:
        """Read nothing yet.

        Args:
            folder: Of the photographs.
            background: Photograph of the empty scene.
            intrinsics: The camera that took them.
            camera: The world's.
            judged: File names of those that judge the model; if none is there, as many as there should be are chosen.
        """
        self._folder, self._background, self._intrinsics, self._camera = folder, background, intrinsics, camera
        self._judged = frozenset(judged)

    def paths(self) -> Sequence[Path]:
        """Files of all photographs; the one of the empty scene is none of them.

        Raises:
            DataError: The folder cannot be read.
        """
        return Photographs(self._folder, () if self._background is None else (self._background,)).paths

    def names_judged(self) -> tuple[str, ...]:
        """File names of those that the model never learns from.

        Raises:
            DataError: The folder cannot be read.
        """
        return tuple(path.name for path in self._split[0])

    def judged(self, count: int) -> tuple[list[Path], Tensor]:
        """At most ``count`` of those that the model never learns from: files, and [num, 3, height, width] in [0, 1].

        Raises:
            DataError: One cannot be read, or is not of the camera's size.
        """
        paths = spread(self._split[0], count)
        return paths, self._read(paths)

    def unlabelled_paths(self) -> Sequence[Path]:
        """Files of the others, which the model may learn from.

        Raises:
            DataError: The folder cannot be read.
        """
        return spread(self._split[1], MAX_UNLABELLED)

    def unlabelled(self) -> UnlabelledPhotographs:
        """The others, for self-training.

        Raises:
            DataError: The folder cannot be read.
        """
        return UnlabelledPhotographs(self.unlabelled_paths())

    def background_image(self) -> Tensor | None:
        """The empty scene, [3, height, width] in [0, 1], if there is a photograph of it.

        Raises:
            DataError: It cannot be read, or is not of the camera's size.
        """
        return None if self._background is None else self._read([self._background])[0]

    @property
    def _split(self) -> tuple[list[Path], list[Path]]:
        """Photographs to judge by, and the others; a model is judged by all if they are few."""
        paths = list(self.paths())
        is_many = len(paths) >= FEWEST_TO_LEARN_FROM
        judged = [path for path in paths if path.name in self._judged]
        if not judged:
            judged = spread(paths, NUM_JUDGED) if is_many else paths
        return judged, sorted(set(paths).difference(judged)) if is_many else []

    def _read(self, paths: Sequence[Path]) -> Tensor:
        frames = read_frames(paths, self._intrinsics, self._camera.width, self._camera.height)
        return torch.from_numpy(frames).float() / 255


def build(options: CaptureOptions) -> World:
    """The world of parts in free space, or on a plane.

    Raises:
        UsageError: The part would reach into the camera, or has two colours.
        MeshError: The mesh is missing or broken.
        CameraError: The camera file is missing or describes no camera, or the file of the plane cannot be used.
        DataError: Photographs or background images of a plane cannot be used.
    """
    if options.plane is not None:
        return build_tabletop(options)
    camera = load_intrinsics(options.camera)
    members = [_object(options, camera, file, slot) for slot, file in enumerate(options.mesh)]
    if options.paint is not None and not any(member.unpainted for member in members):
        named = ", ".join(map(str, options.mesh))
        raise UsageError(f"--paint {options.paint}: {named} has colours of its own; leave it out")
    photographs = CapturePhotographs(options.photos, options.background, camera, frame_camera(camera), options.judged)
    if len(members) > 1:
        name = "-".join(member.kind.name for member in members)
        painted = [_painted(member) for member in members]
        return SeveralObjectsWorld("capture", painted, photographs, name, aligns_outlines=True)
    return TwoStageWorld("capture", members[0], photographs, aligns_outlines=True)


def _object(options: CaptureOptions, camera: Intrinsics, file: Path, slot: int) -> Object:
    of_file = load_mesh(file, options.mesh_unit, options.body)
    refuse_changed_mesh(of_file, options.sha256_of(slot), file)
    found = find_symmetries(of_file)
    center_m = found.point_left(of_file.box_corners_m.mean(axis=0)) if options.centered else np.zeros(3)
    mesh = of_file.moved(-center_m)
    _refuse_collision(options, file, mesh)
    _refuse_invisible(options, file, of_file.diameter_m, camera)
    paint = None if options.paint is None else srgb_of(options.paint)
    kind = ObjectKind(
        file.stem,
        (slot,),
        of_file.diameter_m,
        of_file.box_corners_m,
        of_file.sha256,
        found.discrete,
        found.continuous,
        center_m=(float(center_m[0]), float(center_m[1]), float(center_m[2])),
        hull_m=of_file.hull_m,
    )
    return Object(
        kind,
        mesh,
        camera,
        options.near_m,
        options.far_m,
        partial(_backgrounds, options, camera),
        upper_hemisphere_rotations if options.upright else random_rotations,
        unpainted=is_unpainted(mesh),
        base_colors=any_base_color if paint is None else base_colors_near(paint),
        typical_color=paint or MIDDLE_GREY,
        known_scene=options.background is not None,
    )


def _painted(one: Object) -> Object:
    """The object in its typical colour, where it has none of its own: templates know no other."""
    if not one.unpainted:
        return one
    colors = np.broadcast_to(np.array(one.typical_color), one.mesh.vertices_m.shape)
    return replace(one, mesh=replace(one.mesh, vertex_colors_srgb=colors), unpainted=False)


def _refuse_collision(options: CaptureOptions, file: Path, mesh: Mesh) -> None:
    """The crop-pose stage sees objects nearer than the nearest, by the largest error of the localisation stage."""
    reach = float(np.linalg.norm(mesh.vertices_m, axis=1).max())
    least = reach * float(np.exp(MAX_LOG_SCALE))
    if options.near_m > least:
        return
    raise UsageError(
        f"--near-m {options.near_m:g}: {file} reaches {reach:.3g} m from its middle, so the camera would be "
        f"inside it; expected more than {least:.3g} m. If the part is smaller than that, check --mesh-unit"
    )


def _refuse_invisible(options: CaptureOptions, file: Path, diameter_m: float, camera: Intrinsics) -> None:
    """Distances in millimetres make objects of less than a pixel."""
    matrix = frame_camera(camera).matrix
    assert matrix is not None  # it has a pinhole camera
    size_px = float(matrix[0, 0]) * diameter_m / options.far_m
    if size_px < _SMALLEST_PX:
        raise UsageError(
            f"--far-m {options.far_m:g}: at this distance {file}, whose diameter is {diameter_m:.3g} m, is "
            f"{size_px:.2g} pixels large in frames of {LONGEST_SIDE_PX}; expected at least {_SMALLEST_PX:g}. "
            "--near-m and --far-m are in metres; check --mesh-unit, too"
        )


def _backgrounds(options: CaptureOptions, camera: Intrinsics, cache: Path) -> Backgrounds:
    """The background image mixed with clutter, photographs, or clutter alone.

    Raises:
        DataError: A photograph is missing, broken or of another size, or the cache cannot be written.
    """
    if options.backgrounds is not None:
        return PhotographBackgrounds(Photographs(options.backgrounds))
    if options.background is None:
        return ClutterBackgrounds.cached(cache)
    background_image = BackgroundImages.read(options.background, camera)  # before half a minute is spent on clutter
    return MixedBackgrounds(background_image, ClutterBackgrounds.cached(cache), BACKGROUND_IMAGE_FRACTION)
