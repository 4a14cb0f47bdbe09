"""Scenes found for a run's training images before it learns from them, for ``--method hypotheses``.

The search takes minutes to an hour, so what is found is kept in the run folder, some images a file, and a run that was
stopped goes on with the images that are left::

    RUN/found/00000.npz     the scene codes found for the first images of the set, and the seconds that it took
"""

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from curio_train.config import DecoderKind
from curio_train.errors import CheckpointError, UsageError
from curio_train.refinement.found_frames import FrameExplainer, TrainingFrames, stage_sources, template_reader
from curio_train.scene_code import joined
from curio_train.worlds.base import Explainer, ImageSource, World
from curio_train.worlds.image_sets import StoredImages, load_arrays, save_arrays
from curio_train.worlds.single_object.two_stage import TwoStageWorld

_FOLDER = "found"
_A_FILE = 100  # images
_SECONDS = "seconds"


class Found(NamedTuple):
    """The scenes that a search found."""

    sources: Sequence[ImageSource]
    """Images with scenes for each of the world's stages."""
    seconds: float
    """Seconds that the search took, over all sessions."""


class Images(Protocol):
    """Images that are searched, uint8 [3, height, width] each."""

    def __len__(self) -> int: ...

    def __getitem__(self, rows: slice, /) -> Tensor:
        """Neighbouring ones, [num, 3, height, width]."""


def search_of(world: World, reading: DecoderKind | None, seed: int, cache: Path) -> Callable[[Path], Found]:
    """A function that finds the scenes of training images, given the run folder.

    Args:
        world: That the images are of.
        reading: The decoder that is to learn from them.
        seed: Of the shuffling and all draws.
        cache: Folder of the image sets that worlds draw once.

    Raises:
        UsageError: Scenes of this world cannot be found, or this decoder cannot learn from them.
        DataError: The backgrounds cannot be read. The search itself raises it, too, for damaged files of found scenes,
            and CheckpointError if the run folder cannot be written or weights of pretrained features are missing.
    """
    if isinstance(world, TwoStageWorld) and world.name == "linemod":  # captures have photographs to learn from
        frames, finder = TrainingFrames(world, seed, cache), FrameExplainer(world, template_reader(world, cache))

        def search_frames(run: Path) -> Found:
            code, seconds = explained(finder, frames, run)
            return Found(stage_sources(world, frames, code, seed), seconds)

        return search_frames
    explainer = world.explainer()
    if reading != "cells":
        raise UsageError("--method hypotheses teaches the dense decoder alone; add --reading cells")
    source = world.source("train", seed, with_code=False, cache=cache)
    assert isinstance(source, StoredImages)  # worlds with hypotheses have those

    def search_images(run: Path) -> Found:
        code, seconds = explained(explainer, source.images, run)
        return Found([source.with_code(code)], seconds)

    return search_images


def explained(explainer: Explainer, images: Images, run: Path) -> tuple[dict[str, Tensor], float]:
    """The scenes found for images, and the seconds that it took, over all sessions.

    Raises:
        CheckpointError: The run folder cannot be written.
        DataError: A file of found scenes is damaged.
    """
    parts, seconds = list[dict[str, Tensor]](), 0.0
    for first in range(0, len(images), _A_FILE):
        file = run / _FOLDER / f"{first:05d}.npz"
        if not file.exists():
            print(f"{run}: scenes found for {first:,} of {len(images):,} images", file=sys.stderr)
            begin = time.monotonic()
            found = explainer.explain(images[first : first + _A_FILE])
            arrays = {name: value.numpy() for name, value in found.items()}
            try:
                save_arrays(file, arrays | {_SECONDS: np.array(time.monotonic() - begin)})
            except OSError as exc:
                raise CheckpointError(
                    f"cannot write {file}: {exc.strerror}; make room, then continue with --resume {run}"
                ) from exc
        arrays = load_arrays(file)
        seconds += float(arrays.pop(_SECONDS, 0.0))
        parts.append({name: torch.from_numpy(value) for name, value in arrays.items()})
    return joined(parts), seconds
