"""Worlds whose objects stand on a ground plane: Chairs, Multi and Light.

The paper gives no numbers. Ours were fixed before any training:

* the world frame has y up and its origin on the ground; an object's origin is its lowest point, so y is 0, and its yaw
  turns it about y; yaw 0 looks towards +z, where the camera stands;
* positions are uniform on a square of 1.7 m round the origin; objects do not touch whatever their yaw;
* the camera is 4 m from a point 0.15 m above the origin and looks down on it by 40°. At a focal length of 175 px for
  128x128 images (field of view 40°) every object is whole in the frame, and so it is in the novel view from 90° round
  the vertical axis; the horizon is above the frame;
* the ground is a grey of 0.5 (sRGB); ambient radiance 0.3, sun of strength 0.7. Where the sun does not change it is 50°
  high, to the left of the camera;
* objects throw shadows, on the ground and on each other; as rendering/shadows.py says, all that moves them has
  gradients but the border of a shadow on another object.

Codes are in the world frame. An exported model answers in the camera frame, which never moves.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from curio_train.geometry import Pose, camera_looking_at, rotation_6d_from_matrix
from curio_train.meshes.meshes import Mesh
from curio_train.rendering.ground import Ground
from curio_train.scene_code import CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION, YAW, Field, Layout, SceneCode
from curio_train.worlds.base import Camera
from curio_train.worlds.generated.mesh_world import Kind, MeshWorld, SceneSetup

SIDE_PX, FOCAL_PX = 128, 175.0
DISTANCE_M, ELEVATION_DEG, TARGET_HEIGHT_M = 4.0, 40.0, 0.15
REACH_M = 0.85
GROUND_SRGB = 0.5
AMBIENT, SUN = 0.3, 0.7
SUN_ELEVATION_DEG, SUN_AZIMUTH_DEG = 50.0, 40.0

POSITION = Field(
    TRANSLATION, 3, unit="m", frame="world", lower=(-REACH_M, 0.0, -REACH_M), upper=(REACH_M, 0.0, REACH_M)
)
TURN = Field(YAW, 2, frame="world", activation="tanh", lower=(-1.0, -1.0), upper=(1.0, 1.0))


def stage() -> SceneSetup:
    """Camera and light of all worlds on the ground."""
    up, across = np.sin(np.radians(ELEVATION_DEG)), np.cos(np.radians(ELEVATION_DEG))
    target = torch.tensor([0.0, TARGET_HEIGHT_M, 0.0], dtype=torch.float64)
    rotation, shift = camera_looking_at(target + DISTANCE_M * torch.tensor([0.0, up, across]), target)
    middle = (SIDE_PX - 1) / 2
    matrix = np.array([[FOCAL_PX, 0, middle], [0, FOCAL_PX, middle], [0, 0, 1]])
    elevation, azimuth = np.radians(SUN_ELEVATION_DEG), np.radians(SUN_AZIMUTH_DEG)
    level = np.cos(elevation)
    sun = SUN * np.array([-level * np.sin(azimuth), np.sin(elevation), level * np.cos(azimuth)])
    return SceneSetup(
        Camera(SIDE_PX, SIDE_PX, matrix, is_default=True),
        Pose(rotation.numpy(), shift.numpy()),
        center_m=(0.0, 0.0, 0.0),
        up=(0.0, 1.0, 0.0),
        ambient=AMBIENT,
        sun=tuple(sun.tolist()),
    )


def footprint_radius_m(mesh: Mesh) -> float:
    """Of the smallest vertical cylinder about the object's y axis: what yaw cannot leave."""
    return float(np.linalg.norm(mesh.vertices_m[:, [0, 2]], axis=1).max())


