"""Each file operation in a run folder fails once, by kill -9 and by a full disk: the run goes on bit for bit."""

import gc
import os
import resource
import shutil
import signal
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import pytest
import torch
from curio_train.config import ConvStack, NetworkConfig, Recipe, RunConfig
from curio_train.errors import CheckpointError
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.interruption import Interruption
from curio_train.learning.session import learn
from curio_train.worlds.options import CirclesOptions
from torch import Tensor

CONFIG = RunConfig(
    CirclesOptions(),
    method="sleep",
    images=16,
    recipe=Recipe(batch_size=4, micro_batch_size=4, warm_up_steps=3),
    network=NetworkConfig(
        encoder=ConvStack((4, 4, 4, 4, 4), (11, 5, 3, 3, 3), (4, 2, 2, 2, 2), (0, 1, 1, 1, 0)), hidden=8
    ),
)
Fault = Literal["kill", "full disk"]
_FAULT_STATUS = 3

pytestmark = pytest.mark.usefixtures("one_thread", "small_image_sets")


def _train(path: Path, cache: Path, num_images: int, *, resume: bool = True) -> None:
    config = replace(CONFIG, images=num_images)
    learn(config, path, Interruption(), resume=resume, cache=cache, checkpoint_minutes=0)


def _with_fault(path: Path, cache: Path, fault: Fault, number: int) -> bool:
    """Train one more step in a child whose access to the folder fails at that number; whether there were as many."""
    child = os.fork()
    if not child:
        status = 4
        try:
            _fail_at(path, fault, number)
            _train(path, cache, 12)
            status = 0
        except (CheckpointError, OSError):
            status = _FAULT_STATUS
        finally:
            os._exit(status)
    _, ended = os.waitpid(child, 0)
    assert ended == signal.SIGKILL or os.waitstatus_to_exitcode(ended) in (0, _FAULT_STATUS)
    return ended != 0


def _fail_at(path: Path, fault: Fault, number: int) -> None:
    """From the numbered file operation below the folder on, kill this process, or let its writes fail after 5 bytes."""
    count = 0

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal count
        if event.partition(".")[0] not in ("open", "os") or not str(arguments[0] if arguments else "").startswith(
            str(path)
        ):
            return
        count += 1
        if count == number and fault == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        elif count == number:
            resource.setrlimit(resource.RLIMIT_FSIZE, (5, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))

    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    sys.addaudithook(watch)


def _tensors(path: Path) -> dict[str, Tensor]:
    return RunFolder.open(path).last()[0]


@pytest.mark.parametrize("fault", ["kill", "full disk"])
def test_every_file_operation_may_be_the_last(tmp_path: Path, cache: Path, fault: Fault) -> None:
    _train(tmp_path / "begun", cache, 8, resume=False)
    shutil.copytree(tmp_path / "begun", tmp_path / "whole")
    _train(tmp_path / "whole", cache, 16)
    expected = _tensors(tmp_path / "whole")
    gc.collect()
    path, number, is_reached = tmp_path / "run", 0, True
    while is_reached:
        number += 1
        shutil.rmtree(path, ignore_errors=True)
        shutil.copytree(tmp_path / "begun", path)
        is_reached = _with_fault(path, cache, fault, number)
        _train(path, cache, 16)
        found = _tensors(path)
        assert found.keys() == expected.keys()
        assert [name for name in found if not torch.equal(found[name], expected[name])] == [], number
    assert number > 20
