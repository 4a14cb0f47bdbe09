"""Compares a photograph with the re-rendering of its scene code."""

from typing import NamedTuple

import cv2
import numpy as np
import torch

from curio_train.drawing.pictures import RenderOptions, picture
from curio_train.learning.losses import image_loss
from curio_train.viewing.pages import Page

HEIGHT_PX = 256
"""Height at which images are compared; smaller images keep their own."""

_SAMPLES = 4
_CONTRAST = 2.0  # of the difference, to be seen


class Comparison(NamedTuple):
    """An image beside its re-rendering; pictures are [height, width, 3] uint8 sRGB of one size."""

    image: np.ndarray
    rendering: np.ndarray
    difference: np.ndarray
    """Grey where both agree."""
    loss: float
    """The paper's image loss: squared difference, summed over pixels and channels."""
    shows_objects: bool
    """False where all of them are outside the picture or behind the camera: the loss then says nothing."""


def compare(page: Page) -> Comparison:
    """Render the page's scene and compare it with the page's image.

    Raises:
        DataError: An object has no mesh, or the photograph cannot be read any more.
        RendererError: There is no usable libLLVM.
    """
    options = RenderOptions(min(HEIGHT_PX, page.scene.height), samples=_SAMPLES)
    rendering = picture(page.scene, page.context, options, photograph=page.image if page.over_image else None)
    height, width = rendering.shape[:2]
    image = cv2.resize(page.image, (width, height), interpolation=cv2.INTER_AREA)
    signed = image.astype(np.float32) - rendering.astype(np.float32)
    difference = np.clip(128 + _CONTRAST * signed / 2, 0, 255).astype(np.uint8)
    loss = image_loss(_tensor(rendering), _tensor(image))
    return Comparison(image, rendering, difference, float(loss), not page.over_image or bool(np.any(signed)))


def _tensor(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
