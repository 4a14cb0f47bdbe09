"""The two-stage network: crops are what a turned camera would see, and what is read in them is turned back."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from curio_train.camera import Intrinsics
from curio_train.config import NetworkConfig
from curio_train.geometry import (
    Pose,
    matrix_from_rotation_6d,
    rotation_6d_from_matrix,
    rotation_angle_deg,
    rotation_between,
)
from curio_train.metrics.poses import project
from curio_train.networks.base import StageNetwork
from curio_train.networks.two_stage.crop_pose import OBJECT_COORDINATES
from curio_train.networks.two_stage.localise import (
    HEAT_MAP,
    NUM_TOP,
    PROPOSALS,
    TOP_LOG_WEIGHTS,
    TOP_PROPOSALS,
)
from curio_train.networks.two_stage.network import SCALES
from curio_train.rendering.object_coordinates import ObjectCoordinateMap
from curio_train.scene_code import CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION, index
from curio_train.worlds.single_object.confidence import calibrate
from curio_train.worlds.single_object.crop_pose_loss import ASSUMED_DEPTH
from curio_train.worlds.single_object.crop_pose_stage import CROP_PX, CropPoseStage
from curio_train.worlds.single_object.localisation_stage import LocalisationStage
from curio_train.worlds.single_object.two_stage import TwoStageWorld, frame_camera
from curio_train.worlds.single_object.world import EXPOSURE, Object
from torch import Tensor, nn


class Told(StageNetwork):
    """A look that answers what it was told, and keeps what it was shown.

    Of crops placed nearer and farther too, it says so.
    """

    def __init__(self, code: dict[str, Tensor]) -> None:
        super().__init__()
        self.encoder, self.code, self.shown = nn.Identity(), code, []

    def decode(self, features: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        self.shown.append(features)
        if len(features) == len(next(iter(self.code.values()))):
            return {}, self.code
        code = {name: value.repeat_interleave(len(SCALES), dim=0) for name, value in self.code.items()}
        assert len(features) == len(code[TRANSLATION])
        code[TRANSLATION][..., 2] /= torch.tensor(SCALES).repeat(len(features) // len(SCALES))[:, None]
        return {}, code


def test_the_canonical_camera_is_the_frames_own_at_most_640_pixels_long(brick: Object) -> None:
    camera = frame_camera(brick.camera)
    assert (camera.width, camera.height) == (640, 480)
    assert np.array_equal(camera.matrix, brick.camera.matrix)
    large = frame_camera(Intrinsics(np.array([[1600.0, 0, 960], [0, 1600, 540], [0, 0, 1]]), 1920, 1080))
    assert (large.width, large.height) == (640, 360)
    assert large.matrix[0, 0] == pytest.approx(1600 / 3)


def test_a_crop_is_what_the_second_look_was_trained_on_and_its_pose_comes_back(brick_world: TwoStageWorld) -> None:
    """A frame is rendered, looked at where the object is, and the crop compared with one rendered as a crop.

    Told the truth about the crop, the two-stage network must answer the truth about the frame.
    """
    code = brick_world.sample(6, (5,))
    code[TRANSLATION][..., 2] = code[TRANSLATION][..., 2].clamp(0.62, 0.8)  # near enough, and so if taken nearer
    code[TRANSLATION][..., :2] *= 0.4  # whole in the frame
    images = brick_world.render(code)
    place = code[TRANSLATION][:, 0]
    distance = place.norm(dim=1, keepdim=True)
    second = brick_world.stages[1]
    turn = rotation_between(place, torch.tensor([0.0, 0, 1]).expand_as(place))
    relative = {
        TRANSLATION: torch.tensor([0.0, 0, 1]).expand(6, 1, 3),
        ROTATION_6D: rotation_6d_from_matrix(turn @ matrix_from_rotation_6d(code[ROTATION_6D][:, 0]))[:, None],
        CONFIDENCE: torch.full((6, 1, 1), 0.7),
        LIGHT: (turn @ code[LIGHT][..., None])[..., 0],
        OBJECT_COORDINATES: torch.zeros(6, 4, 16, 16),
    }
    glance = Told(relative)
    places = {TOP_PROPOSALS: code[TRANSLATION], TOP_LOG_WEIGHTS: torch.zeros(6, 1)}
    network = brick_world.assemble([Told(places), glance])
    found = network(images)
    assert torch.allclose(found[TRANSLATION], code[TRANSLATION], atol=1e-5)
    turned = rotation_angle_deg(*(matrix_from_rotation_6d(c[ROTATION_6D][:, 0]) for c in (found, code)))
    assert turned.max() < 0.05
    assert torch.allclose(found[LIGHT], code[LIGHT], atol=1e-5)
    assert torch.allclose(found[CONFIDENCE], relative[CONFIDENCE])
    given = {ASSUMED_DEPTH: distance, EXPOSURE: code[EXPOSURE]}
    rendered = second.render(relative | given | {CONFIDENCE: torch.ones(6, 1, 1)})
    assert glance.shown[0].shape == (6, 3, CROP_PX, CROP_PX)
    missed = (glance.shown[0] - rendered).abs().mean()
    assert missed < 0.5 * (rendered - rendered.roll(1, dims=-1)).abs().mean(), "further off than half a pixel"


def test_objects_of_the_second_look_lie_where_its_code_says(brick_world: TwoStageWorld) -> None:
    second = brick_world.stages[1]
    code = second.sample(40, (1,))
    assert 0 < (code[CONFIDENCE] == 0).sum() < 15
    code[CONFIDENCE][:] = 1
    second.layout.check(
        {name: value for name, value in code.items() if name not in (ASSUMED_DEPTH, EXPOSURE, OBJECT_COORDINATES)}
    )
    drawn = second.render(code).amax(dim=1) > 0.02
    place = code[TRANSLATION][:, 0]
    pixels = torch.from_numpy(project(place.numpy(), second.camera.matrix))
    rows, columns = torch.meshgrid(torch.arange(CROP_PX), torch.arange(CROP_PX), indexing="ij")
    for mask, pixel in zip(drawn, pixels, strict=True):
        middle = torch.stack([columns[mask].float().mean(), rows[mask].float().mean()])
        assert (middle - pixel).norm() < 6


def test_surface_points_project_to_the_patches_that_see_them(brick_world: TwoStageWorld) -> None:
    second = brick_world.stages[1]
    code = second.sample(8, (3,))
    surface_map = ObjectCoordinateMap(second.object.mesh, 32)
    rotation = matrix_from_rotation_6d(code[ROTATION_6D][:, 0])
    place = second._in_metres(code[TRANSLATION][:, 0], code[ASSUMED_DEPTH])
    matrices = second._matrices(code, 32)
    points, seen = surface_map(rotation, place, matrices)
    assert seen.sum() > 500
    for image in range(8):
        v, u = torch.nonzero(seen[image], as_tuple=True)  # those at the rim, too
        metres = points[image][:, v, u].T * surface_map.half_extent_m + torch.from_numpy(surface_map.center_m).float()
        camera = Pose(rotation[image], place[image]).apply(metres)
        pixels = torch.from_numpy(project(camera.numpy(), matrices[image]))
        assert (pixels - torch.stack([u, v], dim=1)).abs().mean() < 0.3


def test_localisation_gives_the_likeliest_position(brick_world: TwoStageWorld) -> None:
    """A network that scores brightness must answer with the bright spot's place, between the depth bounds."""
    first = brick_world.stages[0]
    network = first.network(NetworkConfig()).eval()
    spot = torch.zeros(1, 3, 120, 160)
    spot[:, :, 60:68, 100:108] = 1.0
    with torch.no_grad():
        for module in network.encoder.modules():
            if isinstance(module, nn.Conv2d):
                module.weight.zero_()
                module.bias.zero_()
                middle = module.kernel_size[0] // 2
                module.weight[0, 0, middle, middle] = 1.0
        network.score.weight.zero_()
        network.score.weight[0, 0] = 50.0
        found = network(spot)
    assert found[PROPOSALS].shape == (1, 20 * 15, 3)
    assert found[HEAT_MAP].shape == (1, 20 * 15)
    pixel = torch.from_numpy(project(found[TRANSLATION][0, 0].numpy(), first.camera.matrix))
    assert (pixel - torch.tensor([104.0, 64.0])).abs().max() < 8.1
    assert 0.5 <= found[TRANSLATION][0, 0, 2] <= 1.5


