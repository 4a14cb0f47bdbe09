"""The paper's network with random weights, as an exported model: its answers mean nothing, their cost is right."""

from pathlib import Path

import numpy as np
import onnx
from curio_proto.v1.model_spec_pb2 import CanonicalCamera, Field, ModelSpec, ObjectModel
from google.protobuf import json_format
from onnx import TensorProto, helper, numpy_helper

SIDE_PX = 128
# (channels in, channels out, kernel, stride, padding): with biases and batch norm 2,029,056 parameters
CONVOLUTIONS = [(3, 64, 11, 4, 2), (64, 192, 5, 2, 1), (192, 384, 3, 2, 1), (384, 256, 3, 2, 1), (256, 64, 3, 2, 0)]
DENSE = [(64, 32), (32, 64), (64, 3)]


def write_model(folder: Path, frame_matrix: np.ndarray, frame_width: int) -> None:
    """Writes ``<folder>/1/model.onnx``: image to one object's pose, batch norm folded as exporters do.

    Args:
        folder: Named as the model shall be.
        frame_matrix: K [3, 3] of the frames it will get; the model sees their whole width.
        frame_width: Pixels.
    """
    model = helper.make_model(_graph(folder.name), opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    entry = model.metadata_props.add(key="curio.model_spec")
    entry.value = json_format.MessageToJson(_spec(folder.name, frame_matrix * SIDE_PX / frame_width))
    onnx.checker.check_model(model)
    (folder / "1").mkdir(parents=True)
    (folder / "1" / "model.onnx").write_bytes(model.SerializeToString())


def _graph(name: str) -> onnx.GraphProto:
    rng = np.random.default_rng(0)
    node = helper.make_node
    values: dict[str, np.ndarray] = {
        "largest": np.array(255, np.float32),
        "zero": np.array(0, np.float32),
        "place_m": np.array([0, 0, 0.8], np.float32),
        "upright": np.eye(3, dtype=np.float32)[None, None],
        "upright_6d": np.eye(3, dtype=np.float32)[:, :2].T.reshape(1, 1, 6),
        "as_slot": np.array([-1, 1, 3]),
        "one_axis": np.array([1]),
        "as_3d": np.array([-1, 1, 1]),
        "as_4d": np.array([-1, 1, 1, 1]),
    }
    nodes = [
        node("Cast", ["image"], ["float"], to=TensorProto.FLOAT),
        node("Div", ["float", "largest"], ["unit"]),
        node("Transpose", ["unit"], ["map0"], perm=[0, 3, 1, 2]),
    ]
    for i, (num_in, num_out, kernel, stride, padding) in enumerate(CONVOLUTIONS):
        spread = np.sqrt(2 / (num_in * kernel**2))
        values[f"kernel{i}"] = rng.normal(0, spread, (num_out, num_in, kernel, kernel)).astype(np.float32)
        values[f"bias{i}"] = np.zeros(num_out, np.float32)
        inputs = [f"map{i}", f"kernel{i}", f"bias{i}"]
        nodes.append(node("Conv", inputs, [f"raw{i}"], strides=[stride] * 2, pads=[padding] * 4))
        nodes.append(node("Relu", [f"raw{i}"], [f"map{i + 1}"]))
    nodes.append(node("Flatten", [f"map{len(CONVOLUTIONS)}"], ["row0"]))
    for i, (num_in, num_out) in enumerate(DENSE):
        values[f"dense{i}"] = rng.normal(0, 0.1 / np.sqrt(num_in), (num_in, num_out)).astype(np.float32)
        nodes.append(node("MatMul", [f"row{i}", f"dense{i}"], [f"product{i}"]))
        nodes.append(node("Relu" if num_out != 3 else "Tanh", [f"product{i}"], [f"row{i + 1}"]))
    nodes += [
        node("Add", [f"row{len(DENSE)}", "place_m"], ["position_m"]),
        node("Reshape", ["position_m", "as_slot"], ["translation_m"]),
        # a rotation that depends on the batch's size alone
        node("ReduceSum", ["position_m", "one_axis"], ["sum"], keepdims=1),
        node("Mul", ["sum", "zero"], ["none"]),
    ]
    for output, constant, shape in (("rotation", "upright", "as_4d"), ("rotation_6d", "upright_6d", "as_3d")):
        nodes.append(node("Reshape", ["none", shape], [f"{output}_none"]))
        nodes.append(node("Add", [f"{output}_none", constant], [output]))
    shapes = {"translation_m": ["b", 1, 3], "rotation_6d": ["b", 1, 6], "rotation": ["b", 1, 3, 3]}
    return helper.make_graph(
        nodes,
        name,
        [helper.make_tensor_value_info("image", TensorProto.UINT8, ["b", SIDE_PX, SIDE_PX, 3])],
        [helper.make_tensor_value_info(output, TensorProto.FLOAT, shape) for output, shape in shapes.items()],
        [numpy_helper.from_array(value, constant) for constant, value in values.items()],
    )


def _spec(name: str, focal_lengths: np.ndarray) -> ModelSpec:
    middle = (SIDE_PX - 1) / 2
    corners_m = [0.05 * sign for x in (-1, 1) for y in (-1, 1) for z in (-1, 1) for sign in (x, y, z)]
    return ModelSpec(
        schema_version=1,
        name=name,
        world="linemod",
        num_slots=1,
        fields=[
            Field(name="translation_m", size=3, per_object=True, unit="m", frame="camera"),
            Field(name="rotation_6d", size=6, per_object=True, unit="1", frame="camera"),
        ],
        objects=[ObjectModel(name="box", diameter_m=0.17, box_corners_m=corners_m, slots=[0])],
        camera=CanonicalCamera(
            width=SIDE_PX,
            height=SIDE_PX,
            camera_matrix=[focal_lengths[0, 0], 0, middle, 0, focal_lengths[1, 1], middle, 0, 0, 1],
        ),
    )
