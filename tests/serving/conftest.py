"""Small real models: ONNX graphs whose answers can be worked out by hand, in model folders as the exporter writes them.

They see a soft bright spot on black. Its brightness-weighted centre is where the object is, its colour is the object's
colour, and (pinhole) its total brightness tells the distance: a Gaussian spot of SPOT_RADIUS_M has the standard
deviation s = f r / z in pixels and the sum 2 pi s² over them, so z = f r sqrt(2 pi / sum).
"""

import hashlib
import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from curio_proto.v1.model_spec_pb2 import CanonicalCamera, Field, ModelSpec, ObjectModel
from curio_serve.systems import STOP_SIGNALS
from google.protobuf import json_format
from onnx import TensorProto, helper, numpy_helper

SPOT_RADIUS_M = 0.05
WIDTH, HEIGHT = 96, 64
CANONICAL_K = np.array([[110.0, 0, 50.0], [0, 112.0, 30.0], [0, 0, 1]])
# A turn about an arbitrary axis, so that nothing is right by symmetry.
MODEL_ROTATION = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
MODEL_LIGHT = np.array([0.3, -0.8, -0.5])
BOX = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float) * 0.05


def _constant(name: str, value: np.ndarray) -> onnx.TensorProto:
    return numpy_helper.from_array(np.asarray(value, np.float32), name)


