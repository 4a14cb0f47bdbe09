"""Confidence that photographs calibrate: with pseudo-labels of several objects, or where reads of one object agree."""

from typing import NamedTuple

import numpy as np
import torch
from curio_serve.imaging.virtual_cameras import VIRTUAL_CAMERAS
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from curio_train.counting import counted
from curio_train.data.photographs import read_frames, spread
from curio_train.geometry import Pose
from curio_train.metrics.calibration import fit_calibration, fit_calibration_below_ceiling
from curio_train.metrics.poses import ADD_THRESHOLD, add_or_add_s_m
from curio_train.networks.several_objects.network import ObjectsNetwork
from curio_train.networks.two_stage.network import TwoStageNetwork
from curio_train.refinement.agreeing_reads import NUM_READS, NUM_READS_BY_TEMPLATES, all_agree
from curio_train.refinement.scene_labels import SceneLabels, read_often
from curio_train.scene_code import poses
from curio_train.templates.photographed import learn_appearance
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import Object

_NUM_POINTS = 500  # vertices that ADD is measured at, about
_FEWEST = 8  # correct poses, and wrong ones, that a calibration needs
_READ_AT_ONCE = 2
_NUM_READ, _FEWEST_READ = 100, 20  # photographs; each takes a third of a second for one part, twice as long for two
_TOO_FEW = f"confidence is calibrated by renderings, because there are fewer than {_FEWEST_READ} photographs"


class Evidence(NamedTuple):
    """Calibration features of the poses that were read in photographs, and whether each pose is correct."""

    features: Float[np.ndarray, "photographs objects 3"]
    """Features of the pose-correct logit."""
    correct: Bool[np.ndarray, "photographs objects"]
    """Whether a pose agrees with its pseudo-label."""
    shown: Bool[np.ndarray, "photographs objects"]
    """Whether photographs agree that the object is there. Elsewhere it may be there all the same, and read right."""


@torch.no_grad()
def read_by_others(network: ObjectsNetwork, world: SeveralObjectsWorld, labels: SceneLabels) -> Evidence:
    """Read each photograph by templates that only the other half of the photographs changed.

    A network is surer of what it has learned from.

    Args:
        network: Its templates are the same afterwards.
        world: Of its objects.
        labels: The photographs.
    """
    network.eval()
    rendered = {name: value.clone() for name, value in network.reader.banks.state_dict().items()}
    num, objects = len(labels.frames), len(labels.poses)
    evidence = Evidence(np.zeros((num, objects, 3)), np.zeros((num, objects), dtype=bool), labels.shown)
    for half in range(2):
        own, others = np.arange(half, num, 2), slice(1 - half, None, 2)
        learn_appearance(network, labels.frames[others], [pose.rows(others) for pose in labels.poses])
        batches = np.split(own, range(_READ_AT_ONCE, len(own), _READ_AT_ONCE))
        for rows in counted(batches, len(batches), f"half {half + 1} of the photographs, read by the other, batches"):
            code, found = network.read(labels.frames[torch.from_numpy(rows)].float() / 255)
            evidence.features[rows] = found.right.numpy()
            for slot in range(objects):
                evidence.correct[rows, slot] = _correct(world, slot, poses(code, slot), labels.poses[slot], rows)
        network.reader.banks.load_state_dict(rendered)
    return evidence


def calibrate_by(network: ObjectsNetwork, evidence: Evidence) -> None:
    """Make confidences the probabilities of correct poses in such photographs, where enough were read to tell.

    All objects are calibrated together: some dozens of reads of each, some of whose labels are wrong, tell less about
    an object than the others do (docs/experiments/real_photographs.md). Objects that are not known to be
    there are left out: that is what presence tells. Poses that look as good as any can be at a wrong distance, which
    no feature shows: so confidence has a ceiling.

    Args:
        network: Calibrated on renderings.
        evidence: Of its objects.
    """
    hits = evidence.correct[evidence.shown]
    if min(hits.sum(), (~hits).sum()) >= _FEWEST:
        weights, ceiling = fit_calibration_below_ceiling(evidence.features[evidence.shown], hits.tolist())
        network.reader.pose_correct[:] = torch.tensor(weights).float()
        network.reader.ceiling.fill_(ceiling)


