"""Detects a model's objects in the regions of a frame. No gRPC here."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from curio_proto.v1.detector_pb2 import (
    REGION_STATUS_OUTSIDE_FRAME,
    DetectResponse,
    RegionResult,
)
from curio_proto.v1.model_spec_pb2 import ModelSpec

from curio_serve.errors import ArgumentError, CameraError, CameraMissing, ImageError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.view import FlatFrame, PinholeFrame, Region
from curio_serve.models.answers import UPRIGHT, Limits, check_can_stand, fill, move_onto_plane
from curio_serve.models.instances import InstanceSearch, Rows, Values, check_instances
from curio_serve.models.model import Model, Outputs
from curio_serve.models.object_frames import transformed
from curio_serve.models.reliability import add_interval, calibrated, region_status, status_of, uncalibrated
from curio_serve.models.repeated import AGREEMENT_POWER, RepeatedReader
from curio_serve.models.stages.crop_stage import CropPose
from curio_serve.planes.plane import AnyPlane

if TYPE_CHECKING:
    from google.protobuf.internal.containers import RepeatedCompositeFieldContainer

    Results = RepeatedCompositeFieldContainer[RegionResult]

Array = np.ndarray
_REDUCTIONS = (8, 4, 2)
_MAX_BATCH = 8
_DEPTH_TOLERANCE = 0.01  # of the range: an object at its end is as likely beyond it


class Detector:
    """Finds a model's objects in frames; safe to share between threads."""

    depths_m: tuple[float, float]
    """Smallest and largest depth that the model was trained for, see :func:`trained_depths_m`."""

    def __init__(self, model: Model, num_reads: int = 1) -> None:
        """Take a model.

        Args:
            model: Any.
            num_reads: How often each image is read, see :mod:`curio_serve.models.repeated`.

        Raises:
            ArgumentError: The model cannot read an image more than once, or not that often.
        """
        self.model, self._num_reads = model, num_reads
        self._repeated = None if num_reads == 1 else RepeatedReader(model.spec, model.run, num_reads)
        self.depths_m = trained_depths_m(model.spec)
        self._calibration = tuple(model.spec.reliability.calibration)

    def detect(
        self,
        pixels: Array,
        camera: PinholeCamera | None,
        *,
        regions: Sequence[Region] = (),
        min_confidence: float = 0.0,
        max_detections: int | None = None,
        max_instances: int | None = None,
        plane: AnyPlane | None = None,
        reduction: int = 1,
        results: "Results | None" = None,
        before_run: Callable[[], None] = lambda: None,
    ) -> "Results":
        """Poses in one frame.

        Args:
            pixels: uint8 RGB [height / reduction, width / reduction, 3].
            camera: Intrinsics of the full-size frame; None for 2D worlds and for models that allow a default.
            regions: Rectangles to search, in pixels of the full-size frame; none: the whole frame.
            min_confidence: Detections below it are left out; 0 … 1.
            max_detections: Most detections a region; None: all.
            max_instances: Most instances of each kind of object a region, by a further run of the network for each of
                them where it reads one pose; None: what one run gives.
            plane: On which objects stand, camera frame, or the one on which most of the detected objects do: poses are
                moved along their lines of sight until they stand there.
            reduction: How much smaller than the frame the pixels were decoded.
            results: The field of a response to which results are added; None: a new one.
            before_run: Called before each run of the network; what it raises ends the detection.

        Returns:
            One result a region, in order; detections most confident first.

        Raises:
            CameraMissing: The model needs K.
            CameraError: K cannot be this frame's, or gives a pose that is not finite.
            ImageError: The pixels are not uint8 RGB.
            ArgumentError: A region, threshold or number is out of range, ``max_instances`` of a flat world, or a plane
                for a model that does not say how its objects stand.
            InternalError: The network failed.
        """
        _check_arguments(pixels, regions, min_confidence)
        if camera is not None and not isinstance(camera, PinholeCamera):
            raise CameraError(f"the camera is a {type(camera).__name__}; expected a PinholeCamera, such as of K")
        if max_detections is not None and max_detections < 1:
            raise ArgumentError(f"max_detections is {max_detections}; expected at least 1, or None for all")
        check_instances(self.model, max_instances)
        if plane is not None:
            check_can_stand(self.model)
        limits = Limits(min_confidence, max_detections, max_instances)
        frame = self._frame(pixels, camera, reduction)
        crops = [
            frame.crop(region) if region.overlaps(frame.width, frame.height) else None
            for region in regions or [Region(0, 0, frame.width, frame.height)]
        ]
        predictions = iter(
            self._predictions([crop.image for crop in crops if crop is not None], max_instances, before_run)
        )
        results = DetectResponse().results if results is None else results
        own = [
            results.add(model=self.model.name, model_version=self.model.version, region=index)
            for index in range(len(crops))
        ]
        for result, crop in zip(own, crops, strict=True):
            if crop is None:
                result.status = REGION_STATUS_OUTSIDE_FRAME
            else:
                fill(result, crop, next(predictions), limits, self.depths_m)
        if plane is not None:
            move_onto_plane(own, crops, self.model, plane)
        for result, crop in zip(own, crops, strict=True):
            if crop is not None:
                self._judge(result)
        return results

    def _predictions(
        self, images: list[Array], max_instances: int | None, before_run: Callable[[], None]
    ) -> list[Rows]:
        """The network's outputs for each image; of a network that reads one pose of each kind, a row an instance."""
        slots, found = self.model.slots, [Rows(v, self.model.slots) for v in self._outputs(images, before_run)]
        if max_instances in (None, 1) or len(slots) > len(self.model.spec.objects):
            return found
        kinds = [self if len(slots) == 1 else Detector(self.model.of([slot.object]), self._num_reads) for slot in slots]
        of_kinds = [
            kind._instances(images, [one.row(number) for one in found], max_instances or 1, before_run)
            for number, kind in enumerate(kinds)
        ]
        return [Rows.joined(of_image) for of_image in zip(*of_kinds, strict=True)]

    def _instances(
        self, images: list[Array], first: list[Rows], most: int, before_run: Callable[[], None]
    ) -> list[Rows]:
        """Further instances of the model's one kind in each image, after the first."""
        searches = [InstanceSearch(self.model, image) for image in images]
        going_on = [search for search, rows in zip(searches, first, strict=True) if search.take(rows.values)]
        for _ in range(most - 1):
            outputs = self._outputs([search.image for search in going_on], before_run)
            going_on = [search for search, values in zip(going_on, outputs, strict=True) if search.take(values)]
        return [search.found for search in searches]

    def _outputs(self, images: list[Array], before_run: Callable[[], None]) -> list[Values]:
        """The network's outputs for each image, computed a few at a time: memory stays flat however many there are."""
        outputs: list[Values] = []
        for start in range(0, len(images), _MAX_BATCH):
            batch = images[start : start + _MAX_BATCH]
            found = self._read(batch[0][None] if len(batch) == 1 else np.stack(batch), before_run)
            rows = zip(*[value.tolist() for value in found.values()], strict=True)
            outputs += [dict(zip(found, row, strict=True)) for row in rows]
        return [self._calibrated(values) for values in outputs]

    def _read(self, images: Array, before_run: Callable[[], None]) -> Outputs:
        if self._repeated is not None:
            return self._repeated(images, before_run)
        before_run()
        return self.model.run(images)

    def _judge(self, result: RegionResult) -> None:
        """Write into a result which of its detections are sure, and within which intervals."""
        reliability, center_of = self.model.spec.reliability, {slot.object: slot.center for slot in self.model.slots}
        for detection in result.detections:
            confidence = self._of_one_read(detection.confidence)
            detection.status = status_of(reliability, detection.object, confidence)
            center = [center_of[detection.object]]
            (middle,) = transformed(center, detection.rotation or UPRIGHT, detection.translation_m)
            add_interval(detection, reliability, confidence, math.hypot(*middle))
        result.status = region_status(result.detections)

    def _of_one_read(self, confidence: float) -> float:
        """What thresholds and bounds go by, which were measured on single reads; that of reads that agree is higher."""
        if self._repeated is None:
            return confidence
        share = uncalibrated(self._calibration, confidence) ** (1 / AGREEMENT_POWER)
        return calibrated(self._calibration, share)

    def _calibrated(self, values: Values) -> Values:
        if "confidence" not in values:
            return values
        return {**values, "confidence": [calibrated(self._calibration, value) for value in values["confidence"]]}

    def read_crops(self, pixels: Array, camera: PinholeCamera, position_m: Array) -> CropPose:
        """The pose of the one object of a model with a crop-pose stage, in crops around a position.

        It is aligned with the object's outline where the model's poses are.

        Args:
            pixels: uint8 RGB [height, width, 3].
            camera: That took them.
            position_m: Where the object's middle is expected [3], frame's camera, in front of it.

        Raises:
            InternalError: The network failed.
        """
        assert self.model.crop_stage is not None
        focal_px = self.model.camera.focal_lengths[0]
        pose = self.model.crop_stage.read(pixels, camera, position_m, focal_px)
        if self.model.outline_stage is not None:
            pose = self.model.outline_stage.aligned(pixels, camera, pose, focal_px)
        return replace(pose, confidence=calibrated(self._calibration, pose.confidence))

    def reduction(self, camera: PinholeCamera | None, width: int, height: int) -> int:
        """How much smaller a frame may be decoded (1, 2, 4, 8) without going below the model's own resolution.

        Args:
            camera: Of the frame, if known.
            width: Of the frame.
            height: Of the frame.
        """
        canonical = self.model.camera
        if canonical.matrix is None:
            ratios = (width / canonical.width, height / canonical.height)
        else:
            camera = camera or canonical.for_frame(width, height)
            if camera is None:
                return 1
            (fx, fy), (target_fx, target_fy) = camera.focal_lengths, canonical.focal_lengths
            ratios = fx / target_fx, fy / target_fy
        return next((r for r in _REDUCTIONS if r <= min(ratios)), 1)

    def _frame(self, pixels: Array, camera: PinholeCamera | None, reduction: int) -> "PinholeFrame | FlatFrame":
        canonical = self.model.camera
        if canonical.matrix is None:
            return FlatFrame(pixels, canonical, reduction)
        camera = self.camera_of(camera, pixels.shape[1] * reduction, pixels.shape[0] * reduction)
        return PinholeFrame(pixels, camera, canonical, reduction)

    def camera_of(self, camera: PinholeCamera | None, width: int, height: int) -> PinholeCamera:
        """The camera of a frame for a model of poses in space: the given one, or the model's default.

        Raises:
            CameraMissing: There is neither.
        """
        camera = camera or self.model.camera.for_frame(width, height)
        if camera is None:
            raise CameraMissing(
                f"model {self.model.label} needs the camera matrix K of the frame and none was given; "
                "set `camera` in the request, or --camera FILE on the command line"
            )
        return camera


