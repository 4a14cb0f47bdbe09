"""One image in, one result out, whether the model is a file on this machine or answers behind a server.

What is wrong with one image (its bytes, its K) becomes that result's ``error``; what is wrong with everything (the
server is gone, the disk is full) is raised.
"""

import os
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from curio_proto.v1.detector_pb2 import Detection, DetectResponse, RegionResult, Tracking
from curio_proto.v1.model_spec_pb2 import ModelSpec

from curio_serve.batch.images.source_image import SourceImage
from curio_serve.batch.results.formats import ImageResult
from curio_serve.errors import ArgumentError, CameraError, ImageError, InternalError, OutputError
from curio_serve.imaging import image as images
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.camera_files import CameraFile
from curio_serve.imaging.image_header import Header
from curio_serve.imaging.overlay import draw
from curio_serve.imaging.silhouette import Surface
from curio_serve.imaging.view import searched_fraction
from curio_serve.models.detector import Detector
from curio_serve.models.model import Model, canonical_camera
from curio_serve.planes.camera_poses import GivenPlane, plane_of
from curio_serve.tracking.stream import FollowingStream

if TYPE_CHECKING:
    from curio_serve.client import PoseClient

_OF_ONE_IMAGE = (ImageError, CameraError, ArgumentError, InternalError)
_DRAWN_SUFFIXES = (".jpg", ".jpeg", ".png")
_FAST_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]
_FIRST_S = 5.0  # for the first question to a server: a wrong address is reported soon


@dataclass(frozen=True)
class Settings:
    """The settings that all images of a run share."""

    cameras: CameraFile | None = None
    """Intrinsics of the images; None for 2D worlds and models that allow a default."""
    min_confidence: float = 0.0
    """Detections below this confidence are left out."""
    max_detections: int | None = None
    """Largest number of detections, the most confident ones; None: all."""
    apply_exif_rotation: bool = False
    """Rotate the pixels as EXIF says, and K with them."""
    overlays: Path | None = None
    """Folder that drawings go to; None: nothing is drawn."""
    sources_root: Path = Path("/")
    """Folder that holds all images; drawings repeat the paths below it."""
    track_objects: int | None = None
    """Follow that many objects of each kind from image to image; None: every image on its own."""
    max_instances: int | None = None
    """Largest number of instances of each kind of object; None: as many as one run of the network gives."""
    num_reads: int = 1
    """How often each image is read."""
    objects: tuple[str, ...] = ()
    """Kinds of objects that are looked for; none: all that a model knows."""
    plane: GivenPlane = None
    """On which objects stand, in the frame of each image's camera."""


@dataclass(frozen=True)
class Seen:
    """The answer of a model to one image."""

    width: int
    height: int
    camera: PinholeCamera | None
    """Intrinsics that were used, of the frame after its EXIF rotation."""
    results: Sequence[RegionResult]
    decode_ms: float | None
    inference_ms: float
    frame: images.Frame | None = None
    """The decoded frame, if it was decoded here in full size."""


