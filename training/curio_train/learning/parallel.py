"""Data parallel training under torchrun: the processes divide each step's micro-batches among them.

The images of a micro-batch, over which batch norm takes its statistics, do not depend on the number of processes, so
two of them compute what one would, up to the order of sums.
"""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, distributed

from curio_train.errors import UsageError


@dataclass(frozen=True)
class Ranks:
    """This process among all that train together."""

    rank: int
    """Its number; 0 writes checkpoints and reports."""
    size: int
    """Number of processes."""
    device: torch.device
    """Its torch device."""

    @property
    def leads(self) -> bool:
        """Whether this process writes and reports."""
        return self.rank == 0

    def micro_batches(self, count: int) -> range:
        """The numbers below ``count`` of the micro-batches that this process computes.

        Raises:
            UsageError: ``count`` cannot be divided evenly among the processes.
        """
        if count % self.size:
            raise UsageError(
                f"{count} micro-batches a step cannot be divided among {self.size} processes; expected --batch-size / "
                "--micro-batch-size to be a multiple of torchrun's --nproc-per-node times --nnodes"
            )
        return range(self.rank, count, self.size)

    def sum(self, tensors: Iterable[Tensor]) -> None:
        """Replace each tensor by its sum over all processes, in one message."""
        if self.size == 1:
            return
        parts = list(tensors)
        flat = torch.cat([part.flatten() for part in parts])
        distributed.all_reduce(flat)
        for part, summed in zip(parts, flat.split([part.numel() for part in parts]), strict=True):
            part.copy_(summed.view_as(part))

    def largest(self, *values: float) -> list[float]:
        """The largest of each value over all processes, so that all of them make the same decisions."""
        if self.size == 1:
            return list(values)
        tensor = torch.tensor(values, dtype=torch.float64, device=self.device)
        distributed.all_reduce(tensor, distributed.ReduceOp.MAX)
        return tensor.tolist()


@contextmanager
def ranks(device: Literal["auto", "cpu", "cuda"]) -> Iterator[Ranks]:
    """Join the processes that torchrun started, or be the only one.

    Raises:
        UsageError: CUDA is asked for and there is none.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise UsageError(
            "--device cuda, but torch finds no CUDA device; expected --device cpu, or a CUDA build of torch"
        )
    cuda = torch.cuda.is_available() and device != "cpu"
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        yield Ranks(0, 1, torch.device("cuda" if cuda else "cpu"))
        return
    local = torch.device("cuda", int(os.environ["LOCAL_RANK"])) if cuda else torch.device("cpu")
    if cuda:
        torch.cuda.set_device(local)
    distributed.init_process_group("nccl" if cuda else "gloo")
    try:
        yield Ranks(distributed.get_rank(), size, local)
        # Without a barrier a thread that still frees the last sum's tensor aborts the interpreter while it ends.
        distributed.barrier()
    finally:
        distributed.destroy_process_group()
