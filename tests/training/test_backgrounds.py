import dataclasses

import cv2
import numpy as np
import pytest
import torch
from curio_train.data.background_image import BackgroundImages, MixedBackgrounds
from curio_train.data.backgrounds import POOL_HEIGHT, POOL_WIDTH, ClutterBackgrounds, PhotographBackgrounds, render_pool
from curio_train.data.clutter import dead_leaves_texture
from curio_train.data.photographs import Photographs
from curio_train.errors import DataError
from curio_train.meshes.shapes import sphere


@pytest.fixture(scope="module")
def pool():
    return render_pool(10, seed=5)


def test_clutter_is_varied_and_repeatable(pool):
    assert pool.shape == (10, POOL_HEIGHT, POOL_WIDTH, 3)
    assert pool.dtype == np.uint8
    assert pool.reshape(10, -1).std(1).min() > 8
    assert np.array_equal(pool[:3], render_pool(10, seed=5)[:3])
    assert not np.array_equal(pool, render_pool(10, seed=6))


def test_leaves_cover_each_other_with_strong_edges_everywhere():
    random = np.random.default_rng(2)
    pictures = np.full((12, POOL_HEIGHT, POOL_WIDTH, 3), 0.5, np.float32)
    for picture in pictures:
        dead_leaves_texture(picture, random)
    assert pictures.min() >= 0
    assert pictures.max() <= 1
    covered = (pictures != 0.5).any(axis=-1)
    assert 0.2 < covered.mean() < 0.95
    assert covered.mean(axis=0).min() > 0, "somewhere no leaf ever lies"
    steps = np.abs(np.diff(pictures, axis=2)).max(axis=-1)
    assert (steps > 0.2).mean() > 0.02


def test_other_objects_lie_about():
    """A mesh of a colour that nothing else has covers more in most pictures than in those without it."""
    shape = sphere(0.06)
    green = dataclasses.replace(shape, vertex_colors_srgb=np.tile([0.0, 1.0, 0.0], (len(shape.vertices_m), 1)))
    found = []
    for others in ([], [green] * 3):
        pictures = render_pool(10, seed=5, others=others).astype(int)
        greenest = (pictures[..., 1] - 4 * pictures[..., [0, 2]].max(axis=-1)).reshape(10, -1) > 0
        found.append(greenest.sum(axis=1))
    assert (found[1] > found[0] + 20).mean() > 0.5


def test_draws_are_a_function_of_the_seed(pool):
    source = ClutterBackgrounds(pool)
    first, again, other = (source.draw(4, 48, 32, seed) for seed in ((1, 2), (1, 2), (1, 3)))
    assert first.shape == (4, 3, 32, 48)
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert first.min() >= 0
    assert first.max() <= 1


def test_training_and_test_backgrounds_are_different_pictures():
    marked = np.zeros((10, POOL_HEIGHT, POOL_WIDTH, 3), np.uint8)
    marked[8:] = 255
    source = ClutterBackgrounds(marked)
    assert source.split(train=True).draw(40, 8, 8, (0,)).max() == 0
    assert source.split(train=False).draw(40, 8, 8, (0,)).min() == 1


def test_cached_pool_is_written_where_it_can_be(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="--cache"):
        ClutterBackgrounds.cached(tmp_path / "file" / "below")


def test_photographs_as_backgrounds(tmp_path):
    for number in range(5):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((60, 80, 3), 50 * number, np.uint8))
    source = PhotographBackgrounds(Photographs(tmp_path))
    assert source.split(train=False).draw(10, 16, 16, (0,)).min() == pytest.approx(200 / 255)
    assert source.split(train=True).draw(30, 16, 16, (0,)).max() == pytest.approx(150 / 255)


def test_crops_of_a_plate_span_what_they_span_in_a_frame() -> None:
    ramp = np.tile(np.linspace(0, 255, 400).astype(np.uint8)[None, :, None], (300, 1, 3))
    whole = BackgroundImages(ramp).draw(20, 40, 30, (0,))
    part = BackgroundImages(ramp).of_crops(0.2, 0.3).draw(20, 30, 30, (0,))
    across = [(views[..., -1] - views[..., 0]).mean(dim=(1, 2)) for views in (whole, part)]
    assert across[0].min() > 0.55
    assert across[1].max() < 0.45
    assert across[1].min() > 0.05
    assert BackgroundImages(ramp).of_crops(3.0, 4.0).draw(2, 30, 30, (0,)).shape == (2, 3, 30, 30), "larger than it"


def test_crops_of_a_plate_are_darker_where_a_part_throws_its_shadow() -> None:
    plate = BackgroundImages(np.full((300, 400, 3), 128, np.uint8))
    crops, whole = plate.of_crops(0.2, 0.3).draw(100, 32, 32, (0,)), plate.draw(100, 32, 32, (0,))
    middle, border = (slice(12, 20), slice(0, 2))
    relative = [(v[..., middle, middle].mean() / v[..., border, :].mean()).item() for v in (crops, whole)]
    assert relative[0] < 0.9
    assert relative[1] == pytest.approx(1, abs=0.05)


def test_a_mixture_draws_from_both() -> None:
    black, white = (BackgroundImages(np.full((30, 40, 3), value, np.uint8)) for value in (0, 255))
    mixed = MixedBackgrounds(black, white, 0.5).split(True).of_crops(0.5, 1)
    bright = mixed.draw(40, 8, 6, (3,)).mean(dim=(1, 2, 3)) > 0.5
    assert 8 < bright.sum() < 32
    assert torch.equal(mixed.draw(40, 8, 6, (3,)), mixed.draw(40, 8, 6, (3,)))
