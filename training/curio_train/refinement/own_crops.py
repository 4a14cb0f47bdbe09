"""Crops around a detector's own first answers, for methods that compare re-renderings with training images.

The codes of the frames are never asked for. Each frame is cut where the localisation stage finds the object, right or
wrong, so what the crop-pose stage learns from is what it will see.
"""

import copy
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from curio_train.networks.base import StageNetwork
from curio_train.networks.crop_camera import cut_crops
from curio_train.refinement.found_frames import NUM_FRAMES
from curio_train.refinement.turned_frames import random_rolls
from curio_train.scene_code import TRANSLATION
from curio_train.worlds.base import Batch, ImageSource
from curio_train.worlds.single_object.crop_pose_loss import ASSUMED_DEPTH
from curio_train.worlds.single_object.crop_pose_stage import CROP_PX, FILL
from curio_train.worlds.single_object.localisation_stage import LOCALISATION_STRIDE
from curio_train.worlds.single_object.two_stage import TwoStageWorld

_A_FRAME = 8
"""Crops of each frame, around answers as wrong again as the crop-pose stage has to bear."""


class _Crops(NamedTuple):
    """Of all frames."""

    images: UInt8[Tensor, "crops 3 side side"]
    backgrounds: UInt8[Tensor, "crops 3 side side"]
    """The same without the object."""
    assumed_depth_m: Float[Tensor, "crops 1"]


class OwnCrops(ImageSource):
    """Crops of the first frames of a world's training images, cut when the first batch is asked for."""

    def __init__(
        self,
        world: TwoStageWorld,
        localise: StageNetwork,
        frames: ImageSource,
        seed: int,
        num_frames: int = NUM_FRAMES,
    ) -> None:
        """Cut nothing yet.

        Args:
            world: With both stages.
            localise: The localisation stage's network; trained by the time the first batch is asked for.
            frames: Whole frames with their backgrounds.
            seed: Of all draws.
            num_frames: How many of them are cut.
        """
        assert world.camera.matrix is not None
        self._stage, self._near_m = world.stages[1], world.object.near_m
        self._matrix = torch.from_numpy(np.asarray(world.camera.matrix)).float()
        self._localise, self._frames, self._seed, self._num_frames = localise, frames, seed, num_frames

    def batch(self, step: int, size: int) -> Batch:
        """Random crops."""
        crops = self._crops
        rows = torch.from_numpy(np.random.default_rng((self._seed, step)).integers(len(crops.images), size=size))
        images, backgrounds = (values[rows].float() / 255 for values in (crops.images, crops.backgrounds))
        return Batch(images, backgrounds, given={ASSUMED_DEPTH: crops.assumed_depth_m[rows]})

    @cached_property
    def _crops(self) -> _Crops:
        localise = copy.deepcopy(self._localise).cpu().eval()  # frames are cut there, and its batch norm stays as it is
        with torch.no_grad():
            parts = [self._of_frame(number, localise) for number in range(self._num_frames)]
        return _Crops(*(torch.cat(values) for values in zip(*parts, strict=True)))

    def _of_frame(self, number: int, localise: StageNetwork) -> _Crops:
        frame, random = self._frames.batch(number, 1), np.random.default_rng((self._seed, number, 1))
        assert frame.backgrounds is not None
        answer_m = localise(F.avg_pool2d(frame.images, LOCALISATION_STRIDE))[TRANSLATION][0, 0]
        looked_at_m = self._stage.perturbed(answer_m.expand(_A_FRAME, 3), random)
        depth_m = looked_at_m.norm(dim=1).clamp(min=self._near_m)
        focal_px = FILL * CROP_PX * depth_m / self._stage.object.kind.diameter_m
        turn = random_rolls(_A_FRAME, random)
        seen, behind = (
            (cut_crops(images, self._matrix, looked_at_m[None], focal_px, CROP_PX, roll=turn)[0].clamp(0, 1) * 255)
            for images in (frame.images, frame.backgrounds)
        )
        return _Crops(seen.round().byte(), behind.round().byte(), depth_m[:, None])
