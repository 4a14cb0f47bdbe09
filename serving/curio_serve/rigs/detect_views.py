"""One pose of each object that explains the views of several cameras.

Each view is looked at as a whole. Where its model has a crop-pose stage, every view is then read once more around what
the views agree on, or around what the surest of them says where none agree: so one camera tells the others where to
look. The poses that agree then are averaged, each weighted by how uncertain the network is in which direction.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from curio_proto.v1.detector_pb2 import DETECTION_STATUS_SURE, DETECTION_STATUS_UNSURE, DetectionStatus
from curio_proto.v1.model_spec_pb2 import ObjectModel

from curio_serve.consensus.poses import Consensus, Predictions, consensus, position_covariance_m2
from curio_serve.errors import ArgumentError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.rotation import quaternion_xyzw
from curio_serve.models.detector import Detector
from curio_serve.models.model import Model
from curio_serve.models.object_frames import (
    as_compared,
    center_of,
    middle_from_origin,
    origin_from_middle,
    symmetry_rotations,
    transformed,
)
from curio_serve.models.reliability import region_status, status_of
from curio_serve.rigs.rig import check_baselines

if TYPE_CHECKING:
    from curio_serve.models.detector import Results

Array = np.ndarray
_ACROSS, _IN_DEPTH = 0.04, 0.04  # errors of a whole frame's poses: diameters, and of the distance
_LEAST_SPREAD = 0.02  # diameters: calibration and shutter of the cameras
_READ_AGAIN = 0.08  # least confidence of a pose that is read around another view's
_EXPECTED = 3  # of what the views say, the surest that are looked for in all of them


@dataclass(frozen=True, eq=False)
class RigView:
    """The frame of one camera of a rig, and where the camera stands."""

    pixels: Array
    """uint8 RGB [height / reduction, width / reduction, 3]."""
    camera: PinholeCamera
    """Intrinsics of the full-size frame."""
    cam_from_rig: Array
    """[4, 4], metres."""
    reduction: int = 1
    """How much smaller than the frame the pixels were decoded."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the full-size frame."""
        return self.pixels.shape[1] * self.reduction, self.pixels.shape[0] * self.reduction


@dataclass(frozen=True, eq=False)
class _Seen:
    """One object in one view, in the rig's frame; its position is that of its middle."""

    view: int
    object: str
    rotation: Array
    translation_m: Array
    covariance_m2: Array
    confidence: float


def detect_views(
    detector: Detector,
    views: Sequence[RigView],
    *,
    min_confidence: float = 0.0,
    max_detections: int | None = None,
    results: "Results",
    before_run: Callable[[], None] = lambda: None,
) -> None:
    """Add one result, in the rig's frame, to those of a response.

    Args:
        detector: Of the model.
        views: Of one instant.
        min_confidence: Objects of a lower confidence are left out.
        max_detections: Most objects, the most confident; None: all.
        results: The field of a response.
        before_run: Called before each run of a network.

    Raises:
        ArgumentError: The model is of a 2D world, or without rotations.
        CameraError: Cameras are too far apart for their places to be in metres.
        As :meth:`~curio_serve.models.detector.Detector.detect`.
    """
    model = detector.model
    if model.camera.matrix is None:
        raise ArgumentError(f"model {model.label} is of a 2D world, which several cameras cannot see")
    if not any(field.name in ("rotation", "rotation_6d") for field in model.spec.fields):
        raise ArgumentError(f"model {model.label} answers no rotations, which the poses of several cameras need")
    check_baselines([view.cam_from_rig for view in views], "views")
    kinds = {kind.name: kind for kind in model.spec.objects}
    seen = [one for number, view in enumerate(views) for one in _whole(detector, number, view, kinds, before_run)]
    found: list[tuple[float, Consensus, list[_Seen]]] = []
    for kind in model.spec.objects:
        own = [one for one in seen if one.object == kind.name]
        if model.crop_stage is not None:
            own = _read_again(detector, views, own, kind, before_run)
        found += _explained(own, kind)
    found = sorted((one for one in found if one[0] >= min_confidence), key=lambda one: -one[0])[:max_detections]
    result = results.add(model=model.name, model_version=model.version)
    nearest, farthest = detector.depths_m
    for confidence, pose, own in found:
        slot = next(slot for slot in model.slots if slot.object == own[0].object)
        origin_m = origin_from_middle(pose.translation_m, pose.rotation, np.array(slot.center))
        rows, position = pose.rotation.ravel().tolist(), origin_m.tolist()
        in_first = views[0].cam_from_rig @ _matrix(pose.rotation, origin_m)
        agreeing = sorted({own[row].view for row in pose.members})
        depths_m = [float((views[number].cam_from_rig @ [*pose.translation_m, 1.0])[2]) for number in agreeing]
        corners = transformed(slot.box_corners, in_first[:3, :3].ravel().tolist(), in_first[:3, 3].tolist())
        result.detections.add(
            object=own[0].object,
            confidence=confidence,
            translation_m=position,
            rotation_6d=[*rows[0::3], *rows[1::3]],
            rotation=rows,
            quaternion_xyzw=quaternion_xyzw(rows),
            box_px=views[0].camera.pixels(corners),
            views=agreeing,
            outside_trained_range=not any(nearest <= depth_m <= farthest for depth_m in depths_m),
            status=_status(model, own[0].object, confidence, len(agreeing)),
        )
    result.status = region_status(result.detections)


