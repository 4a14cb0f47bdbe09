"""What a model answers that has a ``reliability.json`` beside it: a status, intervals, and nothing new without it."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from curio_proto.v1 import detector_pb2 as messages
from curio_serve.batch.arguments import DetectArguments
from curio_serve.batch.detect_cli import run
from curio_serve.client import PoseClient
from curio_serve.errors import ModelError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.view import PinholeFrame, Region
from curio_serve.models.detector import Detector
from curio_serve.models.model_folder import open_model
from curio_serve.tracking.stream import FollowingStream

K = np.array([[300.0, 0, 160.0], [0, 301.0, 119.0], [0, 0, 1]])
SURE, SURER = 0.4, 0.9
BOUNDS = [
    {"min_confidence": SURE, "lateral_m": 0.02, "depth_fraction": 0.1, "rotation_deg": 30.0},
    {"min_confidence": SURER, "lateral_m": 0.003, "depth_fraction": 0.02, "rotation_deg": 7.5},
]
OF_SPOT = {"object": "spot", "min_confidence": SURE, "bounds": BOUNDS}
RELIABILITY = {"level": 0.9, "num_images": 1000, "objects": [OF_SPOT]}
Spot = Callable[..., np.ndarray]


@pytest.fixture
def measured(tmp_path: Path, spot_onnx: Callable[..., onnx.ModelProto], write_folder: Callable[..., Path]) -> Path:
    """The folder of ``pinhole`` with a measurement."""
    folder = write_folder(tmp_path / "models" / "pinhole", spot_onnx(True))
    _put(folder, RELIABILITY)
    return folder


def _put(folder: Path, found: object) -> None:
    file = folder / "1" / "reliability.json"
    file.write_text(json.dumps(found))
    lines = [line for line in (folder / "SHA256SUMS").read_text().splitlines() if "reliability" not in line]
    lines.append(f"{hashlib.sha256(file.read_bytes()).hexdigest()}  1/reliability.json")
    (folder / "SHA256SUMS").write_text("\n".join(lines) + "\n")


def _frame(spot_image: Spot, sigma: float) -> np.ndarray:
    return spot_image(320, 240, 150, 120, sigma, sigma, (255, 128, 0))


def _detect(folder: Path, pixels: np.ndarray, **limits: float) -> messages.RegionResult:
    (result,) = Detector(open_model(folder)).detect(pixels, PinholeCamera(K), **limits)  # type: ignore[arg-type]
    return result


def _of_confidence(folder: Path, spot_image: Spot, low: float, high: float) -> np.ndarray:
    """A frame whose answer has a confidence in that range: larger spots are surer."""
    for sigma in np.linspace(0.5, 16, 63):
        pixels = _frame(spot_image, float(sigma))
        if low < _detect(folder, pixels).detections[0].confidence < high:
            return pixels
    raise AssertionError(f"no spot has a confidence in ({low}, {high})")


@pytest.mark.parametrize(("range_", "bounds"), [((SURE, SURER), BOUNDS[0]), ((SURER, 1.1), BOUNDS[1])])
def test_a_sure_answer_has_the_interval_of_its_confidence(
    measured: Path, spot_image: Spot, range_: tuple[float, float], bounds: dict[str, float]
) -> None:
    result = _detect(measured, _of_confidence(measured, spot_image, *range_))
    (found,) = result.detections
    assert (result.status, found.status) == (messages.REGION_STATUS_DETECTED, messages.DETECTION_STATUS_SURE)
    distance_m = float(np.linalg.norm(found.translation_m))
    assert found.interval.level == 0.9
    assert found.interval.lateral_m == bounds["lateral_m"]
    assert found.interval.depth_m == pytest.approx(bounds["depth_fraction"] * distance_m)
    assert found.interval.rotation_deg == bounds["rotation_deg"]


def test_an_unsure_answer_says_so_and_has_no_interval(measured: Path, spot_image: Spot) -> None:
    pixels = _of_confidence(measured, spot_image, 0.01, SURE)
    result = _detect(measured, pixels)
    (found,) = result.detections
    assert (result.status, found.status) == (messages.REGION_STATUS_UNSURE, messages.DETECTION_STATUS_UNSURE)
    assert not found.HasField("interval")
    assert len(found.translation_m) == 3
    nothing = _detect(measured, pixels, min_confidence=SURE)
    assert (nothing.status, len(nothing.detections)) == (messages.REGION_STATUS_NO_OBJECT, 0)


def test_a_model_without_a_measurement_answers_as_before(models_dir: Path, spot_image: Spot) -> None:
    for sigma in (0.6, 12):
        result = _detect(models_dir / "pinhole", _frame(spot_image, sigma))
        assert result.status == messages.REGION_STATUS_DETECTED
        assert result.detections[0].status == messages.DETECTION_STATUS_UNSPECIFIED
        assert not result.detections[0].HasField("interval")


def test_a_followed_object_that_fades_becomes_unsure(measured: Path, spot_image: Spot) -> None:
    detector, stream, statuses = Detector(open_model(measured)), FollowingStream(), []
    for number in range(30):
        answer = messages.DetectResponse()
        pixels = _frame(spot_image, 12) if number < 3 else np.zeros((240, 320, 3), np.uint8)
        stream.follow(
            messages.Tracking(time_s=number / 30, keep_s=1.0),
            [detector],
            pixels,
            PinholeCamera(K),
            min_confidence=0.0,
            reduction=1,
            results=answer.results,
        )
        [result] = answer.results
        statuses.append((result.status, result.detections[0].status))
    assert statuses[0] == (messages.REGION_STATUS_DETECTED, messages.DETECTION_STATUS_SURE)
    assert statuses[-1] == (messages.REGION_STATUS_UNSURE, messages.DETECTION_STATUS_UNSURE)


def test_over_grpc(measured: Path, start_server: Callable[..., object], spot_image: Spot) -> None:
    server = start_server(measured.parent)
    sure, unsure = _frame(spot_image, 14), _of_confidence(measured, spot_image, 0.01, SURE)
    with PoseClient(server.address) as client:  # type: ignore[attr-defined]
        found = [client.detect("pinhole", pixels, K).results[0] for pixels in (sure, unsure)]
        spec = client.get_model("pinhole").spec
    assert found[0].detections[0].interval.rotation_deg in (30.0, 7.5)
    assert found[1].status == messages.REGION_STATUS_UNSURE
    assert spec.reliability.objects[0].min_confidence == SURE


def test_json_lines_say_it(measured: Path, spot_image: Spot, tmp_path: Path) -> None:
    frames, camera, out = tmp_path / "frames", tmp_path / "camera.json", tmp_path / "out.jsonl"
    frames.mkdir()
    camera.write_text(json.dumps({"camera_matrix": K.tolist(), "width": 320, "height": 240}))
    for name, pixels in (
        ("0.png", _frame(spot_image, 14)),
        ("1.png", _of_confidence(measured, spot_image, 0.01, SURE)),
    ):
        cv2.imwrite(str(frames / name), pixels[..., ::-1])
    assert run(DetectArguments(str(measured), (str(frames),), camera=camera, out=str(out))) == 0
    sure, unsure = (json.loads(line)["detections"][0] for line in out.read_text().splitlines())
    assert sure["status"] == "sure"
    assert sorted(sure["interval"]) == ["depth_m", "lateral_m", "level", "rotation_deg"]
    assert unsure["status"] == "unsure"
    assert "interval" not in unsure


def test_a_calibrated_confidence_is_answered_and_judged(
    measured: Path, start_server: Callable[..., object], spot_image: Spot
) -> None:
    """What a server answers went through the calibration; the network's outputs, which KServe gives, did not."""
    pixels = _of_confidence(measured, spot_image, 0.1, 0.9)
    before = _detect(measured, pixels).detections[0].confidence
    _put(measured, RELIABILITY | {"calibration": [0.5, -1.0]})
    expected = 1 / (1 + np.exp(-(0.5 * np.log(before / (1 - before)) - 1.0)))
    server = start_server(measured.parent)
    with PoseClient(server.address) as client:  # type: ignore[attr-defined]
        (result,) = client.detect("pinhole", pixels, K).results
    assert result.detections[0].confidence == pytest.approx(expected, abs=1e-5)
    is_sure = result.detections[0].status == messages.DETECTION_STATUS_SURE
    assert is_sure == (expected >= SURE)
    assert not _detect(measured, pixels, min_confidence=float(expected) + 0.01).detections
    assert open_model(measured).run(_canonical(measured, pixels))["confidence"][0, 0] == pytest.approx(before, abs=1e-5)


