"""A network's predictions with refined poses: each object by render-and-compare with its own mesh."""

from collections.abc import Callable

import torch
from torch import Tensor

from curio_train.refinement.render_and_compare import RenderAndCompare
from curio_train.scene_code import ROTATION_6D, TRANSLATION, SceneCode, of_slot
from curio_train.worlds.base import World
from curio_train.worlds.several_objects.world import SeveralObjectsWorld


def with_refinement(
    predict: Callable[[Tensor], SceneCode], world: World, method: str
) -> Callable[[Tensor], dict[str, Tensor]]:
    """Predictions with refined poses.

    Args:
        predict: uint8 images [batch, 3, height, width] of the world's camera to scene codes.
        world: Of one object, or of several with a slot each.
        method: That the network was trained with.

    Raises:
        UsageError: The world is another.
    """
    of_slots = refiners(world, method)

    def refined(images: Tensor) -> dict[str, Tensor]:
        code = predict(images)
        slots = [refiner.refine(images, of_slot(code, slot)).code for slot, refiner in enumerate(of_slots)]
        return dict(code) | {
            name: torch.cat([one[name] for one in slots], dim=1) for name in (TRANSLATION, ROTATION_6D)
        }

    return refined


def refiners(world: World, method: str) -> list[RenderAndCompare]:
    """Render-and-compare for each object.

    Args:
        world: Of one object, or of several with a slot each.
        method: That the network was trained with.

    Raises:
        UsageError: The world is another.
    """
    if not isinstance(world, SeveralObjectsWorld):
        return [RenderAndCompare.in_world(world, from_templates=method == "templates")]
    return [RenderAndCompare(one.mesh, world.camera, one.kind.diameter_m, from_templates=True) for one in world.members]
