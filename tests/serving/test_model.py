"""What a model file and its folder have to be, and how others are refused."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from curio_proto.v1.model_spec_pb2 import Field, ModelSpec, ObjectModel
from curio_serve.errors import ModelError
from curio_serve.models.model import load
from curio_serve.models.model_folder import open_model
from google.protobuf import json_format
from onnx import TensorProto, helper

MakeOnnx = Callable[..., onnx.ModelProto]
MakeSpec = Callable[[bool], ModelSpec]


def _save(model: onnx.ModelProto, folder: Path) -> Path:
    path = folder / "model.onnx"
    path.write_bytes(model.SerializeToString())
    return path


def test_a_good_model(spot_onnx: MakeOnnx, tmp_path: Path) -> None:
    model = load(_save(spot_onnx(True), tmp_path))
    assert (model.name, model.version) == ("pinhole", 0)
    assert model.output_shapes["rotation"] == (1, 3, 3)
    outputs = model.run(np.zeros((3, 64, 96, 3), np.uint8))
    assert {name: value.shape for name, value in outputs.items()} == {
        name: (3, *shape) for name, shape in model.output_shapes.items()
    }


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "is not an ONNX file"),
        (b"no onnx at all" * 50, "is not an ONNX file"),
        (b"\x89PNG\r\n", "not an ONNX file"),
    ],
)
def test_other_files(tmp_path: Path, data: bytes, words: str) -> None:
    path = tmp_path / "model.onnx"
    path.write_bytes(data)
    with pytest.raises(ModelError, match=words) as caught:
        load(path)
    assert str(path) in str(caught.value)


def test_a_truncated_file(spot_onnx: MakeOnnx, tmp_path: Path) -> None:
    path = _save(spot_onnx(True), tmp_path)
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(ModelError):
        load(path)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="cannot be read"):
        load(tmp_path / "model.onnx")
    with pytest.raises(ModelError, match="no model at"):
        open_model(tmp_path / "nothing")
    with pytest.raises(ModelError, match="no model in"):
        open_model(tmp_path)
    (tmp_path / "models" / "part").mkdir(parents=True)
    with pytest.raises(ModelError, match=r"is a run: name .*/models/part$"):
        open_model(tmp_path)


def test_no_spec(spot_onnx: MakeOnnx, tmp_path: Path) -> None:
    model = spot_onnx(False)
    del model.metadata_props[:]
    with pytest.raises(ModelError, match=r"0 entries curio\.model_spec"):
        load(_save(model, tmp_path))


def test_a_spec_that_is_none(spot_onnx: MakeOnnx, tmp_path: Path) -> None:
    model = spot_onnx(False)
    model.metadata_props[0].value = '{"name": 3'
    with pytest.raises(ModelError, match="is not a ModelSpec"):
        load(_save(model, tmp_path))


def test_a_newer_spec_is_refused_by_its_version(spot_onnx: MakeOnnx, spot_spec: MakeSpec, tmp_path: Path) -> None:
    spec = spot_spec(False)
    spec.schema_version = 2
    model = spot_onnx(False)
    text = json_format.MessageToJson(spec)
    model.metadata_props[0].value = text.replace("{", '{"fieldOfTheFuture": 1,', 1)
    with pytest.raises(ModelError, match="schema version 2; supported is 1"):
        load(_save(model, tmp_path))


def _external_initializer(model: onnx.ModelProto) -> None:
    tensor = model.graph.initializer[0]
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="../../secret")


def _external_attribute(model: onnx.ModelProto) -> None:
    tensor = TensorProto(name="hidden", dims=[1], data_type=TensorProto.FLOAT, data_location=TensorProto.EXTERNAL)
    tensor.external_data.add(key="location", value="weights.bin")
    model.graph.node.append(helper.make_node("Constant", [], ["unused"], value=tensor))


def _external_in_subgraph(model: onnx.ModelProto) -> None:
    tensor = TensorProto(name="deep", dims=[1], data_type=TensorProto.FLOAT)
    tensor.external_data.add(key="location", value="weights.bin")
    branch = helper.make_graph(
        [], "branch", [], [helper.make_tensor_value_info("deep", TensorProto.FLOAT, [1])], [tensor]
    )
    condition = helper.make_tensor("yes", TensorProto.BOOL, [], [True])
    model.graph.node.append(helper.make_node("Constant", [], ["yes"], value=condition))
    model.graph.node.append(helper.make_node("If", ["yes"], ["any"], then_branch=branch, else_branch=branch))


def _external_in_function(model: onnx.ModelProto) -> None:
    tensor = TensorProto(name="inner", dims=[1], data_type=TensorProto.FLOAT, data_location=TensorProto.EXTERNAL)
    node = helper.make_node("Constant", [], ["y"], value=tensor)
    opset = [helper.make_opsetid("", 18)]
    model.functions.append(helper.make_function("own", "f", [], ["y"], [node], opset))


@pytest.mark.parametrize(
    "spoil", [_external_initializer, _external_attribute, _external_in_subgraph, _external_in_function]
)
def test_external_data_is_refused(
    spot_onnx: MakeOnnx, tmp_path: Path, spoil: Callable[[onnx.ModelProto], None]
) -> None:
    model = spot_onnx(False)
    spoil(model)
    with pytest.raises(ModelError, match="external data is refused"):
        load(_save(model, tmp_path))


def _no_slots(spec: ModelSpec) -> None:
    spec.num_slots = 2


def _countless_slots(spec: ModelSpec) -> None:
    spec.num_slots = 2**32 - 1


def _two_owners(spec: ModelSpec) -> None:
    spec.objects.append(ObjectModel(name="other", slots=[0]))


def _more_fields(spec: ModelSpec) -> None:
    spec.fields.append(Field(name="light", size=3))


def _unknown_field(spec: ModelSpec) -> None:
    spec.fields[1].name = "colour"


def _wrong_size(spec: ModelSpec) -> None:
    spec.fields[0].size = 2


def _other_input(spec: ModelSpec) -> None:
    spec.camera.width = 128


def _half_a_matrix(spec: ModelSpec) -> None:
    spec.camera.camera_matrix.extend([1, 0, 0])


def _singular_matrix(spec: ModelSpec) -> None:
    spec.camera.camera_matrix.extend([0, 0, 50, 0, 100, 30, 0, 0, 1])


def _short_box(spec: ModelSpec) -> None:
    del spec.objects[0].box_corners_m[3:]


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (_no_slots, r"2 slots, but its objects name the slots \[0\]"),
        (_countless_slots, r"4294967295 slots, but its objects name the slots \[0\]"),
        (_two_owners, "slot 0 belongs to both spot and other"),
        (_more_fields, r"spec has \['light'\]"),
        (_unknown_field, r"spec has \['colour'\]"),
        (_wrong_size, "translation_m has size 2"),
        (_other_input, "its inputs are"),
        (_half_a_matrix, "3 values of K"),
        (_singular_matrix, "fx = 0"),
        (_short_box, "has 3 values; expected 8 corners"),
    ],
)
def test_specs_that_do_not_fit_the_graph(
    spot_onnx: MakeOnnx, spot_spec: MakeSpec, tmp_path: Path, spoil: Callable[[ModelSpec], None], words: str
) -> None:
    spec = spot_spec(False)
    spoil(spec)
    with pytest.raises(ModelError, match=words):
        load(_save(spot_onnx(False, spec), tmp_path))


def test_a_graph_that_answers_nonsense(spot_onnx: MakeOnnx, tmp_path: Path) -> None:
    model = spot_onnx(False)
    [tiny] = [t for t in model.graph.initializer if t.name == "full"]
    tiny.raw_data = np.float32(np.nan).tobytes()
    with pytest.raises(ModelError, match="not finite"):
        load(_save(model, tmp_path))


def test_a_graph_onnxruntime_cannot_run(spot_onnx: MakeOnnx, tmp_path: Path) -> None:
    model = spot_onnx(False)
    model.graph.node[0].op_type = "NoSuchOperator"
    with pytest.raises(ModelError, match="onnxruntime refuses the graph"):
        load(_save(model, tmp_path))


@pytest.fixture
def folder(models_dir: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(models_dir / "flat", tmp_path / "flat"))


def test_a_folder_a_version_and_a_file_open_the_same(folder: Path) -> None:
    for path, version in ((folder, 1), (folder / "1", 1), (folder / "1" / "model.onnx", 0)):
        model = open_model(path)
        assert (model.name, model.version) == ("flat", version)


def test_the_latest_version_wins(folder: Path, spot_onnx: MakeOnnx, write_folder: Callable[..., Path]) -> None:
    for version in (2, 10):
        write_folder(folder, spot_onnx(False), version)
    assert open_model(folder).version == 10


def test_a_broken_latest_version_says_which_is_before(folder: Path) -> None:
    shutil.copytree(folder / "1", folder / "2")
    (folder / "2" / "model.onnx").write_bytes(b"torn")
    with pytest.raises(ModelError, match=f"the version before can be named: {folder / '1'}"):
        open_model(folder)
    assert open_model(folder / "1").version == 1


def test_sums_are_compared(folder: Path) -> None:
    sums = folder / "SHA256SUMS"
    good = sums.read_text()
    sums.write_text("0" * 64 + good[64:])
    with pytest.raises(ModelError, match="the file is damaged or was replaced"):
        open_model(folder)
    sums.write_text(good.replace("1/model.onnx", "7/model.onnx"))
    with pytest.raises(ModelError, match=r"does not list 1/model\.onnx"):
        open_model(folder)
    sums.unlink()
    assert open_model(folder).version == 1


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('name: "flat"', 'name: "other"', "Triton wants the folder's"),
        ('backend: "onnxruntime"', 'backend: "pytorch"', "backend is 'pytorch'"),
        ("max_batch_size: 64", "max_batch_size: 0", "max_batch_size is 0"),
        ("TYPE_UINT8", "TYPE_FP32", "inputs are"),
        ("dims: [64, 96, 3]", "dims: [128, 128, 3]", "inputs are"),
        ('name: "color"', 'name: "colour"', "outputs are"),
        ("input [", "input <", "not a Triton model configuration"),
    ],
)
def test_config_is_compared_with_the_graph(folder: Path, old: str, new: str, words: str) -> None:
    config = folder / "config.pbtxt"
    text = config.read_text()
    assert old in text
    config.write_text(text.replace(old, new))
    with pytest.raises(ModelError, match=words):
        open_model(folder)


@pytest.mark.parametrize("name", ["SHA256SUMS", "config.pbtxt", "1/golden.npz"])
def test_files_beside_a_model_are_regular_and_bounded(folder: Path, name: str) -> None:
    file = folder / name
    file.unlink(missing_ok=True)
    os.mkfifo(file)
    with pytest.raises(ModelError, match=f"{name} cannot be read: not a regular file"):
        open_model(folder)
    file.unlink()
    file.touch()
    os.truncate(file, 20 << 30)
    with pytest.raises(ModelError, match=f"{name} cannot be read: 21474836480 bytes, at most"):
        open_model(folder)


def test_model_files_that_are_none(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.onnx")
    with open(tmp_path / "sparse.onnx", "wb") as sparse:
        sparse.truncate(20 << 30)
    for name, words in (("pipe", "not a regular file"), ("sparse", "at most 1073741824 are accepted")):
        with pytest.raises(ModelError, match=words):
            load(tmp_path / f"{name}.onnx")
