"""Circles: one red 2D circle of constant radius on black (paper, section "Analysis"; two degrees of freedom).

The paper gives no numbers. Ours were fixed before any training:

* radius 0.1 image widths: large enough to be the picture's subject (3 % of its pixels), small enough that an untrained
  network, which predicts the centre, overlaps only the fifth of the circles that lie within two radii of it;
* positions uniform on [-0.4, 0.4]², so that the circle is always whole inside the frame, up to its very edge.

The head is the paper's: three unbounded outputs. The range of the third is the point 0, so z is always 0.
"""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.scene_code import TRANSLATION, Field, Layout, SceneCode
from curio_train.worlds.base import Camera, ObjectKind, Split, World
from curio_train.worlds.image_sets import StoredImages, stored
from curio_train.worlds.options import CirclesOptions

SIDE_PX = 128
RADIUS = 0.1
REACH = 0.5 - RADIUS
COLOR_SRGB = (1.0, 0.0, 0.0)


class Circles(World):
    """The world of one circle; lengths in image widths from the image's centre, x right, y down."""

    name = "circles"
    layout = Layout(
        (
            Field(
                TRANSLATION,
                3,
                unit="image_width",
                frame="image",
                activation="linear",
                lower=(-REACH, -REACH, 0.0),
                upper=(REACH, REACH, 0.0),
            ),
        )
    )
    camera = Camera(SIDE_PX, SIDE_PX)
    objects = (
        ObjectKind(
            "circle",
            slots=(0,),
            diameter_m=2 * RADIUS,
            box_corners_m=np.array(
                [(x, y, 0.0) for _ in range(2) for x in (-RADIUS, RADIUS) for y in (-RADIUS, RADIUS)]
            ),
        ),
    )

    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        """Uniform positions; z is 0."""
        position = np.zeros((count, 1, 3), np.float32)
        position[..., :2] = np.random.default_rng(seed).uniform(-REACH, REACH, (count, 1, 2))
        return {TRANSLATION: torch.from_numpy(position)}

    def render(self, code: SceneCode, backgrounds: Tensor | None = None) -> Tensor:
        """The circles over black, or over ``backgrounds``."""
        alpha = coverage(code[TRANSLATION][:, 0, :2])[:, None]
        color = alpha.new_tensor(COLOR_SRGB).view(1, 3, 1, 1)
        return alpha * color if backgrounds is None else torch.lerp(backgrounds, color.expand_as(backgrounds), alpha)

    def source(self, split: Split, seed: int, *, with_code: bool, cache: Path) -> StoredImages:
        """2,000, 500 and 500 images, the paper's numbers."""
        recipe = {"radius": RADIUS, "reach": REACH, "side": SIDE_PX, "color": COLOR_SRGB}
        return stored(self, recipe, split, seed, with_code=with_code, cache=cache)


def coverage(centre: Float[Tensor, "batch 2"]) -> Float[Tensor, "batch height width"]:
    """Share of each pixel that the circle covers.

    A pixel whose centre is d pixels inside the edge is covered by d + 1/2, within 0 and 1: exact for a straight edge
    along the pixel grid, 0.04 off at worst for a slanted one. The derivative is that of the same ramp, one pixel wide,
    so image gradients reach the position from the edge and from nowhere else.
    """
    axis = (torch.arange(SIDE_PX, device=centre.device, dtype=centre.dtype) - (SIDE_PX - 1) / 2) / SIDE_PX
    x, y = axis - centre[:, :1], axis - centre[:, 1:]
    squared = x.square()[:, None, :] + y.square()[:, :, None]
    distance = squared.clamp_min(1e-12).sqrt()  # at 0 the root's own derivative is infinite
    return ((RADIUS - distance) * SIDE_PX + 0.5).clamp(0, 1)


def build(options: CirclesOptions) -> Circles:
    """The only circles there are."""
    return Circles()
