"""Parts on a table or floor before a known camera, learned from photographs (paper, section "Real world data").

The paper's setting: the meshes, the plane and the camera's pose are known; the plane looks like a photograph of the
empty scene. Here:

* a scene code is in the world frame of ``--plane``: y up, the plane at y = 0. A part that stands has a position on the
  plane and a yaw, one that lies any way a free rotation and a height, too;
* a yaw is folded by the shape's rotational symmetry (:class:`~curio_train.worlds.generated.orientation.FoldedYaw`); of
  free rotations that look alike, the one nearest to the prediction is the true one. Paint tells the sides of a shape
  apart: a painted part has no symmetry;
* the code has the colour of meshes without colours, and the direction of the light (the paper's text names it), 30° to
  80° high. It shades parts and throws their shadows on the background image; its strength is that of ``ground.py``;
* if the numbers of parts vary each slot has a confidence;
* image loss and critic compare images behind a 9x9 Gaussian filter, as in the paper.

The world's own draws (sleep, and the held-out renderings of ``curio-eval``) put parts where the photographs ever
differ from the background image. The split "train" are the photographs; they have no codes.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.color import linear_from_srgb, srgb_from_linear
from curio_train.data.bop import ModelInfo
from curio_train.errors import UsageError
from curio_train.geometry import Pose, random_rotations, rotation_6d_from_matrix
from curio_train.meshes.meshes import Mesh
from curio_train.rendering.ground import Ground
from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION, YAW, Field, Layout, SceneCode
from curio_train.worlds.base import ObjectKind, PhotographSet, Split
from curio_train.worlds.generated.fields import (
    COLOR_FIELD,
    CONFIDENCE_FIELD,
    HIGHEST_SUN_DEG,
    LOWEST_SUN_DEG,
    SUN_FIELD,
)
from curio_train.worlds.generated.mesh_world import MeshKind, MeshWorld
from curio_train.worlds.generated.orientation import FoldedYaw, FreeRotation, NoRotation, Orientation
from curio_train.worlds.generated.scene_setup import SceneSetup
from curio_train.worlds.image_sets import StoredImages
from curio_train.worlds.placement import (
    random_colors,
    random_presence,
    random_suns,
    random_yaws,
    separate_positions,
)
from curio_train.worlds.single_object.base_colors import MIN_BASE_VALUE
from curio_train.worlds.tabletop.outputs import FileFrameOutputs

_MOVED = 1e-6  # of a diameter; points that are nearer are one
_GAIN, _TINT, _NOISE = 0.1, 0.03, 0.03  # of sRGB


@dataclass(frozen=True, eq=False)
class Part:
    """A kind of part."""

    kind: ObjectKind
    """The kind as its file describes it, without slots."""
    mesh: Mesh
    """Its own frame has y up; its middle at the origin, or if it stands its lowest point below the middle. Symmetries
    leave the middle in its place."""
    file_from_own: Pose[np.ndarray]
    """Rotation and translation from the mesh's own frame to the file's, metres."""
    info: ModelInfo
    """Symmetries in the mesh's own frame; none of a painted part."""
    radius_m: float
    """Radius of a vertical cylinder round it if it stands, of a sphere if it lies."""
    min_count: int
    """Least number of such parts in a scene."""
    max_count: int
    """Largest number of such parts in a scene."""
    fold: int
    """Order of its rotational symmetry about the vertical axis; 0: of revolution."""
    unpainted: bool
    """Whether its colour is part of the scene code."""

    @property
    def mesh_of_file(self) -> Mesh:
        """The mesh in the frame of its file."""
        return replace(self.mesh, vertices_m=self.file_from_own.apply(self.mesh.vertices_m))


@dataclass(frozen=True, eq=False)
class TabletopPhotographs:
    """The photographs of a plane, in the size of the world's camera."""

    training: Tensor
    """uint8 [num, 3, height, width]."""
    backgrounds: Tensor | None
    """uint8, of their shape: the empty scene behind each; None: all have the same background image."""
    own: PhotographSet
    """Photographs to judge by, and the empty scene before the world's camera."""
    second: PhotographSet | None
    """Photographs of these scenes by a second camera."""
    second_cam_from_world: Pose[np.ndarray] | None
    """Pose of that camera."""
    occupied: np.ndarray
    """bool [height, width]: pixels at which parts ever were."""
    position: Field
    """Field of the positions that parts may have."""


