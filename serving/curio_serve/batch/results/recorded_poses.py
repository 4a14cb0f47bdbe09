"""Detections as a recording: one ``vision_msgs/Detection3DArray`` an image, with the image's stamp and frame id."""

import json
import os
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np
from curio_proto.v1.detector_pb2 import Detection
from curio_proto.v1.model_spec_pb2 import ObjectModel

from curio_serve.batch.results.formats import ImageLines, ImageResult
from curio_serve.batch.results.result_file import NamedT, open_locked
from curio_serve.errors import OutputError, UsageError
from curio_serve.files import direct

TOPIC = "detections"
"""Topic of the detections, beside that of the images: /camera/detections for /camera/image_raw."""
_TYPE = "vision_msgs/msg/Detection3DArray"
_NEXT = "=" * 80 + "\nMSG: "
# The definitions of vision_msgs 4 (ROS 2 Humble and later) and of what they are made of, without their comments.
SCHEMA = _NEXT.join(
    [
        "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
        "std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n",
        "builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n",
        "vision_msgs/Detection3D\nstd_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id\n",
        "vision_msgs/ObjectHypothesisWithPose\nvision_msgs/ObjectHypothesis hypothesis\n"
        "geometry_msgs/PoseWithCovariance pose\n",
        "vision_msgs/ObjectHypothesis\nstring class_id\nfloat64 score\n",
        "geometry_msgs/PoseWithCovariance\ngeometry_msgs/Pose pose\nfloat64[36] covariance\n",
        "geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
        "geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n",
        "geometry_msgs/Quaternion\nfloat64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n",
        "vision_msgs/BoundingBox3D\ngeometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
        "geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n",
    ]
)


class Detection3DArrays:
    """Builds the message of each image, as JSON until it is written.

    Args:
        objects: Of the models' specs; their boxes become the bounding boxes.
    """

    def __init__(self, objects: Sequence[ObjectModel]) -> None:
        self._boxes = {kind.name: np.array(kind.box_corners_m).reshape(-1, 3) for kind in objects}

    def lines(self, results: Sequence[ImageResult]) -> ImageLines:
        """The message of an image, with what all models found that answered; none where none did."""
        error = "; ".join(dict.fromkeys(result.error for result in results if result.error))
        image, at = results[0].image, results[0].recorded
        if at is None or all(result.error for result in results):
            return ImageLines(image, error, b"")
        seconds, nanoseconds = divmod(at.stamp_ns, 10**9)
        header: dict[str, object] = {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": at.frame_id}
        found = [self._detection(detection, header) for result in results for detection in result.detections]
        topic = f"{at.topic.removesuffix('/compressed').rpartition('/')[0]}/{TOPIC}"
        message = {"header": header, "detections": found}
        data = json.dumps({"topic": topic, "log_time_ns": at.log_time_ns, "message": message}).encode()
        return ImageLines(image, error, data)

    def _detection(self, detection: Detection, header: dict[str, object]) -> dict[str, object]:
        position = np.array(detection.translation_m)
        x, y, z, w = detection.quaternion_xyzw or (0.0, 0.0, 0.0, 1.0)
        orientation = {"x": x, "y": y, "z": z, "w": w}
        corners = self._boxes[detection.object]
        middle = np.zeros(3) if len(corners) == 0 else (corners.min(axis=0) + corners.max(axis=0)) / 2
        size = np.zeros(3) if len(corners) == 0 else np.ptp(corners, axis=0)
        if detection.rotation:
            middle = np.array(detection.rotation).reshape(3, 3) @ middle
        pose = {"position": _xyz(position), "orientation": orientation}
        box = {"center": {"position": _xyz(position + middle), "orientation": orientation}, "size": _xyz(size)}
        hypothesis = {"class_id": detection.object, "score": detection.confidence}
        covariance = {"pose": pose, "covariance": [0.0] * 36}
        return {"header": header, "results": [{"hypothesis": hypothesis, "pose": covariance}], "bbox": box, "id": ""}


class PoseRecording:
    """Writes such messages to an MCAP file. Unlike a text file, a recording cannot be continued after a stop.

    Args:
        path: The file.
        overwrite: Replace one that exists.

    Raises:
        UsageError: There is one.
        OutputError: It cannot be opened for writing, or another process writes it.
    """

    num_images: int
    """Images that were read so far, failed ones among them."""
    num_errors: int
    """Images that a model or more gave no answer for. The recording has no message where none did."""

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        self.num_images = self.num_errors = 0
        self.label = str(path)
        self._path = direct(path)
        self._is_new = not self._path.exists()
        if not self._is_new and not overwrite:
            raise UsageError(f"--out {path} exists, and a recording cannot be gone on with; --overwrite replaces it")
        self._file: IO[bytes] = os.fdopen(open_locked(path), "ab")
        self._writer: Any = None  # until there is an image: an earlier recording is worth more than none
        self._schema: Any = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Close the recording, which is readable even after an early stop."""
        if self._writer is None:
            self._file.close()
            if self._is_new:
                self._path.unlink()
            return
        with self._file:
            try:
                self._writer.finish()
                self._file.flush()
            except OSError as exc:
                raise OutputError(self._not_written(exc)) from exc

    def unanswered(self, images: Iterator[NamedT]) -> Iterator[NamedT]:
        """All of the images; what was in the file is gone once there is a first one."""
        from mcap_ros2.writer import Writer

        first = next(images, None)
        if first is None:
            return images
        self._file.truncate(0)
        self._file.seek(0)  # from where the writer counts
        self._writer = Writer(self._file)
        self._schema = self._writer.register_msgdef(_TYPE, SCHEMA)
        return chain((first,), images)

    def write(self, lines: ImageLines) -> None:
        """Append the message of one image.

        Raises:
            OutputError: The disk is full or the file cannot be written.
        """
        self.num_images += 1
        self.num_errors += bool(lines.error)
        if not lines.data:
            return
        content = json.loads(lines.data)
        try:
            self._writer.write_message(
                content["topic"], self._schema, content["message"], content["log_time_ns"], sequence=self.num_images
            )
        except OSError as exc:
            raise OutputError(self._not_written(exc)) from exc

    def _not_written(self, exc: OSError) -> str:
        reason = exc.strerror or os.strerror(exc.errno or 0)
        return f"cannot write to {self.label}: {reason}; make room and run the same command with --overwrite"


def _xyz(values: np.ndarray) -> dict[str, float]:
    return dict(zip("xyz", values.tolist(), strict=True))
