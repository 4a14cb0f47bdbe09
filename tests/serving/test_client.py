"""The client against our server, and against one that fails as it is told."""

import asyncio
import math
import subprocess
import time
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent import futures
from pathlib import Path
from typing import Any

import cv2
import grpc
import numpy as np
import pytest
from curio_proto.v1 import detector_pb2 as messages
from curio_proto.v1.detector_pb2_grpc import PoseDetectorServicer, add_PoseDetectorServicer_to_server
from curio_serve import errors
from curio_serve.api.status import status_from_error
from curio_serve.client import AsyncPoseClient, PoseClient, Tls, detect_request, error_from_answer
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.models.detector import Detector
from curio_serve.models.model_folder import open_model

K = np.array([[300.0, 0, 160.0], [0, 301.0, 119.0], [0, 0, 1]])
CAMERA = PinholeCamera(K, (), (320, 240))


@pytest.fixture(scope="module")
def client(server: Any) -> Iterator[PoseClient]:
    with PoseClient(server.address) as found:
        yield found


@pytest.fixture
def pixels(spot_image: Callable[..., np.ndarray]) -> np.ndarray:
    return spot_image(320, 240, 140, 110, 12, 12, (255, 128, 0))


@pytest.fixture
def png(pixels: np.ndarray, tmp_path: Path) -> Path:
    path = tmp_path / "000003.png"
    cv2.imwrite(str(path), pixels[..., ::-1])
    return path


def test_the_server_finds_what_the_detector_finds(models_dir: Path, client: PoseClient, pixels: np.ndarray) -> None:
    (here,) = Detector(open_model(models_dir / "pinhole")).detect(pixels, CAMERA)
    answer = client.detect("pinhole", pixels, CAMERA)
    assert list(answer.results) == [here]
    assert (answer.width, answer.height) == (320, 240)


def test_a_path_bytes_and_pixels_are_the_same_image(client: PoseClient, png: Path, pixels: np.ndarray) -> None:
    answers = [client.detect("flat", image).results for image in (str(png), png, png.read_bytes(), pixels)]
    assert all(answer == answers[0] for answer in answers)
    sliced = np.dstack([pixels, pixels])[:, ::1, :3]  # not contiguous
    assert client.detect("flat", sliced).results == answers[0]


def test_grey_pixels(client: PoseClient, pixels: np.ndarray) -> None:
    grey = pixels[..., 0]
    assert client.detect("flat", grey).results == client.detect("flat", np.dstack([grey] * 3)).results


def test_a_file_a_camera_and_a_matrix_are_the_same_k(client: PoseClient, png: Path, tmp_path: Path) -> None:
    (tmp_path / "camera.json").write_text(f'{{"camera_matrix": {K.tolist()}}}')
    (tmp_path / "scene_camera.json").write_text(f'{{"3": {{"cam_K": {K.ravel().tolist()}}}}}')
    cameras = (str(tmp_path / "camera.json"), tmp_path / "scene_camera.json", CAMERA, K, K.tolist())
    answers = [client.detect("pinhole", png, camera=camera).results for camera in cameras]
    assert all(answer == answers[0] for answer in answers)


def test_a_camera_file_of_another_size_is_refused(client: PoseClient, png: Path, tmp_path: Path) -> None:
    file = tmp_path / "camera.json"
    file.write_text(f'{{"camera_matrix": {K.tolist()}, "width": 640, "height": 480}}')
    for image in (png, png.read_bytes(), np.zeros((240, 320, 3), np.uint8)):
        with pytest.raises(errors.CameraError, match="640x480, this one has 320x240"):
            client.detect("pinhole", image, camera=file)
    request = detect_request("pinhole", png, K)  # another client may not check it: then the server does
    request.camera.width, request.camera.height = 640, 480
    (answer,) = client.detect_stream([request], timeout_s=30)
    assert "640x480, this one has 320x240" in answer.error.message


def test_pixels_in_the_order_of_opencv(client: PoseClient, pixels: np.ndarray) -> None:
    assert client.detect("flat", pixels[..., ::-1], color="bgr").results == client.detect("flat", pixels).results
    with pytest.raises(errors.ArgumentError, match="expected rgb or bgr"):
        client.detect("flat", pixels, color="hsv")  # type: ignore[arg-type]


