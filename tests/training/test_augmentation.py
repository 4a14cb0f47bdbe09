import numpy as np
import torch
from curio_train.data.augmentation import disturb


def test_same_draws_same_pictures_and_each_its_own():
    images = torch.full((8, 3, 32, 32), 0.5)
    first, again = (disturb(images, np.random.default_rng(3)) for _ in range(2))
    other = disturb(images, np.random.default_rng(4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert len({round(float(image.mean()), 4) for image in first}) == len(first)


def test_stays_an_image():
    images = torch.rand(16, 3, 24, 40)
    out = disturb(images, np.random.default_rng(0))
    assert out.shape == images.shape
    assert out.min() >= 0
    assert out.max() <= 1


def test_the_picture_remains_recognisable():
    """Disturbed images correlate with their own originals far more than with others'."""
    random = np.random.default_rng(1)
    coarse = torch.from_numpy(random.random((64, 3, 4, 4), dtype=np.float32))
    images = torch.nn.functional.interpolate(coarse, size=32, mode="bilinear")
    out = disturb(images, random)
    a, b = ((x - x.mean((1, 2, 3), keepdim=True)).flatten(1) for x in (images, out))
    correlation = torch.nn.functional.normalize(a) @ torch.nn.functional.normalize(b).T
    assert correlation.diagonal().mean() > 0.6
    assert correlation.diagonal().mean() > correlation.mean() + 0.4
