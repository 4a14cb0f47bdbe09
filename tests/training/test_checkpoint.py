"""Run folders: what is saved is restored bit for bit, and nothing that goes wrong costs what was saved."""

import json
import os
import shutil
import signal
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from curio_train.config import ConvStack, NetworkConfig, Recipe, RunConfig
from curio_train.errors import CheckpointError, ResumeMismatch, UsageError
from curio_train.learning.loop import Outcome
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.configuration import load_config, refuse_other
from curio_train.learning.runs.interruption import Interruption
from curio_train.learning.runs.provenance import SESSIONS, record_session, run_sessions
from curio_train.learning.session import learn
from curio_train.learning.state import TrainState
from curio_train.worlds import image_sets
from curio_train.worlds.generated.circles import Circles
from curio_train.worlds.options import CirclesOptions, LinemodOptions
from torch import Tensor

pytestmark = pytest.mark.usefixtures("one_thread", "small_image_sets")

LargestFile = Callable[[int], AbstractContextManager[None]]

CONFIG = RunConfig(
    CirclesOptions(),
    method="wake_sleep_critic",
    images=48,
    recipe=Recipe(batch_size=8, micro_batch_size=4, gradient_penalty=1.0, gradient_penalty_every=2, warm_up_steps=3),
    network=NetworkConfig(
        encoder=ConvStack((8, 16, 16, 32, 32), (11, 5, 3, 3, 3), (4, 2, 2, 2, 2), (0, 1, 1, 1, 0)),
        critic=ConvStack((8, 8, 16, 16, 1), (11, 5, 3, 3, 3), (4, 4, 2, 2, 2), (0, 0, 1, 1, 1)),
    ),
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, cache: Path) -> Path:
    """A run of six steps, which many tests begin with; each has a copy of its own."""
    path = tmp_path_factory.mktemp("trained") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(image_sets, "NUM_IMAGES", {"train": 100, "validation": 50, "test": 50})
        train(path, cache)
    return path


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Path:
    return shutil.copytree(trained, tmp_path / "run")


def train(path: Path, cache: Path, config: RunConfig = CONFIG, *, resume: bool = False) -> None:
    learn(config, path, Interruption(), resume=resume, cache=cache)


def last_tensors(path: Path) -> dict[str, Tensor]:
    run = RunFolder.open(path)
    state = TrainState(run.config, Circles(), torch.device("cpu"))
    run.restore(state)
    return state.tensors()


def assert_same(one: dict[str, Tensor], other: dict[str, Tensor]) -> None:
    assert one.keys() == other.keys()
    assert [name for name in one if not torch.equal(one[name], other[name])] == []


def test_a_resumed_run_is_the_uninterrupted_one_bit_for_bit(tmp_path: Path, cache: Path) -> None:
    train(tmp_path / "whole", cache)
    train(tmp_path / "pieces", cache, replace(CONFIG, images=16))
    train(tmp_path / "pieces", cache, replace(CONFIG, images=40), resume=True)
    train(tmp_path / "pieces", cache, resume=True)
    assert_same(last_tensors(tmp_path / "whole"), last_tensors(tmp_path / "pieces"))
    courses = [
        json.loads((RunFolder.open(tmp_path / name).checkpoints()[-1] / "course.json").read_text())
        for name in ("whole", "pieces")
    ]
    assert courses[0].pop("seconds") > 0
    assert courses[1].pop("seconds") > 0
    assert courses[0] == courses[1]


