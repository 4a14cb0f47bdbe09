"""bfloat16 and threads are used only where they save time on this machine."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from curio_train.learning.hardware import autocast, choose_threads, one_thread, quick_bfloat16
from curio_train.learning.muon import orthogonal
from curio_train.threads import in_threads


@pytest.fixture(autouse=True)
def _two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("slow", [1, 2])
def test_the_quicker_number_is_kept(slow: int) -> None:
    chosen = choose_threads(lambda: time.sleep(0.5 if torch.get_num_threads() == slow else 0.0))
    assert chosen == torch.get_num_threads() == 3 - slow


def test_a_process_of_one_thread_tries_nothing() -> None:
    torch.set_num_threads(1)
    calls: list[int] = []
    assert choose_threads(lambda: calls.append(1)) == 1
    assert calls == []


def test_one_thread_computes_within_the_block_alone() -> None:
    with one_thread() as allowed:
        assert (allowed, torch.get_num_threads()) == (2, 1)
    assert torch.get_num_threads() == 2


def test_calls_in_threads_keep_their_order_and_record_no_gradients() -> None:
    weight = torch.ones(1, requires_grad=True)

    def late(seconds: float) -> tuple[float, bool, int]:
        time.sleep(seconds)
        return seconds, (weight * seconds).requires_grad, torch.get_num_threads()

    waits = [0.1, 0.0, 0.05, 0.0]
    assert list(in_threads(late, iter(waits), 3)) == [(seconds, False, 1) for seconds in waits]
    assert torch.get_num_threads() == 2
    with pytest.raises(ZeroDivisionError):
        list(in_threads(lambda value: 1 // value, [1, 0, 1], 2))


@pytest.mark.parametrize("device_type", ["cpu", "cuda"])
def test_float32_stays_float32_on_any_machine(device_type: str) -> None:
    if device_type == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    with autocast("float32", device_type):
        product = torch.ones(4, 4, device=device_type) @ torch.ones(4, 4, device=device_type)
    assert product.dtype == torch.float32


def test_convolutions_have_the_precision_that_the_machine_is_quick_with() -> None:
    expected = torch.bfloat16 if quick_bfloat16("cpu") else torch.float32
    with autocast("bfloat16", "cpu"):
        assert torch.nn.Conv2d(3, 4, 3)(torch.ones(1, 3, 8, 8)).dtype == expected
    assert orthogonal(torch.eye(16)).dtype == torch.float32, "what comes out is as what went in"


def test_a_processor_without_its_instructions_is_not_asked_for_bfloat16() -> None:
    cpuinfo = Path("/proc/cpuinfo")
    flags = set(cpuinfo.read_text(encoding="utf-8").split()) if cpuinfo.exists() else set()
    if "avx2" not in flags:
        pytest.skip("no list of this processor's instructions, or it is no x86 with AVX2")
    if flags & {"avx512bw", "avx_ne_convert", "amx_bf16"}:
        pytest.skip("this processor has them")
    assert not quick_bfloat16("cpu")
