"""Scenes with several different objects, each at most once: in each other's way, under one light."""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from curio_train.data.augmentation import WHOLE_FRAME, augment
from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix
from curio_train.rendering.renderer import Renderer
from curio_train.scene_code import CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION, Layout, SceneCode
from curio_train.worlds.base import SPLITS, Camera, Split, World, jitter_seed
from curio_train.worlds.rendered_stream import APPEARANCE, RenderedStream
from curio_train.worlds.single_object.viewpoints import (
    AMBIENT,
    MILD_EXPOSURE,
    MIN_LIGHT,
    allocentric_to_egocentric,
    random_exposures,
    random_lights,
    random_positions,
)
from curio_train.worlds.single_object.world import EXPOSURE, Object, position_field

PRESENT = 0.6
"""Probability that a scene shows an object."""


class ObjectScenes(World):
    """Several objects anywhere in the frame of a pinhole camera, one slot each."""

    def __init__(self, name: str, members: Sequence[Object], camera: Camera, layout: Layout) -> None:
        """Hold the objects.

        Args:
            name: As on the command line; of a stage, as in the names of its losses.
            members: The objects, each with the slot of its place in this order; their backgrounds are the first's.
            camera: Of the images, with a matrix.
            layout: Of the scene code.
        """
        self.name, self.members, self.camera, self.layout = name, tuple(members), camera, layout
        self.objects = tuple(member.kind for member in members)

    def sample(self, count: int, seed: tuple[int, ...]) -> dict[str, Tensor]:
        """Each object is there or not, anywhere in the frame; all under one light."""
        random, num = np.random.default_rng(seed), len(self.members)
        position, rotation, exposure = [], [], []
        for member in self.members:
            position.append(random_positions(position_field(member), count, random))
            rotation.append(allocentric_to_egocentric(position[-1], member.rotations(count, random)))
            exposure.append(random_exposures(count, random, MILD_EXPOSURE))
        present = torch.from_numpy(random.random((count, num, 1)) < PRESENT).float()
        return {
            TRANSLATION: torch.stack(position, dim=1),
            ROTATION_6D: rotation_6d_from_matrix(torch.stack(rotation, dim=1)),
            EXPOSURE: torch.cat(exposure, dim=1),
            CONFIDENCE: present,
            LIGHT: random_lights(count, random, MIN_LIGHT),
        }

    def render(self, code: SceneCode, backgrounds: Tensor | None = None) -> Tensor:
        """The objects over ``backgrounds``, or over black; those of low confidence fade."""
        position = code[TRANSLATION].float()
        assert self.camera.matrix is not None
        size = (len(position), 3, self.camera.height, self.camera.width)
        return self._renderer(
            matrix_from_rotation_6d(code[ROTATION_6D].float()),
            position,
            camera_matrix=self.camera.matrix,
            backgrounds=position.new_zeros(size) if backgrounds is None else backgrounds,
            light=code[LIGHT].float(),
            color=code.get(EXPOSURE),
            confidence=code[CONFIDENCE][..., 0].float(),
            appearance=code.get(APPEARANCE),
            seed=jitter_seed(code),
        )

    def augment(self, images: Tensor, seed: tuple[int, ...]) -> Tensor:
        """Renderings as real cameras and scenes change them, see :func:`~curio_train.data.augmentation.augment`."""
        return augment(images, np.random.default_rng(seed), WHOLE_FRAME)

    def source(self, split: Split, seed: int, *, with_code: bool, cache: Path) -> RenderedStream:
        """An endless stream of renderings; the splits differ in poses and in backgrounds."""
        training = split == "train"
        backgrounds = self.members[0].backgrounds(cache).split(training)
        seeds = SPLITS.index(split), seed
        return RenderedStream(self, backgrounds, seeds, with_code=with_code, random_appearance=training)

    @cached_property
    def _renderer(self) -> Renderer:
        meshes = [member.mesh for member in self.members]
        return Renderer(meshes, range(len(meshes)), self.camera.width, self.camera.height, ambient=AMBIENT)
