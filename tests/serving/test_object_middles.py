"""A mesh file whose origin is not the object's middle: the same answers, of another point, in every way of asking."""

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from curio_proto.v1 import detector_pb2 as messages
from curio_proto.v1.model_spec_pb2 import ModelSpec
from curio_serve.errors import ModelError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.models.detector import Detector
from curio_serve.models.model import Model, from_bytes
from curio_serve.models.spec import SPEC_KEY
from curio_serve.rigs.detect_views import RigView, detect_views
from curio_serve.tracking.stream import FollowingStream
from google.protobuf import json_format
from onnx import helper, numpy_helper

ROOT = Path(__file__).parents[2]
CENTER_M = np.array([0.12, -0.05, 0.3])
"""Of the file with the distant origin: six diameters away, mostly upwards."""


def _spec(model: onnx.ModelProto) -> ModelSpec:
    (entry,) = [entry for entry in model.metadata_props if entry.key == SPEC_KEY]
    return json_format.Parse(entry.value, ModelSpec())


def _with_spec(model: onnx.ModelProto, spec: ModelSpec) -> bytes:
    (entry,) = [entry for entry in model.metadata_props if entry.key == SPEC_KEY]
    entry.value = json_format.MessageToJson(spec, preserving_proto_field_name=True)
    return model.SerializeToString()


def _moved(model: onnx.ModelProto) -> bytes:
    """The same network for a file in which every vertex is moved by the middle, as the exporter writes it."""
    spec = _spec(model)
    (kind,) = spec.objects
    kind.center_m[:] = CENTER_M
    kind.box_corners_m[:] = (np.reshape(kind.box_corners_m, (8, 3)) + CENTER_M).ravel()
    for node in model.graph.node:
        node.output[:] = ["middle_m" if name == "translation_m" else name for name in node.output]
        node.input[:] = ["middle_m" if name == "translation_m" else name for name in node.input]
    column = numpy_helper.from_array(CENTER_M.astype(np.float32)[:, None], "center_m")
    axis = numpy_helper.from_array(np.array([3]), "last_axis")
    model.graph.initializer.extend([column, axis])
    model.graph.node.extend(
        [
            helper.make_node("MatMul", ["rotation", "center_m"], ["turned_column_m"]),
            helper.make_node("Squeeze", ["turned_column_m", "last_axis"], ["turned_m"]),
            helper.make_node("Sub", ["middle_m", "turned_m"], ["translation_m"]),
        ]
    )
    return _with_spec(model, spec)


@pytest.fixture(scope="module")
def models() -> tuple[Model, Model]:
    """The shipped ape, and the same with its origin elsewhere."""
    path = ROOT / "models" / "ape" / "2" / "model.onnx"
    data = path.read_bytes()
    return from_bytes(data, str(path)), from_bytes(_moved(onnx.load(path)), "moved")


@pytest.fixture(scope="module")
def photograph() -> tuple[PinholeCamera, np.ndarray]:
    camera = PinholeCamera(np.array(json.loads((ROOT / "samples" / "camera.json").read_text())["camera_matrix"]))
    return camera, np.ascontiguousarray(cv2.imread(str(ROOT / "samples" / "03.jpg"))[..., ::-1])


def _middle(found: messages.Detection, pose: "messages.Detection | messages.Track", center_m: np.ndarray) -> np.ndarray:
    assert found.object == "ape"
    return np.array(pose.translation_m) + np.reshape(pose.rotation, (3, 3)) @ center_m


def _assert_alike(one: messages.Detection, moved: messages.Detection) -> None:
    """The same object at the same place: only the point that the position is of differs."""
    np.testing.assert_allclose(moved.rotation, one.rotation, atol=1e-3)
    np.testing.assert_allclose(_middle(moved, moved, CENTER_M), one.translation_m, atol=1e-3)
    np.testing.assert_allclose(moved.box_px, one.box_px, atol=0.1)
    assert moved.confidence == pytest.approx(one.confidence, abs=1e-3)
    assert moved.outside_trained_range == one.outside_trained_range
    assert np.linalg.norm(np.subtract(moved.translation_m, one.translation_m)) > 0.2


@pytest.mark.parametrize("num_reads", [1, 9])
def test_a_whole_frame_is_read_alike(
    models: tuple[Model, Model], photograph: tuple[PinholeCamera, np.ndarray], num_reads: int
) -> None:
    camera, pixels = photograph
    found = []
    for model in models:
        reliability = ModelSpec().reliability
        reliability.level, bounds = 0.9, reliability.objects.add(object="ape", min_confidence=0.1).bounds
        bounds.add(min_confidence=0.1, lateral_m=0.01, depth_fraction=0.05, rotation_deg=10)
        model.spec.reliability.CopyFrom(reliability)
        results = Detector(model, num_reads).detect(pixels, camera, max_instances=2)
        model.spec.ClearField("reliability")
        found.append(results[0].detections[0])
    _assert_alike(*found)
    assert found[1].interval.depth_m == pytest.approx(found[0].interval.depth_m, rel=1e-3) != 0


def test_an_object_is_followed_alike(models: tuple[Model, Model], photograph: tuple[PinholeCamera, np.ndarray]) -> None:
    """With crops around the middle, not around the origin, which lies outside of the frame."""
    camera, pixels = photograph
    answers: list[Sequence[messages.RegionResult]] = []
    for model in models:
        results = messages.DetectResponse().results
        stream = FollowingStream()
        for number in range(20):
            frame = np.roll(pixels, number, axis=1)
            track = messages.Tracking(num_objects=2, search=number == 10)
            stream.follow(track, [Detector(model)], frame, camera, min_confidence=0.0, reduction=1, results=results)
        answers.append(results)
    for one, moved in zip(*answers, strict=True):
        _assert_alike(one.detections[0], moved.detections[0])
        first, second = one.detections[0].track, moved.detections[0].track
        np.testing.assert_allclose(_middle(moved.detections[0], second, CENTER_M), first.translation_m, atol=1e-3)
        np.testing.assert_allclose(second.velocity_m_s, first.velocity_m_s, atol=1e-3)
        np.testing.assert_allclose(second.position_std_m, first.position_std_m, atol=1e-3)


def test_several_cameras_agree_alike(models: tuple[Model, Model], photograph: tuple[PinholeCamera, np.ndarray]) -> None:
    camera, pixels = photograph
    views = [RigView(pixels, camera, np.eye(4)), RigView(np.roll(pixels, 2, axis=1), camera, np.eye(4))]
    found = []
    for model in models:
        results = messages.DetectResponse().results
        detect_views(Detector(model), views, results=results)
        found.append(results[0].detections[0])
    _assert_alike(*found)
    assert list(found[0].views) == [0, 1]


@pytest.mark.parametrize("values", [[0.1, 0.2], [0.1, 0.2, float("nan")]])
def test_a_middle_that_is_no_point_is_refused(values: list[float]) -> None:
    model = onnx.load(ROOT / "models" / "ape" / "2" / "model.onnx")
    spec = _spec(model)
    spec.objects[0].center_m[:] = values
    with pytest.raises(ModelError, match="the middle of ape is"):
        from_bytes(_with_spec(model, spec), "broken")
