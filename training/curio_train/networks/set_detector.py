"""Several objects in one image, read cell by cell (after Zhou et al. 2019, "Objects as Points").

Beyond the paper, whose encoder says everything of a scene in 64 numbers, slot by slot: which object is whose slot is
then to be learned, too, and of ten objects it hardly is. Here every cell of the image says how much of an object is
there and what it would be like, so that what is learned at one place holds at all, and slots are filled afterwards,
the surest object first.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from curio_train.metrics.assignment import canonical
from curio_train.networks.base import StageNetwork
from curio_train.networks.grid import STRIDE, CellGrid, Share, gather_cells, heat_map_loss, of_cells
from curio_train.networks.layers import convolution
from curio_train.scene_code import CONFIDENCE, TRANSLATION, Layout, SceneCode

HEAT_MAP = "cell_amounts"
"""What :meth:`CellNetwork.decode` gives beside the code: logits of how much of an object of each kind is at each cell
[batch, kinds, cells]; under :func:`of_cells` what it would be like [batch, kinds, cells, size]."""

_WIDTHS = (32, 64, 96)
_CONTEXT_DILATIONS = (1, 2, 1)
_HIDDEN = 128
_FIRST_SAY = 0.01
_SCARCE = -4.0  # logit of an amount at the start: most cells hold nothing
_HARDLY = 1e-6  # amount of an object that a slot takes where nothing is left, so that it says something all the same
_PREFERENCE = 0.01  # by which the first cell's amount counts for more than the last's
_SAME_PX = 0.75 * STRIDE  # cells that put an object this near to each other mean the same one


class CellNetwork(StageNetwork):
    """Image to scene code by way of cells."""

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
        nn.init.normal_(last.weight, std=_FIRST_SAY)  # not 0: rotations of no length have no gradient
        assert last.bias is not None
        nn.init.zeros_(last.bias)
        with torch.no_grad():
            last.bias.view(len(kinds), -1)[:, 0] = _SCARCE
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
        """No raw values, and the code beside all that the cells say.

        While it learns, the code has a confidence in worlds of fixed numbers, too: drawn no surer than cells are, an
        image tells them which of them to be surer. Else image loss could not teach where to look.
        """
        each = self.cells(features).flatten(2).unflatten(1, (len(self._counts), sum(self._sizes))).transpose(2, 3)
        amounts, *raw = each.split(self._sizes, dim=-1)
        values = {field.name: self._physical(field.name, value) for field, value in zip(self._fields, raw, strict=True)}
        code = fill_slots(self.grid, self._counts, amounts[..., 0].sigmoid(), values)
        pooled = torch.cat([features.mean(dim=(2, 3)), features.amax(dim=(2, 3))], dim=1)
        code |= {field.name: field.activate(self.scene[field.name](pooled)) for field in self._of_scene}
        if CONFIDENCE not in self.layout and not self.training:
            del code[CONFIDENCE]
        known = {of_cells(name): value for name, value in values.items()}
        return {}, {**code, HEAT_MAP: amounts[..., 0], **known}

    def _physical(self, name: str, raw: Tensor) -> Tensor:
        if name != TRANSLATION:
            return self.layout[name].activate(raw)
        return self.grid.locate(self.grid.pixels + STRIDE * raw[..., :2], raw[..., 2:])


def fill_slots(
    grid: CellGrid, counts: Sequence[int], amounts: Float[Tensor, "batch kinds cells"], values: SceneCode
) -> dict[str, Tensor]:
    """One object after the other of each kind: where there is most, and what all the cells that mean it say of it.

    Args:
        grid: The cells.
        counts: Slots of each kind.
        amounts: How much of an object is at each cell, 0 to 1.
        values: What it would be like [batch, kinds, cells, size], positions among it.

    Returns:
        The values of each slot [batch, slots, size], means weighed by amounts, and the sum of those, which is at most
        1, as confidence.
    """
    found: dict[str, list[Tensor]] = {name: [] for name in (*values, CONFIDENCE)}
    pixels = grid.project(values[TRANSLATION])
    # Over a uniform background cells are alike up to the last digit: without a preference that would decide.
    preference = torch.linspace(1, 1 - _PREFERENCE, amounts.shape[-1], device=amounts.device)
    for kind, count in enumerate(counts):
        left, where = amounts[:, kind], pixels[:, kind]
        for _ in range(count):
            around = F.avg_pool2d(left.unflatten(1, (grid.rows, grid.columns))[:, None], 3, 1, 1)
            best = ((around.flatten(1) + left) * preference).argmax(dim=1, keepdim=True)
            there = where.gather(1, best[..., None].expand(-1, 1, 2))
            same = ((where - there).square().sum(dim=-1) < _SAME_PX**2).to(left.dtype)
            voices = (left * same + _HARDLY * F.one_hot(best[:, 0], left.shape[1]))[:, None]
            total = voices.sum(dim=-1, keepdim=True)
            found[CONFIDENCE].append(total.clamp(max=1))
            for name, value in values.items():
                found[name].append(voices @ value[:, kind] / total)
            left = left * (1 - same)
    return {name: torch.cat(slots, dim=1) for name, slots in found.items()}


def cell_error(
    layout: Layout, kinds: Sequence[Sequence[int]], grid: CellGrid, predicted: SceneCode, true: SceneCode
) -> Float[Tensor, " batch"]:
    """How far the cells are from the truth: cross entropy of the amounts, and Eq. 1's distances of the rest.

    Every object is shared out among the four cells around it; each of them is to say all of it. So no slot has to be
    assigned. Numbers of rotations count as they are, whatever their length: while nothing is known of a rotation none
    is better than another, but numbers near zero err less than others.
    """
    of_slot = torch.cat([torch.full((len(slots),), kind) for kind, slots in enumerate(kinds)])
    here = grid.share(grid.project(true[TRANSLATION]))
    present = true[CONFIDENCE] if CONFIDENCE in layout else torch.ones_like(true[TRANSLATION][..., :1])
    num_cells = predicted[HEAT_MAP].shape[2]
    here = Share(of_slot.to(here.cell)[:, None] * num_cells + here.cell, here.weight * present)
    names = [field.name for field in layout.fields if of_cells(field.name) in predicted]
    truth, error = canonical(true), heat_map_loss(predicted[HEAT_MAP].flatten(1), here)
    for name in names:
        field = layout[name]
        said = gather_cells(predicted[of_cells(name)].flatten(1, 2), here)
        distance = (field.relative(said) - field.relative(truth[name])[:, :, None]).norm(dim=-1)
        error = error + (distance * here.weight).sum(dim=(1, 2))
    for field in layout.fields:
        if not field.per_object:
            error = error + (field.relative(predicted[field.name]) - field.relative(true[field.name])).norm(dim=-1)
    return error
