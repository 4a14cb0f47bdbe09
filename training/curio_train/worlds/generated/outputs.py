"""From scene codes in the world frame to outputs of exported models, which are in the camera frame, and back."""

import dataclasses
import itertools
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from curio_train.geometry import rotation_6d_from_matrix
from curio_train.scene_code import CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION, YAW, Field, Layout, SceneCode
from curio_train.worlds.base import CameraFrameOutputs
from curio_train.worlds.generated.orientation import Orientation
from curio_train.worlds.generated.scene_setup import SceneSetup


class WorldFrameOutputs(CameraFrameOutputs):
    """The outputs of worlds on the ground: their scene codes are in the world frame."""

    def __init__(self, layout: Layout, setup: SceneSetup, orientation: Orientation) -> None:
        super().__init__(layout)
        self._setup, self._orientation = setup, orientation

    @property
    def fields(self) -> tuple[Field, ...]:
        """Output fields: in the camera frame, with 6D rotations in place of yaws, and the light as a vector."""
        sun = float(np.linalg.norm(self._setup.sun))
        position = self._layout[TRANSLATION]
        corners = self._setup.cam_from_world.apply(
            np.array(list(itertools.product(*zip(position.lower, position.upper, strict=True))))
        )
        low, high = tuple(corners.min(axis=0).tolist()), tuple(corners.max(axis=0).tolist())
        exported = {
            TRANSLATION: dataclasses.replace(position, frame="camera", lower=low, upper=high),
            YAW: Field(ROTATION_6D, 6, frame="camera"),
            LIGHT: Field(LIGHT, 3, per_object=False, frame="camera", lower=(-sun,) * 3, upper=(sun,) * 3),
        }
        return tuple(exported.get(field.name, field) for field in self._layout.fields)

    def from_code(self, code: SceneCode) -> dict[str, Tensor]:
        """The outputs for scene codes, see :meth:`CameraFrameOutputs.from_code`."""
        cam_from_world = self._setup.cam_from_world.to(code[TRANSLATION])
        outputs = {field.name: code[field.name] for field in self._layout.fields if field.name != YAW}
        outputs[TRANSLATION] = cam_from_world.apply(code[TRANSLATION])
        outputs["rotation"] = cam_from_world.rotation @ self._orientation.rotation(code)
        outputs[ROTATION_6D] = rotation_6d_from_matrix(outputs["rotation"])
        if LIGHT in self._layout:
            outputs[LIGHT] = self._setup.light(code) @ cam_from_world.rotation.T
        if CONFIDENCE in self._layout:
            outputs[CONFIDENCE] = code[CONFIDENCE].squeeze(-1)
        return outputs

    def to_code(self, outputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The scene codes that :meth:`from_code` made these outputs of; yaws have length 1."""
        rotation, translation_m = self._setup.cam_from_world.to(outputs[TRANSLATION])
        code = {TRANSLATION: (outputs[TRANSLATION] - translation_m) @ rotation}
        code |= self._orientation.entries(rotation.T @ outputs["rotation"])
        if LIGHT in self._layout:
            sun = outputs[LIGHT] @ rotation
            code[LIGHT] = torch.stack([sun[:, 0] / sun[:, 1], sun[:, 2] / sun[:, 1]], dim=-1)
        if CONFIDENCE in self._layout:
            code[CONFIDENCE] = outputs[CONFIDENCE].unsqueeze(-1)
        every = {**outputs, **code}
        return {field.name: every[field.name] for field in self._layout.fields}
