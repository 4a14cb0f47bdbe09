"""Templates drawn by the renderer, as the frame's camera shows the object, then sampled as a crop of a frame is."""

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from curio_train.meshes.meshes import Mesh
from curio_train.rendering.renderer import Renderer
from curio_train.worlds.single_object.viewpoints import AMBIENT

LOOKS = (((0.0, -0.7, -0.7), 1.0), ((0.7, -0.5, -0.5), 1.6), ((-0.7, -0.5, -0.5), 1.2), ((0.0, -0.2, -1.0), 0.8))
"""Lamps, and what colours are multiplied by: descriptors are means over these and over as many backgrounds."""

_BATCH = 64
_BORDER_PX = 4


class Drawn(NamedTuple):
    """Objects without a background.

    Attributes:
        color: sRGB over black, [templates, 3, side, side].
        alpha: What is covered of each pixel, [templates, 1, side, side].
    """

    color: Tensor
    alpha: Tensor

    def over(self, backgrounds: Float[Tensor, "#templates 3 side side"], exposure: float = 1.0) -> Tensor:
        """Pictures in [0, 1]."""
        return (exposure * self.color + (1 - self.alpha) * backgrounds).clamp(0, 1)


def draw(
    mesh: Mesh,
    rotations: Float[Tensor, "templates 3 3"],
    depth_m: float,
    focal_px: float,
    side: int,
    lamp: tuple[float, float, float] = LOOKS[0][0],
) -> Drawn:
    """The object on the optical axis of a camera whose principal point is the picture's middle.

    Raises:
        RendererError: The mesh cannot be rendered.
    """
    renderer = Renderer([mesh], [0], side, side, ambient=AMBIENT)
    middle = (side - 1) / 2
    matrix = np.array([[focal_px, 0, middle], [0, focal_px, middle], [0, 0, 1]])
    batches = []
    for some in rotations.split(_BATCH):
        count = len(some)
        over = [
            renderer(
                some[:, None],
                torch.tensor([0.0, 0.0, depth_m]).expand(count, 1, 3),
                camera_matrix=matrix,
                backgrounds=torch.full((count, 3, side, side), shade),
                light=torch.tensor(lamp).expand(count, 3),
            )
            for shade in (0.0, 1.0)
        ]
        batches.append(torch.cat([over[0], 1 - (over[1] - over[0]).mean(dim=1, keepdim=True)], dim=1))
    drawn = torch.cat(batches)
    return Drawn(drawn[:, :3], drawn[:, 3:])


def draw_as_crop(
    mesh: Mesh,
    rotations: Float[Tensor, "templates 3 3"],
    depth_m: float,
    focal_px: tuple[float, float],
    side: int,
    lamp: tuple[float, float, float],
) -> Drawn:
    """The object as a crop of a frame shows it: no sharper than the frame is.

    Args:
        mesh: The object.
        rotations: cam_from_obj.
        depth_m: Its distance.
        focal_px: Of the frame, and of the crop.
        side: Of the crop, pixels.
        lamp: Towards the light.
    """
    share = focal_px[0] / focal_px[1]  # frame pixels a crop pixel
    frame_side = 2 * int(np.ceil(side * share / 2)) + 2 * _BORDER_PX
    drawn = torch.cat(draw(mesh, rotations, depth_m, focal_px[0], frame_side, lamp), dim=1)
    steps = (torch.arange(2 * side) - (2 * side - 1) / 2) * share / frame_side
    grid = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=-1)[None]
    sampled = [
        F.avg_pool2d(F.grid_sample(some, grid.expand(len(some), -1, -1, -1), align_corners=False), 2)
        for some in drawn.split(_BATCH)
    ]
    found = torch.cat(sampled)
    return Drawn(found[:, :3], found[:, 3:])