def test_regions_models_and_thresholds(client: PoseClient, png: Path) -> None:
    answer = client.detect("flat/1", png, regions=[(0, 0, 320, 240), (100, 60, 96, 64)], request_id="seven")
    assert [(r.model_version, r.region) for r in answer.results] == [(1, 0), (1, 1)]
    with pytest.raises(errors.ArgumentError, match="more than once"):
        client.detect(["flat", "flat/1"], png)
    assert answer.request_id == "seven"
    black = np.zeros((240, 320, 3), np.uint8)
    assert len(client.detect("flat", black).results[0].detections) == 1
    assert client.detect("flat", black, min_confidence=0.5).results[0].status == messages.REGION_STATUS_NO_OBJECT


def test_what_is_loaded(client: PoseClient) -> None:
    assert [m.name for m in client.list_models()] == ["flat", "pinhole"]
    assert client.get_model("flat").spec.world == "spots"
    assert client.get_model("flat/1").version == 1


def test_a_call_or_a_stream_may_have_no_deadline(client: PoseClient, png: Path) -> None:
    request = detect_request("flat", png)
    assert client.detect("flat", png, timeout_s=math.inf).width == 320
    assert [answer.width for answer in client.detect_stream([request], timeout_s=math.inf)] == [320]


def test_a_token_is_text_in_one_line(server) -> None:
    with PoseClient(server.address, token="read from a file\n") as client:
        assert client.list_models()
    for token in ("two\nlines", "sésame"):
        with pytest.raises(errors.UsageError, match="printable ASCII"):
            PoseClient(server.address, token=token)


def test_a_stream_answers_in_order_with_ids(client: PoseClient, png: Path) -> None:
    requests = (detect_request("flat", png, request_id=str(n)) for n in range(20))
    assert [a.request_id for a in client.detect_stream(requests, timeout_s=30)] == [str(n) for n in range(20)]
    mixed = [detect_request("none", png), detect_request("pinhole", png), detect_request("flat", png)]
    found = [error_from_answer(answer) for answer in client.detect_stream(mixed, timeout_s=30)]
    assert [type(error) for error in found] == [errors.ModelNotFound, errors.CameraMissing, type(None)]
    endless = (detect_request("flat", png) for _ in iter(int, 1))
    assert next(client.detect_stream(endless, timeout_s=30)).width == 320


def test_what_the_requests_raise_comes_after_the_answers_to_those_before(
    client: PoseClient, server: Any, png: Path
) -> None:
    def requests() -> Iterator[messages.DetectRequest]:
        for path in (png, png, png.with_name("missing.png")):
            yield detect_request("flat", path)

    answers = client.detect_stream(requests(), timeout_s=30)
    assert [next(answers).width, next(answers).width] == [320, 320]
    with pytest.raises(errors.ImageError, match="missing"):
        next(answers)

    async def talk() -> None:
        async def each() -> AsyncIterator[messages.DetectRequest]:
            for request in requests():
                yield request

        async with AsyncPoseClient(server.address) as asynchronous:
            answers = asynchronous.detect_stream(each(), timeout_s=30)
            assert [(await anext(answers)).width, (await anext(answers)).width] == [320, 320]
            with pytest.raises(errors.ImageError, match="missing"):
                await anext(answers)

    asyncio.run(talk())


@pytest.mark.parametrize(
    ("call", "error"),
    [
        (lambda c: c.detect("none", np.zeros((20, 20, 3), np.uint8)), errors.ModelNotFound),
        (lambda c: c.detect("flat/9", np.zeros((20, 20, 3), np.uint8)), errors.ModelNotFound),
        (lambda c: c.detect("flat", b"no image"), errors.ImageError),
        (lambda c: c.detect("pinhole", np.zeros((240, 320, 3), np.uint8)), errors.CameraMissing),
        (lambda c: c.detect("pinhole", np.zeros((2400, 3200, 3), np.uint8), K), errors.CameraError),
        (lambda c: c.detect("flat", np.zeros((20, 20, 3), np.uint8), min_confidence=2), errors.ArgumentError),
        (lambda c: c.detect([], np.zeros((20, 20, 3), np.uint8)), errors.ArgumentError),
        (lambda c: c.get_model("none"), errors.ModelNotFound),
        # refused before anything is sent
        (lambda c: c.detect("flat/x", b""), errors.ArgumentError),
        (lambda c: c.detect("flat", "missing.png"), errors.ImageError),
        (lambda c: c.detect("flat", np.zeros((20, 20, 3))), errors.ImageError),
        (lambda c: c.detect("flat", b"", "missing.json"), errors.CameraError),
        (lambda c: c.detect("flat", b"", [[1, "x"]]), errors.ArgumentError),
        (lambda c: c.detect("flat", b"", regions=[(1, 2, 3)]), errors.ArgumentError),
    ],
)
def test_errors_come_back_as_what_they_were(client: PoseClient, call: Callable[[PoseClient], Any], error: type) -> None:
    with pytest.raises(error) as caught:
        call(client)
    assert type(caught.value) is error
    assert len(str(caught.value)) > 20


