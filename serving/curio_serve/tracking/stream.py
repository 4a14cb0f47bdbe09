"""The state that one stream keeps from frame to frame; it ends with the stream."""

import math
from collections.abc import Callable
from itertools import count
from typing import TYPE_CHECKING

import numpy as np
from curio_proto.v1.detector_pb2 import Tracking

from curio_serve.errors import ArgumentError, CameraError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.models.answers import check_can_stand
from curio_serve.models.detector import Detector
from curio_serve.planes.plane import AnyPlane
from curio_serve.tracking.follower import Follower, Following

if TYPE_CHECKING:
    from curio_serve.models.detector import Results

_FRAME_S = 1 / 30  # between frames that do not say when they were taken
_LONGEST_S = 1e12
_SAME_CAMERA = 1e-6  # relative difference of K


class FollowingStream:
    """The followed objects of one stream's models. A frame that is refused changes nothing here."""

    versions: dict[str, int]
    """Version of each model that was asked for by its name alone."""

    def __init__(self) -> None:
        self.versions = {}
        self._followers: dict[str, Follower] = {}
        self._numbers = count(1)
        self._time_s: float | None = None
        self._size: tuple[int, int] | None = None
        self._camera: PinholeCamera | None = None

    def check(self, request: Tracking) -> tuple[Following, float]:
        """The options of following for a frame, and the time when it was taken.

        Raises:
            ArgumentError: Its time is no number or not after the frame before, or another value is out of range.
        """
        before = None if request.restart else self._time_s
        time_s = request.time_s if request.HasField("time_s") else (-_FRAME_S if before is None else before) + _FRAME_S
        if not math.isfinite(time_s) or abs(time_s) > _LONGEST_S:
            raise ArgumentError(f"track.time_s is {time_s}; expected seconds")
        if before is not None and time_s <= before:
            raise ArgumentError(
                f"track.time_s is {time_s:.6f}, {before - time_s:.6g} s before that of the frame before; expected "
                "frames in the order in which they were taken, or track.restart to begin anew"
            )
        given = {name: getattr(request, name) for name in ("keep_s", "num_objects") if request.HasField(name)}
        return Following(**given, search=request.search), time_s

    def follow(
        self,
        request: Tracking,
        detectors: list[Detector],
        pixels: np.ndarray,
        camera: PinholeCamera | None,
        *,
        min_confidence: float,
        plane: AnyPlane | None = None,
        reduction: int,
        results: "Results",
        before_run: Callable[[], None] = lambda: None,
    ) -> None:
        """Add each model's result of one frame to those of a response.

        Args:
            request: How to follow.
            detectors: Of the models.
            pixels: uint8 RGB [height / reduction, width / reduction, 3].
            camera: Intrinsics of the full-size frame.
            min_confidence: Detections below it are not answered.
            plane: On which objects stand in this frame, see
                :meth:`~curio_serve.models.detector.Detector.detect`.
            reduction: How much smaller than the frame the pixels were decoded.
            results: The field of a response.
            before_run: Called before each run of a network.

        Raises:
            ArgumentError: See :meth:`check`; or a model is of a 2D world, or does not say how its objects stand and a
                plane is given.
            CameraError: Frame or K are of another camera than before, or K cannot be this frame's.
            CameraMissing: A model needs K.
            InternalError: A network failed.
        """
        following, time_s = self.check(request)
        for detector in detectors:
            if detector.model.camera.matrix is None:
                raise ArgumentError(f"model {detector.model.label} is of a 2D world; poses in space can be followed")
            if plane is not None:
                check_can_stand(detector.model)
        size = pixels.shape[1] * reduction, pixels.shape[0] * reduction
        for detector in detectors:
            detector.camera_of(camera, *size)
        if not request.restart:
            self._check_same_camera(size, camera)
        if camera is not None:
            camera.check_frame(*size)
        followers = {} if request.restart else dict(self._followers)
        numbers = count(1) if request.restart else self._numbers
        for detector in detectors:
            before = followers.get(detector.model.label)
            follower = followers[detector.model.label] = Follower(numbers) if before is None else before.copy()
            follower.follow(
                detector,
                pixels,
                camera,
                time_s,
                following,
                min_confidence=min_confidence,
                plane=plane,
                reduction=reduction,
                results=results,
                before_run=before_run,
            )
        # Only now: a frame that is refused changes nothing.
        self._followers, self._numbers = followers, numbers
        self._time_s, self._size, self._camera = time_s, size, camera

    def _check_same_camera(self, size: tuple[int, int], camera: PinholeCamera | None) -> None:
        if self._size is None:
            return
        if size != self._size:
            raise CameraError(
                f"the frame has {size[0]}x{size[1]} pixels, those before it {self._size[0]}x{self._size[1]}; objects "
                "are followed in the frames of one camera: set track.restart to begin anew"
            )
        if (camera is None) != (self._camera is None) or not _is_same(camera, self._camera):
            raise CameraError(
                "K or the distortion differ from those of the frames before; objects are followed in the frames of one "
                "camera: set track.restart to begin anew"
            )


def _is_same(one: PinholeCamera | None, other: PinholeCamera | None) -> bool:
    if one is other or one is None or other is None:
        return True
    same_matrix = np.abs(one.matrix - other.matrix).max() <= _SAME_CAMERA * np.abs(other.matrix).max()
    return bool(same_matrix) and one.distortion == other.distortion
