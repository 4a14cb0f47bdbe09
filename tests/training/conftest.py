"""Run folders for what comes after training."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from curio_train.config import RunConfig, WorldOptions
from curio_train.learning.checkpoint import RunFolder
from curio_train.learning.provenance import note_sitting
from curio_train.learning.state import Course, TrainState
from curio_train.worlds import build
from curio_train.worlds.options import CirclesOptions


@pytest.fixture(scope="session")
def write_run() -> Callable[..., Path]:
    """``write_run(path, options=…, spread=…)``: a run as training leaves it, its network drawn at random."""

    def write(path: Path, options: WorldOptions | None = None, spread: float = 1.0) -> Path:
        config = RunConfig(options or CirclesOptions(), method="noncur", seed=3, images=64)
        run = RunFolder(path, config)
        run.write_config(new=True)
        note_sitting(path)
        state = TrainState(config, build(config.world), torch.device("cpu"))
        generator = torch.Generator().manual_seed(1)
        for module in state.pose.network.modules():
            if isinstance(module, torch.nn.BatchNorm2d):  # statistics that folding must not lose
                module.running_mean.normal_(0, 0.1, generator=generator)
                module.running_var.uniform_(0.2, 2.0, generator=generator)
                module.weight.data.uniform_(0.5, 2.0, generator=generator)
        for branch in state.pose.network.heads.branches.values():
            branch[-1].weight.data *= spread
        state.course = Course(step=2, images=64, seconds=1.5)
        run.save(state)
        return path

    return write
