"""Renderings of every kind of object in many yaws under one sun, compared with an image at every place.

The colour with the least error has a closed form, so one comparison is a few matrix products. A hypothesis is rendered
in the middle of the ground. At other places it is scaled by the distance, and turned with the ray; perspective inside
of an object, and objects' shades on each other, are neglected.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, TRANSLATION, YAW
from curio_train.worlds.generated.hypotheses.places import Places
from curio_train.worlds.generated.mesh_world import MeshWorld

NUM_YAWS = 24
YAWS = torch.arange(NUM_YAWS) * (2 * math.pi / NUM_YAWS)
"""Yaws of hypotheses, radians, as seen in the middle of the ground."""

COLOR_RANGE = 0.02, 0.98
"""Range of found colours: sRGB is steep at 0, and the network's sigmoid at both ends."""

_COVERED = 0.5  # coverage from which a pixel is the object's
_LEAST_POWER = 1e-2


class Bank:
    """Crops of all kinds in all yaws, kind after kind."""

    masks: Float[Tensor, "hypotheses area"]
    """1 where a crop shows the object."""

    def __init__(self, world: MeshWorld, places: Places, sun: Float[Tensor, " 2"] | None) -> None:
        """Render the hypotheses.

        Args:
            world: With yaws.
            places: Where they are compared.
            sun: Entry ``LIGHT`` of the scene code, if the world's code has one.
        """
        self._world, self._places, self._sun = world, places, sun
        shades, masks = zip(*map(self._draw, range(len(world.objects))), strict=True)
        self._shades, self.masks = torch.cat(shades), torch.cat(masks)

    def improvements(
        self,
        pixels: Float[Tensor, "places 3 area"],
        errors: Float[Tensor, "places 1 area"],
        weights: Float[Tensor, "places 1 area"],
        scales: Float[Tensor, " places"],
    ) -> Float[Tensor, "places hypotheses"]:
        """Squared error that each hypothesis in its best colour explains better than what is behind it.

        Args:
            pixels: Crops of the image.
            errors: Squared error of what is behind, a sum over the channels.
            weights: 1 for pixels that count.
            scales: Of the places.
        """
        behind = ((errors - pixels.square().sum(dim=1, keepdim=True)) * weights)[:, 0] @ self.masks.T
        gains = [
            self._gain((pixels[:, c] * weights[:, 0]) @ shades.T, weights[:, 0] @ shades.square().T)
            for c, shades in enumerate(self._shades.unbind(dim=1))
        ]
        improvements: Tensor = (behind + torch.stack(gains).sum(dim=0)) * scales.square()[:, None]
        return improvements

    def colors(
        self,
        hypotheses: Int[Tensor, " some"],
        pixels: Float[Tensor, "3 area"],
        weights: Float[Tensor, "1 area"],
    ) -> Float[Tensor, "some 3"]:
        """The colour, sRGB, with which each of the hypotheses has the least error."""
        shades = self._shades[hypotheses] * weights
        power = (shades * self._shades[hypotheses]).sum(dim=2) + _LEAST_POWER
        return ((shades * pixels).sum(dim=2) / power).clamp(*COLOR_RANGE)

    def _gain(self, product: Tensor, power: Tensor) -> Tensor:
        """Largest value of 2 c · product - c² · power; c, the colour, is free or 1."""
        if COLOR in self._world.layout:
            return product.square() / (power + _LEAST_POWER)
        return 2 * product - power

    def _draw(self, kind: int) -> tuple[Float[Tensor, "yaws 3 area"], Float[Tensor, "yaws area"]]:
        """Crops of an object of the kind in all yaws, white if it may have any colour: its pixels, and where it is."""
        slot, code = self._world.objects[kind].slots[0], empty_scenes(self._world, NUM_YAWS)
        code[YAW][:, slot] = torch.stack([YAWS.cos(), YAWS.sin()], dim=-1)
        code[CONFIDENCE][:, slot] = 1
        if self._sun is not None:
            code[LIGHT] = self._sun.expand(NUM_YAWS, 2)
        dark = torch.zeros(NUM_YAWS, 3, self._world.camera.height, self._world.camera.width)
        on_black, on_white = (self._world.render(code, behind).detach() for behind in (dark, dark + 1))
        coverage = 1 - (on_white - on_black).mean(dim=1, keepdim=True)
        crops = torch.stack([self._places.cut_middle(one) for one in torch.cat([on_black, coverage], dim=1)])
        shades, covered = crops.split((3, 1), dim=1)
        mask = (covered > _COVERED).float()
        return shades * mask, mask[:, 0]


def empty_scenes(world: MeshWorld, count: int) -> dict[str, Tensor]:
    """Codes of scenes whose objects are all in the middle and invisible, white, under a sun straight above."""
    slots = world.layout.num_slots
    code = {TRANSLATION: torch.zeros(count, slots, 3), YAW: torch.tensor([1.0, 0.0]).repeat(count, slots, 1)}
    if COLOR in world.layout:
        code[COLOR] = torch.ones(count, slots, 3)
    if LIGHT in world.layout:
        code[LIGHT] = torch.zeros(count, 2)
    return code | {CONFIDENCE: torch.zeros(count, slots, 1)}
