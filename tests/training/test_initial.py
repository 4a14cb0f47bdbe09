"""What a run may begin with: runs and exported models give the same network, and what they are not is told."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from curio_train.config import NetworkConfig, RunConfig
from curio_train.errors import CheckpointError, CurioError, UsageError
from curio_train.export.card import EVALUATION_FILE
from curio_train.export.write_model import Exported, export
from curio_train.exported_model import ExportedModel
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.initial import begin_with, method_before, uses_synthetic_labels
from curio_train.learning.runs.interruption import Interruption
from curio_train.learning.session import learn
from curio_train.learning.state import TrainState
from curio_train.worlds.generated.circles import Circles
from curio_train.worlds.options import CirclesOptions
from safetensors.torch import save_file
from torch import Tensor

CONFIG = RunConfig(CirclesOptions(), method="noncur")

pytestmark = pytest.mark.usefixtures("small_image_sets")


@pytest.fixture
def run(circles_run: Path) -> Path:
    return circles_run


@pytest.fixture
def model(circles_models: tuple[Exported, Exported]) -> Path:
    """Version 1 in float32, version 2 in float16."""
    return circles_models[0].path.parent


def begun(path: Path, config: RunConfig = CONFIG) -> TrainState:
    state = TrainState(config, Circles(), torch.device("cpu"))
    begin_with(state, path)
    return state


def network(state: TrainState) -> dict[str, Tensor]:
    return state.pose.network.state_dict()


def test_the_method_before_is_that_of_a_run_that_can_be_read(run: Path, model: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged"
    shutil.copytree(run, damaged)
    (damaged / "config.json").write_text("{")
    found = {path: method_before(replace(CONFIG, method="our", init=path)) for path in (run, model, damaged, None)}
    assert found == {run: "noncur", model: None, damaged: None, None: None}


def test_to_read_a_trained_network_no_optimiser_is_made(run: Path) -> None:
    """Torch imports its compiler for the first one, which takes seconds."""
    code = (
        "import sys; from pathlib import Path; from curio_train.learning.runs.checkpoint import RunFolder\n"
        "from curio_train.worlds.generated.circles import Circles\n"
        f"RunFolder.open(Path({str(run)!r})).trained(Circles()); print('torch._dynamo' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout == "False\n", done


def test_a_model_gives_the_network_that_it_was_exported_from(run: Path, model: Path) -> None:
    """Batch norm's statistics, which write_run draws at random, among it."""
    expected = network(RunFolder.open(run).trained(Circles()))
    assert not torch.equal(expected["encoder.layers.0.weight"], network(begun_anew())["encoder.layers.0.weight"])
    for path, tolerance in ((run, 0.0), (model / "1", 0.0), (model / "2", 1e-3), (model, 1e-3)):
        state = begun(path)
        found = network(state)
        assert found.keys() == expected.keys()
        for name, value in expected.items():
            assert found[name].dtype == value.dtype
            assert torch.allclose(found[name], value, rtol=tolerance, atol=1e-6 * bool(tolerance)), name
        assert (state.progress.all_images, state.progress.images, state.progress.all_seconds) == (64, 0, 1.5)
    assert not torch.equal(network(begun(model))["encoder.layers.0.weight"], expected["encoder.layers.0.weight"])
    assert (model / "2" / "weights.safetensors").stat().st_size < 0.51 * (
        model / "1" / "weights.safetensors"
    ).stat().st_size


def begun_anew() -> TrainState:
    return TrainState(CONFIG, Circles(), torch.device("cpu"))


def test_images_count_on_over_models_and_in_their_cards(model: Path, tmp_path: Path, cache: Path) -> None:
    path = tmp_path / "run"
    config = replace(CONFIG, images=8, init=model, recipe=replace(CONFIG.recipe, batch_size=4, micro_batch_size=4))
    learn(config, path, Interruption(), resume=False, cache=cache)
    learn(replace(config, images=12), path, Interruption(), resume=True, cache=cache)
    (path / EVALUATION_FILE).write_text('{"images_seen": 76, "split": "test", "num_images": 5, "metrics": {"a": 2.0}}')
    version = export(path, tmp_path / "models").path
    spec = ExportedModel.open(version / "model.onnx").spec
    assert spec.images_seen == 64 + 12
    assert spec.training_seconds > 1.5
    card = (version.parent / "CARD.md").read_text()
    assert "| images seen | 76 (64 of the network it began with, 12 here) |" in card
    assert card.count("; then `") == 1  # the second session
    assert "| a | 2 |" in card
    assert "`curio-train circles --init models/circles/1`" in card
    assert begun(version).progress.images_before == 76


