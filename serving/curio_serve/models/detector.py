"""Image in, poses out: one loaded model over the regions of a frame. No gRPC here."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from curio_proto.v1.detector_pb2 import (
    REGION_STATUS_DETECTED,
    REGION_STATUS_NO_OBJECT,
    REGION_STATUS_OUTSIDE_FRAME,
    DetectResponse,
    RegionResult,
)

from curio_serve.errors import ArgumentError, CameraMissing, ImageError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.rotation import quaternion_xyzw
from curio_serve.imaging.view import FlatFrame, PinholeFrame, Region, View
from curio_serve.models.model import Model, Slot

if TYPE_CHECKING:
    from google.protobuf.internal.containers import RepeatedCompositeFieldContainer

    Results = RepeatedCompositeFieldContainer[RegionResult]

Array = np.ndarray
Values = Mapping[str, Any]  # outputs of one image by name, as plain numbers
_REDUCTIONS = (8, 4, 2)
_MAX_BATCH = 8
_UPRIGHT = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


class Detector:
    """Finds a model's objects in frames; safe to share between threads."""

    def __init__(self, model: Model) -> None:
        self.model = model

    def detect(
        self,
        pixels: Array,
        camera: PinholeCamera | None,
        *,
        regions: Sequence[Region] = (),
        min_confidence: float = 0.0,
        max_detections: int | None = None,
        reduction: int = 1,
        results: "Results | None" = None,
    ) -> "Results":
        """Poses in one frame.

        Args:
            pixels: uint8 RGB [height / reduction, width / reduction, 3].
            camera: Intrinsics of the full-size frame; None for 2D worlds and for models that allow a default.
            regions: Where to look, in pixels of the full-size frame; none: the whole frame.
            min_confidence: Detections below are left out; 0 … 1.
            max_detections: Most detections a region; None: all.
            reduction: How much smaller than the frame the pixels were decoded.
            results: Those of an answer, to which these are added; None: of an answer that has none yet.

        Returns:
            One result a region, in order; detections most confident first.

        Raises:
            CameraMissing: The model needs K.
            CameraError: K cannot be this frame's.
            ImageError: Not uint8 RGB.
            ArgumentError: A region or threshold that makes no sense.
            InternalError: The network failed.
        """
        _check_arguments(pixels, regions, min_confidence)
        frame = self._frame(pixels, camera, reduction)
        views = [
            frame.look(region) if region.overlaps(frame.width, frame.height) else None
            for region in regions or [Region(0, 0, frame.width, frame.height)]
        ]
        answers = iter(self._answers([view.image for view in views if view is not None]))
        results = DetectResponse().results if results is None else results
        for index, view in enumerate(views):
            result = results.add(model=self.model.name, model_version=self.model.version, region=index)
            if view is None:
                result.status = REGION_STATUS_OUTSIDE_FRAME
            else:
                _fill(result, view, self.model.slots, next(answers), min_confidence, max_detections)
        return results

    def _answers(self, images: list[Array]) -> list[Values]:
        """What the network says of each image, computed a few at a time: memory stays flat however many there are."""
        answers: list[Values] = []
        for start in range(0, len(images), _MAX_BATCH):
            batch = images[start : start + _MAX_BATCH]
            outputs = self.model.run(batch[0][None] if len(batch) == 1 else np.stack(batch))
            rows = zip(*[value.tolist() for value in outputs.values()], strict=True)
            answers += [dict(zip(outputs, row, strict=True)) for row in rows]
        return answers

    def reduction(self, camera: PinholeCamera | None, width: int, height: int) -> int:
        """How much smaller a frame may be decoded (1, 2, 4, 8) without going below the model's own resolution.

        Args:
            camera: Of the frame, where known.
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
        camera = camera or canonical.for_frame(pixels.shape[1] * reduction, pixels.shape[0] * reduction)
        if camera is None:
            raise CameraMissing(
                f"model {self.model.label} needs the camera matrix K of the frame and none was given; "
                "set `camera` in the request, or --camera FILE on the command line"
            )
        return PinholeFrame(pixels, camera, canonical, reduction)


def _check_arguments(pixels: Array, regions: Sequence[Region], min_confidence: float) -> None:
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3 or not pixels.size:
        raise ImageError(f"pixels are {pixels.dtype} {pixels.shape}; expected uint8 RGB [height, width, 3]")
    if not 0 <= min_confidence <= 1:
        raise ArgumentError(f"min_confidence is {min_confidence}; expected 0 to 1")
    for index, region in enumerate(regions):
        values = (region.x, region.y, region.width, region.height)
        if not np.isfinite(values).all() or np.abs(values).max() > 1e6 or min(region.width, region.height) < 1:
            raise ArgumentError(
                f"regions[{index}] has (x, y, width, height) = {values}; "
                "expected pixels within ±1e6, width and height at least 1"
            )


def _fill(
    result: RegionResult,
    view: View,
    slots: Sequence[Slot],
    values: Values,
    min_confidence: float,
    max_detections: int | None,
) -> None:
    """Turn one image's outputs back into the frame's camera; write down the most confident, best first."""
    if "light" in values:
        result.light.extend(view.turn([[value] for value in values["light"]]))
    confidences = [min(max(c, 0.0), 1.0) for c in values.get("confidence", [1.0] * len(slots))]
    confident = [row for row, confidence in enumerate(confidences) if confidence >= min_confidence]
    if not confident:
        result.status = REGION_STATUS_NO_OBJECT
        return
    result.status = REGION_STATUS_DETECTED
    confident.sort(key=confidences.__getitem__, reverse=True)
    for row in confident[:max_detections]:
        translation = view.translation(values["translation_m"][row])
        rotation = view.turn(values["rotation"][row]) if "rotation" in values else ()
        result.detections.add(
            object=slots[row].object,
            confidence=confidences[row],
            translation_m=translation,
            rotation_6d=[*rotation[0::3], *rotation[1::3]],
            rotation=rotation,
            quaternion_xyzw=quaternion_xyzw(rotation) if rotation else (),
            color=values["color"][row] if "color" in values else (),
            box_px=view.project(_placed(slots[row].box_corners, rotation or _UPRIGHT, translation)),
        )


def _placed(
    points: Sequence[Sequence[float]], rotation: Sequence[float], translation: Sequence[float]
) -> Sequence[Sequence[float]]:
    """An object's points in the frame's camera."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = rotation
    x, y, z = translation
    return [
        (xx * a + xy * b + xz * c + x, yx * a + yy * b + yz * c + y, zx * a + zy * b + zz * c + z) for a, b, c in points
    ]
