"""The registry of worlds.

A new world is a module with a function ``build(options) -> World``, a class of options in ``worlds/options.py``, and a
line here. The module of a world is imported only when that world is built, so that listing the worlds costs no torch.
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

_MODULES = {
    "circles": "generated.circles",
    "spheres": "generated.spheres",
    "chairs": "generated.chairs",
    "varied": "generated.varied",
    "multi": "generated.multi",
    "light": "generated.light",
    "linemod": "single_object.linemod",
    "capture": "single_object.capture",
}

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
    world: World = importlib.import_module(f"curio_train.worlds.{_MODULES[name]}").build(options)
    return world
