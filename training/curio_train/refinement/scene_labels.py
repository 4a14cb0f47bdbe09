"""Pseudo-labels of unlabelled photographs of a scene with several objects (Lee 2013): whole frames for the locator.

Every photograph is read a few times, and what many photographs agree on labels all that show the same
(:mod:`~curio_train.refinement.scene_poses`). No label of a photograph is used.
"""

import logging
import time
from collections.abc import Callable, Sequence
from typing import Self

import numpy as np
import torch
import torch.nn.functional as F
from curio_serve.imaging.virtual_cameras import VIRTUAL_CAMERAS, VirtualCamera
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from curio_train.counting import counted
from curio_train.data.photographs import read_frames
from curio_train.geometry import Pose, matrix_from_rotation_6d, rotation_6d_from_matrix
from curio_train.metrics.poses import in_view
from curio_train.networks.templates.geometry import FRAME_STRIDE
from curio_train.refinement.scene_poses import Reads, scene_poses
from curio_train.refinement.turned_frames import random_camera, seen_by
from curio_train.scene_code import CONFIDENCE, ROTATION_6D, TRANSLATION, SceneCode, joined
from curio_train.worlds.several_objects.world import SeveralObjectsWorld

_THROUGH = VIRTUAL_CAMERAS[:3]  # that photographs are read
_ELSEWHERE_M = (0.0, 0.0, 1.0)  # where objects are said to be whose place nobody knows

_log = logging.getLogger(__name__)

Predict = Callable[[Tensor], SceneCode]
"""Images [batch, 3, height, width] in [0, 1] to scene codes."""


class SceneLabels:
    """Photographs with the poses of several objects, as labelled frames for the locator stage."""

    shown: Bool[np.ndarray, "photographs objects"]
    """Whether an object's place is known and in the photograph. Turned cameras see border pixels beyond it, too."""

    def __init__(
        self,
        world: SeveralObjectsWorld,
        frames: UInt8[Tensor, "num 3 height width"],
        poses: Sequence[Pose[np.ndarray]],
    ) -> None:
        """Hold photographs and their pseudo-labels.

        Args:
            world: Of the objects.
            frames: Photographs in the size of the world's camera, sRGB.
            poses: Cam_from_obj of each object in all of them, [num, …]; NaN where it is not known.
        """
        assert world.camera.matrix is not None
        self.frames, self.poses = frames, tuple(poses)
        self._stage, self._matrix = world.stages[0], world.camera.matrix
        self._position_m = np.stack([pose.translation_m for pose in poses], axis=1)
        self.shown = self._in_view(self._position_m)

    @classmethod
    @torch.no_grad()
    def from_photographs(
        cls, world: SeveralObjectsWorld, predict: Predict, seconds: float | None = None
    ) -> Self | None:
        """Read a world's photographs, and keep what agrees.

        Args:
            world: With photographs, or without.
            predict: Reads images.
            seconds: What it may take, about; where that is too little for all photographs, some are left out, evenly.

        Returns:
            None if there are no photographs, their camera poses are not known, or nothing agrees.

        Raises:
            DataError: A photograph cannot be read, or is not of the camera's size.
            CameraError: The file of camera poses cannot be used.
        """
        if world.photographs is None:
            return None
        paths, cameras = world.photographs.unlabelled()
        if not paths or cameras is None or not cameras.known.any():
            _log.warning("photographs are not learned from: it takes several of one scene, from several viewpoints")
            return None
        # Reads of the others agree with nothing, and are not wrong for it.
        paths = [path for path, is_known in zip(paths, cameras.known, strict=True) if is_known]
        cameras = cameras._replace(cam_from_world=cameras.cam_from_world[cameras.known])
        frames = torch.from_numpy(read_frames(paths, world.members[0].camera, world.camera.width, world.camera.height))
        assert world.camera.matrix is not None
        if seconds is not None:
            began = time.monotonic()
            read_often(frames[:1], world.camera.matrix, predict, _THROUGH)
            chosen = _affordable(len(frames), time.monotonic() - began, seconds)
            frames, cameras = frames[chosen], cameras._replace(cam_from_world=cameras.cam_from_world[chosen])
        poses = scene_poses(read_often(frames, world.camera.matrix, predict, _THROUGH), cameras, world.objects)
        labels = cls(world, frames, poses)
        _log.info("photographs agree on %d poses of %d", labels.num_known, len(frames) * len(world.objects))
        return labels if labels.num_known else None

    @property
    def num_known(self) -> int:
        """Poses, of all objects in all photographs."""
        return int(np.isfinite(self._position_m).all(axis=2).sum())

    @torch.no_grad()
    def draw(self, count: int, seed: tuple[int, ...]) -> tuple[dict[str, Tensor], Tensor]:
        """Random photographs as turned and zoomed cameras see them.

        Returns:
            Codes of the locator stage, with a confidence of NaN where nobody knows whether an object is there, and
            images [count, 3, height, width] in [0, 1].
        """
        random = np.random.default_rng(seed)
        chosen = random.integers(len(self.frames), size=count)
        seen = [
            seen_by(random_camera(random), self.frames[number], self._matrix, self._position_m[number])
            for number in chosen
        ]
        position_m = np.stack([positions for _, positions in seen])
        known, inside = np.isfinite(position_m).all(axis=2), self.shown[chosen] & self._in_view(position_m)
        confidence = np.where(known, inside, np.nan)[..., None]
        position_m[~(known & inside)] = _ELSEWHERE_M
        code = {TRANSLATION: torch.from_numpy(position_m).float(), CONFIDENCE: torch.from_numpy(confidence).float()}
        small = F.avg_pool2d(torch.stack([image for image, _ in seen]), FRAME_STRIDE)
        return code, self._stage.augment(small, seed).clamp(0, 1)

    def _in_view(self, position_m: Float[np.ndarray, "*batch 3"]) -> Bool[np.ndarray, "*batch"]:
        return in_view(position_m, self._matrix, self.frames.shape[3], self.frames.shape[2])


