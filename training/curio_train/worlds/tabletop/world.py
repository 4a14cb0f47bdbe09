"""Parts on a table or floor before a known camera, learned from photographs (paper, section "Real world data").

The paper's setting: meshes known, the plane and the camera's place over it known, the plane looks like a photograph of
the empty scene. Read here:

* a scene code is in the world frame of ``--plane``: y up, the plane at y = 0. A part that stands has a place on the
  plane and a yaw, one that lies any way a free rotation and a height, too;
* a yaw is told up to the shape's symmetries: (i, j) of as many times the angle as there are turns about the vertical
  axis that look alike, and none at all for round parts. So equal images have equal codes;
* the colour of a mesh without colours is read; so is the direction of the light (the paper's text names it), 30° to 80°
  high. It shades parts and throws their shadows on the plate; its strength is that of ``ground.py``;
* where the numbers of parts vary each slot has a confidence;
* image loss and critic compare images behind a 9x9 Gaussian filter, as in the paper.

The world's own draws (sleep, and the held-out renderings of ``curio-eval``) put parts where the photographs ever
differ from the plate. The split "train" are the photographs; they have no codes.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.color import linear_from_srgb, srgb_from_linear
from curio_train.errors import UsageError
from curio_train.geometry import (
    Pose,
    matrix_from_rotation_6d,
    matrix_from_yaw,
    random_rotations,
    rotation_6d_from_matrix,
)
from curio_train.meshes.meshes import Mesh
from curio_train.metrics.images import blurred
from curio_train.rendering.ground import Ground
from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION, YAW, Field, SceneCode
from curio_train.worlds.base import ObjectKind, Split, View
from curio_train.worlds.generated.ground import TURN, GroundWorld
from curio_train.worlds.generated.light import SUN_FIELD, suns
from curio_train.worlds.generated.mesh_world import Kind, SceneSetup
from curio_train.worlds.generated.multi import COLOR_FIELD
from curio_train.worlds.generated.varied import CONFIDENCE_FIELD
from curio_train.worlds.image_sets import StoredImages
from curio_train.worlds.placement import colors, places, presence, yaws
from curio_train.worlds.single_object.world import LEAST_PAINT_VALUE

_GAIN, _TINT, _NOISE = 0.1, 0.03, 0.03
FREE_TURN = Field(ROTATION_6D, 6, frame="world", lower=(-1.0,) * 6, upper=(1.0,) * 6)


@dataclass(frozen=True, eq=False)
class Part:
    """A kind of part.

    Attributes:
        kind: As its file has it, without slots.
        mesh: With y up; its lowest point at y = 0 if it stands, its middle at the origin if it lies.
        file_from_own: From that frame to the file's.
        fewest: How many there are at least.
        most: And at most.
        fold: How many turns about the vertical axis look alike; 0: all.
        unpainted: Its colour is part of the scene code.
    """

    kind: ObjectKind
    mesh: Mesh
    file_from_own: Pose
    fewest: int
    most: int
    fold: int
    unpainted: bool


@dataclass(frozen=True, eq=False)
class Pictures:
    """What was photographed, uint8, through the world's camera.

    Attributes:
        training: [num, 3, height, width].
        behind: Their plates, or one of all of them [1, 3, height, width].
        views: See :meth:`~curio_train.worlds.base.World.views`; the first with the plate of the own camera.
        second: cam_from_world of the second view.
        occupied: [height, width], where parts ever were.
        position: Field of where they may be.
    """

    training: Tensor
    behind: Tensor
    views: tuple[View, ...]
    second: Pose | None
    occupied: np.ndarray
    position: Field


class Table(GroundWorld):
    """The world of parts on a plane."""

    name = "capture"
    object_shadows = False

    def __init__(
        self, parts: Sequence[Part], where: SceneSetup, pictures: Pictures, *, lying: bool, blur_px: int
    ) -> None:
        """Build the renderer.

        Raises:
            RendererError: No usable libLLVM.
        """
        self.parts, self.pictures, self._lying, self._blur_px = tuple(parts), pictures, lying, blur_px
        of_slots = [part for part in parts for _ in range(part.most)]
        folds = torch.tensor([part.fold for part in of_slots])
        self._turn_share = torch.where(folds > 0, 1 / folds.clamp(min=1), 0.0)[:, None]
        self._unpainted = torch.tensor([part.unpainted for part in of_slots])
        turns = [FREE_TURN] if lying else [TURN] * bool(folds.any())
        fields = [COLOR_FIELD] * bool(self._unpainted.any())
        fields += [CONFIDENCE_FIELD] * any(part.fewest < part.most for part in parts)
        kinds = [Kind(part.kind.name, part.mesh, part.most) for part in parts]
        super().__init__([*fields, SUN_FIELD], kinds, where, (pictures.position, *turns))
        self.objects = tuple(
            replace(part.kind, slots=kind.slots) for part, kind in zip(parts, self.objects, strict=True)
        )
        if lying:
            self.radii_m = [float(np.linalg.norm(part.mesh.vertices_m, axis=1).max()) for part in of_slots]
        moves = [part.file_from_own for part in of_slots]
        self._own_from_file = torch.from_numpy(np.stack([move.rotation.T for move in moves]))
        self._file_origin = torch.from_numpy(np.stack([-move.rotation.T @ move.translation_m for move in moves]))

    @property
    def model_name(self) -> str:
        """The parts' names."""
        return "-".join(part.kind.name for part in self.parts)

    @property
    def constants(self) -> Mapping[str, Any]:
        """What its draws depend on beside fields, meshes and stage."""
        pictures = (self.pictures.views[0].plate.numpy(), self.pictures.occupied)
        return {
            "plate": [hashlib.sha256(np.ascontiguousarray(part).tobytes()).hexdigest() for part in pictures],
            "parts": [(part.fewest, part.fold, part.unpainted) for part in self.parts],
            "lying": self._lying,
        }

    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        """Parts that do not touch, where photographs showed any, turned any way, under any sun."""
        random, num_slots = np.random.default_rng(seed), self.layout.num_slots
        field = self.pictures.position
        highest = (field.upper[0], 0.0, field.upper[2])
        place = places(count, self.radii_m, field.lower, highest, random, self._is_occupied)
        code = {TRANSLATION: place, LIGHT: suns(count, random)}
        if self._lying:
            turns = random_rotations(count * num_slots, random).unflatten(0, (count, num_slots))
            code[ROTATION_6D] = rotation_6d_from_matrix(turns)
            code[TRANSLATION][..., 1] = self._touching_height(turns)
        elif YAW in self.layout:
            code[YAW] = torch.where(self._turn_share > 0, yaws(count, num_slots, random), torch.tensor([1.0, 0.0]))
        if COLOR in self.layout:
            drawn = colors(count, num_slots, random, 0.0, LEAST_PAINT_VALUE)
            code[COLOR] = torch.where(self._unpainted[:, None], drawn, 1.0)
        if CONFIDENCE in self.layout:
            there = [presence(count, part.most, part.fewest, random) for part in self.parts]
            code[CONFIDENCE] = torch.cat(there, dim=1)
        return {field.name: code[field.name].float() for field in self.layout.fields}

    def augment(self, images: Tensor, seed: tuple[int, ...]) -> Tensor:
        """What differs from photograph to photograph of one camera: exposure, white balance, noise."""
        random = np.random.default_rng(seed)
        gain = 1 + random.uniform(-_GAIN, _GAIN, (len(images), 1)) + random.uniform(-_TINT, _TINT, (len(images), 3))
        noise = torch.randn(images.shape, generator=torch.Generator().manual_seed(int(random.integers(2**63))))
        level = random.uniform(0, _NOISE, (len(images), 1))
        factors, levels = (torch.from_numpy(value)[..., None, None].to(images) for value in (gain, level))
        return (images * factors + noise.to(images) * levels).clamp(0, 1)

    def compared(self, images: Tensor) -> Tensor:
        """Behind a Gaussian filter, so that noise and sharpness tell photographs and renderings less apart."""
        return blurred(images, self._blur_px)

    def views(self) -> tuple[View, ...]:
        """The photographs that were held out, or all, and what the second camera saw of their scenes."""
        return self.pictures.views

    def novel_view(self, code: SceneCode) -> Tensor:
        """From the second camera over its plate; without one, the own view."""
        if self.pictures.second is None:
            return self.render(code)
        plate = self.pictures.views[1].plate.to(code[TRANSLATION].device).float() / 255
        return self._view(code, self.pictures.second, plate.expand(len(code[TRANSLATION]), -1, -1, -1))

    def source(self, split: Split, seed: int, *, with_code: bool, cache: Path) -> StoredImages:
        """The photographs, or renderings over the plate, whose codes are known.

        Raises:
            UsageError: Codes of photographs are asked for.
        """
        if split != "train":
            return super().source(split, seed, with_code=with_code, cache=cache)
        if with_code:
            raise UsageError(
                "photographs have no labels: expected another --method than super, or --split test, which is rendered"
            )
        behind = self.pictures.behind if len(self.pictures.behind) > 1 else None
        return StoredImages(self.pictures.training, None, seed=seed, shuffle=True, behind=behind)

    def own_rotation(self, code: SceneCode) -> Float[Tensor, "batch slots 3 3"]:
        """world_from_own of each part."""
        if self._lying:
            return matrix_from_rotation_6d(code[ROTATION_6D].float())
        if YAW not in self.layout:
            return super().own_rotation(code)
        turned = matrix_from_yaw(code[YAW].float())
        share = self._turn_share[:, 0].to(turned)
        angle = torch.atan2(turned[..., 0, 2], turned[..., 0, 0]) * share
        return matrix_from_yaw(torch.stack([angle.cos(), angle.sin()], dim=-1))

    @property
    def exported_fields(self) -> tuple[Field, ...]:
        """With a rotation, which the code of round parts does not have."""
        fields = super().exported_fields
        if ROTATION_6D in (field.name for field in fields):
            return tuple(replace(FREE_TURN, frame="camera") if f.name == ROTATION_6D else f for f in fields)
        return (fields[0], replace(FREE_TURN, frame="camera"), *fields[1:])

    def exported(self, code: SceneCode) -> dict[str, Tensor]:
        """In the camera frame; objects in the frames of their files."""
        outputs = super().exported(code)
        own, origin = self._own_from_file.to(code[TRANSLATION]), self._file_origin.to(code[TRANSLATION])
        outputs[TRANSLATION] = outputs[TRANSLATION] + (outputs["rotation"] @ origin[..., None])[..., 0]
        outputs["rotation"] = outputs["rotation"] @ own
        outputs[ROTATION_6D] = rotation_6d_from_matrix(outputs["rotation"])
        return outputs

    def from_exported(self, outputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The scene code that :meth:`exported` made these outputs of."""
        own, origin = self._own_from_file.to(outputs[TRANSLATION]), self._file_origin.to(outputs[TRANSLATION])
        rotation = outputs["rotation"] @ own.transpose(-1, -2)
        place = outputs[TRANSLATION] - (rotation @ origin[..., None])[..., 0]
        return super().from_exported({**outputs, "rotation": rotation, TRANSLATION: place})

    def _rotation_entry(self, own: Tensor) -> dict[str, Tensor]:
        if self._lying:
            return {ROTATION_6D: rotation_6d_from_matrix(own)}
        folds = torch.tensor([part.fold for part in self.parts for _ in range(part.most)]).to(own)
        angle = torch.atan2(own[..., 0, 2], own[..., 0, 0]) * folds
        return {YAW: torch.stack([angle.cos(), angle.sin()], dim=-1)}

    def _behind(self, ground: Ground | None, scene: Mapping[str, Any], backgrounds: Tensor | None) -> Tensor:
        """The plate, or what was given, darkened where the parts keep the sun from it."""
        assert ground is not None  # there is a plane
        light: Tensor = scene["light"]
        plate = self.pictures.views[0].plate.to(light) / 255 if backgrounds is None else backgrounds
        with torch.no_grad():  # shadows are there for the likeness; their gradients would double a step's time
            sun = (light @ torch.as_tensor(ground.up).to(light)).clamp(min=0)
            lost = (sun / (self.stage.ambient + sun)).view(-1, 1, 1, 1)
            shadow = self._renderer.shadows(**scene, ground=ground)
            return srgb_from_linear(linear_from_srgb(plate) * (1 - lost * shadow))

    def _is_occupied(self, points: np.ndarray) -> np.ndarray:
        """Whether parts were ever photographed where parts at these points [n, 3] would have their middle."""
        turn, shift = self.stage.cam_from_world
        seen = (points + np.array([0.0, self._middle_height_m, 0.0])) @ turn.T + shift
        assert self.camera.matrix is not None  # it has a pinhole camera
        pixels = seen @ np.asarray(self.camera.matrix).T
        column, row = np.round(pixels[:, :2] / pixels[:, 2:]).astype(int).T
        height, width = self.pictures.occupied.shape
        inside = (seen[:, 2] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        found = self.pictures.occupied[row.clip(0, height - 1), column.clip(0, width - 1)]
        return np.asarray(inside & found)

    @cached_property
    def _middle_height_m(self) -> float:
        """Of a part over the plane, on average."""
        spans = [np.ptp(part.mesh.vertices_m, axis=0) for part in self.parts]
        return float(np.mean([span.mean() if self._lying else span[1] for span in spans])) / 2

    def _touching_height(self, turns: Float[Tensor, "count slots 3 3"]) -> Tensor:
        """How high the middle of each part is when its lowest point touches the plane, [count, slots]."""
        of_slots = [part.mesh.vertices_m for part in self.parts for _ in range(part.most)]
        lowest = [
            (turns[:, slot, 1] @ torch.from_numpy(vertices.T).to(turns)).amin(dim=1)
            for slot, vertices in enumerate(of_slots)
        ]
        return -torch.stack(lowest, dim=1)