@torch.no_grad()
def calibrate_by_agreement(network: TwoStageNetwork, world: TwoStageWorld) -> str:
    """Make the confidence of a correct pose the share of photographs of which all reads agree, in place.

    Renderings show clutter and parts that the frame's border cuts, which photographs of a part hardly do: calibrated by
    them, an own part's confidence is a third too low (docs/experiments/captures.md). Agreement is no truth: an error
    that all reads share is not seen. Absence, which photographs of the object do not show, stays as renderings tell it.

    Args:
        network: Calibrated on renderings; with fewer than twenty photographs it stays as it is.
        world: Its photographs show the object.

    Returns:
        What calibrates the confidence, for the user.

    Raises:
        DataError: A photograph cannot be read, or is not of the camera's size.
    """
    frames = _frames(world, world.object)
    if frames is None:
        return _TOO_FEW
    assert world.camera.matrix is not None
    reads = read_often(frames, world.camera.matrix, network, VIRTUAL_CAMERAS[:NUM_READS])
    found = [network.uncalibrated(some.float() / 255)[1] for some in frames.split(_READ_AT_ONCE)]
    features = torch.cat([of_some.pose_correct for of_some in found]).numpy()
    agrees = all_agree(reads, world.object)
    network.rightness.copy_(_share(features, agrees))
    return _told(world.object, agrees)


@torch.no_grad()
def calibrate_parts_by_agreement(network: ObjectsNetwork, world: SeveralObjectsWorld) -> str:
    """Make the confidence of each part the share of photographs of which both reads agree, in place.

    Templates of a plain part match photographs half as well as renderings, so that renderings teach that such poses are
    wrong (docs/experiments/captures.md). Photographs therefore tell both at once here: that a part is there, and that
    its pose is correct. A part that few photographs show, or that is seldom read alike, stays as
    renderings calibrate it.

    Args:
        network: Calibrated on renderings; with fewer than twenty photographs it stays as it is.
        world: Its photographs show the parts.

    Returns:
        What calibrates the confidence of each part, for the user.

    Raises:
        DataError: A photograph cannot be read, or is not of the camera's size.
    """
    frames = _frames(world, world.members[0])
    if frames is None:
        return _TOO_FEW
    assert world.camera.matrix is not None
    reads = read_often(frames, world.camera.matrix, network, VIRTUAL_CAMERAS[:NUM_READS_BY_TEMPLATES])
    features = torch.cat([network.read(some.float() / 255)[1].right for some in frames.split(_READ_AT_ONCE)]).numpy()
    reader, told = network.reader, list[str]()
    for slot, member in enumerate(world.members):
        agrees = all_agree(reads, member, slot)
        is_enough = agrees.sum() >= _FEWEST_READ
        told.append(_told(member, agrees, is_enough=bool(is_enough)))
        if is_enough:
            reader.pose_correct[slot] = _share(features[:, slot], agrees)
            reader.presence_power[slot] = 0
    return "\n".join(told)


def _told(one: Object, agrees: Bool[np.ndarray, " photographs"], *, is_enough: bool = True) -> str:
    few = f"fewer than {_FEWEST_READ}, so renderings calibrate its confidence; more photographs that show it help"
    by = "which calibrates its confidence" if is_enough else few
    return f"{one.kind.name}: {agrees.sum()} of {len(agrees)} photographs are read alike, {by}"


def _frames(world: TwoStageWorld | SeveralObjectsWorld, one: Object) -> UInt8[Tensor, "num 3 height width"] | None:
    """Photographs that tell how often reads agree, or None if there are too few.

    Args:
        world: With photographs, or without.
        one: Of its objects; its camera is that of all.
    """
    paths = spread(world.photographs.paths(), _NUM_READ) if world.photographs is not None else []
    if len(paths) < _FEWEST_READ:
        return None
    return torch.from_numpy(read_frames(paths, one.camera, world.camera.width, world.camera.height))


def _share(
    features: Float[np.ndarray, "photographs size"], agrees: Bool[np.ndarray, " photographs"]
) -> Float[Tensor, "size+1"]:
    """Weights of the logit of how often reads of photographs with like features agree."""
    mean = features.mean(axis=0)
    # One right and one wrong answer more (Laplace's rule): that all agree does not make them certain.
    weights = fit_calibration(np.vstack([features, mean, mean]), [*agrees.tolist(), True, False])
    return torch.tensor(weights).float()


def _correct(
    world: SeveralObjectsWorld, slot: int, found: list[Pose], labels: Pose[np.ndarray], rows: np.ndarray
) -> list[bool]:
    member = world.members[slot]
    points = member.mesh.thinned_m(_NUM_POINTS)
    labelled = [labels.rows(row) for row in rows]
    return [
        bool(np.isfinite(label.translation_m).all())
        and add_or_add_s_m(pose, label, points, member.kind.info) < ADD_THRESHOLD * member.kind.diameter_m
        for pose, label in zip(found, labelled, strict=True)
    ]
