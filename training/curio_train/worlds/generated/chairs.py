"""Chairs: five chairs on the ground, each with position and yaw (paper, section "Analysis"; 5 degrees of freedom each).

Wooden chairs of 0.6 m, 0.3 m wide and deep, all of one colour; ground, camera and sun are those of ``ground.py``.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from torch import Tensor

from curio_train.meshes.meshes import Mesh
from curio_train.meshes.shapes import chair, standing
from curio_train.scene_code import TRANSLATION, YAW
from curio_train.worlds.generated.ground import POSITION, GroundWorld
from curio_train.worlds.generated.mesh_world import Kind
from curio_train.worlds.options import ChairsOptions
from curio_train.worlds.placement import places, yaws

HEIGHT_M = 0.6
WOOD_SRGB = (0.85, 0.6, 0.3)
NUM_CHAIRS = 5


def wooden_chair() -> Mesh:
    """The chair, standing."""
    mesh = standing(chair(HEIGHT_M))
    return replace(mesh, vertex_colors_srgb=np.tile(WOOD_SRGB, (len(mesh.vertices_m), 1)))


class Chairs(GroundWorld):
    """The world of five chairs."""

    name = "chairs"

    def __init__(self) -> None:
        super().__init__([], [Kind("chair", wooden_chair(), NUM_CHAIRS)])

    @property
    def constants(self) -> Mapping[str, Any]:
        """The wood's colour; all others stand in fields, meshes and stage."""
        return {"wood": WOOD_SRGB}

    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        """Chairs that do not touch, turned any way."""
        random = np.random.default_rng(seed)
        return {
            TRANSLATION: places(count, self.radii_m, POSITION.lower, POSITION.upper, random),
            YAW: yaws(count, NUM_CHAIRS, random),
        }


def build(options: ChairsOptions) -> Chairs:
    """The only such world there is."""
    return Chairs()
