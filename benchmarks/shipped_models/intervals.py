"""Whether 90 % intervals hold: on held-out renderings and on real frames, and how often a model is sure of nothing.

    python benchmarks/shipped_models/intervals.py models/ape … [--json] [--data DIR] [--num-images 1000]
        [--views views.json]

The renderings are of the test split, which neither training nor ``curio-export --intervals`` draws from. The real
frames are the data set's labelled ones; labels score and do nothing else. With ``--views``, the file of their camera
poses, the first half of the real frames adjusts confidence and bounds without its labels, and the second half scores.

sure                 fraction of answers that are sure, on frames with the object
position, rotation   fraction of sure answers whose interval holds the true pose; the goal is 0.87 to 0.93 on renderings
false_answers        fraction of frames without the object for which the answer is sure; on renderings at most 0.05
ece                  calibration error of the confidence as the probability of ADD(-S) below a tenth of the diameter
"""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro
from curio_proto.v1.model_spec_pb2 import Reliability
from curio_serve.models.model_folder import open_model
from curio_serve.models.reliability import calibrated
from curio_train.data.bop import BopDataset, Frame
from curio_train.data.bop_split import SPLIT, scored_frames
from curio_train.data.photographs import UnlabelledPhotographs, read_frames
from curio_train.evaluation.reliability import Answers, coverage, held_out_answers, pose_errors
from curio_train.evaluation.subject import Predict, load_subject
from curio_train.evaluation.unlabelled.self_consistency import adjusted, photographed_pairs
from curio_train.geometry import Pose
from curio_train.metrics.calibration import calibration_error
from curio_train.metrics.poses import ADD_THRESHOLD, add_or_add_s_m
from curio_train.scene_code import CONFIDENCE, SceneCode, poses
from curio_train.worlds.base import ObjectKind, World
from curio_train.worlds.linemod import read_camera_poses
from tyro.conf import Positional, arg

Figures = dict[str, float]
_DIGITS = 4
_NUM_POINTS = 500  # about so many vertices for ADD


@dataclass(frozen=True)
class Arguments:
    """Measure how often intervals hold the true pose."""

    models: Annotated[Positional[tuple[Path, ...]], arg(metavar="MODEL")]
    """Model folders with a reliability.json."""
    json: bool = False
    """Print one JSON object on the last line instead of a table."""
    data: Path = Path(os.environ.get("CURIO_DATA", "data")) / "lmo"
    """BOP data set with the meshes and the real frames."""
    num_images: int = 1000
    """Renderings of each model, and as many backgrounds."""
    views: Path | None = None
    """Camera poses of the real frames, as curio-train capture --calibrate --views-out writes them."""
    cache: Path = Path("~/.cache/curio")
    """Where backgrounds are kept."""


@dataclass(frozen=True, eq=False)
class RealAnswers:
    """Answers about one object in real frames, and whether each is right."""

    answers: Answers
    """With errors by the labels."""
    correct: np.ndarray
    """Whether ADD(-S) is below a tenth of the diameter, [n]."""


def main() -> None:
    """Measures and prints."""
    arguments = tyro.cli(Arguments)
    dataset, models = BopDataset(arguments.data), dict[str, dict[str, dict[str, Figures]]]()
    for path in arguments.models:
        models[path.name] = measured(arguments, dataset, path)
        for name, found in models[path.name].items():
            print(path.name, name, found, flush=True)
    result = {"num_images": arguments.num_images, "models": models}
    for name, several in (("single", False), ("several", True)):
        figures = [one for found in models.values() if (len(found) > 1) == several for one in found.values()]
        result |= {name: _over_all(figures)} if figures else {}
    print(json.dumps(result) if arguments.json else "")


def measured(arguments: Arguments, dataset: BopDataset, path: Path) -> dict[str, dict[str, Figures]]:
    """Figures of each object of a model."""
    stored, subject = open_model(path).spec.reliability, load_subject(path, arguments.data)
    world, predict = subject.world, subject.predict
    answers = held_out_answers(world, predict, "test", arguments.num_images, arguments.cache.expanduser())
    frames = list(dataset.frames(SPLIT))
    codes = [predict(torch.from_numpy(read_frames([f.path], dataset.camera, f.width, f.height))) for f in frames]
    half = len(frames) // 2
    if arguments.views is None:
        after = stored
    elif stored.num_photographs:
        raise SystemExit(f"{path} was adjusted to photographs: write it again without --photos and --views")
    else:
        after = _adjusted_to(frames[:half], arguments.views, world, predict, stored, answers)
    found = {}
    for number, one in enumerate(answers):
        kind = one.kind
        found[kind.name] = {"renderings": _figures(stored, one, number)}
        real = real_answers(dataset, kind, frames, codes)
        found[kind.name]["real"] = _of_real(stored, real, number)
        if arguments.views is not None:
            second = real_answers(dataset, kind, frames[half:], codes[half:])
            found[kind.name]["second_half"] = _of_real(stored, second, number)
            found[kind.name]["second_half_adjusted"] = _of_real(after, second, number)
    return found


