"""Whole frame to the poses of several objects: places by a trained head, poses by templates, in one graph.

Poses of one's own parts are aligned with their outlines in the end.
"""

from collections.abc import Sequence
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from curio_train.networks.outline_alignment import OutlineAlignment
from curio_train.networks.several_objects.locator import LocatorNetwork
from curio_train.networks.templates.effort import ONE_LOOK
from curio_train.networks.templates.geometry import FRAME_STRIDE, Geometry, num_views
from curio_train.networks.templates.reader import CalibrationFeatures, Places, PoseReader

NUM_PLACES = 3
"""Centre proposals of each object that templates are compared with."""


class ObjectsNetwork(nn.Module):
    """Locate, match, align; one slot an object."""

    DRAWN: Final = ("reader.", "outline.")
    """Beginnings of the names of what is drawn and calibrated instead of trained."""
    locator: LocatorNetwork
    """Finds places; its trunk's features are the reader's, too."""
    reader: PoseReader
    """Finds the poses at the centre proposals."""
    geometries: Sequence[Geometry]
    """One an object."""
    outline: OutlineAlignment | None
    """Aligns poses with outlines in the end; None: they stay as the reader answers them."""
    _matrix: Tensor
    _diameter_m: Tensor

    def __init__(
        self, locator: LocatorNetwork, geometries: Sequence[Geometry], *, aligns_outlines: bool = False
    ) -> None:
        """Build around a locator; all templates and outlines are still empty.

        Args:
            locator: For frames of half the resolution.
            geometries: One an object, in the order of the locator's.
            aligns_outlines: Whether poses are aligned with the objects' outlines in the end.
        """
        super().__init__()
        self.locator, self.geometries = locator, tuple(geometries)
        self._num_places, self.reader = NUM_PLACES, PoseReader(geometries)
        num_directions = num_views(geometries[0].any_side)
        self.outline = OutlineAlignment(num_directions, len(geometries)) if aligns_outlines else None
        diameter_m = torch.tensor([geometry.diameter_m for geometry in geometries])
        self.register_buffer("_matrix", torch.from_numpy(geometries[0].matrix).float(), persistent=False)
        self.register_buffer("_diameter_m", diameter_m, persistent=False)

    def look_less(self) -> None:
        """Look at the likeliest place of each object alone, once, in one crop of half the resolution.

        It takes an eighth of the time. For locators that learned from photographs, whose first place is right nine
        times in ten (docs/experiments/real_photographs.md). The confidence stays calibrated for looking more.
        """
        self._num_places, self.reader.effort = 1, ONE_LOOK

    def forward(
        self, images: Float[Tensor, "batch 3 height width"], slots: Int[Tensor, " objects"] | None = None
    ) -> dict[str, Tensor]:
        """Codes in the frame's camera: metres, 6D rotation, confidence, presence [batch, objects, …]; light [batch, 3].

        Args:
            images: sRGB in [0, 1].
            slots: Which objects to look for, in any order; None: all.
        """
        slots = self._all_slots() if slots is None else slots
        code: dict[str, Tensor] = self.reader(self.locator.trunk, images, self._places(images, slots))
        return self._aligned(images, code, slots)

    def read(self, images: Float[Tensor, "batch 3 height width"]) -> tuple[dict[str, Tensor], CalibrationFeatures]:
        """The code without its confidence, and what that is made of."""
        slots = self._all_slots()
        code, features = self.reader.read(self.locator.trunk, images, self._places(images, slots))
        return self._aligned(images, code, slots), features

    def _all_slots(self) -> Int[Tensor, " objects"]:
        return torch.arange(len(self.geometries), device=self._matrix.device)

    def _places(self, images: Tensor, slots: Tensor) -> Places:
        found = self.locator.places(F.avg_pool2d(images, FRAME_STRIDE), self._num_places, slots)
        return Places(*found, slots)

    def _aligned(self, images: Tensor, code: dict[str, Tensor], slots: Tensor) -> dict[str, Tensor]:
        if self.outline is None:
            return code
        return self.outline.of_objects(images, self._matrix, code, self._diameter_m.index_select(0, slots), slots)
