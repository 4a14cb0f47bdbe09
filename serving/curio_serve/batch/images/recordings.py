"""Images of robots' recordings: MCAP with ROS 2 messages (extra ``robots``), each with the K of its CameraInfo.

A camera's image and its CameraInfo carry the same stamp. They come in either order, a little apart; an image waits for
its CameraInfo until a few more images have come. Nothing here grows with the length of the recording.
"""

import os
import struct
from collections import OrderedDict, deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from typing import IO, Any

from curio_serve.batch.images.source_image import RecordedAt, SourceImage, Topics
from curio_serve.errors import CameraError, ImageError, UsageError
from curio_serve.files import check_regular
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.camera_files import camera_of_images
from curio_serve.imaging.image import RawFormat, from_raw

_IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_INFO_TYPE = "sensor_msgs/msg/CameraInfo"
_RAW: dict[str, RawFormat] = {"rgb8": "RGB8", "bgr8": "BGR8", "mono8": "GRAY8"}
_NUM_WAITING = 8  # images that wait for their CameraInfo
_NUM_INFOS = 256


class Recording:
    """The images of one topic of an MCAP file."""

    image_topic: str
    """Topic of the images."""
    info_topic: str
    """Topic of their CameraInfo."""
    has_info: bool
    """Whether the recording has that topic."""

    def __init__(self, path: str, topics: Topics) -> None:
        """Read what the recording holds, and no message yet.

        Raises:
            UsageError: The extra ``robots`` is not installed, the file cannot be read or is cut off, or it has no such
                topic of images.
        """
        if find_spec("mcap_ros2") is None:
            raise UsageError(f"{path}: recordings need the extra robots: pip install 'curio-pose[robots]'")
        self.path = path
        types = self._types()
        self.image_topic = topics.image or _only_image_topic(path, types)
        if self.image_topic not in types:
            raise UsageError(f"{path} has no topic {self.image_topic}; --topic takes one of: {_images_first(types)}")
        if types[self.image_topic] not in _IMAGE_TYPES:
            raise UsageError(
                f"{path}: --topic {self.image_topic} holds {types[self.image_topic]}, expected "
                f"{' or '.join(_IMAGE_TYPES)}; it has {_images_first(types)}"
            )
        self.info_topic = topics.info or info_topic_of(self.image_topic)
        self.has_info = types.get(self.info_topic) == _INFO_TYPE
        self._others = _images_first(types)

    def refuse_without_info(self) -> None:
        """Refuse a recording without K, for models that need it.

        Raises:
            UsageError: There is no CameraInfo.
        """
        if not self.has_info:
            raise UsageError(
                f"{self.path} has no {_INFO_TYPE} on {self.info_topic}, which would say K; it has {self._others}. Name "
                "its topic with --info-topic, or give --camera FILE"
            )

    def images(self) -> Iterator[SourceImage]:
        """Every image, in the order of recording. After damage, the last one carries the error."""
        infos: OrderedDict[int, PinholeCamera | str] = OrderedDict()
        waiting: deque[SourceImage] = deque()
        number = 0
        try:
            for topic, message, log_time_ns in self._messages():
                stamp_ns = _stamp_ns(message)
                if topic == self.info_topic:
                    infos[stamp_ns] = _camera(message, self.image_topic)
                    if len(infos) > _NUM_INFOS:
                        infos.popitem(last=False)
                else:
                    number += 1
                    at = RecordedAt(self.image_topic, stamp_ns, log_time_ns, message.header.frame_id)
                    waiting.append(self._image(message, at))
                yield from self._ready(waiting, infos, _NUM_WAITING if self.has_info else 0)
        except _damage() as exc:
            yield from self._ready(waiting, infos, 0)
            yield SourceImage(self.path, self.path, error=_damaged(exc, f"after {number} images"))
            return
        yield from self._ready(waiting, infos, 0)

    def _ready(
        self, waiting: deque[SourceImage], infos: OrderedDict[int, PinholeCamera | str], most: int
    ) -> Iterator[SourceImage]:
        """The oldest images that have their CameraInfo, or that have waited for it too long."""
        while waiting:
            at = waiting[0].recorded
            assert at is not None
            found = infos.get(at.stamp_ns)
            if found is None and len(waiting) <= most:
                return
            image = waiting.popleft()
            if isinstance(found, PinholeCamera):
                yield replace(image, camera=found)
            else:
                missing = f"no CameraInfo on {self.info_topic} has the image's stamp; give --camera FILE"
                yield replace(image, no_camera=found or missing)

    def _image(self, message: Any, at: RecordedAt) -> SourceImage:
        seconds, nanoseconds = divmod(at.stamp_ns, 10**9)
        name = f"{self.path}#{self.image_topic}@{seconds}.{nanoseconds:09d}"
        image = SourceImage(name, self.path, recorded=at)
        if hasattr(message, "format"):
            return replace(image, data=bytes(message.data))
        if message.encoding not in _RAW:
            known = ", ".join(_RAW)
            text = f"its encoding is {message.encoding!r}, expected {known} or a compressed image; convert it"
            return replace(image, error=f"{text} (ROS's image_proc makes rgb8 of Bayer patterns)")
        try:
            raw = _RAW[message.encoding]
            frame = from_raw(bytes(message.data), raw, message.width, message.height, message.step)
        except ImageError as exc:
            return replace(image, error=str(exc))
        return replace(image, pixels=frame.pixels)

    def _messages(self) -> Iterator[tuple[str, Any, int]]:
        """(topic, message, log time) of both topics, in the order of recording."""
        from mcap_ros2.decoder import DecoderFactory

        with self._open() as file:
            reader = _reader(file, [DecoderFactory()])
            for _, channel, record, message in reader.iter_decoded_messages([self.image_topic, self.info_topic]):
                yield channel.topic, message, record.log_time

    def _types(self) -> dict[str, str]:
        """The type of each topic's messages."""
        try:
            with self._open() as file:
                summary = _reader(file, []).get_summary()
                if summary is None:
                    raise EOFError("no summary at its end")
                return {
                    channel.topic: _modern(summary.schemas[channel.schema_id].name)
                    for channel in summary.channels.values()
                    if channel.schema_id in summary.schemas and channel.message_encoding == "cdr"
                }
        except _damage() as exc:
            if isinstance(exc, OSError):
                raise UsageError(f"{self.path} cannot be read: {exc.strerror}") from exc
            raise UsageError(f"{self.path}: {_damaged(exc, 'before its end')}") from exc

    @contextmanager
    def _open(self) -> Iterator[IO[bytes]]:
        """The file; a pipe is refused without waiting for its writer."""
        check_regular(os.stat(self.path), self.path)
        with open(self.path, "rb") as file:
            yield file


