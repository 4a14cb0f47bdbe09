"""How many of several equal objects ``--max-instances`` finds, on rendered frames of LineMOD's objects.

    python benchmarks/shipped_models/instances.py models/ape --data DIR [--json]

An answer is found where its position is within half a diameter of an object's across the view, and right where its
ADD(-S) to that object is below a tenth of the diameter. Answers take their objects in the order of their confidence,
each object once.

recall         fraction of the objects that are found, or right
precision      fraction of the answers, of at least --min-confidence, that are found, or right
milliseconds   median time a frame
"""

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from curio_proto.v1.detector_pb2 import Detection
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.models.detector import Detector
from curio_serve.models.model_folder import open_model
from curio_train.commands.command_line.running import CACHE
from curio_train.evaluation.scores import add_errors
from curio_train.evaluation.subject import load_subject
from curio_train.geometry import Pose, matrix_from_rotation_6d
from curio_train.learning.runs.provenance import machine
from curio_train.metrics.poses import ADD_THRESHOLD
from curio_train.rendering.renderer import Renderer
from curio_train.scene_code import LIGHT, ROTATION_6D, TRANSLATION, index, poses
from curio_train.worlds.single_object.viewpoints import AMBIENT
from curio_train.worlds.single_object.world import SingleObjectWorld

SEED, APART = 28, 1.4  # diameters between two objects across the view
COUNTS = (1, 2, 3, 4)


@dataclass(frozen=True)
class Settings:
    """Count the instances that a model finds."""

    model: tyro.conf.Positional[Path]
    """Of one object of LineMOD."""
    data: Path
    """BOP data set with its mesh."""
    num_frames: int = 25
    """For each number of objects."""
    min_confidence: float = 0.2
    """Answers below it do not count."""
    json: bool = False
    """Print one JSON object on the last line."""
    cache: Path = CACHE
    """Where clutter is kept."""


def main() -> None:
    """Render, detect, count."""
    settings = tyro.cli(Settings)
    world = load_subject(settings.model, settings.data).world
    detector, camera = Detector(open_model(settings.model)), PinholeCamera(world.camera.matrix)
    scores = {}
    for count in COUNTS:
        rows = []
        for number in range(settings.num_frames):
            pixels, truths = frame(world, count, number, settings.cache)
            started = time.perf_counter()
            (result,) = detector.detect(
                pixels, camera, max_instances=max(COUNTS), min_confidence=settings.min_confidence
            )
            spent = time.perf_counter() - started
            rows.append((*matched(world, result.detections, truths), len(result.detections), spent))
        scores[str(count)] = summary(rows, count)
    figures = {
        "model": settings.model.name,
        "frames_each": settings.num_frames,
        "max_instances": max(COUNTS),
        "min_confidence": settings.min_confidence,
        "by_number_of_objects": scores,
        "machine": machine(),
    }
    print(json.dumps(figures, indent=None if settings.json else 1))


def frame(world: SingleObjectWorld, count: int, number: int, cache: Path) -> tuple[np.ndarray, list[Pose]]:
    """Objects over clutter, uint8 RGB [height, width, 3], and their poses; none hides another."""
    drawn = world.sample(64, (SEED, count, number))
    far, kept = drawn[TRANSLATION][:, 0].numpy(), list[int]()
    for row, position in enumerate(far):
        across = [np.linalg.norm((position / position[2] - far[other] / far[other][2])[:2]) for other in kept]
        nearest = min(position[2], *[far[other][2] for other in kept]) if kept else 1.0
        if len(kept) < count and all(gap * nearest > APART * world.object.kind.diameter_m for gap in across):
            kept.append(row)
    code = index(drawn, kept)
    camera = world.camera
    renderer = Renderer([world.object.mesh], [0] * count, camera.width, camera.height, ambient=AMBIENT)
    behind = world.backgrounds(cache).draw(1, camera.width, camera.height, (SEED, count, number))
    with torch.no_grad():
        image = renderer(
            matrix_from_rotation_6d(code[ROTATION_6D][:, 0])[None],
            code[TRANSLATION][:, 0][None],
            camera_matrix=camera.matrix,
            backgrounds=behind,
            light=code[LIGHT][:1],
        )[0]
    return (image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).contiguous().numpy(), poses(code)


def matched(world: SingleObjectWorld, detections: list[Detection], truths: list[Pose]) -> tuple[int, int]:
    """How many answers are found, and how many of those are right."""
    kind, left, found, right = world.objects[0], list(truths), 0, 0
    for detection in detections:
        pose = Pose(np.reshape(detection.rotation, (3, 3)), np.array(detection.translation_m))
        seen = pose.translation_m / pose.translation_m[2]
        gaps_m = [
            float(np.linalg.norm(seen - truth.translation_m / truth.translation_m[2])) * truth.translation_m[2]
            for truth in left
        ]
        if not gaps_m or min(gaps_m) > kind.diameter_m / 2:
            continue
        truth = left.pop(int(np.argmin(gaps_m)))
        (error,) = add_errors([pose], [truth], world.object.mesh.vertices_m, kind.info)
        found, right = found + 1, right + int(error < ADD_THRESHOLD)
    return found, right


def summary(rows: list[tuple[int, int, int, float]], count: int) -> dict[str, Any]:
    """Recall, precision and time over frames of that many objects."""
    found, right, answers = (sum(row[column] for row in rows) for column in range(3))
    return {
        "recall": {"found": round(found / (count * len(rows)), 3), "right": round(right / (count * len(rows)), 3)},
        "precision": {"found": round(found / max(answers, 1), 3), "right": round(right / max(answers, 1), 3)},
        "milliseconds": round(1000 * float(np.median([row[3] for row in rows])), 1),
    }


if __name__ == "__main__":
    main()
