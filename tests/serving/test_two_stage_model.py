"""A two-stage detector as it is exported: a large input that is not square, sampled by GridSample inside the graph."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import grpc
import numpy as np
import onnx
import pytest
from curio_proto.inference import inference_pb2 as inference
from curio_proto.inference.inference_pb2_grpc import GRPCInferenceServiceStub
from curio_proto.v1 import detector_pb2 as pb
from curio_proto.v1.detector_pb2_grpc import PoseDetectorStub
from curio_proto.v1.model_spec_pb2 import CanonicalCamera, Field, ModelSpec, ObjectModel
from google.protobuf import json_format
from onnx import TensorProto, helper, numpy_helper

WIDTH, HEIGHT, STRIDE = 480, 360, 4
# Off the middle, and of two focal lengths, so that a mix-up of the axes shows.
K_STAR = np.array([[430.0, 0, 244.0], [0, 440.0, 175.0], [0, 0, 1]])
FRAME_K = np.array([[600.0, 0, 322.0], [0, 590.0, 236.0], [0, 0, 1]])


def _two_stage_onnx() -> onnx.ModelProto:
    """Direction of the brightest spot, at a distance of 1 m, from an image that GridSample makes four times smaller."""
    rows, columns = HEIGHT // STRIDE, WIDTH // STRIDE
    x, y = np.meshgrid((np.arange(columns) + 0.5) * 2 / columns - 1, (np.arange(rows) + 0.5) * 2 / rows - 1)
    u, v = ((x + 1) * WIDTH - 1) / 2, ((y + 1) * HEIGHT - 1) / 2
    values = {
        "grid": np.stack([x, y], -1)[None],
        "slope_x": ((u - K_STAR[0, 2]) / K_STAR[0, 0])[None],
        "slope_y": ((v - K_STAR[1, 2]) / K_STAR[1, 1])[None],
        "tiny": np.array(1e-6),
        "zero": np.array(0.0),
        "one": np.array(1.0),
        "upright": np.eye(3)[None, None],
        "upright_6d": np.eye(3)[:, :2].T.reshape(1, 1, 6),
    }
    integers = {"plane": [2, 3], "channels": [1], "grid_shape": [1, 1, 1, 1], "as_3d": [-1, 1, 1],
                "as_4d": [-1, 1, 1, 1], "as_row": [-1, 1], "batch_axis": [0]}  # fmt: skip
    constants = [numpy_helper.from_array(value.astype(np.float32), name) for name, value in values.items()]
    constants += [numpy_helper.from_array(np.array(value), name) for name, value in integers.items()]
    constants.append(numpy_helper.from_array(np.array([rows, columns, 2]), "grid_tail"))
    node = helper.make_node
    nodes = [
        node("Cast", ["image"], ["float"], to=TensorProto.FLOAT),
        node("Transpose", ["float"], ["map"], perm=[0, 3, 1, 2]),
        node("Shape", ["map"], ["batch"], start=0, end=1),
        node("Concat", ["batch", "grid_tail"], ["grids_shape"], axis=0),
        node("Expand", ["grid", "grids_shape"], ["grids"]),
        node("GridSample", ["map", "grids"], ["small"], align_corners=0, mode="linear"),
        node("ReduceMax", ["small", "channels"], ["weight"], keepdims=1),
        node("ReduceSum", ["weight", "plane"], ["mass_only"], keepdims=0),
        node("Add", ["mass_only", "tiny"], ["mass"]),
    ]
    for axis in "xy":
        nodes += [
            node("Mul", ["weight", f"slope_{axis}"], [f"{axis}_weighted"]),
            node("ReduceSum", [f"{axis}_weighted", "plane"], [f"{axis}_sum"], keepdims=0),
            node("Div", [f"{axis}_sum", "mass"], [f"{axis}_mean"]),
            node("Reshape", [f"{axis}_mean", "as_3d"], [axis]),
        ]
    nodes += [
        node("Mul", ["x", "zero"], ["none"]),
        node("Add", ["none", "one"], ["z"]),
        node("Concat", ["x", "y", "z"], ["translation_m"], axis=2),
        node("Add", ["none", "upright_6d"], ["rotation_6d"]),
        node("Reshape", ["none", "as_4d"], ["none_4d"]),
        node("Add", ["none_4d", "upright"], ["rotation"]),
    ]
    shapes = {"translation_m": ["b", 1, 3], "rotation_6d": ["b", 1, 6], "rotation": ["b", 1, 3, 3]}
    graph = helper.make_graph(
        nodes,
        "two_stage",
        [helper.make_tensor_value_info("image", TensorProto.UINT8, ["b", HEIGHT, WIDTH, 3])],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in shapes.items()],
        constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    spec = ModelSpec(
        schema_version=1,
        name="two_stage",
        world="linemod",
        num_slots=1,
        fields=[
            Field(name="translation_m", size=3, per_object=True, unit="m", frame="camera"),
            Field(name="rotation_6d", size=6, per_object=True, unit="1", frame="camera"),
        ],
        objects=[ObjectModel(name="spot", diameter_m=0.1, slots=[0])],
        camera=CanonicalCamera(width=WIDTH, height=HEIGHT, camera_matrix=K_STAR.ravel()),
    )
    entry = model.metadata_props.add(key="curio.model_spec")
    entry.value = json_format.MessageToJson(spec)
    onnx.checker.check_model(model, full_check=True)
    return model


@pytest.fixture(scope="module")
def channel(
    start_server: Callable[..., Any], write_folder: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory
) -> Any:
    root = tmp_path_factory.mktemp("models")
    write_folder(root / "two_stage", _two_stage_onnx())  # with config.pbtxt and SHA256SUMS, which the server compares
    with grpc.insecure_channel(start_server(root).address) as channel:
        yield channel


def _detect(channel: grpc.Channel, data: bytes, regions: list[pb.Region]) -> list[np.ndarray]:
    request = pb.DetectRequest(
        models=[pb.ModelSelector(name="two_stage")],
        encoded=data,
        camera=pb.Camera(camera_matrix=FRAME_K.ravel()),
        regions=regions,
    )
    answer = PoseDetectorStub(channel).Detect(request, timeout=60)
    return [np.array(result.detections[0].translation_m) for result in answer.results]


@pytest.mark.parametrize("place", [(322, 236), (180, 120), (470, 350)])
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_frames_of_another_camera(
    channel: grpc.Channel, spot_image: Callable[..., np.ndarray], place: tuple[int, int], suffix: str
) -> None:
    """The spot is seen in its direction, on the whole frame and in a region that turns the view towards it."""
    pixels = spot_image(640, 480, *place, 6, 6, (255, 255, 255))
    data = cv2.imencode(suffix, pixels, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
    u, v = place
    towards = np.array([(u - FRAME_K[0, 2]) / FRAME_K[0, 0], (v - FRAME_K[1, 2]) / FRAME_K[1, 1], 1])
    around = pb.Region(x=u - 60, y=v - 40, width=120, height=80)
    for found in _detect(channel, data, [pb.Region(width=640, height=480), around]):
        np.testing.assert_allclose(found / found[2], towards, atol=0.004)


def test_the_same_tensor_over_kserve(channel: grpc.Channel, spot_image: Callable[..., np.ndarray]) -> None:
    stub = GRPCInferenceServiceStub(channel)
    described = stub.ModelMetadata(inference.ModelMetadataRequest(name="two_stage"), timeout=60)
    assert list(described.inputs[0].shape) == [-1, HEIGHT, WIDTH, 3]
    pixels = np.stack([spot_image(WIDTH, HEIGHT, u, 100, 6, 6, (255, 255, 255)) for u in (150, 300)])
    request = inference.ModelInferRequest(model_name="two_stage")
    request.inputs.add(name="image", datatype="UINT8", shape=pixels.shape)
    request.raw_input_contents.append(pixels.tobytes())
    answer = stub.ModelInfer(request, timeout=60)
    names = [output.name for output in answer.outputs]
    found = np.frombuffer(answer.raw_output_contents[names.index("translation_m")], "<f4").reshape(2, 3)
    expected = [[(u - K_STAR[0, 2]) / K_STAR[0, 0], (100 - K_STAR[1, 2]) / K_STAR[1, 1], 1] for u in (150, 300)]
    np.testing.assert_allclose(found, expected, atol=0.002)
