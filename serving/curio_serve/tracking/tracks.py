"""Tracks of one model's objects in one stream: their numbers, their poses, and when each was seen."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from curio_proto.v1.model_spec_pb2 import ObjectModel

from curio_serve.models.object_frames import as_compared, symmetry_rotations
from curio_serve.models.stages.crop_stage import CropPose
from curio_serve.tracking.assignment import assigned
from curio_serve.tracking.pose_filter import PoseFilter

Array = np.ndarray
_FLIP_RAD = math.radians(50)  # a rotation that changes by more between frames was misread
_FLIPS_BELIEVED = 4  # in a row
_DRIFT_M_S = 0.3  # speed at which an object that nobody sees may wander off
_NEAR = 0.5  # diameters between an object and what is read of it, beside the uncertainty
_SAME = 0.35  # diameters between two tracks that follow one object
_ACROSS, _IN_DEPTH, _ROTATION_RAD = 0.04, 0.03, math.radians(6)  # errors of a whole frame's poses


@dataclass(frozen=True, eq=False)
class Measurement:
    """A pose that one frame shows, in the frame's camera."""

    object: str
    """Name of the kind of object."""
    translation_m: Array
    """Position of the object's middle, [3]."""
    rotation: Array
    """cam_from_obj [3, 3]; the identity where every rotation of the object looks alike."""
    confidence: float
    """0 to 1."""
    covariance_m2: Array
    """[3, 3]."""
    rotation_variance: float
    """About each axis, rad²."""
    on_plane: bool = False
    """Whether the object was moved to stand on a plane."""
    presence: float | None = None
    """Probability that the object is in the frame, where the whole model says it."""
    color: tuple[float, ...] = ()
    """sRGB albedo in [0, 1], where the whole model says it."""

    @staticmethod
    def of_whole_frame(kind: ObjectModel, translation_m: Array, rotation: Array, confidence: float) -> "Measurement":
        """A pose from the whole model, which gives no spread: a larger variance in depth than across is assumed."""
        distance_m = float(np.linalg.norm(translation_m))
        ray = translation_m / max(distance_m, 1e-9)
        across, along = (_ACROSS * kind.diameter_m) ** 2, (_IN_DEPTH * distance_m) ** 2
        covariance = np.eye(3) * across + np.outer(ray, ray) * along
        return Measurement(
            kind.name, translation_m, as_compared(rotation, kind), confidence, covariance, _ROTATION_RAD**2
        )

    @staticmethod
    def of_crops(kind: ObjectModel, pose: CropPose) -> "Measurement":
        """A pose that was read from crops, with the network's own spread."""
        return Measurement(
            kind.name,
            pose.translation_m,
            as_compared(pose.rotation, kind),
            pose.confidence,
            pose.position_covariance_m2,
            pose.rotation_variance,
        )


