"""Several instances of an object from a network that reads one: in process, on the command line, over gRPC."""

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
from curio_proto.v1.model_spec_pb2 import ModelSpec
from curio_serve.batch.arguments import DetectArguments
from curio_serve.batch.detect_cli import run
from curio_serve.client import PoseClient
from curio_serve.errors import ArgumentError, UsageError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.models.detector import Detector
from curio_serve.models.model_folder import open_model
from google.protobuf import json_format
from onnx import TensorProto, helper, numpy_helper

K = np.array([[110.0, 0, 50.0], [0, 112.0, 30.0], [0, 0, 1]])
BRIGHT, DIM, DARK = 255, 160, 30
_OF_OBJECT = {"rotation": (1, 1), "rotation_6d": (1,), "color": (1,)}


@pytest.fixture(scope="module")
def seeking(
    tmp_path_factory: pytest.TempPathFactory,
    spot_spec: Callable[[bool], ModelSpec],
    write_folder: Callable[..., Path],
) -> Path:
    """A model that finds the brightest pixel alone, 1 m away, as confident as it is bright."""
    rays = np.stack(
        [(np.arange(96)[None] - 50) / 110 + np.zeros((64, 1)), (np.arange(64)[:, None] - 30) / 112 + np.zeros((1, 96))]
    )
    table = np.concatenate([rays, np.ones((1, 64, 96))]).reshape(3, -1).T
    node = helper.make_node
    constants = {
        "channel": np.array([3]),
        "flat": np.array([-1, 64 * 96]),
        "one": np.array([1]),
        "table": table.astype(np.float32),
        "full": np.float32(255),
        "none": np.float32(0),
        "as_matrix": np.array([-1, 1, 1, 1]),
        "as_slot": np.array([-1, 1, 1]),
        "as_row": np.array([-1, 1]),
        "rotation_value": np.eye(3, dtype=np.float32)[None, None],
        "rotation_6d_value": np.eye(3, dtype=np.float32)[:, :2].T.reshape(1, 1, 6),
        "light_value": np.array([[0, -1, 0]], np.float32),
        "color_value": np.ones((1, 1, 3), np.float32),
    }
    nodes = [
        node("Cast", ["image"], ["float"], to=TensorProto.FLOAT),
        node("ReduceMax", ["float", "channel"], ["grey"], keepdims=0),
        node("Reshape", ["grey", "flat"], ["row"]),
        node("ArgMax", ["row"], ["place"], axis=1, keepdims=1),
        node("Gather", ["table", "place"], ["translation_m"]),
        node("ReduceMax", ["row", "one"], ["brightest"], keepdims=1),
        node("Div", ["brightest", "full"], ["confidence"]),
        node("Mul", ["confidence", "none"], ["nothing"]),
    ]
    outputs = {"rotation": "as_matrix", "rotation_6d": "as_slot", "light": "as_row", "color": "as_slot"}
    for name, shape in outputs.items():
        nodes += [
            node("Reshape", ["nothing", shape], [f"{name}_nothing"]),
            node("Add", [f"{name}_nothing", f"{name}_value"], [name]),
        ]
    sizes = {
        "translation_m": [1, 3],
        "color": [1, 3],
        "confidence": [1],
        "rotation_6d": [1, 6],
        "rotation": [1, 3, 3],
        "light": [3],
    }
    graph = helper.make_graph(
        nodes,
        "seeking",
        [helper.make_tensor_value_info("image", TensorProto.UINT8, ["b", 64, 96, 3])],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["b", *size]) for name, size in sizes.items()],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    spec = spot_spec(True)
    spec.name = "seeking"
    model.metadata_props.add(key="curio.model_spec").value = json_format.MessageToJson(spec)
    onnx.checker.check_model(model)
    return write_folder(tmp_path_factory.mktemp("seeking") / "models" / "seeking", model)


