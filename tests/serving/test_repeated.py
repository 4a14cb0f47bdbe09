"""Several reads of an image through virtual cameras: those that agree are averaged, others are outvoted."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from curio_proto.v1.detector_pb2 import Tracking
from curio_proto.v1.model_spec_pb2 import CanonicalCamera, Field, ModelSpec, ObjectModel, Symmetry
from curio_serve.batch.arguments import DetectArguments
from curio_serve.batch.detect_cli import run
from curio_serve.client import PoseClient, detect_request, error_from_answer
from curio_serve.client.request import views_request
from curio_serve.errors import ArgumentError, UsageError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.rotation import from_rotation_vector
from curio_serve.imaging.virtual_cameras import VIRTUAL_CAMERAS, VirtualCamera
from curio_serve.models.detector import Detector
from curio_serve.models.model_folder import open_model
from curio_serve.models.repeated import AGREEMENT_POWER, RepeatedReader

K = np.array([[110.0, 0, 50.0], [0, 112.0, 30.0], [0, 0, 1]])
POSITION_M = np.array([0.06, -0.03, 0.8])
ROTATION = from_rotation_vector(np.array([0.4, -0.9, 0.3]))


def spec(*symmetries: Symmetry, slots: tuple[int, ...] = (0,)) -> ModelSpec:
    fields = [Field(name=name, size=size, per_object=True) for name, size in (("translation_m", 3), ("rotation_6d", 6))]
    kind = ObjectModel(name="thing", diameter_m=0.1, slots=slots, symmetries=symmetries)
    camera = CanonicalCamera(width=96, height=64, camera_matrix=K.ravel())
    return ModelSpec(name="thing", num_slots=len(slots), fields=fields, objects=[kind], camera=camera)


def seen_by(virtual: VirtualCamera, rotation: np.ndarray, position_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A pose as a network that knows K alone reads it through a virtual camera: nearer by the zoom."""
    position_m = virtual.virtual_from_cam @ position_m
    return virtual.virtual_from_cam @ rotation, position_m / [1, 1, virtual.zoom]


@pytest.mark.parametrize("virtual", VIRTUAL_CAMERAS)
def test_an_image_is_what_its_virtual_camera_sees(virtual: VirtualCamera) -> None:
    u, v, w = K @ POSITION_M
    pixels = np.zeros((64, 96, 3), np.uint8)
    x, y = round(u / w), round(v / w)
    pixels[y - 1 : y + 2, x - 1 : x + 2] = 255
    ray = np.linalg.inv(K) @ [x, y, 1.0]
    expected = K @ np.diag([virtual.zoom, virtual.zoom, 1]) @ virtual.virtual_from_cam @ ray
    weight = virtual.image(pixels, K)[..., 0].astype(float)
    rows, columns = np.mgrid[:64, :96]
    center = (weight * columns).sum() / weight.sum(), (weight * rows).sum() / weight.sum()
    assert center == pytest.approx(expected[:2] / expected[2], abs=0.1)


@pytest.mark.parametrize("virtual", VIRTUAL_CAMERAS)
def test_a_pose_of_a_virtual_camera_is_brought_back(virtual: VirtualCamera) -> None:
    rotation, position_m = virtual.back(*seen_by(virtual, ROTATION, POSITION_M))
    np.testing.assert_allclose(position_m, POSITION_M, atol=1e-9)
    tolerance = 1e-9 if virtual.zoom == 1 else 0.01  # the ray that a zoomed image shows the object on is another
    np.testing.assert_allclose(rotation, ROTATION, atol=tolerance)


