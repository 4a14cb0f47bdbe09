"""Encoder and heads together: the network that is trained, exported and served."""

from jaxtyping import Float
from torch import Tensor

from curio_train.config import NetworkConfig
from curio_train.errors import UsageError
from curio_train.networks.base import StageNetwork
from curio_train.networks.paper.encoder import Encoder
from curio_train.networks.paper.heads import Heads
from curio_train.scene_code import Layout


class PoseNetwork(StageNetwork):
    """Image to scene code: all that is left of training at test time."""

    def __init__(self, layout: Layout, image_side: int = 128, config: NetworkConfig | None = None) -> None:
        """Build for square images of ``image_side`` pixels.

        Raises:
            UsageError: The encoder's strides do not bring such an image down to one pixel.
        """
        super().__init__()
        config = config or NetworkConfig()
        left = config.encoder.output_side(image_side)
        if left != 1:
            raise UsageError(
                f"encoder {config.encoder} leaves {left} pixels a side of an image of {image_side}, expected 1: "
                "change its strides or kernels"
            )
        self.encoder = Encoder(config.encoder)
        self.heads = Heads(layout, config.encoder.widths[-1], config.row, config.hidden)

    def decode(self, latent: Float[Tensor, "batch latent"]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """The heads' raw outputs of a latent code, and the scene code."""
        raw = self.heads.raw(latent)
        return raw, self.heads.layout.activate(raw)
