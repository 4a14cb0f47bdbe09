"""Score pose estimates on the real frames of a BOP data set: whole frames in, nothing but RGB and K.

Serving's own code warps the frames to the canonical camera (:mod:`curio_serve.imaging.view`), so that scores are those
of the poses that are served. Labels are used for scoring alone.
"""

import time
from collections.abc import Iterator, Mapping, Sequence, Set
from pathlib import Path
from typing import Any

import numpy as np
import torch
from curio_serve.errors import CameraError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.view import CanonicalCamera, PinholeCrop, PinholeFrame
from curio_serve.planes.camera_poses import GivenPlane, plane_of
from curio_serve.planes.stable_poses import StandingShape

from curio_train.counting import counted
from curio_train.data.bop import Annotation, BopDataset, Frame
from curio_train.data.bop_split import SPLIT, scored_frames
from curio_train.data.photographs import read_photograph
from curio_train.errors import DataError, UsageError
from curio_train.evaluation.on_plane import shapes_of, standing_on
from curio_train.evaluation.real_scores import Estimate, scored, together
from curio_train.evaluation.subject import Subject
from curio_train.geometry import Pose
from curio_train.scene_code import CONFIDENCE, TRANSLATION, poses, presence_of
from curio_train.worlds.base import Camera, World

_BATCH = 16


def evaluate_real_frames(
    subject: Subject, data: Path, bop_results: Path | None, suffix: str = "", plane: GivenPlane = None
) -> dict[str, Any]:
    """Score on the targets of each object of the world in a data set.

    Args:
        subject: Reads poses; of several objects the scores are means, and ``objects`` has those of each.
        data: In BOP's layout.
        bop_results: Folder for a results file in BOP's format, or None.
        suffix: Of the method's name in that file's.
        plane: On which objects stand.

    Raises:
        CameraError: The file of the plane has no pose of a frame's camera.
        UsageError: The world has no camera or no objects that may stand in any way, the data set does not know the
            object, or the results file is there.
        DataError: The data set is incomplete or has no frame of it.
    """
    dataset, kinds = BopDataset(data), subject.world.objects
    wanted = [scored_frames(dataset, kind.name) for kind in kinds]
    found = _read_frames(subject, dataset, {_key(target) for frames in wanted for target in frames.targets})
    if plane is not None:
        found = _on_plane(found, shapes_of(kinds, plane), plane)
    chosen = [[found[_key(target)][slot] for target in frames.targets] for slot, frames in enumerate(wanted)]
    if bop_results is not None:
        by_object = {dataset.object_id(kind.name): one for kind, one in zip(kinds, chosen, strict=True)}
        _write_bop(bop_file(bop_results, subject, data, suffix), by_object)
    each = {
        kind.name: scored(kind, list(zip(one, frames.targets, strict=True)), dataset)
        for kind, one, frames in zip(kinds, chosen, wanted, strict=True)
    }
    about = {"dataset": data.resolve().name, "split": SPLIT, "split_name": wanted[0].split_name}
    if len(each) == 1:
        return about | next(iter(each.values()))
    return about | together(each, _absent(dataset, [kind.name for kind in kinds], found))


def _on_plane(
    found: Mapping[tuple[int, int], list[Estimate]], shapes: Sequence[StandingShape], given: GivenPlane
) -> dict[tuple[int, int], list[Estimate]]:
    """The same estimates, moved onto the plane in each frame."""
    moved = {}
    for key, estimates in found.items():
        plane = plane_of(given, str(estimates[0].frame.path))
        moved[key] = estimates if plane is None else standing_on(estimates, shapes, plane)
    return moved


def bop_file(folder: Path, subject: Subject, data: Path, suffix: str = "") -> Path:
    """METHOD_DATASET-SPLIT.csv in a folder, as BOP's tools want it: the first underscore ends the method's name.

    Raises:
        UsageError: It is there already, perhaps of another model.
    """
    method = (subject.config.method + suffix).replace("_", "-")
    path = folder / f"{method}_{data.resolve().name}-{SPLIT}.csv"
    if path.exists():
        raise UsageError(f"--bop-results: {path} is there already; remove it, or give another folder")
    return path


def refuse_unscorable(world: World, data: Path) -> None:
    """Refuse a data set without targets of a world's objects.

    Raises:
        UsageError: The data set does not know an object.
        DataError: It is incomplete or has no frame of one.
    """
    dataset = BopDataset(data)
    for kind in world.objects:
        scored_frames(dataset, kind.name)


