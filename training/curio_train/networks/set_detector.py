"""Dense detector for several objects in one image (after Zhou et al. 2019, "Objects as Points").

The paper's encoder compresses a whole scene into 64 numbers and has to learn which object belongs to which slot; with
ten objects it hardly does. Here every grid cell predicts a centre heat map and the fields of an object centred there,
so that what is learned at one position holds at all. The slots are then filled from the heat map, strongest peak first.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from curio_train.data.bop import ModelInfo
from curio_train.metrics.assignment import canonical
from curio_train.metrics.symmetric_rotations import nearest_symmetric
from curio_train.networks.base import StageNetwork
from curio_train.networks.grid import STRIDE, CellGrid, SplatWeights, gather_cells, heat_map_loss, per_cell
from curio_train.networks.layers import convolution
from curio_train.scene_code import CONFIDENCE, ROTATION_6D, TRANSLATION, Layout, SceneCode

HEAT_MAP = "heat_map_logits"
"""Key of the centre heat map's logits [batch, kinds, cells] beside the code that :meth:`SetDetector.decode` returns.
The fields at each cell are under :func:`per_cell` [batch, kinds, cells, size]."""

_WIDTHS = (32, 64, 96)
_CONTEXT_DILATIONS = (1, 2, 1)
_HIDDEN = 128
_INITIAL_STD = 0.01  # of the last layer's weights; not 0: rotations of no length have no gradient
_EMPTY_LOGIT = -4.0  # of the heat map at the start: most cells have no object
_LEAST_WEIGHT = 1e-6  # of the peak that fills a slot where the heat map is used up
_TIE_BREAK = 0.01  # by which the first cell's heat counts for more than the last's
_SAME_PX = 0.75 * STRIDE  # cells whose positions are this near to each other predict the same object


class SetDetector(StageNetwork):
    """Image to scene code by way of a grid."""

    has_raw_values = False

    def __init__(self, layout: Layout, kinds: Sequence[Sequence[int]], grid: CellGrid) -> None:
        """Build for the images of one camera.

        Args:
            layout: Of the scene code.
            kinds: Slots of each kind of object, one kind after the other.
            grid: Cells of that camera.
        """
        super().__init__()
        self.layout, self.grid = layout, grid
        self._counts = [len(slots) for slots in kinds]
        self._fields = [field for field in layout.fields if field.per_object and field.name != CONFIDENCE]
        self._of_scene = [field for field in layout.fields if not field.per_object]
        widest = _WIDTHS[-1]
        self.encoder = nn.Sequential(
            convolution(3, _WIDTHS[0], 5, 2),
            convolution(_WIDTHS[0], _WIDTHS[1], 3, 2),
            convolution(_WIDTHS[1], widest, 3, 2),
            *(convolution(widest, widest, 3, 1, dilation) for dilation in _CONTEXT_DILATIONS),
        )
        self._sizes = [1, *(field.size for field in self._fields)]
        last = nn.Conv2d(_HIDDEN, len(kinds) * sum(self._sizes), 1)
        nn.init.normal_(last.weight, std=_INITIAL_STD)
        assert last.bias is not None
        nn.init.zeros_(last.bias)
        with torch.no_grad():
            last.bias.view(len(kinds), -1)[:, 0] = _EMPTY_LOGIT
        self.cells = nn.Sequential(nn.Conv2d(widest, _HIDDEN, 1), nn.ReLU(), last)
        self.scene = nn.ModuleDict(
            {
                field.name: nn.Sequential(nn.Linear(2 * widest, _HIDDEN), nn.ReLU(), nn.Linear(_HIDDEN, field.size))
                for field in self._of_scene
            }
        )

    def decode(
        self, features: Float[Tensor, "batch channels rows columns"]
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """No raw values, and the code with the predictions of all cells beside it.

        While training, the code has a confidence even in worlds with a fixed number of objects: objects are drawn as
        opaque as their heat, so that the image loss has a gradient on the heat map.
        """
        per_kind = self.cells(features).flatten(2).unflatten(1, (len(self._counts), sum(self._sizes))).transpose(2, 3)
        heat, *raw = per_kind.split(self._sizes, dim=-1)
        values = {field.name: self._physical(field.name, value) for field, value in zip(self._fields, raw, strict=True)}
        code = fill_slots(self.grid, self._counts, heat[..., 0].sigmoid(), values)
        pooled = torch.cat([features.mean(dim=(2, 3)), features.amax(dim=(2, 3))], dim=1)
        code |= {field.name: field.activate(self.scene[field.name](pooled)) for field in self._of_scene}
        if CONFIDENCE not in self.layout and not self.training:
            del code[CONFIDENCE]
        of_cells = {per_cell(name): value for name, value in values.items()}
        return {}, {**code, HEAT_MAP: heat[..., 0], **of_cells}

    def _physical(self, name: str, raw: Tensor) -> Tensor:
        if name != TRANSLATION:
            return self.layout[name].activate(raw)
        return self.grid.locate(self.grid.pixels + STRIDE * raw[..., :2], raw[..., 2:])


def fill_slots(
    grid: CellGrid, counts: Sequence[int], heat: Float[Tensor, "batch kinds cells"], values: SceneCode
) -> dict[str, Tensor]:
    """Take the objects of each kind one after the other: the highest peak, averaged over the cells that agree with it.

    Args:
        grid: The cells.
        counts: Slots of each kind.
        heat: Centre heat map, 0 to 1.
        values: Predictions of each cell [batch, kinds, cells, size], including positions.

    Returns:
        The values of each slot [batch, slots, size], means weighted by heat, and the sum of the weights, which is at
        most 1, as confidence.
    """
    found: dict[str, list[Tensor]] = {name: [] for name in (*values, CONFIDENCE)}
    pixels = grid.project(values[TRANSLATION])
    # Over a uniform background cells are equal up to the last digit, which would decide.
    preference = torch.linspace(1, 1 - _TIE_BREAK, heat.shape[-1], device=heat.device)
    for kind, count in enumerate(counts):
        remaining, centres = heat[:, kind], pixels[:, kind]
        for _ in range(count):
            around = F.avg_pool2d(remaining.unflatten(1, (grid.rows, grid.columns))[:, None], 3, 1, 1)
            best = ((around.flatten(1) + remaining) * preference).argmax(dim=1, keepdim=True)
            centre = centres.gather(1, best[..., None].expand(-1, 1, 2))
            same = ((centres - centre).square().sum(dim=-1) < _SAME_PX**2).to(remaining.dtype)
            weights = (remaining * same + _LEAST_WEIGHT * F.one_hot(best[:, 0], remaining.shape[1]))[:, None]
            total = weights.sum(dim=-1, keepdim=True)
            found[CONFIDENCE].append(total.clamp(max=1))
            for name, value in values.items():
                found[name].append(weights @ value[:, kind] / total)
            remaining = remaining * (1 - same)
    return {name: torch.cat(slots, dim=1) for name, slots in found.items()}


def dense_loss(
    layout: Layout,
    kinds: Sequence[Sequence[int]],
    grid: CellGrid,
    predicted: SceneCode,
    true: SceneCode,
    slot_infos: Sequence[ModelInfo],
) -> Float[Tensor, " batch"]:
    """Loss of all cells: cross entropy of the heat map, and Eq. 1's distances of the other fields.

    The four cells around each object are trained to predict all of its fields, so no slot has to be assigned. Rotation
    numbers are compared as they are, not as rotations: while nothing is known no rotation is better than another, but
    numbers near zero have a smaller error than others. Of rotations that look alike, the four cells learn the one that
    is nearest to their mean, so that they agree.

    Args:
        layout: Of both codes.
        kinds: Slots of each kind of object.
        grid: The cells.
        predicted: From :meth:`SetDetector.decode`.
        true: The scene's own code. Where it has a confidence, objects of confidence 0 teach nothing.
        slot_infos: Symmetries of each slot's object, in the frame that rotations in the codes are from.
    """
    of_slot = torch.cat([torch.full((len(slots),), kind) for kind, slots in enumerate(kinds)])
    splat = grid.splat_weights(grid.project(true[TRANSLATION]))
    present = true[CONFIDENCE] if CONFIDENCE in true else torch.ones_like(true[TRANSLATION][..., :1])
    num_cells = predicted[HEAT_MAP].shape[2]
    splat = SplatWeights(of_slot.to(splat.cell)[:, None] * num_cells + splat.cell, splat.weight * present)
    names = [field.name for field in layout.fields if per_cell(field.name) in predicted]
    truth, error = canonical(true), heat_map_loss(predicted[HEAT_MAP].flatten(1), splat)
    for name in names:
        field = layout[name]
        gathered = gather_cells(predicted[per_cell(name)].flatten(1, 2), splat)
        if name == ROTATION_6D:
            truth[name] = nearest_symmetric((gathered * splat.weight[..., None]).sum(dim=2), truth[name], slot_infos)
        distance = (field.relative(gathered) - field.relative(truth[name])[:, :, None]).norm(dim=-1)
        error = error + (distance * splat.weight).sum(dim=(1, 2))
    for field in layout.fields:
        if not field.per_object:
            error = error + (field.relative(predicted[field.name]) - field.relative(true[field.name])).norm(dim=-1)
    return error
