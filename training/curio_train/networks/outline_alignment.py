"""A pose aligned with a photograph by the object's outline: no rendering, six unknowns.

What a network reads from a crop of 64 pixels is off by a per cent of the distance, and that is most of the error of an
object without texture. Its outline tells more: points of it are projected, the clearest edge is looked for across the
outline at each, and the pose moves to where the points lie on the edges (Harris and Stennett 1990, "RAPID"; Drummond
and Cipolla 2002). An edge is where a colour changes to which the two sides differ most: the linear discriminant of the
colours inside and outside, of each crop anew, in linear light, in which a pixel that shows both is their mean.

All of it is plain tensor arithmetic, so that it can be part of an exported graph.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from curio_serve.models.stages.outline_stage import INPUTS, OUTPUTS, OutlineStageNote
from jaxtyping import Float, Int
from torch import Tensor, nn

from curio_train.color import linear_from_srgb
from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix
from curio_train.networks.crop_camera import cut_crops
from curio_train.networks.pose_steps import solve, turn
from curio_train.scene_code import ROTATION_6D, TRANSLATION

NUM_POINTS = 160
"""Points of the outline in each direction."""

_SIDE, _FILL = 128, 0.6  # of crops, pixels, and the share of it that the diameter spans
_REACHES_PX = (8.0, 6.0, 4.0, 3.0)  # to each side of the outline, in which edges are looked for, round after round
_STEP_PX = 0.5
_NEAR_PX, _FAR_PX = 1.5, 7.5  # from the outline: the strips whose colours are inside and outside
_NOISE = 2e-4  # added to the variance of colours
_INDISTINCT = 0.01  # squared distance of the two sides' colours, in their deviations, at which edges count a half
_CLEARNESS = 12.0  # by how much an edge is likelier than none, where all of the discriminant changes within a pixel
_PRIOR_SPREAD = 0.7  # of how far edges are from the outline, reaches
_EDGE_PX = 1.0  # standard deviation of where a clear edge is found
_OUTLIER_PX = 1.6  # at which an edge counts a quarter, in the last rounds (Geman and McClure 1985)
_WIDEST_OUTLIER = 4.0  # pixels of reach up to which outliers are as near
_NUM_REWEIGHTED = 2
_SHORTEST = 1e-12
_SPREAD = (0.105, 0.015, 0.0225)  # of the network's rotation, radians; of log distance; across the view, diameters


class OutlinePose(NamedTuple):
    """Poses in the camera of the image, or of a crop."""

    rotation: Float[Tensor, "batch 3 3"]
    """cam_from_obj."""
    position: Float[Tensor, "batch 3"]
    """Position of the object, diameters."""


class _Crops(NamedTuple):
    """Crops in which poses are aligned."""

    crops: Float[Tensor, "batch 3 side side"]
    """SRGB in [0, 1], around the objects."""
    focal_px: Float[Tensor, " batch"]
    """Focal lengths of the crops' cameras, whose principal points are their middles."""
    pose: OutlinePose
    """Poses in these cameras, before the alignment."""
    crop_from_cam: Float[Tensor, "batch 3 3"]
    """Rotations from the images' camera."""

    def in_frame(self, pose: OutlinePose) -> OutlinePose:
        """Poses in the camera of the images."""
        return _turned(self.crop_from_cam.transpose(1, 2), pose)


class _Edges(NamedTuple):
    """The clearest edge across each point of an outline."""

    distance_px: Float[Tensor, "batch points"]
    """Distance of the edge from the outline, outwards."""
    weight: Float[Tensor, "batch points"]
    """Inverse of its variance; 0 where no edge is seen."""


