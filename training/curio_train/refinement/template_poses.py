"""How poses of template matching are refined, whose errors in depth are of another kind than those of networks."""

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from curio_train.scene_code import TRANSLATION, SceneCode
from curio_train.worlds.options import LinemodOptions


def uses_templates(recipe: Mapping[str, Any], num_objects: int) -> bool:
    """Whether a model reads poses by templates instead of regressing them.

    Args:
        recipe: The configuration that it was trained with, as its specification holds it.
        num_objects: That it knows.
    """
    world = recipe.get("world", {})
    by_locator = world.get("name") == "linemod" and not LinemodOptions.upgraded(world)["two_stage"]
    is_free = "plane" in world and world["plane"] is None  # a plane's file is left out of what models store
    several_parts = world.get("name") == "capture" and num_objects > 1 and is_free
    return recipe.get("method") == "templates" or (by_locator and world.get("gaze", True)) or several_parts


def with_mean_depth(estimate: SceneCode, refined: SceneCode) -> dict[str, Tensor]:
    """Refined poses, moved along their rays to the geometric mean of the estimate's depth and the refined one.

    In photographs features match best where the object is a little too far away, and colours where it is a little too
    near. The two errors are nearly independent (correlation 0.1 to 0.5 by class), so their mean is smaller than
    either; refinement improves rotation and position across the view, which stay as refined
    (docs/experiments/real_photographs.md). Where both depths are equal, so is the result, to the bit.

    Args:
        estimate: Of template matching, with positions [batch, slots, 3] in the camera frame, metres.
        refined: By colours, the same poses.
    """
    position_m = refined[TRANSLATION]
    ratio = estimate[TRANSLATION][..., 2:] / position_m[..., 2:]
    return dict(refined) | {TRANSLATION: position_m * ratio.sqrt()}