def test_a_message_over_the_servers_limit_is_not_repeated(start_server: Callable[..., Any], models_dir: Path) -> None:
    with PoseClient(start_server(models_dir, "--max-message-mb", "1").address) as client:
        with pytest.raises(errors.ImageError, match="smaller image"):
            client.detect("flat", np.zeros((1000, 1000, 3), np.uint8))
        assert client.detect("flat", np.zeros((100, 100, 3), np.uint8)).width == 100


def test_asynchronous_calls(server: Any, png: Path) -> None:
    async def talk() -> None:
        async def requests() -> AsyncIterator[messages.DetectRequest]:
            for number in range(5):
                yield detect_request("flat", png, request_id=str(number))

        async with AsyncPoseClient(server.address) as client:
            answers = await asyncio.gather(*(client.detect("flat", png, max_detections=1) for _ in range(8)))
            assert all(answer.results == answers[0].results for answer in answers)
            assert [m.name for m in await client.list_models()] == ["flat", "pinhole"]
            assert (await client.get_model("flat")).version == 1
            found = [answer.request_id async for answer in client.detect_stream(requests(), timeout_s=30)]
            assert found == ["0", "1", "2", "3", "4"]
            with pytest.raises(errors.CameraMissing):
                await client.detect("pinhole", png)

    asyncio.run(talk())


class Scripted(PoseDetectorServicer):
    """Answers each call with the next step of a script: an error, a pause in seconds, or (at its end) an answer."""

    def __init__(self) -> None:
        self.script: list[errors.CurioError | grpc.StatusCode | float] = []
        self.times: list[float] = []

    def Detect(self, request: messages.DetectRequest, context: grpc.ServicerContext) -> messages.DetectResponse:
        self.times.append(time.monotonic())
        step = self.script.pop(0) if self.script else 0.0
        if isinstance(step, errors.CurioError):
            context.abort_with_status(status_from_error(step))
        if isinstance(step, grpc.StatusCode):
            context.abort(step, "foreign")
        assert isinstance(step, float)
        time.sleep(step)
        return messages.DetectResponse(width=7)


