"""Score a run or a model on held-out images of its world, beside the same network untrained, and on real frames."""

from collections.abc import Callable, Mapping, Sequence, Sized
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from curio_serve.planes.camera_poses import GivenPlane
from torch import Tensor

from curio_train.errors import DataError, ReportError, UsageError
from curio_train.evaluation.on_plane import shapes_of
from curio_train.evaluation.real_frames import bop_file, evaluate_real_frames, refuse_unscorable
from curio_train.evaluation.repeated import reading_repeatedly
from curio_train.evaluation.reporting.report import keep, write_report
from curio_train.evaluation.scores import add_errors, pose_scores, scene_errors, scene_scores
from curio_train.evaluation.several_objects import several_objects_scores
from curio_train.evaluation.subject import Predict, Subject, load_subject
from curio_train.evaluation.unlabelled.photographed import Judgement, judge
from curio_train.export.card import EVALUATION_FILE
from curio_train.learning.runs.configuration import CONFIG_FILE, world_name
from curio_train.learning.runs.initial import method_before, uses_synthetic_labels
from curio_train.learning.runs.provenance import machine
from curio_train.metrics.calibration import auroc, calibration_error, reliability_bins
from curio_train.metrics.poses import ADD_THRESHOLD
from curio_train.refinement.predictions import with_refinement
from curio_train.scene_code import CONFIDENCE, SceneCode, index, joined, poses, presence_of
from curio_train.worlds.base import Split, World
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object.world import SingleObjectWorld

QUICK, ALL = 100, 500
"""Held-out images that are scored: a minute of rendering whole frames, and the paper's number."""

_BATCH_SIZE = 50
_NUM_EMPTY = 100
_REFINED = "-refined"  # ends the method in the name of a file of refined poses
_SEED = 0  # of the images: the same for every run, so that figures can be compared


@dataclass(frozen=True)
class HeldOut:
    """Images of a split with their true codes."""

    images: Tensor
    """Uint8 [num_images, 3, height, width]."""
    code: SceneCode
    """Scene codes of all images."""
    empty: Tensor | None = None
    """Uint8 [num, 3, height, width], backgrounds without the object, in worlds whose codes have a confidence."""


