"""What the network is to make small, beside curiosity."""

from jaxtyping import Float
from torch import Tensor

from curio_train.metrics.assignment import Groups, scene_error
from curio_train.scene_code import Layout, SceneCode


def image_loss(
    rendered: Float[Tensor, "batch 3 height width"], images: Float[Tensor, "batch 3 height width"]
) -> Float[Tensor, ""]:
    """Squared error summed over pixels and channels, mean over the batch.

    Summed, because the paper's weights (0.01 here, 10 for the critic) are of one size only then.
    """
    return (rendered - images).square().sum((1, 2, 3)).mean()


def supervised_loss(layout: Layout, predicted: SceneCode, true: SceneCode, groups: Groups) -> Float[Tensor, ""]:
    """Eq. 1 of the paper, mean over the batch: the very figure that codes are scored by.

    The assignment has no gradient, because it is constant around almost every code.
    """
    return scene_error(layout, predicted, true, groups).mean()
