"""Writes what a network read in a crop into an answer, in the frame's camera, and moves it onto a plane on request."""

import itertools
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from curio_proto.v1.detector_pb2 import Detection, RegionResult

from curio_serve.errors import ArgumentError, CameraError
from curio_serve.imaging.rotation import quaternion_xyzw
from curio_serve.imaging.view import Crop
from curio_serve.models.instances import Rows, Values
from curio_serve.models.model import Model, Slot
from curio_serve.models.object_frames import center_of, middle_from_origin, transformed, turns_any_way
from curio_serve.planes.plane import AnyPlane, Plane
from curio_serve.planes.stable_poses import StandingShape
from curio_serve.planes.standing import Standing, distance_factor, find_plane

UPRIGHT = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
"""The rotation of objects whose model answers none, row after row."""


class Limits(NamedTuple):
    """Limits beyond which detections are left out of an answer."""

    min_confidence: float
    max_detections: int | None
    max_instances: int | None


def _first_of_each(rows: list[int], slots: Sequence[Slot], count: int) -> list[int]:
    """The first rows of each kind of object, at most that many, in their order."""
    numbers = Counter[str]()
    kept = []
    for row in rows:
        numbers[slots[row].object] += 1
        if numbers[slots[row].object] <= count:
            kept.append(row)
    return kept


def fill(
    result: RegionResult,
    crop: Crop,
    found: Rows,
    limits: Limits,
    depths_m: tuple[float, float],
) -> None:
    """Write the most confident detections of one crop into a result, best first, in the frame's camera.

    Args:
        result: Written to.
        crop: That the network was shown.
        found: What it answered.
        limits: Of the request.
        depths_m: Smallest and largest depth that the model was trained for.

    Raises:
        CameraError: A pose is not finite in the frame's camera.
    """
    values, slots = found
    if "light" in values:
        result.light.extend(crop.rotate([[value] for value in values["light"]]))
    confidences = [min(max(c, 0.0), 1.0) for c in values.get("confidence", [1.0] * len(slots))]
    confident = [row for row, confidence in enumerate(confidences) if confidence >= limits.min_confidence]
    confident.sort(key=confidences.__getitem__, reverse=True)
    if limits.max_instances is not None:
        confident = _first_of_each(confident, slots, limits.max_instances)
    for row in confident[: limits.max_detections]:
        translation = crop.translation(values["translation_m"][row])
        rotation = crop.rotate(values["rotation"][row]) if "rotation" in values else ()
        if not all(map(math.isfinite, (*translation, *rotation, *result.light))):
            raise CameraError("the camera gives a pose that is not finite; check K and the distortion")
        result.detections.add(
            object=slots[row].object,
            confidence=confidences[row],
            translation_m=translation,
            rotation_6d=[*rotation[0::3], *rotation[1::3]],
            rotation=rotation,
            quaternion_xyzw=quaternion_xyzw(rotation) if rotation else (),
            color=values["color"][row] if "color" in values else (),
            box_px=crop.project(transformed(slots[row].box_corners, rotation or UPRIGHT, translation)),
            presence=values["presence"][row] if "presence" in values else None,
            outside_trained_range=not depths_m[0] <= _depth_m(values, row, slots[row]) <= depths_m[1],
        )


def _depth_m(values: Values, row: int, slot: Slot) -> float:
    """Depth of an object's middle along the canonical camera's axis, metres."""
    towards = values["rotation"][row][2] if "rotation" in values else UPRIGHT[6:]
    depth_m: float = values["translation_m"][row][2] + sum(map(float.__mul__, towards, slot.center))
    return depth_m


def check_can_stand(model: Model) -> None:
    """Refuse a plane for a model that does not say how its objects stand.

    Raises:
        ArgumentError: It does not.
    """
    if not model.spec.HasField("stable_poses") or "rotation" not in model.output_names:
        raise ArgumentError(
            f"plane is given, and model {model.label} does not say how its objects stand on one: leave it out, or "
            "export its run again with curio-export (of worlds that are flat, or whose parts all stand, none says it)"
        )


def move_onto_plane(
    results: Sequence[RegionResult], crops: Sequence[Crop | None], model: Model, given: AnyPlane
) -> None:
    """Move detections along their lines of sight until they stand on a plane, where they can.

    Args:
        results: Of all regions of a frame.
        crops: Of the same regions; None: outside the frame.
        model: That answered.
        given: The plane, or that it is to be found.
    """
    shapes, slots = standing_shapes(model), {slot.object: slot for slot in model.slots}
    pairs = [
        (detection, _standing(detection, shapes[detection.object], slots[detection.object]))
        for result in results
        for detection in result.detections
    ]
    plane = given if isinstance(given, Plane) else find_plane([standing for _, standing in pairs])
    if plane is None:
        return
    remaining = iter(pairs)
    for result, crop in zip(results, crops, strict=True):
        write_plane(result, plane)
        for detection, standing in itertools.islice(remaining, len(result.detections)):
            factor = distance_factor(standing, plane, is_known=plane is given)
            if factor is not None and crop is not None:
                _move(detection, (factor - 1) * standing.middle_m, crop, slots[detection.object])


def standing_shapes(model: Model) -> dict[str, StandingShape]:
    """How each kind of a model's objects can stand, by name."""
    kinds = {kind.name: kind for kind in model.spec.objects}
    shapes = {}
    for one in model.spec.stable_poses.objects:
        shape = StandingShape.of(one, center_of(kinds[one.object]))
        # The sides of a ball's mesh tell nothing: its rotation is not read.
        shapes[one.object] = replace(shape, up=shape.up[:0]) if turns_any_way(kinds[one.object]) else shape
    return shapes


def write_plane(result: RegionResult, plane: Plane) -> None:
    """Write into a result on which plane its objects stand."""
    result.plane.point_m.extend(plane.point_m.tolist())
    result.plane.normal.extend(plane.normal.tolist())


def _standing(detection: Detection, shape: StandingShape, slot: Slot) -> Standing:
    rotation, origin_m = np.reshape(detection.rotation, (3, 3)), np.array(detection.translation_m)
    return shape.at(middle_from_origin(origin_m, rotation, np.array(slot.center)), rotation, detection.confidence)


def _move(detection: Detection, by_m: np.ndarray, crop: Crop, slot: Slot) -> None:
    detection.translation_m[:] = (np.array(detection.translation_m) + by_m).tolist()
    detection.box_px[:] = crop.project(transformed(slot.box_corners, detection.rotation, detection.translation_m))
    detection.on_plane = True
