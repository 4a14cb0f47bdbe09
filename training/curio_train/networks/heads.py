"""From the latent code to the scene code (paper, appendix, table "Parameter MLP network")."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from curio_train.scene_code import TRANSLATION, Layout


def _branch(num_in: int, hidden: int, size: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(num_in, hidden), nn.ReLU(), nn.Linear(hidden, size))


class Heads(nn.Module):
    """A trunk shared by all objects, then a branch for each field of the layout.

    The trunk's output is cut into one row an object slot, so that each slot has its own features of the image; the
    branches' weights are shared among the slots. Fields of the whole scene, such as light, branch off the latent code
    itself. Circles gives the paper's smallest count, 4,387 parameters.
    """

    def __init__(
        self, layout: Layout, latent: int = 64, row: int = 32, hidden: int = 64, *, placed: bool = False
    ) -> None:
        """Build the branches.

        Args:
            layout: The fields to predict.
            latent: Size of the latent code.
            row: Values a slot gets from the trunk.
            hidden: Width of the branches' hidden layer.
            placed: The latent code is followed by a place (x, y), −1 to 1, to which the position's first two values
                are relative; an affine map from places to shares of the position's range is learned.
        """
        super().__init__()
        self.place: nn.Linear | None = None
        if placed:
            self.place = nn.Linear(2, 2)
            nn.init.eye_(self.place.weight)
            nn.init.zeros_(self.place.bias)
            latent += 2
        self.layout = layout
        self.row = row
        self.trunk = nn.Sequential(nn.Linear(latent, row * layout.num_slots), nn.ReLU())
        self.branches = nn.ModuleDict(
            {field.name: _branch(row if field.per_object else latent, hidden, field.size) for field in layout.fields}
        )

    def raw(self, latent: Float[Tensor, "batch latent"]) -> dict[str, Tensor]:
        """Outputs before activation: [batch, slots, size] for object fields, [batch, size] for the scene's."""
        rows = self.trunk(latent).unflatten(1, (self.layout.num_slots, self.row))
        raw = {
            field.name: self.branches[field.name](rows if field.per_object else latent) for field in self.layout.fields
        }
        if self.place is not None:
            shares = self.place(latent[:, None, -2:])
            lateral = self.layout[TRANSLATION].raw_from_share(shares)
            raw[TRANSLATION] = torch.cat([raw[TRANSLATION][..., :2] + lateral, raw[TRANSLATION][..., 2:]], dim=-1)
        return raw

    def forward(self, latent: Float[Tensor, "batch latent"]) -> dict[str, Tensor]:
        """The scene code in physical units, in the shapes of :meth:`raw`."""
        return self.layout.activate(self.raw(latent))
