"""Where each of several objects lay in photographs of one scene: consensus of what a network reads in each of them.

The camera moves; objects lie still for a while, and may be moved between photographs. Given the camera's motion
(structure from motion), every read becomes a pose in the scene, and reads of several photographs that agree there are
right together (:mod:`curio_serve.consensus.poses`), also for the photographs between them that were misread. Several
bearings tell a distance better than one photograph does. How large the scene is, which structure from motion leaves
open, is what the objects tell on average. No label is used.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from curio_serve.consensus.poses import Consensus
from jaxtyping import Bool, Int

from curio_train.data.photographs import CameraPoses
from curio_train.geometry import Pose, matrix_from_rotation_6d
from curio_train.refinement.multi_view import consensus_in_scene, estimate_scale
from curio_train.scene_code import CONFIDENCE, ROTATION_6D, TRANSLATION, SceneCode, of_slot
from curio_train.worlds.base import ObjectKind

_LEAST_CONFIDENCE = 0.1  # of reads that count
_IN_DEPTH, _MOVED = 0.03, 0.02  # standard deviations: of distances, relative, and of what lies still, diameters
_OUTLYING = 0.2  # of the objects' scales that are left out, at either end
_LEAST_SHARE = 0.5  # of a photograph's reads that must agree on a place, in some photographs
_FEWEST_PHOTOGRAPHS = 3  # of these
_LARGEST_GAP = 5  # photographs without a member between two that show an object at one place


class Reads(NamedTuple):
    """Scene codes of photographs, each of which may have been read several times."""

    code: SceneCode
    """[reads, objects, …], in the photographs' camera, metres."""
    photograph: Int[np.ndarray, " reads"]
    """Number of the photograph that each is of."""


def scene_poses(reads: Reads, cameras: CameraPoses, kinds: Sequence[ObjectKind]) -> list[Pose[np.ndarray]]:
    """Poses cam_from_obj of each object in all photographs [photographs, …]; NaN where no consensus tells one.

    Args:
        reads: With confidences.
        cameras: Of the photographs, in the order in which they were taken.
        kinds: The objects, each with the slot of its place in this order.
    """
    known = cameras.known[reads.photograph]
    reads = Reads({name: value[known] for name, value in reads.code.items()}, reads.photograph[known])
    at = CameraPoses(cameras.cam_from_world[reads.photograph])
    sure = reads.code[CONFIDENCE][..., 0] >= _LEAST_CONFIDENCE
    scales = {
        slot: scale
        for slot, kind in enumerate(kinds)
        if (scale := estimate_scale(at, of_slot(reads.code, slot), sure[:, slot], kind.diameter_m))
    }
    unknown = Pose(np.full((len(cameras.known), 3, 3), np.nan), np.full((len(cameras.known), 3), np.nan))
    if not scales and not cameras.in_metres:
        return [unknown] * len(kinds)
    scale = 1.0 if cameras.in_metres else _scale_of_all(list(scales.values()))
    cam_from_world = Pose.from_matrix(cameras.cam_from_world)
    cam_from_world = Pose(cam_from_world.rotation, scale * cam_from_world.translation_m)
    return [
        # What an object errs by in all photographs alike is what its scale differs by from the scene's.
        _of_object(reads, slot, sure[:, slot].numpy(), scale / scales.get(slot, scale), cam_from_world, kind)
        for slot, kind in enumerate(kinds)
    ]


def _scale_of_all(scales: Sequence[float]) -> float:
    """The scale of a scene that its objects tell, without those that err most."""
    from scipy.stats import trim_mean  # a third of a second, which training need not wait for

    return float(np.exp(trim_mean(np.log(scales), _OUTLYING)))


def _of_object(
    reads: Reads,
    slot: int,
    chosen: Bool[np.ndarray, " reads"],
    correction: float,
    cam_from_world: Pose[np.ndarray],
    kind: ObjectKind,
) -> Pose[np.ndarray]:
    """The poses of one object in the photographs."""
    photograph = reads.photograph[chosen]
    rotation = matrix_from_rotation_6d(reads.code[ROTATION_6D][:, slot]).double().numpy()[chosen]
    position_m = correction * reads.code[TRANSLATION][:, slot].double().numpy()[chosen]
    found = consensus_in_scene(
        cam_from_world, photograph, Pose(rotation, position_m), kind.info, in_depth=_IN_DEPTH, moved=_MOVED
    )
    number = _where(found, photograph, np.bincount(reads.photograph, minlength=len(cam_from_world.rotation)))
    there = Pose(np.full((len(number), 3, 3), np.nan), np.full((len(number), 3), np.nan))
    for which, one in enumerate(found):
        there.rotation[number == which], there.translation_m[number == which] = one.rotation, one.translation_m
    return cam_from_world @ there


def _where(
    found: Sequence[Consensus], photograph: Int[np.ndarray, " reads"], num_reads: Int[np.ndarray, " photographs"]
) -> Int[np.ndarray, " photographs"]:
    """Which consensus each photograph shows, -1 for none: of its reads' the one of most photographs.

    What a network takes for an object that is not there, it takes for it in one read and not in the next. So there must
    be photographs of which half of the reads agree. Between photographs that show the same one the object was not
    moved.

    Args:
        found: Poses on which some reads agree.
        photograph: Of each of these reads.
        num_reads: Of each photograph, in all.
    """
    agreeing = [np.bincount(photograph[one.members], minlength=len(num_reads)) for one in found]
    number = np.full(len(num_reads), -1)
    for which in sorted(range(len(found)), key=lambda which: np.count_nonzero(agreeing[which])):
        shown = agreeing[which] > 0
        if (shown & (agreeing[which] >= _LEAST_SHARE * num_reads)).sum() >= _FEWEST_PHOTOGRAPHS:
            number[shown] = which
    told = np.flatnonzero(number >= 0)
    for first, second in pairwise(told):
        if number[first] == number[second] and second - first <= _LARGEST_GAP + 1:
            number[first:second] = number[first]
    return number