def reader(num_reads: int, *wrong: tuple[int, np.ndarray, float], kind: ModelSpec | None = None) -> RepeatedReader:
    """Of a network that reads one pose, but others through some cameras: (its number, turn, confidence)."""
    count, by_number = iter(range(num_reads)), {number: (turn, sure) for number, turn, sure in wrong}

    def read(images: np.ndarray) -> dict[str, np.ndarray]:
        number = next(count)
        turn, confidence = by_number.get(number, (np.eye(3), 0.6))
        rotation, position_m = seen_by(VIRTUAL_CAMERAS[number], ROTATION @ turn, POSITION_M)
        values = {
            "translation_m": position_m,
            "rotation": rotation,
            "rotation_6d": rotation.T[:2].ravel(),
            "confidence": confidence,
        }
        light = VIRTUAL_CAMERAS[number].virtual_from_cam @ [0.0, -1.0, 0.0]
        found = {name: np.array(value, np.float32)[None, None] for name, value in values.items()}
        return {**found, "light": np.array([light], np.float32)}

    return RepeatedReader(kind or spec(), read, num_reads)


IMAGE = np.zeros((1, 64, 96, 3), np.uint8)


def test_reads_that_agree_are_averaged() -> None:
    found = reader(9)(IMAGE)
    assert {name: value.shape for name, value in found.items()} == {
        "translation_m": (1, 1, 3),
        "rotation": (1, 1, 3, 3),
        "rotation_6d": (1, 1, 6),
        "confidence": (1, 1),
        "light": (1, 3),
    }
    np.testing.assert_allclose(found["translation_m"][0, 0], POSITION_M, atol=1e-6)
    np.testing.assert_allclose(found["rotation"][0, 0], ROTATION, atol=5e-3)
    np.testing.assert_allclose(found["rotation_6d"][0, 0], found["rotation"][0, 0].T[:2].ravel(), atol=1e-6)
    np.testing.assert_allclose(found["light"][0], [0, -1, 0], atol=1e-6)
    assert found["confidence"][0, 0] == pytest.approx(0.6**AGREEMENT_POWER)


def test_the_surest_read_is_outvoted_by_two_that_agree() -> None:
    turn = from_rotation_vector(np.array([0, 2.0, 0]))
    found = reader(3, (0, turn, 0.9))(IMAGE)
    np.testing.assert_allclose(found["rotation"][0, 0], ROTATION, atol=1e-6)
    assert found["confidence"][0, 0] == pytest.approx(((0.6 + 0.6) / 3) ** AGREEMENT_POWER)


def test_symmetric_poses_agree() -> None:
    half = np.diag([-1.0, -1.0, 1.0])
    matrix = np.eye(4)
    matrix[:3, :3] = half
    wrong = (1, half, 0.6)
    alike = reader(3, wrong, kind=spec(Symmetry(transform=matrix.ravel())))(IMAGE)
    assert alike["confidence"][0, 0] == pytest.approx(0.6**AGREEMENT_POWER)
    assert reader(3, wrong)(IMAGE)["confidence"][0, 0] == pytest.approx(0.4**AGREEMENT_POWER)


def test_reads_of_a_ball_agree_however_it_is_turned() -> None:
    turned = [(number, from_rotation_vector(np.array([0.9 * number, 2.0 - number, 0.4])), 0.6) for number in (1, 2)]
    ball = spec(Symmetry(axis=[0.0, 0.6, 0.8], offset_m=[0.0] * 3), Symmetry(axis=[1.0, 0, 0], offset_m=[0.0] * 3))
    found = reader(3, *turned, kind=ball)(IMAGE)
    assert found["confidence"][0, 0] == pytest.approx(0.6**AGREEMENT_POWER)
    np.testing.assert_allclose(found["translation_m"][0, 0], POSITION_M, atol=1e-6)
    np.testing.assert_allclose(found["rotation"][0, 0], np.eye(3), atol=1e-6)
    assert reader(3, *turned)(IMAGE)["confidence"][0, 0] < 0.4


@pytest.mark.parametrize(("num_reads", "kind"), [(0, spec()), (10, spec()), (3, spec(slots=(0, 1))), (3, ModelSpec())])
def test_what_cannot_be_read_again_is_refused(num_reads: int, kind: ModelSpec) -> None:
    with pytest.raises(ArgumentError, match=r"expected 1 to 9|can read an image only once"):
        RepeatedReader(kind, lambda images: {}, num_reads)