def _graph(pinhole: bool) -> onnx.GraphProto:
    """Nodes that compute mass, centre and colour of the bright pixels of each image."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    constants = [
        _constant("full", 255.0),
        _constant("tiny", 1e-6),
        _constant("u", u[None]),
        _constant("v", v[None]),
        numpy_helper.from_array(np.array([1, 2]), "rows_columns"),
        numpy_helper.from_array(np.array([3]), "channel"),
        numpy_helper.from_array(np.array([1]), "one"),
        numpy_helper.from_array(np.array([-1, 1, 3]), "as_slot"),
        numpy_helper.from_array(np.array([-1, 1]), "as_row"),
        _constant("low", 0.0),
        _constant("high", 1.0),
        _constant("sure_mass", 20.0),
    ]
    node = helper.make_node
    nodes = [
        node("Cast", ["image"], ["float"], to=TensorProto.FLOAT),
        node("Div", ["float", "full"], ["rgb"]),
        node("ReduceMax", ["rgb", "channel"], ["weight"], keepdims=0),
        node("ReduceSum", ["weight", "rows_columns"], ["mass"], keepdims=0),
        node("Add", ["mass", "tiny"], ["safe_mass"]),
        *[
            step
            for axis in "uv"
            for step in (
                node("Mul", ["weight", axis], [f"{axis}_weighted"]),
                node("ReduceSum", [f"{axis}_weighted", "rows_columns"], [f"{axis}_sum"], keepdims=0),
                node("Div", [f"{axis}_sum", "safe_mass"], [f"{axis}_mean"]),
            )
        ],
        node("ReduceSum", ["rgb", "rows_columns"], ["rgb_sum"], keepdims=0),
        node("ReduceMax", ["rgb_sum", "one"], ["rgb_sum_max"], keepdims=1),
        node("Add", ["rgb_sum_max", "tiny"], ["rgb_scale"]),
        node("Div", ["rgb_sum", "rgb_scale"], ["color_row"]),
        node("Reshape", ["color_row", "as_slot"], ["color"]),
        node("Div", ["mass", "sure_mass"], ["sureness"]),
        node("Clip", ["sureness", "low", "high"], ["sure"]),
        node("Reshape", ["sure", "as_row"], ["confidence"]),
    ]
    outputs = {"translation_m": ["b", 1, 3], "color": ["b", 1, 3], "confidence": ["b", 1]}
    if pinhole:
        nodes += _pinhole_nodes(constants)
        outputs |= {"rotation_6d": ["b", 1, 6], "rotation": ["b", 1, 3, 3], "light": ["b", 3]}
    else:
        constants += [_constant("cu", (WIDTH - 1) / 2), _constant("cv", (HEIGHT - 1) / 2), _constant("w", WIDTH)]
        nodes += [
            node("Sub", ["u_mean", "cu"], ["du"]),
            node("Sub", ["v_mean", "cv"], ["dv"]),
            node("Div", ["du", "w"], ["x"]),
            node("Div", ["dv", "w"], ["y"]),
            node("Mul", ["x", "low"], ["z"]),
        ]
    nodes += [
        *[node("Reshape", [axis, "as_row"], [f"{axis}_row"]) for axis in "xyz"],
        node("Concat", ["x_row", "y_row", "z_row"], ["xyz"], axis=1),
        node("Reshape", ["xyz", "as_slot"], ["translation_m"]),
    ]
    values = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in outputs.items()]
    image = helper.make_tensor_value_info("image", TensorProto.UINT8, ["b", HEIGHT, WIDTH, 3])
    return helper.make_graph(nodes, "spot", [image], values, constants)


def _pinhole_nodes(constants: list[onnx.TensorProto]) -> list[onnx.NodeProto]:
    (fx, _, cx), (_, fy, cy), _ = CANONICAL_K
    constants += [
        *[_constant(name, value) for name, value in (("fx", fx), ("fy", fy), ("cx", cx), ("cy", cy))],
        _constant("depth_squared", fx * fy * SPOT_RADIUS_M**2 * 2 * np.pi),
        _constant("rotation_value", MODEL_ROTATION[None, None]),
        _constant("rotation_6d_value", MODEL_ROTATION[:, :2].T.reshape(1, 1, 6)),
        _constant("light_value", MODEL_LIGHT[None]),
        numpy_helper.from_array(np.array([-1, 1, 1, 1]), "as_4d"),
        numpy_helper.from_array(np.array([-1, 1, 1]), "as_3d"),
    ]
    node = helper.make_node
    return [
        node("Div", ["depth_squared", "safe_mass"], ["z_squared"]),
        node("Sqrt", ["z_squared"], ["z_far"]),
        node("Clip", ["z_far", "low", "full"], ["z"]),
        *[
            step
            for axis, pixel in (("x", "u"), ("y", "v"))
            for step in (
                node("Sub", [f"{pixel}_mean", f"c{axis}"], [f"d{axis}"]),
                node("Div", [f"d{axis}", f"f{axis}"], [f"{axis}_slope"]),
                node("Mul", [f"{axis}_slope", "z"], [axis]),
            )
        ],
        node("Mul", ["mass", "low"], ["none"]),
        *[
            step
            for name, shape in (("rotation", "as_4d"), ("rotation_6d", "as_3d"), ("light", "as_row"))
            for step in (
                node("Reshape", ["none", shape], [f"{name}_none"]),
                node("Add", [f"{name}_none", f"{name}_value"], [name]),
            )
        ],
    ]


def _spec(pinhole: bool) -> ModelSpec:
    unit, frame = ("m", "camera") if pinhole else ("image_width", "image")
    fields = [
        Field(name="translation_m", size=3, per_object=True, unit=unit, frame=frame),
        Field(name="color", size=3, per_object=True, unit="1"),
        Field(name="confidence", size=1, per_object=True, unit="1"),
    ]
    if pinhole:
        fields.append(Field(name="rotation_6d", size=6, per_object=True, unit="1", frame="camera"))
        fields.append(Field(name="light", size=3, per_object=False, unit="1", frame="camera"))
    camera = CanonicalCamera(width=WIDTH, height=HEIGHT, camera_matrix=CANONICAL_K.ravel() if pinhole else [])
    spot = ObjectModel(name="spot", diameter_m=0.1, box_corners_m=BOX.ravel(), slots=[0])
    name = "pinhole" if pinhole else "flat"
    return ModelSpec(
        schema_version=1, name=name, world="spots", num_slots=1, fields=fields, objects=[spot], camera=camera
    )


def _config(name: str, model: onnx.ModelProto) -> str:
    def tensor(value: onnx.ValueInfoProto, kind: str) -> str:
        dims = [d.dim_value for d in value.type.tensor_type.shape.dim[1:]]
        return f'  {{ name: "{value.name}" data_type: {kind} dims: {dims} }}'

    inputs = ",\n".join(tensor(v, "TYPE_UINT8") for v in model.graph.input)
    outputs = ",\n".join(tensor(v, "TYPE_FP32") for v in model.graph.output)
    head = f'name: "{name}"\nbackend: "onnxruntime"\nmax_batch_size: 64\ninstance_group [{{ kind: KIND_CPU }}]\n'
    return f"{head}input [\n{inputs}\n]\noutput [\n{outputs}\n]\n"


def make_onnx(pinhole: bool, spec: ModelSpec | None = None) -> onnx.ModelProto:
    model = helper.make_model(_graph(pinhole), opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    entry = model.metadata_props.add(key="curio.model_spec")
    entry.value = json_format.MessageToJson(spec or _spec(pinhole))
    onnx.checker.check_model(model)
    return model


def write_model_folder(folder: Path, model: onnx.ModelProto, version: int = 1) -> Path:
    """The folder as the exporter writes it; further versions join it."""
    (folder / str(version)).mkdir(parents=True, exist_ok=True)
    (folder / str(version) / "model.onnx").write_bytes(model.SerializeToString())
    (folder / "config.pbtxt").write_text(_config(folder.name, model))
    files = sorted(folder.glob("*/model.onnx"))
    sums = "".join(f"{hashlib.sha256(f.read_bytes()).hexdigest()}  {f.relative_to(folder)}\n" for f in files)
    (folder / "SHA256SUMS").write_text(sums)
    return folder


def draw_spot(
    width: int, height: int, u: float, v: float, sigma_u: float, sigma_v: float, color: tuple[int, int, int]
) -> np.ndarray:
    """uint8 RGB [height, width, 3]: a Gaussian spot around pixel (u, v) on black."""
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    spot = np.exp(-0.5 * (((columns - u) / sigma_u) ** 2 + ((rows - v) / sigma_v) ** 2))
    return np.round(spot[..., None] * np.array(color)).astype(np.uint8)


@pytest.fixture(scope="session")
def spot_onnx() -> Callable[..., onnx.ModelProto]:
    """``spot_onnx(pinhole, spec=None)``: the graph with its spec in the metadata."""
    return make_onnx


@pytest.fixture(scope="session")
def spot_spec() -> Callable[[bool], ModelSpec]:
    return _spec


@pytest.fixture(scope="session")
def write_folder() -> Callable[..., Path]:
    """``write_folder(folder, onnx_model, version=1)``: Triton's layout with config.pbtxt and SHA256SUMS."""
    return write_model_folder