def trained_depths_m(spec: ModelSpec) -> tuple[float, float]:
    """Smallest and largest depth along the canonical camera's axis that a model was trained for, metres.

    A head may predict beyond them, and does so where K is of another camera or of another size.
    """
    field = next((field for field in spec.fields if field.name == "translation_m"), None)
    if field is None or field.frame != "camera" or len(field.lower) != 3 or len(field.upper) != 3:
        return -math.inf, math.inf
    tolerance = _DEPTH_TOLERANCE * (field.upper[2] - field.lower[2])
    return field.lower[2] - tolerance, field.upper[2] + tolerance


def check_min_confidence(value: float) -> None:
    """Refuse what is no probability.

    Raises:
        ArgumentError: It is none.
    """
    if not 0 <= value <= 1:
        raise ArgumentError(f"min_confidence is {value}; expected 0 to 1")


def _check_arguments(pixels: Array, regions: Sequence[Region], min_confidence: float) -> None:
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3 or not pixels.size:
        raise ImageError(f"pixels are {pixels.dtype} {pixels.shape}; expected uint8 RGB [height, width, 3]")
    check_min_confidence(min_confidence)
    for index, region in enumerate(regions):
        values = (region.x, region.y, region.width, region.height)
        if not np.isfinite(values).all() or np.abs(values).max() > 1e6 or min(region.width, region.height) < 1:
            raise ArgumentError(
                f"regions[{index}] has (x, y, width, height) = {values}; "
                "expected pixels within ±1e6, width and height at least 1"
            )
