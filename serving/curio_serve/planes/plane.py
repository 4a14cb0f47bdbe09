"""A plane on which objects stand."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Self, TypeAlias

import numpy as np

from curio_serve.errors import ArgumentError

Array = np.ndarray
FIND_PLANE: Literal["objects"] = "objects"
"""In place of a plane: the one on which most of a frame's objects stand, if two of them agree on one."""
_FARTHEST_M = 1e4


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane in a camera's frame, seen from the side on which the objects stand."""

    point_m: Array
    """Any of its points, [3]."""
    normal: Array
    """Unit vector towards the objects and the camera, [3]."""

    @property
    def offset_m(self) -> float:
        """What the normal times any of its points is; below zero, because the camera is on the normal's side."""
        return float(self.normal @ self.point_m)

    @classmethod
    def of(cls, point_m: Sequence[float], normal: Sequence[float]) -> Self:
        """The plane through a point, the normal of any length.

        Raises:
            ArgumentError: Not three values each, values that are not finite or impossibly far, no direction, or the
                camera does not see the side where the objects are.
        """
        try:
            point, direction = np.array(point_m, float), np.array(normal, float)
        except (TypeError, ValueError) as exc:
            raise ArgumentError(f"plane: point {point_m!r}, normal {normal!r}; expected three numbers each") from exc
        if point.shape != (3,) or direction.shape != (3,):
            raise ArgumentError(
                f"plane has {point.size} values of a point and {direction.size} of a normal; expected 3"
            )
        with np.errstate(over="ignore"):  # which is refused below
            length = float(np.linalg.norm(direction))
        if not np.isfinite([*point, length]).all() or np.abs(point).max() > _FARTHEST_M or length < 1e-9:
            raise ArgumentError(f"plane: point {list(point_m)}, normal {list(normal)}; expected metres and a direction")
        found = cls(point, direction / length)
        if found.offset_m >= 0:
            raise ArgumentError(
                f"plane: seen from below, its normal {list(normal)} points away from the camera; expected the side "
                "on which the objects stand"
            )
        return found


AnyPlane: TypeAlias = Plane | Literal["objects"]
