"""Follows the objects of one model through the frames of one stream.

An object that was found is looked for where it is expected: the crop-pose stage alone reads it there. The whole frame
is looked at where nothing is followed, at an interval, where confidence falls, and when a request asks for it. An
object that is not seen for a while keeps its track and is answered as predicted.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np
from curio_proto.v1.detector_pb2 import DETECTION_STATUS_SURE, DETECTION_STATUS_UNSURE

from curio_serve.errors import ArgumentError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.models.answers import standing_shapes, write_plane
from curio_serve.models.detector import Detector
from curio_serve.models.reliability import region_status
from curio_serve.planes.plane import AnyPlane
from curio_serve.tracking.frame import StreamFrame
from curio_serve.tracking.frame_plane import FramePlane
from curio_serve.tracking.tracks import Measurement, Track, assign, without_doubles

if TYPE_CHECKING:
    from curio_serve.models.detector import Results

Array = np.ndarray
KEEP_S, MAX_OBJECTS = 1.5, 16
_FOUND, _FOLLOWED = 0.2, 0.08  # least confidence to begin a track, and to go on with it
_SEARCH_S = 0.09  # between looks at whole frames while an object is not seen
_MORE_S, _VERIFY_S = 0.5, 2.0  # the same for further objects, and to make sure of those that are followed
_AROUND = 0.6  # diameters between the crops in which an object is looked for that is not seen
_OFFSETS = np.array([(x, y, 0) for x in (-1, 0, 1) for y in (-1, 0, 1)])
_TAKEN = 0.5  # diameters around an object within which no other one is
_PAUSE = 10.0  # times the step before: a longer step is a pause, after which nothing is where it was
_SURER = 0.2  # by which another place must be more confident than the one that is followed


@dataclass(frozen=True)
class Following:
    """How objects are followed."""

    keep_s: float = KEEP_S
    """Seconds for which an object that is not seen is answered with its predicted pose."""
    num_objects: int = 1
    """Largest number of objects of each kind that are followed at a time."""
    search: bool = False
    """Run the whole model on this frame in any case."""

    def __post_init__(self) -> None:
        """Refuse impossible values.

        Raises:
            ArgumentError: A value is out of range.
        """
        if not 0 <= self.keep_s <= 3600:
            raise ArgumentError(f"track.keep_s is {self.keep_s}; expected 0 to 3600 seconds")
        if not 1 <= self.num_objects <= MAX_OBJECTS:
            raise ArgumentError(f"track.num_objects is {self.num_objects}; expected 1 to {MAX_OBJECTS}")


class Follower:
    """The objects of one model in one stream; not to be shared between threads."""

    def __init__(self, numbers: Iterator[int]) -> None:
        """Follow nothing yet.

        Args:
            numbers: Of new tracks, each once; those of a stream for all of its models.
        """
        self._tracks: list[Track] = []
        self._numbers = numbers
        self._looked_s = self._searched_s = self._time_s = -math.inf
        self._step_s = 0.0

    def copy(self) -> Self:
        """One that follows the same from here on: numbers of new tracks are those of both."""
        return deepcopy(self, {id(self._numbers): self._numbers})

    def follow(
        self,
        detector: Detector,
        pixels: Array,
        camera: PinholeCamera | None,
        time_s: float,
        following: Following,
        *,
        min_confidence: float = 0.0,
        plane: AnyPlane | None = None,
        reduction: int = 1,
        results: "Results",
        before_run: Callable[[], None] = lambda: None,
    ) -> None:
        """Add the result of one frame to those of a response.

        Args:
            detector: Of the model.
            pixels: uint8 RGB [height / reduction, width / reduction, 3].
            camera: Intrinsics of the full-size frame.
            time_s: When it was taken, after the frame before.
            following: How.
            min_confidence: Objects last seen with less are not answered; how far a prediction faded is no matter.
            plane: On which objects stand in this frame, camera frame, or the one on which most of them do.
            reduction: How much smaller than the frame the pixels were decoded.
            results: The field of a response.
            before_run: Called before each run of a network.

        Raises:
            As :meth:`~curio_serve.models.detector.Detector.detect`.
        """
        shapes = {} if plane is None else standing_shapes(detector.model)
        frame = StreamFrame(detector, pixels, camera, reduction, time_s, FramePlane(shapes, plane), before_run)
        wanted = [slot.object for slot in detector.model.slots]
        self._tracks = [track for track in self._tracks if track.kind.name in wanted]
        step_s, last_s = time_s - self._time_s, self._step_s
        if last_s and step_s > max(following.keep_s, _PAUSE * last_s):  # nobody saw where anything went meanwhile
            self._tracks = []
        for track in self._tracks:
            track.predict(step_s)
        self._time_s, self._step_s = time_s, step_s
        light = self._read_crops(frame)
        is_searched = time_s - self._searched_s >= _SEARCH_S and not all(track.is_seen for track in self._tracks)
        if is_searched:
            self._searched_s = time_s
            light = self._search_around(frame) or light
        if self._is_look_due(frame, following, is_searched):
            self._looked_s = time_s
            light = self._look(frame, following) or light
        kept = [track for track in self._tracks if time_s - track.seen_s <= following.keep_s]
        self._tracks = _most_of_each(without_doubles(kept), following.num_objects)
        self._answer(frame, light, following, min_confidence, results)

    def _read_crops(self, frame: StreamFrame) -> Sequence[float]:
        """Read each object from crops at its expected position; return the light."""
        read = [(track, frame.read(track.filter.translation_m)) for track in self._tracks]
        seen = [(track, pose) for track, pose in read if pose is not None and pose.confidence >= _FOLLOWED]
        found = frame.plane.stood([Measurement.of_crops(track.kind, pose) for track, pose in seen])
        for (track, _), measured in zip(seen, found, strict=True):
            track.update(measured, frame.time_s)
        return seen[-1][1].light.tolist() if seen else ()

    def _search_around(self, frame: StreamFrame) -> Sequence[float]:
        """Search each object that is not seen around its last position; return the light."""
        light: Sequence[float] = ()
        for track in self._tracks:
            if track.is_seen:
                continue
            offsets_m = _AROUND * track.kind.diameter_m
            read = [frame.read(track.measured.translation_m + offsets_m * offset) for offset in _OFFSETS]
            seen = [pose for pose in read if pose is not None and pose.confidence >= _FOLLOWED]
            found = frame.plane.stood([Measurement.of_crops(track.kind, pose) for pose in seen])
            free = [
                (measured.confidence, number)
                for number, measured in enumerate(found)
                if not self._is_taken(track, measured.translation_m)
            ]
            if free:
                _, surest = max(free)
                track.update(found[surest], frame.time_s)
                light = seen[surest].light.tolist()
        return light

    def _is_taken(self, track: Track, position_m: Array) -> bool:
        """Whether an object other than that of the track is seen at this position."""
        apart_m = _TAKEN * track.kind.diameter_m
        return any(
            other.is_seen
            and other.kind.name == track.kind.name
            and float(np.linalg.norm(other.measured.translation_m - position_m)) < apart_m
            for other in self._tracks
        )

    def _is_look_due(self, frame: StreamFrame, following: Following, is_searched: bool) -> bool:
        """Whether to run the whole model.

        Args:
            frame: Whose crops were read.
            following: How.
            is_searched: Whether what is not seen was searched for around its last position.
        """
        if frame.detector.model.crop_stage is None or following.search:
            return True
        num_seen = sum(track.is_seen for track in self._tracks)
        if num_seen < len(self._tracks):
            return is_searched
        wanted = following.num_objects * len(frame.detector.model.spec.objects)
        interval_s = _SEARCH_S if num_seen == 0 else _MORE_S if num_seen < wanted else _VERIFY_S
        return frame.time_s - self._looked_s >= interval_s

    def _look(self, frame: StreamFrame, following: Following) -> Sequence[float]:
        """Run the whole model on the frame; return the light."""
        has_crops = frame.detector.model.crop_stage is not None
        hidden = [track for track in self._tracks if track.is_seen] if has_crops and following.num_objects > 1 else []
        found, light = frame.look(hidden)
        alone = following.num_objects == 1
        found = frame.plane.stood([measured for measured in found if measured.confidence >= _FOLLOWED])
        if has_crops and alone:
            found = self._verified(found)
        unseen = [track for track in self._tracks if not track.is_seen]
        pairs = assign(unseen, found, frame.time_s, alone=alone)
        for row, column in pairs.items():
            unseen[row].update(found[column], frame.time_s)
        for column, measured in enumerate(found):
            if column not in pairs.values() and measured.confidence >= _FOUND:
                self._begin(frame, measured, following)
        return light

    def _verified(self, found: list[Measurement]) -> list[Measurement]:
        """Drop a track if a detection elsewhere is more confident; return the detections of objects not seen yet."""
        left = []
        for measured in found:
            seen = next((t for t in self._tracks if t.is_seen and t.kind.name == measured.object), None)
            if seen is None:
                left.append(measured)
                continue
            gap_m = float(np.linalg.norm(measured.translation_m - seen.measured.translation_m))
            if gap_m > seen.kind.diameter_m and measured.confidence > seen.measured.confidence + _SURER:
                self._tracks.remove(seen)
                left.append(measured)
        return left

    def _begin(self, frame: StreamFrame, measured: Measurement, following: Following) -> None:
        kind = next(kind for kind in frame.detector.model.spec.objects if kind.name == measured.object)
        same = [track for track in self._tracks if track.kind.name == kind.name]
        if len(same) >= following.num_objects:
            replaced = min(same, key=lambda track: (track.is_seen, track.seen_s, track.measured.confidence))
            is_surer = measured.confidence > replaced.measured.confidence + _SURER
            if (replaced.is_seen and not is_surer) or self._is_taken(replaced, measured.translation_m):
                return
            self._tracks.remove(replaced)
        self._tracks.append(Track.begin(next(self._numbers), kind, measured, frame.time_s))

    def _answer(
        self,
        frame: StreamFrame,
        light: Sequence[float],
        following: Following,
        min_confidence: float,
        results: "Results",
    ) -> None:
        model = frame.detector.model
        result = results.add(model=model.name, model_version=model.version)
        result.light.extend(light)
        if frame.plane.plane is not None:
            write_plane(result, frame.plane.plane)
        now_s, keep_s = frame.time_s, following.keep_s
        for track in sorted(self._tracks, key=lambda t: (-t.confidence(now_s, keep_s), t.number)):
            if track.measured.confidence < min_confidence:
                continue
            pose = track.filter
            raw = track.measured if track.is_seen else None
            detection = frame.add_detection(
                result,
                track.kind.name,
                pose.translation_m if raw is None else raw.translation_m,
                pose.rotation if raw is None else raw.rotation,
                track.confidence(now_s, keep_s),
            )
            if raw is not None:
                detection.on_plane = raw.on_plane
                detection.color.extend(raw.color)
                if raw.presence is not None:
                    detection.presence = raw.presence
            frame.describe(detection.track, track)
            if raw is None and detection.status == DETECTION_STATUS_SURE:  # this frame does not show it
                detection.status = DETECTION_STATUS_UNSURE
        result.status = region_status(result.detections)


def _most_of_each(tracks: Sequence[Track], num: int) -> list[Track]:
    """At most ``num`` tracks of each kind of object, those that are seen first, in their order."""
    kept: list[Track] = []
    for track in sorted(tracks, key=lambda track: not track.is_seen):
        if sum(other.kind.name == track.kind.name for other in kept) < num:
            kept.append(track)
    return [track for track in tracks if track in kept]