@pytest.fixture
def spot(tmp_path: Path, spot_image: Callable[..., np.ndarray]) -> Path:
    path = tmp_path / "spot.png"
    cv2.imwrite(str(path), spot_image(96, 64, 60, 35, 3.0, 3.0, (255, 255, 255)))
    return path


def test_the_command_reads_an_image_as_often_as_it_is_told(spot: Path, models_dir: Path, tmp_path: Path) -> None:
    lines = []
    for reads in (1, 9):
        out = tmp_path / f"{reads}.jsonl"
        camera = tmp_path / "camera.json"
        camera.write_text(json.dumps({"camera_matrix": K.ravel().tolist(), "width": 96, "height": 64}))
        arguments = DetectArguments(str(models_dir / "pinhole"), (str(spot),), camera=camera, out=str(out), reads=reads)
        assert run(arguments) == 0
        lines.append(json.loads(out.read_text()))
    once, often = (line["detections"][0]["translation_m"] for line in lines)
    assert often != once
    np.testing.assert_allclose(often, once, rtol=0.02)


@pytest.mark.parametrize(
    ("model", "flags", "told"),
    [
        ("pinhole", {"reads": 0}, "--reads 0: expected 1 to 9"),
        ("pinhole", {"reads": 10}, "--reads 10"),
        ("pinhole", {"reads": 3, "track": True}, "--max-instances and --reads"),
        ("flat", {"reads": 3}, "--reads: reads is 3, but model flat can read an image only once"),
    ],
)
def test_wrong_calls_say_what_to_leave_out(
    spot: Path, models_dir: Path, model: str, flags: dict[str, Any], told: str
) -> None:
    with pytest.raises(UsageError, match=told):
        run(DetectArguments(str(models_dir / model), (str(spot),), **flags))


@pytest.fixture(scope="module")
def client(models_dir: Path, start_server: Callable[..., Any]) -> Iterator[PoseClient]:
    with PoseClient(start_server(models_dir).address) as client:
        yield client


def test_the_server_answers_as_the_command_does(client: PoseClient, models_dir: Path, spot: Path) -> None:
    pixels = np.ascontiguousarray(cv2.imread(str(spot))[..., ::-1])
    (here,) = Detector(open_model(models_dir / "pinhole"), 9).detect(pixels, PinholeCamera(K))
    (there,) = client.detect("pinhole", pixels, K, reads=9).results
    np.testing.assert_allclose(there.detections[0].translation_m, here.detections[0].translation_m, rtol=1e-6)
    (once,) = client.detect("pinhole", pixels, K).results
    assert list(once.detections[0].translation_m) != list(there.detections[0].translation_m)


@pytest.mark.parametrize(
    ("model", "options", "told"),
    [
        ("pinhole", {"reads": 0}, "reads is 0; expected 1 to 9"),
        ("pinhole", {"reads": 10}, "reads is 10; expected 1 to 9"),
        ("pinhole", {"reads": 8, "regions": [(0, 0, 96, 64)] * 9}, "times 9 regions times 8 reads are 72 runs"),
        ("flat", {"reads": 2}, "model flat can read an image only once"),
    ],
)
def test_the_server_refuses(client: PoseClient, model: str, options: dict[str, Any], told: str) -> None:
    with pytest.raises(ArgumentError, match=told):
        client.detect(model, IMAGE[0], K if model == "pinhole" else None, **options)


def test_following_and_rigs_read_once(client: PoseClient) -> None:
    following = detect_request("pinhole", IMAGE[0], K, reads=2, track=Tracking(num_objects=1))
    views = views_request("pinhole", [(IMAGE[0], K, np.eye(4)), (IMAGE[0], K, np.eye(4))])
    views.reads = 2
    told = [str(error_from_answer(answer)) for answer in client.detect_stream([following, views], timeout_s=30)]
    assert "reads are not for following" in told[0]
    assert "the request has views and reads" in told[1]
