"""Outputs of models of parts on a plane: poses of the frames in which the mesh files are written."""

from collections.abc import Mapping
from dataclasses import replace

from torch import Tensor

from curio_train.geometry import Pose, rotation_6d_from_matrix
from curio_train.scene_code import ROTATION_6D, TRANSLATION, Field, Layout, SceneCode
from curio_train.worlds.generated.fields import ROTATION_FIELD
from curio_train.worlds.generated.orientation import Orientation
from curio_train.worlds.generated.outputs import WorldFrameOutputs
from curio_train.worlds.generated.scene_setup import SceneSetup


class FileFrameOutputs(WorldFrameOutputs):
    """Outputs of worlds on the ground whose scene codes use other object frames than the mesh files."""

    def __init__(
        self, layout: Layout, setup: SceneSetup, orientation: Orientation, own_from_file: Pose[Tensor]
    ) -> None:
        """Hold the frames.

        Args:
            layout: Of the scene code.
            setup: Camera and light.
            orientation: How scene codes describe rotations.
            own_from_file: From each slot's mesh file to the frame of scene codes, [slots, …].
        """
        super().__init__(layout, setup, orientation)
        self._own_from_file = own_from_file

    @property
    def fields(self) -> tuple[Field, ...]:
        """Output fields: with a 6D rotation, even if the scene code of round parts has none."""
        position, *others = super().fields
        rotation = replace(ROTATION_FIELD, frame="camera")
        return (position, rotation, *(field for field in others if field.name != ROTATION_6D))

    def from_code(self, code: SceneCode) -> dict[str, Tensor]:
        """The outputs for scene codes, in the camera frame."""
        outputs = super().from_code(code)
        cam_from_own = Pose(outputs["rotation"], outputs[TRANSLATION])
        cam_from_file = cam_from_own @ self._own_from_file.to(code[TRANSLATION])
        outputs[TRANSLATION], outputs["rotation"] = cam_from_file.translation_m, cam_from_file.rotation
        outputs[ROTATION_6D] = rotation_6d_from_matrix(cam_from_file.rotation)
        return outputs

    def to_code(self, outputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The scene codes that :meth:`from_code` made these outputs of."""
        own_from_file = self._own_from_file.to(outputs[TRANSLATION])
        rotation = outputs["rotation"] @ own_from_file.rotation.transpose(-1, -2)
        position = outputs[TRANSLATION] - (rotation @ own_from_file.translation_m[..., None])[..., 0]
        return super().to_code({**outputs, "rotation": rotation, TRANSLATION: position})
