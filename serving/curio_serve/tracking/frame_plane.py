"""Moves what a frame shows of followed objects onto a plane."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from curio_serve.models.answers import standing_shapes
from curio_serve.models.model import Model
from curio_serve.planes.plane import AnyPlane, Plane
from curio_serve.planes.standing import HEIGHT_STD, Standing, distance_factor, find_plane
from curio_serve.tracking.tracks import Measurement

Array = np.ndarray


class FramePlane:
    """The plane on which one frame's objects stand: a given one, or the first that measurements of the frame tell."""

    plane: Plane | None
    """None: there is none, or none was found yet."""

    def __init__(self, model: Model, given: AnyPlane | None) -> None:
        """Take a plane.

        Args:
            model: Whose objects are followed.
            given: The plane, or that it is to be found; None: measurements stay as they are.
        """
        self._given = given
        self._shapes = {} if given is None else standing_shapes(model)
        self.plane = given if isinstance(given, Plane) else None

    def stood(self, found: Sequence[Measurement]) -> list[Measurement]:
        """Measurements of objects that stand on the plane, moved along their lines of sight; the others as they are.

        Args:
            found: In this frame, one after the other or together: a plane that is not known takes two of them.
        """
        if self._given is None:
            return list(found)
        standing = [self._shapes[one.object].at(one.translation_m, one.rotation, one.confidence) for one in found]
        if self.plane is None:
            self.plane = find_plane(standing)
        plane = self.plane
        if plane is None:
            return list(found)
        return [self._moved(one, where, plane) for one, where in zip(found, standing, strict=True)]

    def _moved(self, measured: Measurement, where: Standing, plane: Plane) -> Measurement:
        factor = distance_factor(where, plane, is_known=plane is self._given)
        if factor is None:
            return measured
        middle_m, covariance_m2 = factor * measured.translation_m, measured.covariance_m2
        if plane is self._given:  # one that was found is known no better than the distances that told it
            covariance_m2 = _known_height(covariance_m2, plane.normal, HEIGHT_STD * float(np.linalg.norm(middle_m)))
        return replace(measured, translation_m=middle_m, covariance_m2=covariance_m2, on_plane=True)


def _known_height(covariance_m2: Array, normal: Array, std_m: float) -> Array:
    """The covariance [3, 3] of a position whose height over a plane is known, too (a Kalman update)."""
    across = covariance_m2 @ normal
    result: Array = covariance_m2 - np.outer(across, across) / (normal @ across + std_m**2)
    return result
