"""Self-training: a gaze learns from photographs that nobody labelled, with the poses that it reads in them itself.

What a network reads in a photograph is rough, and render-and-compare makes it far better (:mod:`refinement`), but needs
mesh and renderer, which no server has. So while training goes on, photographs are read and refined, and crops of them
join the renderings of the second look with those poses for labels (pseudo-labels, Lee 2013; of poses by
render-and-compare as in Wang et al. 2020, "Self6D"). That shows it what renderings don't: this camera, this light, this
part. Where the camera moved around a scene that stands still, photographs correct each other (:mod:`still_scene`). No
label of a photograph is used.
"""

from collections.abc import Callable, Sequence
from typing import Self

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, UInt8
from torch import Tensor

from curio_train.data.photographs import CameraPoses, read_frames
from curio_train.geometry import matrix_from_rotation_6d
from curio_train.metrics.poses import symmetry_poses
from curio_train.networks.crop_camera import crop_camera_at, sampling_grid
from curio_train.networks.two_stage.network import OVERSAMPLING
from curio_train.refinement.multi_view import agreed
from curio_train.refinement.render_and_compare import RenderAndCompare
from curio_train.scene_code import LIGHT, ROTATION_6D, TRANSLATION, SceneCode
from curio_train.worlds.base import World
from curio_train.worlds.single_object.two_stage import CROP_PX, FILL, SYMMETRY_STEP, TwoStageWorld

MIN_CONSENSUS = 10
"""Photographs with agreed poses that are worth more than all others with poses of their own."""

_READ_AT_ONCE = 20
_GAINS = (0.8, 1.25)  # of crops: light changes, and all else is the camera's own


class PseudoLabels:
    """Photographs with the poses that were read in them, as crops for the second look."""

    def __init__(self, world: TwoStageWorld, frames: UInt8[Tensor, "num 3 height width"], code: SceneCode) -> None:
        """Teach these.

        Args:
            world: The gaze's.
            frames: Photographs as the world's camera takes them, sRGB.
            code: What they show.
        """
        assert world.camera.matrix is not None  # a gaze has a pinhole camera
        self._look, self._frames, self._code = world.stages[1], frames, code
        self._matrix = torch.from_numpy(np.asarray(world.camera.matrix)).float()[None]

    @classmethod
    @torch.no_grad()
    def from_predictions(
        cls,
        world: TwoStageWorld,
        frames: UInt8[Tensor, "num 3 height width"],
        predict: Callable[[Tensor], SceneCode],
        cameras: CameraPoses | None = None,
    ) -> Self | None:
        """Read photographs, refine what was read, and keep what several agree on; or, of single ones, what is better.

        Args:
            world: The gaze's.
            frames: Photographs as the world's camera takes them, sRGB.
            predict: Reads images [batch, 3, height, width] in [0, 1].
            cameras: Where the camera stood; None: unknown.

        Returns:
            What can be learned of photographs whose object stands still among them, if the camera is known to have
            moved and enough of them agree; else of those whose refined pose, refined once more, is nearer to the
            picture. None if there is none.
        """
        refine = RenderAndCompare(world)
        read, refined, taken = predict_and_refine(refine, frames, predict)
        if cameras is not None:
            symmetries = symmetry_poses(world.object.kind.info, SYMMETRY_STEP)
            code, chosen = agreed(refine, frames, cameras, read, (refined, taken), symmetries)
            if chosen.sum() >= MIN_CONSENSUS:
                return cls(world, frames[chosen], {name: value[chosen] for name, value in code.items()})
        twice, taken_again = _refined(refine, frames, refined)
        chosen = taken | taken_again
        code = {name: value[chosen] for name, value in twice.items()}
        return cls(world, frames[chosen], code) if chosen.any() else None

    @classmethod
    def from_photographs(cls, world: World, predict: Callable[[Tensor], SceneCode]) -> Self | None:
        """Predict and refine the poses in the unlabelled photographs of a world; None if it offers none.

        Raises:
            DataError: A photograph cannot be read, or is not of the camera's size.
        """
        if not isinstance(world, TwoStageWorld):
            return None
        paths, cameras = world.unlabelled()
        if not paths:
            return None
        frames = read_frames(paths, world.object.camera, world.camera.width, world.camera.height)
        return cls.from_predictions(world, torch.from_numpy(frames), predict, cameras)

    def __len__(self) -> int:
        """How many photographs teach."""
        return len(self._frames)

    @torch.no_grad()
    def draw(self, count: int, seed: tuple[int, ...]) -> tuple[dict[str, Tensor], Tensor]:
        """Crops as a first look that errs leaves them, each of a photograph chosen at random.

        Returns:
            Codes of the second look, and images [count, 3, CROP_PX, CROP_PX] in [0, 1].
        """
        random = np.random.default_rng(seed)
        chosen = torch.from_numpy(random.integers(len(self), size=count))
        code = {name: value[chosen] for name, value in self._code.items()}
        position_m, matrix = code[TRANSLATION][:, 0], self._matrix.expand(count, 3, 3)
        place = self._look.mistaken(position_m, random)
        assumed = place.norm(dim=1)
        side = OVERSAMPLING * CROP_PX
        gaze = crop_camera_at(place, FILL * side * assumed / self._look.object.kind.diameter_m, side, matrix)
        height, width = self._frames.shape[2:]
        grid = sampling_grid(gaze, matrix, side, width, height)
        fine = F.grid_sample(self._frames[chosen].float() / 255, grid, padding_mode="border", align_corners=False)
        turned = (gaze.rotation @ position_m[..., None])[..., 0]
        rotation = gaze.rotation @ matrix_from_rotation_6d(code[ROTATION_6D][:, 0])
        code[LIGHT] = (gaze.rotation @ code[LIGHT][..., None])[..., 0]
        gain = torch.from_numpy(random.uniform(*_GAINS, (count, 1, 1, 1))).float()
        crops = (gain * F.avg_pool2d(fine, OVERSAMPLING)).clamp(0, 1)
        return self._look.labelled(code, turned, rotation, assumed[:, None]), crops


@torch.no_grad()
def predict_and_refine(
    refine: RenderAndCompare, frames: UInt8[Tensor, "num 3 height width"], predict: Callable[[Tensor], SceneCode]
) -> tuple[SceneCode, SceneCode, Bool[Tensor, " num"]]:
    """What a network reads in photographs, the same after render-and-compare, and where that found something better."""
    read = _joined([predict(chunk.float() / 255) for chunk in frames.split(_READ_AT_ONCE)])
    return read, *_refined(refine, frames, read)


@torch.enable_grad()
def _refined(refine: RenderAndCompare, frames: Tensor, code: SceneCode) -> tuple[dict[str, Tensor], Tensor]:
    """Better poses, and where they are found."""
    parts = []
    for first in range(0, len(frames), _READ_AT_ONCE):
        some = slice(first, first + _READ_AT_ONCE)
        parts.append(refine.judged(frames[some], {name: value[some] for name, value in code.items()}))
    return _joined([part for part, _ in parts]), torch.cat([taken for _, taken in parts])


def _joined(parts: Sequence[SceneCode]) -> dict[str, Tensor]:
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