def read_often(
    frames: UInt8[Tensor, "num 3 height width"], matrix: np.ndarray, predict: Predict, through: Sequence[VirtualCamera]
) -> Reads:
    """Poses that a network reads in photographs through slightly turned cameras.

    Args:
        frames: Of the network's camera.
        matrix: Its K.
        predict: Reads images.
        through: The turned cameras; each photograph is read once through each.
    """
    codes, photograph = [], []
    for number, frame in enumerate(counted(frames, len(frames), "reading photographs")):
        for camera in through:
            pixels = camera.image(frame.permute(1, 2, 0).numpy(), matrix)
            seen = predict(torch.from_numpy(pixels).permute(2, 0, 1)[None].float() / 255)
            codes.append(_brought_back(seen, camera))
            photograph.append(number)
    return Reads(joined(codes), np.array(photograph))


def _affordable(num: int, seconds_each: float, seconds: float) -> np.ndarray:
    """Numbers of photographs spread evenly over all, as many as the time is enough for; one at least."""
    count = min(num, max(1, int(seconds / seconds_each)))
    chosen: np.ndarray = np.arange(count) * num // count
    return chosen


def _brought_back(code: SceneCode, camera: VirtualCamera) -> dict[str, Tensor]:
    """Poses and confidences of one image in the real camera's frame."""
    rotations = matrix_from_rotation_6d(code[ROTATION_6D][0]).double().numpy()
    positions_m = code[TRANSLATION][0].double().numpy()
    rotation, position_m = zip(*map(camera.back, rotations, positions_m), strict=True)
    return {
        ROTATION_6D: rotation_6d_from_matrix(torch.from_numpy(np.stack(rotation)).float())[None],
        TRANSLATION: torch.from_numpy(np.stack(position_m)).float()[None],
        CONFIDENCE: code[CONFIDENCE],
    }
