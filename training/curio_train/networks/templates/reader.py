"""From places in a frame to poses, for several objects at once: match templates, then align the best ones."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix, rotation_between
from curio_train.networks.crop_camera import cut_crops
from curio_train.networks.templates.alignment import Aligned, align, with_gradient
from curio_train.networks.templates.banks import Banks
from curio_train.networks.templates.geometry import CROP_PX, FILL, Geometry
from curio_train.networks.templates.trunk import COARSE_STRIDE, Trunk
from curio_train.scene_code import CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION

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


class Places(NamedTuple):
    """Where each object may be."""

    position_m: Float[Tensor, "batch objects num 3"]
    """Of the object's centre, camera frame."""
    score: Float[Tensor, "batch objects num"]
    """The higher the likelier; its unit is that of what finds places."""


class CalibrationFeatures(NamedTuple):
    """Calibration features: the inputs of the two logits whose probabilities make up the confidence."""

    right: Float[Tensor, "batch objects 2"]
    """Ten times the final score, and how well the neighbours agree about the distance."""
    there: Float[Tensor, "batch objects 2"]
    """Ten times the final score, and the score of the place that it was found at."""


class _Poses(NamedTuple):
    """Hypotheses in the frame's camera, a row each: image after image, and in each image object after object."""

    rotation: Float[Tensor, "rows 3 3"]
    """cam_from_obj."""
    position_m: Float[Tensor, "rows 3"]
    """Of the object's centre."""
    score: Float[Tensor, " rows"]
    """Of the templates."""
    place: Float[Tensor, " rows"]
    """Score of the place that it was found at."""


class _Crops(NamedTuple):
    """Crops of cameras that look at positions, a row a position."""

    images: Tensor
    """[rows, 3, side, side]."""
    cam_from_crop: Tensor
    """[rows, 3, 3]."""
    distance_m: Tensor
    """[rows]."""
    focal_px: Tensor
    """[rows]."""


