"""Two processes under torchrun compute what one does."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from curio_train.commands.train import train
from safetensors.torch import load_file

COMMAND = Path(sys.executable).with_name("curio-train")
TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
RECIPE = ["--method", "wake_sleep_critic", "--batch-size", "8", "--micro-batch-size", "4"]
RECIPE += ["--precision", "float32", "--device", "cpu", "--gradient-penalty-every", "2"]


def call(*command: object) -> None:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*map(str, command)], capture_output=True, text=True, check=False, env=environment, timeout=300
    )
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, cache: Path) -> dict[str, Path]:
    """A run of one process, and one of two that was stopped half way and resumed; both keep steps 1 and 2."""
    folder = tmp_path_factory.mktemp("runs")
    common = ["circles", "--cache", cache, "--checkpoint-minutes", "0"]
    with pytest.raises(SystemExit) as exit_:  # in this process, which has imported torch already
        train([str(word) for word in (*common, *RECIPE, "--images", "16", "--out", folder / "one")])
    assert not exit_.value.code
    call(*TORCHRUN, COMMAND, *common, *RECIPE, "--images", "8", "--out", folder / "two")
    call(*TORCHRUN, COMMAND, *common, "--resume", folder / "two", "--images", "16")
    return {"one": folder / "one", "two": folder / "two"}


@pytest.mark.parametrize(("step", "tolerance"), [(1, 1e-3), (2, 0.1)])
def test_two_processes_go_where_one_does(runs: dict[str, Path], step: int, tolerance: float) -> None:
    one, two = (load_file(run / f"checkpoints/{step:08d}/tensors.safetensors") for run in runs.values())
    assert one.keys() == two.keys()
    # Averaged gradients, not weights: Adam turns the rounding of a gradient that should be 0 into a whole step, which
    # is also why the second step agrees less well than the first.
    moments = [name for name in one if name.endswith("exp_avg")]
    assert moments
    for name in moments:
        scale = one[name].abs().max().clamp_min(1e-4)
        assert (one[name] - two[name]).abs().max() / scale < tolerance, name


def test_losses_are_those_of_the_whole_batch(runs: dict[str, Path]) -> None:
    rows = ([json.loads(line) for line in (run / "history.jsonl").open()] for run in runs.values())
    one, two = ([row for row in of_run if "image" in row] for of_run in rows)
    assert [row["step"] for row in two] == [1, 2]  # a line a session, not one a process
    for name in ("image", "curiosity", "critic", "sleep"):
        assert (two[0][name] + two[1][name]) / 2 == pytest.approx(one[0][name], rel=1e-2)


def test_one_process_writes_for_both(runs: dict[str, Path]) -> None:
    assert len(list(runs["two"].glob("tensorboard/*"))) == 2  # one a session
    assert len((runs["two"] / "sittings.jsonl").read_text().splitlines()) == 2
