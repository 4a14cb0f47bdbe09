"""What every network that reads an image at one look is made of."""

from abc import ABC, abstractmethod

from jaxtyping import Float
from torch import Tensor, nn


class StageNetwork(nn.Module, ABC):
    """Image to scene code in two parts, of which the first may be computed with fewer digits.

    Attributes:
        encoder: Image to features: convolutions, where the time goes.
    """

    encoder: nn.Module
    has_raw_values = True
    """Whether :meth:`decode` gives what wake–sleep perturbs."""

    @abstractmethod
    def decode(self, features: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Features (float32) to raw values (see ``Layout.activate``; none where there are none) and the code."""

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> dict[str, Tensor]:
        """Scene codes, in physical units, of sRGB images in [0, 1]."""
        return self.decode(self.encoder(images))[1]
