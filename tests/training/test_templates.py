"""Templates on frozen features: what needs no renderer."""

import copy
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from curio_train.errors import CheckpointError, UsageError
from curio_train.export.onnx import Tracing, to_onnx
from curio_train.geometry import random_rotations
from curio_train.networks.crop_camera import about_axis, cut_crops
from curio_train.networks.layers import fold_batch_norm
from curio_train.networks.pose_steps import turn
from curio_train.networks.several_objects.locator import FrameFeatures
from curio_train.networks.templates import geometry as template_geometry
from curio_train.networks.templates.alignment import Aligned, FeatureMaps, InCrop, align
from curio_train.networks.templates.bank import COARSE_SIZE, NUM_OUTLINE_POINTS, NUM_POINTS, Bank
from curio_train.networks.templates.bank import RANK as BANK_RANK
from curio_train.networks.templates.descriptors import Descriptors
from curio_train.networks.templates.effort import ONE_LOOK, Effort
from curio_train.networks.templates.geometry import CROP_PX, NUM_ROLLS, QUARTER_TURNS, Geometry, num_views, viewpoints
from curio_train.networks.templates.localiser import RANK, Localiser
from curio_train.networks.templates.network import TemplateNetwork
from curio_train.networks.templates.quick_trunk import quicken
from curio_train.networks.templates.rolls import ROLLS_DEG, upright_rolls
from curio_train.networks.templates.trunk import COARSE_STRIDE, COARSE_WIDTH, FINE_WIDTH, Trunk
from curio_train.scene_code import COLOR
from curio_train.templates.build import template_network
from curio_train.templates.drawing import row_sampling
from curio_train.worlds import build
from curio_train.worlds.options import CirclesOptions
from torch import nn

MATRIX = np.array([[572.4, 0, 325.3], [0, 573.6, 242.0], [0, 0, 1]])
GEOMETRY = Geometry(MATRIX, 640, 480, 0.2, 0.5, 1.5)
FROM_ANY_SIDE = replace(GEOMETRY, any_side=True)


def test_the_trunk_says_the_same_of_an_image_wherever_it_is_in_a_batch() -> None:
    trunk, images = Trunk.pretrained(), torch.rand(3, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    fine, coarse = trunk(images)
    assert fine.shape == (3, 24, 16, 16)
    assert coarse.shape == (3, 40, 8, 8)
    torch.testing.assert_close(trunk(images[1:2])[1][0], coarse[1], atol=1e-4, rtol=1e-3)
    assert not any(parameter.requires_grad for parameter in trunk.parameters())


def test_a_halved_image_is_read_as_if_it_were_doubled() -> None:
    trunk, images = Trunk.pretrained(), torch.rand(2, 3, 72, 72, generator=torch.Generator().manual_seed(0))
    doubled = trunk(nn.functional.interpolate(images, scale_factor=2, mode="bilinear"))
    for found, expected in zip(trunk(images, halved=True), doubled, strict=True):
        assert found.shape == expected.shape
        torch.testing.assert_close(found[..., 6:-6, 6:-6], expected[..., 6:-6, 6:-6], atol=1e-3, rtol=1e-3)


def test_the_locator_sees_the_fine_cells_side_by_side_with_the_coarse_ones() -> None:
    features, images = FrameFeatures().eval(), torch.rand(2, 3, 96, 128, generator=torch.Generator().manual_seed(0))
    features.trunk.load_state_dict(Trunk.pretrained().state_dict())
    with torch.no_grad():
        fine, coarse = features.trunk(images)
        expected = features.context(torch.cat([nn.functional.pixel_unshuffle(fine, 2), coarse], dim=1))
        torch.testing.assert_close(features(images), expected, atol=1e-4, rtol=1e-4)


def test_the_quick_trunk_says_the_same() -> None:
    trunk, images = Trunk.pretrained(), torch.rand(5, 3, 160, 128, generator=torch.Generator().manual_seed(0))
    folded = copy.deepcopy(trunk)
    fold_batch_norm(folded)
    for of_torch in (trunk, folded):
        network = nn.Sequential(copy.deepcopy(of_torch))
        quicken(network)
        for found, expected in zip(copy.deepcopy(network)(images), trunk(images), strict=True):
            torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)
        assert network.state_dict().keys() == nn.Sequential(of_torch).state_dict().keys()
        halved = (part(images, halved=True) for part in (network[0], of_torch))
        for found, expected in zip(*halved, strict=True):
            torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)
        for weights in network.parameters():
            weights.zero_()
        assert network(images)[1].any()  # torch's weights are not asked any more


