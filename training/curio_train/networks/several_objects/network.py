"""Whole frame to the poses of several objects: places by a trained head, poses by templates, in one graph."""

from collections.abc import Sequence
from typing import Final, NamedTuple

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from curio_train.networks.several_objects.locator import LocatorNetwork
from curio_train.networks.templates.geometry import FRAME_STRIDE, Geometry
from curio_train.networks.templates.reader import CalibrationFeatures, Effort, Places, PoseReader


class Search(NamedTuple):
    """How much of a frame is looked at for each object."""

    places: int = 3
    """Likeliest ones that templates are compared with."""
    effort: Effort = Effort()
    """At each of them."""


FAST = Search(1, Effort(hypotheses=1, closer=1, rolls_deg=(0.0,)))
"""A fourth of the time. For locators that learned from photographs: nine times in ten their first place is right
(docs/experiments/real_photographs.md)."""


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
        self.reader, self.search = PoseReader(geometries), Search()

    @property
    def search(self) -> Search:
        """How much of a frame is looked at; the confidence is calibrated for what it was then."""
        return Search(self._num_places, self.reader.effort)

    @search.setter
    def search(self, search: Search) -> None:
        self._num_places, self.reader.effort = search

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> dict[str, Tensor]:
        """Codes in the frame's camera: metres, 6D rotation and confidence [batch, objects, …], light [batch, 3]."""
        code: dict[str, Tensor] = self.reader(self.locator.trunk, images, self._places(images))
        return code

    def read(self, images: Float[Tensor, "batch 3 height width"]) -> tuple[dict[str, Tensor], CalibrationFeatures]:
        """The code without its confidence, and what that is made of."""
        return self.reader.read(self.locator.trunk, images, self._places(images))

    def _places(self, images: Tensor) -> Places:
        return Places(*self.locator.places(F.avg_pool2d(images, FRAME_STRIDE), self._num_places))
