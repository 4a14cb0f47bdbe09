"""``curio-detect --refine``: poses come nearer to the truth, and a wrong mesh is refused with a reason."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
import torch
import tyro
from curio_proto.v1.model_spec_pb2 import CanonicalCamera, Field, ModelSpec, ObjectModel
from curio_serve.batch import refinement
from curio_serve.batch.arguments import DetectArguments
from curio_serve.batch.detect_cli import run
from curio_serve.errors import UsageError
from curio_serve.models.spec import read_spec
from curio_train.camera import Intrinsics
from curio_train.config import RunConfig
from curio_train.data.backgrounds import ClutterBackgrounds
from curio_train.geometry import matrix_from_rotation_6d
from curio_train.learning.runs.configuration import to_json
from curio_train.meshes.inset import inset
from curio_train.meshes.meshes import Mesh, to_ply
from curio_train.meshes.shapes import chair
from curio_train.refinement.template_poses import uses_templates
from curio_train.scene_code import CONFIDENCE, ROTATION_6D, TRANSLATION
from curio_train.worlds.base import ObjectKind
from curio_train.worlds.options import CaptureOptions
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import Object
from google.protobuf import json_format
from onnx import TensorProto, helper, numpy_helper
from scipy.spatial.transform import Rotation

K = np.array([[572.4, 0, 325.3], [0, 573.6, 242.0], [0, 0, 1]])
MESH = chair(0.12)
OFF_DEG, OFF_DEPTH = 8.0, 1.04


Found = Mapping[str, tuple[Mesh, np.ndarray, np.ndarray]]
"""Mesh, rotation [3, 3] and position [3] of each object that a model finds."""


def constant_model(path: Path, world: str, found: Found) -> None:
    """A model that finds its objects in the same poses in every image."""
    rotation = np.stack([rotation for _, rotation, _ in found.values()])[None]
    values = {
        "translation_m": np.stack([translation_m for _, _, translation_m in found.values()])[None],
        "rotation_6d": rotation[..., :2].swapaxes(2, 3).reshape(1, -1, 6),
        "rotation": rotation,
    }
    zero = [numpy_helper.from_array(np.float32(0), "zero"), numpy_helper.from_array(np.array([1, 2, 3]), "axes")]
    nodes = [
        helper.make_node("Cast", ["image"], ["float"], to=TensorProto.FLOAT),
        helper.make_node("Mul", ["float", "zero"], ["black"]),
        helper.make_node("ReduceSum", ["black", "axes"], ["none"], keepdims=0),
    ]
    for name, value in values.items():
        shape = numpy_helper.from_array(np.array([-1, *[1] * (value.ndim - 1)]), f"{name}_shape")
        zero += [shape, numpy_helper.from_array(value.astype(np.float32), f"{name}_value")]
        nodes.append(helper.make_node("Reshape", ["none", f"{name}_shape"], [f"{name}_none"]))
        nodes.append(helper.make_node("Add", [f"{name}_none", f"{name}_value"], [name]))
    outputs = [helper.make_tensor_value_info(n, TensorProto.FLOAT, ["b", *v.shape[1:]]) for n, v in values.items()]
    image = helper.make_tensor_value_info("image", TensorProto.UINT8, ["b", 480, 640, 3])
    graph = helper.make_graph(nodes, "constant", [image], outputs, zero)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    spec = ModelSpec(
        schema_version=1,
        name=path.stem,
        world=world,
        recipe=json.dumps({"method": "sleep", "world": {"name": world, "class_name": ",".join(found)}}),
        num_slots=len(found),
        fields=[
            Field(name=name, size=size, per_object=True, unit=unit, frame="camera")
            for name, size, unit in (("translation_m", 3, "m"), ("rotation_6d", 6, "1"))
        ],
        objects=[
            ObjectModel(
                name=name,
                diameter_m=mesh.diameter_m,
                box_corners_m=mesh.box_corners_m.ravel(),
                mesh_sha256=hashlib.sha256(to_ply(mesh)).hexdigest(),
                slots=[slot],
            )
            for slot, (name, (mesh, _, _)) in enumerate(found.items())
        ],
        camera=CanonicalCamera(width=640, height=480, camera_matrix=K.ravel()),
    )
    entry = model.metadata_props.add(key="curio.model_spec")
    entry.value = json_format.MessageToJson(spec)
    path.parent.mkdir(parents=True, exist_ok=True)
    onnx.save(model, path)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run's folder with its mesh, a model that is off, and a frame of twice the size, rendered with ``truth``."""
    folder = tmp_path_factory.mktemp("run")
    kind = ObjectKind("chair", (0,), MESH.diameter_m, MESH.box_corners_m, MESH.sha256)
    random = np.random.default_rng(3)
    pool = cv2.resize(random.integers(0, 256, (24, 32, 3), np.uint8), (640, 480))[None]
    object_ = Object(kind, MESH, Intrinsics(K, 640, 480), 0.5, 1.0, lambda _: ClutterBackgrounds(pool))
    world = TwoStageWorld("linemod", object_)
    code = world.sample(1, (1,))
    code[TRANSLATION][..., :2] *= 0.6
    picture = world.render(code, world.backgrounds(Path()).draw(1, 640, 480, (2,)))[0]
    pixels = (picture.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()
    large = cv2.resize(pixels, (1280, 960), interpolation=cv2.INTER_LINEAR)
    cv2.imwrite(str(folder / "frame.png"), cv2.cvtColor(large, cv2.COLOR_RGB2BGR))
    scaling = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1]])
    (folder / "camera.json").write_text(
        json.dumps({"camera_matrix": (scaling @ K).tolist(), "width": 1280, "height": 960})
    )
    rotation, translation = truth(code)
    np.savez(folder / "truth.npz", rotation=rotation, translation=translation)
    turn = Rotation.from_rotvec(np.radians(OFF_DEG) * np.array([0.6, 0.0, 0.8])).as_matrix()
    constant_model(
        folder / "models" / "chair.onnx", "capture", {"chair": (MESH, turn @ rotation, translation * OFF_DEPTH)}
    )
    (folder / "part.ply").write_bytes(to_ply(MESH))
    options = CaptureOptions((folder / "part.ply",), folder / "camera.json", folder)
    (folder / "config.json").write_text(json.dumps(to_json(RunConfig(options))))
    return folder


