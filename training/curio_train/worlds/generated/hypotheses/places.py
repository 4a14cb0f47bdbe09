"""Places on the ground, and crops of images around them."""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from curio_train.scene_code import TRANSLATION
from curio_train.worlds.generated.mesh_world import MeshWorld

SIDE = 24
"""Side of a crop, pixels in the middle of the ground; the worlds' objects are 15 to 20 pixels high and wide."""

_STEP_M = 0.06  # between places
_CLOSENESS = 0.9  # of two objects, in sums of the smallest radius: places are off by half a step


class Places:
    """A square grid of places on the ground of a world, row after row, and how its camera sees them."""

    positions: Float[Tensor, "places 3"]
    """World frame, metres."""
    scales: Float[Tensor, " places"]
    """How large objects are there, in sizes in the middle of the ground."""
    turns: Float[Tensor, " places"]
    """Yaw, radians, that an object must be turned by to look as it does in the middle of the ground."""

    def __init__(self, world: MeshWorld, height_m: float) -> None:
        """Lay the places.

        Args:
            world: With objects on the ground.
            height_m: Of the middle of an object above the ground.
        """
        self._world, self._height_m = world, height_m
        self._closest_m = _CLOSENESS * 2 * min(world.radii_m)
        field, middle = world.layout[TRANSLATION], torch.zeros(1, 3)
        axes = [torch.arange(field.lower[axis], field.upper[axis] + _STEP_M / 2, _STEP_M) for axis in (0, 2)]
        x, z = torch.meshgrid(*axes, indexing="ij")
        self.positions = torch.stack([x, torch.zeros_like(x), z], dim=-1).flatten(0, 1)
        self.scales = self._depth(middle) / self._depth(self.positions)
        self.turns = self._bearing(self.positions) - self._bearing(middle)
        self._pixels, self._middle = self._seen(self.positions), self._seen(middle)

    def cut(
        self, image: Float[Tensor, "channels height width"], places: Int[Tensor, " places"] | slice = slice(None)
    ) -> Float[Tensor, "places channels area"]:
        """Crops of ``SIDE`` times ``SIDE`` pixels around places, enlarged by one over their scales."""
        return _cut(image, self._pixels[places], self.scales[places])

    def cut_middle(self, image: Float[Tensor, "channels height width"]) -> Float[Tensor, "channels area"]:
        """The crop around the middle of the ground."""
        return _cut(image, self._middle, torch.ones(1))[0]

    def paste(self, crop: Float[Tensor, " area"], place: int) -> Float[Tensor, "1 height width"]:
        """The crop of one channel, put back where it is at a place; 0 around it."""
        width, height = self._world.camera.width, self._world.camera.height
        reach = self.scales[place] * (SIDE - 1) / 2
        x = (torch.arange(width) - self._pixels[place, 0]) / reach
        y = (torch.arange(height) - self._pixels[place, 1])[:, None] / reach
        grid = torch.stack(torch.broadcast_tensors(x, y), dim=-1)[None]
        return F.grid_sample(crop.view(1, 1, SIDE, SIDE), grid, align_corners=True)[0]

    def peaks(self, improvements: Float[Tensor, " places"], count: int) -> Int[Tensor, " peaks"]:
        """Places that are better than their neighbours, the best first, and after them the best of the others."""
        side = math.isqrt(len(improvements))
        around = F.max_pool2d(improvements.view(1, side, side), 3, 1, 1).flatten()
        lead = (improvements >= around) * (improvements.max() - improvements.min() + 1)
        return (improvements + lead).topk(min(count, len(improvements))).indices

    def near(self, position: Float[Tensor, " 3"], places: Int[Tensor, " places"]) -> Bool[Tensor, " places"]:
        """Whether an object at the places would touch one at the position."""
        return (self.positions[places] - position).norm(dim=1) < self._closest_m

    def nearest(self, position: Float[Tensor, " 3"]) -> int:
        """Number of the place nearest to a position."""
        return int((self.positions - position).norm(dim=1).argmin())

    def _seen(self, position: Float[Tensor, "places 3"]) -> Float[Tensor, "places 2"]:
        """Pixels of the middles of objects that stand at positions."""
        return self._world.grid.project(self._raised(position))

    def _depth(self, position: Float[Tensor, "places 3"]) -> Float[Tensor, " places"]:
        return self._world.setup.cam_from_world.to(position).apply(self._raised(position))[:, 2]

    def _raised(self, position: Float[Tensor, "places 3"]) -> Float[Tensor, "places 3"]:
        return position + position.new_tensor([0.0, self._height_m, 0.0])

    def _bearing(self, position: Float[Tensor, "places 3"]) -> Float[Tensor, " places"]:
        """Angle about y of the camera's ray to positions."""
        rotation, translation_m = self._world.setup.cam_from_world.to(position)
        ray = position + translation_m @ rotation
        return torch.atan2(ray[:, 0], ray[:, 2])


def _cut(
    image: Float[Tensor, "channels height width"], pixels: Float[Tensor, "places 2"], scales: Float[Tensor, " places"]
) -> Float[Tensor, "places channels area"]:
    steps = torch.arange(SIDE) - (SIDE - 1) / 2
    x = pixels[:, 0, None, None] + scales[:, None, None] * steps
    y = pixels[:, 1, None, None] + scales[:, None, None] * steps[:, None]
    grid = torch.stack(torch.broadcast_tensors(x, y), dim=-1).flatten(1, 2)
    size = grid.new_tensor([image.shape[2] - 1, image.shape[1] - 1])
    cut = F.grid_sample(image[None], (grid / size * 2 - 1)[None], padding_mode="border", align_corners=True)
    return cut[0].transpose(0, 1)
