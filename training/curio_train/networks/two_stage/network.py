"""Two looks as one network: a place from the whole frame, then pose and light from a crop around it."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from curio_train.camera import crop_camera_at, sampling_grid
from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix
from curio_train.networks.base import StageNetwork
from curio_train.networks.two_stage.crop_pose import OBJECT_COORDINATES
from curio_train.networks.two_stage.localise import CANDIDATE_LOG_WEIGHTS, CANDIDATES
from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION

_EVIDENCE = "evidence"
_NUM_CLEAREST = 16  # of 256 patches
SCALES, _MIDDLE = (1 / 1.18, 1.0, 1.18), 1
"""Of the distance that the last crops are placed by."""

_SURELY = 20.0  # logit: as long as nothing is calibrated, the confidence is the second look's

OVERSAMPLING = 2  # a crop is sampled at so many points a pixel and side, then averaged: no aliasing of near objects


@dataclass(frozen=True, eq=False)
class Optics:
    """How a frame becomes a crop.

    Attributes:
        matrix: K of the frames, [3, 3].
        diameter_m: Of the object.
        near_m: Nearest distance that a place is taken for.
        first_look_share: Frame pixels a pixel of the first look, each way.
        crop_px: Side of the crop.
        fill: Share of it that the diameter spans at the assumed depth.
    """

    matrix: np.ndarray
    diameter_m: float
    near_m: float
    localisation_stride: int
    crop_px: int
    fill: float


class CalibrationFeatures(NamedTuple):
    """What the confidence is made of: the probability that the object is there, times that of reading it rightly then.

    Attributes:
        right: [batch, 1], logit of the second look's confidence.
        there: [batch, 2], how clearly the last glances show the object, and the logarithm of the first look's weight.
    """

    right: Float[Tensor, "batch 1"]
    there: Float[Tensor, "batch 2"]


class TwoStageNetwork(nn.Module):
    """Whole frame to scene code, all in one graph.

    A glance at each of the likeliest places. Where the first look's weight and what the second look sees of the object
    together say that it is, the second looks once more, at crops placed by its own answer as if that were a little
    nearer or farther, too: each errs in its own way, so the position is their mean.

    Attributes:
        first: Reads places from frames at low resolution.
        second: Reads poses and light from crops.
        rightness: Weight and offset that make the sign of a right pose a logit; set when training is done.
        presence: Weights and offset that do so with the signs that the object is there.
    """

    def __init__(self, first: StageNetwork, second: StageNetwork, optics: Optics) -> None:
        super().__init__()
        self.first, self.second = first, second
        self._optics = optics
        self._matrix: Tensor
        self.rightness: Tensor
        self.presence: Tensor
        self.register_buffer("rightness", torch.tensor([1.0, 0.0]))
        self.register_buffer("presence", torch.tensor([0.0, 0.0, _SURELY]))
        self.register_buffer("_matrix", torch.from_numpy(optics.matrix).float()[None], persistent=False)

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> dict[str, Tensor]:
        """Codes in the frame's camera: metres, 6D rotation and confidence [batch, 1, …], light [batch, 3]."""
        code, signs = self.read(images)
        sure = _probability(signs.right, self.rightness) * _probability(signs.there, self.presence)
        return code | {CONFIDENCE: sure[:, None, None]}

    def read(self, images: Float[Tensor, "batch 3 height width"]) -> tuple[dict[str, Tensor], CalibrationFeatures]:
        """The code without its confidence's calibration, and what that is made of."""
        seen = self.first(F.avg_pool2d(images, self._optics.localisation_stride))
        glances = self._glance(images, seen[CANDIDATES])
        likeliest, log_weight = _likeliest(glances[TRANSLATION], glances[_EVIDENCE], seen[CANDIDATE_LOG_WEIGHTS])
        last = self._glance(images, likeliest * likeliest.new_tensor(SCALES)[:, None])
        logit, evidence = torch.logit(last[CONFIDENCE].flatten(), 1e-6), last.pop(_EVIDENCE)
        logit, evidence = (of_all.view(-1, len(SCALES)).mean(dim=1, keepdim=True) for of_all in (logit, evidence))
        return _position_of_all(last), CalibrationFeatures(logit, torch.cat([evidence, log_weight], dim=1))

    def _glance(self, images: Tensor, places: Float[Tensor, "batch num 3"]) -> dict[str, Tensor]:
        """Look at crops around places, and turn what is read there back into the frame's camera.

        Returns:
            Codes of all crops, those of one image after the other, and the evidence that each shows the object.
        """
        optics, place = self._optics, places.flatten(0, 1)
        depth = place.norm(dim=1, keepdim=True).clamp(min=optics.near_m)  # along the crop camera's axis
        matrix = self._matrix.expand(place.shape[0], 3, 3)
        side = OVERSAMPLING * optics.crop_px
        gaze = crop_camera_at(place, optics.fill * side * depth[:, 0] / optics.diameter_m, side, matrix)
        grid = sampling_grid(gaze, matrix, side, images.shape[3], images.shape[2])
        # The crops of an image in one tall grid: no frame is copied.
        tall = grid.view(-1, places.shape[1] * side, side, 2)
        fine = F.grid_sample(images, tall, padding_mode="border", align_corners=False)
        crops = fine.unflatten(2, (places.shape[1], side)).transpose(1, 2).flatten(0, 1)
        code = self.second(F.avg_pool2d(crops, OVERSAMPLING))
        relative = code[TRANSLATION][:, 0]
        seen = torch.cat([relative[:, :2] * optics.diameter_m, relative[:, 2:] * depth], dim=-1)
        back = gaze.rotation.transpose(1, 2)
        rotation = back @ matrix_from_rotation_6d(code[ROTATION_6D][:, 0])
        return {name: code[name] for name in (COLOR,) if name in code} | {
            _EVIDENCE: _evidence(code[OBJECT_COORDINATES]),
            TRANSLATION: (back @ seen[..., None])[:, None, :, 0],
            ROTATION_6D: rotation_6d_from_matrix(rotation)[:, None],
            CONFIDENCE: code[CONFIDENCE],
            LIGHT: (back @ code[LIGHT][..., None])[..., 0],
        }


