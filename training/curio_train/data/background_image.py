"""The empty scene behind an object: a background image, taken by the camera that will look for the object.

A detector that has seen the background image takes nothing in it for the object; one that has seen nothing else is lost
when a tool lies there. So the background image is mixed with clutter, and no two views of it are alike: light drifts,
shadows fall, and a tripod is touched now and then. Crops show the dark spot that the part's own shadow leaves, which
our renderer doesn't draw where no plane is known.
"""

from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from curio_train.camera import Intrinsics
from curio_train.data.backgrounds import Backgrounds
from curio_train.data.photographs import read_frame

BACKGROUND_IMAGE_FRACTION = 0.85
"""Fraction of backgrounds that are the background image, where it is mixed with others, which are rare in use."""

_LARGEST_SHIFT = 0.04  # of the frame's width, and as much of its height
_SHORTEST_SIDE = 128  # of a background image that is halved once more
_LEAST_SHRUNK = 1.5  # a view is shrunk by as much from a level of the background image, to look smooth
_GAIN, _TINT = 0.2, 0.06
_SHADOW = 0.1  # standard deviation of the light's unevenness
_SHADOW_GRID = 4
_CAST_REACH, _CAST_SIZES = 0.2, (0.08, 0.25)  # of a crop's side: where a part's own shadow may lie, and its half axes
_DARKEST_CAST = 0.6


class BackgroundImages(Backgrounds):
    """One photograph of the empty scene, shifted and lit a little differently each time."""

    def __init__(self, background_image: np.ndarray, fractions: tuple[float, float] | None = None) -> None:
        """Views of a background image.

        Args:
            background_image: [height, width, 3] uint8 sRGB, without distortion.
            fractions: Of its width that a view spans, least and largest; None: all of it.
        """
        self._levels, self._fractions = [background_image], fractions
        while min(self._levels[-1].shape[:2]) >= _SHORTEST_SIDE:  # to shrink much takes long, and views are many
            self._levels.append(cv2.resize(self._levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))

    @classmethod
    def read(cls, path: Path, camera: Intrinsics) -> "BackgroundImages":
        """The background image in a file.

        Raises:
            DataError: It cannot be read, or is not of the camera's size.
        """
        return cls(read_frame(path, camera))

    def split(self, train: bool) -> "BackgroundImages":
        """The background image is known in use, so it is no secret of the test."""
        return self

    def of_crops(self, least: float, largest: float) -> "BackgroundImages":
        return BackgroundImages(self._levels[0], (least, largest))

    def draw(self, count: int, width: int, height: int, seed: tuple[int, ...]) -> Tensor:
        random = np.random.default_rng(seed)
        views = [self._view(width, height, random) for _ in range(count)]
        return torch.from_numpy(np.stack(views)).permute(0, 3, 1, 2).contiguous()

    def _view(self, width: int, height: int, random: np.random.Generator) -> np.ndarray:
        rows, columns = self._region(width, height, random)
        top = int(random.integers(self._size[0] - rows + 1))
        left = int(random.integers(self._size[1] - columns + 1))
        level = min(len(self._levels) - 1, max(0, int(np.log2(columns / (_LEAST_SHRUNK * width)))))
        top, left, rows, columns = (number >> level for number in (top, left, rows, columns))
        part = self._levels[level][top : top + rows, left : left + columns]
        smaller = cv2.INTER_AREA if columns >= width else cv2.INTER_LINEAR
        seen = cv2.resize(part, (width, height), interpolation=smaller).astype(np.float32) / 255
        light = _light(width, height, random)
        if self._fractions is not None:
            light *= _cast(width, height, random)
        return np.clip(seen * light, 0, 1)

    def _region(self, width: int, height: int, random: np.random.Generator) -> tuple[int, int]:
        """Rows and columns of the background image that a view spans."""
        if self._fractions is None:
            kept = 1 - random.uniform(0, _LARGEST_SHIFT)
            return round(self._size[0] * kept), round(self._size[1] * kept)
        least, largest = np.log(self._fractions)
        columns = self._size[1] * np.exp(random.uniform(least, largest))
        columns = min(columns, self._size[1], self._size[0] * width / height)
        return max(1, int(columns * height / width)), max(1, int(columns))

    @property
    def _size(self) -> tuple[int, int]:
        return self._levels[0].shape[0], self._levels[0].shape[1]


class MixedBackgrounds(Backgrounds):
    """Some backgrounds from one source and the others from a second."""

    def __init__(self, first: Backgrounds, second: Backgrounds, fraction: float) -> None:
        """Take ``fraction`` of all backgrounds from the first."""
        self._first, self._second, self._fraction = first, second, fraction

    def split(self, train: bool) -> "MixedBackgrounds":
        return MixedBackgrounds(self._first.split(train), self._second.split(train), self._fraction)

    def of_crops(self, least: float, largest: float) -> "MixedBackgrounds":
        return MixedBackgrounds(
            self._first.of_crops(least, largest), self._second.of_crops(least, largest), self._fraction
        )

    def draw(self, count: int, width: int, height: int, seed: tuple[int, ...]) -> Tensor:
        of_first = np.random.default_rng(seed).random(count) < self._fraction
        images = torch.empty(count, 3, height, width)
        for source, chosen in ((self._first, of_first), (self._second, ~of_first)):
            if chosen.any():
                images[torch.from_numpy(chosen)] = source.draw(int(chosen.sum()), width, height, seed)
        return images


def _light(width: int, height: int, random: np.random.Generator) -> np.ndarray:
    """Factors [height, width, 3] on sRGB values: exposure, tint, and soft shadows."""
    gain = 1 + random.uniform(-_GAIN, _GAIN) + random.uniform(-_TINT, _TINT, 3)
    grid = 1 + _SHADOW * random.normal(size=(_SHADOW_GRID, _SHADOW_GRID)).astype(np.float32)
    uneven = cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
    return (uneven[..., None] * gain).astype(np.float32)


def _cast(width: int, height: int, random: np.random.Generator) -> np.ndarray:
    """Factors [height, width, 1]: a soft dark blob about a crop's middle, where the part will throw its shadow."""
    middle = np.array([width, height]) * (0.5 + random.uniform(-_CAST_REACH, _CAST_REACH, 2))
    axes = width * random.uniform(*_CAST_SIZES, 2)
    blob = np.zeros((height, width), np.float32)
    corners = cv2.boxPoints((middle.tolist(), (2 * axes).tolist(), random.uniform(0, 180)))
    cv2.fillConvexPoly(blob, corners.round().astype(np.int32), 1.0)
    soft = cv2.GaussianBlur(blob, (0, 0), width * random.uniform(0.01, 0.06))
    return (1 - _DARKEST_CAST * random.uniform() * soft)[..., None]
