"""Base class of the networks; each reads the images of one stage."""

from abc import ABC, abstractmethod

from jaxtyping import Float
from torch import Tensor, nn


class StageNetwork(nn.Module, ABC):
    """Image to scene code in two parts, of which only the encoder may run in bfloat16."""

    encoder: nn.Module
    """Image to features: convolutions, which take most of the time."""
    has_raw_values = True
    """Whether :meth:`decode` returns raw values, around which wake–sleep draws scene codes."""

    @abstractmethod
    def decode(self, features: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """From float32 features: raw values for ``Layout.activate`` (none without ``has_raw_values``), and the code."""

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> dict[str, Tensor]:
        """Scene codes, in physical units, of sRGB images in [0, 1]."""
        return self.decode(self.encoder(images))[1]
