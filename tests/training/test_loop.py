"""The loop: every method learns, accumulates, clips, stops, and sees no label it should not see."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from curio_train.config import METHODS, PRESETS, ConvStack, MethodName, NetworkConfig, Recipe, RunConfig
from curio_train.errors import DataError, TrainingError, UsageError
from curio_train.learning.loop import Outcome, learning_rate_factor, train
from curio_train.learning.parallel import Ranks
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.interruption import Interruption
from curio_train.learning.session import learn
from curio_train.learning.trainer import Trainer
from curio_train.worlds.base import Batch, ImageSource
from curio_train.worlds.generated.circles import Circles
from curio_train.worlds.options import CirclesOptions
from torch import Tensor

THIN = NetworkConfig(
    encoder=ConvStack((8, 16, 16, 32, 32), (11, 5, 3, 3, 3), (4, 2, 2, 2, 2), (0, 1, 1, 1, 0)),
    critic=ConvStack((8, 8, 16, 16, 1), (11, 5, 3, 3, 3), (4, 4, 2, 2, 2), (0, 0, 1, 1, 1)),
)
FAST = Recipe(batch_size=8, micro_batch_size=8, learning_rate=3e-3, critic_learning_rate=1e-4, critic_weight=0.1)
ALONE = Ranks(0, 1, torch.device("cpu"))
TRAINED = [name for name, terms in METHODS.items() if not (terms.templates or terms.hypotheses)]


class SameBatch(ImageSource):
    """The same few circles at every step, however many are asked for."""

    def __init__(self, *, with_code: bool) -> None:
        world = Circles()
        self.code = world.sample(8, (3,))
        self.images = world.render(self.code)
        self.with_code = with_code

    def batch(self, step: int, size: int) -> Batch:
        rows = torch.arange(size) % 8
        code = {name: value[rows] for name, value in self.code.items()}
        return Batch(self.images[rows], code=code if self.with_code else None)


def configuration(method: MethodName = "our", recipe: Recipe = FAST, **others: object) -> RunConfig:
    return RunConfig(CirclesOptions(), method=method, recipe=recipe, network=THIN, **others)


def trainer(config: RunConfig) -> Trainer:
    return Trainer(config, Circles(), [SameBatch(with_code=config.method == "super")], ALONE)


def weights(trainer: Trainer) -> Tensor:
    return torch.cat(
        [p.detach().flatten() for one in trainer.state.learners.values() for p in one.network.parameters()]
    )


def gradients(trainer: Trainer) -> list[Tensor]:
    return [p.grad for one in trainer.state.learners.values() for p in one.network.parameters()]


@pytest.mark.parametrize("method", TRAINED)
def test_every_method_learns_a_fixed_batch(method: MethodName) -> None:
    one = trainer(configuration(method))
    rows = [one.step(1.0) for _ in range(25)]
    assert all(math.isfinite(value) for row in rows for value in row.values())
    term = {"super": "label", "sleep": "sleep"}.get(method, "image")
    assert sum(row[term] for row in rows[-3:]) / 3 < 0.8 * rows[0][term]  # a mean, because sleep draws anew every step


@pytest.mark.parametrize(
    ("method", "terms"),
    [
        ("our", {"image", "curiosity", "critic"}),
        ("noncur", {"image"}),
        ("super", {"label"}),
        ("sleep", {"sleep"}),
        ("wake_sleep", {"image", "sleep"}),
        ("wake_sleep_critic", {"image", "curiosity", "critic", "sleep"}),
    ],
)
def test_a_method_is_its_loss_terms(method: MethodName, terms: set[str]) -> None:
    one = trainer(configuration(method))
    assert set(one.step(1.0)) == terms
    assert (one.state.critic is None) == ("critic" not in terms)


def test_micro_batches_add_up_to_the_gradient_of_the_whole() -> None:
    whole = trainer(configuration("our", FAST))
    pieces = trainer(configuration("our", replace(FAST, batch_size=24)))  # three times the same micro-batch of eight
    for one in (whole, pieces):
        one.step(1.0)
    for one, other in zip(*(gradients(t) for t in (whole, pieces)), strict=True):
        assert torch.allclose(one, other, atol=1e-5, rtol=1e-3)
    assert pieces.state.progress.images == 24


def test_each_micro_batch_holds_its_own_images(cache: Path) -> None:
    seen = []

    class Recording(ImageSource):
        def batch(self, step: int, size: int) -> Batch:
            seen.append((step, size))
            return SameBatch(with_code=False).batch(step, size)

    one = Trainer(
        configuration("noncur", replace(FAST, batch_size=6, micro_batch_size=2)), Circles(), [Recording()], ALONE
    )
    one.step(1.0)
    one.step(1.0)
    assert seen == [(number, 2) for number in range(6)]


def test_gradients_are_clipped_to_the_recipes_norm() -> None:
    one = trainer(configuration("our", replace(FAST, gradient_clip=1e-3)))
    one.step(1.0)
    for learner in one.state.learners.values():
        norm = torch.stack([p.grad.norm() for p in learner.network.parameters()]).norm()
        assert norm.item() == pytest.approx(1e-3, rel=1e-2)


def test_gradient_penalty_acts_on_its_steps_alone() -> None:
    plain = trainer(configuration("our", FAST))
    rare = trainer(configuration("our", replace(FAST, gradient_penalty=10.0, gradient_penalty_every=3)))
    plain.step(1.0), rare.step(1.0)
    assert not torch.equal(weights(plain), weights(rare))
    rare.state.load({k: v.clone() for k, v in plain.state.tensors().items()}, replace(plain.state.progress))
    plain.step(1.0), rare.step(1.0)
    assert torch.equal(weights(plain), weights(rare))


def test_two_runs_of_a_seed_are_equal_and_another_seed_is_not() -> None:
    runs = [trainer(configuration("wake_sleep_critic", seed=seed)) for seed in (5, 5, 6)]
    for one in runs:
        one.step(1.0)
    assert torch.equal(weights(runs[0]), weights(runs[1]))
    assert not torch.equal(weights(runs[0]), weights(runs[2]))


def test_a_step_that_is_not_finite_is_discarded_and_named() -> None:
    one = trainer(configuration("our"))
    one.step(1.0)
    with torch.no_grad():
        one.state.pose.network.heads.trunk[0].bias[0] = math.inf
    before = weights(one)
    with pytest.raises(TrainingError, match=r"step 2: not finite: .*image.*the gradient of pose"):
        one.step(1.0)
    assert torch.equal(weights(one), before)
    assert one.state.progress.step == 1


def test_learning_rate_warms_up_and_decays_along_a_cosine() -> None:
    recipe = Recipe(warm_up_steps=3, final_learning_rate=0.1)
    assert [learning_rate_factor(recipe, step, 0.0) for step in (0, 1, 2, 3, 9)] == [0.25, 0.5, 0.75, 1, 1]
    assert learning_rate_factor(recipe, 9, 0.5) == pytest.approx(0.55)
    assert learning_rate_factor(recipe, 9, 1.2) == pytest.approx(0.1)
    assert learning_rate_factor(PRESETS["paper"], 0, 0.7) == 1


@pytest.fixture
def interruption() -> Interruption:
    return Interruption()


def test_a_run_ends_with_its_budget_of_images(tmp_path: Path, cache: Path, interruption: Interruption) -> None:
    outcome, course = learn(configuration(images=20), tmp_path / "run", interruption, resume=False, cache=cache)
    assert (outcome, course.step, course.images) == (Outcome.SPENT, 3, 24)
    assert (tmp_path / "run/samples.png").stat().st_size > 0
    rows = [json.loads(line) for line in (tmp_path / "run/history.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows if "image" in row] == [3]
    assert [row["step"] for row in rows if "image_dssim" in row] == [3]
    assert list((tmp_path / "run/tensorboard").iterdir())


def test_a_run_ends_with_its_budget_of_minutes(tmp_path: Path, cache: Path, interruption: Interruption) -> None:
    outcome, course = learn(configuration(minutes=1e-6), tmp_path / "run", interruption, resume=False, cache=cache)
    assert (outcome, course.step) == (Outcome.SPENT, 1)


def test_a_run_ends_when_the_image_loss_is_low_enough(tmp_path: Path, cache: Path, interruption: Interruption) -> None:
    config = configuration(stop_below=1e9)
    outcome, course = learn(config, tmp_path / "run", interruption, resume=False, cache=cache)
    assert (outcome, course.step) == (Outcome.CONVERGED, 1)


def test_a_network_is_finished_once_for_each_budget(tmp_path: Path, interruption: Interruption) -> None:
    """Gone on with without a larger budget, it stays as it is: it has learned of its photographs already."""
    first, finished = trainer(configuration(images=16)), list[int]()
    run, others = RunFolder(tmp_path, first.config), (interruption, None, 60.0)

    def go_on(learner: Trainer) -> None:
        train(learner, run, *others, finish=lambda: finished.append(learner.state.progress.step))

    go_on(first)
    again = trainer(first.config)
    again.state.progress = first.state.progress
    go_on(again)
    assert finished == [2]
    longer = trainer(configuration(images=32))
    longer.state.progress = first.state.progress
    go_on(longer)
    assert finished == [2, 4]
    assert longer.state.progress.finished_step == 4
    interruption.signum = 15
    stopped = trainer(configuration(images=800))
    go_on(stopped)
    assert finished == [2, 4]
    assert stopped.state.progress.finished_step is None


def test_a_signal_while_a_network_is_finished_ends_the_run(tmp_path: Path, interruption: Interruption) -> None:
    learner = trainer(configuration(images=16))

    def finish() -> None:
        interruption.signum = 2

    outcome = train(learner, RunFolder(tmp_path, learner.config), interruption, None, 60.0, finish=finish)
    assert outcome is Outcome.INTERRUPTED
    assert learner.state.progress.finished_step == learner.state.progress.step


def test_a_signal_ends_a_run_after_a_whole_step(tmp_path: Path, cache: Path, interruption: Interruption) -> None:
    interruption.signum = 15
    outcome, _ = learn(configuration(images=800), tmp_path / "run", interruption, resume=False, cache=cache)
    assert outcome is Outcome.INTERRUPTED
    assert list((tmp_path / "run/checkpoints").iterdir())


def test_label_free_methods_do_not_open_the_labels(tmp_path: Path, interruption: Interruption) -> None:
    Circles().source("train", 0, with_code=False, cache=tmp_path)
    for labels in tmp_path.glob("circles-*/*.codes.npz"):
        labels.unlink()
        labels.mkdir()  # whoever opens it fails, root too
    for method in ("our", "noncur", "wake_sleep", "wake_sleep_critic"):
        config = configuration(method, images=8)
        outcome, _ = learn(config, tmp_path / method, interruption, resume=False, cache=tmp_path)
        assert outcome is Outcome.SPENT
    with pytest.raises(DataError):
        learn(configuration("super", images=8), tmp_path / "super", interruption, resume=False, cache=tmp_path)


def test_supervision_sees_only_its_share_of_the_images(tmp_path: Path, cache: Path, interruption: Interruption) -> None:
    few, all_ = (configuration("super", images=8, labels=labels) for labels in (0.05, 1.0))
    for number, config in enumerate((few, all_)):
        learn(config, tmp_path / str(number), interruption, resume=False, cache=cache)
    source = Circles().source("train", 0, with_code=True, cache=cache).subset(0.05)
    shown = source.batch(0, 8).images
    assert all(any(torch.equal(image, one) for one in source.images[:100].float() / 255) for image in shown)
    histories = [(tmp_path / str(number) / "history.jsonl").read_text() for number in range(2)]
    assert histories[0] != histories[1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"labels": 0.5}, "expected --method super"),
        ({"method": "super", "labels": 1.5}, "is no fraction"),
        ({"minutes": 0.0}, "--minutes is 0.0, expected more than 0"),
        ({"method": "super", "stop_below": 1.0}, "--stop-below watches the image loss"),
        ({"images": -1}, "--images is -1, expected more than 0"),
        ({"minutes": float("nan")}, "--minutes is nan, expected more than 0"),
        ({"seed": -1}, "--seed is -1, expected 0 or more"),
    ],
)
def test_configurations_that_make_no_sense_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        RunConfig(CirclesOptions(), **change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"batch_size": 10, "micro_batch_size": 4}, "cannot be cut into micro-batches of 4"),
        ({"micro_batch_size": 1}, "batch norm needs two images"),
        ({"learning_rate": 0.0}, "--learning-rate is 0.0"),
        ({"learning_rate": float("nan")}, "--learning-rate is nan"),
        ({"warm_up_steps": -1}, "--warm-up-steps is -1, expected 0 or more"),
        ({"critic_learning_rate": -1.0}, "--critic-learning-rate is -1.0, expected 0 or more"),
        ({"sleep_drawn": 2.0}, "--sleep-drawn 2.0 is no fraction"),
    ],
)
def test_recipes_that_make_no_sense_are_refused(change: dict[str, float], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        Recipe(**change)


def test_the_paper_preset_is_the_papers_table() -> None:
    paper = PRESETS["paper"]
    assert (paper.batch_size, paper.learning_rate, paper.critic_learning_rate) == (128, 1e-4, 1e-6)
    assert (paper.image_weight, paper.critic_weight, paper.gradient_clip) == (0.01, 10, 0.5)


def test_processes_share_micro_batches_evenly_or_not_at_all() -> None:
    shares = [list(Ranks(rank, 2, torch.device("cpu")).micro_batches(4)) for rank in range(2)]
    assert np.array(shares).tolist() == [[0, 2], [1, 3]]
    with pytest.raises(UsageError, match="3 micro-batches a step cannot be divided among 2 processes"):
        Ranks(0, 2, torch.device("cpu")).micro_batches(3)
