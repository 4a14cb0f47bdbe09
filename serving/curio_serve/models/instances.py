"""Several instances of an object from a network that finds one pose of it in an image.

The network reads the image again with the instances covered that it found, as long as it finds another. This works with
any exported model and costs a run an instance, and one more that finds none. An instance that stands in the box of
another is covered with it.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from curio_serve.errors import ArgumentError
from curio_serve.models.model import Model, Slot

Array = np.ndarray
Values = Mapping[str, Any]
"""Outputs of one image by name, as plain numbers."""

MAX_INSTANCES = 16
LEAST_CONFIDENCE = 0.2
"""Least confidence of every instance but the first, which is answered whatever its confidence is."""

_MARGIN = 1.15  # of a box that hides an object
_NEAREST_M = 1e-3
_OF_SCENE = "light"


def check_instances(model: Model, max_instances: int | None) -> None:
    """Refuse a number of instances that cannot be asked of a model; None: it is not asked for.

    Raises:
        ArgumentError: It is out of range, or the model is of a flat world.
    """
    if max_instances is None:
        return
    if not 1 <= max_instances <= MAX_INSTANCES:
        raise ArgumentError(f"max_instances is {max_instances}; expected 1 to {MAX_INSTANCES}")
    if model.camera.matrix is None:
        raise ArgumentError(
            f"max_instances is for poses in space; model {model.label} is of a flat world, leave it out"
        )


class Rows(NamedTuple):
    """The detections in one image, a row each."""

    values: Values
    """Outputs by name; those of objects have a row each."""
    slots: Sequence[Slot]
    """The slot of each row, which says of which kind it is."""

    def row(self, number: int) -> "Rows":
        """One row, with what the scene has once."""
        return Rows(
            {name: value if name == _OF_SCENE else [value[number]] for name, value in self.values.items()},
            [self.slots[number]],
        )

    @classmethod
    def joined(cls, parts: Sequence["Rows"]) -> "Rows":
        """The rows of all parts; what the scene has once is that of the first."""
        first = parts[0].values
        values = {
            name: value if name == _OF_SCENE else [row for part in parts for row in part.values[name]]
            for name, value in first.items()
        }
        return cls(values, [slot for part in parts for slot in part.slots])


def cover(pixels: Array, box_px: Array) -> None:
    """Paint over an object's box with the mean colour of its corners' surroundings, in place.

    Args:
        pixels: uint8 RGB [height, width, 3].
        box_px: Projected corners [num, 2].
    """
    hull = cv2.convexHull(box_px.round().astype(np.int32))
    inside = np.clip(hull[:, 0], 0, (pixels.shape[1] - 1, pixels.shape[0] - 1))
    color = pixels[inside[:, 1], inside[:, 0]].mean(axis=0)
    cv2.fillConvexPoly(pixels, hull, tuple(color.tolist()))


def enlarged(corners_m: Array) -> Array:
    """A box with the margin that covers all of an object where its pose is not quite right.

    Args:
        corners_m: [num, 3] in the object's frame.
    """
    center: Array = corners_m.mean(axis=0)
    return center + _MARGIN * (corners_m - center)


class InstanceSearch:
    """One image in which instances of one kind are found one after the other."""

    def __init__(self, model: Model, image: Array) -> None:
        """Begin without instances.

        Args:
            model: Has K* and one slot.
            image: uint8 RGB [height, width, 3] as the model sees it.
        """
        self.image = image
        """The image with the found instances painted over."""
        self._readings: list[Rows] = []
        self._model, self._covered = model, list[Array]()

    def take(self, values: Values) -> bool:
        """Keep the outputs for :attr:`image` if they are another instance; whether to read it again."""
        (slot,) = self._model.slots
        center = self._pixels([_placed([slot.center], values)[0]])
        is_new = self._is_sure(values) and center is not None and not self._is_covered(center[0])
        if is_new or not self._readings:
            self._readings.append(Rows(values, self._model.slots))
        box_px = self._pixels(_corners(slot, values)) if is_new else None
        if box_px is None:
            return False
        if not self._covered:
            self.image = self.image.copy()
        cover(self.image, box_px)
        self._covered.append(cv2.convexHull(box_px.astype(np.float32)))
        return True

    @property
    def found(self) -> Rows:
        """A row for each instance; what a scene has once is that of the first reading."""
        return Rows.joined(self._readings)

    def _is_sure(self, values: Values) -> bool:
        return "confidence" not in values or bool(values["confidence"][0] >= LEAST_CONFIDENCE)

    def _is_covered(self, pixel: Array) -> bool:
        point = float(pixel[0]), float(pixel[1])
        return any(cv2.pointPolygonTest(hull, point, measureDist=False) >= 0 for hull in self._covered)

    def _pixels(self, points_m: Sequence[Sequence[float]] | Array) -> Array | None:
        """Points in the canonical camera as its pixels [num, 2]; None: one is behind it, or not finite."""
        seen = np.asarray(points_m, float) @ np.asarray(self._model.camera.matrix).T
        if not np.isfinite(seen).all() or seen[:, 2].min() < _NEAREST_M:
            return None
        pixels: Array = np.clip(seen[:, :2] / seen[:, 2:], -1e4, 1e4)
        return pixels


def _corners(slot: Slot, values: Values) -> Array:
    """The box around an instance in the canonical camera."""
    return _placed(enlarged(np.asarray(slot.box_corners, float)), values)


def _placed(points: Sequence[Sequence[float]] | Array, values: Values) -> Array:
    """Points of the first instance's object in the canonical camera."""
    rotation = np.asarray(values["rotation"][0] if "rotation" in values else np.eye(3), float)
    placed: Array = np.asarray(points, float) @ rotation.T + values["translation_m"][0]
    return placed