class GroundWorld(MeshWorld):
    """Objects that stand on the ground before the camera of :func:`stage`."""

    outline_samples = 256
    """Objects of 15 to 40 pixels: measured, half the usual number costs 0.001 of the gradients' cosine."""

    object_shadows = True
    on_plane = True

    def __init__(
        self,
        fields: Sequence[Field],
        kinds: Sequence[Kind],
        where: SceneSetup | None = None,
        poses: Sequence[Field] = (POSITION, TURN),
    ) -> None:
        """Stand the objects on the ground.

        Args:
            fields: Of the scene code beside the poses.
            kinds: Meshes with y up and their lowest point at y = 0.
            where: Camera and light; those of :func:`stage` unless given.
            poses: Fields of position and rotation.

        Raises:
            RendererError: No usable libLLVM.
        """
        layout = Layout((*poses, *fields), sum(kind.num_slots for kind in kinds))
        super().__init__(layout, kinds, where or stage())
        self.radii_m = [footprint_radius_m(kind.mesh) for kind in kinds for _ in range(kind.num_slots)]

    def ground(self, cam_from_world: Pose) -> Ground:
        """The plane y = 0."""
        turn, shift = cam_from_world
        up = np.asarray(turn)[:, 1]
        return Ground(up, -float(up @ np.asarray(shift)), GROUND_SRGB)

    @property
    def recipe(self) -> dict[str, Any]:
        """All that the images depend on."""
        return super().recipe | {"ground": GROUND_SRGB, "shadows": "ground and objects"}

    @property
    def exported_fields(self) -> tuple[Field, ...]:
        """As in the camera frame, with 6D rotations in place of yaw and the light as a vector."""
        turn, shift = self.stage.cam_from_world
        sun = float(np.linalg.norm(self.stage.sun))
        position = self.layout[TRANSLATION]
        corners = np.array(list(itertools.product(*zip(position.lower, position.upper, strict=True)))) @ turn.T + shift
        low, high = tuple(corners.min(axis=0).tolist()), tuple(corners.max(axis=0).tolist())
        exported = {
            TRANSLATION: dataclasses.replace(position, frame="camera", lower=low, upper=high),
            YAW: Field(ROTATION_6D, 6, frame="camera"),
            LIGHT: Field(LIGHT, 3, per_object=False, frame="camera", lower=(-sun,) * 3, upper=(sun,) * 3),
        }
        return tuple(exported.get(field.name, field) for field in self.layout.fields)

    def exported(self, code: SceneCode) -> dict[str, Tensor]:
        """The physical outputs of an exported model, in the camera frame, see :meth:`World.exported`."""
        turn, shift = self._cam_from_world(code[TRANSLATION])
        outputs = {field.name: code[field.name] for field in self.layout.fields if field.name != YAW}
        outputs[TRANSLATION] = code[TRANSLATION] @ turn.T + shift
        outputs["rotation"] = turn @ self.own_rotation(code)
        outputs[ROTATION_6D] = rotation_6d_from_matrix(outputs["rotation"])
        if LIGHT in self.layout:
            outputs[LIGHT] = self.light(code) @ turn.T
        if CONFIDENCE in self.layout:
            outputs[CONFIDENCE] = code[CONFIDENCE].squeeze(-1)
        return outputs

    def from_exported(self, outputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The scene code that :meth:`exported` made these outputs of; yaws come out with length 1."""
        turn, shift = self._cam_from_world(outputs[TRANSLATION])
        code = {TRANSLATION: (outputs[TRANSLATION] - shift) @ turn}
        code |= self._rotation_entry(turn.T @ outputs["rotation"])
        if LIGHT in self.layout:
            sun = outputs[LIGHT] @ turn
            code[LIGHT] = torch.stack([sun[:, 0] / sun[:, 1], sun[:, 2] / sun[:, 1]], dim=-1)
        if CONFIDENCE in self.layout:
            code[CONFIDENCE] = outputs[CONFIDENCE].unsqueeze(-1)
        return {name: code[name] if name in code else outputs[name] for name in (f.name for f in self.layout.fields)}

    def _rotation_entry(self, own: Tensor) -> dict[str, Tensor]:
        """The entry of the scene code for rotations world_from_obj."""
        return {YAW: torch.stack([own[..., 0, 0], own[..., 0, 2]], dim=-1)}

    def _cam_from_world(self, like: Tensor) -> tuple[Tensor, Tensor]:
        turn, shift = self.stage.cam_from_world
        return torch.as_tensor(turn).to(like), torch.as_tensor(shift).to(like)
