"""The templates of several objects side by side, so that a graph reads all objects in one batch."""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from curio_train.networks.templates.bank import COARSE_SIZE, LARGEST_BYTE, NUM_POINTS, RANK, Bank
from curio_train.networks.templates.descriptors import normalised
from curio_train.networks.templates.geometry import CROP_PX, NUM_ROLLS, NUM_VIEWS, viewpoints
from curio_train.networks.templates.trunk import COARSE_STRIDE, COARSE_WIDTH, FINE_WIDTH


class Banks(nn.Module):
    """One :class:`Bank` an object; the first axis of every buffer is the object's."""

    coarse_mean: Tensor
    """Of the features at stride 8, [objects, COARSE_WIDTH]."""
    coarse_projection: Tensor
    """[objects, COARSE_SIZE, COARSE_WIDTH]."""
    fine_mean: Tensor
    """Of the features at stride 4, [objects, FINE_WIDTH]."""
    filters: Tensor
    """[objects, RANK, COARSE_SIZE, cells, cells]."""
    weights: Tensor
    """[objects, templates, RANK]."""
    points: Tensor
    """[objects, templates, points, 3], diameters."""
    described: Tensor
    """[objects, templates, points, FINE_WIDTH], times 127."""
    rotations: Tensor
    """[templates, 3, 3], see :class:`Bank`."""

    def __init__(self, num_objects: int) -> None:
        super().__init__()
        num, side = NUM_VIEWS * NUM_ROLLS, CROP_PX // COARSE_STRIDE
        self.num_objects = num_objects
        for name, shape, dtype in (
            ("coarse_mean", (COARSE_WIDTH,), torch.float32),
            ("coarse_projection", (COARSE_SIZE, COARSE_WIDTH), torch.float32),
            ("fine_mean", (FINE_WIDTH,), torch.float32),
            ("filters", (RANK, COARSE_SIZE, side, side), torch.float16),
            ("weights", (num, RANK), torch.float16),
            ("points", (num, NUM_POINTS, 3), torch.float16),
            ("described", (num, NUM_POINTS, FINE_WIDTH), torch.int8),
        ):
            self.register_buffer(name, torch.zeros(num_objects, *shape, dtype=dtype))
        self.register_buffer("rotations", viewpoints(NUM_VIEWS, NUM_ROLLS), persistent=False)

    def put(self, number: int, bank: Bank) -> None:
        """Copy the templates of one object."""
        self.coarse_mean[number] = bank.coarse.mean
        self.coarse_projection[number] = bank.coarse.projection
        self.fine_mean[number] = bank.fine.mean
        for name in ("filters", "weights", "points", "described"):
            getattr(self, name)[number] = getattr(bank, name)

    def match(
        self, features: Float[Tensor, "batch objects num channels rows columns"]
    ) -> Float[Tensor, "batch objects num templates shifts"]:
        """Mean cosine over each template's silhouette, at every shift of whole cells."""
        batch, objects, num = features.shape[:3]
        centred = features - self.coarse_mean[:, None, :, None, None]
        side_by_side = centred.transpose(1, 2).flatten(2, 3).flatten(0, 1)  # [batch * num, objects * channels, …]
        projection = self.coarse_projection.flatten(0, 1)[..., None, None]
        projected = F.conv2d(side_by_side, projection, groups=objects).unflatten(1, (objects, COARSE_SIZE))
        described = normalised(projected, dim=2).flatten(1, 2)
        filtered = F.conv2d(described, self.filters.float().flatten(0, 1), groups=objects)
        filtered = filtered.unflatten(1, (objects, RANK)).flatten(3)  # [batch * num, objects, RANK, shifts]
        found = self.weights.float() @ filtered
        return found.unflatten(0, (batch, num)).transpose(1, 2)

    def fine(
        self, features: Float[Tensor, "batch*objects*num channels rows columns"], num: int
    ) -> Float[Tensor, "batch*objects*num channels rows columns"]:
        """Descriptors at stride 4 of crops, ``num`` an object."""
        by_object = features.unflatten(0, (-1, self.num_objects, num))
        return normalised(by_object - self.fine_mean[:, None, :, None, None], dim=3).flatten(0, 2)

    def surface(
        self, templates: Int[Tensor, "batch*objects num"]
    ) -> tuple[Float[Tensor, "batch*objects*num points 3"], Float[Tensor, "batch*objects*num points size"]]:
        """Points of templates, diameters, and their descriptors."""
        count = self.points.shape[1]
        of_objects = torch.arange(self.num_objects, device=templates.device)[:, None] * count
        index = (templates.unflatten(0, (-1, self.num_objects)) + of_objects).flatten()
        return (
            self.points.flatten(0, 1)[index].float(),
            self.described.flatten(0, 1)[index].float() / LARGEST_BYTE,
        )