def test_a_run_may_begin_with_the_network_of_another(tmp_path: Path, cache: Path) -> None:
    train(tmp_path / "first", cache)
    # A learning rate this small moves no weight: what is left is what the run began with.
    still = replace(CONFIG, images=8, recipe=replace(CONFIG.recipe, learning_rate=1e-30), init=tmp_path / "first")
    train(tmp_path / "second", cache, still)
    first, second = (last_tensors(tmp_path / name) for name in ("first", "second"))
    weights = [name for name in first if name.startswith("pose.network.") and name.endswith("weight")]
    assert weights
    assert all(torch.equal(first[name], second[name]) for name in weights)
    assert not torch.equal(first["critic.network.layers.0.weight"], second["critic.network.layers.0.weight"])
    resumed = replace(still, images=16)
    train(tmp_path / "second", cache, resumed, resume=True)

    others = replace(still, network=replace(CONFIG.network, hidden=16))
    with pytest.raises(UsageError, match=r"--init .*first: its network does not fit"):
        train(tmp_path / "third", cache, others)
    with pytest.raises(UsageError, match="neither a run folder"):
        train(tmp_path / "fourth", cache, replace(still, init=tmp_path / "nothing"))


def test_two_checkpoints_are_kept(tmp_path: Path, cache: Path) -> None:
    learn(CONFIG, tmp_path / "run", Interruption(), resume=False, cache=cache, checkpoint_minutes=0)
    kept = [path.name for path in sorted((tmp_path / "run/checkpoints").iterdir())]
    assert kept == ["00000005", "00000006"]


def test_a_full_disk_costs_no_earlier_checkpoint(run: Path, largest_file: LargestFile) -> None:
    before, folder = last_tensors(run), RunFolder.open(run)
    state = folder.trained(Circles())
    state.progress.step += 1
    with largest_file(50_000), pytest.raises(CheckpointError, match=r"cannot write checkpoint .*00000006 is intact"):
        folder.save(state)
    assert [path.name for path in (run / "checkpoints").iterdir()] == ["00000006"]
    assert_same(before, last_tensors(run))


def test_a_full_disk_ends_training_with_that_error(tmp_path: Path, cache: Path, largest_file: LargestFile) -> None:
    Circles().source("train", 0, with_code=False, cache=cache)
    with largest_file(100_000), pytest.raises(CheckpointError, match="there is no earlier one"):
        train(tmp_path / "run", cache)


def test_what_a_killed_writer_left_is_no_checkpoint(run: Path, cache: Path) -> None:
    draft = run / "checkpoints/draft.tmp"
    draft.mkdir()
    (draft / "tensors.safetensors").write_bytes(b"half")
    train(run, cache, replace(CONFIG, images=56), resume=True)
    assert RunFolder.open(run).checkpoints()[-1].name == "00000007"
    assert not draft.exists()


def test_a_run_killed_before_its_first_checkpoint_starts_again(tmp_path: Path, cache: Path) -> None:
    train(tmp_path / "whole", cache)
    RunFolder(tmp_path / "killed", CONFIG).write_config(new=True)
    train(tmp_path / "killed", cache, resume=True)
    assert_same(last_tensors(tmp_path / "whole"), last_tensors(tmp_path / "killed"))


@pytest.mark.parametrize("file", ["tensors.safetensors", "course.json"])
def test_a_damaged_checkpoint_is_named(run: Path, cache: Path, file: str) -> None:
    damaged = run / "checkpoints/00000006" / file
    damaged.write_bytes(damaged.read_bytes()[:-7])
    with pytest.raises(CheckpointError, match=r"00000006 cannot be read .*delete this folder to go on"):
        train(run, cache, resume=True)


def test_a_flipped_bit_is_found(run: Path, cache: Path) -> None:
    file = run / "checkpoints/00000006/tensors.safetensors"
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    with pytest.raises(CheckpointError, match="not what SHA256SUMS says"):
        train(run, cache, resume=True)


@pytest.mark.parametrize("value", ['"7"', "-5", "1e30", "NaN", "null", "[" * 100_000])
@pytest.mark.parametrize("field", ["step", "seconds"])
def test_impossible_progress_is_refused(run: Path, cache: Path, field: str, value: str) -> None:
    last = run / "checkpoints/00000006"
    (last / "SHA256SUMS").unlink(missing_ok=True)  # as earlier versions wrote it
    progress = json.loads((last / "course.json").read_text()) | {field: "@"}
    (last / "course.json").write_text(json.dumps(progress).replace('"@"', value))
    with pytest.raises(CheckpointError, match="00000006 cannot be read"):
        train(run, cache, resume=True)


