"""The distance at which an object's outline lies on edges of the picture: none of its own colours is needed.

Descriptors inside a silhouette put objects too far away, because a pose that is a little too small still has the object
at each of its points. Edges across the outline err to the other side, and nearly independently, so that the mean of
both distances is better than either (docs/experiments/real_photographs.md).
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from curio_train.networks.templates.alignment import Aligned

_REACH_PX = 4  # crop pixels across the outline in which edges are looked for
_WIDTH_PX = 3  # of the strips inside and outside whose mean colours are compared
_CLEAR = 0.02  # squared difference of colours at which an edge counts a half
_GOLDEN = 0.618034  # multiples of it are spread evenly, whatever their number
_PREFERENCE = 1e-3  # for the distance as it is: decides where no edge is seen
_FARTHEST, _NUM_SCALES = 0.06, 25  # of the logarithm of the distance


def outline_log_factor(
    pictures: Float[Tensor, "rows 3 side side"],
    outline: Float[Tensor, "rows points 3"],
    outward: Float[Tensor, "rows points 3"],
    pose: Aligned,
    focal_px: Float[Tensor, " rows"],
    side: int,
) -> Float[Tensor, " rows"]:
    """Logarithm of what distances have to be multiplied by, so that outlines lie on the clearest edges; at most 6 %.

    Args:
        pictures: Crops, sRGB in [0, 1], at any resolution.
        outline: Points of the object that are seen on its outline, diameters, object frame.
        outward: What turns away from the object there, across the line of sight, object frame.
        pose: Of the object in its crop's camera.
        focal_px: Of the crops' cameras, whose principal points are their middles.
        side: Of the crops' cameras, pixels.
    """
    turn = pose.rotation.transpose(1, 2)
    seen = outline @ turn + pose.position[:, None]
    slope, along = seen[..., :2] / seen[..., 2:].clamp(min=1e-3), outward @ turn
    across = F.normalize(along[..., :2] - slope * along[..., 2:], dim=-1)
    centre = pose.position[:, None, :2] / pose.position[:, None, 2:].clamp(min=1e-3)
    lever_px = focal_px[:, None] * ((slope - centre) * across).sum(dim=-1)
    middle = (side - 1) / 2
    shift_px = _shifts_px(slope)
    edges = _edges(pictures, focal_px[:, None, None] * slope + middle + shift_px * across, across, side)
    factors = torch.linspace(-_FARTHEST, _FARTHEST, _NUM_SCALES, device=pictures.device)
    column = (_REACH_PX - lever_px[..., None] * factors - shift_px).clamp(0, 2 * _REACH_PX)
    left = column.floor().clamp(max=2 * _REACH_PX - 1)
    near, far = edges.gather(2, left.long()), edges.gather(2, left.long() + 1)
    scores = (near + (column - left) * (far - near)).mean(dim=1)
    return _peak(scores - _PREFERENCE * factors.abs(), factors)


def _shifts_px(points: Float[Tensor, "rows points 2"]) -> Float[Tensor, "points 1"]:
    """By less than half a pixel for each point: what lies between whole pixels is interpolated, and has no peaks there.

    Shifted differently, points of one distance from the centre still show together where between pixels an edge lies.
    """
    number = torch.arange(points.shape[1], device=points.device, dtype=points.dtype)
    return (_GOLDEN * number % 1 - 0.5)[:, None]


def _edges(
    pictures: Tensor, pixels: Float[Tensor, "rows points 2"], across: Float[Tensor, "rows points 2"], side: int
) -> Float[Tensor, "rows points offsets"]:
    """How clear an edge is at each whole pixel from ``_REACH_PX`` inside to as far outside, 0 to 1."""
    reach = _REACH_PX + _WIDTH_PX
    offsets = torch.arange(-reach, reach + 1, device=pictures.device, dtype=pictures.dtype)
    places = pixels[:, :, None] + offsets[:, None] * across[:, :, None]
    border = 1 - 1 / pictures.shape[-1]
    grid = ((2 * places + 1) / side - 1).clamp(-border, border)  # as the grids of crop cameras
    colors = F.grid_sample(pictures, grid, align_corners=False)  # [rows, 3, points, offsets]
    strips = F.avg_pool2d(colors, (1, _WIDTH_PX), stride=1)
    difference = (strips[..., _WIDTH_PX + 1 :] - strips[..., : -_WIDTH_PX - 1]).square().sum(dim=1)
    return difference / (difference + _CLEAR)


def _peak(scores: Float[Tensor, "rows scales"], factors: Float[Tensor, " scales"]) -> Float[Tensor, " rows"]:
    """Where scores are highest: of the parabola through the highest one and its neighbours."""
    best = scores.argmax(dim=1, keepdim=True).clamp(1, scores.shape[1] - 2)
    before, here, after = (scores.gather(1, best + step)[:, 0] for step in (-1, 0, 1))
    bend = (2 * here - before - after).clamp(min=1e-6)
    return factors[best[:, 0]] + ((after - before) / (2 * bend)).clamp(-1, 1) * (factors[1] - factors[0])
