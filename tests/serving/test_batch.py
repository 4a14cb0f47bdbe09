"""Parallel, in order, bounded."""

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
from curio_serve.batch.images.parallel import in_order


def test_answers_keep_the_order_whoever_is_first() -> None:
    def slow_at_first(number: int) -> int:
        time.sleep(0.02 if number % 4 == 0 else 0)
        return number

    assert list(in_order(slow_at_first, range(50), 4)) == list(range(50))


def test_little_more_than_the_next_answer_is_taken() -> None:
    taken = 0

    def endless() -> Iterator[int]:
        nonlocal taken
        while True:
            taken += 1
            yield taken

    answers = in_order(lambda number: number, endless(), 2)
    for expected in range(1, 1001):
        assert next(answers) == expected
        assert taken <= expected + 2 * 8
    answers.close()


def test_work_is_done_at_the_same_time() -> None:
    meeting = threading.Barrier(3, timeout=30)
    assert sorted(in_order(lambda _: meeting.wait(), range(3), 3)) == [0, 1, 2]


def test_what_is_raised_comes_in_its_turn_and_ends_the_rest() -> None:
    def refuse_five(number: int) -> int:
        if number == 5:
            raise KeyError(number)
        return number

    answers = in_order(refuse_five, range(100), 2)
    assert [next(answers) for _ in range(5)] == list(range(5))
    with pytest.raises(KeyError):
        next(answers)
    assert threading.active_count() == 1 or not any("ThreadPool" in t.name for t in threading.enumerate())


def test_what_the_items_raise_comes_after_the_answers_before_it() -> None:
    def failing() -> Iterator[int]:
        yield from range(5)
        raise OSError("the list ends")

    answers = in_order(lambda item: 2 * item, failing(), 2)
    found = [next(answers) for _ in range(5)]
    with pytest.raises(OSError, match="the list ends"):
        next(answers)
    assert found == [0, 2, 4, 6, 8]


def test_answers_do_not_wait_for_a_list_that_is_slow_to_come() -> None:
    more = threading.Semaphore(1)

    def typed() -> Iterator[int]:
        for number in range(4):
            assert more.acquire(timeout=30)
            yield number

    answers = in_order(lambda number: 2 * number, typed(), 4)
    for expected in range(4):
        assert next(answers) == 2 * expected
        more.release()
    assert next(answers, None) is None


def test_who_waits_for_items_is_left_alone() -> None:
    """Where the work is ended, a list that never goes on is not waited for."""
    begun, ever = threading.Event(), threading.Event()

    def stuck() -> Iterator[int]:
        yield 1
        begun.set()
        ever.wait(60)

    answers = in_order(lambda number: number, stuck(), 2)
    assert next(answers) == 1
    assert begun.wait(30)
    answers.close()
    assert not ever.is_set()
    ever.set()


class NativeError(BaseException):
    """As extensions raise it whose code panics."""


def test_nothing_that_ends_the_items_is_lost() -> None:
    def panicking() -> Iterator[int]:
        yield 1
        raise NativeError

    answers = in_order(lambda number: number, panicking(), 2)
    assert next(answers) == 1
    with pytest.raises(NativeError):
        next(answers)


def test_work_that_cannot_begin_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where a container allows no more threads."""

    def refuse(*_: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(ThreadPoolExecutor, "submit", refuse)
    with pytest.raises(RuntimeError, match="new thread"):
        next(in_order(lambda number: number, [1, 2], 2))
