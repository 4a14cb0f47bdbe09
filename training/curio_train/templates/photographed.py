"""Templates that look as photographs of the object do: descriptors averaged with those of photographs with known poses.

Renderings and photographs of one view differ: the cosine of their descriptors is 0.2 to 0.5. Where the poses of some
photographs are known, by pseudo-labels, each template is averaged with what photographs from nearly its direction show
at its cells and surface points. What another object hides there differs most, and counts little.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from curio_train.geometry import Pose, rotation_between
from curio_train.metrics.poses import in_view
from curio_train.networks.crop_camera import about_axis, cut_crops
from curio_train.networks.several_objects.network import ObjectsNetwork
from curio_train.networks.templates.alignment import FeatureMaps, InCrop
from curio_train.networks.templates.bank import RANK
from curio_train.networks.templates.geometry import CROP_PX, FILL, NUM_ROLLS
from curio_train.networks.templates.trunk import COARSE_STRIDE
from curio_train.templates.describe import low_rank

_RENDERED_POINTS, _RENDERED_CELLS = 0.3, 0.5  # weights of the renderings; a photograph from the very direction has 1
_FARTHEST_DEG, _SPREAD_DEG = 15.0, 8.0  # between directions: beyond it a photograph has no weight; of its weight
_OUTLIER = 0.5  # squared distance of descriptors at which a cell counts a quarter (Geman and McClure 1985)
_MARGIN_PX = 16  # around a template in a crop, so that borders change nothing that is read


class _Seen(NamedTuple):
    """What one photograph shows of an object, in crops that are rolled as templates are, a crop a roll."""

    views: Int[Tensor, " near"]
    """Directions of the templates from nearly which it was taken."""
    weight: Float[Tensor, " near"]
    """Weights of the photograph in them."""
    points: FeatureMaps
    """Descriptors at stride 4."""
    cells: Float[Tensor, "rolls size cells cells"]
    """Descriptors at stride 8, of a template's extent."""
    pose: Pose[Tensor]
    """Crop_from_obj, [rolls, …], diameters."""
    focal_px: Tensor
    """Focal lengths of the crops."""


class _Mean:
    """A weighted mean of descriptors of unit length, robust against what differs from the first ones."""

    def __init__(self, first: Float[Tensor, "*shape size"], weight: float) -> None:
        self._length = first.norm(dim=-1, keepdim=True)
        self._first = F.normalize(first, dim=-1)
        self._sum = weight * self._first

    def add(self, where: tuple[Tensor, int], descriptors: Float[Tensor, "near *rest size"], weight: Tensor) -> None:
        """Add the descriptors of some templates with the weight of each."""
        distance = (descriptors - self._first[where]).square().sum(dim=-1, keepdim=True)
        robust = 4 / (1 + distance / _OUTLIER).square()
        self._sum[where] += weight.view(-1, *[1] * (descriptors.dim() - 1)) * robust * descriptors

    def values(self) -> Float[Tensor, "*shape size"]:
        """Means of the descriptors, scaled to the lengths of the first ones."""
        return self._length * F.normalize(self._sum, dim=-1)


@torch.no_grad()
def learn_appearance(
    network: ObjectsNetwork, frames: UInt8[Tensor, "num 3 height width"], poses: Sequence[Pose[np.ndarray]]
) -> None:
    """Let the templates of each object look as it does in photographs.

    Args:
        network: With templates.
        frames: Photographs of its camera, sRGB.
        poses: Cam_from_obj of each object in all photographs [num, …], metres; NaN where it is not known. Photographs
            that do not show the object teach nothing of it.
    """
    for number, pose in enumerate(poses):
        geometry = network.geometries[number]
        known = in_view(pose.translation_m, geometry.matrix, geometry.width, geometry.height)
        if known.any():
            some = Pose(torch.from_numpy(pose.rotation[known]), torch.from_numpy(pose.translation_m[known]))
            _learn(network, number, frames[torch.from_numpy(known)], some)


