"""Image loss, and the adversarial losses of curiosity.

The paper (section "Differentiable Rendering with Curiosity") adds λ · C(R(E(I))) to the image loss and names no
adversarial loss. We read it as the non-saturating binary cross-entropy on logits.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import softplus

Images = Float[Tensor, "batch 3 height width"]
Judge = Callable[[Tensor], Tensor]
"""The critic: images to logits [batch], positive for "data"."""


def image_loss(rendered: Images, images: Images) -> Float[Tensor, ""]:
    """Squared error summed over pixels and channels, mean over the batch.

    The paper's weights (0.01 for this loss, 10 for the critic) balance the two only if it is a sum.
    """
    return (rendered - images).square().sum((1, 2, 3)).mean()


def curiosity_loss(judge: Judge, rendered: Images) -> Tensor:
    """The encoder's term: -log of the critic's probability that the renderings are data, mean over the batch.

    Unlike the saturating log(1 - C) its gradient is largest where the critic is surest that they are not.
    """
    return softplus(-judge(rendered)).mean()


def critic_loss(judge: Judge, images: Images, rendered: Images) -> Tensor:
    """The critic's own loss: binary cross-entropy of telling data from renderings, means over the batch.

    The two batches are judged apart, so that batch norm cannot leak which is which.
    """
    return softplus(-judge(images)).mean() + softplus(judge(rendered.detach())).mean()


def gradient_penalty(judge: Judge, images: Images) -> Tensor:
    """R1 of Mescheder et al. 2018: half the squared gradient of the logits at the data, mean over the batch.

    It keeps the critic flat around the data, so that its gradient elsewhere stays a usable direction.
    """
    images = images.detach().requires_grad_()
    (slope,) = torch.autograd.grad(judge(images).sum(), images, create_graph=True)
    return slope.float().square().sum((1, 2, 3)).mean() / 2


@contextmanager
def frozen(critic: nn.Module) -> Iterator[None]:
    """Gradients pass through the critic to the images and leave its parameters without one."""
    critic.requires_grad_(False)
    try:
        yield
    finally:
        critic.requires_grad_(True)