def truth(code: Mapping[str, torch.Tensor]) -> tuple[np.ndarray, np.ndarray]:
    return matrix_from_rotation_6d(code[ROTATION_6D][0, 0]).numpy(), code[TRANSLATION][0, 0].numpy()


def detect(place: Path, **flags: Any) -> list[dict[str, Any]]:
    out = place / "out.jsonl"
    flags = {"camera": place / "camera.json", "out": str(out), "overwrite": True} | flags
    model = flags.pop("model", place / "models" / "chair.onnx")
    assert run(DetectArguments(str(model), (str(place / "frame.png"),), **flags)) == 0
    return json.loads(out.read_text())["detections"]


def detect_one(place: Path, **flags: Any) -> dict[str, Any]:
    (found,) = detect(place, **flags)
    return found


def rotation_error_deg(place: Path, found: Mapping[str, Any]) -> float:
    with np.load(place / "truth.npz") as true:
        return angle_deg(found, true["rotation"])


def angle_deg(found: Mapping[str, Any], rotation: np.ndarray) -> float:
    turn = np.array(found["rotation"]) @ rotation.T
    return float(np.degrees(np.linalg.norm(Rotation.from_matrix(turn).as_rotvec())))


def test_the_pose_comes_nearer_to_the_truth(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With the mesh of the run that the model lies in; the box follows the pose."""
    before, after = detect_one(place), detect_one(place, refine=True)
    assert "refined 1 of 1 poses" in capsys.readouterr().err
    assert rotation_error_deg(place, before) == pytest.approx(OFF_DEG, abs=0.1)
    assert rotation_error_deg(place, after) < 3
    with np.load(place / "truth.npz") as true:
        depth = float(true["translation"][2])
    assert abs(after["translation_m"][2] / depth - 1) < 0.015
    assert after["confidence"] == before["confidence"]
    camera = np.array(json.loads((place / "camera.json").read_text())["camera_matrix"])
    seen = (MESH.box_corners_m @ np.array(after["rotation"]).T + after["translation_m"]) @ camera.T
    np.testing.assert_allclose(after["box_px"], seen[:, :2] / seen[:, 2:], atol=0.01)


def test_the_mesh_that_is_named_counts(place: Path) -> None:
    mesh = place / "millimetres.ply"
    mesh.write_bytes(to_ply(Mesh(MESH.vertices_m * 1000, MESH.faces)))
    assert rotation_error_deg(place, detect_one(place, refine=True, mesh=(mesh,), mesh_unit="mm")) < 3


@pytest.mark.parametrize(
    ("scale", "shift", "told"),
    [
        (25.4, 0.0, r"--mesh .*its diameter is 3\.7\d+ m, the model's object has 0\.1\d+ m.*--mesh-unit"),
        (1.0, 0.02, "its box is from .* the model's from"),
    ],
)
def test_another_mesh_is_refused(place: Path, tmp_path: Path, scale: float, shift: float, told: str) -> None:
    mesh = tmp_path / "other.ply"
    mesh.write_bytes(to_ply(Mesh(MESH.vertices_m * scale + shift, MESH.faces)))
    with pytest.raises(UsageError, match=told):
        detect_one(place, refine=True, mesh=(mesh,))


def test_a_model_apart_from_its_run_needs_a_mesh(place: Path, tmp_path: Path) -> None:
    copy = tmp_path / "chair.onnx"
    copy.write_bytes((place / "models" / "chair.onnx").read_bytes())
    with pytest.raises(UsageError, match=r"found no mesh of chair for .*--mesh FILE"):
        detect_one(place, model=copy, refine=True)


def test_a_config_of_another_program_is_no_run(place: Path, tmp_path: Path) -> None:
    copy = tmp_path / "models" / "chair.onnx"
    copy.parent.mkdir()
    copy.write_bytes((place / "models" / "chair.onnx").read_bytes())
    (tmp_path / "config.json").write_text('{"app": "something else"}')
    assert detect_one(place, model=copy, overlays=tmp_path / "drawn")["object"] == "chair"
    assert list((tmp_path / "drawn").iterdir())
    with pytest.raises(UsageError, match="found no mesh of chair"):
        detect_one(place, model=copy, refine=True)


@pytest.mark.parametrize(
    ("world", "num_objects", "expected"),
    [
        ({"name": "linemod", "class_name": "ape", "two_stage": False}, 1, True),
        ({"name": "linemod", "class_name": "ape"}, 1, False),
        ({"name": "capture", "plane": None}, 2, True),
        ({"name": "capture"}, 2, False),
        ({"name": "capture", "plane": None}, 1, False),
    ],
)
def test_which_models_read_poses_by_templates(world: dict[str, Any], num_objects: int, expected: bool) -> None:
    assert uses_templates({"method": "sleep", "world": world}, num_objects) == expected
    assert uses_templates({"method": "templates", "world": world}, num_objects)


@pytest.mark.parametrize(
    ("flags", "told"),
    [
        ({"mesh": (Path("part.ply"),)}, "--mesh is for --refine and --overlays"),
        ({"mesh_unit": "mm"}, "--mesh-unit is for --mesh"),
        ({"overlays": Path("drawn"), "mesh": (Path("missing.ply"),)}, "missing.ply: the mesh cannot be read"),
        ({"refine": True, "ray": "local"}, "leave out --ray"),
        ({"refine": True, "mesh": (Path("missing.ply"),)}, "missing.ply: the mesh cannot be read"),
    ],
)
def test_calls_that_cannot_be_carried_out_are_refused(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flags: dict[str, Any], told: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match=told):
        detect_one(place, **flags)


def test_drawings_show_the_contour_of_a_mesh_that_is_known(place: Path, tmp_path: Path) -> None:
    """That of the run, or the named one; else the box."""

    def drawn(**flags: Any) -> np.ndarray:
        folder = tmp_path / f"{len(list(tmp_path.iterdir()))}"
        detect(place, overlays=folder, **flags)
        (picture,) = folder.rglob("frame.png")
        return cv2.imread(str(picture)).astype(int)

    apart = tmp_path / "chair.onnx"
    apart.write_bytes((place / "models" / "chair.onnx").read_bytes())
    of_run, box = drawn(), drawn(model=apart)
    assert (drawn(model=apart, mesh=(place / "part.ply",)) == of_run).all()
    assert (box != of_run).any(axis=2).sum() > 1000


def test_drawings_do_without_the_extra_unless_a_mesh_is_named(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(refinement, "_MODULE", "curio_train_is_not_here")
    detect(place, overlays=tmp_path / "drawn")
    with pytest.raises(UsageError, match=r"--mesh needs the extra train.*pip install 'curio-pose\[train\]'"):
        detect(place, overlays=tmp_path / "drawn", mesh=(place / "part.ply",))


def test_a_missing_extra_is_named(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refinement, "_MODULE", "curio_train_is_not_here")
    with pytest.raises(UsageError, match=r"pip install 'curio-pose\[train\]'"):
        detect_one(place, refine=True)


BENCH = Mesh(MESH.vertices_m * [1.6, 0.7, 1.0], MESH.faces)
OBJECTS = {"chair": MESH, "bench": BENCH}


@pytest.fixture(scope="module")
def several(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model of two objects in a frame that shows both 1 mm thinner than their files, turned and too far away."""
    folder = tmp_path_factory.mktemp("several")
    pool = cv2.resize(np.random.default_rng(4).integers(0, 256, (24, 32, 3), np.uint8), (640, 480))[None]
    kinds = [
        ObjectKind(name, (slot,), mesh.diameter_m, mesh.box_corners_m)
        for slot, (name, mesh) in enumerate(OBJECTS.items())
    ]
    members = [
        Object(
            kind, inset(OBJECTS[kind.name], 1e-3), Intrinsics(K, 640, 480), 0.5, 1.0, lambda _: ClutterBackgrounds(pool)
        )
        for kind in kinds
    ]
    world = SeveralObjectsWorld("linemod", members)
    code = world.sample(1, (3,)) | {CONFIDENCE: torch.ones(1, 2, 1)}
    code[TRANSLATION] = torch.tensor([[[-0.12, 0.0, 0.65], [0.12, 0.02, 0.75]]])
    picture = world.render(code, members[0].backgrounds(Path()).draw(1, 640, 480, (2,)))[0]
    pixels = (picture.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()
    cv2.imwrite(str(folder / "frame.png"), cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))
    (folder / "camera.json").write_text(json.dumps({"camera_matrix": K.tolist(), "width": 640, "height": 480}))
    rotation, translation = matrix_from_rotation_6d(code[ROTATION_6D][0]).numpy(), code[TRANSLATION][0].numpy()
    np.savez(folder / "truth.npz", rotation=rotation, translation=translation)
    turn = Rotation.from_rotvec(np.radians(OFF_DEG) * np.array([0.6, 0.0, 0.8])).as_matrix()
    found = {
        name: (mesh, turn @ rotation[slot], translation[slot] * OFF_DEPTH)
        for slot, (name, mesh) in enumerate(OBJECTS.items())
    }
    constant_model(folder / "two.onnx", "linemod", found)
    (folder / "meshes").mkdir()
    for name, mesh in (OBJECTS | {"other": chair(0.1)}).items():
        (folder / "meshes" / f"{name}.ply").write_bytes(to_ply(mesh))
    (folder / "meshes" / "models_info.json").write_text("{}")
    return folder


def test_each_of_several_objects_is_refined(several: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With its own mesh out of a folder; of templates' depth and the refined one the mean counts."""
    found = {
        one["object"]: one
        for one in detect(several, model=several / "two.onnx", refine=True, mesh=(several / "meshes",))
    }
    assert "refined 2 of 2 poses" in capsys.readouterr().err
    with np.load(several / "truth.npz") as true:
        for name, rotation, translation in zip(OBJECTS, true["rotation"], true["translation"], strict=True):
            assert angle_deg(found[name], rotation) < 3
            x, y, z = found[name]["translation_m"]
            assert z / translation[2] == pytest.approx(OFF_DEPTH**0.5, abs=0.01)
            assert [x / z, y / z] == pytest.approx(translation[:2] / translation[2], abs=0.004)


def test_meshes_are_named_one_by_one(several: Path) -> None:
    """In any order; an object without one is named."""
    spec = read_spec((several / "two.onnx").read_bytes(), "two.onnx")
    chair_file, bench_file, other_file = (several / "meshes" / f"{name}.ply" for name in ("chair", "bench", "other"))
    refinement.load_refiner(spec, "two.onnx", [bench_file, chair_file], None)
    with pytest.raises(
        UsageError, match=r"found 2 mesh files, but none of bench for two\.onnx; .*--mesh FILE once for each"
    ):
        refinement.load_refiner(spec, "two.onnx", [chair_file, other_file], None)
    with pytest.raises(UsageError, match=r"found no mesh of chair, bench for two\.onnx"):
        refinement.load_refiner(spec, "two.onnx", [], None)


def test_mesh_takes_one_file_each_time() -> None:
    """So images may stand after it."""
    call = ["model", "--refine", "--mesh", "a.ply", "--mesh", "b.ply", "frames"]
    arguments = tyro.cli(DetectArguments, args=call)
    assert (arguments.mesh, arguments.images) == ((Path("a.ply"), Path("b.ply")), ("frames",))
