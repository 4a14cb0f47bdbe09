"""Adjusts confidence and intervals to unlabelled photographs of a still scene, by answers that contradict each other.

Renderings are not photographs: there a model is surer than it should be, and errs more. How much more is seen without
labels where the camera's motion is known. Two photographs show one object in one place, so two right answers give one
pose, and the gap between two answers is the difference of their errors. What photographs get wrong alike (a depth that
is always too small) no gap shows. No label is opened.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from curio_proto.v1.model_spec_pb2 import ObjectReliability, PoseBounds, Reliability
from curio_serve.models.reliability import bounds_of, calibrated
from jaxtyping import Bool, Float

from curio_train.data.photographs import (
    MAX_UNLABELLED,
    CameraPoses,
    Photographs,
    UnlabelledPhotographs,
    read_frames,
    spread,
)
from curio_train.errors import DataError, UsageError
from curio_train.evaluation.reliability import Answers, pose_errors
from curio_train.evaluation.subject import Predict
from curio_train.geometry import Pose
from curio_train.metrics.calibration import fit_pair_calibration
from curio_train.metrics.conformal import LEVEL, conformal_quantile
from curio_train.metrics.poses import are_right
from curio_train.refinement.multi_view import estimate_scale
from curio_train.scene_code import CONFIDENCE, ROTATION_6D, TRANSLATION, SceneCode, poses
from curio_train.worlds.base import World
from curio_train.worlds.linemod import read_camera_poses
from curio_train.worlds.several_objects.scenes import ObjectScenes
from curio_train.worlds.single_object.world import Object, SingleObjectWorld

_NEIGHBOURS = 4  # photographs before each that it is compared with: objects may be moved in longer times
_FEWEST_PAIRS = 30
_FEWEST_VIEWS = 2  # photographs with camera poses
_NUM_POINTS = 300  # about so many vertices for ADD
_LEAST = 1e-6  # nearer to 0 and 1 confidences say nothing
_MOST_DEG = 180.0


@dataclass(frozen=True, eq=False)
class Pairs:
    """Answers about one object in pairs of photographs."""

    object: str
    """Its name."""
    confidences: Float[np.ndarray, "n 2"]
    """As the network gives them."""
    gaps: Float[np.ndarray, "n 3"]
    """How far the second answer is off the first, see :func:`~curio_train.evaluation.reliability.pose_errors`."""
    agree: Bool[np.ndarray, " n"]
    """Whether ADD(-S) between the two is below a tenth of the diameter."""


def read_views(folder: Path, file: Path) -> UnlabelledPhotographs:
    """Photographs and where their cameras stood.

    Args:
        folder: Of the photographs.
        file: As ``curio-train capture --calibrate --views-out`` writes it.

    Raises:
        DataError: The folder has no photographs, or the file has poses of fewer than two.
        CameraError: The file has no pose of them, or cannot be read.
    """
    paths = spread(Photographs(folder).paths, MAX_UNLABELLED)
    cameras = read_camera_poses(file, paths, any_unit=True)
    if (num_known := int(cameras.known.sum())) < _FEWEST_VIEWS:
        raise DataError(
            f"--views {file}: has the poses of {num_known} of {len(paths)} photographs in {folder}, expected "
            f"{_FEWEST_VIEWS} or more"
        )
    return UnlabelledPhotographs(paths, cameras)


def photographed_pairs(world: World, predict: Predict, photographs: UnlabelledPhotographs) -> list[Pairs]:
    """A model's answers in pairs of photographs that are near each other in order, one result for each object.

    Args:
        world: Of the model.
        predict: Reads images.
        photographs: Of a still scene, in the order in which they were taken, with camera poses.

    Raises:
        UsageError: The world has no meshes of its objects.
        DataError: A photograph cannot be read, or the scale of the scene is unknown and cannot be told.
    """
    objects, cameras = _objects(world), photographs.cameras
    assert cameras is not None
    frames = read_frames(photographs.paths, objects[0].camera, world.camera.width, world.camera.height)
    code = predict(torch.from_numpy(frames))
    cam_from_world = Pose.from_matrix(cameras.cam_from_world)
    scene = Pose(cam_from_world.rotation, _scale(objects, cameras, code) * cam_from_world.translation_m)
    return [_pairs(one, slot, code, scene, cameras.known) for slot, one in enumerate(objects)]


def _objects(world: World) -> Sequence[Object]:
    if isinstance(world, ObjectScenes):
        return world.members
    if isinstance(world, SingleObjectWorld):
        return (world.object,)
    raise UsageError(f"--views: world {world.name} is none of single parts; leave it out")


def _scale(objects: Sequence[Object], cameras: CameraPoses, code: SceneCode) -> float:
    """Metres a unit of the scene: each object's answers tell one, and err each in its own way (decision 68)."""
    if cameras.in_metres:
        return 1.0
    every, scales = torch.ones(len(code[TRANSLATION]), dtype=torch.bool), list[float]()
    for slot, one in enumerate(objects):
        own = {name: code[name][:, slot : slot + 1] for name in (TRANSLATION, ROTATION_6D)}
        scale = estimate_scale(cameras, own, every, one.kind.diameter_m)
        scales += [] if scale is None else [scale]
    if not scales:
        raise DataError(
            "--views: poses are in no known unit, and the model's answers agree too seldom to tell how large the scene "
            "is; write them with --distance-m or --objects"
        )
    return float(np.exp(np.mean(np.log(scales))))