class OutlineAlignment(nn.Module):
    """The outline of an object, or of several, in each viewing direction, and how a pose is aligned by it."""

    directions: Tensor
    """From the camera to the object, object frame, [directions, 3]; those of several [objects, directions, 3]."""
    points: Tensor
    """Points on the surface, object frame, diameters, [directions, points, 3]; those of several [objects, …]."""
    outward: Tensor
    """Unit vectors across the line of sight, object frame, of the same shape."""
    _prior: Tensor

    def __init__(self, num_directions: int, num_objects: int | None = None) -> None:
        """Build with outlines that are still empty.

        Args:
            num_directions: Of each object.
            num_objects: None: one, whose outlines have no dimension for objects.
        """
        super().__init__()
        several = () if num_objects is None else (num_objects,)
        for name, shape in {
            "directions": (num_directions, 3),
            "points": (num_directions, NUM_POINTS, 3),
            "outward": (num_directions, NUM_POINTS, 3),
        }.items():
            self.register_buffer(name, torch.zeros(*several, *shape))
        turned, log_distance, shifted = (1 / spread**2 for spread in _SPREAD)
        prior = torch.tensor([turned] * 3 + [log_distance] + [shifted] * 2)
        self.register_buffer("_prior", prior, persistent=False)

    def put(self, directions: Tensor, points: Tensor, outward: Tensor, number: int | None = None) -> None:
        """Keep the outlines of an object, in numbers that half precision holds; of several that of a number."""
        for buffer, values in ((self.directions, directions), (self.points, points), (self.outward, outward)):
            (buffer if number is None else buffer[number]).copy_(values.half())

    def of_code(
        self,
        images: Float[Tensor, "batch 3 height width"],
        matrix: Float[Tensor, "3 3"],
        code: dict[str, Tensor],
        diameter_m: float,
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """A code of one object, metres and 6D rotation [batch, 1, …], with its pose where the outline lies on edges.

        Args:
            images: sRGB in [0, 1].
            matrix: K of the images.
            code: What was read: rotations right to some degrees, positions to some per cent.
            diameter_m: Of the object.

        Returns:
            The code, and the tensors at which the alignment can be cut out of an exported graph.
        """
        rotation, position_m = matrix_from_rotation_6d(code[ROTATION_6D][:, 0]), code[TRANSLATION][:, 0]
        position = position_m / diameter_m
        seen = _cut(images, matrix, OutlinePose(rotation, position), position[:, None])
        pose = self._in_crops(seen)
        in_frame = seen.in_frame(pose)
        aligned = {ROTATION_6D: rotation_6d_from_matrix(in_frame.rotation), TRANSLATION: diameter_m * in_frame.position}
        tensors = *(seen.crops, seen.focal_px), *seen.pose, *pose
        return code | {name: value[:, None] for name, value in aligned.items()}, dict(
            zip((*INPUTS, *OUTPUTS), tensors, strict=True)
        )

    def of_objects(
        self,
        images: Float[Tensor, "batch 3 height width"],
        matrix: Float[Tensor, "3 3"],
        code: dict[str, Tensor],
        diameter_m: Float[Tensor, " wanted"],
        objects: Int[Tensor, " wanted"],
    ) -> dict[str, Tensor]:
        """A code of several objects, metres and 6D rotation [batch, wanted, …], with its poses aligned.

        Args:
            images: sRGB in [0, 1].
            matrix: K of the images.
            code: What was read.
            diameter_m: Of each object that the code has.
            objects: Which ones these are.
        """
        position = code[TRANSLATION] / diameter_m[:, None]
        rotation = matrix_from_rotation_6d(code[ROTATION_6D]).flatten(0, 1)
        seen = _cut(images, matrix, OutlinePose(rotation, position.flatten(0, 1)), position)
        found = seen.in_frame(self._in_crops(seen, objects.expand(position.shape[:2]).flatten()))
        aligned = rotation_6d_from_matrix(found.rotation), found.position
        rotation_6d, position = (values.unflatten(0, position.shape[:2]) for values in aligned)
        return code | {ROTATION_6D: rotation_6d, TRANSLATION: position * diameter_m[:, None]}

    def note(self, tensors: dict[str, str], diameter_m: float) -> OutlineStageNote:
        """The numbers that serving needs to run the alignment alone.

        Args:
            tensors: Names in the exported graph of what :meth:`of_code` gives beside the code.
            diameter_m: Of the object.
        """
        return OutlineStageNote(tensors, _SIDE, _FILL, diameter_m)

    def _in_crops(self, seen: _Crops, objects: Int[Tensor, " batch"] | None = None) -> OutlinePose:
        """The poses in the crops' cameras, aligned; each crop's object where there are several."""
        colors, pose = linear_from_srgb(seen.crops), seen.pose
        # Nothing here may take its shape from the images, which are not there where this is cut out of a graph.
        moved = torch.cat([pose.position, pose.position], dim=1) * 0
        for reach in _REACHES_PX:
            pose, moved = self._round(colors, seen.focal_px, pose, moved, reach, objects)
        return pose

    def _nearest(
        self, sight: Float[Tensor, "batch 3"], objects: Int[Tensor, " batch"] | None
    ) -> tuple[Float[Tensor, "batch points 3"], Float[Tensor, "batch points 3"]]:
        """Points and outward vectors of the outlines nearest to lines of sight, object frame."""
        if objects is None:
            view = (sight @ self.directions.T).argmax(dim=1)
            return self.points[view], self.outward[view]
        view = (self.directions[objects] @ sight[..., None])[..., 0].argmax(dim=1)
        return self.points[objects, view], self.outward[objects, view]

    def _round(
        self,
        colors: Tensor,
        focal_px: Tensor,
        pose: OutlinePose,
        moved: Float[Tensor, "batch 6"],
        reach: float,
        objects: Int[Tensor, " batch"] | None,
    ) -> tuple[OutlinePose, Float[Tensor, "batch 6"]]:
        """One look for edges, and the pose that fits them and the network's own best."""
        turned = pose.rotation.transpose(1, 2)
        points, outward = self._nearest((turned @ pose.position[..., None])[..., 0], objects)
        arm = points @ turned
        seen = arm + pose.position[:, None]
        depth = seen[..., 2:].clamp(min=1e-3)
        slope, along = seen[..., :2] / depth, outward @ turned
        across = along[..., :2] - slope * along[..., 2:]
        across = across / across.norm(dim=-1, keepdim=True).clamp(min=_SHORTEST)
        scale = focal_px[:, None, None]
        edges = _find(colors, scale * slope + (_SIDE - 1) / 2, across, reach)
        by_point = torch.cat([across, -(across * slope).sum(dim=-1, keepdim=True)], dim=-1) * scale / depth
        jacobian = torch.cat(
            [
                torch.linalg.cross(arm, by_point),
                (by_point * pose.position[:, None]).sum(dim=-1, keepdim=True),
                by_point[..., :2],
            ],
            dim=-1,
        )
        step = self._step(jacobian, edges, moved, _OUTLIER_PX * max(1.0, reach / _WIDEST_OUTLIER))
        shifted = torch.cat([pose.position[:, :2] + step[:, 4:], pose.position[:, 2:]], dim=1)
        return OutlinePose(turn(step[:, :3]) @ pose.rotation, shifted * step[:, 3:4].exp()), moved + step

    def _step(
        self, jacobian: Float[Tensor, "batch points 6"], edges: _Edges, moved: Tensor, outlier_px: float
    ) -> Float[Tensor, "batch 6"]:
        """Rotation vector, logarithm of the distance, and shift across the view, diameters."""
        residual, step = edges.distance_px, moved
        for _ in range(_NUM_REWEIGHTED):
            weight = edges.weight / (1 + (residual / outlier_px).square()).square()
            weighted = jacobian * weight[..., None]
            hessian = weighted.transpose(1, 2) @ jacobian + torch.diag(self._prior)
            slope = (weighted * edges.distance_px[..., None]).sum(dim=1) - self._prior * moved
            step = solve(hessian, slope)
            residual = edges.distance_px - (jacobian @ step[..., None])[..., 0]
        return step


def _cut(images: Tensor, matrix: Tensor, pose: OutlinePose, position: Float[Tensor, "images num 3"]) -> _Crops:
    """Crops around poses, whose positions are given image by image, too."""
    focal_px = _FILL * _SIDE * pose.position.norm(dim=1)
    crops, crop_from_cam = cut_crops(images, matrix, position, focal_px, _SIDE)
    return _Crops(crops, focal_px, _turned(crop_from_cam, pose), crop_from_cam)


def _turned(rotation: Float[Tensor, "batch 3 3"], pose: OutlinePose) -> OutlinePose:
    return OutlinePose(rotation @ pose.rotation, (rotation @ pose.position[..., None])[..., 0])


def _offsets(reach: float) -> Tensor:
    count = round(reach / _STEP_PX)
    return torch.arange(-count, count + 1) * _STEP_PX


def _find(
    colors: Float[Tensor, "batch 3 side side"],
    pixels: Float[Tensor, "batch points 2"],
    across: Float[Tensor, "batch points 2"],
    reach: float,
) -> _Edges:
    """The mean place of the edge across each point, weighted by how likely it is there."""
    far = reach + 3
    offsets = _offsets(far).to(colors)
    places = pixels[:, :, None] + offsets[:, None] * across[:, :, None]
    border = 1 - 1 / colors.shape[-1]
    grid = ((2 * places + 1) / colors.shape[-1] - 1).clamp(-border, border)
    profiles = F.grid_sample(colors, grid, align_corners=False)  # [batch, 3, points, offsets]
    told = _discriminant(profiles)
    wide, count = round(far / _STEP_PX) - round(reach / _STEP_PX), len(offsets)
    inner, outer = told[..., wide - 1 : count - wide - 1], told[..., wide + 1 : count - wide + 1]
    candidates = _offsets(reach).to(colors)
    likely = _CLEARNESS * (inner - outer).clamp(min=0) - (candidates / (_PRIOR_SPREAD * reach)).square() / 2
    share = likely.softmax(dim=-1)
    distance = (share * candidates).sum(dim=-1)
    variance = (share * (candidates - distance[..., None]).square()).sum(dim=-1)
    seen = (1 - variance / candidates.square().mean()).clamp(min=0)
    return _Edges(distance, seen / (variance + _EDGE_PX**2))


def _discriminant(profiles: Float[Tensor, "batch 3 points offsets"]) -> Float[Tensor, "batch points offsets"]:
    """The linear discriminant of the colours inside and outside (Fisher 1936); their means differ by 1 at most."""
    middle = profiles.shape[3] // 2
    nearest, farthest = round(_NEAR_PX / _STEP_PX), min(round(_FAR_PX / _STEP_PX) - 1, middle)
    (mean_in, spread_in), (mean_out, spread_out) = (
        _mean_and_spread(profiles.narrow(3, first, farthest - nearest))
        for first in (middle - farthest, middle + nearest + 1)
    )
    apart = mean_in - mean_out
    weights = solve((spread_in + spread_out) / 2, apart)
    length = (weights * apart).sum(dim=1) + _INDISTINCT
    return (profiles * (weights / length[:, None])[:, :, None, None]).sum(dim=1)


def _mean_and_spread(
    colors: Float[Tensor, "batch 3 points offsets"],
) -> tuple[Float[Tensor, "batch 3"], Float[Tensor, "batch 3 3"]]:
    flat = colors.flatten(2)
    mean = flat.mean(dim=2)
    apart = flat - mean[..., None]
    noise = _NOISE * torch.eye(3, dtype=colors.dtype, device=colors.device)
    return mean, apart @ apart.transpose(1, 2) / flat.shape[2] + noise
