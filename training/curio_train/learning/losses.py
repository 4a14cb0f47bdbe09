"""What the network is to make small, beside curiosity."""

from jaxtyping import Float
from torch import Tensor


def image_loss(
    rendered: Float[Tensor, "batch 3 height width"], images: Float[Tensor, "batch 3 height width"]
) -> Float[Tensor, ""]:
    """Squared error summed over pixels and channels, mean over the batch.

    Summed, because the paper's weights (0.01 here, 10 for the critic) are of one size only then.
    """
    return (rendered - images).square().sum((1, 2, 3)).mean()
