"""One session of training: from a configuration to a run folder, new or resumed."""

import time
from collections.abc import Callable
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import Literal

import torch

from curio_train.config import RunConfig
from curio_train.errors import UsageError
from curio_train.learning.explaining import Found, search_of
from curio_train.learning.hardware import choose_threads, one_thread
from curio_train.learning.loop import Outcome, train
from curio_train.learning.parallel import ranks
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.initial import begin_with, check_objects_before
from curio_train.learning.runs.interruption import Interruption
from curio_train.learning.runs.progress import reporting
from curio_train.learning.runs.provenance import record_session
from curio_train.learning.state import TrainingProgress, TrainState
from curio_train.learning.trainer import Trainer, check_rendered_stages
from curio_train.networks.several_objects.network import ObjectsNetwork
from curio_train.networks.templates.quick_trunk import quicken
from curio_train.networks.two_stage.network import TwoStageNetwork
from curio_train.templates.build import fill_objects, fill_outline
from curio_train.worlds import build
from curio_train.worlds.base import World, stages_of
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object.two_stage import TwoStageWorld


def _draw(trainer: Trainer, cache: Path) -> None:
    """Draw what networks read or align poses by, before training begins: templates, or outlines."""
    network, world, begin = trainer.state.pose.network, trainer.world, time.monotonic()
    if isinstance(network, ObjectsNetwork) and isinstance(world, SeveralObjectsWorld):
        with one_thread() as num_threads:
            fill_objects(network.cpu(), world, cache, num_threads)  # where the drawings are
    elif isinstance(network, TwoStageNetwork) and isinstance(world, TwoStageWorld):
        fill_outline(network.cpu(), world)
    else:
        return
    network.to(trainer.ranks.device)
    trainer.state.progress.seconds += time.monotonic() - begin


def _refuse_spent(config: RunConfig, seconds: float, path: Path) -> None:
    """Drawing counts as training; a budget that ends with it would leave a network that has learned nothing."""
    if config.progress(0, seconds) >= 1:
        raise UsageError(
            f"--minutes {config.minutes:g}: drawing what {path} reads poses by took {seconds / 60:.1f} minutes, which "
            "leaves nothing to learn in; give more, and another --out"
        )


def _forget_photographs(trainer: Trainer, cache: Path) -> None:
    """Draw the templates of a finished run that is gone on with: they look as photographs do, and would learn twice."""
    progress, config = trainer.state.progress, trainer.config
    goes_on = config.progress(progress.images, progress.seconds) < 1
    has_learned = progress.finished_step is not None and config.recipe.self_training > 0
    if goes_on and has_learned and isinstance(trainer.state.pose.network, ObjectsNetwork):
        _draw(trainer, cache)
        progress.finished_step = None


def _training_images(config: RunConfig, world: World, cache: Path) -> Callable[[Path], Found]:
    """A function that gives the training images of a world's stages, once there is a run folder."""
    if config.terms.hypotheses:
        return search_of(world, config.network.reading, config.seed, cache)
    # Where predictions are rendered, crops are cut from whole frames around the first stage's answers.
    first, *others = stages_of(world)
    shown = [world if config.terms.renders_predictions else first, *others]
    sources = [one.source("train", config.seed, with_code=config.terms.label, cache=cache) for one in shown]
    if config.labels < 1:
        sources = [source.subset(config.labels) for source in sources]
    return lambda _: Found(sources, seconds=0.0)


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
        resume: Continue from the folder's last checkpoint instead of starting a run.
        cache: Folder of the image sets that worlds draw once.
        device: See ``parallel.ranks``.
        checkpoint_minutes: Minutes of training between checkpoints.

    Returns:
        Why training ended, and the run's progress.

    Raises:
        UsageError: The budget is spent before anything is learned.
        CurioError: Any of this package's errors; checkpoints that were written stay.
    """
    with ranks(device) as here, ExitStack() as own:
        # World and first network come first, so that an error in either leaves no run folder behind.
        world = build(config.world)
        check_rendered_stages(config, world)
        if config.init is not None and not resume:
            check_objects_before(config.init, [kind.name for kind in world.objects])
            begin_with(TrainState(config, world, torch.device("cpu")), config.init)
        training_images = _training_images(config, world, cache)
        run = RunFolder(path, config)
        if here.leads:
            own.enter_context(run.lock())
            run.write_config(new=not resume)
            record_session(path)
        found = training_images(path)
        trainer = Trainer(config, world, found.sources, here)
        if resume and run.checkpoints():
            run.restore(trainer.state)
            _forget_photographs(trainer, cache)
        else:
            if config.init is not None:
                begin_with(trainer.state, config.init)
            trainer.state.progress.seconds_before += found.seconds
            _draw(trainer, cache)
            _refuse_spent(config, trainer.state.progress.seconds, path)
        quicken(trainer.state.pose.network)
        if here.device.type == "cpu":
            choose_threads(trainer.warm_up)

        told = reporting(path, trainer.state.progress, is_flat=config.world.is_flat) if here.leads else nullcontext()
        with told as reporter:
            outcome = train(
                trainer,
                run,
                interruption,
                reporter,
                checkpoint_minutes,
                finish=lambda: trainer.self_training.finish(cache) if config.terms.knows_codes else "",
            )
        return outcome, trainer.state.progress
