"""The image encoder: an AlexNet without pooling (paper, appendix, table "AlexNet encoder")."""

from jaxtyping import Float
from torch import Tensor, nn

from curio_train.config import ConvStack


class Encoder(nn.Module):
    """Image to latent code: five strided convolutions, each with batch norm and ReLU.

    The paper's table leaves batch norm out of the last layer; its count of 2,029,056 parameters has it in.
    """

    def __init__(self, stack: ConvStack) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for num_in, width, kernel, stride, padding in zip(
            (3, *stack.widths), stack.widths, stack.kernels, stack.strides, stack.paddings, strict=False
        ):
            layers += [nn.Conv2d(num_in, width, kernel, stride, padding), nn.BatchNorm2d(width), nn.ReLU()]
        self.layers = nn.Sequential(*layers)

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch latent"]:
        """Latent codes of sRGB images in [0, 1]."""
        latent: Tensor = self.layers(images).flatten(1)
        return latent
