"""curio-train as a user meets it: killed and interrupted, as a real process; called wrongly, in this one."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from curio_train.commands.train import train
from safetensors.torch import load_file

COMMAND = Path(sys.executable).with_name("curio-train")
Call = Callable[..., tuple[int, str, str]]
PATIENCE_S = 300  # ends a test that hangs; nothing is measured by it
SMALL = ["--batch-size", "4", "--micro-batch-size", "2", "--precision", "float32", "--gradient-penalty-every", "2"]


def start(*arguments: object) -> subprocess.Popen[str]:
    one_thread = {**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    return subprocess.Popen(
        [COMMAND, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=one_thread
    )


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str]) -> Call:
    """``call(*arguments)``: exit status, stdout and stderr of a call in this process."""

    def called(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as exit_:
            train([str(word) for word in arguments])
        told = capsys.readouterr()
        return int(exit_.value.code or 0), told.out, told.err

    return called


def checkpoints(run: Path) -> list[Path]:
    return sorted(run.glob("checkpoints/0*"))


def wait_for_checkpoint(process: subprocess.Popen[str], run: Path, step: int) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not any(int(path.name) >= step for path in checkpoints(run)):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)


def assert_same_end(one: Path, other: Path) -> None:
    ends = [load_file(checkpoints(run)[-1] / "tensors.safetensors") for run in (one, other)]
    assert ends[0].keys() == ends[1].keys()
    assert [name for name in ends[0] if not torch.equal(ends[0][name], ends[1][name])] == []


def test_a_run_killed_outright_goes_on_as_if_uninterrupted(tmp_path: Path, cache: Path, call: Call) -> None:
    common = ["circles", "--images", 64, "--cache", cache, *SMALL]
    assert call(*common, "--out", tmp_path / "whole")[0] == 0
    killed = tmp_path / "killed"
    process = start(*common, "--out", killed, "--checkpoint-minutes", 0)
    wait_for_checkpoint(process, killed, 3)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert checkpoints(killed)[-1].name < "00000016"
    status, output, _ = call("circles", "--resume", killed, "--cache", cache)
    assert status == 0
    assert f"{killed}: the budget is spent after 64 images" in output
    assert_same_end(tmp_path / "whole", killed)


@pytest.mark.parametrize(("signum", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_polite_signal_leaves_a_checkpoint_and_says_how_to_go_on(
    tmp_path: Path, cache: Path, call: Call, signum: signal.Signals, status: int
) -> None:
    run = tmp_path / "run"
    process = start("circles", "--method", "noncur", "--images", 10**6, "--cache", cache, "--out", run, *SMALL,
                    "--checkpoint-minutes", 0)  # fmt: skip
    wait_for_checkpoint(process, run, 1)
    process.send_signal(signum)
    _output, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == status, errors
    assert f"go on with: curio-train circles --resume {run}" in errors
    assert "Traceback" not in errors
    last = checkpoints(run)[-1]
    assert json.loads((last / "course.json").read_text())["step"] == int(last.name)
    budget = 4 * int(last.name) + 4
    assert call("circles", "--resume", run, "--images", budget, "--cache", cache)[0] == 0
    assert int(checkpoints(run)[-1].name) == int(last.name) + 1


def test_help_needs_no_torch() -> None:
    script = (
        "import sys; from curio_train.commands.train import train\n"
        "for words in (['--help'], ['circles', '--help'], ['linemod', '--help']):\n"
        "    try: train(words)\n"
        "    except SystemExit as exit_: assert not exit_.code\n"
        "print(sorted({'torch', 'mitsuba', 'cv2', 'scipy'} & set(sys.modules)), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"


def test_a_reader_that_leaves_early_is_no_crash() -> None:
    process = start("circles", "--help")
    process.stdout.close()
    assert "Traceback" not in process.stderr.read()
    assert process.wait(PATIENCE_S) == 1


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        ([], 2, "circles"),
        (["atlantis"], 2, "atlantis"),
        (["circles", "--method", "magic"], 2, "magic"),
        (["circles", "--labels", "0.1"], 2, "--labels 0.1 with --method our, which uses none; expected --method super"),
        (["circles", "--minutes", "-1"], 2, "--minutes is -1.0, expected more than 0"),
        (["circles", "--batch-size", "100"], 2, "cannot be cut into micro-batches of 64"),
        (["circles", "--batch-size", "1"], 2, "--batch-size is 1, expected 2 or more"),
        (["circles", "--resume", "nowhere"], 1, "nowhere is no run folder: cannot read nowhere/config.json"),
        (["circles", "--resume"], 2, "--resume"),
        (["linemod"], 2, "--class"),
        (["circles", "--out", "/proc/run"], 1, "cannot write the run folder /proc/run"),
        (["circles", "--device", "cuda"], 2, "torch finds no CUDA device"),
    ],
)
def test_wrong_calls_get_one_clear_message(
    arguments: list[str], status: int, message: str, tmp_path: Path, call: Call
) -> None:
    found, output, errors = call(*arguments, *(["--cache", tmp_path] if arguments[:1] == ["circles"] else []))
    assert found == status, errors
    assert message in " ".join(errors.replace("│", " ").split())
    assert "Traceback" not in errors
    assert output == ""


WITHOUT_EXTRAS = """
import importlib, sys

