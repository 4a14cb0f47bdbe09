"""Spheres: three spheres of varying place and colour on black (paper, section "Analysis"; 6 degrees of freedom each).

The paper gives no numbers. Ours were fixed before any training:

* a camera of focal length 148 px for 128x128 images (field of view 47°) looks along z at a cube 3 m away, 1.4 m wide;
  sphere centres are uniform in the cube, spheres do not touch. A sphere of radius 0.2 m is then always whole in
  the frame, 8 to 13 pixels in radius: distance is seen by size alone;
* the cube looks the same from all sides, so the novel view, 90° round its centre, shows every sphere too;
* colours of any hue, saturation 0.5 to 1, value 0.7 to 1, over black as in Circles;
* one light from the upper left behind the camera, strength 0.7 over an ambient radiance of 0.3: nothing clips at white.

Codes are in the camera frame, which here is the world's. The heads are the paper's: linear positions, sigmoid colours.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor

from curio_train.geometry import Pose
from curio_train.meshes.shapes import sphere
from curio_train.scene_code import COLOR, TRANSLATION, Field, Layout
from curio_train.worlds.base import Camera
from curio_train.worlds.generated.mesh_world import Kind, MeshWorld, SceneSetup
from curio_train.worlds.options import SpheresOptions
from curio_train.worlds.placement import LEAST_SATURATION, LEAST_VALUE, colors, places

SIDE_PX, FOCAL_PX = 128, 148.0
DISTANCE_M, REACH_M = 3.0, 0.7
RADIUS_M = 0.2
NUM_SPHERES = 3

FIELDS = (
    Field(
        TRANSLATION,
        3,
        unit="m",
        frame="camera",
        lower=(-REACH_M, -REACH_M, DISTANCE_M - REACH_M),
        upper=(REACH_M, REACH_M, DISTANCE_M + REACH_M),
    ),
    Field(COLOR, 3, activation="sigmoid", lower=(0.0,) * 3, upper=(1.0,) * 3),
)


def stage() -> SceneSetup:
    """Camera and light of all worlds of spheres."""
    middle = (SIDE_PX - 1) / 2
    matrix = np.array([[FOCAL_PX, 0, middle], [0, FOCAL_PX, middle], [0, 0, 1]])
    return SceneSetup(
        Camera(SIDE_PX, SIDE_PX, matrix, is_default=True),
        Pose(np.eye(3), np.zeros(3)),
        center_m=(0.0, 0.0, DISTANCE_M),
        up=(0.0, -1.0, 0.0),
        ambient=0.3,
        sun=(-0.3, -0.5, -0.387),  # of length 0.7
    )


class Spheres(MeshWorld):
    """The world of three spheres."""

    name = "spheres"
    colors_interchangeable = True

    def __init__(self) -> None:
        super().__init__(
            Layout(FIELDS, NUM_SPHERES), [Kind("sphere", sphere(RADIUS_M, subdivisions=2), NUM_SPHERES)], stage()
        )

    @property
    def constants(self) -> Mapping[str, Any]:
        """Of the colours; all others stand in fields and meshes."""
        return {"saturation": LEAST_SATURATION, "value": LEAST_VALUE}

    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        """Spheres that do not touch, of any colour."""
        random = np.random.default_rng(seed)
        field = self.layout[TRANSLATION]
        position = places(count, [RADIUS_M] * NUM_SPHERES, field.lower, field.upper, random)
        return {TRANSLATION: position, COLOR: colors(count, NUM_SPHERES, random)}


def build(options: SpheresOptions) -> Spheres:
    """The only such world there is."""
    return Spheres()
