"""Whole frame to the poses of several objects: places by a trained head, poses by templates, in one graph."""

from collections.abc import Sequence
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from curio_train.networks.several_objects.locator import LocatorNetwork
from curio_train.networks.templates.geometry import FRAME_STRIDE, Geometry
from curio_train.networks.templates.reader import CalibrationFeatures, Effort, Places, PoseReader

NUM_PLACES = 3
"""Of each object that templates are compared with."""


class ObjectsNetwork(nn.Module):
    """Locate, match, align; one slot an object."""

    DRAWN: Final = ("reader.",)
    """Beginnings of the names of what is drawn and calibrated instead of trained."""
    locator: LocatorNetwork
    """Finds places; its trunk's features are the reader's, too."""
    reader: PoseReader
    """From places to poses."""
    geometries: Sequence[Geometry]
    """One an object."""

    def __init__(self, locator: LocatorNetwork, geometries: Sequence[Geometry]) -> None:
        """Build around a locator; all templates are still empty.

        Args:
            locator: For frames of half the resolution.
            geometries: One an object, in the order of the locator's.
        """
        super().__init__()
        self.locator, self.geometries = locator, tuple(geometries)
        self._num_places, self.reader = NUM_PLACES, PoseReader(geometries)

    def look_less(self) -> None:
        """Look at the likeliest place of each object alone, in one crop a pass: a fourth of the time.

        For locators that learned from photographs, whose first place is right nine times in ten
        (docs/experiments/real_photographs.md). The confidence stays calibrated for looking more.
        """
        self._num_places, self.reader.effort = 1, Effort(hypotheses=1, closer=1, rolls_deg=(0.0,))

    def forward(
        self, images: Float[Tensor, "batch 3 height width"], slots: Int[Tensor, " objects"] | None = None
    ) -> dict[str, Tensor]:
        """Codes in the frame's camera: metres, 6D rotation and confidence [batch, objects, …], light [batch, 3].

        Args:
            images: sRGB in [0, 1].
            slots: Which objects to look for, in any order; None: all.
        """
        code: dict[str, Tensor] = self.reader(self.locator.trunk, images, self._places(images, slots))
        return code

    def read(self, images: Float[Tensor, "batch 3 height width"]) -> tuple[dict[str, Tensor], CalibrationFeatures]:
        """The code without its confidence, and what that is made of."""
        return self.reader.read(self.locator.trunk, images, self._places(images, None))

    def _places(self, images: Tensor, slots: Tensor | None) -> Places:
        if slots is None:
            slots = torch.arange(len(self.geometries), device=images.device)
        found = self.locator.places(F.avg_pool2d(images, FRAME_STRIDE), self._num_places, slots)
        return Places(*found, slots)
