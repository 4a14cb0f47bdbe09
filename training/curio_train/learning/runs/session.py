"""One sitting of training: from a configuration to a run folder, new or resumed."""

import time
from contextlib import nullcontext
from pathlib import Path
from typing import Literal

import torch

from curio_train.config import RunConfig
from curio_train.learning.loop import Outcome, Trainer, train
from curio_train.learning.parallel import ranks
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.initial import begin_with
from curio_train.learning.runs.interruption import Interruption
from curio_train.learning.runs.progress import reporting
from curio_train.learning.runs.provenance import record_session
from curio_train.learning.state import TrainingProgress, TrainState
from curio_train.learning.threads import choose_threads
from curio_train.templates.build import fill
from curio_train.templates.calibration import calibrate
from curio_train.worlds import build
from curio_train.worlds.single_object.world import SingleObjectWorld


def draw_templates(config: RunConfig, path: Path, cache: Path) -> TrainingProgress:
    """Make the run folder of a method that draws templates instead of training.

    Args:
        config: Of the object.
        path: The run folder, a new one.
        cache: Where worlds keep the image sets they draw once.

    Raises:
        CurioError: Any of this package's errors; the folder then has no checkpoint.
    """
    world = build(config.world)
    state = TrainState(config, world, torch.device("cpu"))
    run, network = RunFolder(path, config), state.pose.network
    assert isinstance(world, SingleObjectWorld)  # a template network has been made for it
    begin = time.monotonic()
    fill(network, world, cache)
    calibrate(network, world, cache)
    state.course.seconds = time.monotonic() - begin
    run.write_config(new=True)
    record_session(path)
    run.save(state)
    return state.course


def learn(
    config: RunConfig,
    path: Path,
    interruption: Interruption,
    *,
    resume: bool,
    cache: Path,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    checkpoint_minutes: float = 1.0,
) -> tuple[Outcome, TrainingProgress]:
    """Train, alone or as one of torchrun's processes.

    Args:
        config: What to learn; of a resumed run, its own (see ``configuration.refuse_other``).
        path: The run folder.
        interruption: How signals arrive.
        resume: Go on from the folder's last checkpoint instead of starting a run.
        cache: Where worlds keep the image sets they draw once.
        device: See ``parallel.ranks``.
        checkpoint_minutes: Minutes of training between checkpoints.

    Returns:
        Why training ended, and how far it came.

    Raises:
        CurioError: Any of this package's errors; checkpoints that were written stay.
    """
    with ranks(device) as here:
        # The world comes first: what is wrong with its data shows before a run folder is there.
        world = build(config.world)
        labelled = "label" in config.terms
        sources = [look.source("train", config.seed, with_code=labelled, cache=cache) for look in world.stages]
        if config.labels < 1:
            sources = [source.subset(config.labels) for source in sources]
        run = RunFolder(path, config)
        if here.leads:
            run.write_config(new=not resume)
            record_session(path)
        trainer = Trainer(config, world, sources, here)
        if here.device.type == "cpu":
            # A run that only sleeps draws its images in a thread of its own.
            choose_threads(trainer.warm_up, reserved=int(config.terms == {"sleep"}))
        if resume and run.checkpoints():
            run.restore(trainer.state)
        elif config.init is not None:
            begin_with(trainer.state, config.init)
        with reporting(path, trainer.state.course) if here.leads else nullcontext() as reporter:
            outcome = train(
                trainer,
                run,
                interruption,
                reporter,
                checkpoint_minutes,
                finish=lambda: world.finish(trainer.state.pose.network, cache),
            )
        return outcome, trainer.state.course
