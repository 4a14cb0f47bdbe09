"""Poses that are aligned with the object's outline in an image."""

import dataclasses
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from curio_serve.errors import InternalError, ModelError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.models.stages import outline_stage
from curio_serve.models.stages.crop_stage import CropPose
from curio_serve.models.stages.outline_stage import OutlineStage, OutlineStageNote
from curio_train.config import NetworkConfig, RunConfig
from curio_train.export.graph import pixels_of
from curio_train.export.onnx import to_onnx
from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.initial import begin_with
from curio_train.learning.state import TrainState
from curio_train.networks import outline_alignment
from curio_train.networks.outline_alignment import OutlineAlignment, OutlinePose
from curio_train.networks.pose_steps import solve, turn
from curio_train.networks.two_stage.network import TwoStageNetwork
from curio_train.scene_code import ROTATION_6D, TRANSLATION
from curio_train.templates.build import fill_outline
from curio_train.worlds.options import CirclesOptions
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import Object

NUM = 24


@pytest.fixture(scope="module")
def world(brick: Object) -> TwoStageWorld:
    return TwoStageWorld("capture", brick, aligns_outlines=True)


@pytest.fixture(scope="module")
def network(world: TwoStageWorld) -> TwoStageNetwork:
    torch.manual_seed(0)
    found = world.assemble([stage.network(NetworkConfig()) for stage in world.stages])
    assert isinstance(found, TwoStageNetwork)
    fill_outline(found, world)
    return found.eval()


@pytest.fixture(scope="module")
def outline(network: TwoStageNetwork) -> OutlineAlignment:
    assert network.outline is not None
    return network.outline


@pytest.fixture(scope="module")
def scenes(world: TwoStageWorld) -> tuple[torch.Tensor, OutlinePose]:
    """Images of the brick before smooth noise, and its true poses, positions in diameters."""
    code = world.sample(NUM, (0,))
    coarse = torch.rand(NUM, 3, 30, 40, generator=torch.Generator().manual_seed(0)) * 0.4
    with torch.no_grad():
        images = world.render(code, torch.nn.functional.interpolate(coarse, (480, 640), mode="bicubic")).clamp(0, 1)
    rotation = matrix_from_rotation_6d(code[ROTATION_6D][:, 0])
    return images, OutlinePose(rotation, code[TRANSLATION][:, 0] / world.object.kind.diameter_m)


def matrix(world: TwoStageWorld) -> torch.Tensor:
    assert world.camera.matrix is not None
    return torch.from_numpy(world.camera.matrix).float()


def aligned(outline: OutlineAlignment, images: torch.Tensor, matrix: torch.Tensor, pose: OutlinePose) -> OutlinePose:
    """Poses aligned as those of a code are, positions in diameters."""
    code = {ROTATION_6D: rotation_6d_from_matrix(pose.rotation)[:, None], TRANSLATION: pose.position[:, None]}
    found, _ = outline.of_code(images, matrix, code, diameter_m=1.0)
    return OutlinePose(matrix_from_rotation_6d(found[ROTATION_6D][:, 0]), found[TRANSLATION][:, 0])


def off(found: OutlinePose, true: OutlinePose) -> tuple[float, float, float]:
    """Median errors: degrees, log distance, and across the view in diameters."""
    cosine = ((found.rotation * true.rotation).sum(dim=(1, 2)) - 1) / 2
    log_distance = (found.position.norm(dim=1) / true.position.norm(dim=1)).log().abs()
    across = (found.position[:, :2] / found.position[:, 2:] - true.position[:, :2] / true.position[:, 2:]).norm(dim=1)
    return (
        math.degrees(float(cosine.clamp(-1, 1).arccos().median())),
        float(log_distance.median()),
        float((across * true.position[:, 2]).median()),
    )


@torch.no_grad()
def test_outlines_correct_what_a_network_errs_by(
    world: TwoStageWorld, outline: OutlineAlignment, scenes: tuple[torch.Tensor, OutlinePose]
) -> None:
    images, true = scenes
    random = torch.Generator().manual_seed(1)
    vector = torch.randn(NUM, 3, generator=random) * math.radians(3)
    scale = 1 + 0.03 * torch.randn(NUM, 1, generator=random)
    shift = torch.nn.functional.pad(0.02 * torch.randn(NUM, 2, generator=random), (0, 1))
    start = OutlinePose(turn(vector) @ true.rotation, scale * (true.position + shift))
    found = aligned(outline, images, matrix(world), start)
    for before, after, share in zip(off(start, true), off(found, true), (0.5, 0.7, 0.4), strict=True):
        assert after < share * before


@torch.no_grad()
def test_images_are_aligned_alone_as_among_others(
    world: TwoStageWorld, outline: OutlineAlignment, scenes: tuple[torch.Tensor, OutlinePose]
) -> None:
    images, true = scenes
    both = aligned(outline, images[:3], matrix(world), OutlinePose(*(values[:3] for values in true)))
    alone = aligned(outline, images[1:2], matrix(world), OutlinePose(*(values[1:2] for values in true)))
    for together, single in zip(both, alone, strict=True):
        torch.testing.assert_close(together[1:2], single, atol=1e-4, rtol=1e-4)


