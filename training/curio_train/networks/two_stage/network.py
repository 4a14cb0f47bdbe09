"""The two-stage detector as one network: positions from the whole frame, then pose and light from crops around them."""

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from curio_serve.models.stages import crop_stage, outline_stage
from curio_serve.models.stages.crop_stage import CropStageNote
from curio_serve.models.stages.outline_stage import OutlineStageNote
from jaxtyping import Float
from torch import Tensor, nn

from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix
from curio_train.networks.base import StageNetwork
from curio_train.networks.crop_camera import cut_crops
from curio_train.networks.grid import per_cell
from curio_train.networks.outline_alignment import OutlineAlignment
from curio_train.networks.two_stage.crop_pose import CELL_WEIGHTS, OBJECT_COORDINATES
from curio_train.networks.two_stage.localise import TOP_LOG_WEIGHTS, TOP_PROPOSALS
from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION

_VISIBILITY = "visibility"
_CROP_STAGE, _OUTLINE_STAGE = "crop_stage.", "outline_stage."  # beginnings of the names of tensors in a graph
_NUM_CLEAREST = 16  # of 256 patches
SCALES, _MIDDLE = (1 / 1.18, 1.0, 1.18), 1
"""The crops of the refinement pass assume the object at these multiples of its estimated distance."""

_UNCALIBRATED = 20.0  # presence logit: the confidence is the crop-pose stage's own until it is calibrated


@dataclass(frozen=True, eq=False)
class Optics:
    """Cameras of frame and crops, and the size of the object in a crop."""

    matrix: np.ndarray
    """K of the frames, [3, 3]."""
    diameter_m: float
    """Diameter of the object."""
    near_m: float
    """Proposals nearer than this are taken to be at this distance."""
    localisation_stride: int
    """Frame pixels per pixel of the localisation stage, each way."""
    crop_px: int
    """Side of the crop."""
    fill: float
    """Fraction of the crop's side that the diameter spans at the assumed depth."""


class CalibrationFeatures(NamedTuple):
    """Inputs of the calibrated confidence: P(object present) · P(pose correct | object present)."""

    pose_correct: Float[Tensor, "batch 1"]
    """Logit of the crop-pose stage's own confidence."""
    presence: Float[Tensor, "batch 2"]
    """Mean visibility logit in the refinement pass, and log weight of the proposal."""


class _Estimate(NamedTuple):
    """A code and what it was made of."""

    code: dict[str, Tensor]
    """Scene code with the crop-pose stage's own confidence."""
    features: CalibrationFeatures
    crops: Tensor
    """Crops of the refinement pass."""
    read: dict[str, Tensor]
    """What the crop-pose stage gives for them."""
    outline: dict[str, Tensor]
    """Tensors of the alignment by their names in a graph; none where there is no alignment."""


