"""What following in a stream is worth, on rendered sequences with truth at 30 frames/s, and what it costs.

    python benchmarks/video.py [--json] [--data DIR] [--sequences 100] [--model models/ape]

jitter_ratio         movement of the filtered position from frame to frame at rest, over that of the raw one
lag_frames           how far the filtered position is behind the truth at 0.5 m/s, over that of the raw one, in frames
refound_of_100       sequences in which an object is seen again within 5 frames after 30 of occlusion, of a hundred
                     in which it was followed when it was hidden; refound_of_all: of all, whether it was or not
swaps                sequences in which two equal objects that do not touch change their numbers
one_object_ms        CPU a frame of one followed object, beyond decoding, looks at whole frames included
eight_objects_ms     the same for each followed one of eight equal objects
full_look_ms         CPU of one look at a whole frame
one_camera_depth_mm, two_cameras_depth_mm
                     median error along the first camera's axis, of it alone and with another 60 degrees apart
"""

import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tyro
from curio_proto.v1.detector_pb2 import Detection, DetectResponse, Tracking
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.models.detector import Detector
from curio_serve.models.model_folder import open_model
from curio_serve.rigs.detect_views import RigView, detect_views
from curio_serve.tracking.stream import FollowingStream
from curio_train.data.bop import BopDataset
from curio_train.meshes.meshes import Mesh
from scipy.spatial.transform import Rotation
from synthetic_video import motions
from synthetic_video.sequences import MATRIX, Sequence6, Studio

ROOT = Path(__file__).parents[1]
_FRAME_S = 1 / motions.FRAMES_PER_SECOND
_SETTLING = 15  # frames that do not count
_OCCLUSION = slice(20, 50)
_REFOUND_FRAMES, _REFOUND_DIAMETERS = 5, 0.5
_WARM, _TIMED = 10, 90
_APART_DEG, _LOOKED_AT_M = 60, np.array([0, 0, 0.8])  # angle between two cameras, and where their axes meet
_EIGHT = 8


@dataclass(frozen=True)
class Arguments:
    """Measure following on rendered sequences."""

    json: bool = False
    """Print one JSON object on the last line instead of a table."""
    data: Path = Path(os.environ.get("CURIO_DATA", "data")) / "lmo"
    """LineMOD's data, for the mesh."""
    sequences: int = 100
    """Of occlusion, of two equal objects, and scenes of two cameras; a fifth of that of the others."""
    model: Path = ROOT / "models" / "ape"
    """Model of the object."""
    seed: int = 0
    """Of the sequences."""


