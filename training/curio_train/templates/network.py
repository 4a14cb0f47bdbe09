"""Whole frame to pose by templates alone, in one graph: nothing in it was trained but the frozen trunk."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix, rotation_between
from curio_train.networks.crop_camera import cut_crops
from curio_train.scene_code import CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION
from curio_train.templates.alignment import Aligned, align, with_gradient
from curio_train.templates.bank import Bank
from curio_train.templates.geometry import CROP_PX, FILL, FRAME_STRIDE, Geometry
from curio_train.templates.localiser import NUM_CANDIDATES, Localiser
from curio_train.templates.trunk import COARSE_STRIDE, Trunk

NUM_HYPOTHESES = 3
NUM_NEIGHBOURS = 12
"""Templates around the best hypothesis whose answers are averaged."""

STEPS = (5, 4)
"""Of the alignment: of every hypothesis, then of the best one with its neighbours."""

LAMP = (0.0, -0.7, -0.7)
"""The light that templates are drawn under and that is answered: it is not read from images."""

_MARGIN_PX = 16  # of crops in which templates are shifted, to each side
_ALIKE_COS = 0.94  # 20 degrees between the rotations of hypotheses at one place
_ONE_PLACE = 0.5  # diameters
_SHARPNESS = 20.0  # of the neighbours' weights, a unit of score
_SUPPRESSED = -10.0


class CalibrationFeatures(NamedTuple):
    """Calibration features: the inputs of the two logits whose probabilities make up the confidence."""

    right: Float[Tensor, "batch 2"]
    """[batch, 2], ten times the final score, and how well the neighbours agree about the distance."""
    there: Float[Tensor, "batch 2"]
    """[batch, 2], ten times the final score, and the score of the place that it was found at."""


class Poses(NamedTuple):
    """Hypotheses in the frame's camera, a row each."""

    rotation: Float[Tensor, "rows 3 3"]
    """cam_from_obj."""
    position_m: Float[Tensor, "rows 3"]
    """Of the object's centre."""
    score: Float[Tensor, " rows"]
    """Of the templates."""
    place: Float[Tensor, " rows"]
    """Score of the place that it was found at."""


