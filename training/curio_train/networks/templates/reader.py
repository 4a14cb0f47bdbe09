"""From places in a frame to poses, for several objects at once: match templates, then align the best ones."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix, rotation_between
from curio_train.networks.crop_camera import about_axis, cut_crops
from curio_train.networks.templates.alignment import Aligned, FeatureMaps, align
from curio_train.networks.templates.banks import Banks
from curio_train.networks.templates.effort import Effort
from curio_train.networks.templates.geometry import CROP_PX, FILL, QUARTER_TURNS, Geometry
from curio_train.networks.templates.outline import outline_log_factor
from curio_train.networks.templates.rolls import upright_rolls
from curio_train.networks.templates.trunk import COARSE_STRIDE, Trunk
from curio_train.scene_code import CONFIDENCE, LIGHT, PRESENCE, ROTATION_6D, TRANSLATION

LAMP = (0.0, -0.7, -0.7)
"""The light that templates are drawn under and that is answered: it is not read from images."""

_ALIKE_COS = 0.94  # 20 degrees between the rotations of hypotheses at one place
_ONE_PLACE = 0.5  # diameters
_SHARPNESS = 20.0  # of the neighbours' weights, a unit of score
_SUPPRESSED = -10.0


class Places(NamedTuple):
    """Centre proposals: positions where each object may be."""

    position_m: Float[Tensor, "batch objects num 3"]
    """Position of the object's centre, camera frame."""
    score: Float[Tensor, "batch objects num"]
    """The higher the likelier; its unit is that of what finds places."""
    slots: Int[Tensor, " objects"]
    """Which objects these are, of all that the network knows."""


class _Aims(NamedTuple):
    """Where cameras of crops look, some at each object."""

    position_m: Float[Tensor, "batch objects num 3"]
    """Camera frame of the image."""
    slots: Int[Tensor, " objects"]
    """Which objects are there."""

    def repeated(self, count: int) -> "_Aims":
        """Each position ``count`` times in a row."""
        return self._replace(position_m=self.position_m.repeat_interleave(count, dim=2))

    def of_crops(self, of_all: Float[Tensor, " known"]) -> Float[Tensor, " crops"]:
        """Each crop's value of what all objects have."""
        return of_all.index_select(0, self.slots)[:, None].expand(self.position_m.shape[:3]).flatten()


class CalibrationFeatures(NamedTuple):
    """Calibration features: the inputs of the two logits whose probabilities make up the confidence."""

    right: Float[Tensor, "batch objects 3"]
    """Ten times the final score, and how well the neighbours, and descriptors and outline, agree about the distance."""
    there: Float[Tensor, "batch objects 2"]
    """Ten times the final score, and the highest score of a place of the object."""


class _Crops(NamedTuple):
    """Crops of cameras that look at places: image after image, object after object, place after place."""

    pictures: Float[Tensor, "crops 3 side side"]
    """SRGB in [0, 1]."""
    fine: FeatureMaps
    """Descriptors of the object that is looked for, at stride 4."""
    coarse: Float[Tensor, "batch objects num channels rows columns"]
    """Features at stride 8."""
    cam_from_crop: Float[Tensor, "crops 3 3"]
    """Camera frame of the image."""
    distance_m: Float[Tensor, " crops"]
    """Distances of the centre proposals."""
    focal_px: Float[Tensor, " crops"]
    """Focal lengths of the crops' cameras, pixels."""
    slots: Int[Tensor, " objects"]
    """Which objects are looked for."""

    def by_object(self, values: Tensor) -> Tensor:
        """Rows, object after object, as [batch, objects, …]."""
        return values.unflatten(0, (-1, self.slots.shape[0]))


class _Hypotheses(NamedTuple):
    """Poses in the cameras of their crops, a row each."""

    pose: Aligned
    """Positions in diameters."""
    crop: Int[Tensor, " rows"]
    """Crop in which the object is seen."""

    def in_frame(self, crops: _Crops) -> Float[Tensor, "rows 3"]:
        """Positions in the camera frame of the image, diameters."""
        return (crops.cam_from_crop.index_select(0, self.crop) @ self.pose.position[..., None])[..., 0]


