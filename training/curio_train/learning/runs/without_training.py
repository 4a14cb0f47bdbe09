"""The run folder of a method that trains nothing."""

import time
from pathlib import Path

import torch

from curio_train.config import RunConfig
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.provenance import record_session
from curio_train.learning.state import TrainingProgress, TrainState
from curio_train.networks.templates.network import TemplateNetwork
from curio_train.templates.build import fill, without_scan_excess
from curio_train.templates.calibration import calibrate
from curio_train.worlds import build
from curio_train.worlds.single_object.two_stage import TwoStageWorld


def draw_templates(
    config: RunConfig, path: Path, cache: Path, num_threads: int = 1, *, resume: bool = False
) -> TrainingProgress:
    """Draw an object's templates, calibrate their confidence, and write both as a run.

    Args:
        config: Of the object.
        path: The run folder.
        cache: Where worlds keep the image sets that they render once.
        num_threads: In how many templates and frames are read.
        resume: Whether the folder holds a run already; its templates are drawn unless it has them.

    Raises:
        CurioError: Any of this package's errors. The folder then holds no checkpoint.
    """
    world = build(config.world)
    state = TrainState(config, world, torch.device("cpu"))
    network = state.pose.network
    assert isinstance(world, TwoStageWorld)  # template networks are made for no other
    assert isinstance(network, TemplateNetwork)
    run = RunFolder(path, config)
    with run.lock():
        run.write_config(new=not resume)
        record_session(path)
        if resume and run.checkpoints():
            return run.trained(world).progress
        begin, exact = time.monotonic(), without_scan_excess(world)
        fill(network, exact, cache, num_threads)
        calibrate(network, exact, cache, num_threads)
        state.progress.seconds = time.monotonic() - begin
        run.save(state)
    return state.progress
