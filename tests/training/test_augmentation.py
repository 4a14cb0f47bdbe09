from dataclasses import replace

import numpy as np
import pytest
import torch
from curio_train.data.augmentation import KNOWN_SCENE, UNKNOWN_SCENE, WHOLE_FRAME, AugmentationStrength, augment
from torch import Tensor

NOTHING = AugmentationStrength(0.0, 0.0, 0.0, (1.0, 1.0), (1.0, 1.0), 0.0, (1.0, 1.0), 0.0, 0.0, 0.0)


def coarse(count: int, side: int = 32) -> Tensor:
    """Pictures of soft patches."""
    random = np.random.default_rng(1)
    patches = torch.from_numpy(random.random((count, 3, 4, 4), dtype=np.float32))
    return torch.nn.functional.interpolate(patches, size=side, mode="bilinear")


def disturbed(images: Tensor, seed: int = 3, **ranges: object) -> Tensor:
    """By the ranges named alone."""
    return augment(images, np.random.default_rng(seed), replace(NOTHING, **ranges))


def test_same_draws_same_pictures_and_each_its_own():
    images = torch.full((8, 3, 32, 32), 0.5)
    first, again = (augment(images, np.random.default_rng(3), UNKNOWN_SCENE) for _ in range(2))
    other = augment(images, np.random.default_rng(4), UNKNOWN_SCENE)
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert len({round(float(image.mean()), 4) for image in first}) == len(first)
    assert bool((images == 0.5).all()), "what was given is changed"


@pytest.mark.parametrize("size", [(24, 40), (300, 260)])
def test_stays_an_image(size):
    images = torch.rand(16, 3, *size).round()  # black and white, which have no logarithm and nothing above
    out = augment(images, np.random.default_rng(0), UNKNOWN_SCENE)
    assert out.shape == images.shape
    assert out.min() >= 0
    assert out.max() <= 1


def test_the_picture_remains_recognisable_and_the_more_so_the_more_is_known():
    """Disturbed images correlate with their own originals far more than with others'."""
    images, own = coarse(64), []
    for most in (UNKNOWN_SCENE, WHOLE_FRAME, KNOWN_SCENE):
        out = augment(images, np.random.default_rng(1), most)
        a, b = ((x - x.mean((1, 2, 3), keepdim=True)).flatten(1) for x in (images, out))
        correlation = torch.nn.functional.normalize(a) @ torch.nn.functional.normalize(b).T
        own.append(correlation.diagonal().mean())
        assert own[-1] > correlation.mean() + 0.4
    assert 0.6 < own[0] < own[1] < own[2]


def test_without_any_range_nothing_changes():
    images = coarse(5, 40).clamp(min=0.01)
    assert torch.allclose(disturbed(images), images, atol=1e-5)


def test_each_range_does_what_it_says():
    images = 0.3 + 0.4 * coarse(200)
    means = disturbed(images, offset=0.1).mean((1, 2, 3)) - images.mean((1, 2, 3))
    assert -0.1 < means.min() < -0.09
    assert 0.09 < means.max() < 0.1
    factors = disturbed(images, exposure=(0.7, 1.2)).mean((1, 2, 3)) / images.mean((1, 2, 3))
    assert 0.7 < factors.min() < 0.72
    assert 1.18 < factors.max() < 1.2
    tinted = disturbed(images, tint=0.15).mean((2, 3)) / images.mean((2, 3))
    assert 0.85 < tinted.min() < 0.87
    assert 1.13 < tinted.max() < 1.15
    grey = disturbed(images, saturation=(0.0, 0.0))
    assert torch.allclose(grey, images.mean(1, keepdim=True).expand_as(images), atol=1e-5)
    flat = disturbed(images, contrast=(0.0, 0.0))
    assert torch.allclose(flat, images.mean((1, 2, 3), keepdim=True).expand_as(images), atol=1e-5)
    exponents = disturbed(images, gamma=0.3).log() / images.log()
    assert torch.allclose(exponents, exponents.mean((1, 2, 3), keepdim=True).expand_as(images), atol=1e-3)
    assert 0.28 < exponents.log().abs().max() < 0.31


def test_light_is_uneven_and_smooth_and_the_same_for_all_channels():
    images = torch.full((100, 3, 40, 60), 0.3)
    light = (disturbed(images, shade=0.3) / images).log()
    assert torch.allclose(light, light[:, :1].expand_as(light), atol=1e-5)
    assert 0.1 < light.std() < 0.25  # an evenly drawn strength below 0.3, less between the grid's points
    assert light.diff(dim=-1).abs().max() < 0.15


def test_noise_is_gaussian_of_a_strength_of_its_own_in_each_image():
    images = torch.full((200, 3, 40, 40), 0.5)
    noise = disturbed(images, noise=0.05) - images
    strengths = noise.std((1, 2, 3))
    assert strengths.min() < 0.003
    assert 0.047 < strengths.max() < 0.052
    scaled = noise / strengths[:, None, None, None]
    assert abs(float((scaled**4).mean()) - 3) < 0.05
    flat = torch.nn.functional.normalize(noise.flatten(1))
    assert (flat @ flat.T).fill_diagonal_(0).abs().max() < 0.1, "two images have the same noise"
    assert abs(float((scaled[..., 1:] * scaled[..., :-1]).mean())) < 0.01


def test_blur_is_a_gaussian_of_a_pixel_at_most():
    dot = torch.zeros(300, 3, 15, 15)
    dot[:, :, 7, 7] = 1.0
    seen = disturbed(dot, blur=1.0)
    sums = seen.sum((2, 3))
    assert torch.allclose(sums, torch.ones_like(sums), atol=0.03)  # black is a ten-thousandth
    middle = seen[:, 0, 7, 7]
    assert (middle.min() - (6 / 16) ** 2).abs() < 0.02
    assert middle.max() > 0.98
    wide = seen[middle.argmin(), 0]
    assert wide[7, 9] / wide[7, 7] == pytest.approx(1 / 6, abs=0.02)
    assert torch.allclose(wide, wide.T, atol=1e-6)


def test_pieces_of_other_images_lie_before_their_share():
    shades = torch.linspace(0.1, 0.9, 200)[:, None, None, None]
    images = shades.expand(-1, 3, 48, 64).contiguous()
    changed = (disturbed(images, occluded=0.5) - images).abs() > 1e-3
    covered = changed.any(dim=1).float().mean((1, 2))
    assert 70 < int((covered > 0).sum()) < 110  # a few of a hundred lie beside the frame
    assert 0.01 < covered[covered > 0].mean() < 0.3
    assert not bool((disturbed(images, occluded=0.0) - images).abs().max() > 1e-3)