@dataclass(eq=False)
class Track:
    """One object that is followed."""

    number: int
    """Constant as long as the object is followed; never given twice in a stream."""
    kind: ObjectModel
    """Kind of the object."""
    filter: PoseFilter
    """Filter of its pose, the position of which is that of the object's middle."""
    first_s: float
    """Time at which it was found, seconds."""
    seen_s: float
    """Time at which it was last seen, seconds."""
    measured: Measurement
    """The measurement of when it was last seen."""
    is_seen: bool = True
    """Whether it is seen in the current frame."""
    _symmetries: Array = field(default_factory=lambda: np.eye(3)[None])
    _num_flips: int = 0

    @staticmethod
    def begin(number: int, kind: ObjectModel, measured: Measurement, time_s: float) -> "Track":
        """The track of an object that was just found."""
        pose = PoseFilter(measured.translation_m, measured.rotation, measured.covariance_m2, measured.rotation_variance)
        return Track(number, kind, pose, time_s, time_s, measured, _symmetries=symmetry_rotations(kind))

    def predict(self, seconds: float) -> None:
        """Predict the next frame, in which it counts as not seen until :meth:`update`."""
        self.filter.predict(seconds, seen=self.is_seen)
        self.is_seen = False

    def update(self, measured: Measurement, time_s: float) -> None:
        """Update with a measurement in the current frame."""
        unseen_s, was_on_plane = time_s - self.seen_s, self.measured.on_plane
        self.is_seen, self.seen_s, self.measured = True, time_s, measured
        if self._is_elsewhere(measured) and unseen_s > 0:
            self.filter = PoseFilter(
                measured.translation_m, measured.rotation, measured.covariance_m2, measured.rotation_variance
            )
            return
        if measured.on_plane == was_on_plane:
            self.filter.update(measured.translation_m, measured.covariance_m2)
        else:  # it jumped, and did not move as fast
            self.filter.replace_position(measured.translation_m, measured.covariance_m2)
        rotation = self._nearest_symmetric(measured.rotation)
        if _angle(rotation, self.filter.rotation) < _FLIP_RAD:
            self._num_flips = 0
            self.filter.update_rotation(rotation, measured.rotation_variance)
        elif self._num_flips >= _FLIPS_BELIEVED:
            self._num_flips = 0
            self.filter.replace_rotation(rotation, measured.rotation_variance)
        else:
            self._num_flips += 1

    def confidence(self, time_s: float, keep_s: float) -> float:
        """Confidence of the last measurement; while the object is not seen it falls to 0 over ``keep_s``."""
        unseen = 0.0 if self.is_seen else (time_s - self.seen_s) / max(keep_s, 1e-9)
        return self.measured.confidence * max(0.0, 1 - unseen)

    def reach_m(self, time_s: float) -> float:
        """Largest distance from its expected position at which a measurement is assigned to it."""
        spread_m = 3 * float(self.filter.position_std_m.max())
        return _NEAR * self.kind.diameter_m + spread_m + _DRIFT_M_S * (time_s - self.seen_s)

    def _is_elsewhere(self, measured: Measurement) -> bool:
        gap = measured.translation_m - self.filter.translation_m
        return float(np.linalg.norm(gap)) > self.kind.diameter_m

    def _nearest_symmetric(self, rotation: Array) -> Array:
        if len(self._symmetries) == 1:
            return rotation
        candidates = rotation @ self._symmetries
        nearest: Array = candidates[np.tensordot(candidates, self.filter.rotation, 2).argmax()]
        return nearest


def assign(tracks: Sequence[Track], found: Sequence[Measurement], time_s: float, *, alone: bool) -> dict[int, int]:
    """Assign measurements to tracks with the least sum of distances.

    Args:
        tracks: Predicted to this frame.
        found: In this frame.
        time_s: Of this frame.
        alone: There is one object of each kind, so a measurement of it is that object wherever it is found.

    Returns:
        Index of the measurement by index of the track.
    """
    if not tracks or not found:
        return {}
    far = 1e6
    distance = np.full((len(tracks), len(found)), far)
    for row, track in enumerate(tracks):
        for column, measured in enumerate(found):
            gap_m = float(np.linalg.norm(measured.translation_m - track.filter.translation_m))
            if measured.object == track.kind.name and (alone or gap_m < track.reach_m(time_s)):
                distance[row, column] = gap_m
    return {row: column for row, column in assigned(distance).items() if distance[row, column] < far}


def without_doubles(tracks: Sequence[Track]) -> list[Track]:
    """Drop duplicates: of two tracks at one position, keep the one that is seen, or else the older one."""
    kept: list[Track] = []
    for track in sorted(tracks, key=lambda t: (not t.is_seen, t.number)):
        apart = _SAME * track.kind.diameter_m
        if all(
            other.kind.name != track.kind.name
            or float(np.linalg.norm(other.filter.translation_m - track.filter.translation_m)) > apart
            for other in kept
        ):
            kept.append(track)
    return sorted(kept, key=lambda t: t.number)


def _angle(one: Array, other: Array) -> float:
    return math.acos(min(1.0, max(-1.0, (float((one * other).sum()) - 1) / 2)))