def _absent(dataset: BopDataset, names: Sequence[str], found: Mapping[tuple[int, int], list[Estimate]]) -> list[float]:
    """Presence of objects in frames that do not show them, rounded as those of targets are."""
    shown = [{_key(one) for one in dataset.annotations(SPLIT, name)} for name in names]
    return [
        round(estimate.presence, 4)
        for key, estimates in found.items()
        for estimate, frames in zip(estimates, shown, strict=True)
        if key not in frames
    ]


def _key(found: Annotation | Frame) -> tuple[int, int]:
    return found.scene_id, found.image_id


def estimate_frames(subject: Subject, dataset: BopDataset, targets: Sequence[Annotation]) -> list[Estimate]:
    """Estimates of a world's only object for the frame of each target, in their order.

    Raises:
        DataError: A frame is missing or cannot be read.
    """
    found = _read_frames(subject, dataset, {_key(target) for target in targets})
    return [found[_key(target)][0] for target in targets]


def _read_frames(
    subject: Subject, dataset: BopDataset, wanted: Set[tuple[int, int]]
) -> dict[tuple[int, int], list[Estimate]]:
    """One estimate for each object, by frame."""
    frames = [
        frame
        for scene_id in sorted({scene for scene, _ in wanted})
        for frame in dataset.frames(SPLIT, scene_id)
        if _key(frame) in wanted
    ]
    batches = (frames[start : start + _BATCH] for start in range(0, len(frames), _BATCH))
    told = counted(batches, -(-len(frames) // _BATCH), "reading real frames, batches")
    found = {_key(one[0].frame): one for batch in told for one in _estimates(subject, batch)}
    if missing := wanted - found.keys():
        scene, image = min(missing)
        raise DataError(
            f"{dataset.root / SPLIT}: {len(missing)} labelled images are missing, the first is image {image} of scene "
            f"{scene}; download the split again"
        )
    return found


def _estimates(subject: Subject, frames: Sequence[Frame]) -> Iterator[list[Estimate]]:
    """One estimate for each object of each frame."""
    start = time.perf_counter()
    crops = [_whole_frame(frame, subject.world.camera) for frame in frames]
    images = torch.from_numpy(np.stack([crop.image for crop in crops])).permute(0, 3, 1, 2).contiguous()
    code = subject.predict(images)
    code = {CONFIDENCE: torch.ones_like(code[TRANSLATION][..., :1]), **code}
    seconds = (time.perf_counter() - start) / len(frames)
    by_object = [poses(code, slot) for slot in range(code[TRANSLATION].shape[1])]
    confidence, presence = code[CONFIDENCE][..., 0], presence_of(code)
    for number, (frame, crop) in enumerate(zip(frames, crops, strict=True)):
        cam_from_canonical = Pose(crop.canonical_from_cam.T, np.zeros(3))
        yield [
            Estimate(
                frame,
                cam_from_canonical @ of_object[number],
                float(confidence[number, slot]),
                float(presence[number, slot]),
                seconds,
            )
            for slot, of_object in enumerate(by_object)
        ]


def _whole_frame(frame: Frame, camera: Camera) -> PinholeCrop:
    """A frame as the canonical camera sees it.

    Raises:
        UsageError: The world has no camera.
        DataError: The frame cannot be read, or K cannot be its camera's.
    """
    if camera.matrix is None:
        raise UsageError("--data: this world is flat; expected one with a camera, to warp real frames to")
    canonical = CanonicalCamera(camera.width, camera.height, camera.matrix)
    try:
        return PinholeFrame(read_photograph(frame.path), PinholeCamera(frame.matrix), canonical).crop()
    except CameraError as exc:
        raise DataError(f"{frame.path}: {exc}") from exc


def _write_bop(path: Path, by_object: Mapping[int, Sequence[Estimate]]) -> None:
    """Rotations row by row, millimetres, seconds an image."""
    lines = ["scene_id,im_id,obj_id,score,R,t,time"]
    for object_id, estimates in by_object.items():
        for e in estimates:
            rotation = " ".join(f"{value:.9g}" for value in e.pose.rotation.ravel())
            translation = " ".join(f"{value * 1000:.9g}" for value in e.pose.translation_m)
            frame = f"{e.frame.scene_id},{e.frame.image_id},{object_id}"
            lines.append(f"{frame},{e.confidence:.6g},{rotation},{translation},{e.seconds:.4f}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as exc:
        raise UsageError(f"--bop-results: cannot write {path}: {exc.strerror}") from exc