def info_topic_of(image_topic: str) -> str:
    """The topic of the CameraInfo by ROS's naming: /camera/camera_info of /camera/image_raw and its compressed one."""
    base = image_topic.removesuffix("/compressed")
    return f"{base.rpartition('/')[0]}/camera_info"


def _reader(file: IO[bytes], decoders: Sequence[Any]) -> Any:
    from mcap.reader import make_reader

    return make_reader(file, validate_crcs=True, decoder_factories=decoders)


def _damage() -> tuple[type[Exception], ...]:
    """The errors that mcap's readers let through on damaged files."""
    from mcap.exceptions import McapError
    from zstandard import ZstdError

    built_in = (ValueError, LookupError, TypeError, AttributeError, RuntimeError, OSError, EOFError, ArithmeticError)
    return (*built_in, McapError, ZstdError, struct.error)


def _damaged(exc: Exception, where: str) -> str:
    reason = f"{type(exc).__name__}{f': {exc}' if str(exc) else ''}"
    return f"the recording is cut off or damaged {where} ({reason}); `mcap recover` saves what is whole"


def _modern(name: str) -> str:
    """The name of a message type with its package's folder ``msg``, which old recordings leave out."""
    package, _, kind = name.rpartition("/")
    return name if package.endswith("/msg") else f"{package}/msg/{kind}"


def _only_image_topic(path: str, types: dict[str, str]) -> str:
    found = [topic for topic, kind in types.items() if kind in _IMAGE_TYPES]
    if len(found) != 1:
        number = f"{len(found)} topics of images" if found else "no topic of images"
        raise UsageError(f"{path} has {number}; --topic names the one to read: {_images_first(types)}")
    return found[0]


def _images_first(types: dict[str, str]) -> str:
    """A list of topics and their types for an error message, topics of images first."""
    ordered = sorted(types, key=lambda topic: (types[topic] not in _IMAGE_TYPES, topic))
    return ", ".join(f"{topic} ({types[topic]})" for topic in ordered) or "no topic of ROS 2 messages"


def _stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def _camera(info: Any, image_topic: str) -> PinholeCamera | str:
    """The camera of the topic's images, or what is wrong with it."""
    try:
        return camera_of_images(info, image_topic)
    except CameraError as exc:
        return f"CameraInfo: {exc}"
