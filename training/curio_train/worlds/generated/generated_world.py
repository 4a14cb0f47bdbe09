"""The paper's worlds of meshes: Spheres, Varied, Chairs, Multi and Light differ in meshes, fields and setup alone."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, TRANSLATION, YAW, Field, Layout
from curio_train.worlds.base import Explainer
from curio_train.worlds.generated.fields import HIGHEST_SUN_DEG, LOWEST_SUN_DEG
from curio_train.worlds.generated.hypotheses.search import GroundHypotheses
from curio_train.worlds.generated.mesh_world import MeshKind, MeshWorld
from curio_train.worlds.generated.orientation import Orientation
from curio_train.worlds.generated.scene_setup import SceneSetup
from curio_train.worlds.placement import (
    MIN_SATURATION,
    MIN_VALUE,
    random_colors,
    random_presence,
    random_suns,
    random_yaws,
    separate_positions,
)

MIN_OBJECTS = 2
"""Fewest objects in scenes whose number of objects varies; unused slots have a position and a colour, too."""


class GeneratedWorld(MeshWorld):
    """A world whose scenes are drawn from known ranges; image sets are rendered once and kept."""

    def __init__(
        self,
        name: str,
        kinds: Sequence[MeshKind],
        setup: SceneSetup,
        position: Field,
        orientation: Orientation,
        fields: Sequence[Field] = (),
        constants: Mapping[str, Any] | None = None,
    ) -> None:
        """Build the renderer.

        Args:
            name: As on the command line.
            kinds: The objects.
            setup: Camera, light and ground.
            position: Field of the positions; they are uniform in its range.
            orientation: How scene codes describe rotations.
            fields: Of the scene code beside position and rotation.
            constants: What the draws depend on beside fields, meshes and setup.

        Raises:
            RendererError: No usable libLLVM.
        """
        rotation = [] if orientation.field is None else [orientation.field]
        layout = Layout((position, *rotation, *fields), sum(kind.num_slots for kind in kinds))
        drawn: dict[str, Any] = dict(constants or {})
        if COLOR in layout:
            drawn |= {"saturation": MIN_SATURATION, "value": MIN_VALUE}
        if CONFIDENCE in layout:
            drawn["fewest"] = MIN_OBJECTS
        if LIGHT in layout:
            drawn["sun_deg"] = (LOWEST_SUN_DEG, HIGHEST_SUN_DEG)
        super().__init__(name, layout, kinds, setup, orientation, drawn)
        self.colors_interchangeable = COLOR in layout

    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        """Objects that do not touch; yaws, colours, numbers and the sun are random if the code has them."""
        random, num_slots = np.random.default_rng(seed), self.layout.num_slots
        position = self.layout[TRANSLATION]
        code = {TRANSLATION: separate_positions(count, self.radii_m, position.lower, position.upper, random)}
        if YAW in self.layout:
            code[YAW] = random_yaws(count, num_slots, random)
        if COLOR in self.layout:
            code[COLOR] = random_colors(count, num_slots, random)
        if CONFIDENCE in self.layout:
            code[CONFIDENCE] = random_presence(count, num_slots, MIN_OBJECTS, random)
        if LIGHT in self.layout:
            code[LIGHT] = random_suns(count, LOWEST_SUN_DEG, HIGHEST_SUN_DEG, random)
        return code

    def explainer(self) -> Explainer:
        """A search for the scenes of images among rendered hypotheses, see ``hypotheses/``.

        Raises:
            UsageError: The objects do not stand on the ground.
        """
        if self.setup.ground_srgb is None or YAW not in self.layout:
            return super().explainer()
        return GroundHypotheses(self)