@pytest.fixture(scope="module")
def seeking_two(
    tmp_path_factory: pytest.TempPathFactory,
    spot_spec: Callable[[bool], ModelSpec],
    write_folder: Callable[..., Path],
) -> Path:
    """A model that finds the reddest pixel, a "poppy", and the greenest, a "leaf", 1 m away."""
    columns, rows = np.meshgrid(np.arange(96), np.arange(64))
    table = np.stack([(columns - 50) / 110, (rows - 30) / 112, np.ones(rows.shape)], axis=-1).reshape(-1, 3)
    spec = spot_spec(True)
    spec.name, spec.num_slots = "seeking", 2
    spec.objects.add().CopyFrom(spec.objects[0])
    for slot, name in enumerate(("poppy", "leaf")):
        spec.objects[slot].name, spec.objects[slot].slots[:] = name, [slot]
    node = helper.make_node
    constants = {
        "flat": np.array([-1, 64 * 96, 3]),
        "colors": np.array([0, 1]),
        "pixels": np.array([2]),
        "table": table.astype(np.float32),
        "full": np.float32(255),
        "none": np.float32(0),
        "scene": np.array([0]),
        "scene_end": np.array([1]),
        "axis": np.array([1]),
        **{f"{name}_shape": np.array([-1, 2, *shape]) for name, shape in _OF_OBJECT.items()},
        "rotation_value": np.tile(np.eye(3, dtype=np.float32), (1, 2, 1, 1)),
        "rotation_6d_value": np.tile(np.eye(3, dtype=np.float32)[:, :2].T.reshape(6), (1, 2, 1)),
        "color_value": np.ones((1, 2, 3), np.float32),
        "light_value": np.array([[0, -1, 0]], np.float32),
    }
    nodes = [
        node("Cast", ["image"], ["float"], to=TensorProto.FLOAT),
        node("Reshape", ["float", "flat"], ["rows"]),
        node("Transpose", ["rows"], ["by_color"], perm=[0, 2, 1]),
        node("Gather", ["by_color", "colors"], ["seen"], axis=1),
        node("ArgMax", ["seen"], ["place"], axis=2, keepdims=0),
        node("Gather", ["table", "place"], ["translation_m"]),
        node("ReduceMax", ["seen", "pixels"], ["brightest"], keepdims=0),
        node("Div", ["brightest", "full"], ["confidence"]),
        node("Mul", ["confidence", "none"], ["nothing"]),
        node("Slice", ["nothing", "scene", "scene_end", "axis"], ["of_scene"]),
        node("Add", ["of_scene", "light_value"], ["light"]),
    ]
    for name in _OF_OBJECT:
        nodes += [
            node("Reshape", ["nothing", f"{name}_shape"], [f"{name}_nothing"]),
            node("Add", [f"{name}_nothing", f"{name}_value"], [name]),
        ]
    sizes = {"translation_m": [2, 3], "color": [2, 3], "confidence": [2], "rotation_6d": [2, 6], "rotation": [2, 3, 3]}
    graph = helper.make_graph(
        nodes,
        "seeking",
        [helper.make_tensor_value_info("image", TensorProto.UINT8, ["b", 64, 96, 3])],
        [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, ["b", *size])
            for name, size in (sizes | {"light": [3]}).items()
        ],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    model.metadata_props.add(key="curio.model_spec").value = json_format.MessageToJson(spec)
    onnx.checker.check_model(model)
    return write_folder(tmp_path_factory.mktemp("seeking-two") / "models" / "seeking", model)


def frame(*spots: tuple[int, int, int]) -> np.ndarray:
    """Black with squares (x, y, brightness) smaller than the box of the object."""
    pixels = np.zeros((64, 96, 3), np.uint8)
    for x, y, brightness in spots:
        pixels[y - 3 : y + 4, x - 3 : x + 4] = brightness
        pixels[y, x] = brightness  # the first brightest pixel is the corner's
    return pixels


def found(model: Path, pixels: np.ndarray, **settings: Any) -> list[tuple[float, float, float]]:
    """(x, y, confidence) of each instance, in pixels."""
    (result,) = Detector(open_model(model)).detect(pixels, PinholeCamera(K), **settings)
    seen = [K @ np.array(detection.translation_m) for detection in result.detections]
    return [(u, v, d.confidence) for (u, v, _), d in zip(seen, result.detections, strict=True)]


TWO = frame((20, 20, DIM), (70, 40, BRIGHT))


def test_the_likelier_instance_comes_first(seeking: Path) -> None:
    first, second = found(seeking, TWO, max_instances=4)
    assert first == pytest.approx((67, 37, 1.0), abs=0.01)
    assert second == pytest.approx((17, 17, DIM / 255), abs=0.01)


@pytest.mark.parametrize(
    ("settings", "count"),
    [
        ({}, 1),
        ({"max_instances": 1}, 1),
        ({"max_instances": 2}, 2),
        ({"max_instances": 16}, 3),
        ({"max_instances": 16, "max_detections": 2}, 2),
        ({"max_instances": 16, "min_confidence": 0.9}, 2),
    ],
)
def test_there_are_as_many_as_asked_for_and_seen(seeking: Path, settings: dict[str, Any], count: int) -> None:
    """The fourth is too dark to be believed."""
    spots = frame((15, 15, BRIGHT), (75, 15, DIM), (15, 48, 250), (75, 48, DARK))
    assert len(found(seeking, spots, **settings)) == count