class PoseReader(nn.Module):
    """Matches and aligns the templates of several objects in frames of one camera."""

    banks: Banks
    """All templates."""
    pose_correct: Tensor
    """Weights [objects, 2] and offset of the pose-correct logit, [objects, 3]; calibrated on renderings."""
    presence: Tensor
    """Likewise of the presence logit."""
    _matrix: Tensor
    _diameter_m: Tensor
    _nearest_m: Tensor
    _lamp: Tensor

    def __init__(self, geometries: Sequence[Geometry], steps: tuple[int, int] = STEPS) -> None:
        """Build for objects in frames of one camera; all templates are still empty.

        Args:
            geometries: One an object.
            steps: See :data:`STEPS`.
        """
        super().__init__()
        num = len(geometries)
        self.banks, self._steps = Banks(num), steps
        self.register_buffer("pose_correct", torch.tensor([1.0, 0.0, 0.0]).repeat(num, 1))
        self.register_buffer("presence", torch.tensor([1.0, 0.0, 0.0]).repeat(num, 1))
        for name, values in {
            "_matrix": torch.from_numpy(geometries[0].matrix).float(),
            "_diameter_m": torch.tensor([geometry.diameter_m for geometry in geometries]),
            "_nearest_m": torch.tensor([geometry.near_m / 2 for geometry in geometries]),
            "_lamp": torch.tensor(LAMP),
        }.items():
            self.register_buffer(name, values, persistent=False)

    def forward(self, trunk: Trunk, images: Float[Tensor, "batch 3 height width"], places: Places) -> dict[str, Tensor]:
        """Codes in the frame's camera: metres, 6D rotation and confidence [batch, objects, …], light [batch, 3]."""
        code, features = self.read(trunk, images, places)
        sure = _probability(features.right, self.pose_correct) * _probability(features.there, self.presence)
        return code | {CONFIDENCE: sure[..., None]}

    def read(
        self, trunk: Trunk, images: Float[Tensor, "batch 3 height width"], places: Places
    ) -> tuple[dict[str, Tensor], CalibrationFeatures]:
        """The code without its confidence, and what that is made of."""
        found = self._aligned(trunk, images, self._hypotheses(trunk, images, places))
        last, spread = self._averaged(trunk, images, _best(found))

        def by_object(values: Tensor) -> Tensor:
            return values.unflatten(0, (-1, self.banks.num_objects))

        score, spread, place = by_object(10 * last.score), by_object(-100 * spread), by_object(last.place)
        return {
            TRANSLATION: by_object(last.position_m),
            ROTATION_6D: by_object(rotation_6d_from_matrix(last.rotation)),
            LIGHT: self._lamp.expand(images.shape[0], 3),
        }, CalibrationFeatures(torch.stack([score, spread], dim=2), torch.stack([score, place], dim=2))

    def _hypotheses(self, trunk: Trunk, images: Tensor, places: Places) -> _Poses:
        """The best match, the best of those that differ from it, and so on, of each object in each image."""
        num = places.score.shape[2]
        crops = self._crops(images, places.position_m.flatten(0, 2), num, CROP_PX + 2 * _MARGIN_PX)
        coarse = trunk(crops.images)[1].unflatten(0, (-1, self.banks.num_objects, num))
        scores, shift = (found.flatten(0, 1) for found in self.banks.match(coarse).max(dim=4))
        turn, distance_m, focal_px = (of_all.unflatten(0, (-1, num)) for of_all in crops[1:])
        positions_m, place_scores = places.position_m.flatten(0, 1), places.score.flatten(0, 1)
        shifts = _shifts().to(images)
        found: list[_Poses] = []
        row = torch.arange(scores.shape[0], device=images.device)
        for place, template, score in self._pick(scores, positions_m):
            slope = shifts[shift[row, place, template]] / focal_px[row, place][:, None]
            ray = torch.cat([slope, torch.ones_like(slope[:, :1])], dim=1)
            ray = ray / ray.square().sum(dim=1, keepdim=True).sqrt() * distance_m[row, place][:, None]
            position = (turn[row, place] @ ray[..., None])[..., 0]
            axis = position.new_tensor([0.0, 0.0, 1.0]).expand_as(position)
            rotation = rotation_between(axis, position) @ self.banks.rotations[template]
            found.append(_Poses(rotation, position, score, place_scores[row, place]))
        return _Poses(*(torch.stack(values, dim=1).flatten(0, 1) for values in zip(*found, strict=True)))

    def _pick(
        self, scores: Float[Tensor, "rows num templates"], positions_m: Float[Tensor, "rows num 3"]
    ) -> list[tuple[Int[Tensor, " rows"], Int[Tensor, " rows"], Float[Tensor, " rows"]]]:
        """Place, template and score of each hypothesis; hypotheses at one place differ in rotation."""
        turns = self.banks.rotations.flatten(1)
        count, picked = turns.shape[0], []
        apart_m = (_ONE_PLACE * self._diameter_m).repeat(scores.shape[0] // self.banks.num_objects)
        for _ in range(NUM_HYPOTHESES):
            score, best = scores.flatten(1).max(dim=1)
            place, template = torch.div(best, count, rounding_mode="floor"), best % count
            picked.append((place, template, score))
            alike = (turns[template] @ turns.T - 1) / 2 > _ALIKE_COS
            chosen = positions_m[torch.arange(best.shape[0], device=best.device), place]
            beside = (positions_m - chosen[:, None]).square().sum(dim=-1) < apart_m[:, None] ** 2
            scores = torch.where(beside[:, :, None] & alike[:, None], _SUPPRESSED, scores)
        return picked

    def _aligned(self, trunk: Trunk, images: Tensor, poses: _Poses) -> _Poses:
        """Each hypothesis moved to where the template nearest to it fits best."""
        crops = self._crops(images, poses.position_m, NUM_HYPOTHESES, CROP_PX)
        maps = with_gradient(self.banks.fine(trunk(crops.images)[0], NUM_HYPOTHESES))
        start = self._in_crop(poses.rotation, crops, NUM_HYPOTHESES)
        nearest = (start.rotation.flatten(1) @ self.banks.rotations.flatten(1).T).argmax(dim=1)
        surface = self.banks.surface(nearest.unflatten(0, (-1, NUM_HYPOTHESES)))
        found = align(maps, *surface, start, crops.focal_px, self._steps[0])
        return _Poses(*self._in_frame(found, crops, NUM_HYPOTHESES), found.score, poses.place)

    def _averaged(self, trunk: Trunk, images: Tensor, best: _Poses) -> tuple[_Poses, Float[Tensor, " rows"]]:
        """The mean of what the templates around a pose answer, and the spread of the logarithm of their distances."""
        crops = self._crops(images, best.position_m, 1, CROP_PX)
        maps = with_gradient(self.banks.fine(trunk(crops.images)[0], 1))
        start = self._in_crop(best.rotation, crops, 1)
        near = (start.rotation.flatten(1) @ self.banks.rotations.flatten(1).T).topk(NUM_NEIGHBOURS, dim=1).indices
        start = Aligned(*(of_all.repeat_interleave(NUM_NEIGHBOURS, dim=0) for of_all in start))
        maps, focal_px = (of_all.repeat_interleave(NUM_NEIGHBOURS, dim=0) for of_all in (maps, crops.focal_px))
        found = align(maps, *self.banks.surface(near), start, focal_px, self._steps[1])
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
        return _Poses(*self._in_frame(Aligned(turn, placed, total), crops, 1), total, best.place), spread

    def _of_rows(self, of_objects: Float[Tensor, " objects"], rows: int, num: int) -> Float[Tensor, " rows"]:
        """What belongs to the object of each row; an object has ``num`` rows in an image."""
        return of_objects.repeat_interleave(num).repeat(rows // (num * self.banks.num_objects))

    def _crops(self, images: Tensor, positions_m: Float[Tensor, "rows 3"], num: int, side: int) -> _Crops:
        """Crops of this side around positions, ``num`` an object."""
        rows = positions_m.shape[0]
        nearest, diameter_m = (self._of_rows(one, rows, num) for one in (self._nearest_m, self._diameter_m))
        distance_m = torch.maximum(positions_m.square().sum(dim=1).sqrt(), nearest)
        focal_px = FILL * CROP_PX * distance_m / diameter_m
        by_image = positions_m.unflatten(0, (images.shape[0], -1))
        crops, crop_from_cam = cut_crops(images, self._matrix, by_image, focal_px, side)
        return _Crops(crops, crop_from_cam.transpose(1, 2), distance_m, focal_px)

    def _in_crop(self, rotation: Tensor, crops: _Crops, num: int) -> Aligned:
        """Poses in the cameras of crops that look at their positions."""
        zero = torch.zeros_like(crops.distance_m)
        diameter_m = self._of_rows(self._diameter_m, zero.shape[0], num)
        position = torch.stack([zero, zero, crops.distance_m / diameter_m], dim=1)
        return Aligned(crops.cam_from_crop.transpose(1, 2) @ rotation, position, zero)

    def _in_frame(self, found: Aligned, crops: _Crops, num: int) -> tuple[Tensor, Tensor]:
        position_m = found.position * self._of_rows(self._diameter_m, found.position.shape[0], num)[:, None]
        turn = crops.cam_from_crop
        return turn @ found.rotation, (turn @ position_m[..., None])[..., 0]


def _best(poses: _Poses) -> _Poses:
    """The hypothesis of each object in each image that has the highest score."""
    by_object = poses.score.unflatten(0, (-1, NUM_HYPOTHESES))
    row = torch.arange(by_object.shape[0], device=by_object.device) * NUM_HYPOTHESES + by_object.argmax(dim=1)
    return _Poses(*(of_all[row] for of_all in poses))


def _shifts() -> Float[Tensor, "shifts 2"]:
    """Crop pixels by which templates are shifted, (x, y), in the order of :meth:`Banks.match`."""
    steps = COARSE_STRIDE * torch.arange(-(_MARGIN_PX // COARSE_STRIDE), _MARGIN_PX // COARSE_STRIDE + 1)
    down, across = torch.meshgrid(steps, steps, indexing="ij")
    return torch.stack([across, down], dim=-1).flatten(0, 1).float()


def _probability(
    features: Float[Tensor, "batch objects 2"], weights: Float[Tensor, "objects 3"]
) -> Float[Tensor, "batch objects"]:
    """Sigmoid of the weighted sum of calibration features; the last weight is the offset."""
    return torch.sigmoid((features * weights[:, :-1]).sum(dim=2) + weights[:, -1])
