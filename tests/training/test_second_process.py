"""What a second process returns, raises, and leaves behind."""

import multiprocessing
import os
import time
from pathlib import Path

import torch
from curio_train.camera import load_intrinsics
from curio_train.errors import CameraError, WorkError
from curio_train.second_process import SecondProcess


def test_it_computes_in_one_thread() -> None:
    with SecondProcess(torch.get_num_threads) as second:
        assert second.result == 1
        assert second.result == 1  # asked again, it is not run again


def test_its_error_is_handed_over(tmp_path: Path) -> None:
    missing = tmp_path / "camera.json"
    with SecondProcess(load_intrinsics, missing) as second:
        found = second.result
    assert isinstance(found, CameraError)
    assert str(missing) in str(found)


def test_its_end_is_an_error() -> None:
    with SecondProcess(os._exit, 3) as second:
        found = second.result
    assert isinstance(found, WorkError)
    assert "ended before it was done" in str(found)


def test_it_ends_with_the_context() -> None:
    with SecondProcess(time.sleep, 3600) as second:
        assert len(multiprocessing.active_children()) == 1
    assert not multiprocessing.active_children()
    assert isinstance(second.result, WorkError)