class TabletopWorld(MeshWorld):
    """The world of parts on a plane."""

    yaw_folds: Tensor
    """[slots] int: the fold of each slot's part."""

    def __init__(
        self, parts: Sequence[Part], setup: SceneSetup, photographs: TabletopPhotographs, *, lying: bool, blur_px: int
    ) -> None:
        """Build the renderer.

        Args:
            parts: The kinds of parts.
            setup: Camera, light and plane.
            photographs: The photographs.
            lying: Parts lie any way instead of standing upright.
            blur_px: Side of the Gaussian filter behind which images are compared.

        Raises:
            RendererError: No usable libLLVM.
        """
        self.parts, self.photographs, self._lying = tuple(parts), photographs, lying
        self._part_of_slot = [part for part in parts for _ in range(part.max_count)]
        self.yaw_folds = torch.tensor([part.fold for part in self._part_of_slot])
        self._unpainted = torch.tensor([part.unpainted for part in self._part_of_slot])
        orientation: Orientation = FoldedYaw(self.yaw_folds) if self.yaw_folds.any() else NoRotation()
        if lying:
            orientation = FreeRotation()
        fields = [photographs.position] + ([] if orientation.field is None else [orientation.field])
        fields += [COLOR_FIELD] * bool(self._unpainted.any())
        fields += [CONFIDENCE_FIELD] * any(part.min_count < part.max_count for part in parts)
        kinds = [MeshKind(part.kind.name, part.mesh, part.max_count, part.radius_m) for part in parts]
        layout = Layout((*fields, SUN_FIELD), len(self._part_of_slot))
        super().__init__("capture", layout, kinds, setup, orientation, self._drawn_from(photographs))
        self.comparison_blur_px = blur_px
        spans = [np.ptp(part.mesh.vertices_m, axis=0) for part in parts]
        self._middle_height_m = float(np.mean([span.mean() if lying else span[1] for span in spans])) / 2
        self.objects = tuple(
            replace(part.kind, slots=kind.slots) for part, kind in zip(parts, self.objects, strict=True)
        )

    def _drawn_from(self, photographs: TabletopPhotographs) -> dict[str, Any]:
        """Values that the draws depend on besides fields, meshes and setup."""
        arrays = (photographs.own.background_image.numpy(), photographs.occupied)
        constants = {
            "plate": [hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest() for array in arrays],
            "parts": [(part.min_count, part.fold, part.unpainted) for part in self.parts],
            "lying": self._lying,
        }
        if any(_is_off_middle(part, self._lying) for part in self.parts):
            constants["origins"] = [part.file_from_own.translation_m.tolist() for part in self.parts]
        return constants

    @property
    def slot_infos(self) -> list[ModelInfo]:
        """Symmetries of each slot's part, in the frame of :attr:`Part.mesh`."""
        return [part.info for part in self._part_of_slot]

    @property
    def model_name(self) -> str:
        """The parts' names."""
        return "-".join(part.kind.name for part in self.parts)

    @property
    def outputs(self) -> FileFrameOutputs:
        """Conversion between scene codes and poses of the mesh files' frames."""
        poses = [part.file_from_own.inverse() for part in self._part_of_slot]
        own_from_file = Pose(*(torch.from_numpy(np.stack(values)) for values in zip(*poses, strict=True)))
        return FileFrameOutputs(self.layout, self.setup, self.orientation, own_from_file)

    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        """Parts that do not touch, where photographs showed any, turned any way, under any sun."""
        random, num_slots = np.random.default_rng(seed), self.layout.num_slots
        field = self.photographs.position
        highest = (field.upper[0], 0.0, field.upper[2])
        position = separate_positions(count, self.radii_m, field.lower, highest, random, self._is_occupied)
        code = {TRANSLATION: position, LIGHT: random_suns(count, LOWEST_SUN_DEG, HIGHEST_SUN_DEG, random)}
        if self._lying:
            rotation = random_rotations(count * num_slots, random).unflatten(0, (count, num_slots))
            code[ROTATION_6D] = rotation_6d_from_matrix(rotation)
            code[TRANSLATION][..., 1] = self._touching_height(rotation)
        elif YAW in self.layout:
            yaws = random_yaws(count, num_slots, random)
            code[YAW] = torch.where(self.yaw_folds[:, None] > 0, yaws, torch.tensor([1.0, 0.0]))
        if COLOR in self.layout:
            colors = random_colors(count, num_slots, random, 0.0, MIN_BASE_VALUE)
            code[COLOR] = torch.where(self._unpainted[:, None], colors, 1.0)
        if CONFIDENCE in self.layout:
            present = [random_presence(count, part.max_count, part.min_count, random) for part in self.parts]
            code[CONFIDENCE] = torch.cat(present, dim=1)
        return {field.name: code[field.name].float() for field in self.layout.fields}

    def augment(self, images: Tensor, seed: tuple[int, ...]) -> Tensor:
        """Renderings with what differs between photographs of one camera: exposure, white balance, noise."""
        random = np.random.default_rng(seed)
        gain = 1 + random.uniform(-_GAIN, _GAIN, (len(images), 1)) + random.uniform(-_TINT, _TINT, (len(images), 3))
        noise = torch.randn(images.shape, generator=torch.Generator().manual_seed(int(random.integers(2**63))))
        level = random.uniform(0, _NOISE, (len(images), 1))
        factors, levels = (torch.from_numpy(value)[..., None, None].to(images) for value in (gain, level))
        return (images * factors + noise.to(images) * levels).clamp(0, 1)

    def novel_view(self, code: SceneCode) -> Tensor:
        """The scenes before the second camera and its background image; without one, the own view."""
        second, pose = self.photographs.second, self.photographs.second_cam_from_world
        if second is None or pose is None:
            return self.render(code)
        behind = second.background_image.to(code[TRANSLATION].device).float() / 255
        return self._render(code, pose, behind.expand(len(code[TRANSLATION]), -1, -1, -1))

    def source(self, split: Split, seed: int, *, with_code: bool, cache: Path) -> StoredImages:
        """The photographs as training split; as the other splits renderings, whose codes are known.

        Raises:
            UsageError: ``with_code`` with the training split: photographs have no codes.
        """
        if split != "train":
            return super().source(split, seed, with_code=with_code, cache=cache)
        if with_code:
            raise UsageError("photographs have no labels; expected --split test or validation, which are rendered")
        photographs = self.photographs
        return StoredImages(photographs.training, None, seed=seed, shuffle=True, backgrounds=photographs.backgrounds)

    def _background(self, ground: Ground | None, scene: Mapping[str, Any], backgrounds: Tensor | None) -> Tensor:
        """The background image, or the given ones, darkened by the parts' shadows."""
        assert ground is not None  # there is a plane
        light: Tensor = scene["light"]
        own = self.photographs.own.background_image
        behind = own.to(light) / 255 if backgrounds is None else backgrounds
        with torch.no_grad():  # shadows are for realism; their gradients would double a step's time
            sun = (light @ torch.as_tensor(ground.up).to(light)).clamp(min=0)
            lost = (sun / (self.setup.ambient + sun)).view(-1, 1, 1, 1)
            shadow = self._renderer.shadows(**scene, ground=ground)
            return srgb_from_linear(linear_from_srgb(behind) * (1 - lost * shadow))

    def _is_occupied(self, points: np.ndarray) -> np.ndarray:
        """Whether the middles of parts at these points [n, 3] of the plane project to occupied pixels."""
        in_camera = self.setup.cam_from_world.apply(points + np.array([0.0, self._middle_height_m, 0.0]))
        assert self.camera.matrix is not None  # it has a pinhole camera
        pixels = in_camera @ np.asarray(self.camera.matrix).T
        column, row = np.round(pixels[:, :2] / pixels[:, 2:]).astype(int).T
        height, width = self.photographs.occupied.shape
        inside = (in_camera[:, 2] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        found = self.photographs.occupied[row.clip(0, height - 1), column.clip(0, width - 1)]
        return np.asarray(inside & found)

    def _touching_height(self, rotation: Float[Tensor, "count slots 3 3"]) -> Tensor:
        """Heights [count, slots] of the parts' middles at which their lowest points touch the plane."""
        lowest = [
            (rotation[:, slot, 1] @ torch.from_numpy(part.mesh.vertices_m.T).to(rotation)).amin(dim=1)
            for slot, part in enumerate(self._part_of_slot)
        ]
        return -torch.stack(lowest, dim=1)


def _is_off_middle(part: Part, lying: bool) -> bool:
    """Whether a part's origin is another point than the middle of its box; of one that stands, as seen from above."""
    middle_m = (part.mesh.vertices_m.min(axis=0) + part.mesh.vertices_m.max(axis=0)) / 2
    return bool(np.abs(middle_m if lying else middle_m[[0, 2]]).max() > _MOVED * part.kind.diameter_m)
