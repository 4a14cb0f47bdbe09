"""Whether 90 % intervals hold: on held-out renderings and on real frames, and how often a model is sure of nothing.

    python benchmarks/intervals.py models/ape models/can … [--json] [--data DIR] [--num-images 1000]

The renderings are of the test split, which neither training nor ``curio-export --intervals`` draws from. The real
frames are the data set's labelled ones, read as serving reads them; labels score and do nothing else.

sure                 fraction of answers that are sure, on frames with the object
position, rotation   fraction of sure answers whose interval holds the true pose; the goal is 0.87 to 0.93 on renderings
false_answers        fraction of backgrounds without the object for which the answer is sure; the goal is at most 0.05
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
    figures: dict[str, dict[str, Figures]] = {}
    for path in arguments.models:
        detector, subject = Detector(open_model(path)), load_subject(path, arguments.data)
        world, cache = subject.world, arguments.cache.expanduser()
        answers = held_out_answers(world, subject.predict, "test", arguments.num_images, cache)
        for of, on_renderings in zip(detector.model.spec.reliability.objects, answers, strict=True):
            figures[of.object] = {
                "renderings": _on_renderings(of, on_renderings),
                "real": on_real_frames(detector, BopDataset(arguments.data), on_renderings.kind, of),
            }
            print(of.object, figures[of.object])
    result = {"num_images": arguments.num_images, "all": _over_all(figures), "objects": figures}
    print(json.dumps(result) if arguments.json else result["all"])


def _on_renderings(of: ObjectReliability, answers: Answers) -> Figures:
    found = coverage(of, answers.confidences, answers.errors)
    false = float((answers.without >= of.min_confidence).mean())
    return _rounded(found | {"backgrounds": len(answers.without), "false_answers": false})


def on_real_frames(detector: Detector, dataset: BopDataset, kind: ObjectKind, of: ObjectReliability) -> Figures:
    """How often the intervals of the served answers hold on the labelled frames of an object."""
    targets = {(target.scene_id, target.image_id): target for target in scored_frames(dataset, kind.name).targets}
    confidences, found, true = list[float](), list[Pose](), list[Pose]()
    for scene_id in sorted({scene for scene, _ in targets}):
        for frame in dataset.frames(SPLIT, scene_id):
            target = targets.get((frame.scene_id, frame.image_id))
            if target is None:
                continue
            (result,) = detector.detect(read_photograph(frame.path), PinholeCamera(frame.matrix))
            one = next(one for one in result.detections if one.object == kind.name)
            assert (one.status == DETECTION_STATUS_SURE) == one.HasField("interval")
            confidences.append(one.confidence)
            found.append(Pose(np.reshape(one.rotation, (3, 3)), np.array(one.translation_m)))
            true.append(target.pose)
    return _rounded(coverage(of, np.array(confidences), pose_errors(found, true, kind)))


def _over_all(figures: dict[str, dict[str, Figures]]) -> dict[str, Figures]:
    """Fractions of the answers of all objects together."""
    return {where: _pooled([one[where] for one in figures.values()]) for where in ("renderings", "real")}


def _pooled(figures: Sequence[Figures]) -> Figures:
    num = sum(one["num"] for one in figures)
    num_sure = [one["sure"] * one["num"] for one in figures]
    result: Figures = {"num": num, "sure": sum(num_sure) / num}
    for name in ("position", "rotation"):
        held = [one[name] * sure for one, sure in zip(figures, num_sure, strict=True) if sure]
        result[name] = sum(held) / sum(num_sure)
    if "false_answers" in figures[0]:
        result["false_answers"] = float(np.mean([one["false_answers"] for one in figures]))
    return _rounded(result)


def _rounded(figures: Figures) -> Figures:
    return {name: round(value, _DIGITS) for name, value in figures.items()}


if __name__ == "__main__":
    main()
