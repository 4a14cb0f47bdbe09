"""The circles world: its statistics, its renderer against brute force, its gradients, its cache."""

from pathlib import Path

import numpy as np
import pytest
import torch
from curio_train.errors import DataError, UsageError
from curio_train.scene_code import TRANSLATION
from curio_train.worlds import build
from curio_train.worlds.generated import circles
from curio_train.worlds.generated.circles import RADIUS, REACH, SIDE_PX, Circles
from curio_train.worlds.options import CirclesOptions
from torch import Tensor


def at(x: float, y: float, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.tensor([[[x, y, 0.0]]], dtype=dtype, requires_grad=True)


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (0.123, -0.3), (REACH, -REACH), (0.45, 0.1), (2.0, 0.0)])
def test_coverage_agrees_with_counting_subpixels(x: float, y: float) -> None:
    fine = 16
    axis = (np.arange(SIDE_PX * fine) + 0.5) / (SIDE_PX * fine) - 0.5
    inside = (axis[None, :] - x) ** 2 + (axis[:, None] - y) ** 2 < RADIUS**2
    counted = inside.reshape(SIDE_PX, fine, SIDE_PX, fine).mean((1, 3))
    rendered = Circles().render({TRANSLATION: at(x, y)})[0, 0].detach().numpy()
    assert abs(rendered - counted).max() < 0.06
    assert rendered.sum() == pytest.approx(counted.sum(), rel=2e-3, abs=0.1)


def test_circle_is_red_on_black_and_its_place_is_x_right_y_down() -> None:
    image = Circles().render({TRANSLATION: at(0.25, -0.125)})[0]
    assert image.shape == (3, SIDE_PX, SIDE_PX)
    assert image[1:].abs().max() == 0
    rows, columns = torch.nonzero(image[0] == 1, as_tuple=True)
    assert (columns.double().mean().item() + 0.5) / SIDE_PX - 0.5 == pytest.approx(0.25, abs=1e-3)
    assert (rows.double().mean().item() + 0.5) / SIDE_PX - 0.5 == pytest.approx(-0.125, abs=1e-3)


def test_backgrounds_show_outside_the_circle_alone() -> None:
    background = torch.full((1, 3, SIDE_PX, SIDE_PX), 0.5, dtype=torch.float64)
    image = Circles().render({TRANSLATION: at(0.0, 0.0)}, background)[0]
    assert image[:, 0, 0].tolist() == [0.5, 0.5, 0.5]
    assert image[:, 64, 64].tolist() == [1.0, 0.0, 0.0]


@pytest.mark.parametrize(("x", "y"), [(0.03, 0.02), (0.11, -0.05), (-0.13, 0.1)])
def test_image_loss_pulls_overlapping_circles_together_as_their_areas_say(x: float, y: float) -> None:
    world = Circles()
    where = (torch.rand(64, 1, 3, generator=torch.Generator().manual_seed(0)) - 0.5).double() / SIDE_PX
    place = (where + at(x, y)).detach().requires_grad_()  # many pairs, so that the pixel grid averages out
    target = world.render({TRANSLATION: where})
    (gradient,) = torch.autograd.grad((world.render({TRANSLATION: place}) - target).square().sum(), place)
    # The loss is the area that only one circle covers: 2 (circle - lens), and d lens / d distance is minus the chord.
    distance = np.hypot(x, y)
    pull = 2 * 2 * np.sqrt(RADIUS**2 - distance**2 / 4) * SIDE_PX**2
    expected = pull * np.array([x, y, 0.0]) / distance
    assert gradient.mean((0, 1)).numpy() == pytest.approx(expected, abs=0.05 * pull)


def test_gradient_is_the_derivative_of_the_pixels() -> None:
    def first_channel(position: Tensor) -> Tensor:
        return Circles().render({TRANSLATION: position})[:, 0, 50:60, 50:60]

    assert torch.autograd.gradcheck(first_channel, at(-0.0123, -0.1511), eps=1e-7, atol=1e-4)


def test_gradient_is_finite_when_a_pixel_sits_on_the_centre() -> None:
    place = at(0.5 / SIDE_PX, 0.5 / SIDE_PX)
    (gradient,) = torch.autograd.grad(Circles().render({TRANSLATION: place}).square().sum(), place)
    assert gradient.isfinite().all()