def _pairs(object_: Object, slot: int, code: SceneCode, cam_from_world: Pose, known: np.ndarray) -> Pairs:
    kind, points = object_.kind, object_.mesh.thinned_m(_NUM_POINTS)
    confidences, answers = code[CONFIDENCE][:, slot, 0].numpy(), poses(code, slot)
    first, second, moved = [], [], []
    for one, other in _neighbours(np.flatnonzero(known)):
        first.append(one)
        second.append(other)
        moved.append(cam_from_world.rows(one) @ cam_from_world.rows(other).inverse() @ answers[other])
    own = [answers[one] for one in first]
    return Pairs(
        kind.name,
        np.stack([confidences[first], confidences[second]], axis=1).astype(float),
        pose_errors(own, moved, kind),
        np.array(are_right(own, moved, points, kind.info), bool),
    )


def _neighbours(numbers: np.ndarray) -> Iterator[tuple[int, int]]:
    for place, one in enumerate(numbers):
        for other in numbers[place + 1 : place + 1 + _NEIGHBOURS]:
            yield int(one), int(other)


def adjusted(
    found: Reliability, answers: Sequence[Answers], pairs: Sequence[Pairs], num_photographs: int
) -> Reliability:
    """The reliability that renderings gave, adjusted to photographs.

    The confidence is calibrated by which pairs agree. Bounds become wider by what gaps between photographs are larger
    than gaps between renderings would be, relative to the bounds. They never become narrower: errors that all
    photographs share leave no gap.

    Args:
        found: From :func:`~curio_train.evaluation.reliability.fit_reliability`.
        answers: On renderings, that it was fitted to.
        pairs: Of photographs.
        num_photographs: How many.
    """
    confidences = np.concatenate([one.confidences for one in pairs]).clip(_LEAST, 1 - _LEAST)
    agree = np.concatenate([one.agree for one in pairs])
    calibration = fit_pair_calibration(np.log(confidences / (1 - confidences)), agree.tolist())
    widening = _widening(found, answers, pairs)
    result = Reliability(level=found.level, num_images=found.num_images, num_photographs=num_photographs)
    result.calibration.extend(calibration)
    result.position_widening, result.rotation_widening = widening or (0.0, 0.0)
    for one in found.objects:
        bounds = [_adjusted_bounds(part, calibration, widening or (1.0, 1.0)) for part in one.bounds]
        sure = calibrated(calibration, one.min_confidence)
        result.objects.append(ObjectReliability(object=one.object, min_confidence=sure, bounds=bounds))
    return result


def adjustment(found: Reliability) -> str:
    """One line that says what photographs changed."""
    weight, offset = found.calibration
    if not found.position_widening:
        wider = f"bounds as on renderings: fewer than {_FEWEST_PAIRS} pairs of answers are sure"
    else:
        position, rotation = found.position_widening, found.rotation_widening
        wider = f"bounds of positions {position:.2f} times, of rotations {rotation:.2f} times as wide"
    return (
        f"by {found.num_photographs} photographs: a confidence of 0.5 is answered as "
        f"{calibrated((weight, offset), 0.5):.2f}; {wider}"
    )


def _adjusted_bounds(of: PoseBounds, calibration: Sequence[float], widening: tuple[float, float]) -> PoseBounds:
    position, rotation = widening
    return PoseBounds(
        min_confidence=calibrated(calibration, of.min_confidence),
        lateral_m=of.lateral_m * position,
        depth_fraction=of.depth_fraction * position,
        rotation_deg=min(of.rotation_deg * rotation, _MOST_DEG),
    )


def _widening(found: Reliability, answers: Sequence[Answers], pairs: Sequence[Pairs]) -> tuple[float, float] | None:
    """Factors that widen the bounds of positions and rotations, at least 1; None: too few pairs of sure answers."""
    of = {one.object: one for one in found.objects}
    rendered = [_relative(of[one.kind.name], *_of_renderings(of[one.kind.name], one)) for one in answers]
    seen = [_relative(of[one.object], one.confidences, one.gaps) for one in pairs]
    expected, photographed = np.concatenate(rendered), np.concatenate(seen)
    if min(len(expected), len(photographed)) < _FEWEST_PAIRS:
        return None
    # Both answers of a pair are within their bounds in so many cases.
    both = LEVEL**2
    position, rotation = (
        max(1.0, conformal_quantile(photographed[:, column], both) / conformal_quantile(expected[:, column], both))
        for column in (0, 1)
    )
    return position, rotation


def _of_renderings(of: ObjectReliability, answers: Answers) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of sure answers about different renderings: confidences, and gaps as independent errors leave them."""
    sure = np.flatnonzero(answers.confidences >= of.min_confidence)
    first, second = sure[:-1], sure[1:]
    gaps = np.hypot(answers.errors[first], answers.errors[second])
    return np.stack([answers.confidences[first], answers.confidences[second]], axis=1), gaps


def _relative(of: ObjectReliability, confidences: np.ndarray, gaps: np.ndarray) -> Float[np.ndarray, "m 2"]:
    """Gaps of position and rotation of the pairs that are both sure, relative to their bounds."""
    relative = [np.zeros((0, 2))]
    for pair, gap in zip(confidences.tolist(), gaps, strict=True):
        bounds = [bounds_of(of, confidence) for confidence in pair]
        limits = [(one.lateral_m, one.depth_fraction, one.rotation_deg) for one in bounds if one is not None]
        if len(limits) == len(pair):
            lateral, depth, rotation = gap / np.hypot(*np.array(limits))
            relative.append(np.array([[max(lateral, depth), rotation]]))
    return np.concatenate(relative)