def _canonical(folder: Path, pixels: np.ndarray) -> np.ndarray:
    """The frame as the network's own camera takes it, [1, height, width, 3]."""
    height, width = pixels.shape[:2]
    frame = PinholeFrame(pixels, PinholeCamera(K), open_model(folder).camera, 1)
    return frame.crop(Region(0, 0, width, height)).image[None]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"calibration": [0.0, 1.0]}, "impossible values"),
        ({"calibration": [1.0]}, "impossible values"),
        ({"calibration": [1.0, "NaN"]}, "impossible values"),
        ({"level": 1.5}, "impossible values"),
        ({"objects": [OF_SPOT | {"object": "cone"}]}, r"is about \['cone'\], the model finds \['spot'\]"),
        ({"objects": [OF_SPOT | {"bounds": BOUNDS[::-1]}]}, "impossible values"),
        ({"objects": [OF_SPOT | {"bounds": [BOUNDS[0] | {"lateral_m": 0.0}]}]}, "impossible values"),
        ({"objects": [OF_SPOT | {"min_confidence": "NaN"}]}, "impossible values"),
        ({"objects": 3}, "is not what curio-export --intervals writes"),
    ],
)
def test_a_file_that_cannot_be_is_refused(measured: Path, changes: dict[str, object], told: str) -> None:
    _put(measured, RELIABILITY | changes)
    with pytest.raises(ModelError, match=told):
        open_model(measured)
