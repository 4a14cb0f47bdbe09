"""Refined poses: nearer to the truth where the picture shows the object, and left alone where it does not."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from curio_train.camera import Intrinsics
from curio_train.data.backgrounds import ClutterBackgrounds
from curio_train.data.bop import ModelInfo
from curio_train.errors import UsageError
from curio_train.evaluation.evaluate import evaluate
from curio_train.evaluation.scores import add_errors
from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix
from curio_train.meshes.meshes import Mesh
from curio_train.meshes.shapes import chair
from curio_train.refinement.crops import rotation_from_vector
from curio_train.refinement.inpainting import inpainted
from curio_train.refinement.predictions import with_refinement
from curio_train.refinement.render_and_compare import RenderAndCompare
from curio_train.refinement.template_poses import with_mean_depth
from curio_train.scene_code import CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION, SceneCode, of_slot, poses
from curio_train.worlds.base import ObjectKind
from curio_train.worlds.generated.circles import Circles
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.world import Object
from scipy.spatial.transform import Rotation
from torch import Tensor

K = np.array([[572.4, 0, 325.3], [0, 573.6, 242.0], [0, 0, 1]])
MESH = chair(0.12)
NUM = 6


@pytest.fixture(scope="module")
def world() -> TwoStageWorld:
    kind = ObjectKind("chair", (0,), MESH.diameter_m, MESH.box_corners_m, MESH.sha256)
    random = np.random.default_rng(3)
    pool = np.stack([cv2.resize(random.integers(0, 256, (24, 32, 3), np.uint8), (640, 480)) for _ in range(4)])
    return TwoStageWorld(
        "linemod", Object(kind, MESH, Intrinsics(K, 640, 480), 0.5, 1.0, lambda _: ClutterBackgrounds(pool))
    )


@pytest.fixture(scope="module")
def refinement(world: TwoStageWorld) -> RenderAndCompare:
    return RenderAndCompare.in_world(world)


@pytest.fixture(scope="module")
def scenes(world: TwoStageWorld) -> tuple[Tensor, Tensor, SceneCode]:
    """Pictures of the object in whole, the clutter behind it, and the truth."""
    code = world.sample(NUM, (1,))
    code[TRANSLATION][..., :2] *= 0.6
    behind = world.backgrounds(Path()).draw(NUM, 640, 480, (2,))
    images = [(picture.clamp(0, 1) * 255).round().byte() for picture in (world.render(code, behind), behind)]
    return images[0], images[1], code


def off(code: SceneCode) -> dict[str, Tensor]:
    """The code as a network might read it: 8 degrees, 4 % of the distance and some pixels beside the truth."""
    random = np.random.default_rng(5)
    axes = random.normal(size=(NUM, 3))
    turns = Rotation.from_rotvec(np.radians(8) * axes / np.linalg.norm(axes, axis=1, keepdims=True)).as_matrix()
    rotation = torch.from_numpy(turns).float() @ matrix_from_rotation_6d(code[ROTATION_6D][:, 0])
    scale = torch.from_numpy(random.choice([0.96, 1.04], (NUM, 1, 1))).float()
    shift = torch.tensor([0.005, -0.004, 0.0])
    read = {TRANSLATION: code[TRANSLATION] * scale + shift, ROTATION_6D: rotation_6d_from_matrix(rotation)[:, None]}
    return dict(code) | read | {LIGHT: code[LIGHT].roll(1, dims=0)}


def errors(found: SceneCode, true: SceneCode) -> np.ndarray:
    return np.array(add_errors(poses(found), poses(true), MESH.vertices_m, ModelInfo(MESH.diameter_m)))


def test_most_estimates_come_most_of_the_way_to_the_truth(
    refinement: RenderAndCompare, scenes: tuple[Tensor, Tensor, SceneCode]
) -> None:
    """One of six may end in another pose that explains as much: the search is a local one."""
    images, _, true = scenes
    estimate = off(true)
    found = refinement.refine(images, estimate).code
    before, after = errors(estimate, true), errors(found, true)
    assert before.min() > 0.1
    assert np.median(after) < 0.15 * np.median(before), (before, after)
    assert (after < before).sum() >= NUM - 1, (before, after)
    rotation = matrix_from_rotation_6d(found[ROTATION_6D][:, 0])
    assert torch.allclose(rotation @ rotation.transpose(1, 2), torch.eye(3).expand(NUM, 3, 3), atol=1e-5)
    assert all(torch.equal(found[name], estimate[name]) for name in estimate.keys() - {TRANSLATION, ROTATION_6D})


def test_objects_half_hidden_are_not_lost(
    refinement: RenderAndCompare, scenes: tuple[Tensor, Tensor, SceneCode]
) -> None:
    """The right half of each object behind something else: what cannot be explained hardly ever pulls it away."""
    images, behind, true = scenes
    place = true[TRANSLATION][:, 0]
    hidden = images.clone()
    for number, column in enumerate((K[0, 0] * place[:, 0] / place[:, 2] + K[0, 2] + 8).int().tolist()):
        hidden[number, :, :, column:] = behind[number].flip(1)[:, :, column:]
    estimate = off(true)
    before, after = errors(estimate, true), errors(refinement.refine(hidden, estimate).code, true)
    assert (after < before + 0.02).sum() >= NUM - 1, (before, after)


def test_where_there_is_nothing_estimates_stand(
    refinement: RenderAndCompare, scenes: tuple[Tensor, Tensor, SceneCode]
) -> None:
    _, behind, true = scenes
    estimate = off(true)
    flat = torch.full_like(behind, 128)
    for images in (behind, flat):
        found = refinement.refine(images, estimate).code
        assert all(torch.equal(found[name], estimate[name]) for name in estimate)


def test_objects_out_of_the_picture_give_numbers(
    refinement: RenderAndCompare, scenes: tuple[Tensor, Tensor, SceneCode]
) -> None:
    images, _, true = scenes
    lost = dict(true) | {TRANSLATION: true[TRANSLATION] + torch.tensor([3.0, 0.0, 0.0])}
    lost[TRANSLATION][0] = torch.tensor([0.0, 0.0, 1e-3])
    found = refinement.refine(images, lost).code
    assert all(value.isfinite().all() for value in found.values())


def test_hidden_pixels_continue_their_surroundings() -> None:
    ramp = torch.linspace(0, 1, 32).expand(1, 3, 32, 32).clone()
    hidden = torch.zeros(1, 1, 32, 32, dtype=torch.bool)
    hidden[..., 10:20, 12:22] = True
    filled = inpainted(torch.where(hidden, torch.full_like(ramp, 7.0), ramp), hidden)
    assert torch.equal(filled[..., :10, :], ramp[..., :10, :])
    assert (filled - ramp).abs().max() < 0.15


def test_rotations_of_vectors_are_scipys() -> None:
    vectors = torch.tensor([[0.3, -0.2, 0.5], [0.0, 0.0, 0.0], [1e-5, 0.0, 0.0]], requires_grad=True)
    found = rotation_from_vector(vectors)
    assert found.detach().numpy() == pytest.approx(Rotation.from_rotvec(vectors.detach().numpy()).as_matrix(), abs=1e-6)
    found[:, 0, 1].sum().backward()
    assert vectors.grad is not None
    assert vectors.grad.isfinite().all()
    assert vectors.grad[1, 2] == pytest.approx(-1, abs=1e-4)


def test_each_of_several_objects_is_refined_and_takes_the_mean_of_both_depths(world: TwoStageWorld) -> None:
    """Objects of LineMOD's world of several are read by templates."""
    bench = Mesh(MESH.vertices_m * [1.6, 0.7, 1.0], MESH.faces)
    members = [
        replace(world.object, kind=ObjectKind(name, (slot,), mesh.diameter_m, mesh.box_corners_m), mesh=mesh)
        for slot, (name, mesh) in enumerate({"chair": MESH, "bench": bench}.items())
    ]
    several = SeveralObjectsWorld("linemod", members)
    true = several.sample(2, (1,)) | {CONFIDENCE: torch.ones(2, 2, 1)}
    true[TRANSLATION] = torch.tensor([[[-0.12, 0.0, 0.65], [0.12, 0.02, 0.75]], [[0.1, 0.05, 0.8], [-0.1, 0.0, 0.7]]])
    behind = world.backgrounds(Path()).draw(2, 640, 480, (2,))
    images = (several.render(true, behind).clamp(0, 1) * 255).round().byte()
    estimate = true | {TRANSLATION: true[TRANSLATION] * 1.04 + torch.tensor([0.003, -0.002, 0.0])}
    found = with_refinement(lambda _: estimate, several, "sleep")(images)
    for slot, member in enumerate(members):
        alone = RenderAndCompare(member.mesh, several.camera, member.kind.diameter_m)
        refined, accepted, *_ = alone.refine(images, of_slot(estimate, slot))
        assert accepted.all()
        expected = (refined[TRANSLATION][..., 2:] * estimate[TRANSLATION][:, slot : slot + 1, 2:]).sqrt()
        expected = refined[TRANSLATION] * expected / refined[TRANSLATION][..., 2:]
        assert torch.allclose(found[TRANSLATION][:, slot : slot + 1], expected, atol=1e-3)
        turned = matrix_from_rotation_6d(found[ROTATION_6D][:, slot]) - matrix_from_rotation_6d(
            true[ROTATION_6D][:, slot]
        )
        assert turned.abs().max() < 0.05
    assert torch.equal(found[CONFIDENCE], true[CONFIDENCE])


def test_rejected_refinements_leave_depth_to_the_bit() -> None:
    code = {TRANSLATION: torch.rand(1000, 1, 3) + 0.1}
    assert torch.equal(with_mean_depth(code, code)[TRANSLATION], code[TRANSLATION])


def test_worlds_without_one_object_are_refused(tmp_path: Path, write_run) -> None:
    with pytest.raises(UsageError, match="--refine: world circles cannot be refined, expected objects in free"):
        RenderAndCompare.in_world(Circles())
    with pytest.raises(UsageError, match="--refine: world circles"):
        evaluate(write_run(tmp_path / "run"), refine=True, cache=tmp_path)
