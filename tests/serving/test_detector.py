"""Poses in frames whose truth is known: what the spot models answer can be worked out by hand (see conftest)."""

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from curio_proto.v1.detector_pb2 import (
    REGION_STATUS_DETECTED,
    REGION_STATUS_NO_OBJECT,
    REGION_STATUS_OUTSIDE_FRAME,
)
from curio_proto.v1.model_spec_pb2 import ModelSpec
from curio_serve.errors import ArgumentError, CameraError, CameraMissing, ImageError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.view import Region
from curio_serve.models.detector import Detector
from curio_serve.models.model import load
from curio_serve.models.model_folder import open_model
from scipy.spatial.transform import Rotation

SPOT_RADIUS_M = 0.05
K = np.array([[600.0, 0, 310.0], [0, 610.0, 250.0], [0, 0, 1]])
MODEL_ROTATION = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
MODEL_LIGHT = np.array([0.3, -0.8, -0.5])
COLOR = (255, 128, 64)

DrawSpot = Callable[..., np.ndarray]


@pytest.fixture(scope="module")
def flat(models_dir: Path) -> Detector:
    return Detector(open_model(models_dir / "flat"))


@pytest.fixture(scope="module")
def pinhole(models_dir: Path) -> Detector:
    return Detector(open_model(models_dir / "pinhole"))


def _picture(draw: DrawSpot, position: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    u, v = camera.project(position[None])[0]
    sigma = SPOT_RADIUS_M / position[2]
    return draw(640, 480, u, v, camera.matrix[0, 0] * sigma, camera.matrix[1, 1] * sigma, COLOR)


def _check_position(found: Sequence[float], truth: np.ndarray) -> None:
    """The direction to a fifth of a pixel of the model's input; depth as far as brightness tells it off the axis."""
    np.testing.assert_allclose(np.array(found)[:2] / found[2], truth[:2] / truth[2], atol=2e-3)
    assert found[2] == pytest.approx(truth[2], rel=0.05)


def test_flat_positions(flat: Detector, spot_image: DrawSpot) -> None:
    [result] = flat.detect(spot_image(640, 480, 200, 300, 20, 20, COLOR), None)
    assert (result.model, result.model_version, result.status) == ("flat", 1, REGION_STATUS_DETECTED)
    [found] = result.detections
    np.testing.assert_allclose(found.translation_m, [(200 - 319.5) / 640, (300 - 239.5) / 640, 0], atol=5e-4)
    np.testing.assert_allclose(found.color, np.array(COLOR) / 255, atol=0.01)
    assert found.object == "spot"
    assert found.confidence == 1
    assert not found.rotation
    assert not result.light
    corners = np.reshape(found.box_px, (8, 2))
    np.testing.assert_allclose(corners.mean(axis=0), [200, 300], atol=0.5)
    np.testing.assert_allclose(np.ptp(corners, axis=0), [64, 64])


@pytest.mark.parametrize("distortion", [(), (-0.2, 0.05, 0.001, -0.002, 0.0)])
@pytest.mark.parametrize("position", [(0.1, -0.05, 2.0), (-0.3, 0.2, 2.5), (0.0, 0.0, 3.0)])
def test_positions_in_space(
    pinhole: Detector, spot_image: DrawSpot, position: tuple[float, ...], distortion: tuple[float, ...]
) -> None:
    truth = np.array(position)
    camera = PinholeCamera(K, distortion)
    [result] = pinhole.detect(_picture(spot_image, truth, camera), camera)
    [found] = result.detections
    _check_position(found.translation_m, truth)


@pytest.mark.parametrize("region", [Region(380, 120, 60, 80), Region(100, 50, 500, 400), Region(420, 150, 400, 100)])
def test_regions_look_elsewhere_and_find_the_same(pinhole: Detector, spot_image: DrawSpot, region: Region) -> None:
    truth = np.array([0.3, -0.15, 2.0])
    camera = PinholeCamera(K)
    [result] = pinhole.detect(_picture(spot_image, truth, camera), camera, regions=[region])
    [found] = result.detections
    _check_position(found.translation_m, truth)


def test_rotation_and_light_are_turned_back(pinhole: Detector, spot_image: DrawSpot) -> None:
    camera = PinholeCamera(K)
    picture = _picture(spot_image, np.array([0.3, -0.15, 2.0]), camera)
    [result] = pinhole.detect(picture, camera, regions=[Region(380, 120, 60, 80)])
    [found] = result.detections
    rotation = np.reshape(found.rotation, (3, 3))
    turn = rotation @ MODEL_ROTATION.T
    # The model's constant rotation, seen from a camera turned towards the region.
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) > 3
    canonical_center = np.linalg.solve([[110, 0, 50], [0, 112, 30], [0, 0, 1]], [47.5, 31.5, 1])
    towards = turn @ canonical_center / np.linalg.norm(canonical_center)
    np.testing.assert_allclose(towards, camera.ray(409.5, 159.5), atol=1e-6)
    np.testing.assert_allclose(result.light, turn @ MODEL_LIGHT, atol=1e-6)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    np.testing.assert_array_equal(found.rotation_6d, [*rotation[:, 0], *rotation[:, 1]])
    np.testing.assert_allclose(Rotation.from_quat(found.quaternion_xyzw).as_matrix(), rotation, atol=1e-6)


