"""Pseudo-labels of unlabelled photographs: the network's own poses, refined, as labels of crops (Lee 2013).

A pose that a network predicts in a photograph is rough; render-and-compare makes it far better but needs mesh and
renderer, which no server has. So photographs get predicted and refined poses during training, and their crops join the
renderings of the crop-pose stage with these poses as labels (of poses by render-and-compare as in Wang et al. 2020,
"Self6D"). They show the network what renderings lack: this camera, this light, this part. If the camera moved around a
static scene, photographs correct each other (:mod:`~curio_train.refinement.multi_view`). No label of a photograph is
used.
"""

import time
from collections.abc import Callable
from typing import Self

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from curio_train.data.photographs import CameraPoses, read_frames
from curio_train.geometry import matrix_from_rotation_6d
from curio_train.networks.crop_camera import cut_crops
from curio_train.refinement.multi_view import Estimates, consensus_poses
from curio_train.refinement.render_and_compare import RenderAndCompare
from curio_train.refinement.turned_frames import random_rolls
from curio_train.scene_code import LIGHT, ROTATION_6D, TRANSLATION, SceneCode, index, joined
from curio_train.worlds.base import World
from curio_train.worlds.single_object.crop_pose_stage import CROP_PX, FILL
from curio_train.worlds.single_object.two_stage import TwoStageWorld

MIN_CONSENSUS = 10
"""With at least so many photographs in a multi-view consensus, the network learns from these alone."""

_BATCH_SIZE = 20
_PASSES = 2  # of render-and-compare over each photograph
_GAINS = (0.8, 1.25)  # on crops: only the light varies, all else is the camera's own
_DRAWN = 4  # times as many pairs of photographs as crops are wanted that show no object


