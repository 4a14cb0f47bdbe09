"""The alignment of a pose with the object's outline alone: corrects what was read from crops, as a whole frame's is.

A model of one's own part ends with that alignment. Where an object is followed, or seen by several cameras, its pose is
read by the crop-pose stage alone, so the alignment is cut out of the graph as well. The exporter notes in the metadata
at which tensors; models without that note answer what the crop-pose stage reads.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from curio_serve.errors import InternalError, ModelError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.crop import cut_crop
from curio_serve.imaging.rotation import smallest_rotation
from curio_serve.models.runtime import open_session, runtime_errors
from curio_serve.models.stages.crop_stage import CropPose
from curio_serve.models.stages.cut_graph import cut_graph

if TYPE_CHECKING:
    import onnxruntime

Array = np.ndarray
OUTLINE_STAGE_KEY = "curio.outline_stage"
INPUTS = ("crops", "focal_px", "rotation", "position")
"""Crops [n, 3, side, side], sRGB in [0, 1]; focal lengths of their cameras [n]; rotations [n, 3, 3] and positions
[n, 3], diameters, in these cameras."""
OUTPUTS = ("aligned_rotation", "aligned_position")
"""Rotations and positions, aligned."""


@dataclass(frozen=True)
class OutlineStageNote:
    """What the exporter notes about the alignment, as JSON under ``curio.outline_stage``."""

    tensors: Mapping[str, str]
    """Names in the graph of :data:`INPUTS` and :data:`OUTPUTS`."""
    side_px: int
    """Of a crop."""
    fill: float
    """Fraction of the side that the diameter spans."""
    diameter_m: float
    """Of the object."""

    @staticmethod
    def parse(text: str, where: str) -> "OutlineStageNote":
        """The note in a model's metadata.

        Raises:
            ModelError: It is not one.
        """
        try:
            note = OutlineStageNote(**json.loads(text))
            numbers = note.side_px, note.fill, note.diameter_m
            is_valid = all(map(math.isfinite, numbers)) and min(numbers) > 0 and note.side_px <= 1024
            is_valid &= set(note.tensors) == {*INPUTS, *OUTPUTS}
        except (ValueError, TypeError) as exc:
            raise ModelError(
                f"{where}: the metadata {OUTLINE_STAGE_KEY} is not what curio-export writes: {exc}"
            ) from exc
        if not is_valid:
            raise ModelError(f"{where}: the metadata {OUTLINE_STAGE_KEY} has impossible values; export the model again")
        return note


class OutlineStage:
    """Aligns poses with the object's outline in frames; safe to share between threads."""

    def __init__(self, data: bytes, note: OutlineStageNote, where: str, providers: Sequence[str]) -> None:
        """Cut the graph; the runtime opens it when the stage is first used.

        Args:
            data: Content of the ONNX file.
            note: What it says about the stage.
            where: The file, for messages.
            providers: onnxruntime's names.

        Raises:
            ModelError: The graph has not the tensors of the note.
        """
        self.note, self._where, self._providers = note, where, tuple(providers)
        self._inputs, self._outputs = ([note.tensors[name] for name in names] for names in (INPUTS, OUTPUTS))
        self._graph = cut_graph(data, self._inputs, self._outputs, f"{where}: {OUTLINE_STAGE_KEY}")

    @cached_property
    def _session(self) -> "onnxruntime.InferenceSession":
        return open_session(self._graph, self._where, self._providers)

    def aligned(self, pixels: Array, camera: PinholeCamera, pose: CropPose, canonical_focal_px: float) -> CropPose:
        """A pose moved to where the object's outline lies on edges; as it is where it is behind the camera.

        Args:
            pixels: uint8 RGB [height, width, 3].
            camera: That took them.
            pose: As the crop-pose stage read it.
            canonical_focal_px: Of the camera that the model was trained for: larger frames are averaged down to it.

        Raises:
            InternalError: The network failed, or gives what is not finite.
        """
        note, distance_m = self.note, float(np.linalg.norm(pose.translation_m))
        if pose.translation_m[2] <= 0:
            return pose
        crop_from_cam = smallest_rotation(pose.translation_m / distance_m, np.array([0.0, 0.0, 1.0]))
        focal_px = note.fill * note.side_px * distance_m / note.diameter_m
        crop = cut_crop(pixels, camera, crop_from_cam, focal_px, note.side_px, canonical_focal_px)
        position = np.array([0.0, 0.0, distance_m / note.diameter_m])
        given = crop.transpose(2, 0, 1) / 255, focal_px, crop_from_cam @ pose.rotation, position
        rotation, position = self._run([np.asarray(value, np.float32)[None] for value in given])
        return replace(
            pose,
            translation_m=crop_from_cam.T @ position * note.diameter_m,
            rotation=crop_from_cam.T @ rotation,
        )

    def _run(self, values: Sequence[Array]) -> tuple[Array, Array]:
        """Rotation [3, 3] and position [3] for the inputs of one pose."""
        try:
            rotation, position = self._session.run(self._outputs, dict(zip(self._inputs, values, strict=True)))
        except runtime_errors() as exc:
            raise InternalError(f"{self._where}: onnxruntime failed on the outline of one crop: {exc}") from exc
        if not (np.isfinite(rotation).all() and np.isfinite(position).all()):
            raise InternalError(f"{self._where}: a pose aligned with its outline is not finite for this image")
        return rotation[0].astype(float), position[0].astype(float)
