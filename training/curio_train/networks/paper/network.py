"""The paper's network: encoder and heads (paper, appendix, tables "AlexNet encoder" and "Parameter MLP network")."""

from jaxtyping import Float
from torch import Tensor, nn

from curio_train.config import ConvStack, NetworkConfig
from curio_train.errors import UsageError
from curio_train.networks.base import StageNetwork
from curio_train.scene_code import Layout


class Encoder(nn.Module):
    """Image to latent code: an AlexNet without pooling, five strided convolutions, each with batch norm and ReLU.

    The paper's table leaves batch norm out of the last layer; its count of 2,029,056 parameters has it in.
    """

    def __init__(self, stack: ConvStack) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for num_in, width, kernel, stride, padding in zip(
            (3, *stack.widths), stack.widths, stack.kernels, stack.strides, stack.paddings, strict=False
        ):
            layers += [nn.Conv2d(num_in, width, kernel, stride, padding), nn.BatchNorm2d(width), nn.ReLU()]
        self.layers = nn.Sequential(*layers)

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch latent"]:
        """Latent codes of sRGB images in [0, 1]."""
        latent: Tensor = self.layers(images).flatten(1)
        return latent


def _branch(num_in: int, hidden: int, size: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(num_in, hidden), nn.ReLU(), nn.Linear(hidden, size))


class Heads(nn.Module):
    """Latent code to raw scene code: a trunk shared by all objects, then a branch for each field of the layout.

    The trunk's output is cut into one row per object slot, so that each slot has its own features of the image; the
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


class PoseNetwork(StageNetwork):
    """Encoder and heads together: image to scene code, all that remains of training at test time."""

    def __init__(self, layout: Layout, image_side: int = 128, config: NetworkConfig | None = None) -> None:
        """Build for square images of ``image_side`` pixels.

        Raises:
            UsageError: The encoder's strides do not reduce such an image to one pixel.
        """
        super().__init__()
        config = config or NetworkConfig()
        left = config.encoder.output_side(image_side)
        if left != 1:
            raise UsageError(
                f"encoder {config.encoder} leaves {left} pixels a side of an image of {image_side}, expected 1: "
                "change its strides or kernels"
            )
        self.encoder = Encoder(config.encoder)
        self.heads = Heads(layout, config.encoder.widths[-1], config.row, config.hidden)

    def decode(self, latent: Float[Tensor, "batch latent"]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """The heads' raw outputs of a latent code, and the scene code."""
        raw = self.heads.raw(latent)
        return raw, self.heads.layout.activate(raw)
