"""The exported file against the trained network, and what an export refuses without leaving a trace."""

import hashlib
import json
import shlex
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from curio_train.commands import export as export_command
from curio_train.config import RunConfig
from curio_train.errors import CheckpointError, ExportError, UsageError
from curio_train.export.ahead import TracingAhead
from curio_train.export.card import EVALUATION_FILE, Provenance, card, portable
from curio_train.export.folder import ModelFolder
from curio_train.export.graph import Graph, check_images
from curio_train.export.parity import largest_difference, refuse_disparity
from curio_train.export.write_model import Exported, export
from curio_train.exported_model import ExportedModel, find_model
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.provenance import this_session
from curio_train.learning.state import TrainingProgress
from curio_train.scene_code import CONFIDENCE, ROTATION_6D, TRANSLATION, Field, Layout
from curio_train.worlds import build
from curio_train.worlds.generated.circles import Circles
from curio_train.worlds.options import CaptureOptions, CirclesOptions

WriteRun = Callable[..., Path]


@pytest.fixture
def run(circles_run: Path) -> Path:
    return circles_run


@pytest.fixture
def single(circles_models: tuple[Exported, Exported]) -> Exported:
    return circles_models[0]


@pytest.fixture
def half(circles_models: tuple[Exported, Exported]) -> Exported:
    return circles_models[1]


@pytest.fixture
def models(single: Exported) -> Path:
    return single.path.parents[1]


@pytest.fixture
def network(run: Path) -> torch.nn.Module:
    folder = RunFolder.open(run)
    return folder.trained(build(folder.config.world)).pose.network