@pytest.fixture(scope="session")
def spot_image() -> Callable[..., np.ndarray]:
    """``spot_image(width, height, u, v, sigma_u, sigma_v, color)``."""
    return draw_spot


@pytest.fixture(scope="session")
def models_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A repository with ``flat`` (2D world) and ``pinhole``, one version each; read it, never write into it."""
    root = tmp_path_factory.mktemp("models")
    write_model_folder(root / "flat", make_onnx(False))
    write_model_folder(root / "pinhole", make_onnx(True))
    return root


@dataclass
class RunningServer:
    """A ``curio-serve`` process.

    Attributes:
        address: host:port of gRPC.
        metrics_url: Of Prometheus, where the server was started with it.
        log: File its log goes to.
    """

    process: "subprocess.Popen[str]"
    address: str
    metrics_url: str
    log: Path

    def stop(self, number: int = signal.SIGTERM) -> int:
        """Send a signal and wait for the exit status."""
        self.process.send_signal(number)
        return self.process.wait(timeout=60)


@pytest.fixture(scope="session")
def start_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., RunningServer]]:
    """``start_server(models_dir, *flags)``: a real server on a free port of 127.0.0.1; ended after the tests."""
    running: list[RunningServer] = []
    for number in STOP_SIGNALS:  # a run in the background (nohup, &) ignores some, and servers would inherit that
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)

    def start(models: Path, *flags: str) -> RunningServer:
        log = tmp_path_factory.mktemp("server") / "log"
        code = "from curio_serve.server.serve_cli import main; main()"
        command = [sys.executable, "-c", code, str(models), "--port", "0", *flags]
        with log.open("w") as stderr:
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=stderr, text=True)
        assert process.stdout is not None
        lines = [process.stdout.readline() for _ in range(2 if "--metrics-port" in flags else 1)]
        if not lines[0].startswith("listening on "):
            raise RuntimeError(f"the server did not start ({process.wait(timeout=60)}): {log.read_text()}")
        found = RunningServer(process, lines[0].split()[-1], lines[-1].split()[-1], log)
        running.append(found)
        return found

    yield start
    for server in running:
        if server.process.poll() is None:
            server.stop()
        if server.process.stdout is not None:
            server.process.stdout.close()


@pytest.fixture(scope="session")
def server(start_server: Callable[..., RunningServer], models_dir: Path) -> RunningServer:
    """One server with the models of ``models_dir``, shared by the tests that leave it as it is."""
    return start_server(models_dir, "--metrics-port", "0")


@pytest.fixture
def frames(tmp_path: Path, spot_image: Callable[..., np.ndarray]) -> Path:
    """Folder of six frames; the spot of frame n is at (100 + 20 n, 120)."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for number in range(6):
        pixels = spot_image(320, 240, 100 + 20 * number, 120, 12, 12, (255, 128, 0))
        cv2.imwrite(str(folder / f"{number:06d}.png"), pixels[..., ::-1])
    return folder


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    """A camera file for frames of 320x240 pixels."""
    path = tmp_path / "camera.json"
    matrix = [[300.0, 0, 160.0], [0, 301.0, 119.0], [0, 0, 1]]
    path.write_text(json.dumps({"camera_matrix": matrix, "width": 320, "height": 240}))
    return path
