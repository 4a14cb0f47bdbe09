"""Templates out of descriptors: mean cosines over silhouettes, and their compression."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from scipy.linalg import eigh
from torch import Tensor


def mean_cosine(descriptors: Tensor, mask: Float[Tensor, "templates 1 height width"]) -> Tensor:
    """Templates whose product with a picture's descriptors is the mean cosine over their silhouettes."""
    return F.normalize(descriptors, dim=1) * mask / mask.sum(dim=(1, 2, 3), keepdim=True).clamp(min=1e-6)


def low_rank(templates: Float[Tensor, "templates size height width"], rank: int) -> tuple[Tensor, Tensor]:
    """Filters [rank, size, height, width] and weights [templates, rank] whose products are nearly the templates."""
    rows = templates.flatten(1)
    last = len(rows) - 1  # the largest are last
    _, vectors = eigh((rows @ rows.T).numpy(), subset_by_index=[last + 1 - rank, last])
    weights = torch.from_numpy(vectors)
    return (weights.T @ rows).unflatten(1, templates.shape[1:]), weights
