"""The number of threads is the quicker one for the work at hand, and one stays one."""

import time
from collections.abc import Iterator

import pytest
import torch
from curio_train.learning.hardware import choose_threads


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


@pytest.mark.parametrize(("reserved", "expected"), [(0, 2), (1, 1), (5, 1)])
def test_threads_for_other_work_are_left_alone(reserved: int, expected: int) -> None:
    slow_alone = lambda: time.sleep(0.5 if torch.get_num_threads() == 1 else 0.0)  # noqa: E731
    assert choose_threads(slow_alone, reserved=reserved) == torch.get_num_threads() == expected
