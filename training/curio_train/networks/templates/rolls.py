"""How crop cameras are rolled so that objects stand in their pictures as they do in templates.

Features do not turn with a picture. An object that leans between two templates is therefore read worse than one that
leans as a template does.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.geometry import rotation_between
from curio_train.networks.crop_camera import about_axis
from curio_train.networks.templates.geometry import MAX_ROLL_DEG, NUM_ROLLS

ROLLS_DEG = (-2 * MAX_ROLL_DEG / NUM_ROLLS, 0.0, 2 * MAX_ROLL_DEG / NUM_ROLLS)
"""Rolls away from upright; templates show exactly these."""


def upright_rolls(
    position: Float[Tensor, "places 3"], upward: Float[Tensor, "places 3"], rolls_deg: Sequence[float] = ROLLS_DEG
) -> Float[Tensor, "places*rolls 3 3"]:
    """Rotations about the optical axis that show objects rolled by ``rolls_deg``, one roll after the other.

    Args:
        position: Of the objects, camera frame of the image, any unit.
        upward: Their z axes, camera frame of the image.
        rolls_deg: From where objects stand upright.
    """
    axis = position.new_tensor([0.0, 0.0, 1.0]).expand_as(position)
    x, y = (rotation_between(position, axis) @ upward[..., None])[:, :2, 0].unbind(1)
    length = (x.square() + y.square()).clamp(min=1e-12).sqrt()
    upright = about_axis(torch.stack([-y / length, -x / length], dim=1))
    angles = torch.tensor(rolls_deg, device=position.device).deg2rad()
    further = about_axis(torch.stack([angles.cos(), angles.sin()], dim=1))
    return (further @ upright[:, None]).flatten(0, 1)
