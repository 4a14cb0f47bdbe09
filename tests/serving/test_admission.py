"""The bounded queue: refusals, deadlines, calls that hang up."""

import asyncio
import threading

import pytest
from curio_serve.admission import WorkQueue
from curio_serve.errors import DeadlineError, Overloaded
from curio_serve.telemetry import Metrics
from prometheus_client import CollectorRegistry


class Gate:
    """Work that tells when it has begun and ends when it is let go."""

    def __init__(self) -> None:
        self.begun, self.open = threading.Event(), threading.Event()

    def __call__(self, waited_s: float) -> str:
        self.begun.set()
        assert self.open.wait(30)
        return "done"


def _queue(num_workers: int, max_waiting: int) -> WorkQueue:
    return WorkQueue(num_workers, max_waiting, Metrics(CollectorRegistry()))


def test_beyond_the_queue_is_refused_at_once() -> None:
    async def scenario() -> None:
        work, gate = _queue(1, 2), Gate()
        accepted = [asyncio.create_task(work.run(gate, None)) for _ in range(3)]
        await asyncio.to_thread(gate.begun.wait)
        with pytest.raises(Overloaded, match="3 requests are being worked on or waiting") as caught:
            await work.run(gate, None)
        assert caught.value.retry_after_s > 0
        # Callers that are bounded otherwise may wait all the same.
        extra = asyncio.create_task(work.run(gate, None, always=True))
        gate.open.set()
        assert await asyncio.gather(*accepted, extra) == ["done"] * 4
        assert await work.run(gate, None) == "done"
        work.close()

    asyncio.run(scenario())


def test_a_deadline_that_passed_in_the_queue_costs_no_work() -> None:
    async def scenario() -> None:
        work, gate, late = _queue(1, 5), Gate(), Gate()
        first = asyncio.create_task(work.run(gate, None))
        await asyncio.to_thread(gate.begun.wait)
        second = asyncio.create_task(work.run(late, 0.0))
        await asyncio.sleep(0)
        gate.open.set()
        assert await first == "done"
        with pytest.raises(DeadlineError, match="nothing was done"):
            await second
        assert not late.begun.is_set()
        work.close()

    asyncio.run(scenario())


def test_a_cancelled_call_leaves_the_queue() -> None:
    async def scenario() -> None:
        work, gate, gone = _queue(1, 1), Gate(), Gate()
        first = asyncio.create_task(work.run(gate, None))
        await asyncio.to_thread(gate.begun.wait)
        waiting = asyncio.create_task(work.run(gone, None))
        await asyncio.sleep(0)
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting
        # Its place is free again.
        third = asyncio.create_task(work.run(gate, None))
        await asyncio.sleep(0)
        gate.open.set()
        assert await asyncio.gather(first, third) == ["done", "done"]
        assert not gone.begun.is_set()
        work.close()

    asyncio.run(scenario())


def test_a_call_cancelled_while_worked_on_keeps_its_worker_until_it_ends() -> None:
    async def scenario() -> None:
        work, gate = _queue(1, 0), Gate()
        running = asyncio.create_task(work.run(gate, None))
        await asyncio.to_thread(gate.begun.wait)
        running.cancel()
        with pytest.raises(asyncio.CancelledError):
            await running
        with pytest.raises(Overloaded):
            await work.run(gate, None)
        gate.open.set()
        while True:
            try:
                assert await work.run(gate, None) == "done"
                break
            except Overloaded:
                await asyncio.sleep(0.001)
        work.close()

    asyncio.run(scenario())


def test_errors_of_the_work_come_through() -> None:
    def broken(waited_s: float) -> None:
        raise ValueError("mine")

    async def scenario() -> None:
        work = _queue(2, 2)
        for _ in range(5):
            with pytest.raises(ValueError, match="mine"):
                await work.run(broken, None)
        work.close()

    asyncio.run(scenario())
