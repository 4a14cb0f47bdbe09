"""The critic that makes the encoder curious (paper, appendix, table "Critic architecture")."""

from typing import Literal

from jaxtyping import Float
from torch import Tensor, nn

from curio_train.config import ConvStack

LEAK = 0.2  # the paper says "leaky ReLU" and no slope; DCGAN's, the usual one of critics


class Critic(nn.Module):
    """Image to one logit, large for images that look like the data's.

    The paper's sigmoid is in the loss. Its table ends in 64 channels, but its count of 1,883,713 parameters has one.
    Batch norm always uses the batch's own statistics: data and renderings are normalised apart, and the critic is not
    used after training.
    """

    def __init__(self, stack: ConvStack, normalisation: Literal["batch", "instance"] = "batch") -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for num_in, width, kernel, stride, padding in zip(
            (3, *stack.widths), stack.widths, stack.kernels, stack.strides, stack.paddings, strict=False
        ):
            layers += [
                nn.Conv2d(num_in, width, kernel, stride, padding),
                _norm(normalisation, width),
                nn.LeakyReLU(LEAK),
            ]
        self.layers = nn.Sequential(*layers[:-2])

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, " batch"]:
        """Logits of sRGB images in [0, 1]; where more than one position is left, their mean."""
        logits: Tensor = self.layers(images).mean((1, 2, 3))
        return logits


def _norm(normalisation: Literal["batch", "instance"], width: int) -> nn.Module:
    if normalisation == "instance":
        return nn.InstanceNorm2d(width, affine=True)
    return nn.BatchNorm2d(width, track_running_stats=False)
