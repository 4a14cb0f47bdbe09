"""Renderings over random backgrounds as a source of training images."""

import numpy as np
import torch
from torch import Tensor

from curio_train.data.backgrounds import Backgrounds
from curio_train.rendering.materials import random_appearances
from curio_train.scene_code import TRANSLATION
from curio_train.worlds.base import Batch, ImageSource, World

APPEARANCE = "appearance"
"""Key beside the code of training images: random surface properties other than colour, never predicted."""

_APPEARANCE_DRAWS = 1  # keeps these draws of a step apart from its others


class RenderedStream(ImageSource):
    """Images of a world over random backgrounds, rendered when they are asked for and never stored."""

    def __init__(
        self,
        world: World,
        backgrounds: Backgrounds,
        seed: tuple[int, ...],
        *,
        with_code: bool,
        given: tuple[str, ...] = (),
        random_appearance: bool = False,
    ) -> None:
        """Render nothing yet.

        Args:
            world: Draws and renders scenes.
            backgrounds: Of its images.
            seed: Decides every draw, with the step.
            with_code: Whether batches hold the true codes.
            given: Entries of the codes that are known of every image.
            random_appearance: Whether objects have random surface properties.
        """
        self._world, self._backgrounds, self._seed, self._with_code = world, backgrounds, seed, with_code
        self._given, self._random_appearance = given, random_appearance

    @torch.no_grad()
    def batch(self, step: int, size: int) -> Batch:
        """The images of one step, a function of seed and step alone."""
        seed = (*self._seed, step)
        code = self._world.sample(size, seed)
        if self._random_appearance:
            count, slots = code[TRANSLATION].shape[:2]
            drawn = random_appearances(count * slots, np.random.default_rng((*seed, _APPEARANCE_DRAWS)))
            code[APPEARANCE] = drawn.reshape(count, slots, -1)
        backgrounds = self.backgrounds(step, size)
        images = self._world.render(code, backgrounds)
        given = {name: code[name] for name in self._given}
        return Batch(images, backgrounds, code if self._with_code else None, given)

    def backgrounds(self, step: int, size: int) -> Tensor:
        """The backgrounds of one step's batch, without rendering the images."""
        camera = self._world.camera
        return self._backgrounds.draw(size, camera.width, camera.height, (*self._seed, step))