def test_first_look_sees_several_under_one_light(brick_world: TwoStageWorld) -> None:
    first: LocalisationStage = brick_world.stages[0]
    code = first.sample(4, (1,))
    assert code[TRANSLATION].shape == (4, first.num_instances, 3)
    assert code[LIGHT].shape == (4, 3)
    background = torch.zeros(4, 3, first.camera.height, first.camera.width)
    seen = first.render(code, background).sum(1) > 0
    pixels = project(code[TRANSLATION].flatten(0, 1).numpy(), first.camera.matrix)
    for number, (u, v) in enumerate(pixels.round().astype(int).tolist()):
        patch = seen[number // first.num_instances, max(v - 4, 0) : v + 5, max(u - 4, 0) : u + 5]
        assert patch.any(), (number, u, v)


def test_batches_of_crops_give_what_rendering_needs_and_no_label(brick_world: TwoStageWorld, tmp_path) -> None:
    batch = brick_world.stages[1].source("train", 0, with_code=False, cache=tmp_path).batch(3, 4)
    assert batch.code is None
    assert set(batch.given) == {ASSUMED_DEPTH}
    labelled = brick_world.stages[1].source("train", 0, with_code=True, cache=tmp_path).batch(3, 4)
    again = brick_world.stages[1].render(index(labelled.code, slice(None)), labelled.backgrounds)
    assert torch.allclose(again, batch.images, atol=1e-5)  # Dr.Jit's threads add in any order


class Bright(StageNetwork):
    """A look at crops that sees the more of the object the brighter they are, and says that it is in the middle."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = nn.Identity()

    def decode(self, features: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        count, brightness = len(features), features.mean((1, 2, 3))
        return {}, {
            TRANSLATION: torch.tensor([0.0, 0, 1]).expand(count, 1, 3),
            ROTATION_6D: torch.tensor([1.0, 0, 0, 0, 1, 0]).expand(count, 1, 6),
            CONFIDENCE: brightness.view(count, 1, 1),
            LIGHT: torch.zeros(count, 3),
            OBJECT_COORDINATES: brightness.view(count, 1, 1, 1).expand(count, 4, 16, 16),
        }


def test_of_several_candidates_the_likeliest_is_answered(brick_world: TwoStageWorld) -> None:
    """Two frames, each bright at another of three candidates; then a localisation stage that knows better than the
    second."""
    candidates = torch.tensor([[0.2, 0.1, 1.0], [-0.2, -0.1, 0.8], [0.0, 0.2, 1.2]]).expand(2, 3, 3)
    pixels = project(candidates.numpy(), brick_world.camera.matrix).round().astype(int)
    frames = torch.zeros(2, 3, 480, 640)
    for image, chosen in enumerate((2, 0)):
        u, v = pixels[image, chosen].tolist()
        frames[image, :, v - 30 : v + 31, u - 30 : u + 31] = 1.0
    equal = {TOP_PROPOSALS: candidates, TOP_LOG_WEIGHTS: torch.full((2, 3), -1.1)}
    found = brick_world.assemble([Told(equal), Bright()])(frames)
    assert torch.allclose(found[TRANSLATION][:, 0], candidates[0, [2, 0]], atol=1e-5)
    assert found[CONFIDENCE].min() > 0.1
    assert set(found) == {field.name for field in brick_world.layout.fields}
    known = {TOP_PROPOSALS: candidates, TOP_LOG_WEIGHTS: torch.tensor([[-9.0, 0, -9]]).expand(2, 3)}
    found = brick_world.assemble([Told(known), Bright()])(frames)
    assert torch.allclose(found[TRANSLATION][:, 0], candidates[0, [1, 1]], atol=1e-5)


def test_confidence_weighs_what_all_glances_see(brick_world: TwoStageWorld) -> None:
    """Probability that the object is there, by evidence and weight of the place, times that of being right then."""
    candidates = torch.tensor([[0.2, 0.1, 1.0], [-0.2, -0.1, 0.8]]).expand(3, 2, 3)
    weights = torch.tensor([[-3.0, -0.5]]).expand(3, 2)
    frames = torch.tensor([0.2, 0.5, 0.9])[:, None, None, None].expand(3, 3, 480, 640)
    network = brick_world.assemble([Told({TOP_PROPOSALS: candidates, TOP_LOG_WEIGHTS: weights}), Bright()])
    _, features = network.uncalibrated(frames)
    brightness = frames[:, 0, 0, 0]
    assert torch.allclose(features.pose_correct[:, 0], brightness.logit(), atol=1e-4)
    assert torch.allclose(features.presence, torch.stack([brightness, torch.full((3,), -0.5)], dim=1), atol=1e-4)
    assert torch.allclose(network(frames)[CONFIDENCE].flatten(), brightness, atol=1e-4)
    network.rightness.copy_(torch.tensor([2.0, 0.5]))
    network.presence.copy_(torch.tensor([2.0, 1.0, 0.25]))
    expected = (2 * brightness.logit() + 0.5).sigmoid() * (2 * brightness - 0.25).sigmoid()
    assert torch.allclose(network(frames)[CONFIDENCE].flatten(), expected, atol=1e-4)


class Middle(StageNetwork):
    """A look at frames that takes everything to be at one place."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = nn.Identity()

    def decode(self, features: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        count = len(features)
        place = torch.tensor([0.0, 0, 0.8]).expand(count, 1, 3)
        return {}, {TOP_PROPOSALS: place, TOP_LOG_WEIGHTS: torch.zeros(count, 1)}


def test_calibration_knows_empty_frames(brick_world: TwoStageWorld, tmp_path: Path) -> None:
    """To a network that sees what stands out from the wall, whose own confidence says nothing."""
    wall = torch.full((4, 3, 480, 640), 128 / 255)

    class StandsOut(Bright):
        def decode(self, features: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
            seen = (features - wall[0, 0, 0, 0]).abs().mean(dim=(1, 2, 3), keepdim=True)
            surface = (100 * seen).expand(-1, 4, 16, 16)
            return {}, super().decode(features)[1] | {
                OBJECT_COORDINATES: surface,
                CONFIDENCE: torch.full_like(seen[:, 0], 0.5),
            }

    network = brick_world.assemble([Middle(), StandsOut()])
    calibrate(network, brick_world, tmp_path)
    code = brick_world.sample(4, (1,))
    code[TRANSLATION][:] = torch.tensor([0.0, 0, 0.8])
    full, empty = (network(images)[CONFIDENCE].mean() for images in (brick_world.render(code, wall), wall))
    assert empty < 0.6 * full


def test_top_proposals_are_apart_and_the_likeliest_comes_first(brick_world: TwoStageWorld) -> None:
    first = brick_world.stages[0]
    network = first.network(NetworkConfig())
    weights = torch.full((1, 20 * 15), 1e-6)
    chosen = torch.tensor([5 * 20 + 5, 5 * 20 + 6, 10 * 20 + 12, 2 * 20 + 17])
    weights[0, chosen] = torch.tensor([0.5, 0.3, 0.15, 0.05])
    places = network.grid.locate(network.grid.pixels, torch.zeros(300, 1))[None]
    found, of_found = network._top_proposals(places, weights)
    assert found.shape == (1, NUM_TOP, 3)
    assert torch.equal(found[0, :3], places[0, chosen[[0, 2, 3]]])
    assert torch.equal(of_found[0, :3], weights[0, chosen[[0, 2, 3]]])
    # Cells far from each other that mean one place are one candidate.
    places[0, chosen[2]] = places[0, chosen[0]] + 0.01
    found, _ = network._top_proposals(places, weights)
    assert torch.equal(found[0, :2], places[0, chosen[[0, 3]]])


def test_colours_differ_least_where_they_tell_most(brick: Object, brick_world: TwoStageWorld) -> None:
    """The localisation stage, and all looks at a known scene, see milder light than the crop-pose stage at an unknown
    one."""
    first, second = brick_world.stages
    known = TwoStageWorld("capture", replace(brick, known_scene=True))
    spread = {
        name: float(look.sample(400, (1,))[EXPOSURE].log().std())
        for name, look in {"whole": brick_world, "first": first, "second": second, "known": known.stages[1]}.items()
    }
    assert spread["second"] > 1.3 * spread["first"]
    assert spread["whole"] == pytest.approx(spread["first"], rel=0.1)
    assert spread["known"] == pytest.approx(spread["first"], rel=0.1)
    images = torch.rand(64, 3, 1, 1).expand(-1, -1, 64, 64).contiguous()

    def moved(look: LocalisationStage | CropPoseStage) -> float:
        return float((look.augment(images, (1,)) - images).mean((2, 3)).abs().mean())

    assert moved(second) > 1.3 * moved(first)
    assert moved(first) > 1.2 * moved(known.stages[0])
    assert moved(known.stages[0]) == pytest.approx(moved(known.stages[1]))


def test_light_of_a_known_scene_tells_faces_apart(brick: Object) -> None:
    for known, weakest in ((False, 0.2), (True, 0.5)):
        for look in TwoStageWorld("capture", replace(brick, known_scene=known)).stages:
            strength = look.sample(400, (1,))[LIGHT].norm(dim=-1)
            assert weakest <= strength.min() < 1.1 * weakest
            assert strength.max() <= 2