@pytest.mark.parametrize("scale", [0.4, 0.73, 1.0])
def test_crops_are_drawn_as_they_are_sampled_in_frames(scale: float) -> None:
    frame_side, side = 120, 96
    picture = torch.rand(1, 2, frame_side, frame_side, generator=torch.Generator().manual_seed(0))
    steps = (torch.arange(2 * side) - (2 * side - 1) / 2) * scale / frame_side
    grid = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=-1)[None]
    sampled = torch.nn.functional.grid_sample(picture, grid, align_corners=False)
    rows = row_sampling(frame_side, side, scale)
    expected = torch.nn.functional.avg_pool2d(sampled, 2)
    torch.testing.assert_close(rows @ picture @ rows.T, expected, atol=1e-4, rtol=1e-4)


def test_truncated_weights_are_named(tmp_path: Path) -> None:
    whole = tmp_path / "whole.pth"
    torch.save(Trunk().state_dict(), whole)
    cut = tmp_path / "cut.pth"
    cut.write_bytes(whole.read_bytes()[:20_000])
    with pytest.raises(CheckpointError, match=r"cut\.pth.*cannot be read.*reinstall"):
        Trunk.pretrained(cut)
    with pytest.raises(CheckpointError, match=r"missing\.pth"):
        Trunk.pretrained(tmp_path / "missing.pth")


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    other = tmp_path / "other.pth"
    torch.save({"weight": torch.zeros(3)}, other)
    with pytest.raises(CheckpointError, match="not the weights of EfficientNet-Lite0"):
        Trunk.pretrained(other)


def test_viewpoints_are_rotations_of_the_upper_hemisphere() -> None:
    found = viewpoints(20, 3)
    torch.testing.assert_close(found @ found.mT, torch.eye(3).expand(60, 3, 3), atol=1e-6, rtol=0)
    assert (torch.linalg.det(found) > 0).all()
    camera_height = -(found[:, 2, 2])  # the camera looks along the third row, from above downwards
    assert (camera_height > 0).all()


def test_any_rotation_is_near_a_template_in_one_of_the_quarter_turns() -> None:
    random = random_rotations(300, np.random.default_rng(0))
    quarters = [about_axis(torch.tensor(turn)) for turn in ([1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0])]
    assert len(quarters) == QUARTER_TURNS
    templates = FROM_ANY_SIDE.rotations.flatten(1)
    angles = [((turn @ random).flatten(1) @ templates.T).amax(dim=1) for turn in quarters]
    nearest = ((torch.stack(angles).amax(dim=0) - 1) / 2).clamp(-1, 1).acos().rad2deg()
    assert nearest.max() < 16
    upright = viewpoints(220, NUM_ROLLS).flatten(1)
    below = ((random[random[:, 2, 2] > 0.5].flatten(1) @ upright.T).amax(dim=1) - 1) / 2
    assert below.acos().rad2deg().min() > 16  # which those of the upper hemisphere are not for what is seen from below


def test_crops_are_rolled_until_objects_stand_as_in_templates() -> None:
    random = torch.Generator().manual_seed(0)
    position = torch.randn(20, 3, generator=random) * 0.2 + torch.tensor([0.0, 0.0, 1.0])
    upward = torch.randn(20, 3, generator=random)
    matrix = torch.from_numpy(MATRIX).float()
    each = position.repeat_interleave(len(ROLLS_DEG), dim=0)
    roll = upright_rolls(position, upward)
    _, crop_from_cam = cut_crops(torch.zeros(1, 3, 8, 8), matrix, each[None], torch.full((60,), 100.0), 4, roll=roll)
    x, y, _ = (crop_from_cam @ upward.repeat_interleave(len(ROLLS_DEG), dim=0)[..., None])[..., 0].unbind(1)
    leaning = torch.atan2(x, -y).rad2deg()  # clockwise from upright; y points down
    torch.testing.assert_close(leaning, torch.tensor(ROLLS_DEG).repeat(20), atol=0.01, rtol=0)
    of_templates = torch.atan2(*(viewpoints(1, NUM_ROLLS)[:, :2, 2] * torch.tensor([1, -1])).unbind(1)).rad2deg()
    for angle in ROLLS_DEG:
        assert (of_templates - angle).abs().min() < 0.01


