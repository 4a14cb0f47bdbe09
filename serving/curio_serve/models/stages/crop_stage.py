"""The crop-pose stage of a two-stage model alone: reads a pose from a crop around where the object is expected.

A two-stage model localises its object in the whole frame and then reads the pose from crops. Where the place is known,
as in a stream, the crops alone cost a seventh. The exporter notes in the metadata which tensors of the graph are the
crops and what is read from them; here the graph is cut at these tensors, so that a model stays one file. Models without
that note have no such stage and read whole frames alone.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.crop import cut_crop
from curio_serve.imaging.rotation import smallest_rotation
from curio_serve.models.stages.graph_part import GraphPart, parse_note

Array = np.ndarray
CROP_STAGE_KEY = "curio.crop_stage"
INPUT = "crops"
OUTPUTS = (
    *("translation", "rotation_6d", "confidence", "light", "visibility"),
    *("cell_translation", "cell_rotation_6d", "weights"),
)
"""Tensors that the stage reads from crops: pose, its logit and light in each crop's camera, visibility logits of the
object [n, 16, 16], and each cell's own pose and weight. Positions are (x, y) in diameters and z in expected depths."""
_NUM_CLEAREST = 16  # patches whose mean logit says whether the object is visible
_FAR_BEHIND = 0.05  # cosine to the optical axis below which nothing is cut out
_SCALES = (1 / 1.09, 1.09)  # of the expected distance: the errors of two crops are nearly independent
_SAME_ROTATION_RAD = math.radians(30)  # crops that differ by more have read symmetric poses
_FOUND_LOG_WEIGHT = 0.0  # log weight of the proposal of an object that is followed: there was one


@dataclass(frozen=True)
class CropStageNote:
    """What the exporter notes about the stage, as JSON under ``curio.crop_stage``."""

    tensors: Mapping[str, str]
    """Names in the graph of :data:`INPUT` and :data:`OUTPUTS`."""
    side_px: int
    """Side of a crop."""
    fill: float
    """Fraction of the side that the diameter spans at the expected depth."""
    diameter_m: float
    """Diameter of the object."""
    near_m: float
    """Objects nearer than this are taken to be at this distance."""
    pose_correct: Sequence[float]
    """Weight and offset from the logit of the stage's confidence to the probability of a correct pose."""
    presence: Sequence[float]
    """Weights of visibility and log weight, and offset, to the probability that the object is there."""

    @staticmethod
    def parse(text: str, where: str) -> "CropStageNote":
        """The note in a model's metadata.

        Raises:
            ModelError: It is not one.
        """
        return parse_note(CropStageNote, text, CropStageNote._is_valid, f"{where}: {CROP_STAGE_KEY}")

    def _is_valid(self) -> bool:
        numbers = (self.side_px, self.fill, self.diameter_m, self.near_m, *self.pose_correct, *self.presence)
        return (
            all(map(math.isfinite, numbers))
            and min(numbers[:4]) > 0
            and self.side_px <= 1024
            and (len(self.pose_correct), len(self.presence)) == (2, 3)
            and set(self.tensors) == {INPUT, *OUTPUTS}
        )


@dataclass(frozen=True, eq=False)
class CropPose:
    """A pose read around an expected position, in the frame's camera."""

    translation_m: Array
    """Position of the object's middle, [3]."""
    rotation: Array
    """cam_from_obj [3, 3]."""
    confidence: float
    """Probability that the object is there and the pose correct."""
    position_covariance_m2: Array
    """Spread of the network's own cells and crops [3, 3]."""
    rotation_variance: float
    """Variance of the rotation about each axis, rad²."""
    light: Array
    """[3], towards the light; its length is the strength."""


