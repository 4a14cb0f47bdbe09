"""The second look's network: pose and light of one object that fills a crop.

On its way it says, for each of 16x16 patches, whether the object is seen there and which point of it. Those 1,024
numbers an image teach the features long before nine numbers of a pose can (dense coordinates as in Wang et al. 2021,
"GDR-Net"). Then each of 8x8 cells says all of the pose, and how much its word counts; their mean is the answer. Each
cell that sees the object is taught (after Wang et al. 2019, "DenseFusion"): many lessons a crop instead of one. Of
several crops of a frame the gaze goes on with one that shows the object most clearly.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from curio_train.networks.base import StageNetwork
from curio_train.networks.grid import STRIDE, CellGrid, of_cells
from curio_train.networks.layers import Residual, convolution
from curio_train.scene_code import ROTATION_6D, TRANSLATION, Layout

OBJECT_COORDINATES = "surface"
"""What ``CropPoseNetwork.decode`` gives beside the code: [batch, 4, 16, 16], the point of the object each patch sees
(three coordinates, in half extents from the middle of its box), then the logit of seeing the object at all. Under
:func:`~curio_train.networks.grid.of_cells` stand position and rotation as each cell says them [batch, cells, size]."""

OBJECT_COORDINATES_STRIDE = 4
"""Pixels a side of a patch."""

_WIDTHS = (48, 64, 128)
_PATCH_VALUES = 4
_CONTEXT, _CONTEXT_DILATIONS = 96, (1, 2)
_HIDDEN = 256
_FIRST_SAY = 0.1


class CropPoseNetwork(StageNetwork):
    """Crop to scene code."""

    has_raw_values = False

    def __init__(self, layout: Layout, grid: CellGrid) -> None:
        """Build for crops of the grid's camera."""
        super().__init__()
        self.layout, self.grid = layout, grid
        patches_a_cell = (STRIDE // OBJECT_COORDINATES_STRIDE) ** 2
        self._num_described = _PATCH_VALUES * patches_a_cell
        self.encoder = nn.Sequential(
            convolution(3, _WIDTHS[0], 5, 2),
            convolution(_WIDTHS[0], _WIDTHS[1], 3, 2),
            Residual(_WIDTHS[1]),
            convolution(_WIDTHS[1], _WIDTHS[2], 3, 2),
            Residual(_WIDTHS[2]),
            Residual(_WIDTHS[2]),
            _Described(_WIDTHS[2], self._num_described),
        )
        self.unfold = nn.PixelShuffle(STRIDE // OBJECT_COORDINATES_STRIDE)
        inputs = _WIDTHS[2] + self._num_described, _CONTEXT
        self.context = nn.Sequential(
            *(convolution(num, _CONTEXT, 3, 1, by) for num, by in zip(inputs, _CONTEXT_DILATIONS, strict=True))
        )
        self._sizes = {field.name: field.size for field in layout.fields}
        last = nn.Conv2d(_HIDDEN, 1 + sum(self._sizes.values()), 1)
        self.cells = nn.Sequential(nn.Conv2d(_CONTEXT, _HIDDEN, 1), nn.ReLU(), last)
        self._begin_with_identity(last)

    def decode(
        self, features: Float[Tensor, "batch channels rows columns"]
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """No raw values, and the code with :data:`OBJECT_COORDINATES` and what cells say beside it."""
        each = self.cells(self.context(features)).flatten(2).transpose(1, 2)
        weight, *values = each.split([1, *self._sizes.values()], dim=-1)
        said = dict(zip(self._sizes, values, strict=True))
        at = self.grid.pixels + STRIDE * said[TRANSLATION][..., :2]
        said[TRANSLATION] = self.grid.locate(at, said[TRANSLATION][..., 2:].tanh())
        share = weight.softmax(dim=1)
        code = {}
        for field in self.layout.fields:
            mean = (share * said[field.name]).sum(dim=1)
            value = mean if field.name == TRANSLATION else field.activate(mean)
            code[field.name] = value[:, None] if field.per_object else value
        pose = {of_cells(name): said[name] for name in (TRANSLATION, ROTATION_6D)}
        return {}, {**code, **pose, OBJECT_COORDINATES: self.unfold(features[:, -self._num_described :])}

    def _begin_with_identity(self, last: nn.Conv2d) -> None:
        """A rotation of zeros has no gradient worth following: start small, from the identity."""
        assert last.bias is not None
        with torch.no_grad():
            last.weight.mul_(_FIRST_SAY)
            last.bias.zero_()
            biases = last.bias[1:].split(list(self._sizes.values()))
            dict(zip(self._sizes, biases, strict=True))[ROTATION_6D].copy_(torch.tensor([1.0, 0, 0, 0, 1, 0]))


class _Described(nn.Module):
    """Features, followed by what a linear map says of them."""

    def __init__(self, width: int, num_values: int) -> None:
        super().__init__()
        self.values = nn.Conv2d(width, num_values, 1)

    def forward(self, features: Tensor) -> Tensor:
        return torch.cat([features, self.values(features)], dim=1)