class TemplateNetwork(nn.Module):
    """Localise, match, align."""

    trunk: Trunk
    """Frozen features."""
    localiser: Localiser
    """Finds centre proposals in the frame."""
    bank: Bank
    """All templates."""
    geometry: Geometry
    """Of frames and object."""
    pose_correct: Tensor
    """Weights [2] and offset of the pose-correct logit; calibrated on renderings."""
    presence: Tensor
    """Weights [2] and offset of the presence logit; calibrated on renderings."""
    _matrix: Tensor
    _lamp: Tensor

    def __init__(self, geometry: Geometry, steps: tuple[int, int] = STEPS) -> None:
        """Build for frames and an object; all templates are still empty.

        Args:
            geometry: Of frames and object.
            steps: See :data:`STEPS`.
        """
        super().__init__()
        self.trunk, self.localiser, self.bank = Trunk(), Localiser(geometry), Bank()
        self.geometry, self._steps = geometry, steps
        self.register_buffer("pose_correct", torch.tensor([1.0, 0.0, 0.0]))
        self.register_buffer("presence", torch.tensor([1.0, 0.0, 0.0]))
        self.register_buffer("_matrix", torch.from_numpy(geometry.matrix).float()[None], persistent=False)
        self.register_buffer("_lamp", torch.tensor(LAMP), persistent=False)
        self.requires_grad_(False)
        self.eval()

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> dict[str, Tensor]:
        """Codes in the frame's camera: metres, 6D rotation and confidence [batch, 1, …], light [batch, 3]."""
        code, features = self.read(images)
        sure = _probability(features.right, self.pose_correct) * _probability(features.there, self.presence)
        return code | {CONFIDENCE: sure[:, None, None]}

    def read(self, images: Float[Tensor, "batch 3 height width"]) -> tuple[dict[str, Tensor], CalibrationFeatures]:
        """The code without its confidence, and what that is made of."""
        best = self._best(self._aligned(images, self._hypotheses(images)), images.shape[0])
        last, spread = self._averaged(images, best)
        features = CalibrationFeatures(
            torch.stack([10 * last.score, -100 * spread], dim=1), torch.stack([10 * last.score, last.place], dim=1)
        )
        return {
            TRANSLATION: last.position_m[:, None],
            ROTATION_6D: rotation_6d_from_matrix(last.rotation)[:, None],
            LIGHT: self._lamp.expand(images.shape[0], 3),
        }, features

    def _hypotheses(self, images: Float[Tensor, "batch 3 height width"]) -> Poses:
        """The best match, the best of those that differ from it, and so on; those of one image after the other."""
        _, features = self.trunk(F.avg_pool2d(images, FRAME_STRIDE))
        places = self.localiser(features)
        crops, back, depth, focal_px = self._crops(images, places.position_m, CROP_PX + 2 * _MARGIN_PX)
        scores = self.bank.match(self.bank.coarse(self.trunk(crops)[1]))
        scores, shift = scores.max(dim=2)  # [batch * candidates, templates]
        offset = (_shifts().to(images)[shift] / focal_px[:, None, None]).unflatten(0, (-1, NUM_CANDIDATES))
        back, depth = (of_all.unflatten(0, (-1, NUM_CANDIDATES)) for of_all in (back, depth))
        picked = self._pick(scores.unflatten(0, (-1, NUM_CANDIDATES)), places.position_m)
        rotations, positions, found, place = [], [], [], []
        row = torch.arange(images.shape[0], device=images.device)
        for candidate, template, score in picked:
            slope = offset[row, candidate, template]
            ray = torch.cat([slope, torch.ones_like(slope[:, :1])], dim=1)
            ray = ray / ray.square().sum(dim=1, keepdim=True).sqrt() * depth[row, candidate][:, None]
            position = (back[row, candidate] @ ray[..., None])[..., 0]
            axis = position.new_tensor([0.0, 0.0, 1.0]).expand_as(position)
            rotations.append(rotation_between(axis, position) @ self.bank.rotations[template])
            positions.append(position)
            found.append(score)
            place.append(places.score[row, candidate])
        return Poses(*(torch.stack(values, dim=1).flatten(0, 1) for values in (rotations, positions, found, place)))

    def _pick(
        self, scores: Float[Tensor, "batch candidates templates"], positions_m: Float[Tensor, "batch candidates 3"]
    ) -> list[tuple[Int[Tensor, " batch"], Int[Tensor, " batch"], Float[Tensor, " batch"]]]:
        """Candidate, template and score of each hypothesis; hypotheses at one place differ in rotation."""
        turns = self.bank.rotations.flatten(1)
        num, picked = len(turns), []
        apart_m = _ONE_PLACE * self.geometry.diameter_m
        for _ in range(NUM_HYPOTHESES):
            score, best = scores.flatten(1).max(dim=1)
            candidate, template = torch.div(best, num, rounding_mode="floor"), best % num
            picked.append((candidate, template, score))
            alike = (turns[template] @ turns.T - 1) / 2 > _ALIKE_COS
            chosen = positions_m[torch.arange(best.shape[0], device=best.device), candidate]
            beside = (positions_m - chosen[:, None]).square().sum(dim=-1) < apart_m**2
            scores = torch.where(beside[:, :, None] & alike[:, None], _SUPPRESSED, scores)
        return picked

    def _aligned(self, images: Tensor, poses: Poses) -> Poses:
        """Each hypothesis moved to where the template nearest to it fits best."""
        crops, back, depth, focal_px = self._crops(
            images, poses.position_m.unflatten(0, (images.shape[0], -1)), CROP_PX
        )
        maps = with_gradient(self.bank.fine(self.trunk(crops)[0]))
        start = self._in_crop(poses.rotation, back, depth)
        nearest = (start.rotation.flatten(1) @ self.bank.rotations.flatten(1).T).argmax(dim=1)
        found = align(maps, *self.bank.surface(nearest), start, focal_px, self._steps[0])
        return Poses(*self._in_frame(found, back), found.score, poses.place)

    def _averaged(self, images: Tensor, best: Poses) -> tuple[Poses, Float[Tensor, " batch"]]:
        """The mean of what the templates around a pose answer, and the spread of the logarithm of their distances."""
        crops, back, depth, focal_px = self._crops(images, best.position_m[:, None], CROP_PX)
        maps = with_gradient(self.bank.fine(self.trunk(crops)[0]))
        start = self._in_crop(best.rotation, back, depth)
        near = (start.rotation.flatten(1) @ self.bank.rotations.flatten(1).T).topk(NUM_NEIGHBOURS, dim=1).indices
        start = Aligned(*(of_all.repeat_interleave(NUM_NEIGHBOURS, dim=0) for of_all in start))
        maps, focal_px = (of_all.repeat_interleave(NUM_NEIGHBOURS, dim=0) for of_all in (maps, focal_px))
        found = align(maps, *self.bank.surface(near.flatten()), start, focal_px, self._steps[1])
        rotation, position, score = (of_all.unflatten(0, (-1, NUM_NEIGHBOURS)) for of_all in found)
        weight = (_SHARPNESS * score).softmax(dim=1)
        log_depth = position[..., 2].clamp(min=1e-3).log()
        mean = (weight * log_depth).sum(dim=1, keepdim=True)
        slope = (weight[..., None] * position[..., :2] / position[..., 2:].clamp(min=1e-3)).sum(dim=1)
        turn = (weight[..., None, None] * rotation).sum(dim=1)
        turn = matrix_from_rotation_6d(rotation_6d_from_matrix(turn))
        placed = torch.cat([slope * mean.exp(), mean.exp()], dim=1)
        spread = (weight * (log_depth - mean).square()).sum(dim=1).clamp(min=1e-12).sqrt()
        total = (weight * score).sum(dim=1)
        return Poses(*self._in_frame(Aligned(turn, placed, total), back), total, best.place), spread

    def _best(self, poses: Poses, num_images: int) -> Poses:
        """The hypothesis of each image that has the highest score."""
        by_image = poses.score.unflatten(0, (num_images, -1))
        row = torch.arange(num_images, device=by_image.device) * by_image.shape[1] + by_image.argmax(dim=1)
        return Poses(*(of_all[row] for of_all in poses))

    def _crops(
        self, images: Tensor, positions_m: Float[Tensor, "batch num 3"], side: int
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Crops of cameras that look at positions; cam_from_crop, distances and focal lengths, a row a position."""
        place = positions_m.flatten(0, 1)
        depth = place.square().sum(dim=1).sqrt().clamp(min=self.geometry.near_m / 2)
        focal_px = FILL * CROP_PX * depth / self.geometry.diameter_m
        crops, crop_from_cam = cut_crops(images, self._matrix[0], positions_m, focal_px, side)
        return crops, crop_from_cam.transpose(1, 2), depth, focal_px

    def _in_crop(self, rotation: Tensor, back: Tensor, depth: Tensor) -> Aligned:
        zero = torch.zeros_like(depth)
        position = torch.stack([zero, zero, depth / self.geometry.diameter_m], dim=1)
        return Aligned(back.transpose(1, 2) @ rotation, position, zero)

    def _in_frame(self, found: Aligned, back: Tensor) -> tuple[Tensor, Tensor]:
        position_m = found.position * self.geometry.diameter_m
        return back @ found.rotation, (back @ position_m[..., None])[..., 0]


def _shifts() -> Float[Tensor, "shifts 2"]:
    """Crop pixels by which templates are shifted, (x, y), in the order of :meth:`Bank.match`."""
    steps = COARSE_STRIDE * torch.arange(-(_MARGIN_PX // COARSE_STRIDE), _MARGIN_PX // COARSE_STRIDE + 1)
    down, across = torch.meshgrid(steps, steps, indexing="ij")
    return torch.stack([across, down], dim=-1).flatten(0, 1).float()


def _probability(features: Float[Tensor, "batch 2"], weights: Float[Tensor, " 3"]) -> Float[Tensor, " batch"]:
    """Sigmoid of the weighted sum of calibration features; the last weight is the offset."""
    return torch.sigmoid(features @ weights[:-1] + weights[-1])
