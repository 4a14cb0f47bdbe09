"""What render-and-compare compares: a crop of a picture, the background behind the object, and scenes in its camera."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix
from curio_train.refinement.inpainting import blurred
from curio_train.scene_code import LIGHT, ROTATION_6D, TRANSLATION, SceneCode

_SCALE = 0.09  # difference of sRGB colours at which a pixel pulls hardest


class Scene(NamedTuple):
    """What a crop shows, in the camera of that crop.

    Attributes:
        rotation: crop_from_obj, [batch, 3, 3].
        translation_m: [batch, 3].
        light: [batch, 3].
    """

    rotation: Tensor
    translation_m: Tensor
    light: Tensor

    def moved(self, moves: "Moves", diameter_m: float) -> "Scene":
        """The same after moves."""
        scale = moves.log_depth.exp()
        across, depth = self.translation_m[:, :2] + moves.across * diameter_m, self.translation_m[:, 2:]
        place = torch.cat([across * scale, depth * scale], dim=1)
        return Scene(rotation_from_vector(moves.turn) @ self.rotation, place, self.light + moves.light)


@dataclass(frozen=True, eq=False)
class Moves:
    """What changes of a scene.

    Attributes:
        across: [batch, 2], diameters.
        log_depth: [batch, 1].
        turn: [batch, 3], rotation vector, radians.
        light: [batch, 3].
    """

    across: Tensor
    log_depth: Tensor
    turn: Tensor
    light: Tensor

    @staticmethod
    def none(count: int) -> "Moves":
        return Moves(*(torch.zeros(count, size, requires_grad=True) for size in (2, 1, 3, 3)))


@dataclass(frozen=True, eq=False)
class View:
    """Crops, and how estimates lie in them.

    Attributes:
        crops: [batch, 3, side, side].
        behind: The same without the object.
        region: [batch, 1, side, side], where they are compared: 1 inside and around the silhouette, else 0.
        crop_from_cam: [batch, 3, 3].
        matrices: K of each crop.
        color: Of unpainted objects, [batch, 1, 3].
        times_blurred: How often crops and backgrounds are.
    """

    crops: Tensor
    behind: Tensor
    region: Tensor
    crop_from_cam: Tensor
    matrices: np.ndarray
    color: Tensor | None
    times_blurred: int

    def scene(self, code: SceneCode) -> Scene:
        """A code in the camera of the crop."""
        rotation = self.crop_from_cam @ matrix_from_rotation_6d(code[ROTATION_6D][:, 0])
        place, light = (self.crop_from_cam @ of_frame[..., None] for of_frame in (code[TRANSLATION][:, 0], code[LIGHT]))
        return Scene(rotation, place[..., 0], light[..., 0].float())

    def code(self, scene: Scene) -> dict[str, Tensor]:
        """A scene in the frame's camera."""
        back = self.crop_from_cam.transpose(1, 2)
        return {
            TRANSLATION: (back @ scene.translation_m[..., None]).transpose(1, 2),
            ROTATION_6D: rotation_6d_from_matrix(back @ scene.rotation)[:, None],
            LIGHT: (back @ scene.light[..., None])[..., 0],
        }

    def over(self, behind: Tensor, region: Tensor) -> "View":
        """The same before another background."""
        return View(**(vars(self) | {"behind": behind, "region": region}))

    def blurred(self, times: int) -> "View":
        """The same, blurred."""
        crops, behind = self.crops, self.behind
        for _ in range(times):
            crops, behind = blurred(crops), blurred(behind)
        return View(**(vars(self) | {"crops": crops, "behind": behind, "times_blurred": times}))

    def missed(self, images: Tensor) -> Float[Tensor, "batch 1 side side"]:
        """Robust difference between images and crops, 0 to 1 a pixel; 0 outside the region."""
        squared = ((images - self.crops) / _SCALE).square().sum(1, keepdim=True)
        return squared / (squared + 1) * self.region

    def explained(self, missed: Tensor) -> Float[Tensor, " batch"]:
        """By how much less is missed than by the background alone, pixels."""
        return (self.missed(self.behind) - missed).clamp(min=0).sum((1, 2, 3))

    def share(self, missed: Tensor) -> Float[Tensor, " batch"]:
        """Its mean over the region."""
        return missed.sum((1, 2, 3)) / self.region.sum((1, 2, 3)).clamp(min=1)


def rotation_from_vector(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rodrigues' formula; the gradient is finite at 0."""
    angle = (vector.square().sum(-1) + 1e-12).sqrt()[..., None, None]
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    identity = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return identity + angle.sin() / angle * cross + (1 - angle.cos()) / angle.square() * (cross @ cross)
