"""Light: two to ten capsules, boxes and cones on the ground under a sun that moves (paper, section "Analysis").

Position, yaw, colour and confidence of each object, and two numbers for the sun: 11 degrees of freedom. Slots 0–3 are
capsules, 4–6 boxes, 7–9 cones. Each number from 2 to 10 is as likely as the others, and any slots may be in use.

Upright capsules and cones look alike from all sides and boxes from two, so all are painted: their colour fades to half
its sRGB value from front to back. The sun is uniform in direction between 30° and 80° above the horizon, of constant
strength. Colours are drawn as in Spheres; slots out of use as in Varied; ground and camera are those of ``ground.py``.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from curio_train.meshes.shapes import box, capsule, cone, painted, standing
from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, TRANSLATION, YAW, Field
from curio_train.worlds.generated.ground import POSITION, GroundWorld
from curio_train.worlds.generated.mesh_world import Kind
from curio_train.worlds.generated.multi import COLOR_FIELD, DARKEST
from curio_train.worlds.generated.varied import CONFIDENCE_FIELD
from curio_train.worlds.options import LightOptions
from curio_train.worlds.placement import LEAST_SATURATION, LEAST_VALUE, colors, places, presence, yaws

LOWEST_SUN_DEG, HIGHEST_SUN_DEG = 30.0, 80.0
FEWEST = 2
_REACH = 1 / float(np.tan(np.radians(LOWEST_SUN_DEG)))
SUN_FIELD = Field(LIGHT, 2, per_object=False, frame="world", lower=(-_REACH, -_REACH), upper=(_REACH, _REACH))


class Light(GroundWorld):
    """The world of many shapes under a moving sun."""

    name = "light"
    colors_interchangeable = True

    def __init__(self) -> None:
        kinds = [
            Kind("capsule", painted(standing(capsule(0.13, 0.48, sections=16)), DARKEST), 4),
            Kind("box", painted(standing(box((0.3, 0.32, 0.22))), DARKEST), 3),
            Kind("cone", painted(standing(cone(0.18, 0.48, sections=24)), DARKEST), 3),
        ]
        super().__init__([COLOR_FIELD, CONFIDENCE_FIELD, SUN_FIELD], kinds)

    @property
    def constants(self) -> Mapping[str, Any]:
        """Of colours, counts and sun; all others stand in fields, meshes and stage."""
        return {
            "saturation": LEAST_SATURATION,
            "value": LEAST_VALUE,
            "fewest": FEWEST,
            "sun_deg": (LOWEST_SUN_DEG, HIGHEST_SUN_DEG),
        }

    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        """Objects that do not touch, turned any way, of any colour, some of them absent, under any sun."""
        random = np.random.default_rng(seed)
        num_slots = self.layout.num_slots
        return {
            TRANSLATION: places(count, self.radii_m, POSITION.lower, POSITION.upper, random),
            YAW: yaws(count, num_slots, random),
            COLOR: colors(count, num_slots, random),
            CONFIDENCE: presence(count, num_slots, FEWEST, random),
            LIGHT: suns(count, random),
        }


def suns(count: int, random: np.random.Generator) -> Tensor:
    """(x / y, z / y) [count, 2]: a height uniform on the unit sphere is uniform in area."""
    lowest, highest = (float(np.sin(np.radians(degrees))) for degrees in (LOWEST_SUN_DEG, HIGHEST_SUN_DEG))
    height = random.uniform(lowest, highest, count)
    azimuth = random.uniform(-np.pi, np.pi, count)
    slope = np.sqrt(1 - height**2) / height
    return torch.from_numpy(np.stack([slope * np.cos(azimuth), slope * np.sin(azimuth)], axis=1)).float()


def build(options: LightOptions) -> Light:
    """The only such world there is."""
    return Light()
