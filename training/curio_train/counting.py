"""Says how far work is that takes minutes and shows nothing else."""

import sys
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

Item = TypeVar("Item")
_SECONDS_A_LINE = 10


def counted(items: Iterable[Item], num: int, what: str) -> Iterator[Item]:
    """Items as they come; every ten seconds a line on stderr says how many came, and how long the others may take.

    Args:
        items: Worked on by the caller, or by whoever makes them.
        num: Of items.
        what: Is done with them.
    """
    begun = told = time.monotonic()
    for done, item in enumerate(items):
        now = time.monotonic()
        if done and now - told >= _SECONDS_A_LINE:
            told = now
            left_s = (num - done) * (now - begun) / done
            print(f"{what}: {done} of {num}, about {left_s:.0f} s left", file=sys.stderr, flush=True)
        yield item