def test_descriptors_have_unit_length_and_lose_what_all_backgrounds_share() -> None:
    random = torch.Generator().manual_seed(0)
    background = torch.randn(4, 8, 16, 16, generator=random) * torch.tensor([10.0, *[1.0] * 7])[:, None, None]
    descriptors = Descriptors(8, 8)
    descriptors.projection.copy_(descriptors.whiten(background + 5))
    found = descriptors(background + 5)
    torch.testing.assert_close(found.square().sum(dim=1), torch.ones(4, 16, 16))
    assert float(found.movedim(1, 0).flatten(1).std(dim=1).max()) < 0.5  # no direction rules


def test_a_pose_is_aligned_with_the_crop_that_it_belongs_to() -> None:
    random = np.random.default_rng(0)
    waves = torch.from_numpy(random.uniform(-0.35, 0.35, (FINE_WIDTH, 2))).float()
    phases = torch.from_numpy(random.uniform(0, 2 * math.pi, FINE_WIDTH)).float()
    v, u = torch.meshgrid(torch.arange(32.0), torch.arange(32.0), indexing="ij")

    def seen(cells: torch.Tensor) -> torch.Tensor:
        values = torch.sin(cells @ waves.T + phases)
        return values / values.norm(dim=-1, keepdim=True)

    maps = FeatureMaps.of(seen(torch.stack([u, v], dim=-1)).permute(2, 0, 1)[None])
    points = torch.from_numpy(random.uniform(-0.4, 0.4, (1, 200, 3))).float()
    focal, true = torch.tensor([400.0]), torch.tensor([[0.02, -0.01, 4.4]])
    at = points + true[:, None]
    wanted = seen((focal * at[..., :2] / at[..., 2:] + 63.5) / 4)
    start = Aligned(torch.eye(3)[None], torch.tensor([[0.0, 0.0, 4.2]]), torch.zeros(1))
    found = align(maps, torch.tensor([0]), points, wanted, start, focal, 12)
    torch.testing.assert_close(found.position, true, atol=0.02, rtol=0)
    torch.testing.assert_close(found.rotation, torch.eye(3)[None], atol=0.02, rtol=0)
    assert float(found.score) > 0.98


def test_derivatives_by_a_pose_are_those_of_small_changes() -> None:
    random = np.random.default_rng(1)
    rotation = random_rotations(3, random).double()
    position = torch.from_numpy(random.uniform([-0.3, -0.3, 1.2], [0.3, 0.3, 1.8], (3, 3)))
    points, focal = torch.from_numpy(random.uniform(-0.5, 0.5, (3, 7, 3))), torch.tensor([90.0, 130.0, 150.0]).double()
    derivatives = InCrop.of(rotation, position, points).jacobians(focal)  # [3, 2, 6, points]
    for number, change in enumerate(1e-5 * torch.eye(6).double()):
        turned = turn(change[None, :3]) @ rotation
        by_change = (
            InCrop.of(turned, position + change[3:], points).cells(focal, 40)
            - InCrop.of(rotation, position, points).cells(focal, 40)
        ) / 1e-5
        torch.testing.assert_close(derivatives[:, :, number], by_change, atol=2e-3, rtol=1e-3)


