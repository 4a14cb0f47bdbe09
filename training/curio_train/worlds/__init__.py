"""The registry of worlds.

A world NAME is a module ``worlds/NAME.py`` with a function ``build(options) -> World``, and a line here that names its
options. Nothing is imported before it is asked for, so that listing the worlds costs no torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from curio_train.config import WorldOptions
from curio_train.worlds.options import (
    CaptureOptions,
    ChairsOptions,
    CirclesOptions,
    LightOptions,
    LinemodOptions,
    MultiOptions,
    SpheresOptions,
    VariedOptions,
)

if TYPE_CHECKING:
    from curio_train.worlds.base import World

WORLDS: dict[str, type[WorldOptions]] = {
    "circles": CirclesOptions,
    "spheres": SpheresOptions,
    "chairs": ChairsOptions,
    "varied": VariedOptions,
    "multi": MultiOptions,
    "light": LightOptions,
    "linemod": LinemodOptions,
    "capture": CaptureOptions,
}


def build(options: WorldOptions) -> World:
    """The world that these options describe."""
    name = next(name for name, kind in WORLDS.items() if isinstance(options, kind))
    world: World = importlib.import_module(f"curio_train.worlds.{name}").build(options)
    return world