def files(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_a_graph_traced_before_there_were_weights_is_the_same(run: Path, single: Exported, tmp_path: Path) -> None:
    with TracingAhead(RunFolder.open(run).config) as ahead:
        done = export(run, tmp_path / "models", ahead=ahead.model)
    found, direct = (onnx.load(exported.path / "model.onnx") for exported in (done, single))
    for node in (*found.graph.node, *direct.graph.node):
        node.ClearField("name")  # some are numbered
    assert found.graph == direct.graph


def test_a_trace_that_ended_with_an_error_is_no_graph(network: torch.nn.Module, run: Path, tmp_path: Path) -> None:
    config = RunFolder.open(run).config
    part = CaptureOptions(mesh=(tmp_path / "missing.stl",), camera=tmp_path / "none.json", photos=tmp_path)
    with TracingAhead(replace(config, world=part, method="templates")) as ahead:
        assert ahead.model(Graph(network, build(config.world))) is None


@pytest.mark.parametrize("num_images", [1, 2, 7])
@torch.no_grad()
def test_the_file_says_what_the_network_says(single: Exported, network: torch.nn.Module, num_images: int) -> None:
    images = np.random.default_rng(num_images).integers(0, 256, (num_images, 128, 128, 3), dtype=np.uint8)
    expected = network(torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255)[TRANSLATION]
    assert expected.std() > 1e-3, "the network answers the same to everything: nothing is compared"
    found = ExportedModel.open(single.path / "model.onnx")(torch.from_numpy(images))
    assert found.keys() == {TRANSLATION}
    assert (found[TRANSLATION] - expected).abs().max() < 1e-4
    assert single.rounding_error == 0


@torch.no_grad()
def test_half_is_half_as_large_and_its_rounding_is_told(
    single: Exported, half: Exported, network: torch.nn.Module
) -> None:
    assert half.num_bytes < 0.51 * single.num_bytes
    assert half.parity_error <= 1e-4
    images = check_images(Circles())
    expected = network(images.permute(0, 3, 1, 2).float() / 255)
    found = ExportedModel.open(half.path / "model.onnx")(images)
    assert half.rounding_error > 0
    assert largest_difference(expected, found) == pytest.approx(half.rounding_error, abs=1e-5)


def test_a_file_stands_alone_and_tells_nothing_of_the_machine(single: Exported, half: Exported) -> None:
    for exported in (single, half):
        assert files(exported.path) == ["golden.npz", "model.onnx", "weights.safetensors"]
        content = (exported.path / "model.onnx").read_bytes()
        model = onnx.load_model_from_string(content)
        assert not any(onnx.external_data_helper.uses_external_data(tensor) for tensor in model.graph.initializer)
        assert b"stack_trace" not in content
        assert str(Path(__file__).parents[2]).encode() not in content


def test_the_golden_image_comes_with_the_models_own_answers(half: Exported) -> None:
    with np.load(half.path / "golden.npz") as golden:
        found = ExportedModel.open(half.path / "model.onnx")(torch.from_numpy(golden["image"][None]))
        assert set(golden.files) == {"image", *found}
        assert all(np.abs(found[name][0].numpy() - golden[name]).max() < 1e-6 for name in found)
        assert golden["image"].max() > 100, "a black picture tells nothing"


def test_the_spec_describes_world_and_making(single: Exported, run: Path) -> None:
    spec = ExportedModel.open(single.path / "model.onnx").spec
    assert (spec.schema_version, spec.name, spec.world, spec.num_slots) == (1, "circles", "circles", 1)
    assert [(f.name, f.size, f.per_object, f.unit, f.frame) for f in spec.fields] == [
        (TRANSLATION, 3, True, "image_width", "image")
    ]
    assert list(spec.fields[0].upper) == pytest.approx(Circles.layout[TRANSLATION].upper)
    assert [(kind.name, list(kind.slots), kind.diameter_m) for kind in spec.objects] == [("circle", [0], 0.2)]
    assert np.reshape(spec.objects[0].box_corners_m, (8, 3)) == pytest.approx(Circles.objects[0].box_corners_m)
    assert (spec.camera.width, spec.camera.height, list(spec.camera.camera_matrix)) == (128, 128, [])
    assert (spec.images_seen, spec.training_seconds) == (64, 1.5)
    assert spec.parity_max_abs_error == single.parity_error
    recipe = json.loads(spec.recipe)
    assert (recipe["world"], recipe["method"], recipe["seed"]) == ({"name": "circles"}, "noncur", 3)


def test_versions_stand_beside_each_other(single: Exported, half: Exported, models: Path) -> None:
    assert (single.path, half.path) == (models / "circles" / "1", models / "circles" / "2")
    assert files(models) == [
        "circles", "circles/1", "circles/1/golden.npz", "circles/1/model.onnx", "circles/1/weights.safetensors",
        "circles/2", "circles/2/golden.npz", "circles/2/model.onnx", "circles/2/weights.safetensors",
        "circles/CARD.md", "circles/SHA256SUMS", "circles/config.pbtxt",
    ]  # fmt: skip
    sums = dict(line.split("  ")[::-1] for line in (models / "circles" / "SHA256SUMS").read_text().splitlines())
    listed = [f"{version}/{file}" for version in (1, 2) for file in ("model.onnx", "golden.npz", "weights.safetensors")]
    assert list(sums) == listed
    for file in listed:
        assert sums[file] == hashlib.sha256((models / "circles" / file).read_bytes()).hexdigest()
    card = (models / "circles" / "CARD.md").read_text()
    assert card.startswith("# circles\n\n## Version 2\n")
    assert card.count("# circles") == 1
    assert "float16" in card.partition("## Version 1")[0]
    assert "float16" not in card.partition("## Version 1")[2]
    assert find_model(models / "circles") == half.path / "model.onnx"


def test_the_card_quotes_an_evaluation_of_the_same_checkpoint_only(single: Exported, tmp_path: Path) -> None:
    spec = ExportedModel.open(single.path / "model.onnx").spec
    config, progress = RunConfig(CirclesOptions(), method="noncur"), TrainingProgress(step=2, images=64, seconds=1.5)
    made = Provenance(tmp_path, config, [this_session()], progress, "float32", pretrained=False, chooses=True)
    result = {"split": "test", "num_images": 500, "metrics": {"position_px": 1.25}, "untrained": {"position_px": 40.0}}
    for images_seen, quoted in ((32, False), (64, True)):
        (tmp_path / EVALUATION_FILE).write_text(json.dumps(result | {"images_seen": images_seen}))
        text = card(1, spec, {TRANSLATION: (1, 3)}, Circles.objects, made)
        assert ("| position_px | 1.25 | 40 |" in text) == quoted
        assert ("had not scored it" in text) != quoted
        assert "real frames" not in text
        assert "| input | `slots`, int64 [wanted]: which rows" in text
    real = {"dataset": "lmo", "split_name": "bop19 targets", "num_targets": 89, "metrics": {"add_recall": 0.25}}
    for refined, column in (({}, "–"), ({"refined": {"real": {"metrics": {"add_recall": 0.5}}}}, "0.5")):
        found = result | {"images_seen": 64, "real": real} | refined
        (tmp_path / EVALUATION_FILE).write_text(json.dumps(found))
        text = card(1, spec, {TRANSLATION: (1, 3)}, Circles.objects, made)
        assert "On 89 targets in real frames of lmo (bop19 targets):" in text
        assert f"| add_recall | 0.25 | {column} |" in text
    fast = card(1, spec, {TRANSLATION: (1, 3)}, Circles.objects, replace(made, reduced=True))
    assert "this model" not in fast
    assert fast.count("| before --fast or --int8 |") == 2


def test_commands_on_cards_name_no_folder_of_a_machine() -> None:
    typed = "curio-train linemod --data /mnt/a b/lmo --out=/data/runs/ape --init ~/ape --class ape --cache ../c"
    words = ["curio-train", "linemod", "--data", "/mnt/a b/lmo", *typed.split()[5:]]
    scales = "curio-train linemod --data lmo --out=ape --init ape --class ape --cache ../c"
    assert portable(shlex.join(words)) == scales
    assert portable(scales) == scales


def test_disagreement_is_refused_and_leaves_nothing(tmp_path: Path, write_run: WriteRun) -> None:
    """Outputs of a billion are exact to a hundred in float32: the order of sums already decides."""
    run = write_run(tmp_path / "run", spread=1e9)
    before = files(tmp_path)
    with pytest.raises(ExportError, match=r"8 of the network's 8 answers to check images change"):
        export(run, tmp_path / "models")
    assert files(tmp_path) == before


def test_a_graph_that_computes_something_else_is_refused() -> None:
    with pytest.raises(ExportError, match=r"torch and onnxruntime differ by 0.5 in translation_m, expected at most"):
        refuse_disparity({TRANSLATION: torch.tensor([1.0, 2.0])}, {TRANSLATION: torch.tensor([1.0, 2.5])})


def test_weights_too_large_for_half_are_refused(tmp_path: Path, write_run: WriteRun) -> None:
    run = write_run(tmp_path / "run", spread=1e7)
    with pytest.raises(ExportError, match="too large for float16; export without --half"):
        export(run, tmp_path / "models", half=True)


def test_other_tensors_under_one_name_are_refused(run: Path, tmp_path: Path, models: Path, single: Exported) -> None:
    target = tmp_path / "circles"
    (target / "1").mkdir(parents=True)
    (target / "1" / "model.onnx").write_bytes((single.path / "model.onnx").read_bytes())
    config = (models / "circles" / "config.pbtxt").read_text()
    (target / "config.pbtxt").write_text(config.replace("128, 128", "256, 256"))
    before = files(tmp_path)
    with pytest.raises(ExportError, match="other inputs or outputs"):
        export(run, tmp_path)
    assert files(tmp_path) == before


@pytest.mark.parametrize("name", ["", "..", "a/b", ".hidden", "x" * 65])
def test_impossible_names_are_refused(run: Path, tmp_path: Path, name: str) -> None:
    with pytest.raises(UsageError, match="--name"):
        export(run, tmp_path, name)


def test_only_detectors_for_several_objects_can_look_less(run: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--fast is for detectors of several objects"):
        export(run, tmp_path, fast=True)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_no_model_is_not_touched(run: Path, tmp_path: Path) -> None:
    (tmp_path / "circles").mkdir()
    (tmp_path / "circles" / "thesis.txt").write_text("dear")
    with pytest.raises(UsageError, match="exists and is no model folder"):
        export(run, tmp_path)
    assert files(tmp_path) == ["circles", "circles/thesis.txt"]


def test_runs_that_cannot_be_read_are_refused(tmp_path: Path, write_run: WriteRun) -> None:
    with pytest.raises(CheckpointError, match="is no run folder"):
        export(tmp_path / "nowhere", tmp_path / "models")
    (tmp_path / "empty").mkdir()
    with pytest.raises(CheckpointError, match="is no run folder"):
        export(tmp_path / "empty", tmp_path / "models")

    untrained = write_run(tmp_path / "untrained")
    checkpoint = RunFolder.open(untrained).checkpoints()[-1]
    checkpoint.rename(checkpoint.with_name("draft.tmp"))  # as a kill in the middle of writing leaves it
    with pytest.raises(CheckpointError, match=r"has no checkpoint yet; train it first: --resume"):
        export(untrained, tmp_path / "models")

    cut = write_run(tmp_path / "cut")
    tensors = RunFolder.open(cut).checkpoints()[-1] / "tensors.safetensors"
    tensors.write_bytes(tensors.read_bytes()[:-1000])
    with pytest.raises(CheckpointError, match="cannot be read"):
        export(cut, tmp_path / "models")
    assert not (tmp_path / "models").exists()


def test_a_place_that_cannot_be_written_is_told(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(SystemExit) as exit_:
        export_command.export([str(run), "--out", str(tmp_path / "file")])
    assert exit_.value.code == 1
    said = capsys.readouterr().err
    assert said.startswith("error: cannot write ")
    assert "--out" in said


def test_a_full_disk_leaves_nothing_behind(
    tmp_path: Path, largest_file: Callable[[int], AbstractContextManager[None]]
) -> None:
    folder, small, large = (
        ModelFolder.named(tmp_path / "models", "circles"),
        {"model.onnx": b"small"},
        "card\n" * 300_000,
    )
    told = "File too large; name another folder: --out"
    with largest_file(1_000_000), pytest.raises(ExportError, match=told):
        folder.add(1, {"golden.npz": b"small", "model.onnx": bytes(2_000_000)}, "config", "card")
    assert files(tmp_path) == ["models"]
    folder.add(1, small, "config", large)
    before = {path: path.read_bytes() for path in folder.files()}
    with largest_file(1_000_000), pytest.raises(ExportError, match=told):
        folder.add(2, small, "config", "card")
    assert folder.versions() == [1]
    assert {path: path.read_bytes() for path in folder.files()} == before
    (folder.path / "CARD.md").unlink()
    with largest_file(10_000), pytest.raises(ExportError, match=told):
        folder.add(2, small, "config", large)
    assert "CARD.md" not in [path.name for path in folder.files()]


class _Everything(Circles):
    """Every field that is exported as it is; never rendered."""

    layout = Layout((*Circles.layout.fields, Field(ROTATION_6D, 6), Field(CONFIDENCE, 1)), num_slots=2)


def test_physical_outputs_hold_the_scene_code() -> None:
    world, generator = _Everything(), torch.Generator().manual_seed(0)
    code = {f.name: torch.rand(world.layout.shape(f, 5), generator=generator) for f in world.layout.fields}
    outputs = world.outputs.from_code(code)
    assert {name: tuple(value.shape) for name, value in outputs.items()} == {
        TRANSLATION: (5, 2, 3), ROTATION_6D: (5, 2, 6), CONFIDENCE: (5, 2), "rotation": (5, 2, 3, 3)
    }  # fmt: skip
    rotation = outputs["rotation"]
    assert rotation @ rotation.transpose(-1, -2) == pytest.approx(torch.eye(3).expand(5, 2, 3, 3), abs=1e-5)
    columns = rotation[..., :2].transpose(-1, -2).flatten(-2)
    assert outputs[ROTATION_6D] == pytest.approx(columns, abs=1e-6)
    back = world.outputs.to_code(outputs)
    world.layout.check(back)
    assert torch.equal(back[CONFIDENCE], code[CONFIDENCE])
    assert world.outputs.from_code(back)["rotation"] == pytest.approx(rotation, abs=1e-5)


def test_differences_that_are_not_numbers_are_infinite() -> None:
    one = {"a": torch.tensor([1.0, 2.0])}
    assert largest_difference(one, {"a": torch.tensor([1.0, 2.5])}) == 0.5
    assert largest_difference(one, {"a": torch.tensor([1.0, float("nan")])}) == float("inf")
    assert largest_difference(one, {"a": torch.tensor([1.0])}) == float("inf")
    assert largest_difference(one, {}) == float("inf")
    assert largest_difference({"a": torch.zeros(0, 3)}, {"a": torch.zeros(0, 3)}) == 0