@pytest.fixture
def scripted() -> Iterator[tuple[Scripted, PoseClient]]:
    servicer = Scripted()
    server = grpc.server(futures.ThreadPoolExecutor(4))
    add_PoseDetectorServicer_to_server(servicer, server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    with PoseClient(f"127.0.0.1:{port}", max_attempts=4) as client:
        yield servicer, client
    server.stop(None)


@pytest.mark.parametrize("kind", list(errors.STATUS_OF))
def test_every_exception_survives_the_way(kind: type, scripted: tuple[Scripted, PoseClient]) -> None:
    servicer, client = scripted
    servicer.script = [kind("found this, expected that")] * 4
    with pytest.raises(kind, match="found this, expected that") as caught:
        client.detect("m", b"x")
    assert type(caught.value) is kind
    assert len(servicer.times) == (4 if kind in (errors.Unavailable, errors.Overloaded) else 1)


def test_out_of_reach_and_full_are_tried_again(scripted: tuple[Scripted, PoseClient]) -> None:
    servicer, client = scripted
    servicer.script = [grpc.StatusCode.UNAVAILABLE, errors.Overloaded("full", 0.3), errors.Unavailable("draining")]
    assert client.detect("m", b"x").width == 7
    assert len(servicer.times) == 4
    assert servicer.times[2] - servicer.times[1] >= 0.3  # as long as the server asked for


def test_nothing_is_tried_after_the_deadline(scripted: tuple[Scripted, PoseClient]) -> None:
    servicer, client = scripted
    servicer.script = [errors.Overloaded("full", 60.0)]
    with pytest.raises(errors.Overloaded) as caught:
        client.detect("m", b"x", timeout_s=5)
    assert caught.value.retry_after_s == 60
    assert len(servicer.times) == 1


def test_a_slow_server_is_a_deadline_error(scripted: tuple[Scripted, PoseClient]) -> None:
    servicer, client = scripted
    servicer.script = [1.0]
    with pytest.raises(errors.DeadlineError, match="did not answer in time"):
        client.detect("m", b"x", timeout_s=0.2)


@pytest.mark.parametrize(
    ("status", "kind"),
    [
        (grpc.StatusCode.INVALID_ARGUMENT, errors.ArgumentError),
        (grpc.StatusCode.UNAUTHENTICATED, errors.TokenError),
        (grpc.StatusCode.UNIMPLEMENTED, errors.Unsupported),
        (grpc.StatusCode.UNKNOWN, errors.InternalError),
    ],
)
def test_a_foreign_status_becomes_the_nearest_exception(
    status: grpc.StatusCode, kind: type, scripted: tuple[Scripted, PoseClient]
) -> None:
    servicer, client = scripted
    servicer.script = [status]
    with pytest.raises(kind, match="foreign"):
        client.detect("m", b"x")
    assert len(servicer.times) == 1


def test_no_server_is_said_with_the_address() -> None:
    with (
        PoseClient("127.0.0.1:9", max_attempts=2) as client,
        pytest.raises(errors.Unavailable, match=r"127.0.0.1:9 .*running"),
    ):
        client.list_models()


def test_a_token_is_shown(start_server: Callable[..., Any], models_dir: Path, tmp_path: Path) -> None:
    (tmp_path / "tokens").write_text("open-sesame\n")
    guarded = start_server(models_dir, "--token-file", str(tmp_path / "tokens"))
    with PoseClient(guarded.address, token="open-sesame") as client:
        assert client.list_models()
    for token in ("", "wrong"):
        with PoseClient(guarded.address, token=token) as client, pytest.raises(errors.TokenError):
            client.list_models()


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``ca``, ``server`` and ``client``, each .pem and .key, made with openssl for a day."""
    folder = tmp_path_factory.mktemp("certificates")

    def openssl(*arguments: str) -> None:
        subprocess.run(["openssl", *arguments], cwd=folder, check=True, capture_output=True)

    key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "1")
    openssl("req", "-x509", *key, "-keyout", "ca.key", "-out", "ca.pem", "-subj", "/CN=test authority")
    for name in ("server", "client"):
        subject = ("-subj", f"/CN={name}", "-addext", "subjectAltName=IP:127.0.0.1")
        signed = ("-CA", "ca.pem", "-CAkey", "ca.key")
        openssl("req", "-x509", *key, *signed, "-keyout", f"{name}.key", "-out", f"{name}.pem", *subject)
    openssl("req", "-x509", *key, "-keyout", "other.key", "-out", "other.pem", "-subj", "/CN=someone else")
    return folder


def test_mutual_tls(start_server: Callable[..., Any], models_dir: Path, certificates: Path) -> None:
    own = ("--tls-certificate", str(certificates / "server.pem"), "--tls-key", str(certificates / "server.key"))
    ca, pem, key = (certificates / name for name in ("ca.pem", "client.pem", "client.key"))
    guarded = start_server(models_dir, *own, "--client-ca", str(ca))
    with PoseClient(guarded.address, tls=Tls(ca, pem, key)) as client:
        assert client.list_models()
    for refused in (None, Tls(ca), Tls(certificates / "other.pem", pem, key)):
        with PoseClient(guarded.address, tls=refused, max_attempts=1) as client, pytest.raises(errors.Unavailable):
            client.list_models()


def test_tls_files_are_named_where_they_are_wrong(tmp_path: Path) -> None:
    with pytest.raises(errors.UsageError, match=r"none\.pem"):
        PoseClient("127.0.0.1:1", tls=Tls(tmp_path / "none.pem"))
    with pytest.raises(errors.UsageError, match="belong together"):
        PoseClient("127.0.0.1:1", tls=Tls(None, tmp_path / "some.pem"))
