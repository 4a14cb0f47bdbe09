"""Training runs carried out a few at a time, each by ``curio-train`` and ``curio-eval`` in a folder of its own.

A queue that was stopped, or killed, goes on where it was when it is carried out again, in the middle of a run, too.
"""

import fcntl
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from curio_train.export.card import EVALUATION_FILE
from curio_train.learning.runs.configuration import CONFIG_FILE


@dataclass
class QueuedRun:
    """One run.

    Attributes:
        name: In words.
        folder: Its run folder; what its commands print goes to a log beside it.
        world: What ``curio-train`` is to learn.
        images: Its budget.
        flags: What else it is started with.
        scoring: What else ``curio-eval`` is called with.
        before: The run whose network it begins as; trained, too, where it is not yet.
        process: What it is doing now, if anything.
    """

    name: str
    folder: Path
    world: str
    images: int
    flags: Sequence[str]
    scoring: Sequence[str] = ()
    before: "QueuedRun | None" = None
    process: subprocess.Popen[bytes] | None = field(default=None)

    @property
    def done(self) -> bool:
        """Trained and scored."""
        return (self.folder / EVALUATION_FILE).exists()

    @property
    def evaluation(self) -> dict[str, Any]:
        """What ``curio-eval`` found of a run that is done."""
        found: dict[str, Any] = json.loads((self.folder / EVALUATION_FILE).read_text(encoding="utf-8"))
        return found

    @property
    def log(self) -> Path:
        """What its commands print."""
        return self.folder.with_name(self.folder.name + ".log")

    def commands(self) -> Iterator[list[str]]:
        """What is left to do."""
        here = Path(sys.executable).parent
        begin = ["--init", str(self.before.folder)] if self.before else []
        if self.before and not self.before.done:
            yield from self.before.commands()
        train = [str(here / "curio-train"), self.world, "--images", str(self.images)]
        if (self.folder / CONFIG_FILE).exists():
            yield [*train, "--resume", str(self.folder)]
        else:
            yield [*train, *self.flags, *begin, "--out", str(self.folder)]
        yield [str(here / "curio-eval"), str(self.folder), *self.scoring]

    def carry_out(self, threads: int) -> int:
        """Train and score; the exit status of what failed, or 0.

        Raises:
            BlockingIOError: Another process is at work on this run.
        """
        self.folder.parent.mkdir(parents=True, exist_ok=True)
        environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
        with self.log.open("ab") as log:
            fcntl.flock(log, fcntl.LOCK_EX | fcntl.LOCK_NB)  # the process inherits it, and holds it if we are killed
            for command in self.commands():
                # A session of its own: Ctrl-C reaches it through us, once.
                self.process = subprocess.Popen(
                    command, stdout=log, stderr=log, env=environment, start_new_session=True
                )
                if status := self.process.wait():
                    return status
        return 0


def carry_out(runs: Sequence[QueuedRun], jobs: int, after_each: Callable[[], None]) -> int:
    """Do what is not done yet, ``jobs`` runs at once, each with its share of the cores.

    A signal is passed on, so that each run leaves a checkpoint.

    Args:
        runs: In the order they are begun in.
        jobs: How many at once.
        after_each: Called whenever a run has ended.

    Returns:
        An exit status: 1 where a run failed, which is said on stderr with its log.
    """
    threads = max(1, len(os.sched_getaffinity(0)) // jobs)
    left = [run for run in runs if not run.done]
    _say(f"{len(runs) - len(left)} of {len(runs)} runs are done")
    with ThreadPoolExecutor(jobs) as pool:
        waiting = {pool.submit(run.carry_out, threads): run for run in left}
        try:
            while waiting:
                for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                    run = waiting.pop(future)
                    if isinstance(future.exception(), BlockingIOError):
                        _say(f"{run.name}: another process is at work on it")
                    else:
                        _say(f"{run.name}: exit status {future.result()}, see {run.log}")
                    after_each()
        finally:  # with nothing left to do unless a signal ended the wait
            pool.shutdown(wait=False, cancel_futures=True)
            for run in waiting.values():
                if run.process is not None and run.process.poll() is None:
                    run.process.send_signal(signal.SIGTERM)
    return int(not all(run.done for run in runs))


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