def _status(model: Model, object_: str, confidence: float, num_agreeing: int) -> DetectionStatus:
    """Whether an answer is sure. That was measured on single images: the surest of several views is not, alone."""
    status = status_of(model.spec.reliability, object_, confidence)
    return DETECTION_STATUS_UNSURE if status == DETECTION_STATUS_SURE and num_agreeing < 2 else status


def _whole(
    detector: Detector,
    number: int,
    view: RigView,
    kinds: dict[str, ObjectModel],
    before_run: Callable[[], None],
) -> list[_Seen]:
    """Detect objects in a whole view."""
    (result,) = detector.detect(view.pixels, view.camera, reduction=view.reduction, before_run=before_run)
    found = []
    for one in result.detections:
        kind, rotation = kinds[one.object], np.reshape(one.rotation, (3, 3))
        translation_m = middle_from_origin(np.array(one.translation_m), rotation, center_of(kind))
        covariance = position_covariance_m2(translation_m[None], _ACROSS * kind.diameter_m, _IN_DEPTH)[0]
        found.append(_in_rig(number, view, one.object, rotation, translation_m, covariance, one.confidence))
    return found


def _read_again(
    detector: Detector,
    views: Sequence[RigView],
    seen: list[_Seen],
    kind: ObjectModel,
    before_run: Callable[[], None],
) -> list[_Seen]:
    """Read poses from crops in every view around the views' estimate; without any, keep the whole views' poses."""
    stage = detector.model.crop_stage
    assert stage is not None
    expected = [pose.translation_m for _, pose, _ in sorted(_explained(seen, kind), key=lambda one: -one[0])]
    for position_m in expected[:_EXPECTED]:
        found = []
        for number, view in enumerate(views):
            in_cam = view.cam_from_rig[:3, :3] @ position_m + view.cam_from_rig[:3, 3]
            if not stage.sees(view.camera, in_cam, *view.size):
                continue
            before_run()
            pose = detector.read_crops(view.pixels, view.camera.reduced(view.reduction), in_cam)
            if pose.confidence >= _READ_AGAIN:
                floor = np.eye(3) * (_LEAST_SPREAD * kind.diameter_m) ** 2
                covariance = pose.position_covariance_m2 + floor
                found.append(
                    _in_rig(number, view, kind.name, pose.rotation, pose.translation_m, covariance, pose.confidence)
                )
        if found:
            return found
    return seen


def _explained(seen: list[_Seen], kind: ObjectModel) -> list[tuple[float, Consensus, list[_Seen]]]:
    """Confidence and pose on which the views agree; if none agree, those of the most confident view."""
    if not seen:
        return []
    predictions = Predictions(
        np.array([one.view for one in seen]),
        as_compared(np.stack([one.rotation for one in seen]), kind),
        np.stack([one.translation_m for one in seen]),
        np.stack([one.covariance_m2 for one in seen]),
    )
    found = consensus(predictions, symmetry_rotations(kind), min_predictions=2, min_views=2)
    if not found:
        surest = max(range(len(seen)), key=lambda row: seen[row].confidence)
        alone = Consensus(seen[surest].rotation, seen[surest].translation_m, np.array([surest]))
        return [(seen[surest].confidence, alone, seen)]
    # Views err independently: the pose is wrong only if all that agree on it are.
    return [(1 - float(np.prod([1 - seen[row].confidence for row in one.members])), one, seen) for one in found]


def _in_rig(
    number: int,
    view: RigView,
    object_: str,
    rotation: Array,
    translation_m: Array,
    covariance_m2: Array,
    confidence: float,
) -> _Seen:
    rig_from_cam = view.cam_from_rig[:3, :3].T
    return _Seen(
        number,
        object_,
        rig_from_cam @ rotation,
        rig_from_cam @ (translation_m - view.cam_from_rig[:3, 3]),
        rig_from_cam @ covariance_m2 @ rig_from_cam.T,
        confidence,
    )


def _matrix(rotation: Array, translation_m: Array) -> Array:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation_m
    return pose