class TwoStageNetwork(nn.Module):
    """Whole frame to scene code, all in one graph.

    The crop-pose stage runs on a crop around each top proposal. The proposal with the highest sum of log weight and
    visibility then goes through a refinement pass: crops at three assumed distances around the estimated position.
    Their errors are nearly independent, so the final position is their mean. The pose may then be aligned with the
    object's outline.
    """

    DRAWN: Final = ("outline.",)
    """Beginnings of the names of what is drawn instead of trained."""
    LAST: Final = ("second.cells.2.",)
    """Beginnings of the names of the layer whose size depends on what is read of an object, such as its colour."""
    first: StageNetwork
    """The localisation stage, on frames at low resolution."""
    second: StageNetwork
    """The crop-pose stage."""
    outline: OutlineAlignment | None
    """Aligns poses with outlines in the end; None: they stay as they are read."""
    rightness: Tensor
    """[2], weight and offset from the feature ``pose_correct`` to a calibrated logit; set after training."""
    presence: Tensor
    """[3], weights and offset from the features ``presence`` to a calibrated logit; set after training."""

    def __init__(
        self, first: StageNetwork, second: StageNetwork, optics: Optics, outline: OutlineAlignment | None = None
    ) -> None:
        super().__init__()
        self.first, self.second, self.outline = first, second, outline
        self._optics = optics
        self._matrix: Tensor
        self.register_buffer("rightness", torch.tensor([1.0, 0.0]))
        self.register_buffer("presence", torch.tensor([0.0, 0.0, _UNCALIBRATED]))
        self.register_buffer("_matrix", torch.from_numpy(optics.matrix).float()[None], persistent=False)

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> dict[str, Tensor]:
        """Codes in the frame's camera: metres, 6D rotation and confidence [batch, 1, …], light [batch, 3]."""
        return self._calibrated(self._estimate(images))

    def with_stages(self, images: Float[Tensor, "batch 3 height width"]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """The codes, and the tensors, by their names in a graph, at which its last stages can be cut out of it."""
        found = self._estimate(images)
        return self._calibrated(found), _crop_stage_tensors(found.crops, found.read) | found.outline

    def stage_notes(self) -> dict[str, CropStageNote | OutlineStageNote]:
        """Notes that serving needs to run the last stages alone, refinement and alignment, by the metadata's key."""
        optics = self._optics
        tensors = {name: _CROP_STAGE + name for name in (crop_stage.INPUT, *crop_stage.OUTPUTS)}
        notes: dict[str, CropStageNote | OutlineStageNote] = {
            crop_stage.CROP_STAGE_KEY: CropStageNote(
                tensors,
                optics.crop_px,
                optics.fill,
                optics.diameter_m,
                optics.near_m,
                self.rightness.tolist(),
                self.presence.tolist(),
            )
        }
        if self.outline is not None:
            tensors = {name: _OUTLINE_STAGE + name for name in (*outline_stage.INPUTS, *outline_stage.OUTPUTS)}
            notes[outline_stage.OUTLINE_STAGE_KEY] = self.outline.note(tensors, optics.diameter_m)
        return notes

    def _calibrated(self, found: _Estimate) -> dict[str, Tensor]:
        pose_correct = _probability(found.features.pose_correct, self.rightness)
        confidence = pose_correct * _probability(found.features.presence, self.presence)
        return found.code | {CONFIDENCE: confidence[:, None, None]}

    def uncalibrated(
        self, images: Float[Tensor, "batch 3 height width"]
    ) -> tuple[dict[str, Tensor], CalibrationFeatures]:
        """The code with the crop-pose stage's own confidence, and the features to calibrate it with."""
        found = self._estimate(images)
        return found.code, found.features

    def _estimate(self, images: Tensor) -> _Estimate:
        located = self.first(F.avg_pool2d(images, self._optics.localisation_stride))
        crops, _ = self._crop_poses(images, located[TOP_PROPOSALS])
        position, log_weight = _likeliest(crops[TRANSLATION], crops[_VISIBILITY], located[TOP_LOG_WEIGHTS])
        refined, read = self._crop_poses(images, position * position.new_tensor(SCALES)[:, None])
        logit, visibility = torch.logit(refined[CONFIDENCE].flatten(), 1e-6), refined.pop(_VISIBILITY)
        logit, visibility = (values.view(-1, len(SCALES)).mean(dim=1, keepdim=True) for values in (logit, visibility))
        features = CalibrationFeatures(logit, torch.cat([visibility, log_weight], dim=1))
        code, outline = self._aligned(images, _mean_position(refined))
        return _Estimate(code, features, *read, outline)

    def _aligned(self, images: Tensor, code: dict[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """The code with its pose aligned with the object's outline in the images, and that stage's tensors."""
        if self.outline is None:
            return code, {}
        aligned, tensors = self.outline.of_code(images, self._matrix[0], code, self._optics.diameter_m)
        return aligned, {_OUTLINE_STAGE + name: tensor for name, tensor in tensors.items()}

    def _crop_poses(
        self, images: Tensor, centres: Float[Tensor, "batch num 3"]
    ) -> tuple[dict[str, Tensor], tuple[Tensor, dict[str, Tensor]]]:
        """Crop around positions, predict poses there, and rotate them back into the frame's camera.

        Returns:
            Codes of all crops [batch · num, …], those of one image after the other, and the visibility in each; and
            the crops with what the crop-pose stage gives for them.
        """
        optics, centre = self._optics, centres.flatten(0, 1)
        depth = centre.norm(dim=1, keepdim=True).clamp(min=optics.near_m)  # along the crop camera's axis
        focal_px = optics.fill * optics.crop_px * depth[:, 0] / optics.diameter_m
        crops, crop_from_cam = cut_crops(images, self._matrix[0], centres, focal_px, optics.crop_px)
        code = self.second(crops)
        relative = code[TRANSLATION][:, 0]
        position = torch.cat([relative[:, :2] * optics.diameter_m, relative[:, 2:] * depth], dim=-1)
        cam_from_crop = crop_from_cam.transpose(1, 2)
        rotation = cam_from_crop @ matrix_from_rotation_6d(code[ROTATION_6D][:, 0])
        poses = {name: code[name] for name in (COLOR,) if name in code} | {
            _VISIBILITY: _visibility(code[OBJECT_COORDINATES]),
            TRANSLATION: (cam_from_crop @ position[..., None])[:, None, :, 0],
            ROTATION_6D: rotation_6d_from_matrix(rotation)[:, None],
            CONFIDENCE: code[CONFIDENCE],
            LIGHT: (cam_from_crop @ code[LIGHT][..., None])[..., 0],
        }
        return poses, (crops, code)


def _crop_stage_tensors(crops: Tensor, read: dict[str, Tensor]) -> dict[str, Tensor]:
    """Crops of the refinement pass and what is read from them, by their names in a graph."""
    values = {
        crop_stage.INPUT: crops,
        "translation": read[TRANSLATION][:, 0],
        "rotation_6d": read[ROTATION_6D][:, 0],
        "confidence": read[CONFIDENCE][:, 0],
        "light": read[LIGHT],
        "visibility": read[OBJECT_COORDINATES][:, 3],
        "cell_translation": read[per_cell(TRANSLATION)],
        "cell_rotation_6d": read[per_cell(ROTATION_6D)],
        "weights": read[CELL_WEIGHTS],
    }
    return {_CROP_STAGE + name: value for name, value in values.items()}


def _mean_position(crops: dict[str, Tensor]) -> dict[str, Tensor]:
    """The code of each image's middle crop in the refinement pass, with the mean position of all of them.

    The rotation is not averaged: an object's symmetric poses have no mean.
    """
    by_image = {name: value.unflatten(0, (-1, len(SCALES))) for name, value in crops.items()}
    code = {name: value[:, _MIDDLE] for name, value in by_image.items()}
    position = by_image[TRANSLATION]  # [batch, crops, 1, 3]
    depth = position[..., 2:].log().mean(dim=1).exp()
    slope = (position[..., :2] / position[..., 2:]).mean(dim=1)
    return code | {TRANSLATION: torch.cat([slope * depth, depth], dim=-1)}


def _likeliest(
    positions: Float[Tensor, "rows 1 3"], visibility: Float[Tensor, " rows"], log_weights: Float[Tensor, "batch num"]
) -> tuple[Float[Tensor, "batch 1 3"], Float[Tensor, "batch 1"]]:
    """Each image's position with the highest sum of visibility and log weight, and that weight."""
    best = (visibility.view_as(log_weights) + log_weights).argmax(dim=1)
    first = torch.arange(best.shape[0], device=best.device) * log_weights.shape[1]
    return positions[first + best], log_weights.gather(1, best[:, None])


def _probability(features: Float[Tensor, "batch num"], weights: Float[Tensor, " values"]) -> Float[Tensor, " batch"]:
    """Logistic regression; the offset is the last weight."""
    return torch.sigmoid(features @ weights[:-1] + weights[-1])


def _visibility(coordinates: Float[Tensor, "rows 4 side side"]) -> Float[Tensor, " rows"]:
    """Visibility of the object in a crop: mean logit of the patches where it is highest.

    The confidence that the pose is correct cannot say this: it is as low for poses that are hard to estimate as for
    crops without the object.
    """
    return coordinates[:, 3].flatten(1).topk(_NUM_CLEAREST, dim=1).values.mean(dim=1)