def _learn(network: ObjectsNetwork, number: int, frames: Tensor, cam_from_obj: Pose[Tensor]) -> None:
    """The templates of one object."""
    banks = network.reader.banks
    surface = banks.surface(torch.arange(len(banks.rotations))[None], torch.tensor([number]))
    points, described = (values.unflatten(0, (-1, NUM_ROLLS)) for values in surface)
    of_points = _Mean(described, _RENDERED_POINTS)
    of_cells = _Mean(banks.templates(number).unflatten(0, (-1, NUM_ROLLS)).movedim(2, -1), _RENDERED_CELLS)
    for frame, rotation, position_m in zip(frames, cam_from_obj.rotation, cam_from_obj.translation_m, strict=True):
        seen = _seen(network, number, frame, Pose(rotation.float(), position_m.float()))
        if len(seen.views) == 0:
            continue
        for roll in range(NUM_ROLLS):
            where = seen.views, roll
            of_points.add(where, _at_points(seen, roll, points[where]), seen.weight)
            of_cells.add(where, seen.cells[roll].movedim(0, -1).expand(len(seen.views), -1, -1, -1), seen.weight)
    banks.put_described(number, of_points.values().flatten(0, 1))
    banks.put_filters(number, *low_rank(of_cells.values().movedim(-1, 2).flatten(0, 1), RANK))


def _seen(network: ObjectsNetwork, number: int, frame: Tensor, cam_from_obj: Pose[Tensor]) -> _Seen:
    banks, geometry = network.reader.banks, network.geometries[number]
    templates = banks.rotations.unflatten(0, (-1, NUM_ROLLS))
    position_m = cam_from_obj.translation_m
    axis = position_m.new_tensor([0.0, 0.0, 1.0])
    shown = rotation_between(position_m, axis) @ cam_from_obj.rotation
    angle_deg = (templates[:, 0, 2] @ shown[2]).clamp(-1, 1).acos().rad2deg()
    views = torch.nonzero(angle_deg < _FARTHEST_DEG).flatten()
    weight = (-0.5 * (angle_deg[views] / _SPREAD_DEG).square()).exp()

    # The object leans in each crop as it does in the templates of one roll.
    turn = _lean(templates[angle_deg.argmin()]) - _lean(shown)
    rolls = about_axis(torch.stack([turn.cos(), turn.sin()], dim=1))
    distance_m = position_m.norm()
    focal_px = FILL * CROP_PX * distance_m / geometry.diameter_m
    matrix = torch.from_numpy(geometry.matrix).float()
    crops, crop_from_cam = cut_crops(
        frame[None].float() / 255,
        matrix,
        position_m.expand(1, NUM_ROLLS, 3),
        focal_px.expand(NUM_ROLLS),
        CROP_PX + 2 * _MARGIN_PX,
        oversampling=1,
        roll=rolls,
    )
    fine, coarse = network.locator.trunk(crops)
    first, cells = _MARGIN_PX // COARSE_STRIDE, CROP_PX // COARSE_STRIDE
    inside = slice(first, first + cells)
    return _Seen(
        views,
        weight,
        FeatureMaps.of(banks.fine(fine, torch.tensor([number]), NUM_ROLLS)),
        banks.coarse_of(number, coarse)[:, :, inside, inside],
        Pose(crop_from_cam @ cam_from_obj.rotation, crop_from_cam @ position_m / geometry.diameter_m),
        focal_px,
    )


def _lean(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """The angle in the picture of the object's z axis."""
    return torch.atan2(rotation[..., 1, 2], rotation[..., 0, 2])


def _at_points(seen: _Seen, roll: int, points: Float[Tensor, "near points 3"]) -> Float[Tensor, "near points size"]:
    """Descriptors of a crop where it shows surface points."""
    where = InCrop.of(seen.pose.rotation[roll][None], seen.pose.translation_m[roll][None], points)
    place = where.cells(seen.focal_px[None], seen.points.side)
    crop = torch.full((len(points),), roll)
    return F.normalize(seen.points.around(crop, place).of(seen.points.here), dim=-1)
