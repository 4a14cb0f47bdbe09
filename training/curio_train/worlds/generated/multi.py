"""Multi: two each of the letters W, X, Y, Z on the ground, with position, yaw and colour (paper, section "Analysis").

Letters 0.42 m high and 0.14 m thick stand upright. W, X and Y look the same from behind, so all letters are painted:
their colour fades to half its sRGB value from front to back, and yaw is something that can be seen. Slot = shape:
slots 0–1 W, 2–3 X, 4–5 Y, 6–7 Z. Colours are drawn as in Spheres; ground, camera and sun are those of ``ground.py``.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor

from curio_train.meshes.letters import letter
from curio_train.meshes.shapes import painted, standing
from curio_train.scene_code import COLOR, TRANSLATION, YAW, Field
from curio_train.worlds.generated.ground import POSITION, GroundWorld
from curio_train.worlds.generated.mesh_world import Kind
from curio_train.worlds.options import MultiOptions
from curio_train.worlds.placement import LEAST_SATURATION, LEAST_VALUE, colors, places, yaws

LETTERS, NUM_EACH = "WXYZ", 2
HEIGHT_M, DEPTH_M = 0.42, 0.14
DARKEST = 0.5
COLOR_FIELD = Field(COLOR, 3, activation="sigmoid", lower=(0.0,) * 3, upper=(1.0,) * 3)


class Multi(GroundWorld):
    """The world of eight letters."""

    name = "multi"
    colors_interchangeable = True

    def __init__(self) -> None:
        meshes = {name: painted(standing(letter(name, HEIGHT_M, DEPTH_M)), DARKEST) for name in LETTERS}
        super().__init__([COLOR_FIELD], [Kind(name, mesh, NUM_EACH) for name, mesh in meshes.items()])

    @property
    def constants(self) -> Mapping[str, Any]:
        """Of the colours; all others stand in fields, meshes and stage."""
        return {"saturation": LEAST_SATURATION, "value": LEAST_VALUE}

    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        """Letters that do not touch, turned any way, of any colour."""
        random = np.random.default_rng(seed)
        return {
            TRANSLATION: places(count, self.radii_m, POSITION.lower, POSITION.upper, random),
            YAW: yaws(count, self.layout.num_slots, random),
            COLOR: colors(count, self.layout.num_slots, random),
        }


def build(options: MultiOptions) -> Multi:
    """The only such world there is."""
    return Multi()