def evaluate(
    path: Path,
    *,
    split: Split = "test",
    num_images: int | None = None,
    data: Path | None = None,
    bop_results: Path | None = None,
    refine: bool = False,
    reads: int = 1,
    plane: GivenPlane = None,
    cache: Path,
    progress: Callable[[str], None] = lambda text: None,
    warn: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Score a run folder or an exported model.

    Args:
        path: See :func:`~curio_train.evaluation.subject.load_subject`.
        split: Which images of the world.
        num_images: How many; of a finite set at most all. Unless given, :data:`QUICK` of a world that renders whole
            frames, and :data:`ALL` of others.
        data: A BOP data set whose real frames are scored as well, in the LineMOD world.
        bop_results: Folder for a results file of those frames in BOP's format.
        refine: Score the poses once more after :class:`~curio_train.refinement.render_and_compare.RenderAndCompare`.
        reads: How often each image is read, see :mod:`curio_serve.models.repeated`.
        plane: On which the objects of real frames stand, see :mod:`curio_serve.planes.standing`.
        cache: Where worlds keep their image sets.
        progress: Told what is being done.
        warn: Told why photographs could not be judged by, or a report not written: no evaluation is thrown away for
            either.

    Returns:
        What was evaluated, ``metrics`` by name, the same of the network before its first step as ``untrained``,
        ``reliability`` of the confidence where one object has one, and
        ``real`` where real frames were scored, ``photographs`` where there are some to judge by, and
        ``refined`` with ``metrics`` and ``real`` of refined poses. A run folder gets it as well, and a report, unless
        images were read more than once or poses moved onto a plane.

    Raises:
        CurioError: Any of this package's errors.
    """
    if num_images is not None and num_images < 1:
        raise UsageError(f"--num-images is {num_images}, expected at least 1")
    _refuse_without_frames(data, bop_results, plane, refine=refine)
    subject = load_subject(path, data)
    if data is not None:  # before minutes are spent on renderings
        _refuse_unscorable(subject, data, bop_results, ("", _REFINED) if refine else ("",), plane)
    subject = subject if reads == 1 else reading_repeatedly(subject, reads)
    num_images = num_images or (QUICK if _has_whole_frames(subject.world) else ALL)
    better = _refining(subject) if refine else None
    progress(f"{num_images} images of the {split} split")
    held_out = draw(subject.world, split, num_images, cache)
    result = _origin(path, subject) | {"split": split, "num_images": len(held_out.images), "reads": reads}
    result["on_plane"] = plane is not None
    progress("the network")
    scored = _scored(subject.world, subject.predict, held_out)
    result["metrics"] = scored.metrics
    if held_out.empty is not None:
        result["reliability"] = reliability_bins(*_confidences(subject.world, scored.code, held_out.code))
    progress("the same network untrained")
    result["untrained"] = _scored(subject.world, subject.untrained(), held_out).metrics
    if data is not None:
        progress(f"real frames in {data}")
        result["real"] = evaluate_real_frames(subject, data, bop_results, plane=plane)
    if better is not None:
        progress("refined poses")
        result["refined"] = {"metrics": _scored(better.world, better.predict, held_out).metrics}
        if data is not None:
            result["refined"]["real"] = evaluate_real_frames(better, data, bop_results, _REFINED)
    if (judgement := _judged(subject, warn)) is not None:
        result["photographs"] = judgement.summary
    is_plain = reads == 1 and plane is None  # cards and reports are of the model as it answers by itself
    if is_plain and (path / CONFIG_FILE).exists():
        _keep_held_out(path, result)
        progress("the report")
        try:
            write_report(path, subject, split, cache, scored.errors, result, judgement)
        except ReportError as exc:
            warn(str(exc))
    return result


def _refuse_without_frames(data: Path | None, bop_results: Path | None, plane: GivenPlane, *, refine: bool) -> None:
    if bop_results is not None and data is None:
        raise UsageError("--bop-results needs the real frames: give --data DIR")
    if plane is not None and (data is None or refine):
        raise UsageError("--plane is for real frames (--data DIR), and not for --refine, which corrects distances, too")


def _has_whole_frames(world: World) -> bool:
    return isinstance(world, SingleObjectWorld | SeveralObjectsWorld)


def _refuse_unscorable(
    subject: Subject, data: Path, bop_results: Path | None, suffixes: Sequence[str], plane: GivenPlane
) -> None:
    if not _has_whole_frames(subject.world):
        raise UsageError(f"--data {data}: world {subject.world.name} has no real frames; leave it out")
    refuse_unscorable(subject.world, data)
    if plane is not None:
        shapes_of(subject.world.objects, plane)
    if bop_results is not None:
        for suffix in suffixes:
            bop_file(bop_results, subject, data, suffix)


def _keep_held_out(run: Path, result: Mapping[str, Any]) -> None:
    """Keep what cards quote: images that were learned from say nothing about a model."""
    if result["split"] != "train":
        keep(run / EVALUATION_FILE, result)


def _judged(subject: Subject, warn: Callable[[str], None]) -> Judgement | None:
    """What photographs say of the network; None: there are none, or they have moved since, and the scores need none."""
    try:
        return judge(subject.world, subject.predict)
    except DataError as exc:
        warn(f"not judged by photographs: {exc}")
        return None


def _refining(subject: Subject) -> Subject:
    """A network whose poses are refined."""
    return replace(subject, predict=with_refinement(subject.predict, subject.world, subject.config.method))


@torch.no_grad()
def draw(world: World, split: Split, num_images: int, cache: Path) -> HeldOut:
    """The first images of a split, as a camera would give them: in bytes."""
    source = world.source(split, _SEED, with_code=True, cache=cache)
    if isinstance(source, Sized):
        num_images = min(num_images, len(source))
    batches = [source.batch(step, _BATCH_SIZE) for step in range(-(-num_images // _BATCH_SIZE))]
    images = torch.cat([(batch.images.clamp(0, 1) * 255).round().byte() for batch in batches])
    code = index(joined([batch.code for batch in batches if batch.code is not None]), slice(num_images))
    if not isinstance(world, SingleObjectWorld) or CONFIDENCE not in world.layout:
        return HeldOut(images[:num_images], code)
    behind = source.backgrounds(len(batches), _NUM_EMPTY)  # of steps that have not been drawn
    return HeldOut(images[:num_images], code, None if behind is None else (behind.clamp(0, 1) * 255).round().byte())


def score(
    world: World, predicted: SceneCode, true: SceneCode, errors: dict[str, Tensor] | None = None
) -> dict[str, float]:
    """All metrics that mean something in this world; ``errors``: see :func:`scene_scores`."""
    scores = scene_scores(world, predicted, true, errors)
    if isinstance(world, SingleObjectWorld):
        info = world.objects[0].info
        scores |= pose_scores(poses(predicted), poses(true), world.object.mesh.vertices_m, info)
    if isinstance(world, SeveralObjectsWorld):
        scores |= several_objects_scores(world, predicted, true)
    return scores


def calibration(world: World, predicted: SceneCode, true: SceneCode, on_empty: SceneCode) -> dict[str, float]:
    """Scores the confidence of one object as the probability that ADD(-S) is below a tenth of the diameter.

    And its presence, or its confidence where there is none, as a sign that the object is there.
    """
    confidences, correct = _confidences(world, predicted, true)
    return {
        "confidence_ece": calibration_error(confidences, correct),
        "present_auroc": auroc(presence_of(predicted).flatten().tolist(), presence_of(on_empty).flatten().tolist()),
    }


def _confidences(world: World, predicted: SceneCode, true: SceneCode) -> tuple[list[float], list[bool]]:
    """Confidence of each pose, and whether its ADD(-S) is below a tenth of the diameter."""
    assert isinstance(world, SingleObjectWorld)
    errors = add_errors(poses(predicted), poses(true), world.object.mesh.vertices_m, world.objects[0].info)
    return predicted[CONFIDENCE].flatten().tolist(), [error < ADD_THRESHOLD for error in errors]


class _Scored(NamedTuple):
    """A network's scene codes for held-out images, and their errors."""

    code: SceneCode
    errors: dict[str, Tensor]
    """Each single one, see :func:`scene_errors`."""
    metrics: dict[str, float]


def _scored(world: World, predict: Predict, held_out: HeldOut) -> _Scored:
    predicted = predict(held_out.images)
    errors = scene_errors(world, predicted, held_out.code)
    scores = score(world, predicted, held_out.code, errors)
    if held_out.empty is not None:
        scores |= calibration(world, predicted, held_out.code, predict(held_out.empty))
    return _Scored(predicted, errors, scores)


def _origin(path: Path, subject: Subject) -> dict[str, Any]:
    config = subject.config
    return {
        "source": str(path),
        "world": world_name(config),
        "objects": [kind.name for kind in subject.world.objects],
        "method": config.method,
        "method_before": method_before(config),
        "reading": config.network.reading or "whole",
        "labels": config.labels if config.terms.label else 0.0,
        "labels_real": False,  # images with true codes are renderings in every world
        "labels_synthetic": uses_synthetic_labels(config),
        "preset": config.preset,
        "seed": config.seed,
        "images_seen": subject.images_seen,
        "training_seconds": round(subject.training_seconds, 1),
        "commit": subject.commit,
        "machine": machine(),
    }
