"""Moves what a frame shows of followed objects onto a plane."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from curio_serve.planes.plane import AnyPlane, Plane
from curio_serve.planes.stable_poses import StandingShape
from curio_serve.planes.standing import DEPTH_STD, HEIGHT_STD, Standing, find_plane, height_over
from curio_serve.tracking.tracks import Measurement

Array = np.ndarray


class FramePlane:
    """The plane on which one frame's objects stand: a given one, or the first that measurements of the frame tell."""

    plane: Plane | None
    """None: there is none, or none was found yet."""

    def __init__(self, shapes: Mapping[str, StandingShape], given: AnyPlane | None) -> None:
        """Take a plane.

        Args:
            shapes: How each kind of object can stand, by name; of none without a plane.
            given: The plane, or that it is to be found; None: measurements stay as they are.
        """
        self._given, self._shapes = given, shapes
        self.plane = given if isinstance(given, Plane) else None

    def stood(self, found: Sequence[Measurement]) -> list[Measurement]:
        """Measurements of objects that stand on the plane, moved there; the others as they are.

        Args:
            found: In this frame. A plane that is not known is found at the first call with two that agree on one.
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
        """A Kalman update of the position by its height over the plane."""
        height_m = height_over(where, plane, is_known=plane is self._given)
        if height_m is None:
            return measured
        covariance_m2 = _in_photographs(measured)
        across = covariance_m2 @ plane.normal
        std_m = HEIGHT_STD * float(np.linalg.norm(measured.translation_m))
        gain = across / (plane.normal @ across + std_m**2)
        if plane is self._given:  # one that was found is known no better than the distances that told it
            covariance_m2 = covariance_m2 - np.outer(gain, across)
        middle_m = measured.translation_m - gain * height_m
        return replace(measured, translation_m=middle_m, covariance_m2=covariance_m2, on_plane=True)


def _in_photographs(measured: Measurement) -> Array:
    """The covariance [3, 3], in which a distance is known no better than networks read it in photographs.

    A network's own spread leaves out by how much all of its distances are off, which the plane tells.
    """
    distance_m = float(np.linalg.norm(measured.translation_m))
    ray = measured.translation_m / distance_m
    missing = (DEPTH_STD * distance_m) ** 2 - float(ray @ measured.covariance_m2 @ ray)
    result: Array = measured.covariance_m2 + max(0.0, missing) * np.outer(ray, ray)
    return result
