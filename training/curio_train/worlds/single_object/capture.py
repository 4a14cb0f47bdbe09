"""A part of one's own: one mesh, one camera, six degrees of freedom, no labels. Parts on a plane: ``table.py``.

Images are rendered without end, as for LineMOD; what a data set's authors publish there is asked for or found out here:

* distances are given (0.3 to 1 m unless said otherwise), the part's origin is anywhere in the frame;
* it is seen from all sides alike, or from above alone;
* its symmetries are found from its shape; poses that differ by one count as equal, whatever is painted on it;
* a mesh without colours has another colour in each image, which is read with the pose: about the one that the part
  has in the photographs where a plate shows what is not the part, else of any saturation;
* light is that of LineMOD: from the camera's half space, over an ambient radiance of 0.4.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from curio_train.camera import Intrinsics, load_intrinsics
from curio_train.data.background_image import BACKGROUND_IMAGE_FRACTION, BackgroundImages, MixedBackgrounds
from curio_train.data.backgrounds import Backgrounds, ClutterBackgrounds, PhotographBackgrounds
from curio_train.data.part_color import is_unpainted
from curio_train.data.photographs import MAX_UNLABELLED, Photographs, UnlabelledPhotographs, read_frames, spread
from curio_train.errors import UsageError
from curio_train.geometry import random_rotations
from curio_train.meshes.meshes import Mesh, load_mesh
from curio_train.meshes.symmetries import find_symmetries
from curio_train.worlds.base import ObjectKind, World
from curio_train.worlds.options import CaptureOptions
from curio_train.worlds.single_object.base_colors import base_colors_near
from curio_train.worlds.single_object.two_stage import LARGEST_LOG_SCALE, TwoStageWorld
from curio_train.worlds.single_object.viewpoints import upper_views
from curio_train.worlds.single_object.world import Object, any_base_color
from curio_train.worlds.tabletop.files import build_table

NUM_JUDGED = 40
"""Photographs that a model is judged by, and that it therefore never learns from; of fewer than twice as many it learns
from none."""


class Capture(TwoStageWorld):
    """One part before the camera that took a folder of photographs."""

    def __init__(self, thing: Object, images: Path, background: Path | None = None) -> None:
        """Nothing of the photographs is read before they are asked for."""
        super().__init__("capture", thing)
        self._images, self._background = images, background

    def photographs(self, count: int) -> Tensor:
        """Those that teach nothing, without the lens's distortion, in the canonical size."""
        return self._read(spread(self._divided[0], count)).float() / 255

    def unlabelled(self) -> UnlabelledPhotographs:
        """The photographs that the model is not judged by."""
        return UnlabelledPhotographs(spread(self._divided[1], MAX_UNLABELLED))

    def plate(self) -> Tensor | None:
        """What ``--background`` shows, as the photographs come."""
        return None if self._background is None else self._read([self._background])[0].float() / 255

    @property
    def _divided(self) -> tuple[list[Path], list[Path]]:
        """Photographs to judge by, and the others; of a few the model is judged by all."""
        paths = list(Photographs(self._images).paths)
        if len(paths) < 2 * NUM_JUDGED:
            return paths, []
        judged = spread(paths, NUM_JUDGED)
        return judged, sorted(set(paths).difference(judged))

    def _read(self, paths: Sequence[Path]) -> Tensor:
        return torch.from_numpy(read_frames(paths, self.object.camera, self.camera.width, self.camera.height))


def build(options: CaptureOptions) -> World:
    """The world of one part in free space, or of parts on a plane.

    Raises:
        UsageError: The part would reach into the camera, or has two colours.
        MeshError: The mesh is missing or broken.
        CameraError: The camera file is missing or describes no camera.
        DataError: Of a plane, photographs, plates or its file cannot be used.
    """
    if options.plane is not None:
        return build_table(options)
    (file,) = options.mesh
    mesh, camera = load_mesh(file, options.mesh_unit), load_intrinsics(options.camera)
    _refuse_collision(options, mesh)
    if options.paint is not None and not is_unpainted(mesh):
        raise UsageError(f"--paint {options.paint}: {file} has colours of its own; leave it out")
    found = find_symmetries(mesh)
    kind = ObjectKind(
        file.stem, (0,), mesh.diameter_m, mesh.box_corners_m, mesh.sha256, found.discrete, found.continuous
    )
    thing = Object(
        kind,
        mesh,
        camera,
        options.near_m,
        options.far_m,
        partial(_backgrounds, options, camera),
        upper_views if options.upright else random_rotations,
        painted=is_unpainted(mesh),
        paints=any_base_color if options.paint is None else base_colors_near(options.paint),
        known_scene=options.background is not None,
    )
    return Capture(thing, options.photos, options.background)


def _refuse_collision(options: CaptureOptions, mesh: Mesh) -> None:
    """The nearest that a crop may have to be thought at is nearer than the nearest place by the first look's error."""
    reach = float(np.linalg.norm(mesh.vertices_m, axis=1).max())
    least = reach * float(np.exp(LARGEST_LOG_SCALE))
    if options.near_m > least:
        return
    raise UsageError(
        f"--near-m {options.near_m:g}: {options.mesh[0]} reaches {reach:.3g} m from its origin, so the camera would be "
        f"inside it; expected more than {least:.3g} m. If the part is smaller than that, check --mesh-unit, and that "
        "the origin lies within the part (curio-doctor --mesh)"
    )


def _backgrounds(options: CaptureOptions, camera: Intrinsics, cache: Path) -> Backgrounds:
    """The plate mixed with clutter, photographs, or clutter alone.

    Raises:
        DataError: A photograph is missing, broken or of another size, or the cache cannot be written.
    """
    if options.backgrounds is not None:
        return PhotographBackgrounds(Photographs(options.backgrounds))
    if options.background is None:
        return ClutterBackgrounds.cached(cache)
    plate = BackgroundImages.read(options.background, camera)  # before half a minute is spent on clutter
    return MixedBackgrounds(plate, ClutterBackgrounds.cached(cache), BACKGROUND_IMAGE_FRACTION)
