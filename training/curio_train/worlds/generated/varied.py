"""Varied: two to five spheres of any position and colour (paper, section "Analysis"; 7 degrees of freedom each).

As Spheres in every constant, with five slots and their confidence. The numbers of spheres from 2 to 5 are equally
likely, and any slots may be the ones in use. Slots that are not used have a position and a colour, too, apart from the
others; with confidence 0 they are not in the image.
"""

from curio_train.worlds.generated.fields import COLOR_FIELD, CONFIDENCE_FIELD
from curio_train.worlds.generated.generated_world import GeneratedWorld
from curio_train.worlds.generated.orientation import NoRotation
from curio_train.worlds.generated.spheres import POSITION_FIELD, sphere_kind, spheres_setup
from curio_train.worlds.options import VariedOptions

NUM_SLOTS = 5


def build(options: VariedOptions) -> GeneratedWorld:
    """The world of two to five spheres."""
    kinds, fields = [sphere_kind(NUM_SLOTS)], [COLOR_FIELD, CONFIDENCE_FIELD]
    return GeneratedWorld("varied", kinds, spheres_setup(), POSITION_FIELD, NoRotation(), fields)