class BaseInstall:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in missing.split(","):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

missing, module, function, *sys.argv = sys.argv[1:]
sys.meta_path.insert(0, BaseInstall())
getattr(importlib.import_module(f"curio_train.commands.{module}"), function)()
"""
TRAIN = "torch,cattrs,mitsuba,drjit,trimesh,scipy,skimage,jaxtyping,huggingface_hub,onnx,safetensors,PIL,jinja2"


@pytest.mark.parametrize(
    ("missing", "call", "extra"),
    [
        (TRAIN, "train train curio-train linemod --class ape --data lmo", "train"),
        (TRAIN, "train train curio-train circles", "train"),
        (TRAIN, "train train curio-train capture --calibrate --images . --board 9 6", "train"),
        (TRAIN, "evaluate evaluate curio-eval run", "train"),
        (TRAIN, "export export curio-export run", "train"),
        (TRAIN, "doctor doctor curio-doctor", "train"),
        (TRAIN, "render render curio-render poses.jsonl --out out", "train"),
        ("viser", "view view curio-view chairs", "view"),
    ],
)
def test_a_base_install_names_the_extra(missing: str, call: str, extra: str, tmp_path: Path) -> None:
    """The packages of an extra cannot be imported, as after ``pip install .``."""
    command = [sys.executable, "-c", WITHOUT_EXTRAS, missing, *call.split()]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=PATIENCE_S)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert "pip install 'curio-pose[" in done.stderr
    assert extra in done.stderr


def test_runs_are_neither_overwritten_nor_continued_as_something_else(tmp_path: Path, cache: Path, call: Call) -> None:
    run = tmp_path / "run"
    common = ["circles", "--method", "noncur", "--images", 4, "--cache", cache, *SMALL]
    assert call(*common, "--out", run)[0] == 0
    status, _, errors = call(*common, "--out", run)
    assert (status, "holds a run already" in errors) == (2, True)
    status, _, errors = call("circles", "--self-training", 0.5, "--out", run)  # which has no photographs to learn from
    assert (status, "holds a run already" in errors) == (2, True)
    status, _, errors = call("circles", "--resume", run, "--seed", 9, "--preset", "paper")
    assert status == 2
    assert "preset (run: laptop, now: paper), seed (run: 0, now: 9)" in errors
    status, output, _ = call("circles", "--resume", run, "--cache", cache)
    assert (status, output.count(f"{run}: nothing to learn, the budget was spent (larger --images")) == (0, 1)