def test_drawn_circles_are_whole_flat_spread_and_repeatable() -> None:
    world = Circles()
    position = world.sample(4000, (7,))[TRANSLATION]
    assert position[..., :2].abs().max() <= REACH
    assert position[..., 2].abs().max() == 0
    assert position[..., :2].mean((0, 1)).abs().max() < 0.02
    assert position[..., :2].std((0, 1)).numpy() == pytest.approx(2 * REACH / np.sqrt(12), rel=0.03)
    assert torch.equal(position, world.sample(4000, (7,))[TRANSLATION])
    assert not torch.equal(position, world.sample(4000, (8,))[TRANSLATION])
    areas = world.render({TRANSLATION: position[:200]})[:, 0].sum((1, 2))
    assert areas.min() / areas.max() > 0.995


def test_predicted_third_value_cannot_leave_the_plane() -> None:
    assert circles.Circles.layout[TRANSLATION].activate(torch.randn(4, 1, 3))[..., 2].abs().max() == 0


def test_splits_have_the_papers_sizes_and_differ(cache: Path) -> None:
    world = build(CirclesOptions())
    sources = {split: world.source(split, 0, with_code=True, cache=cache) for split in ("train", "validation", "test")}
    assert [len(source) for source in sources.values()] == [2000, 500, 500]
    firsts = [source.code[TRANSLATION][0] for source in sources.values()]
    assert not torch.equal(firsts[0], firsts[1])
    assert not torch.equal(firsts[1], firsts[2])
    batch = sources["test"].batch(0, 3)
    assert (batch.images - world.render(batch.code)).abs().max() <= 0.5 / 255 + 1e-6


def test_every_epoch_shows_each_training_image_once_in_another_order(cache: Path) -> None:
    source = Circles().source("train", 3, with_code=True, cache=cache)

    def epoch(number: int) -> Tensor:
        return torch.cat([source.batch(step, 500).code[TRANSLATION] for step in range(4 * number, 4 * number + 4)])

    first, second = epoch(0), epoch(1)
    assert not torch.equal(first, second)
    assert torch.equal(first.flatten(1).sum(1).sort().values, second.flatten(1).sum(1).sort().values)
    assert torch.equal(first, epoch(0))


def test_batches_may_straddle_epochs(cache: Path) -> None:
    source = Circles().source("validation", 0, with_code=True, cache=cache)
    across = source.batch(1, 300).code[TRANSLATION]
    assert torch.equal(across[200:], source.code[TRANSLATION][:100])


def test_a_share_of_the_images_is_always_the_same_images(cache: Path) -> None:
    source = Circles().source("train", 0, with_code=True, cache=cache).subset(0.05)
    seen = torch.cat([source.batch(step, 50).code[TRANSLATION] for step in range(4)]).flatten(1)
    assert len(seen.unique(dim=0)) == len(source) == 100
    with pytest.raises(UsageError, match="fraction of 0 of 100 images"):
        source.subset(0)


def test_without_codes_the_label_file_is_not_opened(tmp_path: Path) -> None:
    world = Circles()
    world.source("validation", 0, with_code=True, cache=tmp_path)
    (labels,) = tmp_path.glob("circles-*/validation.codes.npz")
    labels.write_bytes(b"unreadable")
    assert world.source("validation", 0, with_code=False, cache=tmp_path).batch(0, 2).code is None
    with pytest.raises(DataError, match=r"validation\.codes\.npz is damaged"):
        world.source("validation", 0, with_code=True, cache=tmp_path)


def test_a_cache_that_cannot_be_written_is_one_clear_error(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    with pytest.raises(DataError, match=r"cannot write .*--cache"):
        Circles().source("test", 0, with_code=False, cache=blocked)


def test_an_image_set_that_was_emptied_is_named_and_made_anew(tmp_path: Path) -> None:
    world = Circles()
    world.source("validation", 0, with_code=True, cache=tmp_path)
    for name in ("images", "codes"):
        (file,) = tmp_path.glob(f"circles-*/validation.{name}.npz")
        file.write_bytes(b"")
        with pytest.raises(DataError, match=rf"validation\.{name}\.npz is damaged .*delete it"):
            world.source("validation", 0, with_code=True, cache=tmp_path)
        file.unlink()
        assert world.source("validation", 0, with_code=True, cache=tmp_path).batch(0, 2).code is not None