def main() -> None:
    """Measures and prints."""
    arguments = tyro.cli(Arguments)
    cv2.setNumThreads(1)
    detector = Detector(open_model(arguments.model))
    mesh = BopDataset(arguments.data).mesh(detector.model.spec.objects[0].name)
    studio, pair = Studio([mesh]), Studio([mesh, mesh])
    few = max(1, arguments.sequences // 5)

    def each(num: int, kind: int, one: Callable[[np.random.Generator], object]) -> list[object]:
        return [one(np.random.default_rng((arguments.seed, kind, number))) for number in range(num)]

    rest = np.array(each(few, 0, lambda random: jitter_m(detector, studio, random)))
    late = np.array(each(few, 1, lambda random: lag_frames(detector, studio, random)), float)
    refound = each(arguments.sequences, 2, lambda random: is_refound(detector, studio, random))
    swapped = each(arguments.sequences, 3, lambda random: is_swapped(detector, pair, random))
    found = [value for value in refound if value is not None]
    followed = [value for value in swapped if value is not None]
    jitter = np.nanmedian(rest, axis=0)
    depths = each(arguments.sequences, 4, lambda random: depth_errors_m(detector, studio, random))
    one_m, two_m = np.median(np.array(depths, float), axis=0)
    figures = {
        "jitter_ratio": round(float(jitter[1] / jitter[0]), 3),
        "jitter_raw_mm": round(1e3 * float(jitter[0]), 3),
        "jitter_filtered_mm": round(1e3 * float(jitter[1]), 3),
        "lag_frames": round(float(np.nanmedian(late)), 3),
        "refound_of_100": round(100 * float(np.mean(np.array(found, float))), 1),
        "occlusions": len(found),
        "refound_of_all": round(100 * sum(map(bool, found)) / arguments.sequences, 1),
        "swaps": int(np.sum(np.array(followed, float))),
        "pairs": len(followed),
        "sequences": arguments.sequences,
        "one_object_ms": round(one_object_ms(detector, studio), 2),
        "eight_objects_ms": round(eight_objects_ms(detector, mesh), 2),
        "full_look_ms": round(full_look_ms(detector), 1),
        "one_camera_depth_mm": round(1e3 * float(one_m), 2),
        "two_cameras_depth_mm": round(1e3 * float(two_m), 2),
    }
    print(json.dumps(figures) if arguments.json else "\n".join(f"{k:20} {v}" for k, v in figures.items()))


def follow(detector: Detector, video: Sequence6, num_objects: int = 1) -> list[list[Detection]]:
    """The detections of each frame."""
    stream, camera, found = FollowingStream(), PinholeCamera(video.matrix), []
    for number, frame in enumerate(video.frames):
        results = DetectResponse().results
        stream.follow(
            Tracking(time_s=number * _FRAME_S, num_objects=num_objects),
            [detector],
            frame,
            camera,
            min_confidence=0.0,
            reduction=1,
            results=results,
        )
        found.append(list(results[0].detections))
    return found


def jitter_m(detector: Detector, studio: Studio, random: np.random.Generator) -> tuple[float, float]:
    """Root mean square movement from frame to frame at rest, raw and filtered; nan where the object is not followed."""
    still = studio.film([motions.at_rest(1, random)], random)
    noise = random.normal(0, 3, (60, *still.frames.shape[1:])).astype(np.float32)
    frames = (still.frames + noise).clip(0, 255).astype(np.uint8)
    video = Sequence6(frames, still.matrix, np.repeat(still.cam_from_obj, 60, axis=0), np.zeros(60, bool))
    found = [detections[0] for detections in follow(detector, video)[_SETTLING:] if detections]
    if len(found) < 60 - _SETTLING or any(one.track.predicted for one in found):
        return float("nan"), float("nan")
    raw, filtered = [one.translation_m for one in found], [one.track.translation_m for one in found]
    moved = [np.linalg.norm(np.diff(np.array(values), axis=0), axis=1) for values in (raw, filtered)]
    return float(np.sqrt((moved[0] ** 2).mean())), float(np.sqrt((moved[1] ** 2).mean()))


def lag_frames(detector: Detector, studio: Studio, random: np.random.Generator) -> float:
    """Frames by which the filtered position is behind the raw one, while the object moves at 0.5 m/s."""
    path = motions.carried_past(45, random)
    velocity = (path[1] - path[0])[:3, 3]
    behind = []
    for detections in follow(detector, studio.film([path], random))[_SETTLING:]:
        if detections and not detections[0].track.predicted:
            gap = np.subtract(detections[0].translation_m, detections[0].track.translation_m)
            behind.append(float(gap @ velocity / (velocity @ velocity)))
    return float(np.mean(behind)) if len(behind) > _SETTLING else float("nan")


def is_refound(detector: Detector, studio: Studio, random: np.random.Generator) -> bool | None:
    """Whether an object is seen under its number soon after an occlusion; None: it was not followed before."""
    video = studio.film([motions.wandering(_OCCLUSION.stop + _REFOUND_FRAMES, random)], random, _OCCLUSION)
    found = follow(detector, video)
    before = found[_OCCLUSION.start - 1]
    if not before or before[0].track.predicted or not _is_at(before[0], video.cam_from_obj[_OCCLUSION.start - 1, 0]):
        return None
    return any(
        one.track.track_id == before[0].track.track_id and not one.track.predicted and _is_at(one, truth[0])
        for detections, truth in zip(found[_OCCLUSION.stop :], video.cam_from_obj[_OCCLUSION.stop :], strict=True)
        for one in detections
    )


def is_swapped(detector: Detector, studio: Studio, random: np.random.Generator) -> bool | None:
    """Whether the numbers of two equal objects change; None: they were never both followed."""
    video = studio.film(motions.side_by_side(60, random), random)
    owners: dict[int, int] = {}
    swapped = False
    for detections, truths in zip(follow(detector, video, 2), video.cam_from_obj, strict=True):
        for one in detections:
            if one.track.predicted:
                continue
            gaps = [np.linalg.norm(np.subtract(one.translation_m, truth[:3, 3])) for truth in truths]
            if min(gaps) < _REFOUND_DIAMETERS * detector.model.spec.objects[0].diameter_m:
                owner = int(np.argmin(gaps))
                swapped |= owners.setdefault(one.track.track_id, owner) != owner
    return swapped if len(set(owners.values())) == 2 else None


def depth_errors_m(detector: Detector, studio: Studio, random: np.random.Generator) -> tuple[float, float]:
    """Error along the first camera's axis, of it alone and of both; infinite where nothing is found."""
    path = motions.at_rest(1, random)
    turn = Rotation.from_euler("y", _APART_DEG, degrees=True).as_matrix()
    cam_from_rig = np.eye(4)
    cam_from_rig[:3, :3], cam_from_rig[:3, 3] = turn, _LOOKED_AT_M - turn @ _LOOKED_AT_M
    first, second = (studio.film([pose @ path], random) for pose in (np.eye(4), cam_from_rig))
    camera, answer = PinholeCamera(first.matrix), DetectResponse()
    alone = detector.detect(first.frames[0], camera)[0].detections
    views = [RigView(first.frames[0], camera, np.eye(4)), RigView(second.frames[0], camera, cam_from_rig)]
    detect_views(detector, views, results=answer.results)
    truth = path[0, 2, 3]
    return _depth_error_m(alone, truth), _depth_error_m(answer.results[0].detections, truth)


def _depth_error_m(found: Sequence[Detection], truth_m: float) -> float:
    return abs(found[0].translation_m[2] - truth_m) if found else float("inf")


def one_object_ms(detector: Detector, studio: Studio) -> float:
    """CPU milliseconds a frame of one object that is moved about."""
    random = np.random.default_rng(7)
    video = studio.film([motions.wandering(_WARM + _TIMED, random)], random)
    return _followed_ms(detector, video.frames, PinholeCamera(video.matrix), 1)


def eight_objects_ms(detector: Detector, mesh: Mesh) -> float:
    """CPU milliseconds a frame and object of eight equal ones that are moved about beside each other."""
    random = np.random.default_rng(8)
    video = Studio([mesh] * _EIGHT).film(motions.on_a_grid(_WARM + _TIMED, random, _EIGHT), random)
    return _followed_ms(detector, video.frames, PinholeCamera(video.matrix), _EIGHT)


def full_look_ms(detector: Detector) -> float:
    """CPU milliseconds of a whole frame without following."""
    pixels = np.random.default_rng(0).integers(0, 255, (480, 640, 3), np.uint8)
    begun = time.process_time()
    for _ in range(_WARM):
        detector.detect(pixels, PinholeCamera(MATRIX))
    return 1e3 * (time.process_time() - begun) / _WARM


def _followed_ms(detector: Detector, frames: np.ndarray, camera: PinholeCamera, num_objects: int) -> float:
    stream, num_followed, spent_s = FollowingStream(), 0, 0.0
    for number, frame in enumerate(frames):
        results = DetectResponse().results
        begun = time.process_time()
        stream.follow(
            Tracking(time_s=number * _FRAME_S, num_objects=num_objects),
            [detector],
            frame,
            camera,
            min_confidence=0.0,
            reduction=1,
            results=results,
        )
        if number >= _WARM:
            spent_s += time.process_time() - begun
            num_followed += sum(not one.track.predicted for result in results for one in result.detections)
    return 1e3 * spent_s / max(1, num_followed)


def _is_at(one: Detection, cam_from_obj: np.ndarray) -> bool:
    gap = np.subtract(one.translation_m, cam_from_obj[:3, 3])
    return bool(np.linalg.norm(gap) < 0.1)


if __name__ == "__main__":
    main()
