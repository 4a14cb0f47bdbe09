"""The registry of worlds.

A new world is three things: a module with a function ``build(options) -> World``, a class of options in
``worlds/options.py``, and a line here. Listing the worlds imports no torch; a world's module is imported when it is
built.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from curio_train.config import WorldOptions
from curio_train.worlds import options as _options

if TYPE_CHECKING:
    from curio_train.worlds.base import World

_REGISTRY: dict[str, tuple[type[WorldOptions], str]] = {
    "circles": (_options.CirclesOptions, "generated.circles"),
    "spheres": (_options.SpheresOptions, "generated.spheres"),
    "chairs": (_options.ChairsOptions, "generated.chairs"),
    "varied": (_options.VariedOptions, "generated.varied"),
    "multi": (_options.MultiOptions, "generated.multi"),
    "light": (_options.LightOptions, "generated.light"),
    "linemod": (_options.LinemodOptions, "linemod"),
    "capture": (_options.CaptureOptions, "capture"),
}

WORLDS: dict[str, type[WorldOptions]] = {name: kind for name, (kind, _) in _REGISTRY.items()}
"""Class of options by name of the world."""


def build(options: WorldOptions) -> World:
    """The world that these options describe."""
    module = next(module for kind, module in _REGISTRY.values() if isinstance(options, kind))
    world: World = importlib.import_module(f"curio_train.worlds.{module}").build(options)
    return world