def test_files_that_are_pipes_or_endless_are_refused(run: Path, cache: Path) -> None:
    tensors = run / "checkpoints/00000006/tensors.safetensors"
    os.truncate(tensors, 50 << 30)
    with pytest.raises(CheckpointError, match="at most"):
        train(run, cache, resume=True)
    (run / "config.json").unlink()
    os.mkfifo(run / "config.json")
    with pytest.raises(CheckpointError, match="not a regular file"):
        load_config(run)


def test_a_history_that_is_a_pipe_or_endless_is_refused(run: Path, cache: Path) -> None:
    file = run / "history.jsonl"
    os.truncate(file, 50 << 30)
    with pytest.raises(CheckpointError, match=r"history\.jsonl cannot be read .*at most"):
        train(run, cache, resume=True)
    file.unlink()
    os.mkfifo(file)
    with pytest.raises(CheckpointError, match=r"history\.jsonl cannot be read .*not a regular file"):
        train(run, cache, resume=True)


def test_sessions_that_are_a_pipe_or_endless_are_refused(tmp_path: Path) -> None:
    file = tmp_path / SESSIONS
    file.touch()
    os.truncate(file, 50 << 30)
    with pytest.raises(CheckpointError, match="at most"):
        run_sessions(tmp_path)
    file.unlink()
    os.mkfifo(file)
    with pytest.raises(CheckpointError, match="not a regular file"):
        run_sessions(tmp_path)
    with pytest.raises(CheckpointError, match="not a regular file"):
        record_session(tmp_path)
    with pytest.raises(CheckpointError, match="not a regular file"), RunFolder(tmp_path, CONFIG).lock():
        pass


@pytest.mark.parametrize("content", [b"\xff\xfe}\n", b"[]}\n", b'{"images": 8}\n', b"[" * 100_000 + b"}\n"])
def test_a_damaged_history_is_named(run: Path, cache: Path, content: bytes) -> None:
    (run / "history.jsonl").write_bytes(content)
    with pytest.raises(CheckpointError, match=r"history.jsonl cannot be read .*delete it"):
        train(run, cache, resume=True)


def test_two_processes_do_not_train_one_run(run: Path, cache: Path) -> None:
    wanted = replace(CONFIG, images=56)
    with (
        RunFolder(run, CONFIG).lock(),
        pytest.raises(CheckpointError, match=r"another process trains .*run: `.*`, started 20"),
    ):
        train(run, cache, wanted, resume=True)
    assert load_config(run) == CONFIG
    train(run, cache, wanted, resume=True)


