"""Reads of a photograph agree or not, and the share of photographs whose reads agree is what confidence says."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from curio_serve.imaging.virtual_cameras import VIRTUAL_CAMERAS
from curio_train.config import RunConfig
from curio_train.geometry import rotation_6d_from_matrix
from curio_train.learning.state import TrainState
from curio_train.networks.two_stage.network import TwoStageNetwork
from curio_train.refinement.agreeing_reads import NUM_READS, all_agree
from curio_train.refinement.photographed_confidence import calibrate_by_agreement
from curio_train.refinement.scene_poses import Reads
from curio_train.scene_code import CONFIDENCE, ROTATION_6D, TRANSLATION
from curio_train.worlds.options import LinemodOptions
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import Object
from scipy.spatial.transform import Rotation
from torch import Tensor

NUM = 20


def reads_of(rotations: Sequence[Rotation], positions_m: np.ndarray) -> dict[str, Tensor]:
    rotation = torch.from_numpy(np.stack([rotation.as_matrix() for rotation in rotations])).float()
    return {
        ROTATION_6D: rotation_6d_from_matrix(rotation)[:, None],
        TRANSLATION: torch.from_numpy(np.asarray(positions_m)).float()[:, None],
        CONFIDENCE: torch.full((len(rotations), 1, 1), 0.5),
    }


def test_reads_agree_if_all_are_near_their_mean_up_to_a_symmetry(brick: Object) -> None:
    """The brick looks alike after half a turn about z; ``turned`` turns one read of three about an axis."""
    base = Rotation.from_rotvec([0.3, -0.2, 0.5])

    def agree(turned: Rotation, farther_m: float = 0.0) -> bool:
        positions_m = np.array([[0.1, 0.05, 0.8]] * 3) + np.outer([0, 0, farther_m], [0, 0, 1.0])
        code = reads_of([base, base, base * turned], positions_m)
        return bool(all_agree(Reads(code, np.zeros(3, int)), brick)[0])

    assert agree(Rotation.identity())
    assert agree(Rotation.from_rotvec([0, 0, np.pi]))
    assert not agree(Rotation.from_rotvec([np.pi / 2, 0, 0]))
    asymmetric = replace(brick, kind=replace(brick.kind, symmetries=()))
    code = reads_of([base, base, base * Rotation.from_rotvec([0, 0, np.pi])], np.array([[0.1, 0.05, 0.8]] * 3))
    assert not all_agree(Reads(code, np.zeros(3, int)), asymmetric)[0]
    # A third of the gap is what the mean moves by; the read itself is two thirds off.
    diameter_m = brick.kind.diameter_m
    assert agree(Rotation.identity(), 0.07 * diameter_m)
    assert not agree(Rotation.identity(), 0.2 * diameter_m)


def test_each_photograph_is_judged_by_its_own_reads(brick: Object) -> None:
    turns = [Rotation.identity(), Rotation.from_rotvec([1.0, 0, 0])]
    code = reads_of([turns[0], turns[0], turns[1], turns[0], turns[1], turns[1]], np.array([[0, 0, 0.7]] * 6))
    assert all_agree(Reads(code, np.array([0, 0, 1, 1, 2, 2])), brick).tolist() == [True, False, True]


@torch.no_grad()
def test_confidence_is_the_share_of_photographs_whose_reads_agree(brick: Object, greys: Callable[[int], Any]) -> None:
    """Every fourth photograph is read in another way each time."""
    world = TwoStageWorld("capture", brick, greys(NUM), aligns_outlines=True)
    state = TrainState(RunConfig(LinemodOptions("ape", two_stage=True)), world, torch.device("cpu"))
    network = state.pose.network.eval()
    assert isinstance(network, TwoStageNetwork)
    presence = network.presence.clone()
    random, count = np.random.default_rng(1), 0

    def read(_network: object, _images: object, _output: object) -> dict[str, Tensor]:
        nonlocal count
        number, virtual = count // NUM_READS, VIRTUAL_CAMERAS[count % NUM_READS]
        count += 1
        turn = (
            Rotation.random(random_state=random) if number % 4 == 0 else Rotation.from_matrix(virtual.virtual_from_cam)
        )
        return reads_of([turn], np.array([[0.0, 0.0, 0.8 / virtual.zoom]]))

    network.register_forward_hook(read)
    calibrate_by_agreement(network, world)
    assert count == NUM * NUM_READS
    frames = torch.stack([torch.full((3, 480, 640), 9 * number / 255) for number in range(NUM)])
    features = torch.cat([network.uncalibrated(frame[None])[1].pose_correct for frame in frames])
    confidence = torch.sigmoid(features @ network.rightness[:1] + network.rightness[1])
    assert abs(float(confidence.mean()) - (0.75 * NUM + 1) / (NUM + 2)) < 0.03
    assert torch.equal(network.presence, presence)

    network.rightness.copy_(torch.tensor([0.7, 0.3]))
    assert "fewer than 20" in calibrate_by_agreement(
        network, TwoStageWorld("capture", brick, greys(NUM - 1), aligns_outlines=True)
    )
    assert network.rightness.tolist() == pytest.approx([0.7, 0.3]), "too few photographs say nothing"
