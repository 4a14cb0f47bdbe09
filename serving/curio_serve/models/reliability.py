"""Reads a model's reliability, which was measured on renderings and is stored beside the model.

``reliability.json`` holds a ``Reliability`` message: for each object the confidence from which an answer counts as
sure, and bounds of the pose error by confidence (split conformal prediction). Photographs may have adjusted both, and
the confidence itself. Models without the file answer as they did, with neither a status nor intervals.
"""

import math
from bisect import bisect_right
from collections.abc import Iterable, Sequence

from curio_proto.v1.detector_pb2 import (
    DETECTION_STATUS_SURE,
    DETECTION_STATUS_UNSPECIFIED,
    DETECTION_STATUS_UNSURE,
    REGION_STATUS_DETECTED,
    REGION_STATUS_NO_OBJECT,
    REGION_STATUS_UNSURE,
    Detection,
    DetectionStatus,
    RegionStatus,
)
from curio_proto.v1.model_spec_pb2 import ObjectReliability, PoseBounds, Reliability

from curio_serve.beside import parsed_message, refuse_other_objects
from curio_serve.errors import ModelError

RELIABILITY_FILE = "reliability.json"
_WRITER = "curio-export --intervals"
_LEAST, _MOST_LOGIT = 1e-9, 60.0  # nearer to 0 and 1 logits say nothing


def parse_reliability(text: bytes, objects: Sequence[str], where: str) -> Reliability:
    """The measured reliability of a model.

    Args:
        text: Content of the file.
        objects: Names of the model's objects.
        where: The file, for messages.

    Raises:
        ModelError: It is no Reliability, has impossible values, or is about other objects.
    """
    found = parsed_message(text, Reliability(), where, _WRITER)
    refuse_other_objects(found.objects, objects, where, f"write it again with {_WRITER}")
    if not 0 < found.level < 1 or not _is_calibration(found.calibration) or not all(map(_is_possible, found.objects)):
        raise ModelError(f"{where} has impossible values; write it again with {_WRITER}")
    return found


def _is_possible(one: ObjectReliability) -> bool:
    starts = [bounds.min_confidence for bounds in one.bounds]
    errors = [value for b in one.bounds for value in (b.lateral_m, b.depth_fraction, b.rotation_deg)]
    return (
        math.isfinite(one.min_confidence)
        and one.min_confidence >= 0
        and all(map(math.isfinite, (*starts, *errors)))
        and all(value > 0 for value in errors)
        and starts == sorted(starts)
        and (not starts or starts[0] <= one.min_confidence)
    )


def _is_calibration(values: Sequence[float]) -> bool:
    """Whether these are a weight above 0 and an offset, or none."""
    return not values or (len(values) == 2 and all(map(math.isfinite, values)) and values[0] > 0)


def calibrated(calibration: Sequence[float], confidence: float) -> float:
    """The confidence that is answered.

    Args:
        calibration: Weight and offset of the logit, see ``Reliability``; none: it is answered as it is.
        confidence: That the network gives, in [0, 1].
    """
    if not calibration:
        return confidence
    weight, offset = calibration
    inside = min(max(confidence, _LEAST), 1 - _LEAST)
    logit = weight * math.log(inside / (1 - inside)) + offset
    return 1 / (1 + math.exp(-min(max(logit, -_MOST_LOGIT), _MOST_LOGIT)))


def uncalibrated(calibration: Sequence[float], confidence: float) -> float:
    """The confidence that the network gives where one is answered: undoes :func:`calibrated`."""
    if not calibration:
        return confidence
    weight, offset = calibration
    inside = min(max(confidence, _LEAST), 1 - _LEAST)
    return calibrated((1 / weight, -offset / weight), inside)


def bounds_of(one: ObjectReliability, confidence: float) -> PoseBounds | None:
    """The error bounds of an answer with a given confidence; None if it is unsure or nothing was measured."""
    row = bisect_right([bounds.min_confidence for bounds in one.bounds], confidence) - 1
    return one.bounds[row] if row >= 0 and confidence >= one.min_confidence else None


def status_of(reliability: Reliability, object_: str, confidence: float) -> DetectionStatus:
    """Whether an answer is sure; unspecified for a model that was not measured."""
    one = _of(reliability, object_)
    if one is None:
        return DETECTION_STATUS_UNSPECIFIED
    return DETECTION_STATUS_SURE if confidence >= one.min_confidence else DETECTION_STATUS_UNSURE


def add_interval(detection: Detection, reliability: Reliability, confidence: float, distance_m: float) -> None:
    """Write the interval of a pose of one image into its detection, if the model has one for it.

    Args:
        detection: Of the object.
        reliability: Of the model.
        confidence: As one read of the image would give it.
        distance_m: Of the object's middle.
    """
    one = _of(reliability, detection.object)
    bounds = None if one is None else bounds_of(one, confidence)
    if bounds is not None:
        interval = detection.interval
        interval.level, interval.lateral_m = reliability.level, bounds.lateral_m
        interval.depth_m = bounds.depth_fraction * distance_m
        interval.rotation_deg = bounds.rotation_deg


def region_status(detections: Iterable[Detection]) -> RegionStatus:
    """The status of a region, given its detections."""
    found = [detection.status for detection in detections]
    if not found:
        return REGION_STATUS_NO_OBJECT
    return REGION_STATUS_UNSURE if set(found) == {DETECTION_STATUS_UNSURE} else REGION_STATUS_DETECTED


def _of(reliability: Reliability, object_: str) -> ObjectReliability | None:
    return next((one for one in reliability.objects if one.object == object_), None)
