"""Renders sequences by the project's own renderer: objects on their paths, a board that hides them, sensor noise."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from curio_train.meshes.meshes import Mesh
from curio_train.meshes.shapes import box
from curio_train.rendering.renderer import Renderer
from jaxtyping import Bool, Float, UInt8

MATRIX = np.array([[572.4, 0, 325.3], [0, 573.6, 242.0], [0, 0, 1]])
SIZE = 640, 480
"""LineMOD's camera."""

_AMBIENT = 0.4
_LIGHT = (0.3, -0.8, -0.6)  # camera frame, towards the light
_NOISE = 3.0  # standard deviation of a pixel's channel, of 255
_BOARD_M = (0.9, 0.9, 0.01)
_BOARD_DEPTH_M = 0.5
_AWAY = (0.0, 0.0, -5.0)  # behind the camera
_BATCH = 8


@dataclass(frozen=True, eq=False)
class Sequence6:
    """A video with truth."""

    frames: UInt8[np.ndarray, "frames height width 3"]
    """RGB."""
    matrix: Float[np.ndarray, "3 3"]
    """K of the camera, pixels."""
    cam_from_obj: Float[np.ndarray, "frames objects 4 4"]
    """True poses, metres."""
    hidden: Bool[np.ndarray, " frames"]
    """Frames in which the board stands before the view."""


class Studio:
    """One camera before which objects are moved."""

    def __init__(self, meshes: Sequence[Mesh], scale: float = 1.0) -> None:
        """Build the scene.

        Args:
            meshes: Of each object, metres.
            scale: Size of the frames relative to 640x480.
        """
        width, height = (round(side * scale) for side in SIZE)
        half = np.array([[scale, 0, (scale - 1) / 2], [0, scale, (scale - 1) / 2], [0, 0, 1]])
        self.matrix, self._size, self._num = half @ MATRIX, (width, height), len(meshes)
        kinds = list(range(len(meshes) + 1))
        self._renderer = Renderer([*meshes, box(_BOARD_M)], kinds, width, height, ambient=_AMBIENT)

    def film(self, paths: Sequence[np.ndarray], random: np.random.Generator, hidden: slice | None = None) -> Sequence6:
        """Render objects on their paths.

        Args:
            paths: cam_from_obj [frames, 4, 4] of each object.
            random: Draws the background and the noise.
            hidden: Frames in which a board hides the whole view.
        """
        cam_from_obj = np.stack(paths, axis=1)
        is_hidden = np.zeros(len(cam_from_obj), bool)
        if hidden is not None:
            is_hidden[hidden] = True
        background = torch.from_numpy(clutter(*self._size, random)).permute(2, 0, 1).float() / 255
        frames = [
            self._render(cam_from_obj[start : start + _BATCH], is_hidden[start : start + _BATCH], background)
            for start in range(0, len(cam_from_obj), _BATCH)
        ]
        seen = np.concatenate(frames)
        noisy = np.stack([_noisy(frame, random) for frame in seen])
        return Sequence6(noisy, self.matrix, cam_from_obj, is_hidden)

    @torch.no_grad()
    def _render(self, cam_from_obj: np.ndarray, hidden: np.ndarray, background: torch.Tensor) -> np.ndarray:
        num = len(cam_from_obj)
        board = np.repeat(np.eye(4)[None], num, axis=0)
        board[:, :3, 3] = np.where(hidden[:, None], (0.0, 0.0, _BOARD_DEPTH_M), _AWAY)
        matrices = torch.from_numpy(np.concatenate([cam_from_obj, board[:, None]], axis=1)).float()
        present = torch.ones(num, self._num + 1)
        present[:, -1] = torch.from_numpy(hidden).float()
        images = self._renderer(
            matrices[..., :3, :3],
            torch.where(present[..., None] > 0, matrices[..., :3, 3], torch.tensor([0.0, 0, 3])),
            camera_matrix=self.matrix,
            backgrounds=background.expand(num, -1, -1, -1),
            light=torch.tensor(_LIGHT).expand(num, 3),
            confidence=present,
        )
        pixels: np.ndarray = (images.clamp(0, 1) * 255).round().byte().permute(0, 2, 3, 1).numpy()
        return pixels


def _noisy(frame: np.ndarray, random: np.random.Generator) -> np.ndarray:
    changed = frame + _NOISE * random.standard_normal(frame.shape, np.float32)
    result: np.ndarray = changed.clip(0, 255).astype(np.uint8)
    return result


def clutter(width: int, height: int, random: np.random.Generator, num: int = 60) -> UInt8[np.ndarray, "h w 3"]:
    """A still background: overlapping discs and boxes of any colour and size."""
    image = np.full((height, width, 3), random.integers(60, 200, 3), np.uint8)
    for _ in range(num):
        color = tuple(int(value) for value in random.integers(20, 235, 3))
        centre = int(random.integers(width)), int(random.integers(height))
        size = int(random.integers(width // 40, width // 8))
        if random.random() < 0.5:
            cv2.circle(image, centre, size, color, -1)
        else:
            cv2.rectangle(image, centre, (centre[0] + size, centre[1] + int(random.integers(size) + 4)), color, -1)
    return cv2.GaussianBlur(image, (0, 0), 1.0)