class PseudoLabels:
    """Photographs with poses, as labelled crops for the crop-pose stage."""

    def __init__(self, world: TwoStageWorld, frames: UInt8[Tensor, "num 3 height width"], code: SceneCode) -> None:
        """Hold photographs and their pseudo-labels.

        Args:
            world: With both stages.
            frames: Photographs in the size of the world's camera, sRGB.
            code: The pseudo-labels.
        """
        assert world.camera.matrix is not None
        self._stage, self._frames, self._code = world.stages[1], frames, code
        self._matrix = torch.from_numpy(np.asarray(world.camera.matrix)).float()

    @classmethod
    @torch.no_grad()
    def from_predictions(
        cls,
        world: TwoStageWorld,
        frames: UInt8[Tensor, "num 3 height width"],
        predict: Callable[[Tensor], SceneCode],
        cameras: CameraPoses | None = None,
    ) -> Self | None:
        """Predict poses in photographs, refine them, and keep the multi-view consensus or what was accepted.

        Args:
            world: With both stages.
            frames: Photographs in the size of the world's camera, sRGB.
            predict: Images [batch, 3, height, width] in [0, 1] to scene codes.
            cameras: Poses of the camera; None: unknown.

        Returns:
            If camera poses are known and enough photographs are part of a consensus, those. Else the photographs whose
            refined pose, refined once more, was accepted either time. None if there are none.
        """
        refiner = RenderAndCompare.in_world(world)
        estimates = predict_and_refine(refiner, frames, predict)
        if cameras is not None:
            code, found = consensus_poses(refiner, frames, cameras, estimates, world.object.kind.info)
            if found.sum() >= MIN_CONSENSUS:
                return cls(world, frames[found], index(code, found))
        twice, accepted_again = refined_poses(refiner, frames, estimates.refined)
        accepted = estimates.accepted | accepted_again
        return cls(world, frames[accepted], index(twice, accepted)) if accepted.any() else None

    @classmethod
    def from_photographs(
        cls, world: World, predict: Callable[[Tensor], SceneCode], seconds: float | None = None
    ) -> Self | None:
        """Predict and refine the poses in the unlabelled photographs of a world; None if it has none.

        Args:
            world: With or without photographs.
            predict: Images [batch, 3, height, width] in [0, 1] to scene codes.
            seconds: What it may take, about; where that is too little for all photographs, some are left out, evenly.

        Raises:
            DataError: A photograph cannot be read, or is not of the camera's size.
            CameraError: The file of camera poses cannot be used.
        """
        if not isinstance(world, TwoStageWorld) or world.photographs is None:
            return None
        paths, cameras = world.photographs.unlabelled()
        if not paths:
            return None
        frames = torch.from_numpy(read_frames(paths, world.object.camera, world.camera.width, world.camera.height))
        if seconds is not None and len(frames) > _BATCH_SIZE:
            chosen = _affordable(RenderAndCompare.in_world(world), frames, predict, seconds)
            frames = frames[torch.from_numpy(chosen)]
            cameras = None if cameras is None else cameras._replace(cam_from_world=cameras.cam_from_world[chosen])
        return cls.from_predictions(world, frames, predict, cameras)

    def __len__(self) -> int:
        """Number of photographs."""
        return len(self._frames)

    @property
    def given(self) -> tuple[str, ...]:
        """Entries of the crops' codes that are known of every image."""
        return self._stage.given

    @torch.no_grad()
    def draw(
        self, count: int, seed: tuple[int, ...], largest_roll_deg: float = 0.0
    ) -> tuple[dict[str, Tensor], Tensor]:
        """Crops of random photographs, off the labelled positions by errors like those of the localisation stage.

        Args:
            count: How many.
            seed: Decides every draw.
            largest_roll_deg: By which the crops' cameras are rolled, to either side.

        Returns:
            Codes of the crop-pose stage, and images [count, 3, CROP_PX, CROP_PX] in [0, 1].
        """
        random = np.random.default_rng(seed)
        chosen = torch.from_numpy(random.integers(len(self), size=count))
        code = index(self._code, chosen)
        position_m = code[TRANSLATION][:, 0]
        localised_m = self._stage.perturbed(position_m, random)
        assumed_depth_m = localised_m.norm(dim=1)
        gain = torch.from_numpy(random.uniform(*_GAINS, (count, 1, 1, 1))).float()
        crops, crop_from_cam = self._crops(chosen, localised_m, random_rolls(count, random, largest_roll_deg))
        rotation = crop_from_cam @ matrix_from_rotation_6d(code[ROTATION_6D][:, 0])
        in_crop, code[LIGHT] = ((crop_from_cam @ vector[..., None])[..., 0] for vector in (position_m, code[LIGHT]))
        labels = self._stage.label_crops(code, in_crop, rotation, assumed_depth_m[:, None])
        return labels, (gain * crops).clamp(0, 1)

    @torch.no_grad()
    def elsewhere(self, count: int, seed: tuple[int, ...]) -> Float[Tensor, "count 3 side side"]:
        """Crops of random photographs where others show the object and they do not; in [0, 1]."""
        random = np.random.default_rng(seed)
        position_m, diameter_m = self._code[TRANSLATION][:, 0], self._stage.object.kind.diameter_m
        chosen, others = torch.from_numpy(random.integers(len(self), size=(2, _DRAWN * count)))
        slopes = position_m[:, :2] / position_m[:, 2:]
        apart = (slopes[chosen] - slopes[others]).norm(dim=1)
        farthest = (apart * position_m[chosen, 2] / diameter_m).argsort(descending=True)[:count]
        no_roll = torch.eye(3).expand(count, 3, 3)
        return self._crops(chosen[farthest], position_m[others[farthest]], no_roll)[0]

    def _crops(self, chosen: Tensor, position_m: Tensor, roll: Tensor) -> tuple[Tensor, Tensor]:
        """Crops of photographs around positions, and crop_from_cam; one after the other, as whole frames are large."""
        focal_px = FILL * CROP_PX * position_m.norm(dim=1) / self._stage.object.kind.diameter_m
        parts = [
            cut_crops(
                self._frames[number][None].float() / 255,
                self._matrix,
                position_m[None, row : row + 1],
                focal_px[row : row + 1],
                CROP_PX,
                roll=roll[row : row + 1],
            )
            for row, number in enumerate(chosen)
        ]
        crops, crop_from_cam = zip(*parts, strict=True)
        return torch.cat(crops), torch.cat(crop_from_cam)


def _affordable(
    refiner: RenderAndCompare, frames: Tensor, predict: Callable[[Tensor], SceneCode], seconds: float
) -> Int[np.ndarray, " num"]:
    """Photographs spread evenly over all of them, as many as the time is enough for; one batch at least."""
    began = time.monotonic()
    predict_and_refine(refiner, frames[:_BATCH_SIZE], predict)
    spent = time.monotonic() - began
    num = int((seconds - spent) / (_PASSES * spent) * _BATCH_SIZE)
    num = min(max(num, _BATCH_SIZE), len(frames))
    return np.arange(num) * len(frames) // num


@torch.no_grad()
def predict_and_refine(
    refiner: RenderAndCompare, frames: UInt8[Tensor, "num 3 height width"], predict: Callable[[Tensor], SceneCode]
) -> Estimates:
    """A network's predictions for photographs, as they are and refined."""
    predicted = joined([predict(chunk.float() / 255) for chunk in frames.split(_BATCH_SIZE)])
    return Estimates(predicted, *refined_poses(refiner, frames, predicted))


@torch.enable_grad()
def refined_poses(
    refiner: RenderAndCompare, frames: UInt8[Tensor, "num 3 height width"], code: SceneCode
) -> tuple[dict[str, Tensor], Bool[Tensor, " num"]]:
    """Refined poses, and where they were accepted."""
    batches = [slice(first, first + _BATCH_SIZE) for first in range(0, len(frames), _BATCH_SIZE)]
    parts = [refiner.refine(frames[batch], index(code, batch)) for batch in batches]
    return joined([part.code for part in parts]), torch.cat([part.accepted for part in parts])
