"""From features to descriptors: centred, projected, of unit length, so that their product is a cosine."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

_SHORTEST = 1e-6
_REGULARISATION = 0.05  # of the mean variance


class Descriptors(nn.Module):
    """A linear map of features, then normalisation."""

    mean: Tensor
    """Mean of the features, [inputs]."""
    projection: Tensor
    """[outputs, inputs]."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(inputs))
        self.register_buffer("projection", torch.eye(outputs, inputs))

    def forward(
        self, features: Float[Tensor, "batch inputs height width"]
    ) -> Float[Tensor, "batch outputs height width"]:
        """Descriptors of unit length."""
        return normalised(F.conv2d(features - self.mean[:, None, None], self.projection[..., None, None]), dim=1)

    def centre(self, background: Float[Tensor, "batch inputs height width"]) -> None:
        """Take the mean of background; nothing is projected away."""
        self.mean.copy_(background.mean(dim=(0, 2, 3)))

    def whiten(self, background: Float[Tensor, "batch inputs height width"]) -> Float[Tensor, "inputs inputs"]:
        """Take the mean of background, and return the map that whitens it.

        What varies in every background says little (Hariharan et al. 2012, "Discriminative decorrelation").
        """
        self.centre(background)
        rows = (background - self.mean[:, None, None]).movedim(1, 0).flatten(1)
        covariance = rows @ rows.T / rows.shape[1]
        ridge = _REGULARISATION * covariance.diagonal().mean() * torch.eye(len(covariance))
        values, vectors = torch.linalg.eigh(covariance + ridge)
        return values.rsqrt()[:, None] * vectors.T

    def compress(
        self,
        whitening: Float[Tensor, "inputs inputs"],
        features: Float[Tensor, "templates inputs height width"],
        mask: Float[Tensor, "templates 1 height width"],
    ) -> None:
        """Keep the whitened directions in which the templates' descriptors are largest (PCA about zero)."""
        full = Descriptors(*whitening.shape)
        full.mean.copy_(self.mean)
        full.projection.copy_(whitening)
        rows = (full(features) * mask).movedim(1, 0).flatten(1)
        _, vectors = torch.linalg.eigh(rows @ rows.T)
        self.projection.copy_(vectors[:, -len(self.projection) :].T @ whitening)


def normalised(descriptors: Tensor, dim: int) -> Tensor:
    """Descriptors, whose channels are dimension ``dim``, scaled to unit length."""
    return descriptors / descriptors.square().sum(dim=dim, keepdim=True).clamp(min=_SHORTEST**2).sqrt()
