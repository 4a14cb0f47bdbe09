"""From the latent code to the scene code (paper, appendix, table "Parameter MLP network")."""

from jaxtyping import Float
from torch import Tensor, nn

from curio_train.scene_code import Layout


def _branch(num_in: int, hidden: int, size: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(num_in, hidden), nn.ReLU(), nn.Linear(hidden, size))


class Heads(nn.Module):
    """A trunk shared by all objects, then a branch for each field of the layout.

    The trunk's output is cut into one row an object slot, so that each slot has its own features of the image; the
    branches' weights are shared among the slots. Fields of the whole scene, such as light, branch off the latent code
    itself. Circles gives the paper's smallest count, 4,387 parameters.
    """

    def __init__(self, layout: Layout, latent: int = 64, row: int = 32, hidden: int = 64) -> None:
        """Build the branches.

        Args:
            layout: The fields to predict.
            latent: Size of the latent code.
            row: Values a slot gets from the trunk.
            hidden: Width of the branches' hidden layer.
        """
        super().__init__()
        self.layout = layout
        self.row = row
        self.trunk = nn.Sequential(nn.Linear(latent, row * layout.num_slots), nn.ReLU())
        self.branches = nn.ModuleDict(
            {field.name: _branch(row if field.per_object else latent, hidden, field.size) for field in layout.fields}
        )

    def raw(self, latent: Float[Tensor, "batch latent"]) -> dict[str, Tensor]:
        """Outputs before activation: [batch, slots, size] for object fields, [batch, size] for the scene's."""
        rows = self.trunk(latent).unflatten(1, (self.layout.num_slots, self.row))
        return {
            field.name: self.branches[field.name](rows if field.per_object else latent) for field in self.layout.fields
        }