def _position_of_all(glances: dict[str, Tensor]) -> dict[str, Tensor]:
    """Of the last glances at each image the middle one, at the mean of all positions.

    The rotation stays as one of them reads it: an object's symmetric poses have no mean.
    """
    by_image = {name: value.unflatten(0, (-1, len(SCALES))) for name, value in glances.items()}
    code = {name: value[:, _MIDDLE] for name, value in by_image.items()}
    position = by_image[TRANSLATION]  # [batch, glances, 1, 3]
    depth = position[..., 2:].log().mean(dim=1).exp()
    slope = (position[..., :2] / position[..., 2:]).mean(dim=1)
    return code | {TRANSLATION: torch.cat([slope * depth, depth], dim=-1)}


def _likeliest(
    places: Float[Tensor, "rows 1 3"], evidence: Float[Tensor, " rows"], log_weights: Float[Tensor, "batch num"]
) -> tuple[Float[Tensor, "batch 1 3"], Float[Tensor, "batch 1"]]:
    """Of the places of each image the one with the highest sum of evidence and log weight, and that weight."""
    best = (evidence.view_as(log_weights) + log_weights).argmax(dim=1)
    first = torch.arange(best.shape[0], device=best.device) * log_weights.shape[1]
    return places[first + best], log_weights.gather(1, best[:, None])


def _probability(signs: Float[Tensor, "batch signs"], weights: Float[Tensor, " values"]) -> Float[Tensor, " batch"]:
    """Of the weighed sum as a logit; the offset is last."""
    return torch.sigmoid(signs @ weights[:-1] + weights[-1])


def _evidence(surface: Float[Tensor, "rows 4 side side"]) -> Float[Tensor, " rows"]:
    """How surely the object is seen in a crop: mean logit of the patches that show it most clearly.

    Not the confidence that the pose is right, which is as low where a pose is hard to read as where there is nothing.
    """
    return surface[:, 3].flatten(1).topk(_NUM_CLEAREST, dim=1).values.mean(dim=1)
