"""Suns that an image may have been taken under."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.color import linear_from_srgb, srgb_from_linear
from curio_train.scene_code import LIGHT
from curio_train.worlds.generated.fields import HIGHEST_SUN_DEG, LOWEST_SUN_DEG
from curio_train.worlds.generated.mesh_world import MeshWorld

_NUM_AZIMUTHS, _NUM_ELEVATIONS = 8, 4
_GREY = 3  # largest difference between the channels of a pixel of the ground, of 255


class Sun(NamedTuple):
    """A sun that an image may have been taken under."""

    bank: int
    """Number of the bank that is nearest to it."""
    light: Float[Tensor, " 2"] | None
    """Entry ``LIGHT`` of the scene code, if the world's code has one."""


class Suns:
    """The suns of a world on the ground: one that does not move, or those whose banks differ enough."""

    banks: list[Float[Tensor, " 2"] | None]
    """Sun of each bank, azimuth after azimuth for each elevation."""
    dark: float
    """sRGB value of the ground in shadow."""

    def __init__(self, world: MeshWorld) -> None:
        """Choose the suns.

        Args:
            world: With a ground.
        """
        setup = world.setup
        assert setup.ground_srgb is not None
        self._albedo = float(linear_from_srgb(torch.tensor(setup.ground_srgb)))
        self._ambient, self._strength = setup.ambient, math.hypot(*setup.sun)
        self._height = setup.sun[1]
        self.dark = self._ground(0.0)
        self._moves = LIGHT in world.layout
        self._azimuths = torch.arange(_NUM_AZIMUTHS) * (2 * math.pi / _NUM_AZIMUTHS)
        span = (HIGHEST_SUN_DEG - LOWEST_SUN_DEG) / _NUM_ELEVATIONS
        self._elevations = [math.radians(LOWEST_SUN_DEG + (n + 0.5) * span) for n in range(_NUM_ELEVATIONS)]
        self.banks = [*self._all_around()] if self._moves else [None]

    def of_image(self, image: Float[Tensor, "3 height width"]) -> tuple[list[Sun], float]:
        """The suns that an image in [0, 1] may have been taken under, and the sRGB value of the ground in their light.

        The ground is the most frequent grey that is not its value in shadow. It tells how high the sun is.
        """
        if not self._moves:
            return [Sun(0, None)], self._ground(self._height)
        pixels = (image * 255).round().long().flatten(1)
        grey = pixels.amax(dim=0) - pixels.amin(dim=0) < _GREY
        counts = torch.bincount(pixels.sum(dim=0)[grey] // 3, minlength=256)
        counts[: round(self.dark * 255) + 3] = 0
        lit = int(counts.argmax()) / 255
        sine = (float(linear_from_srgb(torch.tensor(lit))) / self._albedo - self._ambient) / self._strength
        low, high = (math.sin(math.radians(angle)) for angle in (LOWEST_SUN_DEG, HIGHEST_SUN_DEG))
        elevation = math.asin(min(max(sine, low), high))
        row = min(range(_NUM_ELEVATIONS), key=lambda n: abs(self._elevations[n] - elevation))
        suns = [Sun(row * _NUM_AZIMUTHS + n, light) for n, light in enumerate(self._around(elevation))]
        return suns, self._ground(self._strength * math.sin(elevation))

    def _all_around(self) -> list[Tensor]:
        return [light for elevation in self._elevations for light in self._around(elevation)]

    def _around(self, elevation: float) -> list[Float[Tensor, " 2"]]:
        directions = torch.stack([self._azimuths.cos(), self._azimuths.sin()], dim=-1)
        return list((directions / math.tan(elevation)).unbind())

    def _ground(self, sun: float) -> float:
        """The ground's sRGB value where so much of the sun's radiance falls on it."""
        return float(srgb_from_linear(torch.tensor(self._albedo * (self._ambient + sun))))
