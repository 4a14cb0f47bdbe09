"""The typed API on a real server: answers, refusals, and what the server says about itself."""

import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import grpc
import numpy as np
import pytest
from curio_proto.v1 import detector_pb2 as pb
from curio_proto.v1.detector_pb2_grpc import PoseDetectorStub
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.view import Region
from curio_serve.models.detector import Detector
from curio_serve.models.model_folder import open_model
from google.rpc import error_details_pb2
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import ProtoReflectionDescriptorDatabase
from grpc_status import rpc_status

K = [600.0, 0, 310.0, 0, 610.0, 250.0, 0, 0, 1]
COLOR = (255, 128, 64)
FLAT, PINHOLE = pb.ModelSelector(name="flat"), pb.ModelSelector(name="pinhole")


@pytest.fixture(scope="module")
def channel(server: Any) -> Iterator[grpc.Channel]:
    with grpc.insecure_channel(server.address) as channel:
        yield channel


@pytest.fixture(scope="module")
def stub(channel: grpc.Channel) -> PoseDetectorStub:
    return PoseDetectorStub(channel)


@pytest.fixture(scope="module")
def picture(spot_image: Callable[..., np.ndarray]) -> np.ndarray:
    return spot_image(640, 480, 340, 235, 15, 15, COLOR)


