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


def blurred(
    images: Float[Tensor, "batch channels height width"], side: int = 9
) -> Float[Tensor, "batch channels height width"]:
    """Images behind a Gaussian filter of ``side`` x ``side`` pixels (paper, section "Real world data": 9x9).

    The paper does not give its width; by OpenCV's rule it is 0.3 ((side - 1) / 2 - 1) + 0.8 pixels, 1.7 of 9.
    """
    if side == 1:
        return images
    height, width = (_filter(size, side).to(images) for size in images.shape[-2:])
    return height @ images @ width.T


def _filter(size: int, side: int) -> Tensor:
    """The filter along one axis as a matrix [size, size], borders repeated; ten times quicker on a CPU."""
    reach = side // 2
    steps = torch.arange(-reach, reach + 1)
    weights = torch.exp(-0.5 * (steps / (0.3 * (reach - 1) + 0.8)).square())
    rows = torch.arange(size)[:, None]
    matrix = torch.zeros(size, size).scatter_add(
        1, (rows + steps).clamp(0, size - 1), (weights / weights.sum()).expand(size, -1)
    )
    return matrix
