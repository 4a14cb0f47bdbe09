"""Crops around a detector's own first answers, for methods that compare re-renderings with training images.

The codes of the frames are never asked for. Each frame is cut where the localisation stage finds the object, right or
wrong, so what the crop-pose stage learns from is what it will see.

Training images come with their backgrounds. Photographs have none: there, the background of a crop is what surrounds
the place where the object was found, continued over that place.
"""

import copy
from collections.abc import Iterator
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from curio_train.data.photographs import read_frames
from curio_train.networks.base import StageNetwork
from curio_train.networks.crop_camera import cut_crops
from curio_train.refinement.found_frames import NUM_FRAMES
from curio_train.refinement.inpainting import inpainted
from curio_train.refinement.turned_frames import random_rolls
from curio_train.scene_code import TRANSLATION
from curio_train.worlds.base import Batch, ImageSource
from curio_train.worlds.single_object.crop_pose_loss import ASSUMED_DEPTH
from curio_train.worlds.single_object.crop_pose_stage import CROP_PX, FILL
from curio_train.worlds.single_object.localisation_stage import LOCALISATION_STRIDE
from curio_train.worlds.single_object.two_stage import TwoStageWorld

_A_FRAME = 8
"""Crops of each frame, around answers as wrong again as the crop-pose stage has to bear."""

_MARGIN_PX = 1.0
"""Pixels at an object's outline show it, too."""


class _Crops(NamedTuple):
    """Crops of all frames."""

    images: UInt8[Tensor, "crops 3 side side"]
    backgrounds: UInt8[Tensor, "crops 3 side side"]
    """The crops without the object."""
    assumed_depth_m: Float[Tensor, "crops 1"]


class OwnCrops(ImageSource):
    """Crops of a world's first training images and of its photographs, cut when the first batch is asked for."""

    def __init__(
        self,
        world: TwoStageWorld,
        localise: StageNetwork,
        frames: ImageSource,
        seed: int,
        photographed: float = 0.0,
        num_frames: int = NUM_FRAMES,
    ) -> None:
        """Cut nothing yet.

        Args:
            world: With both stages.
            localise: The localisation stage's network; trained by the time the first batch is asked for.
            frames: Whole frames with their backgrounds.
            seed: Of all draws.
            photographed: Fraction of each batch that shows the world's unlabelled photographs, if it has any.
            num_frames: How many frames are cut.
        """
        assert world.camera.matrix is not None
        self._world, self._photographed = world, photographed
        self._stage, self._near_m = world.stages[1], world.object.near_m
        self._matrix = torch.from_numpy(np.asarray(world.camera.matrix)).float()
        self._localise, self._frames, self._seed, self._num_frames = localise, frames, seed, num_frames

    def batch(self, step: int, size: int) -> Batch:
        """Random crops.

        Raises:
            DataError: A photograph cannot be read, or is not of the camera's size.
        """
        crops, num_frames, random = self._crops, _A_FRAME * self._num_frames, np.random.default_rng((self._seed, step))
        rows = random.integers(num_frames, size=size)
        if len(crops.images) > num_frames:
            num_photographed = round(self._photographed * size)
            rows[:num_photographed] = random.integers(num_frames, len(crops.images), size=num_photographed)
        images, backgrounds = (values[rows].float() / 255 for values in (crops.images, crops.backgrounds))
        return Batch(images, backgrounds, given={ASSUMED_DEPTH: crops.assumed_depth_m[rows]})

    @cached_property
    def _crops(self) -> _Crops:
        """Crops of the frames, then of the photographs."""
        localise = copy.deepcopy(self._localise).cpu().eval()  # frames are cut there, and its batch norm stays as it is
        with torch.no_grad():
            parts = []
            for number in range(self._num_frames):
                frame = self._frames.batch(number, 1)
                assert frame.backgrounds is not None
                parts.append(self._of_frame(frame.images, frame.backgrounds, localise, (number, 1)))
            parts += [
                self._of_frame(photograph[None].float() / 255, None, localise, (number, 2))
                for number, photograph in enumerate(self._photographs())
            ]
        return _Crops(*(torch.cat(values) for values in zip(*parts, strict=True)))

    def _photographs(self) -> Iterator[Tensor]:
        """One after the other, uint8 [3, height, width], in the size of the world's camera."""
        if self._photographed and self._world.photographs is not None:
            camera = self._world.camera
            for path in self._world.photographs.unlabelled_paths():
                frames = read_frames([path], self._world.object.camera, camera.width, camera.height)
                yield torch.from_numpy(frames)[0]

    def _of_frame(
        self, image: Tensor, background: Tensor | None, localise: StageNetwork, draw: tuple[int, ...]
    ) -> _Crops:
        """Crops of a frame [1, 3, height, width] in [0, 1] and of its background, where that is known."""
        random = np.random.default_rng((self._seed, *draw))
        answer_m = localise(F.avg_pool2d(image, LOCALISATION_STRIDE))[TRANSLATION][0, 0]
        looked_at_m = self._stage.perturbed(answer_m.expand(_A_FRAME, 3), random)
        depth_m = looked_at_m.norm(dim=1).clamp(min=self._near_m)
        focal_px = FILL * CROP_PX * depth_m / self._stage.object.kind.diameter_m
        turn = random_rolls(_A_FRAME, random)
        cut = partial(cut_crops, position_m=looked_at_m[None], focal_px=focal_px, side=CROP_PX, roll=turn)
        seen, crop_from_cam = cut(image, self._matrix)
        if background is None:
            behind = inpainted(seen, self._around(crop_from_cam @ answer_m, focal_px))
        else:
            behind = cut(background, self._matrix)[0]
        seen, behind = ((values.clamp(0, 1) * 255).round().byte() for values in (seen, behind))
        return _Crops(seen, behind, depth_m[:, None])

    def _around(self, position_m: Float[Tensor, "crops 3"], focal_px: Float[Tensor, " crops"]) -> Bool[Tensor, "..."]:
        """The pixels [crops, 1, side, side] in which an object may be seen at a position in a crop camera's frame."""
        pixel = torch.arange(CROP_PX) - (CROP_PX - 1) / 2
        x, y = (
            focal_px[:, None, None] * position_m[:, axis, None, None] / position_m[:, 2, None, None] for axis in (0, 1)
        )
        radius = focal_px * self._stage.object.kind.diameter_m / 2 / position_m[:, 2]
        distance = torch.hypot(pixel[None, None, :] - x, pixel[None, :, None] - y)
        return (distance <= radius[:, None, None] + _MARGIN_PX)[:, None]