def test_the_localiser_finds_the_template_it_holds() -> None:
    localiser = Localiser(GEOMETRY)
    features = torch.randn(1, 40, *GEOMETRY.frame_cells, generator=torch.Generator().manual_seed(0))
    number = 3
    side = localiser.filters(number).shape[-1]
    row, column = 9, 21
    patch = localiser.descriptors(features)[:, :, row : row + side, column : column + side]
    localiser.filters(number).copy_(patch.expand(RANK, -1, -1, -1) / side**2)
    localiser.weights[number] = 1 / RANK
    found = localiser(features)
    pixel = MATRIX @ found.position_m[0, 0].numpy()
    expected = (np.array([column, row]) + side // 2) * 16 + 0.5
    np.testing.assert_allclose(pixel[:2] / pixel[2], expected, atol=0.01)
    assert float(found.position_m[0, 0].norm()) == pytest.approx(GEOMETRY.depths_m[number], rel=1e-4)
    assert float(found.score[0, 0]) > 0.9


def _random_network(geometry: Geometry = GEOMETRY) -> TemplateNetwork:
    random = torch.Generator().manual_seed(0)
    network = TemplateNetwork(geometry, has_color=geometry.any_side)
    network.trunk.load_state_dict(Trunk.pretrained().state_dict())
    for name, buffer in (*network.localiser.named_buffers(), *network.reader.banks.named_buffers()):
        if buffer.is_floating_point() and name.startswith(("filters", "weights")):
            buffer.copy_(torch.randn(buffer.shape, generator=random) * 0.05)
    network.reader.banks.put(0, _random_bank(random, num_views(geometry.any_side)))
    return network


def _random_bank(random: torch.Generator, views: int) -> Bank:
    coarse, num, cells = Descriptors(COARSE_WIDTH, COARSE_SIZE), views * NUM_ROLLS, CROP_PX // COARSE_STRIDE
    return Bank(
        coarse,
        Descriptors(FINE_WIDTH, FINE_WIDTH),
        torch.randn(BANK_RANK, COARSE_SIZE, cells, cells, generator=random) * 0.05,
        torch.randn(num, BANK_RANK, generator=random) * 0.05,
        torch.randn(num, NUM_POINTS, 3, generator=random) * 0.2,
        torch.randn(num, NUM_POINTS, FINE_WIDTH, generator=random) * 0.2,
        torch.randn(views, NUM_OUTLINE_POINTS, 3, generator=random) * 0.3,
        torch.nn.functional.normalize(torch.randn(views, NUM_OUTLINE_POINTS, 3, generator=random), dim=2),
    )


@pytest.mark.parametrize("effort", [Effort(), ONE_LOOK])
@pytest.mark.parametrize("geometry", [GEOMETRY, FROM_ANY_SIDE])
def test_a_frame_is_read_the_same_alone_and_among_others(
    geometry: Geometry, effort: Effort, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(template_geometry, "NUM_VIEWS", 24)
    network = _random_network(geometry)
    network.reader.effort = effort
    assert len(network.color) == 3 * geometry.any_side
    network.color.fill_(0.25)
    images = torch.rand(2, 3, 480, 640, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        both, alone = network(images), network(images[1:])
    assert (COLOR in both) == geometry.any_side
    for name, values in both.items():
        assert values.isfinite().all()
        assert name != COLOR or torch.equal(values, torch.full((2, 1, 3), 0.25))
        torch.testing.assert_close(values[1:], alone[name], atol=1e-3, rtol=1e-3)


class _Graph(torch.nn.Module):
    """The network with a camera's pixels as its input, as an export has it."""

    def __init__(self, network: TemplateNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return tuple(self.network(image.permute(0, 3, 1, 2).float() / 255).values())


def test_the_exported_graph_equals_torch_for_any_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    # With 220 each image is compared with 1,540 templates; with half of 48 the confidence hangs on rounding.
    monkeypatch.setattr(template_geometry, "NUM_VIEWS", 48)
    network, random = _random_network(), np.random.default_rng(0)
    network.reader.effort = network.reader.effort._replace(steps=(1, 0, 0))  # more take long to trace
    graph = _Graph(network).eval()
    names = ["translation_m", "rotation_6d", "light", "confidence", "presence"]
    session = onnxruntime.InferenceSession(to_onnx(graph, 640, 480, names, Tracing(one_image=True)).SerializeToString())
    coarse = torch.from_numpy(random.integers(0, 255, (3, 3, 60, 80))).float()
    smooth = torch.nn.functional.interpolate(coarse, (480, 640), mode="bilinear")
    images = smooth.round().byte().permute(0, 2, 3, 1).contiguous()
    with torch.no_grad():
        expected = dict(zip(names, graph(images), strict=True))
    for name, found in zip(names, session.run(names, {"image": images.numpy()}), strict=True):
        torch.testing.assert_close(torch.from_numpy(found), expected[name], atol=1e-3, rtol=1e-3)


def test_templates_are_of_one_object_in_six_degrees_of_freedom() -> None:
    with pytest.raises(UsageError, match="--method templates"):
        template_network(build(CirclesOptions()))
