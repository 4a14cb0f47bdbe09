"""Whether 90 % intervals hold: on held-out renderings and on real frames, and how often a model is sure of nothing.

    python benchmarks/shipped_models/intervals.py models/ape models/can … [--json] [--data DIR] [--num-images 1000]

The renderings are of the test split, which neither training nor ``curio-export --intervals`` draws from. The real
frames are the data set's labelled ones, read as serving reads them; labels score and do nothing else.

sure                 fraction of answers that are sure, on frames with the object
position, rotation   fraction of sure answers whose interval holds the true pose; the goal is 0.87 to 0.93 on renderings
false_answers        fraction of frames without the object for which the answer is sure; on renderings at most 0.05
"""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from curio_proto.v1.detector_pb2 import DETECTION_STATUS_SURE
from curio_proto.v1.model_spec_pb2 import ObjectReliability
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.models.detector import Detector
from curio_serve.models.model_folder import open_model
from curio_train.data.bop import BopDataset
from curio_train.data.bop_split import SPLIT, scored_frames
from curio_train.data.photographs import read_photograph
from curio_train.evaluation.reliability import Answers, coverage, held_out_answers, pose_errors
from curio_train.evaluation.subject import load_subject
from curio_train.geometry import Pose
from curio_train.worlds.base import ObjectKind
from tyro.conf import Positional, arg

Figures = dict[str, float]
_DIGITS = 4


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
    cache: Path = Path("~/.cache/curio")
    """Where backgrounds are kept."""


def main() -> None:
    """Measures and prints."""
    arguments = tyro.cli(Arguments)
    dataset, models = BopDataset(arguments.data), dict[str, dict[str, dict[str, Figures]]]()
    for path in arguments.models:
        detector, subject = Detector(open_model(path)), load_subject(path, arguments.data)
        world, cache = subject.world, arguments.cache.expanduser()
        answers = held_out_answers(world, subject.predict, "test", arguments.num_images, cache)
        models[path.name] = {}
        for of, on_renderings in zip(detector.model.spec.reliability.objects, answers, strict=True):
            models[path.name][of.object] = found = {
                "renderings": _on_renderings(of, on_renderings),
                "real": on_real_frames(detector, dataset, on_renderings.kind, of),
            }
            print(path.name, of.object, found, flush=True)
    result = {"num_images": arguments.num_images, "models": models}
    for name, several in (("single", False), ("several", True)):
        figures = [one for found in models.values() if (len(found) > 1) == several for one in found.values()]
        result |= {name: _over_all(figures)} if figures else {}
    print(json.dumps(result) if arguments.json else "")


def _on_renderings(of: ObjectReliability, answers: Answers) -> Figures:
    return _with_false(of, coverage(of, answers.confidences, answers.errors), answers.without)


def _with_false(of: ObjectReliability, found: Figures, without: np.ndarray) -> Figures:
    """Adds how often answers are sure on frames without the object; of no such frames, never."""
    num_sure = int((without >= of.min_confidence).sum())
    return _rounded(found | {"num_without": len(without), "false_answers": num_sure / max(1, len(without))})


def on_real_frames(detector: Detector, dataset: BopDataset, kind: ObjectKind, of: ObjectReliability) -> Figures:
    """How often the intervals of served answers hold on the frames of an object, and are sure on those without it."""
    targets = {(target.scene_id, target.image_id): target for target in scored_frames(dataset, kind.name).targets}
    shown = {(one.scene_id, one.image_id) for one in dataset.annotations(SPLIT, kind.name)}
    confidences, found, true, without = list[float](), list[Pose](), list[Pose](), list[float]()
    for scene_id in sorted({scene for scene, _ in targets}):
        for frame in dataset.frames(SPLIT, scene_id):
            target = targets.get((frame.scene_id, frame.image_id))
            if target is None and (frame.scene_id, frame.image_id) in shown:
                continue
            (result,) = detector.detect(read_photograph(frame.path), PinholeCamera(frame.matrix))
            one = next(one for one in result.detections if one.object == kind.name)
            assert (one.status == DETECTION_STATUS_SURE) == one.HasField("interval")
            if target is None:
                without.append(one.confidence)
                continue
            confidences.append(one.confidence)
            found.append(Pose(np.reshape(one.rotation, (3, 3)), np.array(one.translation_m)))
            true.append(target.pose)
    return _with_false(of, coverage(of, np.array(confidences), pose_errors(found, true, kind)), np.array(without))


def _over_all(figures: Sequence[dict[str, Figures]]) -> dict[str, Figures]:
    """Fractions of the answers about all objects together."""
    return {where: _pooled([one[where] for one in figures]) for where in ("renderings", "real")}


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