def test_box_corners_are_the_spec_s_projected(pinhole: Detector, spot_image: DrawSpot) -> None:
    camera = PinholeCamera(K, (-0.2, 0.05, 0.001, -0.002, 0.0))
    [result] = pinhole.detect(_picture(spot_image, np.array([0.1, 0.1, 2.0]), camera), camera)
    [found] = result.detections
    corners = np.reshape(pinhole.model.spec.objects[0].box_corners_m, (8, 3))
    in_camera = corners @ np.reshape(found.rotation, (3, 3)).T + found.translation_m
    expected, _ = cv2.projectPoints(in_camera, np.zeros(3), np.zeros(3), K, np.array(camera.distortion))
    np.testing.assert_allclose(np.reshape(found.box_px, (8, 2)), expected[:, 0], atol=1e-3)


def test_reduced_pixels_give_the_same_pose(pinhole: Detector, spot_image: DrawSpot) -> None:
    camera, truth = PinholeCamera(K), np.array([0.1, -0.05, 2.0])
    picture = _picture(spot_image, truth, camera)
    assert pinhole.reduction(camera, 640, 480) == 4
    half = picture.reshape(240, 2, 320, 2, 3).mean(axis=(1, 3)).round().astype(np.uint8)
    whole, reduced = (
        pinhole.detect(pixels, camera, reduction=reduction)[0].detections[0].translation_m
        for pixels, reduction in ((picture, 1), (half, 2))
    )
    np.testing.assert_allclose(whole, reduced, rtol=0.02, atol=1e-3)


def test_reduction_never_goes_below_the_models_resolution(flat: Detector, pinhole: Detector) -> None:
    assert flat.reduction(None, 640, 480) == 4
    assert flat.reduction(None, 96, 64) == 1
    assert flat.reduction(None, 192, 127) == 1
    assert pinhole.reduction(None, 640, 480) == 1
    assert pinhole.reduction(PinholeCamera(K / 3 + np.diag([0, 0, 2 / 3])), 640, 480) == 1


def test_an_empty_frame_is_an_answer(flat: Detector) -> None:
    [result] = flat.detect(np.zeros((480, 640, 3), np.uint8), None, min_confidence=0.5)
    assert result.status == REGION_STATUS_NO_OBJECT
    assert not result.detections


def test_regions_keep_their_order_and_status(flat: Detector, spot_image: DrawSpot) -> None:
    picture = spot_image(640, 480, 500, 100, 10, 10, COLOR)
    regions = [Region(700, 0, 50, 50), Region(400, 20, 200, 160), Region(0, 200, 200, 200), Region(-50, -50, 50, 50)]
    results = flat.detect(picture, None, regions=regions, min_confidence=0.5)
    assert [r.region for r in results] == [0, 1, 2, 3]
    assert [r.status for r in results] == [
        REGION_STATUS_OUTSIDE_FRAME,
        REGION_STATUS_DETECTED,
        REGION_STATUS_NO_OBJECT,
        REGION_STATUS_OUTSIDE_FRAME,
    ]
    position = results[1].detections[0].translation_m
    np.testing.assert_allclose(position, [(500 - 319.5) / 640, (100 - 239.5) / 640, 0], atol=1e-3)