@torch.no_grad()
@pytest.mark.parametrize("shade", [0.0, 0.5, 1.0])
def test_where_nothing_is_seen_poses_stay(
    world: TwoStageWorld, outline: OutlineAlignment, scenes: tuple[torch.Tensor, OutlinePose], shade: float
) -> None:
    images, true = scenes
    found = aligned(outline, torch.full_like(images, shade), matrix(world), true)
    for before, after in zip(true, found, strict=True):
        torch.testing.assert_close(after, before, atol=2e-3, rtol=1e-3)


@torch.no_grad()
def test_the_network_answers_aligned_poses(world: TwoStageWorld, network: TwoStageNetwork) -> None:
    images = torch.rand(2, 3, 480, 640, generator=torch.Generator().manual_seed(2))
    code = network(images)
    aligned, network.outline = network.outline, None
    try:
        as_read = network(images)
    finally:
        network.outline = aligned
    assert code.keys() == as_read.keys()
    assert code[TRANSLATION].isfinite().all()
    assert not torch.equal(code[TRANSLATION], as_read[TRANSLATION])


@torch.no_grad()
def test_of_several_objects_each_is_aligned_as_it_would_be_alone(
    world: TwoStageWorld, outline: OutlineAlignment, scenes: tuple[torch.Tensor, OutlinePose]
) -> None:
    """Two objects, asked for in the other order: the second one is half as large, and its outlines are turned over."""
    images, true = scenes
    other = OutlineAlignment(len(outline.directions))
    other.put(-outline.directions, -outline.points, -outline.outward)
    several = OutlineAlignment(len(outline.directions), 2)
    for slot, one in enumerate((outline, other)):
        several.put(one.directions, one.points, one.outward, slot)
    diameter_m, rotation = torch.tensor([0.2, 0.1]), rotation_6d_from_matrix(true.rotation)
    codes = [{ROTATION_6D: rotation[:, None], TRANSLATION: size * true.position[:, None]} for size in diameter_m]
    wanted = torch.tensor([1, 0])
    both = {name: torch.cat([codes[slot][name] for slot in wanted], dim=1) for name in codes[0]}
    found = several.of_objects(images, matrix(world), both, diameter_m[wanted], wanted)
    for place, slot in enumerate(wanted.tolist()):
        alone, _ = (outline, other)[slot].of_code(images, matrix(world), codes[slot], float(diameter_m[slot]))
        for name, values in alone.items():
            torch.testing.assert_close(found[name][:, place], values[:, 0], atol=1e-4, rtol=1e-4)


