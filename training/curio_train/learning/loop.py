"""The training loop: steps, checkpoints and progress until the budget, convergence or a signal ends the run."""

import math
import time
from collections.abc import Callable
from enum import Enum

from curio_train.config import Recipe, RunConfig
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.interruption import Interruption
from curio_train.learning.runs.progress import Reporter
from curio_train.learning.trainer import Trainer


class Outcome(Enum):
    """Why training ended, in words for the user."""

    CONVERGED = "converged: the image loss is below --stop-below"
    SPENT = "the budget is spent"
    SPENT_BEFORE = "nothing to learn, the budget was spent (larger --images or --minutes go on)"
    INTERRUPTED = "interrupted"


def train(
    trainer: Trainer,
    run: RunFolder,
    interruption: Interruption,
    reporter: Reporter | None,
    checkpoint_minutes: float,
    finish: Callable[[], str],
) -> Outcome:
    """Train until convergence, the end of the budget, or a signal; a checkpoint is saved in each case.

    Args:
        trainer: Takes the steps.
        run: Where checkpoints are saved.
        interruption: How signals arrive.
        reporter: Only the process that has one writes: under torchrun all have the same state.
        checkpoint_minutes: Minutes of training between checkpoints.
        finish: Called before the last checkpoint of a run that was not interrupted, unless that was done already;
            returns what the user is to know of it.

    Raises:
        TrainingError: The optimisation broke down; the last checkpoint is the one to go back to.
        CheckpointError: A checkpoint could not be written; earlier ones are intact.
    """
    config, progress, ranks = trainer.config, trainer.state.progress, trainer.ranks
    saved_at, clock = progress.seconds, time.monotonic()
    ended_at = progress.finished_step
    with interruption.deferred(), trainer.synthetic.prefetching():
        while True:
            # All processes go by the slowest clock and by anyone's signal, so that they stop at the same step.
            seconds, signalled = ranks.largest(progress.seconds, interruption.signum or 0)
            spent = config.progress(progress.images, seconds)
            outcome = _outcome(config, progress.image_loss, spent, bool(signalled))
            if outcome or seconds - saved_at >= 60 * checkpoint_minutes:
                trainer.synthetic.wait_idle()
                if outcome and outcome is not Outcome.INTERRUPTED and progress.finished_step != progress.step:
                    if reporter and config.terms.knows_codes:
                        reporter.say(f"{outcome.value}; now the confidence is calibrated, which may take minutes")
                    told = finish()
                    if reporter and told:
                        reporter.say(told)
                    progress.finished_step = progress.step
                if reporter:
                    run.save(trainer.state)
                    reporter.pictures(trainer.pairs())
                saved_at = seconds
            if outcome:  # a signal may have come while the confidence was calibrated
                _, signalled = ranks.largest(0.0, interruption.signum or 0)
                if signalled:
                    return Outcome.INTERRUPTED
                return Outcome.SPENT_BEFORE if outcome is Outcome.SPENT and ended_at == progress.step else outcome
            trainer.synthetic.update_pseudo_labels(spent)
            losses = trainer.step(learning_rate_factor(config.recipe, progress.step, spent))
            progress.seconds, clock = progress.seconds + time.monotonic() - clock, time.monotonic()
            if reporter:
                reporter.step(losses, config.progress(progress.images, progress.seconds))


def _outcome(config: RunConfig, loss: float | None, spent: float, signalled: bool) -> Outcome | None:
    if loss is not None and loss < config.stop_below:
        return Outcome.CONVERGED
    if spent >= 1:
        return Outcome.SPENT
    return Outcome.INTERRUPTED if signalled else None


def learning_rate_factor(recipe: Recipe, step: int, spent: float) -> float:
    """Factor on the learning rates: linear warm-up over the first steps, then a cosine decay.

    Args:
        recipe: Its ``warm_up_steps``, and the ``final_learning_rate`` that the cosine ends at.
        step: Steps done.
        spent: Fraction of the budget.
    """
    warm = min(1.0, (step + 1) / (recipe.warm_up_steps + 1))
    cosine = (1 + math.cos(math.pi * min(spent, 1.0))) / 2
    return warm * (recipe.final_learning_rate + (1 - recipe.final_learning_rate) * cosine)
