"""Network of the crop-pose stage: pose and light of one object that fills a crop.

Dense object coordinates are an auxiliary output: for each of 16x16 patches, whether the object is visible there and
which of its points (as in Wang et al. 2021, "GDR-Net"). These 1,024 numbers an image train the features long before
the nine numbers of a pose can. Each of 8x8 cells then predicts the whole pose and a weight; the result is the weighted
mean. Every cell that sees the object has a loss of its own (after Wang et al. 2019, "DenseFusion").
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from curio_train.networks.base import StageNetwork
from curio_train.networks.grid import STRIDE, CellGrid, per_cell
from curio_train.networks.layers import Residual, convolution
from curio_train.scene_code import ROTATION_6D, TRANSLATION, Layout

OBJECT_COORDINATES = "surface"
"""Key beside the code that ``CropPoseNetwork.decode`` returns: [batch, 4, 16, 16], the object's point that each patch
sees (three coordinates, in half extents from the middle of its box), then the logit of seeing the object at all.
Position and rotation as predicted by each cell are under :func:`~curio_train.networks.grid.per_cell`
[batch, cells, size]."""

CELL_WEIGHTS = "cell_weights"
"""Key of the weights with which the cells make the mean [batch, cells, 1]."""

OBJECT_COORDINATES_STRIDE = 4
"""Side of a patch in pixels."""

_WIDTHS = (48, 64, 128)
_PATCH_VALUES = 4
_CONTEXT, _CONTEXT_DILATIONS = 96, (1, 2)
_HIDDEN = 256
_INITIAL_SCALE = 0.1  # of the last layer's weights


class CropPoseNetwork(StageNetwork):
    """Crop to scene code."""

    has_raw_values = False

    def __init__(self, layout: Layout, grid: CellGrid) -> None:
        """Build for crops of the grid's camera."""
        super().__init__()
        self.layout, self.grid = layout, grid
        patches_a_cell = (STRIDE // OBJECT_COORDINATES_STRIDE) ** 2
        self._num_coordinates = _PATCH_VALUES * patches_a_cell
        self.encoder = nn.Sequential(
            convolution(3, _WIDTHS[0], 5, 2),
            convolution(_WIDTHS[0], _WIDTHS[1], 3, 2),
            Residual(_WIDTHS[1]),
            convolution(_WIDTHS[1], _WIDTHS[2], 3, 2),
            Residual(_WIDTHS[2]),
            Residual(_WIDTHS[2]),
            _WithCoordinates(_WIDTHS[2], self._num_coordinates),
        )
        self.unfold = nn.PixelShuffle(STRIDE // OBJECT_COORDINATES_STRIDE)
        inputs = _WIDTHS[2] + self._num_coordinates, _CONTEXT
        self.context = nn.Sequential(
            *(convolution(num, _CONTEXT, 3, 1, by) for num, by in zip(inputs, _CONTEXT_DILATIONS, strict=True))
        )
        self._sizes = {field.name: field.size for field in layout.fields}
        last = nn.Conv2d(_HIDDEN, 1 + sum(self._sizes.values()), 1)
        self.cells = nn.Sequential(nn.Conv2d(_CONTEXT, _HIDDEN, 1), nn.ReLU(), last)
        self._start_at_identity(last)

    def decode(
        self, features: Float[Tensor, "batch channels rows columns"]
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """No raw values, and the code with :data:`OBJECT_COORDINATES` and the predictions of all cells beside it."""
        outputs = self.cells(self.context(features)).flatten(2).transpose(1, 2)
        logits, *values = outputs.split([1, *self._sizes.values()], dim=-1)
        fields = dict(zip(self._sizes, values, strict=True))
        pixels = self.grid.pixels + STRIDE * fields[TRANSLATION][..., :2]
        fields[TRANSLATION] = self.grid.locate(pixels, fields[TRANSLATION][..., 2:].tanh())
        weights = logits.softmax(dim=1)
        code = {}
        for field in self.layout.fields:
            mean = (weights * fields[field.name]).sum(dim=1)
            value = mean if field.name == TRANSLATION else field.activate(mean)
            code[field.name] = value[:, None] if field.per_object else value
        pose = {per_cell(name): fields[name] for name in (TRANSLATION, ROTATION_6D)}
        beside = {CELL_WEIGHTS: weights, OBJECT_COORDINATES: self.unfold(features[:, -self._num_coordinates :])}
        return {}, {**code, **pose, **beside}

    def _start_at_identity(self, last: nn.Conv2d) -> None:
        """Rotation numbers near zero have no useful gradient: start with small weights at the identity."""
        assert last.bias is not None
        with torch.no_grad():
            last.weight.mul_(_INITIAL_SCALE)
            last.bias.zero_()
            biases = last.bias[1:].split(list(self._sizes.values()))
            dict(zip(self._sizes, biases, strict=True))[ROTATION_6D].copy_(torch.tensor([1.0, 0, 0, 0, 1, 0]))


class _WithCoordinates(nn.Module):
    """Appends a linear map of the features to them."""

    def __init__(self, width: int, num_values: int) -> None:
        super().__init__()
        self.values = nn.Conv2d(width, num_values, 1)

    def forward(self, features: Tensor) -> Tensor:
        return torch.cat([features, self.values(features)], dim=1)
