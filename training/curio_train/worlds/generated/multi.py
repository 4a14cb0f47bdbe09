"""Multi: two each of the letters W, X, Y, Z on the ground, with position, yaw and colour (paper, section "Analysis").

Letters 0.42 m high and 0.14 m thick stand upright. W, X and Y look the same from behind, so all letters are painted:
their colour fades to half its sRGB value from front to back, and images show the yaw. Slot = shape: slots 0–1 W,
2–3 X, 4–5 Y, 6–7 Z. Colours are drawn as in Spheres; ground, camera and sun are those of ``ground.py``.
"""

from curio_train.meshes.letters import letter
from curio_train.meshes.shapes import painted, standing
from curio_train.worlds.generated.fields import COLOR_FIELD
from curio_train.worlds.generated.generated_world import GeneratedWorld
from curio_train.worlds.generated.ground import POSITION_FIELD, ground_setup, standing_kind
from curio_train.worlds.generated.orientation import Yaw
from curio_train.worlds.options import MultiOptions

LETTERS, NUM_EACH = "WXYZ", 2
HEIGHT_M, DEPTH_M = 0.42, 0.14
DARKEST = 0.5


def build(options: MultiOptions) -> GeneratedWorld:
    """The world of eight letters."""
    meshes = {name: painted(standing(letter(name, HEIGHT_M, DEPTH_M)), DARKEST) for name in LETTERS}
    kinds = [standing_kind(name, mesh, NUM_EACH) for name, mesh in meshes.items()]
    return GeneratedWorld("multi", kinds, ground_setup(), POSITION_FIELD, Yaw(), [COLOR_FIELD])
