"""Measures how far a model's answers may be trusted, on renderings: when they are sure, and how far off they are."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from curio_proto.v1.model_spec_pb2 import ObjectReliability, Reliability
from curio_serve.models.reliability import bounds_of

from curio_train.counting import counted
from curio_train.errors import ExportError, UsageError
from curio_train.evaluation.scores import rotation_errors_deg
from curio_train.evaluation.subject import Predict
from curio_train.geometry import Pose
from curio_train.metrics.conformal import LEVEL, error_bounds, sure_from
from curio_train.scene_code import CONFIDENCE, SceneCode, poses
from curio_train.worlds.base import ObjectKind, Split, World

NUM_IMAGES = 2000
"""Renderings that bounds are measured on, and as many backgrounds where each shows all objects: four minutes."""

_SEED = 1  # the confidence is calibrated with 0
_BATCH_SIZE = 10
_OF_IMAGES, _OF_BACKGROUNDS = 1, 2  # keeps their augmentations apart


@dataclass(frozen=True, eq=False)
class Answers:
    """A model's answers about one object."""

    kind: ObjectKind
    """The object."""
    confidences: np.ndarray
    """[n], on frames with the object."""
    errors: np.ndarray
    """[n, 3], see :func:`pose_errors`."""
    without: np.ndarray
    """[m], confidences on frames without it."""


def pose_errors(found: Sequence[Pose], true: Sequence[Pose], kind: ObjectKind) -> np.ndarray:
    """How far answers are off.

    Returns:
        [n, 3]: metres across the line of sight through the answered position, along it as a fraction of the distance,
        and degrees to the nearest of the symmetric rotations.
    """
    answered, truth = (np.stack([pose.translation_m for pose in side]) for side in (found, true))
    distances_m = np.linalg.norm(answered, axis=1).clip(1e-9)
    gaps = truth - answered
    along = (gaps * answered).sum(axis=1) / distances_m
    across = np.linalg.norm(gaps - along[:, None] * answered / distances_m[:, None], axis=1)
    return np.stack([across, np.abs(along) / distances_m, rotation_errors_deg(found, true, kind.info)], axis=1)


@torch.no_grad()
def held_out_answers(
    world: World,
    predict: Predict,
    split: Split,
    num_images: int,
    cache: Path,
) -> list[Answers]:
    """A model's answers on renderings as cameras see them, and without the object, one for each object.

    Args:
        world: Of the model, with one slot an object and images over backgrounds.
        predict: Reads images.
        split: Which renderings; none of those that the confidence was calibrated with.
        num_images: How many, and as many backgrounds where renderings always show the objects.
        cache: Of backgrounds.

    Raises:
        UsageError: The world is flat, has several slots an object, no confidence, or no backgrounds.
        DataError: The backgrounds cannot be read.
    """
    if world.camera.matrix is None or CONFIDENCE not in world.layout or any(len(k.slots) > 1 for k in world.objects):
        raise UsageError(
            f"--intervals: world {world.name} gives no poses in space with one confidence an object; leave it out"
        )
    source = world.source(split, _SEED, with_code=True, cache=cache)
    steps = -(-num_images // _BATCH_SIZE)
    seen: list[list[tuple[float, Pose, Pose]]] = [[] for _ in world.objects]
    without: list[list[float]] = [[] for _ in world.objects]
    for step in counted(range(steps), steps, "measuring on renderings, batches"):
        batch = source.batch(step, _BATCH_SIZE)
        assert batch.code is not None
        if bool((batch.code[CONFIDENCE] > 0).all()):  # else the renderings themselves are frames without
            behind = source.backgrounds(steps + step, _BATCH_SIZE)
            if behind is None:
                raise UsageError(f"--intervals: world {world.name} has no backgrounds; leave it out")
            empty = predict(_photographed(world, behind, (_SEED, _OF_BACKGROUNDS, step)))
            for number, kind in enumerate(world.objects):
                without[number] += empty[CONFIDENCE][:, kind.slots[0]].flatten().tolist()
        found = predict(_photographed(world, batch.images, (_SEED, _OF_IMAGES, step)))
        _sort(world.objects, found, batch.code, seen, without)
    return [_answers(kind, pairs, others) for kind, pairs, others in zip(world.objects, seen, without, strict=True)]


def _sort(
    objects: Sequence[ObjectKind],
    found: SceneCode,
    true: SceneCode,
    seen: list[list[tuple[float, Pose, Pose]]],
    without: list[list[float]],
) -> None:
    """Add the answers of a batch to those of each object, by whether its frame shows the object."""
    for number, kind in enumerate(objects):
        slot = kind.slots[0]
        confidences = found[CONFIDENCE][:, slot].flatten().tolist()
        present = true[CONFIDENCE][:, slot].flatten() > 0
        answers = zip(confidences, poses(found, slot), poses(true, slot), strict=True)
        for is_present, answer in zip(present.tolist(), answers, strict=True):
            if is_present:
                seen[number].append(answer)
            else:
                without[number].append(answer[0])


def _answers(kind: ObjectKind, seen: Sequence[tuple[float, Pose, Pose]], without: Sequence[float]) -> Answers:
    confidences, found, true = zip(*seen, strict=True)
    return Answers(kind, np.array(confidences), pose_errors(found, true, kind), np.array(without))


def _photographed(world: World, images: torch.Tensor, seed: tuple[int, ...]) -> torch.Tensor:
    """Renderings as a camera gives them: changed as those of training are, if they are, and in bytes."""
    return (world.augment(images, seed).clamp(0, 1) * 255).round().byte()


def fit_reliability(answers: Sequence[Answers]) -> Reliability:
    """When answers are sure, and how far off sure ones are.

    Args:
        answers: On renderings that nothing was fitted to.

    Raises:
        ExportError: Too few answers are sure.
    """
    found = Reliability(level=LEVEL, num_images=max(len(one.confidences) for one in answers))
    for one in answers:
        try:
            sure = sure_from(one.without.tolist())
            bounds = error_bounds(one.confidences, one.errors, sure)
        except ValueError as exc:
            raise ExportError(
                f"--intervals: of {len(one.confidences)} answers about {one.kind.name} too few are sure ({exc}): train "
                "it longer, or leave --intervals out"
            ) from exc
        found.objects.append(ObjectReliability(object=one.kind.name, min_confidence=sure, bounds=bounds))
    return found


def coverage(of: ObjectReliability, confidences: np.ndarray, errors: np.ndarray) -> dict[str, float]:
    """How often the intervals of sure answers hold the true pose.

    Args:
        of: What was measured of the object.
        confidences: [n], on frames with the object.
        errors: [n, 3], see :func:`pose_errors`.

    Returns:
        ``num``, the fraction ``sure`` of them, the fractions of these whose true ``position`` and ``rotation`` are
        inside, and the median bounds.
    """
    bounds = [bounds_of(of, confidence) for confidence in confidences.tolist()]
    sure = [(one.lateral_m, one.depth_fraction, one.rotation_deg) for one in bounds if one is not None]
    result = {"num": len(bounds), "sure": len(sure) / max(1, len(bounds))}
    if not sure:
        return result
    limits = np.array(sure)
    holds = errors[[one is not None for one in bounds]] <= limits
    lateral_m, depth_fraction, rotation_deg = np.median(limits, axis=0).tolist()
    return result | {
        "position": float(holds[:, :2].all(axis=1).mean()),
        "rotation": float(holds[:, 2].mean()),
        "lateral_mm_median": 1e3 * lateral_m,
        "depth_percent_median": 100 * depth_fraction,
        "rotation_deg_median": rotation_deg,
    }
