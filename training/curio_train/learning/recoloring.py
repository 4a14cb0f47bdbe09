"""More colours from the same images: exchanging channels, where a world stays what it was.

Under white light and before grey, a scene whose colours have red and green exchanged looks like its image with these
channels exchanged, exactly. A network that is shown 2,000 images over and over otherwise learns places by colours.
"""

from dataclasses import replace

import numpy as np
import torch

from curio_train.scene_code import COLOR
from curio_train.worlds.base import Batch

_MARK = 2  # of these draws among all that a step makes


def recolored(batch: Batch, seed: tuple[int, ...]) -> Batch:
    """The batch with the channels of each image in one of their six orders, and true colours likewise.

    Args:
        batch: Images without backgrounds of their own.
        seed: Decides every draw.
    """
    num = len(batch.images)
    draws = np.random.default_rng((*seed, _MARK)).permuted(np.tile(np.arange(3), (num, 1)), axis=1)
    order = torch.from_numpy(draws).to(batch.images.device)
    images = batch.images.gather(1, order[:, :, None, None].expand_as(batch.images))
    if batch.code is None:
        return replace(batch, images=images)
    color = batch.code[COLOR]
    return replace(batch, images=images, code={**batch.code, COLOR: color.gather(2, order[:, None].expand_as(color))})
