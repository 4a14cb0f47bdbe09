"""Draws poses over the frame they were found in: the mesh's contour or its box, the object's axes, name and confidence.

A picture must be readable over snow and over soot: every stroke is drawn twice, first wider and dark, then in its
colour. Edges of the box that its own sides hide are thin and dim, so that one sees which corner is near.
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from types import MappingProxyType

import cv2
import numpy as np
from curio_proto.v1.detector_pb2 import DETECTION_STATUS_UNSURE, Detection, RegionResult
from curio_proto.v1.model_spec_pb2 import ModelSpec, ObjectModel
from numpy.typing import NDArray

from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.silhouette import Surface, silhouette

Pixels = NDArray[np.uint8]
Rgb = tuple[int, int, int]

_PALETTE: tuple[Rgb, ...] = (
    (255, 196, 0),
    (0, 214, 255),
    (255, 105, 180),
    (124, 252, 0),
    (255, 140, 60),
    (190, 160, 255),
)
_AXES: tuple[Rgb, ...] = ((255, 64, 64), (64, 224, 64), (80, 128, 255))  # x, y, z
_UNSURE: Rgb = (176, 176, 176)
_HALO: Rgb = (16, 16, 16)
_TEXT: Rgb = (255, 255, 255)
_SUBPIXEL_BITS = 4  # OpenCV draws at sixteenths of a pixel
_FARTHEST_PX = 1e6  # a corner just before the camera's plane projects to anywhere: keep it in OpenCV's integers


def draw(
    pixels: Pixels,
    results: Iterable[RegionResult],
    spec: ModelSpec,
    camera: PinholeCamera | None = None,
    surfaces: Mapping[str, Surface] = MappingProxyType({}),
) -> Pixels:
    """A copy of the frame with every detection drawn on it, but those whose confidence is 0 to two digits.

    These are the slots of a model for several objects that it knows to be empty. Detections that are unsure are grey,
    with a question mark.

    Args:
        pixels: [height, width, 3] RGB.
        results: What was found in these pixels.
        spec: The model that found it: the objects' boxes.
        camera: The frame's own camera; None for 2D worlds, whose objects are drawn as circles.
        surfaces: Of objects by their names, whose contours are drawn in place of their boxes.

    Returns:
        [height, width, 3] RGB.
    """
    canvas = pixels.copy()
    objects = {kind.name: (kind, _PALETTE[i % len(_PALETTE)]) for i, kind in enumerate(spec.objects)}
    stroke_px = max(1, round(min(canvas.shape[:2]) / 240))
    labels = list[tuple[NDArray[np.float64], str, Rgb]]()
    # the most confident last: on top
    for detection in sorted((d for result in results for d in result.detections), key=lambda d: d.confidence):
        if round(detection.confidence, 2) == 0:
            continue
        kind, color = objects.get(detection.object, (ObjectModel(), _PALETTE[0]))
        is_unsure = detection.status == DETECTION_STATUS_UNSURE
        color = _UNSURE if is_unsure else color
        corners_px = np.array(detection.box_px, float).reshape(-1, 2)
        if camera is None:
            _draw_disc(canvas, corners_px, color, stroke_px)
        elif detection.object in surfaces:
            _draw_contour(canvas, surfaces[detection.object], detection, kind, camera, color, stroke_px)
        else:
            _draw_solid(canvas, corners_px, detection, kind, camera, color, stroke_px)
        labels.append((corners_px, f"{detection.object}{'?' * is_unsure} {detection.confidence:.2f}", color))
    is_labelled = np.zeros(canvas.shape[:2], bool)
    for label in reversed(labels):  # the most confident one first: others make room
        _draw_label(canvas, *label, is_labelled)
    return canvas


def _draw_disc(canvas: Pixels, corners_px: NDArray[np.float64], color: Rgb, stroke_px: int) -> None:
    """A 2D object: the circle in its box and a cross in the middle."""
    if not len(corners_px) or not np.isfinite(corners_px).all():
        return
    low, high = corners_px.min(axis=0), corners_px.max(axis=0)
    center, radius_px = (low + high) / 2, float((high - low).max()) / 2
    scale = 1 << _SUBPIXEL_BITS
    center_fixed = tuple(int(c) for c in np.rint(np.clip(center, -_FARTHEST_PX, _FARTHEST_PX) * scale))
    radius_fixed = round(min(radius_px, _FARTHEST_PX) * scale)
    for ink, width in ((_HALO, stroke_px + 2), (color, stroke_px)):
        cv2.circle(canvas, center_fixed, radius_fixed, ink, width, cv2.LINE_AA, _SUBPIXEL_BITS)
    arm = max(2.0, radius_px / 4)
    for step in (np.array([arm, 0]), np.array([0, arm])):
        _draw_segment(canvas, center - step, center + step, color, stroke_px)


def _draw_contour(
    canvas: Pixels,
    surface: Surface,
    detection: Detection,
    kind: ObjectModel,
    camera: PinholeCamera,
    color: Rgb,
    stroke_px: int,
) -> None:
    """The outline of the mesh, holes included, which half a turn changes where a box stays the same; and the axes."""
    rotation, translation_m = _pose(detection)
    height, width = canvas.shape[:2]
    covered = silhouette(surface, rotation, translation_m, camera, width, height)
    contours, _ = cv2.findContours(covered, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(canvas, contours, -1, _HALO, stroke_px + 2, cv2.LINE_AA)
    cv2.drawContours(canvas, contours, -1, color, stroke_px, cv2.LINE_AA)
    _draw_axes(canvas, rotation, translation_m, 0.6 * kind.diameter_m, camera, stroke_px)


def _pose(detection: Detection) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation [3, 3] and translation [3] in metres, from the object's frame to the camera's."""
    return np.array(detection.rotation, float).reshape(3, 3), np.array(detection.translation_m, float)


