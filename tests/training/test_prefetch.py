"""Prefetched items equal those made without a thread, come in order, and the thread ends."""

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from curio_train.camera import Intrinsics
from curio_train.config import ConvStack, NetworkConfig, Recipe, RunConfig
from curio_train.data.backgrounds import ClutterBackgrounds
from curio_train.errors import DataError
from curio_train.learning.parallel import Ranks
from curio_train.learning.prefetch import prefetching
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.interruption import Interruption
from curio_train.learning.session import learn
from curio_train.learning.state import TrainState
from curio_train.learning.trainer import Trainer
from curio_train.meshes.shapes import box
from curio_train.worlds.base import Batch, ImageSource, ObjectKind
from curio_train.worlds.generated.circles import Circles
from curio_train.worlds.options import CirclesOptions
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import Object
from torch import Tensor

CONFIG = RunConfig(
    CirclesOptions(),
    method="sleep",
    images=32,
    recipe=Recipe(batch_size=8, micro_batch_size=4),
    network=NetworkConfig(encoder=ConvStack((8, 16, 16, 32, 32), (11, 5, 3, 3, 3), (4, 2, 2, 2, 2), (0, 1, 1, 1, 0))),
)


def names() -> set[str]:
    return {thread.name for thread in threading.enumerate()}


def test_items_are_made_in_order_by_one_other_thread_one_ahead() -> None:
    made, began = [], threading.Event()

    def make(number: int) -> int:
        made.append((number, threading.get_ident()))
        if number == 11:
            began.set()
        return number * number

    with prefetching(make, 3) as prefetcher:
        assert [prefetcher.take(number) for number in (2, 5, 8)] == [4, 25, 64]
        assert began.wait(10), "nothing is prefetched"
        prefetcher.wait_idle()
        assert [number for number, _ in made] == [2, 5, 8, 11]
        assert prefetcher.take(40) == 1600, "another number than foreseen"
    assert len({thread for _, thread in made} | {threading.get_ident()}) == 2
    assert not any(name.startswith("prefetch") for name in names())


def test_an_error_arrives_when_its_item_is_taken_and_the_thread_ends() -> None:
    broken = DataError("the photograph drawn is broken")

    def make(number: int) -> int:
        if number == 1:
            raise broken
        return number

    def take_all() -> None:
        with prefetching(make, 1) as prefetcher:
            assert prefetcher.take(0) == 0
            prefetcher.wait_idle()
            prefetcher.take(1)

    with pytest.raises(DataError) as raised:
        take_all()
    assert raised.value is broken
    assert not any(name.startswith("prefetch") for name in names())


def test_the_callers_number_of_threads_stays() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    with prefetching(lambda _: torch.get_num_threads(), 1) as prefetcher:
        assert prefetcher.take(0) == 1
        assert torch.get_num_threads() == 2
    torch.set_num_threads(before)


def tensors(path: Path) -> dict[str, Tensor]:
    run = RunFolder.open(path)
    state = TrainState(run.config, Circles(), torch.device("cpu"))
    run.restore(state)
    return state.tensors()


def test_prefetched_batches_train_the_same_weights_bit_for_bit(tmp_path: Path) -> None:
    """Whole, in pieces, and without a thread: the same weights."""
    learn(CONFIG, tmp_path / "whole", Interruption(), resume=False, cache=tmp_path)
    learn(replace(CONFIG, images=16), tmp_path / "pieces", Interruption(), resume=False, cache=tmp_path)
    learn(CONFIG, tmp_path / "pieces", Interruption(), resume=True, cache=tmp_path)
    whole, pieces = tensors(tmp_path / "whole"), tensors(tmp_path / "pieces")
    assert [name for name in whole if not torch.equal(whole[name], pieces[name])] == []
    world, here = Circles(), Ranks(0, 1, torch.device("cpu"))
    source = world.source("train", 0, with_code=False, cache=tmp_path)
    one, other = (Trainer(CONFIG, world, [source], here) for _ in range(2))
    losses = [one.step(1.0) for _ in range(3)]
    with other.synthetic.prefetching():
        assert [other.step(1.0) for _ in range(3)] == losses
        assert any(name.startswith("prefetch") for name in names())
    assert not any(name.startswith("prefetch") for name in names())
    assert [other.step(1.0)] == [one.step(1.0)]


def test_images_that_cannot_be_read_end_training_with_their_error(tmp_path: Path) -> None:
    class Broken(ImageSource):
        def batch(self, step: int, size: int) -> Batch:
            if step >= 3:
                raise DataError("frame 3 is broken")
            return Batch(torch.zeros(size, 3, 128, 128))

    one = Trainer(CONFIG, Circles(), [Broken()], Ranks(0, 1, torch.device("cpu")))

    def train() -> None:
        with one.synthetic.prefetching():
            one.step(1.0)
            one.step(1.0)

    with pytest.raises(DataError, match="frame 3"):
        train()
    assert one.state.progress.step == 1
    assert not any(name.startswith("prefetch") for name in names())


def test_the_renderer_draws_the_same_in_another_thread() -> None:
    """To the last bit where one of the renderer's threads adds up; several have no fixed order."""
    import drjit

    mesh = box((0.09, 0.06, 0.12))
    matrix = np.array([[572.4, 0, 325.3], [0, 573.6, 242.0], [0, 0, 1]])
    kind = ObjectKind("brick", (0,), mesh.diameter_m, mesh.box_corners_m, mesh.sha256)
    pool = np.full((5, 240, 320, 3), 128, np.uint8)
    thing = Object(kind, mesh, Intrinsics(matrix, 640, 480), 0.5, 1.5, lambda _: ClutterBackgrounds(pool))
    world = TwoStageWorld("linemod", thing)

    def draw(number: int) -> list[Tensor]:
        look = world.stages[number % 2]
        code = look.sample(8, (number,))
        return [look.augment(look.render(code), (number,)), *code.values()]

    threads = drjit.thread_count()
    drjit.set_thread_count(1)
    try:
        with torch.no_grad(), prefetching(draw, 1) as prefetcher:
            drawn = [prefetcher.take(number) for number in range(4)]
            prefetcher.wait_idle()
            for number, elsewhere in enumerate(drawn):
                assert all(map(torch.equal, elsewhere, draw(number)))
    finally:
        drjit.set_thread_count(threads)