class Estimator(ABC):
    """Answers images one at a time; safe to share between threads."""

    name: str
    """Name of the model."""
    version: int
    """Version of the model."""
    spec: ModelSpec
    """The model's specification."""

    def __init__(self, name: str, version: int, spec: ModelSpec, settings: Settings) -> None:
        self.name, self.version, self.spec = name, version, spec
        self.settings = settings
        self.surfaces: Mapping[str, Surface] = {}
        """Surfaces of objects by name, where they are known: drawings show their contours."""
        self.canonical = canonical_camera(spec, name)

    def look(self, image: SourceImage, data: bytes) -> Seen:
        """Detect in an image.

        Args:
            image: The image.
            data: Content of its file; empty for a video's frame.

        Raises:
            RequestError: The image or its camera is not acceptable.
            InternalError: The model fails on it.
            ServiceError: The server is out of reach or overloaded.
        """
        return self._look(image, data, self._camera(image))

    def result(self, image: SourceImage, data: bytes, seen: Seen) -> ImageResult:
        """The result of an image for the result file."""
        has_rotation = image.pixels is None and images.open_header(data).orientation > 1
        camera = seen.camera
        return ImageResult(
            image.name,
            self.name,
            self.version,
            seen.width,
            seen.height,
            () if camera is None else camera.matrix.ravel().tolist(),
            seen.results,
            seen.decode_ms,
            seen.inference_ms,
            is_turned=has_rotation and not self.settings.apply_exif_rotation,
            recorded=image.recorded,
            distortion=() if camera is None else camera.distortion,
            exif_rotation=has_rotation and self.settings.apply_exif_rotation,
            searched=1.0 if camera is None else searched_fraction(camera, self.canonical, seen.width, seen.height),
        )

    def failed(self, image: SourceImage, exc: Exception) -> ImageResult:
        """An image without an answer."""
        return ImageResult(image.name, self.name, self.version, error=str(exc), recorded=image.recorded)

    def overlay(self, pixels: np.ndarray) -> tuple[np.ndarray, list[Detection]]:
        """A video's frame with its detections drawn in, and the detections, most confident first.

        Args:
            pixels: uint8 RGB [height, width, 3].

        Raises:
            RequestError: The frame or its camera is not acceptable.
            ServiceError: The server is out of reach or overloaded.
        """
        image = SourceImage("frame", "frame", 0, pixels, time_s=time.monotonic())
        seen = self._look(image, b"", self._camera(image))
        found = [detection for result in seen.results for detection in result.detections]
        return draw(pixels, seen.results, self.spec, seen.camera, self.surfaces), found

    @abstractmethod
    def _look(self, image: SourceImage, data: bytes, camera: PinholeCamera | None) -> Seen:
        """Detects in a video's frame or in the bytes of an image file; the camera is that of the stored pixels."""

    def _camera(self, image: SourceImage) -> PinholeCamera | None:
        if self.canonical.matrix is None:
            return None
        if self.settings.cameras is None:
            if image.no_camera and not self.canonical.is_default:
                raise CameraError(image.no_camera)
            return image.camera
        return self.settings.cameras.camera_for(image.numbered_name)

    def _frame(
        self, image: SourceImage, data: bytes, header: Header | None = None, max_reduction: int = 1
    ) -> images.Frame:
        if image.pixels is None:
            rotate = self.settings.apply_exif_rotation
            return images.decode(data, header=header, max_reduction=max_reduction, apply_exif_rotation=rotate)
        height, width = image.pixels.shape[:2]
        images.check_size(width, height)
        return images.Frame(image.pixels, width, height)

    def drawn(self, image: SourceImage, data: bytes, seen: Seen, pixels: np.ndarray | None) -> np.ndarray:
        """The frame with the detections drawn in.

        Args:
            image: The image.
            data: Content of its file.
            seen: What was found.
            pixels: Frame with other models' detections, uint8 RGB [height, width, 3]; None: none yet.
        """
        if pixels is None:
            pixels = (seen.frame or self._frame(image, data)).pixels
        return draw(pixels, seen.results, self.spec, seen.camera, self.surfaces)


def answers(estimators: Sequence[Estimator], image: SourceImage) -> list[ImageResult]:
    """Each model's detections in an image, or what is wrong with it; drawn into one picture where that is asked for.

    Args:
        estimators: With the same settings.
        image: The image.

    Raises:
        OutputError: The drawing cannot be written.
        ServiceError: The server is out of reach or overloaded.
        RequestError: The server refuses what would be the same for every image.
    """
    settings, results, pixels = estimators[0].settings, list[ImageResult](), None
    try:
        data = b"" if image.pixels is not None else image.read()
    except ImageError as exc:
        return [estimator.failed(image, exc) for estimator in estimators]
    for estimator in estimators:
        try:
            seen = estimator.look(image, data)
            if settings.overlays is not None:
                pixels = estimator.drawn(image, data, seen, pixels)
            results.append(estimator.result(image, data, seen))
        except _OF_ONE_IMAGE as exc:
            results.append(estimator.failed(image, exc))
    if pixels is not None and settings.overlays is not None:
        _write_drawing(_drawing_path(settings.overlays, image, settings.sources_root), pixels)
    return results


def _write_drawing(path: Path, pixels: np.ndarray) -> None:
    parameters = _FAST_PNG if path.suffix.lower() == ".png" else []
    is_encoded, encoded = cv2.imencode(path.suffix, cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), parameters)
    if not is_encoded:
        height, width = pixels.shape[:2]
        raise OutputError(f"{path}: a drawing of {width}x{height} pixels cannot be encoded")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encoded.tobytes())
    except OSError as exc:
        raise OutputError(f"--overlays: {path} cannot be written: {exc.strerror}") from exc