class CropStage:
    """Cuts crops out of frames and reads poses from them; safe to share between threads."""

    def __init__(self, data: bytes, note: CropStageNote, where: str, providers: Sequence[str]) -> None:
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
        self._part = GraphPart(data, note.tensors, (INPUT,), OUTPUTS, f"{where}: {CROP_STAGE_KEY}", providers)

    def read(self, pixels: Array, camera: PinholeCamera, position_m: Array, canonical_focal_px: float) -> CropPose:
        """The pose of the object in crops around a position.

        Args:
            pixels: uint8 RGB [height, width, 3].
            camera: That took them.
            position_m: Where the object's middle is expected, frame's camera, in front of it.
            canonical_focal_px: Of the camera that the model was trained for: larger frames are averaged down to it.

        Raises:
            InternalError: The network failed, or gives what is not finite.
        """
        note = self.note
        distance_m = max(float(np.linalg.norm(position_m)), note.near_m)
        crop_from_cam = smallest_rotation(position_m / np.linalg.norm(position_m), np.array([0.0, 0.0, 1.0]))
        depths_m = [scale * distance_m for scale in _SCALES]
        crops = [
            cut_crop(
                pixels,
                camera,
                crop_from_cam,
                note.fill * note.side_px * depth_m / note.diameter_m,
                note.side_px,
                canonical_focal_px,
            )
            for depth_m in depths_m
        ]
        images = np.ascontiguousarray(np.stack(crops).transpose(0, 3, 1, 2), np.float32) / 255
        return self._pose(self._part.run({INPUT: images}), depths_m, crop_from_cam.T)

    def sees(self, camera: PinholeCamera, position_m: Array, width: int, height: int) -> bool:
        """Whether a position is in front of the camera and its pixel within the frame."""
        if position_m[2] <= _FAR_BEHIND * float(np.linalg.norm(position_m)):
            return False
        x, y = camera.pixels([position_m.tolist()])
        return -0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5

    def _pose(self, found: Mapping[str, Array], depths_m: Sequence[float], cam_from_crop: Array) -> CropPose:
        """The mean position of the crops, the rotation of the surest, and how far cells and crops disagree."""
        num = len(depths_m)
        units = np.array([[self.note.diameter_m, self.note.diameter_m, depth_m] for depth_m in depths_m])
        positions = found["translation"].reshape(num, 3) * units
        confidence = found["confidence"].reshape(num).clip(1e-6, 1 - 1e-6)
        logit = float(np.log(confidence / (1 - confidence)).mean())
        depth_m = math.exp(float(np.log(positions[:, 2].clip(1e-6)).mean()))
        mean = (positions / positions[:, 2:]).mean(axis=0) * depth_m
        rotations = rotations_from_6d(found["rotation_6d"].reshape(num, 6))
        rotation, between = _mean_rotation(rotations, int(confidence.argmax()))
        weights = found["weights"].reshape(num, -1, 1)
        cells = found["cell_translation"].reshape(num, -1, 3) * units[:, None]
        offsets = (np.sqrt(weights) * (cells - positions[:, None])).reshape(-1, 3)
        apart = positions - mean
        spread = (offsets.T @ offsets + apart.T @ apart) / num
        turned = found["cell_rotation_6d"].reshape(num, -1, 6) - found["rotation_6d"].reshape(num, 1, 6)
        # The squared length of the change of two columns is four times the variance about an axis.
        variance = float((weights * turned**2).sum()) / num / 4 + between**2 / 4
        return CropPose(
            cam_from_crop @ mean,
            cam_from_crop @ rotation,
            self._confidence(logit, _visibility(found["visibility"], num)),
            cam_from_crop @ spread @ cam_from_crop.T,
            variance,
            cam_from_crop @ found["light"].reshape(num, 3).mean(axis=0),
        )

    def _confidence(self, logit: float, visibility: float) -> float:
        note = self.note
        correct = _sigmoid(note.pose_correct[0] * logit + note.pose_correct[1])
        seen = note.presence[0] * visibility + note.presence[1] * _FOUND_LOG_WEIGHT + note.presence[2]
        return correct * _sigmoid(seen)


def rotations_from_6d(values: Array) -> Array:
    """Rotations [n, 3, 3] of 6D vectors [n, 6]: the first two columns, made orthonormal (Zhou et al. 2019)."""
    first, second = values[:, :3].astype(float), values[:, 3:].astype(float)
    first = first / np.linalg.norm(first, axis=1, keepdims=True).clip(1e-9)
    second = second - (first * second).sum(axis=1, keepdims=True) * first
    second = second / np.linalg.norm(second, axis=1, keepdims=True).clip(1e-9)
    return np.stack([first, second, np.cross(first, second)], axis=2)


def _mean_rotation(rotations: Array, surest: int) -> tuple[Array, float]:
    """Mean of the crops' rotations, and the angle between them; the surest alone where they are symmetric poses."""
    cosine = (float((rotations[0] * rotations[-1]).sum()) - 1) / 2
    angle = math.acos(min(1.0, max(-1.0, cosine)))
    if angle > _SAME_ROTATION_RAD:
        return rotations[surest], angle
    left, _, right = np.linalg.svd(rotations.mean(axis=0))
    return left @ right, angle


def _visibility(logits: Array, num: int) -> float:
    clearest = np.partition(logits.reshape(num, -1), -_NUM_CLEAREST, axis=1)[:, -_NUM_CLEAREST:]
    return float(clearest.mean())


def _sigmoid(value: float) -> float:
    return 1 / (1 + math.exp(-min(max(value, -60.0), 60.0)))