class PoseReader(nn.Module):
    """Matches and aligns the templates of several objects in frames of one camera."""

    banks: Banks
    """Templates of all objects."""
    effort: Effort
    """May be changed at any time; the confidence is calibrated for what it was then."""
    pose_correct: Tensor
    """Weights of the pose-correct logit's features and its offset, [objects, 4]; calibrated on renderings."""
    ceiling: Tensor
    """How often the poses that look best are correct, [objects]; 1 unless photographs tell."""
    presence: Tensor
    """Weights of the presence logit's features and its offset, [objects, 3]; calibrated on renderings."""
    presence_power: Tensor
    """Power with which presence enters the confidence, [objects]: 1, or 0 where the other factor tells both."""
    _matrix: Tensor
    _diameter_m: Tensor
    _nearest_m: Tensor
    _lamp: Tensor

    def __init__(self, geometries: Sequence[Geometry]) -> None:
        """Build for objects of these geometries in frames of one camera; all templates are still empty."""
        super().__init__()
        num, self.effort = len(geometries), Effort()
        self._any_side = geometries[0].any_side
        self.banks = Banks(num, self._any_side)
        self.register_buffer("pose_correct", torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(num, 1))
        self.register_buffer("ceiling", torch.ones(num))
        self.register_buffer("presence", torch.tensor([1.0, 0.0, 0.0]).repeat(num, 1))
        self.register_buffer("presence_power", torch.ones(num))
        for name, values in {
            "_matrix": torch.from_numpy(geometries[0].matrix).float(),
            "_diameter_m": torch.tensor([geometry.diameter_m for geometry in geometries]),
            "_nearest_m": torch.tensor([geometry.near_m / 2 for geometry in geometries]),
            "_lamp": torch.tensor(LAMP),
        }.items():
            self.register_buffer(name, values, persistent=False)

    def forward(self, trunk: Trunk, images: Float[Tensor, "batch 3 height width"], places: Places) -> dict[str, Tensor]:
        """In the frame's camera: metres, 6D rotation, confidence, presence [batch, objects, …]; light [batch, 3]."""
        code, features = self.read(trunk, images, places)
        calibration = (self.pose_correct, self.ceiling, self.presence, self.presence_power)
        right, ceiling, there, power = (of_all.index_select(0, places.slots) for of_all in calibration)
        presence = _probability(features.there, there)
        confidence = presence**power * ceiling * _probability(features.right, right)
        return code | {CONFIDENCE: confidence[..., None], PRESENCE: presence[..., None]}

    def read(
        self, trunk: Trunk, images: Float[Tensor, "batch 3 height width"], places: Places
    ) -> tuple[dict[str, Tensor], CalibrationFeatures]:
        """The code without its confidence, and what that is made of."""
        aims = _Aims(places.position_m, places.slots)
        aims, roll = self._closer(trunk, images, aims) if self.effort.closer else self._turned(aims)
        crops = self._crops(trunk, images, aims, roll)
        best = self._best(self._aligned(crops, self._hypotheses(crops, aims), self.effort.steps[1]))
        pose, spread = self._averaged(crops, best)
        pose, gap = self._between(crops, best.crop, pose)

        found, by_object = best._replace(pose=pose), crops.by_object
        cam_from_crop = crops.cam_from_crop.index_select(0, best.crop)
        position_m = by_object(found.in_frame(crops)) * self._diameter_m.index_select(0, places.slots)[:, None]
        score = by_object(10 * pose.score)
        return {
            TRANSLATION: position_m,
            ROTATION_6D: by_object(rotation_6d_from_matrix(cam_from_crop @ pose.rotation)),
            LIGHT: self._lamp.expand(images.shape[0], 3),
        }, CalibrationFeatures(
            torch.stack([score, by_object(-100 * spread), by_object(-100 * gap.abs())], dim=2),
            torch.stack([score, places.score.amax(dim=2)], dim=2),
        )

    def _closer(self, trunk: Trunk, images: Tensor, aims: _Aims) -> tuple[_Aims, Float[Tensor, "crops 3 3"]]:
        """Where the likeliest hypotheses put each object, and by what angles crops there are rolled.

        Places are some per cent too near or too far, and objects lean to one side. Templates match better in crops at
        the distance that alignment finds, and where the object leans as it does in templates.
        """
        aims, turn = self._turned(aims)
        crops = self._crops(trunk, images, aims, turn)
        found = self._aligned(crops, self._hypotheses(crops, aims), self.effort.steps[0])
        upward = (crops.cam_from_crop.index_select(0, found.crop) @ found.pose.rotation)[..., 2]
        rows = (found.pose.score, found.in_frame(crops), upward)
        score, position, upward = (values.unflatten(0, (-1, self.effort.hypotheses)) for values in rows)
        best = score.topk(self.effort.closer, dim=1).indices
        of_rows = best[..., None].expand(-1, -1, 3)
        both = (self._diameter_m, self._nearest_m)
        diameter_m, nearest_m = (of_all.index_select(0, aims.slots)[:, None, None] for of_all in both)
        chosen = crops.by_object(position.gather(1, of_rows)) * diameter_m
        in_front = torch.maximum(chosen[..., 2:], nearest_m)
        closer = torch.cat([chosen[..., :2], in_front], dim=3)
        rolls_deg = self.effort.rolls_deg
        roll = upright_rolls(closer.flatten(0, 2), upward.gather(1, of_rows).flatten(0, 1), rolls_deg)
        return _Aims(closer, aims.slots).repeated(len(rolls_deg)), roll

    def _turned(self, aims: _Aims) -> tuple[_Aims, Float[Tensor, "crops 3 3"] | None]:
        """Aims in all quarter turns where objects may be rolled in any way; else as they are."""
        if not self._any_side:
            return aims, None
        quarters = aims.position_m.new_tensor([[1, 0], [0, 1], [-1, 0], [0, -1]])
        turns = about_axis(quarters).expand(*aims.position_m.shape[:3], -1, -1, -1).flatten(0, 3)
        return aims.repeated(QUARTER_TURNS), turns

    def _crops(self, trunk: Trunk, images: Tensor, aims: _Aims, roll: Tensor | None = None) -> _Crops:
        """Crops in which templates can be shifted."""
        num, side, slots = aims.position_m.shape[2], self._side, aims.slots
        by_image = aims.position_m.flatten(1, 2)
        nearest, diameter_m = aims.of_crops(self._nearest_m), aims.of_crops(self._diameter_m)
        distance_m = torch.maximum(by_image.flatten(0, 1).square().sum(dim=1).sqrt(), nearest)
        focal_px = FILL * CROP_PX * distance_m / diameter_m
        scale = 2 if self.effort.halved else 1
        pictures, crop_from_cam = cut_crops(
            images, self._matrix, by_image, focal_px / scale, side // scale, oversampling=1, roll=roll
        )
        fine, coarse = trunk(pictures, halved=self.effort.halved)
        by_object = coarse.unflatten(0, (-1, slots.shape[0], num))
        maps = FeatureMaps.of(self.banks.fine(fine, slots, num))
        return _Crops(pictures, maps, by_object, crop_from_cam.transpose(1, 2), distance_m, focal_px, slots)

    def _hypotheses(self, crops: _Crops, aims: _Aims) -> _Hypotheses:
        """The best match, the best of those that differ from it, and so on, of each object in each image."""
        num = aims.position_m.shape[2]
        scores, shift = (found.flatten(0, 1) for found in self.banks.match(crops.coarse, aims.slots).max(dim=4))
        positions_m, diameter_m = aims.position_m.flatten(0, 1), aims.of_crops(self._diameter_m)
        shifts = _shifts(self.effort.margin_px).to(scores)
        count = scores.shape[2]
        score, best = self._pick(scores, positions_m, _ONE_PLACE * diameter_m[::num])
        place, template = (torch.div(best, count, rounding_mode="floor"), (best % count).flatten())
        row = torch.arange(scores.shape[0], device=scores.device)
        crop = (row[:, None] * num + place).flatten()
        shift = shift.flatten(1).gather(1, best).flatten()
        slope = shifts.index_select(0, shift) / crops.focal_px.index_select(0, crop)[:, None]
        ray = torch.cat([slope, torch.ones_like(slope[:, :1])], dim=1)
        far = (crops.distance_m / diameter_m).index_select(0, crop)
        position = ray / ray.square().sum(dim=1, keepdim=True).sqrt() * far[:, None]
        rotation = _seen_along(position) @ self.banks.rotations.index_select(0, template)
        return _Hypotheses(Aligned(rotation, position, score.flatten()), crop)

    def _pick(
        self,
        scores: Float[Tensor, "rows num templates"],
        positions_m: Float[Tensor, "rows num 3"],
        apart_m: Float[Tensor, " rows"],
    ) -> tuple[Float[Tensor, "rows hypotheses"], Int[Tensor, "rows hypotheses"]]:
        """Scores of hypotheses, and which templates at which places they are; at one place they differ in rotation."""
        turns = self.banks.rotations.flatten(1)
        count, found, picked = turns.shape[0], [], []
        for _ in range(self.effort.hypotheses):
            score, best = scores.flatten(1).max(dim=1)
            found.append(score)
            picked.append(best)
            place, template = torch.div(best, count, rounding_mode="floor"), best % count
            alike = (turns.index_select(0, template) @ turns.T - 1) / 2 > _ALIKE_COS
            chosen = positions_m.gather(1, place[:, None, None].expand(-1, 1, 3))
            beside = (positions_m - chosen).square().sum(dim=-1) < apart_m[:, None] ** 2
            scores = torch.where(beside[:, :, None] & alike[:, None], _SUPPRESSED, scores)
        return torch.stack(found, dim=1), torch.stack(picked, dim=1)

    def _aligned(self, crops: _Crops, found: _Hypotheses, num_steps: int) -> _Hypotheses:
        """Each hypothesis moved to where the template nearest to it fits best."""
        templates = self._nearest(found.pose, 1).unflatten(0, (-1, self.effort.hypotheses))[..., 0]
        surface = self.banks.surface(templates, crops.slots)
        pose = align(
            crops.fine, found.crop, *surface, found.pose, crops.focal_px.index_select(0, found.crop), num_steps
        )
        return found._replace(pose=pose)

    def _averaged(self, crops: _Crops, best: _Hypotheses) -> tuple[Aligned, Float[Tensor, " rows"]]:
        """The mean of what the templates around a pose answer, and the spread of the logarithm of their distances."""
        num = self.effort.neighbours
        rolled, pose = self._in_all_rolls(crops, best.crop, best.pose)
        templates = self._nearest(pose, num).unflatten(0, (-1, len(self.effort.rolls_deg))).flatten(1)
        surface = self.banks.surface(templates, crops.slots)
        start = Aligned(*(of_all.repeat_interleave(num, dim=0) for of_all in pose))
        crop = rolled.repeat_interleave(num)
        found = align(crops.fine, crop, *surface, start, crops.focal_px.index_select(0, crop), self.effort.steps[2])
        rotation, position, score = (of_all.unflatten(0, templates.shape) for of_all in found)
        cam_from_crop = crops.cam_from_crop.index_select(0, crop).unflatten(0, templates.shape)
        back = crops.cam_from_crop.index_select(0, best.crop).transpose(1, 2)[:, None] @ cam_from_crop
        rotation, position = back @ rotation, (back @ position[..., None])[..., 0]
        weight = (_SHARPNESS * score).softmax(dim=1)
        log_depth = position[..., 2].clamp(min=1e-3).log()
        mean = (weight * log_depth).sum(dim=1, keepdim=True)
        slope = (weight[..., None] * position[..., :2] / position[..., 2:].clamp(min=1e-3)).sum(dim=1)
        turn = (weight[..., None, None] * rotation).sum(dim=1)
        turn = matrix_from_rotation_6d(rotation_6d_from_matrix(turn))
        placed = torch.cat([slope * mean.exp(), mean.exp()], dim=1)
        spread = (weight * (log_depth - mean).square()).sum(dim=1).clamp(min=1e-12).sqrt()
        return Aligned(turn, placed, (weight * score).sum(dim=1)), spread

    def _between(self, crops: _Crops, crop: Tensor, pose: Aligned) -> tuple[Aligned, Float[Tensor, " rows"]]:
        """The pose at the mean of the distances that descriptors and outline tell, and the logarithm of their ratio."""
        num = len(self.effort.rolls_deg)
        outlines = self.banks.outlines(self._nearest(pose, 1)[:, 0], crops.slots)
        points, outward = (of_all.repeat_interleave(num, dim=0) for of_all in outlines)
        rolled, seen = self._in_all_rolls(crops, crop, pose)
        pictures, focal_px = (of_all.index_select(0, rolled) for of_all in (crops.pictures, crops.focal_px))
        gaps = outline_log_factor(pictures, points, outward, seen, focal_px, self._side)
        gap = gaps.unflatten(0, (-1, num)).mean(dim=1)
        return pose._replace(position=pose.position * (gap / 2).exp()[:, None]), gap

    def _best(self, found: _Hypotheses) -> _Hypotheses:
        """The hypothesis of each object in each image that has the highest score."""
        best = found.pose.score.unflatten(0, (-1, self.effort.hypotheses)).argmax(dim=1)
        row = torch.arange(best.shape[0], device=best.device) * self.effort.hypotheses + best
        pose = Aligned(*(of_all.index_select(0, row) for of_all in found.pose))
        return _Hypotheses(pose, found.crop.index_select(0, row))

    def _in_all_rolls(
        self, crops: _Crops, crop: Int[Tensor, " rows"], pose: Aligned
    ) -> tuple[Int[Tensor, " rolled"], Aligned]:
        """The crops of the same place in all rolls, and poses in their cameras, one after the other."""
        num = len(self.effort.rolls_deg)
        rolled = (crop - crop % num)[:, None] + torch.arange(num, device=crop.device)
        others = crops.cam_from_crop.index_select(0, rolled.flatten()).unflatten(0, (-1, num))
        turn = others.transpose(2, 3) @ crops.cam_from_crop.index_select(0, crop)[:, None]
        rotation, position = turn @ pose.rotation[:, None], (turn @ pose.position[:, None, :, None])[..., 0]
        scores = pose.score.repeat_interleave(num)
        return rolled.flatten(), Aligned(rotation.flatten(0, 1), position.flatten(0, 1), scores)

    def _nearest(self, pose: Aligned, num: int) -> Int[Tensor, "rows num"]:
        """Templates whose rotations are nearest to what poses show."""
        turn = _seen_along(pose.position).transpose(1, 2) @ pose.rotation
        return (turn.flatten(1) @ self.banks.rotations.flatten(1).T).topk(num, dim=1).indices

    @property
    def _side(self) -> int:
        """Of crops, pixels."""
        return CROP_PX + 2 * self.effort.margin_px


def _seen_along(position: Float[Tensor, "rows 3"]) -> Float[Tensor, "rows 3 3"]:
    """The rotation by which an object on the optical axis shows the same side at a position beside the axis."""
    return rotation_between(position.new_tensor([0.0, 0.0, 1.0]).expand_as(position), position)


def _shifts(margin_px: int) -> Float[Tensor, "shifts 2"]:
    """Crop pixels by which templates are shifted, (x, y), in the order of :meth:`Banks.match`."""
    steps = COARSE_STRIDE * torch.arange(-(margin_px // COARSE_STRIDE), margin_px // COARSE_STRIDE + 1)
    down, across = torch.meshgrid(steps, steps, indexing="ij")
    return torch.stack([across, down], dim=-1).flatten(0, 1).float()


def _probability(
    features: Float[Tensor, "batch objects size"], weights: Float[Tensor, "objects size+1"]
) -> Float[Tensor, "batch objects"]:
    """Sigmoid of the weighted sum of calibration features; the last weight is the offset."""
    return torch.sigmoid((features * weights[:, :-1]).sum(dim=2) + weights[:, -1])