def test_a_run_killed_before_its_first_checkpoint_begins_with_the_same_network(
    run: Path, tmp_path: Path, cache: Path
) -> None:
    still = replace(CONFIG.recipe, batch_size=4, micro_batch_size=4, learning_rate=1e-30)
    config = replace(CONFIG, images=4, init=run, recipe=still)
    RunFolder(tmp_path / "run", config).write_config(new=True)
    learn(config, tmp_path / "run", Interruption(), resume=True, cache=cache)
    learned, expected = (network(RunFolder.open(path).trained(Circles())) for path in (tmp_path / "run", run))
    assert torch.equal(learned["encoder.layers.0.weight"], expected["encoder.layers.0.weight"])


def test_what_taught_a_model_is_known_of_runs_that_begin_with_it(model: Path, run: Path, tmp_path: Path) -> None:
    assert not uses_synthetic_labels(CONFIG)
    assert all(uses_synthetic_labels(replace(CONFIG, method=method)) for method in ("super", "sleep", "wake_sleep"))
    assert not uses_synthetic_labels(replace(CONFIG, init=run))
    assert not uses_synthetic_labels(replace(CONFIG, init=model))
    assert uses_synthetic_labels(replace(CONFIG, init=tmp_path / "gone"))
    slept = tmp_path / "slept"
    RunFolder(slept, replace(CONFIG, method="sleep")).write_config(new=True)
    assert uses_synthetic_labels(replace(CONFIG, init=slept))


def without_weights(version: Path) -> None:
    (version / "weights.safetensors").unlink()


def cut(version: Path) -> None:
    file = version / "weights.safetensors"
    file.write_bytes(file.read_bytes()[:-7])


def a_pipe(version: Path) -> None:
    (version / "weights.safetensors").unlink()
    os.mkfifo(version / "weights.safetensors")


def a_device(version: Path) -> None:
    (version / "weights.safetensors").unlink()
    (version / "weights.safetensors").symlink_to("/dev/zero")


def far_too_large(version: Path) -> None:
    os.truncate(version / "weights.safetensors", 50 << 30)


def with_strange_notes(version: Path) -> None:
    save_file(
        {},
        version / "weights.safetensors",
        dict.fromkeys(("images_seen", "training_seconds", "synthetic_labels"), "many"),
    )


def of_nothing(version: Path) -> None:
    (version / "model.onnx").unlink()


@pytest.mark.parametrize(
    ("damage", "error", "text"),
    [
        (without_weights, CheckpointError, r"circles/1 was exported without weights.safetensors"),
        (cut, CheckpointError, r"weights\.safetensors cannot be read .*export the model anew"),
        (a_pipe, CheckpointError, r"weights\.safetensors cannot be read \(.*not a regular file"),
        (a_device, CheckpointError, r"weights\.safetensors cannot be read \(.*not a regular file"),
        (far_too_large, CheckpointError, r"weights\.safetensors cannot be read \(.*at most 2147483648 are accepted"),
        (with_strange_notes, CheckpointError, r"weights\.safetensors says .*many.*export the model anew"),
        (of_nothing, UsageError, "neither a run folder .* nor a model"),
    ],
)
def test_what_cannot_be_begun_with_is_told(
    model: Path, tmp_path: Path, damage: Callable[[Path], None], error: type[CurioError], text: str
) -> None:
    version = Path(shutil.copytree(model / "1", tmp_path / "circles" / "1"))
    damage(version)
    with pytest.raises(error, match=text):
        begun(version)


def test_a_first_network_that_is_not_there_leaves_no_run(tmp_path: Path, cache: Path) -> None:
    config = replace(CONFIG, images=4, init=tmp_path / "nowhere")
    with pytest.raises(UsageError, match="neither a run folder"):
        learn(config, tmp_path / "run", Interruption(), resume=False, cache=cache)
    assert not (tmp_path / "run").exists()


def test_the_first_network_is_found_from_every_folder(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(run.parent)
    config = replace(CONFIG, init=Path(run.name))
    monkeypatch.chdir(tmp_path)
    assert method_before(config) == CONFIG.method


def test_networks_of_other_shapes_name_what_differs(model: Path) -> None:
    other = replace(CONFIG, network=NetworkConfig(hidden=16))
    with pytest.raises(UsageError, match=r"--init .*: its network does not fit this world \(size mismatch for heads"):
        begun(model, other)
