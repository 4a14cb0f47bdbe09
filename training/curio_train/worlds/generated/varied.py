"""Varied: two to five spheres of varying place and colour (paper, section "Analysis"; 7 degrees of freedom each).

As Spheres in every constant, with five slots and their confidence. Each number of spheres from 2 to 5 is as likely as
the others, and any slots may be the ones in use. Slots out of use have a place and a colour too, kept apart from the
others' like theirs; with confidence 0 they are not in the image.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor

from curio_train.meshes.shapes import sphere
from curio_train.scene_code import COLOR, CONFIDENCE, TRANSLATION, Field, Layout
from curio_train.worlds.generated.mesh_world import Kind, MeshWorld
from curio_train.worlds.generated.spheres import FIELDS, RADIUS_M, stage
from curio_train.worlds.options import VariedOptions
from curio_train.worlds.placement import LEAST_SATURATION, LEAST_VALUE, colors, places, presence

FEWEST, NUM_SLOTS = 2, 5
CONFIDENCE_FIELD = Field(CONFIDENCE, 1, activation="sigmoid", lower=(0.0,), upper=(1.0,))


class Varied(MeshWorld):
    """The world of two to five spheres."""

    name = "varied"
    colors_interchangeable = True

    def __init__(self) -> None:
        layout = Layout((*FIELDS, CONFIDENCE_FIELD), NUM_SLOTS)
        super().__init__(layout, [Kind("sphere", sphere(RADIUS_M, subdivisions=2), NUM_SLOTS)], stage())

    @property
    def constants(self) -> Mapping[str, Any]:
        """Of colours and counts; all others stand in fields and meshes."""
        return {"saturation": LEAST_SATURATION, "value": LEAST_VALUE, "fewest": FEWEST}

    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        """Spheres that do not touch, of any colour, some of them absent."""
        random = np.random.default_rng(seed)
        field = self.layout[TRANSLATION]
        return {
            TRANSLATION: places(count, [RADIUS_M] * NUM_SLOTS, field.lower, field.upper, random),
            COLOR: colors(count, NUM_SLOTS, random),
            CONFIDENCE: presence(count, NUM_SLOTS, FEWEST, random),
        }


def build(options: VariedOptions) -> Varied:
    """The only such world there is."""
    return Varied()
