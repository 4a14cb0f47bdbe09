"""Scenes found for a run's training images before it learns from them, for ``--method hypotheses``.

The search takes minutes to an hour, so what is found is kept in the run folder, some images a file, and a run that was
stopped goes on with the images that are left::

    RUN/found/00000.npz     the scene codes found for the first images of the set
"""

import sys
from pathlib import Path

import torch
from torch import Tensor

from curio_train.errors import CheckpointError, UsageError
from curio_train.scene_code import joined
from curio_train.worlds.base import Explainer, HypothesisWorld, ImageSource, World
from curio_train.worlds.image_sets import StoredImages, load_arrays, save_arrays

_FOLDER = "found"
_A_FILE = 100  # images


def explainer_of(world: World) -> Explainer:
    """What finds the scenes of a world's images.

    Raises:
        UsageError: The world has no hypotheses, or scenes of this world cannot be found so.
    """
    if not isinstance(world, HypothesisWorld):
        raise UsageError(f"--method hypotheses: {world.name} has no hypotheses; expected chairs, multi or light")
    return world.explainer()


def explained(explainer: Explainer, source: ImageSource, run: Path) -> StoredImages:
    """The images with the scenes found for them.

    Raises:
        CheckpointError: The run folder cannot be written.
        DataError: A file of found scenes is damaged.
    """
    assert isinstance(source, StoredImages)  # worlds with hypotheses have those
    parts = list[dict[str, Tensor]]()
    for first in range(0, len(source), _A_FILE):
        file = run / _FOLDER / f"{first:05d}.npz"
        if not file.exists():
            print(f"{run}: scenes found for {first:,} of {len(source):,} images", file=sys.stderr)
            found = explainer.explain(source.images[first : first + _A_FILE])
            try:
                save_arrays(file, {name: value.numpy() for name, value in found.items()})
            except OSError as exc:
                raise CheckpointError(
                    f"cannot write {file}: {exc.strerror}; make room, then continue with --resume {run}"
                ) from exc
        parts.append({name: torch.from_numpy(value) for name, value in load_arrays(file).items()})
    return source.with_code(joined(parts))
