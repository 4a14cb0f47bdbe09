"""What ``curio-detect --refine`` gains, and what it costs, on rendered frames of LineMOD's objects.

    python benchmarks/shipped_models/refinement.py models/ape --data DIR [--json]

add_recall          fraction of frames whose ADD(-S) is below a tenth of the diameter, as detected and refined
add_diameters       median ADD(-S) in diameters
milliseconds        median time a frame: detection, and render-and-compare on top of it
"""

import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from curio_proto.v1.detector_pb2 import Detection
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.models.detector import Detector
from curio_serve.models.model_folder import open_model
from curio_train.commands.command_line.running import CACHE
from curio_train.evaluation.evaluate import draw
from curio_train.evaluation.scores import add_errors
from curio_train.evaluation.subject import load_subject
from curio_train.geometry import Pose
from curio_train.learning.runs.provenance import machine
from curio_train.metrics.poses import ADD_THRESHOLD
from curio_train.refinement.detections import DetectionRefiner, NamedMesh
from curio_train.scene_code import poses


@dataclass(frozen=True)
class Settings:
    """Measure render-and-compare on the detections of a model."""

    model: tyro.conf.Positional[Path]
    """Of one object of LineMOD."""
    data: Path
    """BOP data set with its mesh."""
    num_frames: int = 100
    """Held-out renderings."""
    json: bool = False
    """Print one JSON object on the last line."""
    cache: Path = CACHE
    """Where clutter is kept."""


def main() -> None:
    """Detect, refine, score."""
    settings = tyro.cli(Settings)
    world = load_subject(settings.model, settings.data).world
    detector, kind = Detector(open_model(settings.model)), world.objects[0]
    refine = DetectionRefiner(detector.model.spec, {kind.name: NamedMesh(str(settings.data), world.object.mesh)})
    frames = draw(world, "test", settings.num_frames, settings.cache)
    camera, truths = PinholeCamera(world.camera.matrix), poses(frames.code)
    found, spent = {"detected": [], "refined": []}, {"detected": [], "refined": []}
    for image in frames.images.permute(0, 2, 3, 1).contiguous().numpy():
        started = time.perf_counter()
        (result,) = detector.detect(image, camera, max_detections=1)
        found["detected"].append(pose(result.detections[0]))
        spent["detected"].append(time.perf_counter() - started)
        started = time.perf_counter()
        refine(image, camera, result.detections, result.light)
        found["refined"].append(pose(result.detections[0]))
        spent["refined"].append(time.perf_counter() - started)
    scores = {
        name: add_errors(estimates, truths, world.object.mesh.vertices_m, kind.info)
        for name, estimates in found.items()
    }
    figures = {
        "model": settings.model.name,
        "num_frames": len(truths),
        "num_refined": refine.num_refined,
        "add_recall": {
            name: round(float(np.mean(np.array(errors) < ADD_THRESHOLD)), 4) for name, errors in scores.items()
        },
        "add_diameters": {name: round(float(np.median(errors)), 4) for name, errors in scores.items()},
        "milliseconds": {name: round(1000 * float(np.median(seconds)), 1) for name, seconds in spent.items()},
        "machine": machine(),
    }
    print(json.dumps(figures, indent=None if settings.json else 1))


def pose(detection: Detection) -> Pose:
    """cam_from_obj of a detection."""
    return Pose(np.reshape(detection.rotation, (3, 3)), np.array(detection.translation_m))


if __name__ == "__main__":
    main()
