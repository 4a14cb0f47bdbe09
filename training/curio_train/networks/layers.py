"""Pieces that the networks beside the paper's are made of."""

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval


def convolution(num_in: int, num_out: int, kernel: int, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    """Convolution, batch norm, ReLU. With stride s, output i looks at pixel i * s."""
    padding = dilation * (kernel // 2)
    return nn.Sequential(
        nn.Conv2d(num_in, num_out, kernel, stride, padding, dilation), nn.BatchNorm2d(num_out), nn.ReLU()
    )


class Residual(nn.Module):
    """Two convolutions beside a shortcut (He et al. 2016, "Deep Residual Learning for Image Recognition")."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = convolution(width, width, 3)
        self.second = nn.Sequential(nn.Conv2d(width, width, 3, 1, 1), nn.BatchNorm2d(width))

    def forward(self, features: Tensor) -> Tensor:
        """Features of the same shape."""
        return torch.relu(features + self.second(self.first(features)))


def fold_batch_norm(network: nn.Module) -> None:
    """Fold batch norm into the convolutions before it, in place: for a network in evaluation mode."""
    for layers in network.modules():
        if not isinstance(layers, nn.Sequential):
            continue
        for number in range(len(layers) - 1):
            convolution, norm = layers[number], layers[number + 1]
            if isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                layers[number], layers[number + 1] = fuse_conv_bn_eval(convolution, norm), nn.Identity()
