"""Pieces that the networks beside the paper's are made of."""

import torch
from torch import Tensor, nn


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