class LocalEstimator(Estimator):
    """Runs a model in this process."""

    def __init__(self, model: Model, settings: Settings) -> None:
        model = model.of(settings.objects)
        super().__init__(model.name, model.version, model.spec, settings)
        self._detector = Detector(model, settings.num_reads)
        self._following, self._stream = FollowingStream(), ""

    def _look(self, image: SourceImage, data: bytes, camera: PinholeCamera | None) -> Seen:
        started = time.perf_counter()
        header, reduction = None, 1
        if image.pixels is None:
            header = images.open_header(data)
            reduction = self._detector.reduction(camera, header.width, header.height)
        frame = self._frame(image, data, header, reduction)
        stored = (header.width, header.height) if header is not None else (frame.width, frame.height)
        camera = _turned(camera, frame.quarter_turns, *stored) or self.canonical.for_frame(frame.width, frame.height)
        decoded = time.perf_counter()
        results: Sequence[RegionResult]
        if self.settings.track_objects is None:
            results = self._detector.detect(
                frame.pixels,
                camera,
                min_confidence=self.settings.min_confidence,
                max_detections=self.settings.max_detections,
                max_instances=self.settings.max_instances,
                plane=plane_of(self.settings.plane, image.place),
                reduction=frame.reduction,
            )
        else:
            results = self._follow(image, frame, camera, self.settings.track_objects)
        decode_ms = None if image.pixels is not None else 1000 * (decoded - started)
        inference_ms = 1000 * (time.perf_counter() - decoded)
        full_size = frame if frame.reduction == 1 else None
        return Seen(frame.width, frame.height, camera, results, decode_ms, inference_ms, full_size)

    def _follow(
        self, image: SourceImage, frame: images.Frame, camera: PinholeCamera | None, num_objects: int
    ) -> Sequence[RegionResult]:
        """Follow objects from the frame before; images have to come one after the other, in the order they were taken.

        Raises:
            RequestError: The frame is of another size or camera than those before it.
            InternalError: The network fails on it.
        """
        if image.stream != self._stream:
            self._following, self._stream = FollowingStream(), image.stream
        results = DetectResponse().results
        self._following.follow(
            Tracking(time_s=image.time_s, num_objects=num_objects),
            [self._detector],
            frame.pixels,
            camera,
            min_confidence=self.settings.min_confidence,
            plane=plane_of(self.settings.plane, image.place),
            reduction=frame.reduction,
            results=results,
        )
        return results


class RemoteEstimator(Estimator):
    """Asks a server. It asks for the version once, so all results of a file are of one model.

    Args:
        client: Connected to the server.
        model: ``name`` (the latest version now) or ``name/version``.
        settings: For all images.
    """

    def __init__(self, client: "PoseClient", model: str, settings: Settings) -> None:
        found = client.get_model(model, timeout_s=_FIRST_S)
        super().__init__(model.partition("/")[0], found.version, found.spec, settings)
        self._client = client
        # Of several models each is asked for those of the wanted objects that it knows.
        self._wanted = [kind.name for kind in found.spec.objects if kind.name in settings.objects]

    def _look(self, image: SourceImage, data: bytes, camera: PinholeCamera | None) -> Seen:
        is_turned = self.settings.apply_exif_rotation and image.pixels is None
        answer = self._client.detect(
            f"{self.name}/{self.version}",
            data if image.pixels is None else image.pixels,
            camera,
            min_confidence=self.settings.min_confidence,
            max_detections=self.settings.max_detections,
            max_instances=self.settings.max_instances,
            reads=self.settings.num_reads if self.settings.num_reads > 1 else None,
            plane=plane_of(self.settings.plane, image.place),
            objects=self._wanted,
            apply_exif_rotation=is_turned,
        )
        if is_turned:  # by the server, and so is the K that is written down
            header = images.open_header(data)
            camera = _turned(camera, images.quarter_turns_of(header), header.width, header.height)
        camera = camera or self.canonical.for_frame(answer.width, answer.height)
        spent = answer.milliseconds
        return Seen(answer.width, answer.height, camera, answer.results, spent.decode, spent.inference)


def _turned(camera: PinholeCamera | None, quarter_turns: int, width: int, height: int) -> PinholeCamera | None:
    """The camera of a frame that was turned, given the camera and the size of its stored pixels."""
    if camera is None or not quarter_turns:
        return camera
    camera.check_frame(width, height)
    return camera.turned(quarter_turns, width, height)


def _drawing_path(folder: Path, image: SourceImage, root: Path) -> Path:
    """The path of a drawing, which repeats the image's path so that no two drawings collide."""
    path = Path(os.path.abspath(image.relative_name))
    target = folder / path.relative_to(root if path.is_relative_to(root) else path.anchor)
    return target if target.suffix.lower() in _DRAWN_SUFFIXES else target.with_name(target.name + ".jpg")
