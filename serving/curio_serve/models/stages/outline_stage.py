"""The alignment of a pose with the object's outline alone: corrects what was read from crops, as a whole frame's is.

A model of one's own part ends with that alignment. Where an object is followed, or seen by several cameras, its pose is
read by the crop-pose stage alone, so the alignment is cut out of the graph as well. The exporter notes in the metadata
at which tensors; models without that note answer what the crop-pose stage reads.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.crop import cut_crop
from curio_serve.imaging.rotation import smallest_rotation
from curio_serve.models.stages.crop_stage import CropPose
from curio_serve.models.stages.graph_part import GraphPart, parse_note

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
    """Side of a crop."""
    fill: float
    """Fraction of the side that the diameter spans."""
    diameter_m: float
    """Diameter of the object."""

    @staticmethod
    def parse(text: str, where: str) -> "OutlineStageNote":
        """The note in a model's metadata.

        Raises:
            ModelError: It is not one.
        """
        return parse_note(OutlineStageNote, text, OutlineStageNote._is_valid, f"{where}: {OUTLINE_STAGE_KEY}")

    def _is_valid(self) -> bool:
        numbers = self.side_px, self.fill, self.diameter_m
        return (
            all(map(math.isfinite, numbers))
            and min(numbers) > 0
            and self.side_px <= 1024
            and set(self.tensors) == {*INPUTS, *OUTPUTS}
        )


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
        self.note = note
        self._part = GraphPart(data, note.tensors, INPUTS, OUTPUTS, f"{where}: {OUTLINE_STAGE_KEY}", providers)

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
        named = zip(INPUTS, given, strict=True)
        found = self._part.run({name: np.asarray(value, np.float32)[None] for name, value in named})
        rotation, position = (found[name][0].astype(float) for name in OUTPUTS)
        return replace(
            pose,
            translation_m=crop_from_cam.T @ position * note.diameter_m,
            rotation=crop_from_cam.T @ rotation,
        )
