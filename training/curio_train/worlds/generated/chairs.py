"""Chairs: five chairs on the ground, each with position and yaw (paper, section "Analysis"; 5 degrees of freedom each).

Wooden chairs of 0.6 m, 0.3 m wide and deep, all of one colour; ground, camera and sun are those of ``ground.py``.
"""

from dataclasses import replace

import numpy as np

from curio_train.meshes.meshes import Mesh
from curio_train.meshes.shapes import chair, standing
from curio_train.worlds.generated.generated_world import GeneratedWorld
from curio_train.worlds.generated.ground import POSITION_FIELD, ground_setup, standing_kind
from curio_train.worlds.generated.orientation import Yaw
from curio_train.worlds.options import ChairsOptions

HEIGHT_M = 0.6
WOOD_SRGB = (0.85, 0.6, 0.3)
NUM_CHAIRS = 5


def wooden_chair() -> Mesh:
    """The chair, standing."""
    mesh = standing(chair(HEIGHT_M))
    return replace(mesh, vertex_colors_srgb=np.tile(WOOD_SRGB, (len(mesh.vertices_m), 1)))


def build(options: ChairsOptions) -> GeneratedWorld:
    """The world of five chairs."""
    kinds = [standing_kind("chair", wooden_chair(), NUM_CHAIRS)]
    return GeneratedWorld("chairs", kinds, ground_setup(), POSITION_FIELD, Yaw(), constants={"wood": WOOD_SRGB})
