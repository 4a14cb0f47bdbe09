"""What ``curio-doctor`` says of a model beside a mesh and a camera."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import trimesh
from curio_proto.v1.model_spec_pb2 import CanonicalCamera, ModelSpec
from curio_train.doctor.examine import Subjects, examine_files
from curio_train.doctor.finding import Finding
from curio_train.export.onnx import put_spec
from curio_train.meshes.meshes import load_mesh

WIDTH, HEIGHT = 160, 120
K = [[180.0, 0.0, 81.0], [0.0, 180.0, 58.0], [0.0, 0.0, 1.0]]


def write_camera(path: Path, matrix: Sequence[Sequence[float]]) -> None:
    path.write_text(json.dumps({"camera_matrix": matrix, "width": WIDTH, "height": HEIGHT}))


def export(path: Path, sha256: str, diameter_m: float) -> None:
    """An ONNX file that says it was trained for such a mesh, and for the good camera."""
    make, tensor = onnx.helper.make_node, onnx.helper.make_tensor_value_info
    nodes = [
        make("Cast", ["image"], ["values"], to=onnx.TensorProto.FLOAT),
        make("ReduceMean", ["values"], ["mean"], axes=[1, 2], keepdims=0),
        make("Unsqueeze", ["mean", "one"], ["translation_m"]),
    ]
    image = tensor("image", onnx.TensorProto.UINT8, ["batch", HEIGHT, WIDTH, 3])
    output = tensor("translation_m", onnx.TensorProto.FLOAT, ["batch", 1, 3])
    one = onnx.helper.make_tensor("one", onnx.TensorProto.INT64, [1], [1])
    graph = onnx.helper.make_graph(nodes, "mean colour", [image], [output], [one])
    model = onnx.helper.make_model(graph, ir_version=9, opset_imports=[onnx.helper.make_opsetid("", 17)])
    spec = ModelSpec(schema_version=1, name="part", world="linemod", num_slots=1)
    spec.fields.add(name="translation_m", size=3, per_object=True)
    spec.objects.add(name="part", slots=[0], mesh_sha256=sha256, diameter_m=diameter_m)
    spec.camera.MergeFrom(CanonicalCamera(width=WIDTH, height=HEIGHT, camera_matrix=np.ravel(K).tolist()))
    put_spec(model, spec)
    onnx.save(model, str(path))


@pytest.fixture
def subjects(tmp_path: Path) -> Subjects:
    """A mesh, a camera and a model of both."""
    trimesh.creation.box((60, 40, 30)).export(tmp_path / "part.ply")
    write_camera(tmp_path / "camera.json", K)
    mesh = load_mesh(tmp_path / "part.ply", "mm")
    export(tmp_path / "model.onnx", mesh.sha256, mesh.diameter_m)
    return Subjects(tmp_path / "part.ply", "mm", camera=tmp_path / "camera.json", model=tmp_path / "model.onnx")


def alarms(subjects: Subjects) -> list[Finding]:
    findings = list(examine_files(subjects))
    return [finding for finding in findings if finding.subject.startswith("model") and finding.state != "good"]


def test_the_models_own_mesh_and_camera_are_good(subjects: Subjects) -> None:
    assert alarms(subjects) == []


@pytest.mark.parametrize(
    ("size", "fault", "state"),
    [(1.0, "other mesh", "warning"), (1.7, "other mesh", "bad"), (1000.0, "mesh unit", "bad")],
)
def test_a_model_of_another_mesh(subjects: Subjects, size: float, fault: str, state: str) -> None:
    assert subjects.mesh is not None
    assert subjects.model is not None
    export(subjects.model, "0" * 64, load_mesh(subjects.mesh, "mm").diameter_m * size)
    (finding,) = alarms(subjects)
    assert (finding.fault, finding.state) == (fault, state)


def test_the_models_own_mesh_in_another_unit(subjects: Subjects) -> None:
    (finding,) = alarms(replace(subjects, mesh_unit="cm"))
    assert (finding.fault, finding.state) == ("mesh unit", "bad")


@pytest.mark.parametrize(
    ("factor", "text"), [(3.0, "fills the middle 33%"), (0.8, "64% of a frame, its middle, are searched")]
)
def test_a_model_of_another_camera(subjects: Subjects, factor: float, text: str) -> None:
    assert subjects.camera is not None
    write_camera(subjects.camera, [[factor * 180, 0, 81], [0, factor * 180, 58], [0, 0, 1]])
    (finding,) = alarms(subjects)
    assert finding.fault == "other view"
    assert text in str(finding)


def test_a_camera_that_sees_little_more_is_no_alarm(subjects: Subjects) -> None:
    assert subjects.camera is not None
    write_camera(subjects.camera, [[174, 0, 81], [0, 174, 58], [0, 0, 1]])
    assert alarms(subjects) == []


def test_a_run_without_a_model_is_told_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text("{}")
    (finding,) = examine_files(Subjects(model=tmp_path))
    assert finding.state == "bad"
    assert f"curio-export {tmp_path}" in finding.text
