"""Finite image sets that a world draws once and keeps in a cache folder.

The folder is named by the hash of the recipe, so a changed constant never meets old images::

    CACHE/circles-1f0c…/train.images.npz     uint8 [num, 3, height, width]
                        train.codes.npz      the true scene codes; label-free runs never open this file
"""

import hashlib
import json
import os
import tempfile
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from curio_train.errors import DataError, UsageError
from curio_train.scene_code import SceneCode, index
from curio_train.worlds.base import SPLITS, Batch, ImageSource, Split, World

NUM_IMAGES: Mapping[Split, int] = {"train": 2000, "validation": 500, "test": 500}  # paper, section "Analysis"
_CHUNK = 100


class StoredImages(ImageSource):
    """A finite image set in memory."""

    images: Tensor
    """uint8 [num, 3, height, width]."""
    code: SceneCode | None
    """The true codes of all images, or None."""

    def __init__(
        self, images: Tensor, code: SceneCode | None, *, seed: int, shuffle: bool, backgrounds: Tensor | None = None
    ) -> None:
        """Hold the images.

        Args:
            images: uint8 [num, 3, height, width].
            code: The true codes of all images, or None.
            seed: Of the shuffling.
            shuffle: Give each epoch its own order.
            backgrounds: uint8 [num, 3, height, width], the background of each image; None: the world's own.
        """
        self.images, self.code = images, code
        self._seed, self._shuffle, self._backgrounds = seed, shuffle, backgrounds

    def __len__(self) -> int:
        return len(self.images)

    def subset(self, fraction: float) -> "StoredImages":
        """The first images of the set.

        Raises:
            UsageError: No image is left, or there are not so many.
        """
        count = round(fraction * len(self))
        if not 0 < count <= len(self):
            raise UsageError(
                f"a fraction of {fraction} of {len(self)} images is {count} images, expected 1 to {len(self)}"
            )
        code = None if self.code is None else index(self.code, slice(count))
        backgrounds = None if self._backgrounds is None else self._backgrounds[:count]
        return StoredImages(self.images[:count], code, seed=self._seed, shuffle=self._shuffle, backgrounds=backgrounds)

    def with_code(self, code: SceneCode) -> "StoredImages":
        """These images with other codes."""
        return StoredImages(self.images, code, seed=self._seed, shuffle=self._shuffle, backgrounds=self._backgrounds)

    def batch(self, step: int, size: int) -> Batch:
        """Images ``step * size`` to ``(step + 1) * size`` of the endless sequence of epochs."""
        rows = self._rows(np.arange(step * size, (step + 1) * size))
        images = self.images[rows].float() / 255
        backgrounds = None if self._backgrounds is None else self._backgrounds[rows].float() / 255
        return Batch(images, backgrounds, None if self.code is None else index(self.code, rows))

    def _rows(self, positions: np.ndarray) -> Tensor:
        epochs, rows = np.divmod(positions, len(self))
        if self._shuffle:
            orders = {
                epoch: np.random.default_rng((self._seed, epoch)).permutation(len(self))
                for epoch in set(epochs.tolist())
            }
            rows = np.array([orders[epoch][row] for epoch, row in zip(epochs.tolist(), rows, strict=True)])
        return torch.from_numpy(rows)


def stored_images(
    world: World, recipe: Mapping[str, Any], split: Split, seed: int, *, with_code: bool, cache: Path
) -> StoredImages:
    """A split of a world, drawn and rendered on first use.

    Args:
        world: Draws and renders.
        recipe: Every constant the images depend on; its hash names the folder.
        split: The training split is shuffled, the others keep their order.
        seed: Of the shuffling alone: all runs share the same images.
        with_code: Without it the file of true codes is not opened.
        cache: Parent of the folders of all worlds.

    Raises:
        DataError: The cache cannot be written, or a file in it is damaged.
    """
    digest = hashlib.sha256(json.dumps({**recipe, "num": NUM_IMAGES[split]}, sort_keys=True).encode()).hexdigest()[:16]
    folder = cache.expanduser() / f"{world.name}-{digest}"
    images, codes = folder / f"{split}.images.npz", folder / f"{split}.codes.npz"
    if not (images.exists() and codes.exists()):
        _draw(world, split, images, codes)
    code = {name: torch.from_numpy(value) for name, value in load_arrays(codes).items()} if with_code else None
    return StoredImages(torch.from_numpy(load_arrays(images)["images"]), code, seed=seed, shuffle=split == "train")


@torch.no_grad()
def _draw(world: World, split: Split, images: Path, codes: Path) -> None:
    code = world.sample(NUM_IMAGES[split], (SPLITS.index(split),))
    chunks = [world.render(index(code, slice(start, start + _CHUNK))) for start in range(0, NUM_IMAGES[split], _CHUNK)]
    pixels = (torch.cat(chunks).clamp(0, 1) * 255).round().byte()
    try:
        save_arrays(codes, {name: value.numpy() for name, value in code.items()})
        save_arrays(images, {"images": pixels.numpy()})  # last, so that codes of another version are never beside them
    except OSError as exc:
        raise DataError(
            f"cannot write {images}: {exc.strerror}; name a writable folder with enough space: --cache"
        ) from exc


def save_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write whole or not at all, so that neither a full disk nor a second process leaves half a file.

    Raises:
        OSError: The file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
            os.chmod(file.name, 0o644)
            os.link(file.name, path)
    except FileExistsError:
        return  # another process has written the same


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read what :func:`save_arrays` wrote.

    Raises:
        DataError: The file is damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, EOFError, ValueError, zlib.error, zipfile.BadZipFile) as exc:
        raise DataError(f"{path} is damaged ({exc}); delete it, it is made anew") from exc
