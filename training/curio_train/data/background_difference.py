"""Where photographs of a scene differ from a photograph of it empty, and where that is no more than a shadow.

Each photograph is brought to the background image's exposure and white balance first. What clearly differs is parts and
their shadows; what is merely darker than the background image, in the background image's own tint, is a shadow.
"""

from typing import NamedTuple

from jaxtyping import Bool, Float
from torch import Tensor

from curio_train.color import linear_from_srgb, srgb_from_linear

_LEAST_DIFFERENCE, _DEVIATIONS = 0.08, 6.0  # sRGB; what noise, vignettes and drifting light do not reach
_SHADOW_TINT = 0.25  # how far the logarithms of a shadow's three ratios to the background image may lie apart
_LEAST_LIGHT = 1e-3


class BackgroundDifference(NamedTuple):
    """Photographs beside their background image."""

    difference: Float[Tensor, "num height width"]
    """Largest of the three channels', sRGB, exposure allowed for."""
    differs: Bool[Tensor, "num height width"]
    """Pixels where the difference is clear."""
    shaded: Bool[Tensor, "num height width"]
    """Pixels where the photograph is the background image made darker."""


def compare(
    photographs: Float[Tensor, "num 3 height width"], background_image: Float[Tensor, "3 height width"]
) -> BackgroundDifference:
    """Compare photographs with the empty scene, both sRGB in [0, 1]."""
    light, empty = linear_from_srgb(photographs), linear_from_srgb(background_image)
    ratio = (light + _LEAST_LIGHT) / (empty + _LEAST_LIGHT)
    ratio = ratio / ratio.flatten(2).median(dim=2).values[..., None, None]
    difference = (srgb_from_linear(empty * ratio) - background_image).abs().amax(dim=1)
    level = _median(difference)
    limit = (level + _DEVIATIONS * 1.4826 * _median((difference - level).abs())).clamp(min=_LEAST_DIFFERENCE)
    logs = ratio.clamp(min=_LEAST_LIGHT).log()
    shaded = (logs.amax(dim=1) - logs.amin(dim=1) < _SHADOW_TINT) & (logs.mean(dim=1) < 0)
    return BackgroundDifference(difference, difference > limit, shaded)


def _median(images: Tensor) -> Float[Tensor, "num 1 1"]:
    """The median of each image."""
    return images.flatten(1).median(dim=1).values[:, None, None]