def _draw_solid(
    canvas: Pixels,
    corners_px: NDArray[np.float64],
    detection: Detection,
    kind: ObjectModel,
    camera: PinholeCamera,
    color: Rgb,
    stroke_px: int,
) -> None:
    """Hidden edges, then the axes inside the box, then the edges in front of both."""
    corners_m = np.array(kind.box_corners_m, float).reshape(-1, 3)
    rotation, translation_m = _pose(detection)
    edges = _box_edges(corners_m, -rotation.T @ translation_m) if len(corners_m) == len(corners_px) else []
    dim: Rgb = (color[0] // 2, color[1] // 2, color[2] // 2)
    for start, end, is_visible in edges:
        if not is_visible:
            _draw_segment(canvas, corners_px[start], corners_px[end], dim, 1, halo_px=0)
    _draw_axes(canvas, rotation, translation_m, 0.6 * kind.diameter_m, camera, stroke_px)
    for start, end, is_visible in edges:
        if is_visible:
            _draw_segment(canvas, corners_px[start], corners_px[end], color, stroke_px)


def _box_edges(corners_m: NDArray[np.float64], eye_m: NDArray[np.float64]) -> list[tuple[int, int, bool]]:
    """The box's 12 edges and whether the camera sees them.

    An edge is seen when one of its two faces is, and a face is seen when the camera stands beyond its plane.

    Args:
        corners_m: [8, 3] corners of a box along the object's axes, in any order.
        eye_m: [3] the camera's centre in the object's frame.

    Returns:
        (index of one corner, index of the other, seen).
    """
    low, high = corners_m.min(axis=0), corners_m.max(axis=0)
    is_high = corners_m > (low + high) / 2
    edges = []
    for a, b in combinations(range(len(corners_m)), 2):
        differing = np.flatnonzero(is_high[a] != is_high[b])
        if len(differing) != 1:
            continue
        faces = [axis for axis in range(3) if axis != differing[0]]
        is_seen = any(eye_m[axis] > high[axis] if is_high[a, axis] else eye_m[axis] < low[axis] for axis in faces)
        edges.append((a, b, is_seen))
    return edges


def _draw_axes(
    canvas: Pixels,
    rotation: NDArray[np.float64],
    translation_m: NDArray[np.float64],
    length_m: float,
    camera: PinholeCamera,
    stroke_px: int,
) -> None:
    """X red, y green, z blue, from the object's origin; the farthest tip first."""
    tips_m = translation_m + length_m * rotation.T  # row i: the tip of axis i, camera frame
    points_m = np.vstack([translation_m, tips_m])
    if points_m[:, 2].min() <= 0:
        return
    projected, _ = cv2.projectPoints(
        points_m, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion, float)
    )
    origin_px, *tips_px = projected.reshape(-1, 2)
    for axis in np.argsort(-tips_m[:, 2]):
        _draw_segment(canvas, origin_px, tips_px[axis], _AXES[axis], stroke_px)


def _draw_segment(
    canvas: Pixels,
    start: Sequence[float] | NDArray,
    end: Sequence[float] | NDArray,
    ink: Rgb,
    width: int,
    halo_px: int = 2,
) -> None:
    """A straight stroke with a dark rim between two points in pixels; nothing where one is not finite."""
    ends = np.array([start, end], float)
    if not np.isfinite(ends).all():
        return
    fixed = np.rint(np.clip(ends, -_FARTHEST_PX, _FARTHEST_PX) * (1 << _SUBPIXEL_BITS)).astype(int).tolist()
    if halo_px:
        cv2.line(canvas, fixed[0], fixed[1], _HALO, width + halo_px, cv2.LINE_AA, _SUBPIXEL_BITS)
    cv2.line(canvas, fixed[0], fixed[1], ink, width, cv2.LINE_AA, _SUBPIXEL_BITS)


def _draw_label(
    canvas: Pixels, corners_px: NDArray[np.float64], text: str, color: Rgb, is_labelled: NDArray[np.bool_]
) -> None:
    """Name and confidence on a dark label over the box, moved inside the frame where it would stick out.

    It is moved down where it would cover another label (``is_labelled`` [height, width]), unless there is no room.
    """
    seen_px = corners_px[np.isfinite(corners_px).all(axis=1)]
    if not len(seen_px):
        return
    height, width = canvas.shape[:2]
    scale = max(0.35, min(height, width) / 1000)
    (text_width, text_height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    label_width, label_height = text_width + 8, text_height + below + 6
    left = int(np.clip(seen_px[:, 0].min(), 0, max(0, width - label_width)))
    top = int(np.clip(seen_px[:, 1].min() - label_height - 3, 0, max(0, height - label_height)))
    for below_px in range(top, height - label_height, label_height + 1):
        if not is_labelled[below_px : below_px + label_height, left : left + label_width].any():
            top = below_px
            break
    is_labelled[top : top + label_height, left : left + label_width] = True
    label = canvas[top : top + label_height, left : left + label_width]
    label[:] = label // 4
    label[:, :3] = color
    cv2.putText(canvas, text, (left + 6, top + text_height + 3), cv2.FONT_HERSHEY_SIMPLEX, scale, _TEXT, 1, cv2.LINE_AA)
