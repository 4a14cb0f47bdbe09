"""Light: two to ten capsules, boxes and cones on the ground under a sun that moves (paper, section "Analysis").

Position, yaw, colour and confidence of each object, and two numbers for the sun: 11 degrees of freedom. Slots 0–3 are
capsules, 4–6 boxes, 7–9 cones. Each number from 2 to 10 is as likely as the others, and any slots may be in use.

Upright capsules and cones look alike from all sides and boxes from two, so all are painted: their colour fades to half
its sRGB value from front to back. The sun is uniform in direction between 30° and 80° above the horizon, of constant
strength. Colours are drawn as in Spheres, unused slots as in Varied; ground and camera are those of ``ground.py``.
"""

from curio_train.meshes.shapes import box, capsule, cone, painted, standing
from curio_train.worlds.generated.fields import COLOR_FIELD, CONFIDENCE_FIELD, SUN_FIELD
from curio_train.worlds.generated.generated_world import GeneratedWorld
from curio_train.worlds.generated.ground import POSITION_FIELD, ground_setup, standing_kind
from curio_train.worlds.generated.multi import DARKEST
from curio_train.worlds.generated.orientation import Yaw
from curio_train.worlds.options import LightOptions


def build(options: LightOptions) -> GeneratedWorld:
    """The world of many shapes under a moving sun."""
    kinds = [
        standing_kind("capsule", painted(standing(capsule(0.13, 0.48, sections=16)), DARKEST), 4),
        standing_kind("box", painted(standing(box((0.3, 0.32, 0.22))), DARKEST), 3),
        standing_kind("cone", painted(standing(cone(0.18, 0.48, sections=24)), DARKEST), 3),
    ]
    fields = [COLOR_FIELD, CONFIDENCE_FIELD, SUN_FIELD]
    return GeneratedWorld("light", kinds, ground_setup(), POSITION_FIELD, Yaw(), fields)
