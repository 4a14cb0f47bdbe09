"""A detection as an object of JSON Lines."""

import math
from collections.abc import Sequence

from curio_proto.v1.detector_pb2 import (
    DETECTION_STATUS_SURE,
    DETECTION_STATUS_UNSURE,
    Detection,
    PoseInterval,
    Track,
)

STATUS = {DETECTION_STATUS_SURE: "sure", DETECTION_STATUS_UNSURE: "unsure"}
"""Names of a detection's status; a model whose reliability was not measured gives none."""


def detection_json(detection: Detection) -> dict[str, object]:
    """Its keys are always the same, but for those of tracks, several cameras, planes, presence and measured models."""
    added: dict[str, object] = {"track": _track_json(detection.track)} if detection.HasField("track") else {}
    added |= {"views": list(detection.views)} if detection.views else {}
    added |= {"status": STATUS[detection.status]} if detection.status in STATUS else {}
    added |= {"presence": round(detection.presence, 6)} if detection.HasField("presence") else {}
    added |= {"on_plane": True} if detection.on_plane else {}
    added |= {"interval": _interval_json(detection.interval)} if detection.HasField("interval") else {}
    return {
        "object": detection.object,
        "confidence": round(detection.confidence, 6),
        "translation_m": list(detection.translation_m),
        "rotation": rows(detection.rotation, 3) or None,
        "rotation_6d": list(detection.rotation_6d) or None,
        "quaternion_xyzw": list(detection.quaternion_xyzw) or None,
        "color": list(detection.color) or None,
        "box_px": [[finite(value) for value in corner] for corner in rows(detection.box_px, 2)] or None,
        "outside_trained_range": detection.outside_trained_range,
        **added,
    }


def _interval_json(interval: PoseInterval) -> dict[str, float]:
    return {
        "level": interval.level,
        "lateral_m": round(interval.lateral_m, 6),
        "depth_m": round(interval.depth_m, 6),
        "rotation_deg": round(interval.rotation_deg, 3),
    }


def _track_json(track: Track) -> dict[str, object]:
    return {
        "track_id": track.track_id,
        "age_s": round(track.age_s, 6),
        "unseen_s": round(track.unseen_s, 6),
        "predicted": track.predicted,
        "translation_m": list(track.translation_m),
        "rotation": rows(track.rotation, 3),
        "quaternion_xyzw": list(track.quaternion_xyzw),
        "velocity_m_s": list(track.velocity_m_s),
        "position_std_m": list(track.position_std_m),
        "rotation_std_rad": track.rotation_std_rad,
    }


def rows(values: Sequence[float], width: int) -> list[list[float]]:
    """The values, cut into rows of a given length."""
    return [list(values[start : start + width]) for start in range(0, len(values), width)]


def finite(value: float) -> float | None:
    """Replace NaN by None: JSON has no NaN, so a corner behind the camera is null."""
    return value if math.isfinite(value) else None