def test_an_empty_frame_has_the_one_unlikely_answer(seeking: Path) -> None:
    assert [confidence for *_, confidence in found(seeking, frame(), max_instances=3)] == [0.0]


def test_instances_of_every_kind_are_found(seeking_two: Path) -> None:
    pixels = frame((15, 15, BRIGHT), (75, 15, DIM)) * np.uint8([1, 0, 0])
    pixels += frame((15, 48, 250)) * np.uint8([0, 1, 0])
    detector = Detector(open_model(seeking_two))

    def kinds(**settings: Any) -> list[tuple[str, int]]:
        (result,) = detector.detect(pixels, PinholeCamera(K), **settings)
        return [(one.object, round(255 * one.confidence)) for one in result.detections]

    assert kinds() == [("poppy", BRIGHT), ("leaf", 250)]
    assert kinds(max_instances=1) == kinds()
    assert kinds(max_instances=4) == [("poppy", BRIGHT), ("leaf", 250), ("poppy", DIM)]
    detector = Detector(open_model(seeking_two).of(["poppy"]))
    assert kinds(max_instances=4) == [("poppy", BRIGHT), ("poppy", DIM)]


def test_each_region_is_searched_by_itself(seeking: Path) -> None:
    """Regions set the direction of a crop alone, so both see both."""
    detector = Detector(open_model(seeking))
    regions = [(0, 0, 96, 64), (10, 10, 60, 40)]
    from curio_serve.imaging.view import Region

    results = detector.detect(TWO, PinholeCamera(K), regions=[Region(*r) for r in regions], max_instances=2)
    assert [len(result.detections) for result in results] == [2, 2]


def test_the_frame_is_left_as_it_was(seeking: Path) -> None:
    pixels = TWO.copy()
    found(seeking, pixels, max_instances=3)
    np.testing.assert_array_equal(pixels, TWO)


@pytest.mark.parametrize("number", [0, 17])
def test_impossible_numbers_are_refused(seeking: Path, number: int) -> None:
    with pytest.raises(ArgumentError, match=f"max_instances is {number}; expected 1 to 16"):
        found(seeking, TWO, max_instances=number)


def test_a_flat_world_has_no_instances(models_dir: Path) -> None:
    with pytest.raises(ArgumentError, match="is of a flat world"):
        Detector(open_model(models_dir / "flat")).detect(TWO, None, max_instances=2)


def detect(model: Path, folder: Path, **flags: Any) -> list[dict[str, Any]]:
    cv2.imwrite(str(folder / "frame.png"), TWO)
    (folder / "camera.json").write_text(json.dumps({"camera_matrix": K.tolist(), "width": 96, "height": 64}))
    out = folder / "out.jsonl"
    images = (str(folder / "frame.png"),)
    run(DetectArguments(str(model), images, camera=folder / "camera.json", out=str(out), **flags))
    return json.loads(out.read_text())["detections"]


def test_the_command_writes_all_of_them(seeking: Path, tmp_path: Path) -> None:
    detections = detect(seeking, tmp_path, max_instances=3)
    assert [round(one["confidence"], 2) for one in detections] == [1.0, round(DIM / 255, 2)]


@pytest.mark.parametrize(
    ("flags", "told"),
    [
        ({"max_instances": 0}, "expected 1 to 16"),
        ({"max_instances": 2, "track": True}, "leave out --max-detections, --max-instances and --reads"),
    ],
)
def test_the_command_refuses(seeking: Path, tmp_path: Path, flags: dict[str, Any], told: str) -> None:
    with pytest.raises(UsageError, match=re.escape(told)):
        detect(seeking, tmp_path, **flags)


@pytest.fixture(scope="module")
def client(seeking: Path, start_server: Callable[..., Any]) -> Iterator[PoseClient]:
    with PoseClient(start_server(seeking.parent).address) as client:
        yield client


def test_the_server_answers_all_of_them(client: PoseClient) -> None:
    answer = client.detect("seeking", TWO, K, max_instances=3)
    assert len(answer.results[0].detections) == 2
    assert len(client.detect("seeking", TWO, K).results[0].detections) == 1


def test_the_server_bounds_the_runs(client: PoseClient) -> None:
    with pytest.raises(ArgumentError, match="1 models times 32 regions times 4 instances are 128 runs"):
        client.detect("seeking", TWO, K, regions=[(0, 0, 96, 64)] * 32, max_instances=4)
