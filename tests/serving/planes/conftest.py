"""A model of one cube and one of two, that say how cubes stand."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from curio_proto.v1 import detector_pb2 as messages
from curio_proto.v1.model_spec_pb2 import ModelSpec
from curio_serve.client import Plane
from onnx import helper, numpy_helper

CORNERS_M = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float) * 0.05
SIDES = np.concatenate([np.eye(3), -np.eye(3)])
STABLE_POSES = {"objects": [{"object": "spot", "hull_m": CORNERS_M.ravel().tolist(), "up": SIDES.ravel().tolist()}]}
_BESIDE = 0.2 * np.array([0.36, -0.8, 0.48])
Spot = Callable[..., np.ndarray]


@pytest.fixture
def with_stable_poses() -> Callable[[Path], Path]:
    """Lays ``stable_poses.json`` of a cube beside the model of a folder."""

    def put(folder: Path) -> Path:
        file = folder / "1" / "stable_poses.json"
        file.write_text(json.dumps(STABLE_POSES))
        with (folder / "SHA256SUMS").open("a") as sums:
            sums.write(f"{hashlib.sha256(file.read_bytes()).hexdigest()}  1/stable_poses.json\n")
        return folder

    return put


@pytest.fixture
def standing(
    tmp_path: Path,
    spot_onnx: Callable[..., onnx.ModelProto],
    write_folder: Callable[..., Path],
    with_stable_poses: Callable[[Path], Path],
) -> Path:
    """The folder of ``pinhole``, whose object can stand as a cube does."""
    return with_stable_poses(write_folder(tmp_path / "models" / "pinhole", spot_onnx(True)))


@pytest.fixture
def pair(
    tmp_path: Path,
    spot_onnx: Callable[..., onnx.ModelProto],
    spot_spec: Callable[[bool], ModelSpec],
    write_folder: Callable[..., Path],
    with_stable_poses: Callable[[Path], Path],
) -> Path:
    """The folder of ``pair``: ``pinhole`` with a second cube 0.2 m beside the first, along the first's own x axis."""
    spec = spot_spec(True)
    spec.name, spec.num_slots, spec.objects[0].slots[:] = "pair", 2, [0, 1]
    model = spot_onnx(True, spec)
    graph = model.graph
    for output in graph.output:
        if output.name == "light":
            continue
        (last,) = [node for node in graph.node if output.name in node.output]
        last.output[:] = [f"{output.name}_one"]
        shift = _BESIDE if output.name == "translation_m" else np.float32(0)
        graph.initializer.append(numpy_helper.from_array(np.asarray(shift, np.float32), f"{output.name}_shift"))
        names = [f"{output.name}_{part}" for part in ("one", "shift", "two")]
        graph.node.append(helper.make_node("Add", names[:2], names[2:]))
        graph.node.append(helper.make_node("Concat", [names[0], names[2]], [output.name], axis=1))
        output.type.tensor_type.shape.dim[1].dim_value = 2
    onnx.checker.check_model(model)
    return with_stable_poses(write_folder(tmp_path / "models" / "pair", model))


@pytest.fixture
def pixels(spot_image: Spot) -> np.ndarray:
    return spot_image(320, 240, 150, 120, 12, 12, (255, 128, 0))


@pytest.fixture
def below() -> Callable[[messages.Detection, float], Plane]:
    """The plane on which a detection's cube would stand, if it were farther away by so much."""

    def plane(found: messages.Detection, farther_m: float) -> Plane:
        rotation, origin_m = np.reshape(found.rotation, (3, 3)), np.array(found.translation_m)
        normal = max(SIDES @ rotation.T, key=lambda side: -side @ origin_m)
        ray = origin_m / np.linalg.norm(origin_m)
        return Plane(origin_m + farther_m * ray - 0.05 * normal, normal)

    return plane
