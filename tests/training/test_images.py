"""DSSIM against its definition."""

import pytest
import torch
from curio_train.metrics.images import dssim


def noise(seed: int) -> torch.Tensor:
    return torch.rand(2, 3, 24, 32, generator=torch.Generator().manual_seed(seed))


def test_equal_is_zero() -> None:
    assert dssim(noise(0), noise(0)).tolist() == pytest.approx([0, 0], abs=1e-12)


def test_constant_images_by_hand() -> None:
    # Without variance SSIM is (2ab + c) / (a² + b² + c) with c = (0.01 * range)².
    a, b = torch.full((1, 3, 16, 16), 0.2), torch.full((1, 3, 16, 16), 0.6)
    c = 0.01**2
    ssim = (2 * 0.2 * 0.6 + c) / (0.2**2 + 0.6**2 + c)
    assert dssim(a, b).item() == pytest.approx((1 - ssim) / 2, rel=1e-6)


def test_worse_is_larger_and_images_apart() -> None:
    truth = noise(0)
    slightly = (truth + 0.05 * noise(1)).clamp(0, 1)
    wholly = noise(2)
    near, far = dssim(slightly, truth), dssim(wholly, truth)
    assert (near < 0.1).all()
    assert (far > 0.3).all()
    mixed = dssim(torch.stack([slightly[0], wholly[1]]), truth)
    assert mixed.tolist() == pytest.approx([near[0].item(), far[1].item()])


def test_inverted_image_is_beyond_half() -> None:
    assert (dssim(1 - noise(0), noise(0)) > 0.5).all()
