"""Some of a model's kinds of objects, asked for by name: in process, on the command line, over gRPC, in streams."""

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
from curio_proto.v1 import detector_pb2 as messages
from curio_proto.v1.model_spec_pb2 import ModelSpec
from curio_serve.batch.arguments import DetectArguments
from curio_serve.batch.detect_cli import run
from curio_serve.client import PoseClient
from curio_serve.client.request import detect_request, views_request
from curio_serve.errors import ArgumentError, UsageError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.models.detector import Detector
from curio_serve.models.model import SLOTS, answering
from curio_serve.models.model_folder import open_model
from curio_serve.models.runtime import Runtime
from google.protobuf import json_format
from onnx import TensorProto, helper, numpy_helper

K = np.array([[110.0, 0, 50.0], [0, 112.0, 30.0], [0, 0, 1]])
KINDS = {"bolt": [0], "nut": [1, 2], "plate": [3]}
PLACES = np.array([[0.0, 0, 1.0], [0.1, 0, 1.1], [0.2, 0, 1.2], [0.3, 0, 1.3]], np.float32)
SURE = np.array([0.9, 0.5, 0.7, 0.8], np.float32)
GREY = np.full((64, 96, 3), 90, np.uint8)


def _onnx(name: str, spec: ModelSpec, *, takes_slots: bool) -> onnx.ModelProto:
    """A model of four slots and three kinds that sees each at its place, whatever the image."""
    spec.name, spec.num_slots = name, len(PLACES)
    kinds = [spec.objects[0]] * len(KINDS)
    del spec.objects[:]
    for (kind, slots), like in zip(KINDS.items(), kinds, strict=True):
        one = spec.objects.add()
        one.CopyFrom(like)
        one.name, one.slots[:] = kind, slots
    node, every = helper.make_node, np.arange(len(PLACES))
    tables = {
        "translation_m": PLACES,
        "rotation": np.tile(np.eye(3, dtype=np.float32), (4, 1, 1)),
        "rotation_6d": np.tile(np.eye(3, dtype=np.float32)[:, :2].T.reshape(6), (4, 1)),
        "color": np.ones((4, 3), np.float32),
        "confidence": SURE,
    }
    constants = {f"{key}_of_all": value for key, value in tables.items()} | {
        SLOTS: every,
        "pixel": np.array([1, 2, 3]),
        "none": np.float32(0),
        "light_value": np.array([[0, -1, 0]], np.float32),
    }
    nodes = [
        node("Cast", ["image"], ["float"], to=TensorProto.FLOAT),
        node("ReduceMean", ["float", "pixel"], ["mean"], keepdims=0),
        node("Mul", ["mean", "none"], ["nothing"]),
    ]
    for key, value in tables.items():
        constants[f"{key}_shape"] = np.array([-1, *[1] * value.ndim])
        nodes += [
            node("Gather", [f"{key}_of_all", SLOTS], [f"{key}_chosen"], axis=0),
            node("Reshape", ["nothing", f"{key}_shape"], [f"{key}_nothing"]),
            node("Add", [f"{key}_nothing", f"{key}_chosen"], [key]),
        ]
    constants["row"] = np.array([-1, 1])
    nodes += [
        node("Reshape", ["nothing", "row"], ["light_nothing"]),
        node("Add", ["light_nothing", "light_value"], ["light"]),
    ]
    given = [helper.make_tensor_value_info("image", TensorProto.UINT8, ["b", 64, 96, 3])]
    if takes_slots:
        given.append(helper.make_tensor_value_info(SLOTS, TensorProto.INT64, ["wanted"]))
    shapes = {key: ["b", "n" if takes_slots else 4, *value.shape[1:]] for key, value in tables.items()}
    graph = helper.make_graph(
        nodes,
        name,
        given,
        [helper.make_tensor_value_info(k, TensorProto.FLOAT, s) for k, s in (shapes | {"light": ["b", 3]}).items()],
        [numpy_helper.from_array(np.asarray(value), key) for key, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    model.metadata_props.add(key="curio.model_spec").value = json_format.MessageToJson(spec)
    onnx.checker.check_model(model)
    return model


@pytest.fixture(scope="module")
def models(
    tmp_path_factory: pytest.TempPathFactory,
    spot_spec: Callable[[bool], ModelSpec],
    spot_onnx: Callable[..., onnx.ModelProto],
    write_folder: Callable[..., Path],
) -> Path:
    """``choosing``, whose graph computes wanted slots alone, ``whole``, whose graph cannot, and ``pinhole``."""
    root = tmp_path_factory.mktemp("models")
    for name, takes_slots in (("choosing", True), ("whole", False)):
        folder = write_folder(root / name, _onnx(name, spot_spec(True), takes_slots=takes_slots))
        (folder / "config.pbtxt").unlink()  # how many outputs there are is free in the graph
    write_folder(root / "pinhole", spot_onnx(True))
    return root


@pytest.fixture(scope="module")
def client(models: Path, start_server: Callable[..., Any]) -> Iterator[PoseClient]:
    with PoseClient(start_server(models).address) as found:
        yield found


def names(result: messages.RegionResult) -> list[str]:
    return [detection.object for detection in result.detections]


@pytest.mark.parametrize("max_batch", [1, 4])
@pytest.mark.parametrize("name", ["choosing", "whole"])
@pytest.mark.parametrize(
    ("wanted", "rows"), [(["bolt"], [0]), (["nut"], [1, 2]), (["plate", "bolt"], [0, 3]), ([*KINDS], [0, 1, 2, 3])]
)
def test_a_part_answers_as_the_whole_does(
    models: Path, name: str, wanted: list[str], rows: list[int], max_batch: int
) -> None:
    model = open_model(models / name, Runtime(max_batch=max_batch))
    part, images = model.of(wanted), np.stack([GREY, GREY])
    every, some = model.run(images), part.run(images)
    assert every["translation_m"].shape == (2, 4, 3)
    for output, values in some.items():
        np.testing.assert_array_equal(values, every[output] if output == "light" else every[output][:, rows])
    assert [slot.object for slot in part.slots] == [model.slots[row].object for row in rows]
    assert part.spec.num_slots == len(rows) == sum(len(kind.slots) for kind in part.spec.objects)
    assert part.output_shapes["translation_m"] == (len(rows), 3)
    assert (part is model) == (len(rows) == 4)


class Watched:
    """A session that keeps what it was given."""

    def __init__(self, session: Any) -> None:
        self._session, self.given = session, dict[str, np.ndarray]()

    def run(self, outputs: None, given: dict[str, np.ndarray]) -> Any:
        self.given = given
        return self._session.run(outputs, given)


@pytest.mark.parametrize(("name", "told"), [("choosing", [1, 2]), ("whole", None)])
def test_a_graph_that_can_is_told_which_slots(models: Path, name: str, told: list[int] | None) -> None:
    part = open_model(models / name).of(["nut"])
    part._session = watched = Watched(part._session)  # type: ignore[assignment]
    part.run(GREY[None])
    assert (watched.given[SLOTS].tolist() if SLOTS in watched.given else None) == told


def test_a_part_of_a_part_is_counted_in_the_whole(models: Path) -> None:
    for name in ("choosing", "whole"):
        part = open_model(models / name).of(["nut", "plate"]).of(["plate"])
        np.testing.assert_array_equal(part.run(GREY[None])["translation_m"], PLACES[None, 3:])


def test_names_that_no_model_knows_are_refused(models: Path) -> None:
    opened = [open_model(models / name) for name in ("choosing", "pinhole")]
    assert answering(opened, []) == opened
    with pytest.raises(ArgumentError, match="objects names 'bolts'; expected some of bolt, nut, plate, spot"):
        answering(opened, ["bolt", "bolts"])
    with pytest.raises(ArgumentError, match="objects names bolt, and model pinhole/1 knows none but spot"):
        answering(opened, ["bolt"])
    assert [model.spec.num_slots for model in answering(opened, ["spot", "bolt"])] == [1, 1]


@pytest.mark.parametrize("name", ["choosing", "whole"])
def test_the_server_answers_what_is_asked_for(client: PoseClient, name: str) -> None:
    every = client.detect(name, GREY, K)
    some = client.detect(name, GREY, K, objects=["nut"])
    assert names(every.results[0]) == ["bolt", "plate", "nut", "nut"]
    assert some.results[0].detections == [one for one in every.results[0].detections if one.object == "nut"]
    read_often = client.detect(name, GREY, K, objects=["bolt"], reads=3) if name == "choosing" else None
    assert read_often is None or names(read_often.results[0]) == ["bolt"]


def test_the_server_refuses_other_names(client: PoseClient) -> None:
    with pytest.raises(ArgumentError, match="objects names 'spott'; expected some of spot"):
        client.detect("pinhole", GREY, K, objects=["spott"])
    with pytest.raises(ArgumentError, match="objects is the text 'nut'; expected a list of names"):
        client.detect("choosing", GREY, K, objects="nut")


def test_a_rig_is_asked_for_some_too(client: PoseClient) -> None:
    apart = np.eye(4)
    apart[0, 3] = 0.1
    views = [(GREY, K, np.eye(4)), (GREY, K, apart)]
    request = views_request("choosing", views, objects=["plate"])
    assert list(request.objects) == ["plate"]
    assert {*names(client.detect_views("choosing", views, objects=["plate"]).results[0])} <= {"plate"}


def test_a_stream_forgets_what_is_no_longer_asked_for(client: PoseClient) -> None:
    wanted = [["bolt", "plate"], ["bolt", "plate"], ["plate"], ["bolt", "plate"]]
    requests = [
        detect_request("choosing", GREY, K, objects=some, track=messages.Tracking(time_s=0.1 * (number + 1)))
        for number, some in enumerate(wanted)
    ]
    answers = list(client.detect_stream(requests, timeout_s=60))
    assert [sorted(names(answer.results[0])) for answer in answers] == wanted
    ids = [{one.object: one.track.track_id for one in answer.results[0].detections} for answer in answers]
    assert {one["plate"] for one in ids} == {ids[0]["plate"]}
    assert ids[3]["bolt"] != ids[1]["bolt"]


def detect(model: str, folder: Path, more: tuple[str, ...] = (), **flags: Any) -> list[str]:
    """The objects that the command writes down about one image."""
    cv2.imwrite(str(folder / "frame.png"), GREY)
    (folder / "camera.json").write_text(json.dumps({"camera_matrix": K.tolist(), "width": 96, "height": 64}))
    out = folder / "out.jsonl"
    call = DetectArguments(
        model, (*more, str(folder / "frame.png")), camera=folder / "camera.json", out=str(out), overwrite=True, **flags
    )
    assert run(call) == 0
    return [one["object"] for line in out.read_text().splitlines() for one in json.loads(line)["detections"]]


def test_of_several_models_each_is_asked_for_what_it_knows(models: Path, client: PoseClient, tmp_path: Path) -> None:
    """Behind a server as without one."""
    for names_of in ((models / "choosing", models / "pinhole"), ("choosing", "pinhole")):
        first, second = (str(one) if isinstance(one, Path) else f"{client.address}/{one}" for one in names_of)
        found = detect(first, tmp_path, more=(second,), objects="plate,spot")
        assert {"plate"} <= {*found} <= {"plate", "spot"}


def test_the_command_writes_what_is_asked_for(models: Path, client: PoseClient, tmp_path: Path) -> None:
    for model in (str(models / "choosing"), str(models / "whole"), f"{client.address}/choosing"):
        assert detect(model, tmp_path, objects="nut, bolt") == ["bolt", "nut", "nut"]
    assert detect(str(models / "choosing"), tmp_path, objects="plate", track=True) == ["plate"]


@pytest.mark.parametrize(
    ("objects", "told"),
    [
        ("bolt,", "--objects bolt,: expected names with commas between them, such as ape,can"),
        ("bolt,screw", "--objects: objects names 'screw'; expected some of bolt, nut, plate"),
        ("screw", "objects names screw, and model"),
    ],
)
def test_the_command_refuses_other_names(
    models: Path, client: PoseClient, tmp_path: Path, objects: str, told: str
) -> None:
    for model in (str(models / "choosing"), f"{client.address}/choosing"):
        with pytest.raises(UsageError, match=re.escape(told)):
            detect(model, tmp_path, objects=objects)


def test_detectors_take_parts(models: Path) -> None:
    part = open_model(models / "choosing").of(["plate"])
    (result,) = Detector(part).detect(GREY, PinholeCamera(K))
    assert names(result) == ["plate"]
    assert result.detections[0].translation_m == pytest.approx(PLACES[3], abs=1e-6)


def test_calls_for_the_same_objects_share_a_part(models: Path) -> None:
    """So that their images are batched; of a model's very many parts some are kept."""
    model = open_model(models / "choosing", Runtime(max_batch=4))
    part = model.of(["nut"])
    assert model.of(["nut"]) is part
    assert model.of(["bolt", "nut"]) is not part
    assert model.of(["bolt", "nut"]).of(["nut"]) is not part, "which is counted in the part"
