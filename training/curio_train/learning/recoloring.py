"""Colour augmentation by permuting channels, exact in worlds with white light and a grey background.

There, exchanging red and green in the image equals exchanging them in the objects' colours. Without it a network that
sees 2,000 images over and over memorises positions by colour.
"""

from dataclasses import replace

import numpy as np
import torch

from curio_train.scene_code import COLOR
from curio_train.worlds.base import Batch

_RECOLOR = 2  # keeps these draws apart from a step's other ones


def recolored(batch: Batch, seed: tuple[int, ...]) -> Batch:
    """The batch with the channels of each image, and of its true colours, in one of their six orders.

    Args:
        batch: Images without backgrounds of their own.
        seed: Decides every draw.
    """
    num = len(batch.images)
    draws = np.random.default_rng((*seed, _RECOLOR)).permuted(np.tile(np.arange(3), (num, 1)), axis=1)
    order = torch.from_numpy(draws).to(batch.images.device)
    images = batch.images.gather(1, order[:, :, None, None].expand_as(batch.images))
    if batch.code is None:
        return replace(batch, images=images)
    color = batch.code[COLOR]
    return replace(batch, images=images, code={**batch.code, COLOR: color.gather(2, order[:, None].expand_as(color))})