def test_history_has_no_line_twice_after_a_kill(run: Path, cache: Path) -> None:
    with (run / "history.jsonl").open("a") as file:
        file.write('{"step": 7, "images": 56, "seconds": 1.0, "image": 1.0}\n{"step": 8, "ima')
    train(run, cache, replace(CONFIG, images=64), resume=True)
    rows = [json.loads(line) for line in (run / "history.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows if "image" in row] == [6, 8]
    assert [row["step"] for row in rows if "image_dssim" in row] == [6, 8]


def test_a_run_folder_is_not_written_over(tmp_path: Path, cache: Path) -> None:
    RunFolder(tmp_path, CONFIG).write_config(new=True)
    with pytest.raises(UsageError, match=r"holds a run already.*--resume.*--out"):
        RunFolder(tmp_path, CONFIG).write_config(new=True)


def test_a_folder_that_cannot_be_written_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(CheckpointError, match=r"cannot write the run folder .*--out"):
        RunFolder(tmp_path / "file/run", CONFIG).write_config(new=True)


def test_a_run_without_checkpoints_has_no_network(tmp_path: Path) -> None:
    RunFolder(tmp_path, CONFIG).write_config(new=True)
    with pytest.raises(CheckpointError, match="has no checkpoint yet"):
        RunFolder.open(tmp_path).trained(Circles())


@pytest.mark.parametrize(
    "config",
    [CONFIG, RunConfig(LinemodOptions("ape", Path("some/where"), None), minutes=1.5, method="super", labels=0.1)],
)
def test_configurations_survive_their_file(tmp_path: Path, config: RunConfig) -> None:
    RunFolder(tmp_path, config).write_config(new=True)
    assert load_config(tmp_path) == config


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "is no run folder"),
        ("{", "is no configuration of this version"),
        ('{"world": {"name": "atlantis"}}', "found the world 'atlantis', expected one of circles"),
        ('{"world": {}}', "found the world None, expected one of circles"),
        ('{"world": {"name": "circles"}, "methods": "our"}', r"is no configuration .*\(methods\) @ config"),
        ('{"world": {"name": "circles", "class": "ape"}}', r"\(class\) @ config.world"),
        ('{"world": {"name": "circles"}, "method": "ours"}', r"ours not in literal .* @ config.method"),
        ('{"world": {"name": "circles"}, "seed": "1"}', "found '1', expected int @ config.seed"),
        ('{"world": {"name": "circles"}, "recipe": {"seed": 1}}', r"\(seed\) @ config.recipe"),
        ('{"world": {"name": "circles"}, "labels": 7.0}', "is no fraction"),
        ('{"method": "our"}', "required field missing @ config.world"),
        ("[]", "is no configuration of this version"),
        ("[" * 100_000, "is no configuration of this version"),
    ],
)
def test_damaged_configurations_are_named(tmp_path: Path, content: str | None, message: str) -> None:
    if content is not None:
        (tmp_path / "config.json").write_text(content)
    with pytest.raises(CheckpointError, match=message):
        load_config(tmp_path)


def test_another_configuration_is_refused_field_by_field(tmp_path: Path) -> None:
    wanted = replace(CONFIG, method="our", seed=3, recipe=replace(CONFIG.recipe, learning_rate=0.5))
    with pytest.raises(ResumeMismatch) as caught:
        refuse_other(CONFIG, wanted, tmp_path)
    text = str(caught.value)
    assert "method (run: wake_sleep_critic, now: our)" in text
    assert "recipe.learning_rate (run: 0.0001, now: 0.5)" in text
    assert "seed (run: 0, now: 3)" in text
    assert "batch_size" not in text
    assert caught.value.exit_status == 2


def test_budgets_may_be_given_anew(tmp_path: Path) -> None:
    refuse_other(CONFIG, replace(CONFIG, images=None, minutes=3.0, stop_below=5.0), tmp_path)


def test_an_interrupted_run_goes_on_where_it_was(tmp_path: Path, cache: Path) -> None:
    stopped = Interruption()
    stopped.signum = signal.SIGTERM
    outcome, _ = learn(CONFIG, tmp_path / "run", stopped, resume=False, cache=cache)
    assert outcome is Outcome.INTERRUPTED
    train(tmp_path / "run", cache, resume=True)
    train(tmp_path / "whole", cache)
    assert_same(last_tensors(tmp_path / "whole"), last_tensors(tmp_path / "run"))


def test_what_changes_without_a_step_is_saved(tmp_path: Path, cache: Path) -> None:
    """As a calibration does, at the end of a run that is gone on with though its budget is spent."""
    train(tmp_path / "run", cache, replace(CONFIG, images=16))
    run = RunFolder.open(tmp_path / "run")
    state = TrainState(run.config, Circles(), torch.device("cpu"))
    run.restore(state)
    with torch.no_grad():
        next(iter(state.pose.network.parameters())).add_(1)
    names = [path.name for path in run.checkpoints()]
    run.save(state)
    assert [path.name for path in run.checkpoints()] == names
    assert not list((tmp_path / "run" / "checkpoints").glob("*.tmp"))
    assert_same(last_tensors(tmp_path / "run"), state.tensors())
