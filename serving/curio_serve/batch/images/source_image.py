"""An image as the commands pass it along: from a file, from a video or from a robot's recording."""

import os
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from curio_serve.batch.images.remote_files import check_scheme, files_of, is_url, path_of, place_and_query
from curio_serve.errors import ImageError, UsageError
from curio_serve.files import read_file
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.image import MAX_FILE_BYTES

Pixels: TypeAlias = np.ndarray


@dataclass(frozen=True)
class Topics:
    """The topics that are read of a recording."""

    image: str | None = None
    """Topic of the images; None: the only one there is."""
    info: str | None = None
    """Topic of their CameraInfo; None: by ROS's naming, beside the images."""


@dataclass(frozen=True)
class RecordedAt:
    """The topic and the times of an image in a robot's recording."""

    topic: str
    """Topic of the image."""
    stamp_ns: int
    """Time stamp in the image's header, set by the camera; since the epoch."""
    log_time_ns: int
    """When the image was recorded."""
    frame_id: str
    """Name of the camera's optical frame."""


@dataclass(frozen=True)
class SourceImage:
    """An image to detect in."""

    name: str
    """Its path as given; a video's frames are ``clip.mp4#0`` and so on, a recording's ``run.mcap#/topic@SECONDS``."""
    path: str
    """The file it comes from."""
    video_frame: int | None = None
    """Its number in a video; None for an image file."""
    pixels: Pixels | None = None
    """Uint8 RGB [height, width, 3] of a video's frame or a recording's raw image."""
    data: bytes | None = None
    """Content of a recording's compressed image."""
    camera: PinholeCamera | None = None
    """The image's own camera, if it comes from a recording that has it."""
    no_camera: str = ""
    """Why the recording has no camera for it."""
    recorded: RecordedAt | None = None
    """Topic and times, if the image comes from a recording."""
    error: str = ""
    """Why a video has no frames to give, or not this one, or a folder no images."""
    time_s: float | None = None
    """When a video's frame was taken, since its first, where that is known."""

    def read(self) -> bytes:
        """The bytes of an image file.

        Raises:
            ImageError: The file cannot be read, is no regular file or too large, or there is none.
            Unavailable: The object store that it lies in does not answer.
        """
        if self.error:
            raise ImageError(self.error)
        if self.data is not None:
            return self.data
        if is_url(self.path):
            return self._read_url()
        try:
            return read_file(self.path, MAX_FILE_BYTES)
        except (OSError, ValueError) as exc:  # ValueError: a null byte in the name
            reason = exc.strerror if isinstance(exc, OSError) else str(exc)
            raise ImageError(f"cannot be read: {reason}") from exc

    def _read_url(self) -> bytes:
        try:
            check_scheme(self.path)
        except UsageError as exc:  # of one URL in a list, which says nothing of the others
            raise ImageError(f"cannot be read: {exc}") from exc
        return files_of(self.path).read(self.path, MAX_FILE_BYTES)

    @property
    def stream(self) -> str:
        """The video or recording, or the folder whose images are frames of one camera in order."""
        return os.path.dirname(self.path) if self.video_frame is None and self.recorded is None else self.path

    @property
    def place(self) -> str:
        """Where an image file lies, whatever the working folder is; of a video's or recording's image its name."""
        return self.path if self.video_frame is None and self.recorded is None else self.name

    @property
    def numbered_name(self) -> str:
        """A path whose last number is that of the image; the query of a URL has numbers of its own."""
        return place_and_query(self.path)[0] if is_url(self.path) else self.relative_name

    @property
    def relative_name(self) -> str:
        """A relative path that is unique to the image, for files such as drawings."""
        if self.recorded is not None:
            return os.path.join(self.path, self.recorded.topic.strip("/"), f"{self.recorded.stamp_ns:019d}.jpg")
        if is_url(self.path):
            return path_of(self.path)
        return self.path if self.video_frame is None else os.path.join(self.path, f"{self.video_frame:06d}.jpg")
