"""A level ground under the objects: a plane of one colour, lit like everything else."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.color import linear_from_srgb, srgb_from_linear


@dataclass(frozen=True, eq=False)
class Ground:
    """A plane as a camera above it sees it; it fills the whole image, also above the horizon."""

    up: np.ndarray
    """Unit normal of the ground [3], camera frame."""
    camera_height_m: float
    """Height of the camera above the ground, metres."""
    albedo_srgb: float
    """Grey, in [0, 1]."""

    def image(
        self, ambient: float, light: Float[Tensor, "batch 3"], shadow: Float[Tensor, "batch 1 height width"]
    ) -> Float[Tensor, "batch 3 height width"]:
        """Image of the ground in sRGB: albedo · (ambient + max(0, n·l)) where no shadow falls.

        Args:
            ambient: Radiance from everywhere; it knows no shadows.
            light: Camera frame, towards the light; its length is the strength.
            shadow: Fraction of each pixel that no light reaches.
        """
        albedo = linear_from_srgb(light.new_tensor(self.albedo_srgb))
        sun = (light @ torch.as_tensor(self.up).to(light)).clamp(min=0)
        lit, dark = srgb_from_linear(albedo * (ambient + sun)), srgb_from_linear(albedo * ambient)
        lit = lit.view(-1, 1, 1, 1)
        return (lit + shadow * (dark - lit)).expand(-1, 3, -1, -1)
