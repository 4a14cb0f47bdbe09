"""The templates of several objects side by side, compressed, so that a graph reads all objects in one batch."""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from curio_train.networks.templates.bank import COARSE_SIZE, NUM_OUTLINE_POINTS, NUM_POINTS, RANK, Bank
from curio_train.networks.templates.descriptors import normalised
from curio_train.networks.templates.geometry import CROP_PX, NUM_ROLLS, num_views, viewpoints
from curio_train.networks.templates.quantisation import CODEWORDS, LARGEST_BYTE, to_bytes, to_codes
from curio_train.networks.templates.trunk import COARSE_STRIDE, COARSE_WIDTH, FINE_WIDTH

_PARTS = 4
"""Parts of a fine descriptor, each stored as the number of a codeword."""


class Banks(nn.Module):
    """One :class:`Bank` an object, in 1.3 MB; the first axis of every buffer is the object's."""

    coarse_mean: Tensor
    """Mean of the features at stride 8, [objects, COARSE_WIDTH]."""
    coarse_projection: Tensor
    """[objects, COARSE_SIZE, COARSE_WIDTH]."""
    fine_mean: Tensor
    """Mean of the features at stride 4, [objects, FINE_WIDTH]."""
    filters: Tensor
    """Bytes [objects, RANK, COARSE_SIZE, cells, cells]."""
    weights: Tensor
    """Bytes [objects, templates, RANK]."""
    match_scale: Tensor
    """Product of the scales of the bytes of filters and of weights, [objects, RANK]."""
    points: Tensor
    """Bytes [objects, templates, points, 3]."""
    points_scale: Tensor
    """Diameters a unit, [objects]."""
    codes: Tensor
    """Bytes [objects, templates, points, parts]: codewords of the points' fine descriptors."""
    codewords: Tensor
    """[objects, parts, CODEWORDS, FINE_WIDTH / parts]."""
    outline: Tensor
    """Bytes [objects, directions, points, 3]."""
    outline_scale: Tensor
    """Diameters a unit, [objects]."""
    outward: Tensor
    """Bytes [objects, directions, points, 3]; their lengths do not matter."""
    rotations: Tensor
    """cam_from_obj of an object on the optical axis, [templates, 3, 3]; the same for every object."""

    def __init__(self, num_objects: int, any_side: bool = False) -> None:
        super().__init__()
        views, side = num_views(any_side), CROP_PX // COARSE_STRIDE
        num = views * NUM_ROLLS
        for name, shape, dtype in (
            ("coarse_mean", (COARSE_WIDTH,), torch.float32),
            ("coarse_projection", (COARSE_SIZE, COARSE_WIDTH), torch.float32),
            ("fine_mean", (FINE_WIDTH,), torch.float32),
            ("filters", (RANK, COARSE_SIZE, side, side), torch.int8),
            ("weights", (num, RANK), torch.int8),
            ("match_scale", (RANK,), torch.float32),
            ("points", (num, NUM_POINTS, 3), torch.int8),
            ("points_scale", (), torch.float32),
            ("codes", (num, NUM_POINTS, _PARTS), torch.uint8),
            ("codewords", (_PARTS, CODEWORDS, FINE_WIDTH // _PARTS), torch.float16),
            ("outline", (views, NUM_OUTLINE_POINTS, 3), torch.int8),
            ("outline_scale", (), torch.float32),
            ("outward", (views, NUM_OUTLINE_POINTS, 3), torch.int8),
        ):
            self.register_buffer(name, torch.zeros(num_objects, *shape, dtype=dtype))
        self.register_buffer("rotations", viewpoints(views, NUM_ROLLS, any_side), persistent=False)

    def put(self, number: int, bank: Bank) -> None:
        """Compress and keep the templates of one object."""
        self.coarse_mean[number] = bank.coarse.mean
        self.coarse_projection[number] = bank.coarse.projection
        self.fine_mean[number] = bank.fine.mean
        self.put_filters(number, bank.filters, bank.weights)
        points, of_points = to_bytes(bank.points.flatten()[None])
        self.points[number] = points.view_as(self.points[number])
        self.points_scale[number] = of_points[0]
        self.put_described(number, bank.described)
        outline, of_outline = to_bytes(bank.outline.flatten()[None])
        self.outline[number] = outline.view_as(self.outline[number])
        self.outline_scale[number] = of_outline[0]
        self.outward[number] = (LARGEST_BYTE * bank.outward).round().to(torch.int8)

    def put_filters(
        self, number: int, filters: Float[Tensor, "rank size cells cells"], weights: Float[Tensor, "templates rank"]
    ) -> None:
        """Compress and keep whole templates of one object, weighted sums of few filters."""
        in_bytes, of_filters = to_bytes(filters.flatten(1))
        weights_in_bytes, of_weights = to_bytes(weights.T)
        self.filters[number] = in_bytes.view_as(self.filters[number])
        self.weights[number] = weights_in_bytes.T
        self.match_scale[number] = of_filters * of_weights

    def put_described(self, number: int, described: Float[Tensor, "templates points channels"]) -> None:
        """Compress and keep the fine descriptors of one object's surface points."""
        codes, codewords = to_codes(described.flatten(0, 1), _PARTS)
        self.codes[number] = codes.view_as(self.codes[number])
        self.codewords[number] = codewords

    def templates(self, number: int) -> Float[Tensor, "templates size cells cells"]:
        """Whole templates of one object, as :meth:`match` uses them."""
        weights = self.weights[number].float() * self.match_scale[number]
        return (weights @ self.filters[number].float().flatten(1)).unflatten(1, self.filters.shape[2:])

    def coarse_of(
        self, number: int, features: Float[Tensor, "batch channels rows columns"]
    ) -> Float[Tensor, "batch size rows columns"]:
        """Descriptors at stride 8 as templates of one object have them."""
        centred = features - self.coarse_mean[number][:, None, None]
        return normalised(F.conv2d(centred, self.coarse_projection[number][..., None, None]), dim=1)

    def match(
        self, features: Float[Tensor, "batch asked num channels rows columns"], slots: Int[Tensor, " asked"]
    ) -> Float[Tensor, "batch asked num templates shifts"]:
        """Mean cosine over each template's silhouette, at every shift of whole cells, of the objects in ``slots``."""
        columns, side = features.shape[-1], self.filters.shape[-1]
        centred = features.flatten(-2).transpose(-1, -2) - self.coarse_mean.index_select(0, slots)[:, None, None]
        described = normalised(centred @ self.coarse_projection.index_select(0, slots).transpose(1, 2)[:, None], dim=-1)
        cells = _windows(columns, side).to(features.device)
        windows = described.index_select(-2, cells.flatten()).unflatten(-2, cells.shape).flatten(-2)
        # As floats before the choice: a runtime then converts them once, not with every image.
        filters = self.filters.permute(0, 1, 3, 4, 2).flatten(2).float().index_select(0, slots)
        filtered = (
            filters[:, None] @ windows.transpose(-1, -2) * self.match_scale.index_select(0, slots)[:, None, :, None]
        )
        found: Tensor = self.weights.float().index_select(0, slots)[:, None] @ filtered
        return found

    def fine(
        self, features: Float[Tensor, "batch*asked*num channels rows columns"], slots: Int[Tensor, " asked"], num: int
    ) -> Float[Tensor, "batch*asked*num channels rows columns"]:
        """Descriptors at stride 4 of crops, ``num`` an object."""
        by_object = features.unflatten(0, (-1, slots.shape[0], num))
        return normalised(by_object - self.fine_mean.index_select(0, slots)[:, None, :, None, None], dim=3).flatten(
            0, 2
        )

    def surface(
        self, templates: Int[Tensor, "batch*asked num"], slots: Int[Tensor, " asked"]
    ) -> tuple[Float[Tensor, "batch*asked*num points 3"], Float[Tensor, "batch*asked*num points size"]]:
        """Points of templates, diameters, and their descriptors."""
        count, by_object = self.points.shape[1], templates.unflatten(0, (-1, slots.shape[0]))
        number = slots[:, None].expand_as(by_object).flatten()
        row = number * count + by_object.flatten()
        points = (
            self.points.flatten(0, 1).index_select(0, row).float()
            * self.points_scale.index_select(0, number)[:, None, None]
        )
        first = number[:, None, None] * _PARTS + torch.arange(_PARTS, device=templates.device)
        codeword = first * CODEWORDS + self.codes.flatten(0, 1).index_select(0, row).long()
        described = self.codewords.flatten(0, 2).float().index_select(0, codeword.flatten())
        return points, described.unflatten(0, codeword.shape).flatten(2)

    def outlines(
        self, templates: Int[Tensor, " batch*asked"], slots: Int[Tensor, " asked"]
    ) -> tuple[Float[Tensor, "batch*asked points 3"], Float[Tensor, "batch*asked points 3"]]:
        """Points on the outlines of templates, diameters, and vectors out of them; a template an object."""
        number = slots.expand(templates.unflatten(0, (-1, slots.shape[0])).shape).flatten()
        row = number * self.outline.shape[1] + torch.div(templates, NUM_ROLLS, rounding_mode="floor")
        points = (
            self.outline.flatten(0, 1).index_select(0, row).float()
            * self.outline_scale.index_select(0, number)[:, None, None]
        )
        return points, self.outward.flatten(0, 1).index_select(0, row).float()


def _windows(columns: int, side: int) -> Int[Tensor, "shifts side*side"]:
    """Numbers of the cells of a square map, in every square of ``side`` cells that lies in it."""
    of_cells = torch.arange(columns * columns).unflatten(0, (columns, columns))
    return of_cells.unfold(0, side, 1).unfold(1, side, 1).flatten(2).flatten(0, 1)
