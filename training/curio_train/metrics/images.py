"""Image errors."""

import torch
from jaxtyping import Float
from skimage.metrics import structural_similarity
from torch import Tensor


def dssim(
    rendered: Float[Tensor, "batch channels height width"], truth: Float[Tensor, "batch channels height width"]
) -> Float[Tensor, " batch"]:
    """Structural dissimilarity (1 - SSIM) / 2 of each pair of images in [0, 1]; 0 where they are equal.

    SSIM (Wang et al. 2004) with scikit-image's defaults: a uniform 7x7 window, mean over channels. The paper's image
    error is the mean of this over all images, and ratios are ratios of such means.
    """
    pairs = zip(rendered.detach().cpu().double().numpy(), truth.detach().cpu().double().numpy(), strict=True)
    similarity = [structural_similarity(a, b, channel_axis=0, data_range=1.0) for a, b in pairs]
    return (1 - torch.tensor(similarity, dtype=torch.float64)) / 2
