"""Followed objects that stand on a plane: streams, and what one frame's measurements become."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from curio_proto.v1 import detector_pb2 as messages
from curio_proto.v1.model_spec_pb2 import ObjectModel
from curio_serve.client import Plane
from curio_serve.errors import ArgumentError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.models.answers import standing_shapes
from curio_serve.models.detector import Detector
from curio_serve.models.model_folder import open_model
from curio_serve.models.object_frames import center_of, middle_from_origin
from curio_serve.planes.stable_poses import StandingShape
from curio_serve.tracking.frame_plane import FramePlane
from curio_serve.tracking.stream import FollowingStream
from curio_serve.tracking.tracks import Measurement, Track
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).parents[3]
K = np.array([[300.0, 0, 160.0], [0, 301.0, 119.0], [0, 0, 1]])
SIZE_M = np.array([0.1, 0.06, 0.04])
CORNERS_M = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * SIZE_M / 2
SIDES = np.concatenate([np.eye(3), -np.eye(3)])
BRICK = ObjectModel(name="brick", diameter_m=float(np.linalg.norm(SIZE_M)))
SHAPES = {"brick": StandingShape(CORNERS_M, SIDES)}
TABLE = Plane.of([0.0, 0.1, 1.0], [0.0, -0.8, -0.6])
UPRIGHT = Rotation.align_vectors(TABLE.normal[None], SIDES[2][None])[0].as_matrix()


def _follow(
    detector: Detector,
    pixels: np.ndarray,
    num_frames: int,
    num_objects: int = 1,
    camera: PinholeCamera | None = None,
    plane: Any = None,
) -> Any:
    """The results of equal frames."""
    stream, results, camera = FollowingStream(), messages.DetectResponse().results, camera or PinholeCamera(K)
    track = messages.Tracking(num_objects=num_objects)
    for _ in range(num_frames):
        stream.follow(track, [detector], pixels, camera, min_confidence=0.0, plane=plane, reduction=1, results=results)
    return results


def test_a_track_stands_on_a_plane_that_is_known_and_its_height_is_known_better(
    standing: Path, pixels: np.ndarray, below: Callable[..., Plane]
) -> None:
    detector = Detector(open_model(standing))
    (before,) = detector.detect(pixels, PinholeCamera(K))[0].detections
    plane = below(before, 0.01)
    (expected,) = detector.detect(pixels, PinholeCamera(K), plane=plane)[0].detections
    free, result = (_follow(detector, pixels, 3, **options)[-1] for options in ({}, {"plane": plane}))
    (found,) = result.detections
    assert np.allclose(result.plane.normal, plane.normal)
    assert not free.HasField("plane")
    assert (found.on_plane, free.detections[0].on_plane) == (True, False)
    assert found.translation_m == pytest.approx(expected.translation_m, abs=0.002)
    assert found.track.translation_m == pytest.approx(found.translation_m)
    assert not _follow(detector, pixels, 1, plane=below(before, 0.4))[0].detections[0].on_plane
    assert max(found.track.position_std_m) < 0.7 * max(free.detections[0].track.position_std_m)


def test_followed_objects_tell_their_plane(pair: Path, standing: Path, pixels: np.ndarray) -> None:
    detector = Detector(open_model(pair))
    result = _follow(detector, pixels, 2, 2, plane="objects")[-1]
    (expected,) = detector.detect(pixels, PinholeCamera(K), plane="objects")
    assert [one.on_plane for one in result.detections] == [True, True]
    assert np.allclose(result.plane.normal, expected.plane.normal)
    tracked, detected = (sorted(list(one.translation_m) for one in of.detections) for of in (result, expected))
    assert np.allclose(tracked, detected, atol=0.002)
    (alone,) = _follow(Detector(open_model(standing)), pixels, 1, plane="objects")
    assert not alone.HasField("plane")


def test_what_crops_show_moves_as_well() -> None:
    """The shipped model of an ape is cut at its crops: after the first frame the whole frame is not read."""
    matrix = json.loads((ROOT / "samples" / "camera.json").read_text())["camera_matrix"]
    photograph = np.ascontiguousarray(cv2.imread(str(ROOT / "samples" / "03.jpg"))[..., ::-1])
    detector = Detector(open_model(ROOT / "models" / "ape"))
    (kind,), shape = detector.model.spec.objects, standing_shapes(detector.model)["ape"]

    def lowest_m(found: messages.Detection, normal: np.ndarray | None = None) -> Plane:
        rotation = np.reshape(found.rotation, (3, 3))
        middle_m = middle_from_origin(np.array(found.translation_m), rotation, center_of(kind))
        where = shape.at(middle_m, rotation, 1.0)
        normal = min(where.up, key=lambda up: up @ middle_m) if normal is None else normal
        return Plane((where.hull_m @ normal).min() * normal, normal)

    before = _follow(detector, photograph, 2, camera=PinholeCamera(np.array(matrix)))[-1].detections[0]
    read = lowest_m(before)
    plane = Plane(read.point_m - 0.004 * read.normal, read.normal)
    found = _follow(detector, photograph, 2, camera=PinholeCamera(np.array(matrix)), plane=plane)[-1].detections[0]
    assert found.on_plane
    below_m = lowest_m(found, plane.normal).offset_m - read.offset_m
    assert -0.005 < below_m < -0.002


def test_a_prediction_stands_on_nothing_and_a_model_has_to_say_how_objects_stand(
    standing: Path, models_dir: Path, pixels: np.ndarray, below: Callable[..., Plane]
) -> None:
    detector, stream = Detector(open_model(standing)), FollowingStream()
    plane = below(detector.detect(pixels, PinholeCamera(K))[0].detections[0], 0.01)
    results = messages.DetectResponse().results
    options: dict[str, Any] = {"min_confidence": 0.0, "plane": plane, "reduction": 1, "results": results}
    for frame in (pixels, np.zeros_like(pixels)):
        stream.follow(messages.Tracking(), [detector], frame, PinholeCamera(K), **options)
    seen, predicted = (result.detections[0] for result in results)
    assert (seen.on_plane, seen.track.predicted) == (True, False)
    assert (predicted.on_plane, predicted.track.predicted) == (False, True)
    other = Detector(open_model(models_dir / "pinhole"))
    with pytest.raises(ArgumentError, match="does not say how its objects stand"):
        FollowingStream().follow(messages.Tracking(), [other], pixels, PinholeCamera(K), **options)


def _brick(x_m: float, factor: float = 1.0, lean: float = 0.0, confidence: float = 0.9) -> Measurement:
    """A brick on the table, as a whole frame shows it whose distances are off by a factor."""
    rotation = Rotation.from_rotvec([lean, 0, lean]).as_matrix() @ UPRIGHT
    lowest_m = (CORNERS_M @ rotation.T @ TABLE.normal).min()
    middle_m = TABLE.point_m + np.array([x_m, 0, 0]) - lowest_m * TABLE.normal
    return Measurement.of_whole_frame(BRICK, factor * middle_m, rotation, confidence)


def _over_table_m(measured: Measurement) -> float:
    hull_m = CORNERS_M @ measured.rotation.T + measured.translation_m
    return float((hull_m @ TABLE.normal).min()) - TABLE.offset_m


def test_without_a_plane_measurements_stay() -> None:
    found = [_brick(-0.2, 1.01), _brick(0.2, 0.99)]
    plane = FramePlane(SHAPES, None)
    assert plane.stood(found) == found
    assert plane.plane is None


@pytest.mark.parametrize("std", [0.002, 0.03])
def test_a_position_on_a_known_plane_is_as_uncertain_as_its_covariance_says(std: float) -> None:
    """Distances are off by 1.5 % at least, whatever spread a network says; 3 is the mean of a chi-square of three."""
    random, truth = np.random.default_rng(3), _brick(0.1)
    ray = truth.translation_m / np.linalg.norm(truth.translation_m)
    said = np.eye(3) * 0.003**2 + np.outer(ray, ray) * std**2
    squares, moved_m, read_m = [], [], []
    for _ in range(400):
        error_m = random.normal(0, 0.003, 3) + ray * random.normal(0, max(std, 0.015))
        plane = Plane(TABLE.point_m + TABLE.normal * random.normal(0, 0.004), TABLE.normal)
        read = replace(truth, translation_m=truth.translation_m + error_m, covariance_m2=said)
        (found,) = FramePlane(SHAPES, plane).stood([read])
        off_m = found.translation_m - truth.translation_m
        if not found.on_plane:
            continue
        squares.append(off_m @ np.linalg.solve(found.covariance_m2, off_m))
        moved_m.append(np.linalg.norm(off_m))
        read_m.append(np.linalg.norm(error_m))
    assert len(squares) > 370
    assert np.mean(squares) == pytest.approx(3, rel=0.25)
    assert np.mean(moved_m) < 0.6 * np.mean(read_m)


def test_a_plane_that_is_found_stays_for_the_frame_and_is_known_no_better_than_distances() -> None:
    plane, pair, later = FramePlane(SHAPES, "objects"), [_brick(-0.2, 1.01), _brick(0.2, 0.99)], _brick(0.0, 1.015)
    assert plane.stood(pair[:1]) == pair[:1], "one brick stands on any plane"
    first = plane.stood(pair)
    assert [one.on_plane for one in first] == [True, True]
    told = plane.plane
    (found,) = plane.stood([later])
    assert plane.plane is told
    assert abs(_over_table_m(found)) < 0.6 * abs(_over_table_m(later))
    for moved, read in zip([*first, found], [*pair, later], strict=True):
        assert np.linalg.eigvalsh(moved.covariance_m2 - read.covariance_m2).min() > -1e-12


def test_what_leans_touches_a_known_plane_alone_and_what_is_too_high_none() -> None:
    leaning, high = _brick(0.1, 1.01, lean=0.5), _brick(-0.1, 0.85)
    known = FramePlane(SHAPES, TABLE).stood([leaning, high])
    assert [one.on_plane for one in known] == [True, False]
    assert abs(_over_table_m(known[0])) < 0.2 * abs(_over_table_m(leaning))
    found = FramePlane(SHAPES, "objects").stood([_brick(-0.3), _brick(0.3), leaning, high])
    assert [one.on_plane for one in found] == [True, True, False, False]
    assert found[3] == high


def test_the_confident_tell_the_plane() -> None:
    high = [_brick(x, 0.9, confidence=0.2) for x in (-0.1, 0.1)]
    plane = FramePlane(SHAPES, "objects")
    plane.stood([*high, _brick(-0.3), _brick(0.3)])
    assert plane.plane is not None
    assert plane.plane.normal @ TABLE.point_m == pytest.approx(plane.plane.offset_m, abs=0.005)


def test_a_track_that_leaves_the_plane_jumps_and_does_not_fly() -> None:
    standing, lifted = _brick(0.1, 0.95), _brick(0.1, 0.9)
    track = Track.begin(1, BRICK, *FramePlane(SHAPES, TABLE).stood([standing]), 0.0)
    for number, read in enumerate([standing, standing, lifted, lifted], start=1):
        track.predict(1 / 30)
        (measured,) = FramePlane(SHAPES, TABLE).stood([read])
        track.update(measured, number / 30)
        assert measured.on_plane == (read is standing)
    assert np.allclose(track.filter.translation_m, lifted.translation_m, atol=0.001)
    assert np.linalg.norm(track.filter.velocity_m_s) < 0.01
