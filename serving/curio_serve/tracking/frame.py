"""One frame of a stream: runs the model on it, whole or with objects covered, and fills its answer."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from curio_proto.v1.detector_pb2 import Detection, RegionResult
from curio_proto.v1.detector_pb2 import Track as TrackMessage

from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.rotation import quaternion_xyzw
from curio_serve.models.detector import Detector
from curio_serve.models.instances import cover, enlarged
from curio_serve.models.object_frames import center_of, middle_from_origin, origin_from_middle, transformed
from curio_serve.models.reliability import status_of
from curio_serve.models.stages.crop_stage import CropPose
from curio_serve.tracking.frame_plane import FramePlane
from curio_serve.tracking.tracks import Measurement, Track

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class StreamFrame:
    """A frame, its camera and the model to run on it."""

    detector: Detector
    """Detector of the model."""
    pixels: Array
    """uint8 RGB [height / reduction, width / reduction, 3]."""
    camera: PinholeCamera | None
    """Intrinsics of the full-size frame."""
    reduction: int
    """Factor by which the pixels are smaller than the frame."""
    time_s: float
    """Time at which it was taken, seconds."""
    plane: FramePlane
    """On which its objects stand."""
    before_run: Callable[[], None]
    """Called before each run of a network."""

    @cached_property
    def known_camera(self) -> PinholeCamera | None:
        """The camera, or the model's default camera for a frame without one."""
        height, width = self.pixels.shape[:2]
        default = self.detector.model.camera.for_frame(width * self.reduction, height * self.reduction)
        return self.camera or default

    @cached_property
    def scaled_camera(self) -> PinholeCamera | None:
        """The camera of the pixels as they were decoded."""
        return None if self.known_camera is None else self.known_camera.reduced(self.reduction)

    def look(self, hidden: Sequence[Track]) -> tuple[list[Measurement], Sequence[float]]:
        """Run the whole model.

        Args:
            hidden: Objects that are covered first, so that a model of one object finds another.

        Returns:
            What it finds of any confidence, and the light.
        """
        pixels = self.pixels
        if hidden and self.scaled_camera is not None:
            pixels = pixels.copy()
            for track in hidden:
                self._cover(pixels, self.scaled_camera, track)
        (result,) = self.detector.detect(pixels, self.camera, reduction=self.reduction, before_run=self.before_run)
        kinds = {kind.name: kind for kind in self.detector.model.spec.objects}
        found = []
        for detection in result.detections:
            kind = kinds[detection.object]
            rotation = np.reshape(detection.rotation, (3, 3)) if detection.rotation else np.eye(3)
            middle_m = middle_from_origin(np.array(detection.translation_m), rotation, center_of(kind))
            measured = Measurement.of_whole_frame(kind, middle_m, rotation, detection.confidence)
            presence = detection.presence if detection.HasField("presence") else None
            found.append(replace(measured, presence=presence, color=tuple(detection.color)))
        return found, result.light

    def read(self, position_m: Array) -> CropPose | None:
        """The pose in crops around a position; None: the frame does not show it, or the model has no such stage."""
        stage, camera = self.detector.model.crop_stage, self.scaled_camera
        height, width = self.pixels.shape[:2]
        if stage is None or camera is None or not stage.sees(camera, position_m, width, height):
            return None
        self.before_run()
        pose = self.detector.read_crops(self.pixels, camera, position_m)
        return pose if pose.translation_m[2] > 0 else None

    def add_detection(
        self, result: RegionResult, object_: str, middle_m: Array, rotation: Array, confidence: float
    ) -> Detection:
        """Add a pose in the frame's camera to a result, given where the object's middle is."""
        slot = next(slot for slot in self.detector.model.slots if slot.object == object_)
        origin_m = origin_from_middle(middle_m, rotation, np.array(slot.center))
        rows, position = rotation.ravel().tolist(), origin_m.tolist()
        nearest, farthest = self.detector.depths_m
        corners = transformed(slot.box_corners, rows, position)
        return result.detections.add(
            object=object_,
            confidence=confidence,
            translation_m=position,
            rotation_6d=[*rows[0::3], *rows[1::3]],
            rotation=rows,
            quaternion_xyzw=quaternion_xyzw(rows),
            box_px=[] if self.known_camera is None else self.known_camera.pixels(corners),
            outside_trained_range=not nearest <= middle_m[2] <= farthest,
            status=status_of(self.detector.model.spec.reliability, object_, confidence),
        )

    def describe(self, message: TrackMessage, track: Track) -> None:
        """Write a track's number, age and filtered pose into an answer."""
        pose = track.filter
        message.track_id, message.predicted = track.number, not track.is_seen
        message.age_s, message.unseen_s = self.time_s - track.first_s, self.time_s - track.seen_s
        origin_m = origin_from_middle(pose.translation_m, pose.rotation, center_of(track.kind))
        message.translation_m.extend(origin_m.tolist())
        rows = pose.rotation.ravel().tolist()
        message.rotation.extend(rows)
        message.quaternion_xyzw.extend(quaternion_xyzw(rows))
        message.velocity_m_s.extend(pose.velocity_m_s.tolist())
        message.position_std_m.extend(pose.position_std_m.tolist())
        message.rotation_std_rad = pose.rotation_std_rad

    def _cover(self, pixels: Array, camera: PinholeCamera, track: Track) -> None:
        """Paint over an object's box with the mean colour of its corners' surroundings, in place."""
        pose, corners = track.measured, np.reshape(track.kind.box_corners_m, (-1, 3))
        if not len(corners):
            return
        seen = camera.project((enlarged(corners) - center_of(track.kind)) @ pose.rotation.T + pose.translation_m)
        if np.isfinite(seen).all():
            cover(pixels, seen)