def test_many_regions_are_answered_each_with_its_own(flat: Detector, spot_image: DrawSpot) -> None:
    picture = spot_image(640, 480, 320, 240, 12, 12, COLOR)
    regions = [Region(20 * i, 10 * i, 320, 240) for i in range(20)]
    together = flat.detect(picture, None, regions=regions)
    for index, region in enumerate(regions):
        [alone] = flat.detect(picture, None, regions=[region])
        assert (together[index].region, together[index].status) == (index, alone.status)
        found, expected = together[index].detections[0], alone.detections[0]
        np.testing.assert_allclose(found.translation_m, expected.translation_m, atol=1e-6)
        np.testing.assert_allclose(found.box_px, expected.box_px, atol=1e-3)


def test_missing_k_is_refused_and_a_default_is_only_the_specs(
    pinhole: Detector, spot_onnx: Callable[..., onnx.ModelProto], spot_spec: Callable[[bool], ModelSpec], tmp_path: Path
) -> None:
    picture = np.zeros((480, 640, 3), np.uint8)
    with pytest.raises(CameraMissing, match="needs the camera matrix K"):
        pinhole.detect(picture, None)
    spec = spot_spec(True)
    spec.camera.is_default = True
    path = tmp_path / "default.onnx"
    path.write_bytes(spot_onnx(True, spec).SerializeToString())
    assert len(Detector(load(path)).detect(picture, None)) == 1


@pytest.mark.parametrize(("depth_m", "outside"), [(0.3, True), (0.7, False), (1.2, True)])
def test_depths_that_were_not_trained_are_marked(
    spot_onnx: Callable[..., onnx.ModelProto],
    spot_spec: Callable[[bool], ModelSpec],
    spot_image: DrawSpot,
    tmp_path: Path,
    depth_m: float,
    outside: bool,
) -> None:
    spec = spot_spec(True)
    spec.fields[0].lower.extend([-1, -1, 0.5])
    spec.fields[0].upper.extend([1, 1, 1.0])
    path = tmp_path / "ranged.onnx"
    path.write_bytes(spot_onnx(True, spec).SerializeToString())
    camera = PinholeCamera(K)
    picture = _picture(spot_image, np.array([0.02, -0.01, depth_m]), camera)
    [result] = Detector(load(path)).detect(picture, camera)
    assert [found.outside_trained_range for found in result.detections] == [outside]


def test_a_camera_that_cannot_have_taken_the_frame(pinhole: Detector) -> None:
    with pytest.raises(CameraError, match="outside the frame of 320x240"):
        pinhole.detect(np.zeros((240, 320, 3), np.uint8), PinholeCamera(K + np.diag([9, 9, 0])))


@pytest.mark.parametrize(
    ("pixels", "words"),
    [
        (np.zeros((48, 64, 3), np.float32), "float32"),
        (np.zeros((48, 64), np.uint8), r"\(48, 64\)"),
        (np.zeros((48, 64, 4), np.uint8), r"\(48, 64, 4\)"),
        (np.zeros((0, 64, 3), np.uint8), r"\(0, 64, 3\)"),
    ],
)
def test_pixels_of_another_kind(flat: Detector, pixels: np.ndarray, words: str) -> None:
    with pytest.raises(ImageError, match=words):
        flat.detect(pixels, None)


@pytest.mark.parametrize(
    "region",
    [
        Region(0, 0, 0, 10),
        Region(0, 0, 10, -5),
        Region(float("nan"), 0, 10, 10),
        Region(0, 0, float("inf"), 10),
        Region(-1e9, 0, 2e9, 10),
    ],
)
def test_impossible_regions(flat: Detector, region: Region) -> None:
    with pytest.raises(ArgumentError, match=r"regions\[1\]"):
        flat.detect(np.zeros((48, 64, 3), np.uint8), None, regions=[Region(0, 0, 64, 48), region])


@pytest.mark.parametrize("confidence", [-0.1, 1.5, float("nan")])
def test_impossible_thresholds(flat: Detector, confidence: float) -> None:
    with pytest.raises(ArgumentError, match="min_confidence"):
        flat.detect(np.zeros((48, 64, 3), np.uint8), None, min_confidence=confidence)