def _jpeg(rgb: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


def _raw(rgb: np.ndarray) -> pb.RawImage:
    return pb.RawImage(format=pb.PIXEL_FORMAT_RGB8, width=rgb.shape[1], height=rgb.shape[0], data=rgb.tobytes())


def test_remote_and_local_agree_exactly(stub: PoseDetectorStub, models_dir: Path, picture: np.ndarray) -> None:
    regions = [pb.Region(x=0, y=0, width=640, height=480), pb.Region(x=250, y=150, width=120, height=100)]
    request = pb.DetectRequest(
        request_id="mine", models=[PINHOLE, FLAT], raw=_raw(picture), camera=pb.Camera(camera_matrix=K), regions=regions
    )
    answer = stub.Detect(request, timeout=10)
    assert (answer.request_id, answer.width, answer.height) == ("mine", 640, 480)
    camera = PinholeCamera(np.reshape(K, (3, 3)))
    local = [
        result
        for name in ("pinhole", "flat")
        for result in Detector(open_model(models_dir / name)).detect(
            picture, camera, regions=[Region(r.x, r.y, r.width, r.height) for r in regions]
        )
    ]
    assert list(answer.results) == local
    assert [(r.model, r.region) for r in answer.results] == [("pinhole", 0), ("pinhole", 1), ("flat", 0), ("flat", 1)]
    assert answer.milliseconds.inference > 0


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
def test_encoded_frames(stub: PoseDetectorStub, picture: np.ndarray, suffix: str) -> None:
    data = cv2.imencode(suffix, picture[..., ::-1])[1].tobytes()
    answer = stub.Detect(pb.DetectRequest(models=[FLAT], encoded=data), timeout=10)
    [found] = answer.results[0].detections
    np.testing.assert_allclose(found.translation_m, [(340 - 319.5) / 640, (235 - 239.5) / 640, 0], atol=2e-3)
    assert len(answer.request_id) == 32
    assert answer.milliseconds.decode > 0


def test_thresholds(stub: PoseDetectorStub, picture: np.ndarray) -> None:
    faint = (picture * 0.02).astype(np.uint8)
    request = pb.DetectRequest(models=[FLAT], raw=_raw(faint), min_confidence=0.9)
    assert stub.Detect(request, timeout=10).results[0].status == pb.REGION_STATUS_NO_OBJECT
    request.min_confidence = 0.0
    assert stub.Detect(request, timeout=10).results[0].status == pb.REGION_STATUS_DETECTED


def _with_orientation_6(jpeg: bytes) -> bytes:
    exif = b"Exif\x00\x00MM\x00*\x00\x00\x00\x08\x00\x01\x01\x12\x00\x03\x00\x00\x00\x01\x00\x06\x00\x00\x00\x00"
    return jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + jpeg[2:]


def test_exif_rotation_turns_the_camera_too(stub: PoseDetectorStub, picture: np.ndarray) -> None:
    """The same scene, stored upright, and stored lying with EXIF orientation 6: the upright pose both times."""
    upright = PinholeCamera(np.reshape(K, (3, 3)))
    lying = upright.turned(3, 640, 480)
    turned = _with_orientation_6(_jpeg(np.ascontiguousarray(np.rot90(picture, 1))))
    requests = [
        pb.DetectRequest(models=[PINHOLE], encoded=_jpeg(picture), camera=pb.Camera(camera_matrix=K)),
        pb.DetectRequest(
            models=[PINHOLE],
            encoded=turned,
            camera=pb.Camera(camera_matrix=lying.matrix.ravel()),
            apply_exif_rotation=True,
        ),
    ]
    answers = [stub.Detect(request, timeout=10) for request in requests]
    assert [(a.width, a.height) for a in answers] == [(640, 480), (640, 480)]
    first, second = (a.results[0].detections[0].translation_m for a in answers)
    np.testing.assert_allclose(first, second, rtol=0.01, atol=1e-3)


def test_a_turned_frame_has_to_have_the_size_of_its_camera(stub: PoseDetectorStub, picture: np.ndarray) -> None:
    turned = _with_orientation_6(_jpeg(picture))
    camera = pb.Camera(camera_matrix=K, width=1280, height=960)
    for asked in (False, True):
        with pytest.raises(grpc.RpcError, match="K belongs to frames of 1280x960, this one has 640x480"):
            stub.Detect(
                pb.DetectRequest(models=[PINHOLE], encoded=turned, camera=camera, apply_exif_rotation=asked), timeout=10
            )


def test_streams_answer_in_order(stub: PoseDetectorStub, spot_image: Callable[..., np.ndarray]) -> None:
    places = [100 + 40 * i for i in range(12)]
    requests = (
        pb.DetectRequest(request_id=str(u), models=[FLAT], raw=_raw(spot_image(640, 480, u, 200, 9, 9, COLOR)))
        for u in places
    )
    answers = list(stub.DetectStream(requests, timeout=30))
    assert [a.request_id for a in answers] == [str(u) for u in places]
    found = [a.results[0].detections[0].translation_m[0] * 640 + 319.5 for a in answers]
    np.testing.assert_allclose(found, places, atol=0.5)


def test_models_are_listed_and_described(stub: PoseDetectorStub) -> None:
    answer = stub.ListModels(pb.ListModelsRequest(), timeout=10)
    assert [(m.name, list(m.versions), m.world, list(m.objects)) for m in answer.models] == [
        ("flat", [1], "spots", ["spot"]),
        ("pinhole", [1], "spots", ["spot"]),
    ]
    got = stub.GetModel(pb.GetModelRequest(model=PINHOLE), timeout=10)
    assert (got.version, got.spec.name, got.spec.camera.width) == (1, "pinhole", 96)


def _good(**changes: Any) -> pb.DetectRequest:
    values: dict[str, Any] = {"models": [PINHOLE], "camera": pb.Camera(camera_matrix=K)}
    values["raw"] = pb.RawImage(format=pb.PIXEL_FORMAT_RGB8, width=640, height=480, data=bytes(640 * 480 * 3))
    if "encoded" in changes:
        del values["raw"]
    return pb.DetectRequest(**(values | changes))


NAN = float("nan")


@pytest.mark.parametrize(
    ("request_", "status", "reason", "words"),
    [
        (_good(camera=None), "FAILED_PRECONDITION", "CameraMissing", "needs the camera matrix K"),
        (_good(camera=pb.Camera()), "INVALID_ARGUMENT", "CameraError", "has 0 values"),
        (_good(camera=pb.Camera(camera_matrix=[0.0] * 9)), "INVALID_ARGUMENT", "CameraError", "last row"),
        (_good(camera=pb.Camera(camera_matrix=[NAN] * 9)), "INVALID_ARGUMENT", "CameraError", "not finite"),
        (_good(camera=pb.Camera(camera_matrix=K, distortion=[1])), "INVALID_ARGUMENT", "CameraError", "distortion"),
        (_good(encoded=b""), "INVALID_ARGUMENT", "ImageError", "empty"),
        (_good(encoded=b"x" * 100), "INVALID_ARGUMENT", "ImageError", "not a JPEG"),
        (_good(raw=pb.RawImage(width=99, height=99)), "INVALID_ARGUMENT", "ImageError", "raw.format is 0"),
        (pb.DetectRequest(models=[FLAT]), "INVALID_ARGUMENT", "ImageError", "has no image"),
        (_good(models=[]), "INVALID_ARGUMENT", "ArgumentError", "names 0 models"),
        (_good(models=[PINHOLE] * 17), "INVALID_ARGUMENT", "ArgumentError", "names 17 models"),
        (_good(models=[pb.ModelSelector(name="no")]), "NOT_FOUND", "ModelNotFound", "loaded are"),
        (_good(models=[pb.ModelSelector(name="../flat")]), "NOT_FOUND", "ModelNotFound", "loaded are"),
        (_good(models=[pb.ModelSelector(name="flat\0")]), "NOT_FOUND", "ModelNotFound", "loaded are"),
        (_good(models=[pb.ModelSelector(name="flat", version=7)]), "NOT_FOUND", "ModelNotFound", "no version 7"),
        (_good(regions=[pb.Region(width=1, height=1)] * 65), "INVALID_ARGUMENT", "ArgumentError", "65 entries"),
        (_good(regions=[pb.Region(width=-5, height=9)]), "INVALID_ARGUMENT", "ArgumentError", r"regions\[0\]"),
        (_good(regions=[pb.Region(x=NAN, width=9, height=9)]), "INVALID_ARGUMENT", "ArgumentError", r"regions\[0\]"),
        (_good(min_confidence=NAN), "INVALID_ARGUMENT", "ArgumentError", "min_confidence"),
        (_good(max_detections=0), "INVALID_ARGUMENT", "ArgumentError", "max_detections is 0"),
        (_good(request_id="x" * 129), "INVALID_ARGUMENT", "ArgumentError", "request_id has 129"),
    ],
)
def test_refusals(stub: PoseDetectorStub, request_: pb.DetectRequest, status: str, reason: str, words: str) -> None:
    with pytest.raises(grpc.RpcError, match=words) as caught:
        stub.Detect(request_, timeout=10)
    assert caught.value.code().name == status
    rich = rpc_status.from_call(caught.value)
    info = error_details_pb2.ErrorInfo()
    assert rich.details[0].Unpack(info)
    assert (info.reason, info.domain) == (reason, "curio-pose")
    # The next good request is right.
    assert stub.Detect(_good(), timeout=10).results[0].model == "pinhole"


def test_a_bad_frame_is_answered_so_and_its_stream_goes_on(stub: PoseDetectorStub) -> None:
    no_model = pb.DetectRequest(models=[pb.ModelSelector(name="none")], encoded=b"x")
    frames = [_good(request_id="1"), _good(encoded=b"x", request_id="2"), no_model, _good(request_id="4")]
    answers = list(stub.DetectStream(iter(frames), timeout=10))
    assert [answer.request_id for answer in answers if answer.results] == ["1", "4"]
    assert not any(answer.HasField("error") for answer in answers if answer.results)
    bad, unknown = answers[1:3]
    assert (bad.request_id, bad.error.code, bad.error.reason) == ("2", 3, "ImageError")
    assert "not a JPEG, PNG or WebP image" in bad.error.message
    assert unknown.request_id
    assert (unknown.error.code, unknown.error.reason) == (5, "ModelNotFound")


def test_messages_beyond_the_limit(stub: PoseDetectorStub) -> None:
    with pytest.raises(grpc.RpcError) as caught:
        stub.Detect(_good(encoded=bytes(40 << 20)), timeout=30)
    assert caught.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
    assert stub.Detect(_good(), timeout=10).results


def test_a_deadline_that_has_passed(stub: PoseDetectorStub) -> None:
    with pytest.raises(grpc.RpcError) as caught:
        stub.Detect(_good(), timeout=1e-6)
    assert caught.value.code() is grpc.StatusCode.DEADLINE_EXCEEDED


def test_health_of_the_whole_and_of_each_model(channel: grpc.Channel) -> None:
    stub = health_pb2_grpc.HealthStub(channel)
    for name in ("", "curio.v1.PoseDetector", "inference.GRPCInferenceService", "flat", "pinhole"):
        answer = stub.Check(health_pb2.HealthCheckRequest(service=name), timeout=10)
        assert answer.status == health_pb2.HealthCheckResponse.SERVING
    with pytest.raises(grpc.RpcError) as caught:
        stub.Check(health_pb2.HealthCheckRequest(service="nothing"), timeout=10)
    assert caught.value.code() is grpc.StatusCode.NOT_FOUND


def test_reflection_lists_the_services(channel: grpc.Channel) -> None:
    database = ProtoReflectionDescriptorDatabase(channel)
    assert {
        "curio.v1.PoseDetector",
        "inference.GRPCInferenceService",
        "grpc.health.v1.Health",
        "grpc.reflection.v1alpha.ServerReflection",
    } == set(database.get_services())
    file = database.FindFileContainingSymbol("curio.v1.PoseDetector")
    assert [method.name for method in file.service[0].method] == ["Detect", "DetectStream", "ListModels", "GetModel"]


def test_metrics_count_calls_and_time_phases(server: Any, stub: PoseDetectorStub) -> None:
    def read() -> dict[str, float]:
        with urllib.request.urlopen(server.metrics_url, timeout=10) as page:
            lines = [line.rsplit(" ", 1) for line in page.read().decode().splitlines() if not line.startswith("#")]
        return {name: float(value) for name, value in lines}

    ok = 'curio_requests_total{code="OK",method="Detect"}'
    decoded = 'curio_phase_seconds_count{phase="decode"}'
    stub.Detect(_good(), timeout=10)
    before = read()
    for _ in range(3):
        stub.Detect(_good(), timeout=10)
    with pytest.raises(grpc.RpcError):
        stub.Detect(_good(models=[pb.ModelSelector(name="no")]), timeout=10)
    after = read()
    assert after[ok] - before[ok] == 3
    assert after[decoded] - before[decoded] == 3
    assert after['curio_requests_total{code="NOT_FOUND",method="Detect"}'] >= 1
    assert after["curio_models_loaded"] == 2
    assert after["curio_queue_length"] == 0


def test_the_log_tells_refusals_and_no_image_bytes(server: Any, stub: PoseDetectorStub) -> None:
    with pytest.raises(grpc.RpcError):
        stub.Detect(_good(encoded=b"SECRETPIXELS" * 10, request_id="find-me"), timeout=10)
    with pytest.raises(grpc.RpcError):
        stub.Detect(_good(models=[], request_id="and-me"), timeout=10)
    # A further call is answered after the line was queued; lines are written in order by one thread.
    for _ in range(200):
        text = server.log.read_text()
        if "and-me" in text:
            break
        stub.ListModels(pb.ListModelsRequest(), timeout=10)
    assert "find-me" in text
    assert "SECRETPIXELS" not in text
