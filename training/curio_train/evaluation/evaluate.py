"""Score a run or a model on held-out images of its world, beside the same network untrained, and on real frames."""

import json
from collections.abc import Callable, Sized
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from curio_train.errors import CheckpointError, UsageError
from curio_train.evaluation.real_frames import evaluate_real_frames
from curio_train.evaluation.scores import model_info, pose_scores, poses, scene_scores
from curio_train.evaluation.subject import Predict, Subject, load_subject
from curio_train.learning.configuration import CONFIG_FILE, world_name
from curio_train.learning.provenance import machine
from curio_train.model_card import EVALUATION_FILE
from curio_train.scene_code import SceneCode
from curio_train.worlds.base import Split, World

_BATCH_SIZE = 50
_SEED = 0  # of the images: the same for every run, so that figures can be compared


@dataclass(frozen=True)
class HeldOut:
    """Images of a split with their true codes.

    Attributes:
        images: uint8 [num_images, 3, height, width].
        code: Of all images.
    """

    images: Tensor
    code: SceneCode


def evaluate(
    path: Path,
    *,
    split: Split = "test",
    num_images: int = 500,
    data: Path | None = None,
    bop_results: Path | None = None,
    cache: Path,
    progress: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Score a run folder or an exported model.

    Args:
        path: See :func:`~curio_train.evaluation.subject.load_subject`.
        split: Which images of the world.
        num_images: How many; of a finite set at most all.
        data: A BOP data set whose real frames are scored as well, in the LineMOD world.
        bop_results: Folder for a results file of those frames in BOP's format.
        cache: Where worlds keep their image sets.
        progress: Told what is being done.

    Returns:
        What was evaluated, ``metrics`` by name, the same of the network before its first step as ``untrained``, and
        ``real`` where real frames were scored. Written into a run folder as well.

    Raises:
        CurioError: Any of this package's errors.
    """
    if num_images < 1:
        raise UsageError(f"--num-images is {num_images}, expected at least 1")
    if bop_results is not None and data is None:
        raise UsageError("--bop-results needs the real frames that it is about: --data DIR")
    subject = load_subject(path, data)
    if data is not None and subject.world.mesh is None:
        raise UsageError(f"--data {data}: world {subject.world.name} has no real frames; leave it out")
    progress(f"{num_images} images of the {split} split")
    held_out = draw(subject.world, split, num_images, cache)
    result = _origin(path, subject) | {"split": split, "num_images": len(held_out.images)}
    progress("the network")
    result["metrics"] = score(subject.world, subject.predict, held_out)
    progress("the same network untrained")
    result["untrained"] = score(subject.world, subject.untrained(), held_out)
    if data is not None:
        progress(f"real frames in {data}")
        result["real"] = evaluate_real_frames(subject, data, bop_results)
    if (path / CONFIG_FILE).exists():
        _keep(path, result)
    return result


@torch.no_grad()
def draw(world: World, split: Split, num_images: int, cache: Path) -> HeldOut:
    """The first images of a split, as a camera would give them: in bytes."""
    source = world.source(split, _SEED, with_code=True, cache=cache)
    if isinstance(source, Sized):
        num_images = min(num_images, len(source))
    batches = [source.batch(step, _BATCH_SIZE) for step in range(-(-num_images // _BATCH_SIZE))]
    images = torch.cat([(batch.images.clamp(0, 1) * 255).round().byte() for batch in batches])
    codes = [batch.code for batch in batches if batch.code is not None]
    code = {name: torch.cat([one[name] for one in codes])[:num_images] for name in codes[0]}
    return HeldOut(images[:num_images], code)


def score(world: World, predict: Predict, held_out: HeldOut) -> dict[str, float]:
    """All metrics that mean something in this world."""
    batches = [predict(images) for images in held_out.images.split(_BATCH_SIZE)]
    predicted = {name: torch.cat([batch[name] for batch in batches]) for name in batches[0]}
    scores = scene_scores(world, predicted, held_out.code)
    if world.mesh is not None:
        info = model_info(world.objects[0])
        scores |= pose_scores(poses(predicted), poses(held_out.code), world.mesh.vertices_m, info)
    return scores


def _origin(path: Path, subject: Subject) -> dict[str, Any]:
    config = subject.config
    return {
        "source": str(path),
        "world": world_name(config),
        "objects": [kind.name for kind in subject.world.objects],
        "method": config.method,
        "labels": config.labels if "label" in config.terms else 0.0,
        "preset": config.preset,
        "seed": config.seed,
        "images_seen": subject.images_seen,
        "training_seconds": round(subject.training_seconds, 1),
        "commit": subject.commit,
        "machine": machine(),
    }


def _keep(run: Path, result: dict[str, Any]) -> None:
    """In the run folder, for the card of a model exported from it."""
    file = run / EVALUATION_FILE
    draft = file.with_name(file.name + ".tmp")
    try:
        draft.write_text(json.dumps(result, indent=2), encoding="utf-8")
        draft.replace(file)
    except OSError as exc:
        raise CheckpointError(f"cannot write {file}: {exc.strerror}; make the run folder writable") from exc
