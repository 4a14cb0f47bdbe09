"""What repeats: kernels from step to step, and images to the bit where one thread computes."""

import drjit
import pytest
import torch
from curio_train.scene_code import SceneCode
from curio_train.worlds.generated.light import Light


@pytest.fixture(scope="module")
def world() -> Light:
    """The world with the longest programs: ten slots, shadows, a sun that moves."""
    return Light()


def step(world: Light, code: SceneCode) -> list[torch.Tensor]:
    """Images and gradients."""
    attached = {name: value.clone().requires_grad_() for name, value in code.items()}
    images = world.render(attached)
    images.square().sum().backward()
    gradients = [value.grad for value in attached.values()]
    return [images.detach(), *(g for g in gradients if g is not None)]


def test_no_step_compiles_what_another_did(world: Light) -> None:
    step(world, world.sample(4, (0,)))
    with drjit.scoped_set_flag(drjit.JitFlag.KernelHistory, True):
        drjit.kernel_history_clear()
        for number, count in enumerate((4, 4, 9, 3), start=1):
            step(world, world.sample(count, (number,)))
        kernels = [entry for entry in drjit.kernel_history() if entry["type"] == drjit.KernelType.JIT]
    assert len(kernels) > 100
    assert all(entry["cache_hit"] for entry in kernels)


def test_one_thread_repeats_to_the_bit(world: Light) -> None:
    """Several add to the same pixel and the same gradient in any order, so their last bits differ."""
    code, threads = world.sample(8, (1,)), drjit.thread_count()
    many = step(world, code)
    try:
        drjit.set_thread_count(1)
        first, second = step(world, code), step(world, code)
    finally:
        drjit.set_thread_count(threads)
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    assert torch.allclose(many[0], first[0], atol=1e-6)
