"""Crops of frames around pose estimates, for render-and-compare and pseudo-labels."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix
from curio_train.refinement.inpainting import blurred
from curio_train.scene_code import LIGHT, ROTATION_6D, TRANSLATION, SceneCode

_RESIDUAL_SCALE = 0.09  # difference of sRGB colours at which the gradient is strongest


@dataclass(frozen=True, eq=False)
class PoseUpdate:
    """A change of pose and light, the parameters that render-and-compare optimises."""

    across: Float[Tensor, "batch 2"]
    """Translation across the view, diameters."""
    log_depth: Float[Tensor, "batch 1"]
    """Logarithm of the factor on the distance."""
    rotation_vector: Float[Tensor, "batch 3"]
    """Rotation vector, radians."""
    light: Float[Tensor, "batch 3"]
    """Change of the light."""

    @staticmethod
    def zero(count: int) -> "PoseUpdate":
        """No change, with gradients."""
        return PoseUpdate(*(torch.zeros(count, size, requires_grad=True) for size in (2, 1, 3, 3)))


class PoseAndLight(NamedTuple):
    """Pose and light in the frames of the crop cameras."""

    rotation: Float[Tensor, "batch 3 3"]
    """crop_from_obj."""
    translation_m: Float[Tensor, "batch 3"]
    """crop_from_obj."""
    light: Float[Tensor, "batch 3"]
    """Towards the light; its length is the strength."""

    def updated(self, update: PoseUpdate, diameter_m: float) -> "PoseAndLight":
        """Pose and light after an update."""
        scale = update.log_depth.exp()
        across, depth = self.translation_m[:, :2] + update.across * diameter_m, self.translation_m[:, 2:]
        translation_m = torch.cat([across * scale, depth * scale], dim=1)
        rotation = rotation_from_vector(update.rotation_vector) @ self.rotation
        return PoseAndLight(rotation, translation_m, self.light + update.light)


@dataclass(frozen=True, eq=False)
class Crops:
    """A batch of crops around estimates, with the object's background inpainted."""

    images: Float[Tensor, "batch 3 side side"]
    """The crops."""
    backgrounds: Float[Tensor, "batch 3 side side"]
    """The crops without the object."""
    mask: Float[Tensor, "batch 1 side side"]
    """1 inside and around the silhouette, where crops and renderings are compared; else 0."""
    crop_from_cam: Float[Tensor, "batch 3 3"]
    """Rotations from the frame's camera to the crops'."""
    matrices: Float[np.ndarray, "batch 3 3"]
    """K of each crop."""
    color: Float[Tensor, "batch 1 3"] | None
    """Base colour of unpainted objects."""
    times_blurred: int = 0
    """How often images and backgrounds have been blurred."""

    def from_code(self, code: SceneCode) -> PoseAndLight:
        """Pose and light of a scene code, from the frame's camera to the crops'."""
        rotation = self.crop_from_cam @ matrix_from_rotation_6d(code[ROTATION_6D][:, 0])
        translation_m, light = (
            (self.crop_from_cam @ vector[..., None])[..., 0] for vector in (code[TRANSLATION][:, 0], code[LIGHT])
        )
        return PoseAndLight(rotation, translation_m, light.float())

    def to_code(self, estimate: PoseAndLight) -> dict[str, Tensor]:
        """The entries of the scene code, in the frame's camera."""
        cam_from_crop = self.crop_from_cam.transpose(1, 2)
        return {
            TRANSLATION: (cam_from_crop @ estimate.translation_m[..., None]).transpose(1, 2),
            ROTATION_6D: rotation_6d_from_matrix(cam_from_crop @ estimate.rotation)[:, None],
            LIGHT: (cam_from_crop @ estimate.light[..., None])[..., 0],
        }

    def blurred(self, times: int) -> "Crops":
        """These crops, blurred."""
        images, backgrounds = self.images, self.backgrounds
        for _ in range(times):
            images, backgrounds = blurred(images), blurred(backgrounds)
        return replace(self, images=images, backgrounds=backgrounds, times_blurred=times)

    def residual(self, renderings: Float[Tensor, "batch 3 side side"]) -> Float[Tensor, "batch 1 side side"]:
        """Robust photometric residual of each pixel, 0 to 1 (Geman and McClure 1987); 0 outside the mask."""
        squared = ((renderings - self.images) / _RESIDUAL_SCALE).square().sum(1, keepdim=True)
        return squared / (squared + 1) * self.mask

    def mean_residual(self, residual: Float[Tensor, "batch 1 side side"]) -> Float[Tensor, " batch"]:
        """Mean over the mask."""
        return residual.sum((1, 2, 3)) / self.mask.sum((1, 2, 3)).clamp(min=1)

    def inlier_pixels(self, residual: Float[Tensor, "batch 1 side side"]) -> Float[Tensor, " batch"]:
        """Sum over pixels of how much smaller the residual is than that of the background alone."""
        return (self.residual(self.backgrounds) - residual).clamp(min=0).sum((1, 2, 3))


def rotation_from_vector(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rodrigues' formula; the gradient is finite at 0."""
    angle = (vector.square().sum(-1) + 1e-12).sqrt()[..., None, None]
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    identity = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return identity + angle.sin() / angle * cross + (1 - angle.cos()) / angle.square() * (cross @ cross)