def real_answers(
    dataset: BopDataset, kind: ObjectKind, frames: Sequence[Frame], codes: Sequence[SceneCode]
) -> RealAnswers:
    """What a network said of frames that show an object, and of those that do not."""
    targets = {(target.scene_id, target.image_id): target for target in scored_frames(dataset, kind.name).targets}
    shown = {(one.scene_id, one.image_id) for one in dataset.annotations(SPLIT, kind.name)}
    points = dataset.mesh(kind.name).thinned_m(_NUM_POINTS)
    confidences, found, true, without = list[float](), list[Pose](), list[Pose](), list[float]()
    for frame, code in zip(frames, codes, strict=True):
        key = frame.scene_id, frame.image_id
        confidence = float(code[CONFIDENCE][0, kind.slots[0], 0])
        if key in targets:
            confidences.append(confidence)
            found += poses(code, kind.slots[0])
            true.append(targets[key].pose)
        elif key not in shown:
            without.append(confidence)
    errors_m = [add_or_add_s_m(one, other, points, kind.info) for one, other in zip(found, true, strict=True)]
    answers = Answers(kind, np.array(confidences), pose_errors(found, true, kind), np.array(without))
    return RealAnswers(answers, np.array(errors_m) < ADD_THRESHOLD * kind.diameter_m)


def _adjusted_to(
    frames: Sequence[Frame], views: Path, world: World, predict: Predict, of: Reliability, answers: Sequence[Answers]
) -> Reliability:
    paths = [frame.path for frame in frames]
    photographs = UnlabelledPhotographs(paths, read_camera_poses(views, paths, any_unit=True))
    return adjusted(of, answers, photographed_pairs(world, predict, photographs), len(paths))


def _answered(found: Reliability, answers: Answers) -> Answers:
    """The same with the confidences that are answered."""
    sides = (answers.confidences, answers.without)
    answered, without = (np.array([calibrated(found.calibration, one) for one in side.tolist()]) for side in sides)
    return replace(answers, confidences=answered, without=without)


def _figures(found: Reliability, answers: Answers, number: int) -> Figures:
    """With how often answers are sure on frames without the object; of no such frames, never."""
    of, answered = found.objects[number], _answered(found, answers)
    num_sure = int((answered.without >= of.min_confidence).sum())
    false = {"num_without": len(answered.without), "false_answers": num_sure / max(1, len(answered.without))}
    return _rounded(coverage(of, answered.confidences, answered.errors) | false)


def _of_real(found: Reliability, real: RealAnswers, number: int) -> Figures:
    confidences = _answered(found, real.answers).confidences.tolist()
    calibration = {
        "confidence": float(np.mean(confidences)),
        "correct": float(real.correct.mean()),
        "ece": calibration_error(confidences, real.correct.tolist()),
    }
    return _figures(found, real.answers, number) | _rounded(calibration)


def _over_all(figures: Sequence[dict[str, Figures]]) -> dict[str, Figures]:
    """Fractions of the answers about all objects together."""
    return {where: _pooled([one[where] for one in figures]) for where in figures[0]}


def _pooled(figures: Sequence[Figures]) -> Figures:
    num = sum(one["num"] for one in figures)
    num_sure = [one["sure"] * one["num"] for one in figures]
    result: Figures = {"num": num, "sure": sum(num_sure) / num}
    for name in ("position", "rotation"):
        held = [one[name] * sure for one, sure in zip(figures, num_sure, strict=True) if sure]
        result[name] = sum(held) / sum(num_sure)
    without = sum(one["num_without"] for one in figures)
    false = sum(one["num_without"] * one["false_answers"] for one in figures)
    return _rounded(result | {"num_without": without, "false_answers": false / max(1, without)})


def _rounded(figures: Figures) -> Figures:
    return {name: round(value, _DIGITS) for name, value in figures.items()}


if __name__ == "__main__":
    main()