@contextmanager
def one_round() -> Iterator[None]:
    """Four take long to trace."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(outline_alignment, "_REACHES_PX", (6.0,))
        yield


class Alone(torch.nn.Module):
    """A graph that is nothing but the alignment of a pose that is nearly always the same."""

    def __init__(self, outline: OutlineAlignment, matrix: torch.Tensor, start: OutlinePose, diameter_m: float) -> None:
        super().__init__()
        self._outline, self._diameter_m = outline, diameter_m
        self.register_buffer("_matrix", matrix)
        self.register_buffer("_rotation", rotation_6d_from_matrix(start.rotation))
        self.register_buffer("_position_m", start.position * diameter_m)

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, ...]:
        pixels = pixels_of(image)
        little = 1e-6 * pixels.mean(dim=(1, 2, 3))[:, None, None]  # a pose that depends on nothing would be a constant
        pose = (values + little for values in (self._rotation, self._position_m))
        code = dict(zip((ROTATION_6D, TRANSLATION), pose, strict=True))
        aligned, tensors = self._outline.of_code(pixels, self._matrix, code, self._diameter_m)
        return (*aligned.values(), *tensors.values())


@pytest.fixture(scope="module")
def stage(
    world: TwoStageWorld, outline: OutlineAlignment, scenes: tuple[torch.Tensor, OutlinePose]
) -> tuple[OutlineStage, bytes, OutlineStageNote]:
    """The alignment as serving cuts it out of a graph."""
    names = [*outline_stage.INPUTS, *outline_stage.OUTPUTS]
    start, diameter_m = OutlinePose(*(values[:1] for values in scenes[1])), world.object.kind.diameter_m
    graph = Alone(outline, matrix(world), start, diameter_m).eval()
    with one_round():
        data = to_onnx(graph, 640, 480, [ROTATION_6D, TRANSLATION, *names]).SerializeToString()
    note = outline.note({name: name for name in names}, diameter_m)
    return OutlineStage(data, note, "brick.onnx", ("CPUExecutionProvider",)), data, note


@torch.no_grad()
def test_the_alignment_alone_moves_poses_as_the_network_does(
    world: TwoStageWorld,
    outline: OutlineAlignment,
    scenes: tuple[torch.Tensor, OutlinePose],
    stage: tuple[OutlineStage, bytes, OutlineStageNote],
) -> None:
    diameter_m, camera = world.object.kind.diameter_m, PinholeCamera(np.asarray(world.camera.matrix))
    images, true = scenes
    start = OutlinePose(turn(torch.tensor([[0.03, -0.03, 0.02]])) @ true.rotation, 1.02 * true.position)
    with one_round():
        expected = aligned(outline, images, matrix(world), start)
    gaps, moves = [], []
    for number, image in enumerate(images):
        pixels = (image.permute(1, 2, 0) * 255).round().byte().numpy()
        read = pose_read(start.rotation[number], diameter_m * start.position[number])
        found = stage[0].aligned(pixels, camera, read, camera.focal_lengths[0])
        assert found.confidence == read.confidence
        gaps.append(np.linalg.norm(found.translation_m - diameter_m * expected.position[number].numpy()))
        moves.append(np.linalg.norm(found.translation_m - read.translation_m))
        assert np.allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-5)
    assert max(gaps) < 0.05 * np.median(moves), "crops' pixels are rounded, and sampled by OpenCV"


def test_a_pose_behind_the_camera_stays(stage: tuple[OutlineStage, bytes, OutlineStageNote]) -> None:
    read = pose_read(torch.eye(3), torch.tensor([0.0, 0.1, -0.5]))
    camera = PinholeCamera(np.diag([572.4, 572.4, 1.0]))
    assert stage[0].aligned(np.zeros((480, 640, 3), np.uint8), camera, read, 572.4) is read


def test_a_pose_that_is_not_finite_is_an_error(stage: tuple[OutlineStage, bytes, OutlineStageNote]) -> None:
    read = pose_read(torch.full((3, 3), math.nan), torch.tensor([0.0, 0.1, 0.5]))
    camera = PinholeCamera(np.diag([572.4, 572.4, 1.0]))
    with pytest.raises(InternalError, match="not finite"):
        stage[0].aligned(np.zeros((480, 640, 3), np.uint8), camera, read, 572.4)


def test_a_note_of_tensors_that_are_not_there_is_refused(stage: tuple[OutlineStage, bytes, OutlineStageNote]) -> None:
    _, data, note = stage
    wrong = dataclasses.replace(note, tensors={**note.tensors, "crops": "image_of_nothing"})
    expected = r"curio\.outline_stage: .* depend on .*, which is none of its inputs \(image_of_nothing"
    with pytest.raises(ModelError, match=expected):
        OutlineStage(data, wrong, "brick.onnx", ())


def pose_read(rotation: torch.Tensor, position_m: torch.Tensor) -> CropPose:
    return CropPose(position_m.numpy(), rotation.numpy(), 0.5, np.eye(3), 0.01, np.ones(3))


def test_outlines_are_drawn_anew_and_not_taken_from_another_network(world: TwoStageWorld, tmp_path: Path) -> None:
    config, path = RunConfig(CirclesOptions(), method="sleep"), tmp_path / "run"

    def begun(of: TwoStageWorld, init: Path | None) -> TwoStageNetwork:
        state = TrainState(config, of, torch.device("cpu"))
        if init is None:
            assert isinstance(state.pose.network, TwoStageNetwork)
            fill_outline(state.pose.network, of)
            run = RunFolder(path, config)
            run.write_config(new=True)
            run.save(state)
        else:
            begin_with(state, init)
        assert isinstance(state.pose.network, TwoStageNetwork)
        return state.pose.network

    trained = begun(world, None)
    with_outline, without = begun(world, path), begun(TwoStageWorld("linemod", world.object), path)
    assert trained.outline is not None
    assert with_outline.outline is not None
    assert without.outline is None
    assert trained.outline.points.any()
    assert not with_outline.outline.points.any()
    for name, value in without.state_dict().items():
        assert torch.equal(value, trained.state_dict()[name])
        assert torch.equal(value, with_outline.state_dict()[name])


def test_steps_are_solved_and_turned() -> None:
    random = np.random.default_rng(0)
    root = random.normal(size=(4, 6, 6))
    positive, right = (
        torch.from_numpy(root @ root.transpose(0, 2, 1) + np.eye(6)),
        torch.from_numpy(random.normal(size=(4, 6))),
    )
    torch.testing.assert_close((positive @ solve(positive, right)[..., None])[..., 0], right)
    vector = torch.tensor([[0.0, 0.1, 0.0]], dtype=torch.float64)
    expected = torch.tensor([[[math.cos(0.1), 0, math.sin(0.1)], [0, 1, 0], [-math.sin(0.1), 0, math.cos(0.1)]]])
    torch.testing.assert_close(turn(vector).float(), expected, atol=2e-4, rtol=0)
