"""Templates learn how an object looks from photographs whose poses are known, and these calibrate confidence."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
from curio_serve.imaging.virtual_cameras import VIRTUAL_CAMERAS
from curio_train.camera import Intrinsics
from curio_train.config import NetworkConfig
from curio_train.data.backgrounds import ClutterBackgrounds
from curio_train.export.onnx import Tracing, to_onnx
from curio_train.export.stages import tracing_of
from curio_train.geometry import Pose, rotation_6d_from_matrix
from curio_train.learning.self_training import SelfTraining
from curio_train.meshes.shapes import chair
from curio_train.networks import outline_alignment
from curio_train.networks.crop_camera import cut_crops
from curio_train.networks.outline_alignment import OutlineAlignment
from curio_train.networks.several_objects.network import ObjectsNetwork
from curio_train.networks.templates import geometry as template_geometry
from curio_train.networks.templates.alignment import Aligned, FeatureMaps, align
from curio_train.networks.templates.bank import COARSE_SIZE, NUM_OUTLINE_POINTS, NUM_POINTS, RANK, Bank
from curio_train.networks.templates.descriptors import Descriptors
from curio_train.networks.templates.geometry import CROP_PX, FILL, NUM_ROLLS, num_views
from curio_train.networks.templates.trunk import COARSE_STRIDE, COARSE_WIDTH, FINE_WIDTH, Trunk
from curio_train.refinement.agreeing_reads import NUM_READS_BY_TEMPLATES
from curio_train.refinement.photographed_confidence import (
    Evidence,
    calibrate_by,
    read_by_others,
)
from curio_train.refinement.scene_labels import SceneLabels
from curio_train.scene_code import CONFIDENCE, ROTATION_6D, TRANSLATION, poses
from curio_train.templates.outline import outlines
from curio_train.templates.photographed import learn_appearance
from curio_train.worlds.base import ObjectKind
from curio_train.worlds.several_objects import confidence as confidence_of_several
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object.world import Object
from scipy.spatial.transform import Rotation

K = np.array([[572.4, 0, 325.3], [0, 573.6, 242.0], [0, 0, 1]])
MESH = chair(0.2)
VIEW, ROLL = 150, 2  # of the template that the photograph shows
DISTANCE_M = 0.8


@pytest.fixture(scope="module")
def world() -> SeveralObjectsWorld:
    kinds = [ObjectKind(f"chair-{n}", (n,), MESH.diameter_m, MESH.box_corners_m, MESH.sha256) for n in range(2)]
    pool = np.full((2, 480, 640, 3), 128, np.uint8)
    camera = Intrinsics(K, 640, 480)
    members = [Object(kind, MESH, camera, 0.5, 1.5, lambda _: ClutterBackgrounds(pool)) for kind in kinds]
    return SeveralObjectsWorld("linemod", members)


def with_random_templates(world: SeveralObjectsWorld) -> ObjectsNetwork:
    network = world.assemble([stage.network(NetworkConfig()) for stage in world.stages])
    assert isinstance(network, ObjectsNetwork)
    network.locator.trunk.load_state_dict(Trunk.pretrained().state_dict())
    random, cells = torch.Generator().manual_seed(0), CROP_PX // COARSE_STRIDE
    views = num_views(any_side=False)
    num = views * NUM_ROLLS
    for slot in range(2):
        network.reader.banks.put(
            slot,
            Bank(
                Descriptors(COARSE_WIDTH, COARSE_SIZE),
                Descriptors(FINE_WIDTH, FINE_WIDTH),
                torch.randn(RANK, COARSE_SIZE, cells, cells, generator=random) * 0.05,
                torch.randn(num, RANK, generator=random) * 0.05,
                (torch.rand(num, NUM_POINTS, 3, generator=random) - 0.5) * 0.5,
                torch.nn.functional.normalize(torch.randn(num, NUM_POINTS, FINE_WIDTH, generator=random), dim=2),
                torch.randn(views, NUM_OUTLINE_POINTS, 3, generator=random) * 0.3,
                torch.nn.functional.normalize(torch.randn(views, NUM_OUTLINE_POINTS, 3, generator=random), dim=2),
            ),
        )
    return network.eval()


@torch.no_grad()
def agreement(network: ObjectsNetwork, frame: torch.Tensor, pose: Pose) -> tuple[float, float]:
    """Mean cosine with what the photograph shows of its template's surface points, and of the whole template."""
    number, position_m = VIEW * NUM_ROLLS + ROLL, torch.from_numpy(pose.translation_m[0]).float()
    banks = network.reader.banks
    focal_px = torch.tensor([FILL * CROP_PX * float(position_m.norm()) / MESH.diameter_m])
    crop, _ = cut_crops(
        frame[None].float() / 255, torch.from_numpy(K).float(), position_m[None, None], focal_px, CROP_PX, 1
    )
    fine, coarse = network.locator.trunk(crop)
    start = Aligned(banks.rotations[number][None], position_m[None] / MESH.diameter_m, torch.zeros(1))
    slot = torch.tensor([0])
    shown = banks.surface(torch.tensor([[number]]), slot)
    found = align(FeatureMaps.of(banks.fine(fine, slot, 1)), slot, *shown, start, focal_px, 0)
    both = coarse[:, None, None].expand(-1, 2, -1, -1, -1, -1)
    return float(found.score), float(banks.match(both, torch.arange(2))[0, 0, 0, number, 0])


def test_what_a_photograph_shows_is_learned_and_the_rest_stays(world: SeveralObjectsWorld) -> None:
    network = with_random_templates(world)
    banks = network.reader.banks
    rough = torch.rand(1, 3, 60, 80, generator=torch.Generator().manual_seed(1))
    smooth = torch.nn.functional.interpolate(rough, (480, 640), mode="bicubic").clamp(0, 1)
    frames = (255 * smooth).byte().expand(2, -1, -1, -1)
    shown = banks.rotations[VIEW * NUM_ROLLS + ROLL].double().numpy()
    # One photograph shows it on the optical axis; where it is in the other nobody knows.
    rotation, position_m = np.full((2, 3, 3), np.nan), np.full((2, 3), np.nan)
    rotation[0], position_m[0] = shown, [0, 0, DISTANCE_M]
    unknown = Pose(np.full((2, 3, 3), np.nan), np.full((2, 3), np.nan))
    pose = Pose(rotation, position_m)

    every = torch.arange(len(banks.rotations))[None], torch.tensor([0])
    _, described = banks.surface(*every)
    before, other = agreement(network, frames[0], pose), banks.codes[1].clone()
    learn_appearance(network, frames, [pose, unknown])
    after = agreement(network, frames[0], pose)
    assert after[0] > before[0] + 0.2
    assert after[1] > before[1] + 0.1
    assert torch.equal(banks.codes[1], other), "nothing is known of the other object"

    outside = {name: value.clone() for name, value in banks.state_dict().items()}
    for place_m in ([0.8, 0.04, 0.35], [0.0, 0.0, -DISTANCE_M]):  # beside the frame, behind the camera
        learn_appearance(network, frames[:1], [Pose(rotation[:1], np.array([place_m])), unknown])
        assert all(torch.equal(value, outside[name]) for name, value in banks.state_dict().items())

    directions = banks.rotations[:, 2]
    far = directions @ directions[VIEW * NUM_ROLLS] < 0.9
    kept = torch.nn.functional.cosine_similarity(banks.surface(*every)[1][far], described[far], dim=2)
    assert float(kept.mean()) > 0.8, "codewords are chosen anew, which costs a little"


def test_a_network_that_looks_less_reads_each_frame_alone_as_among_others(world: SeveralObjectsWorld) -> None:
    network = with_random_templates(world)
    images = torch.rand(2, 3, 480, 640, generator=torch.Generator().manual_seed(3))
    with torch.no_grad():
        thorough = network(images)
        network.look_less()
        both, alone = network(images), network(images[1:])
    for name, values in both.items():
        assert values.isfinite().all()
        torch.testing.assert_close(values[1:], alone[name], atol=1e-3, rtol=1e-3)
    assert not torch.equal(both["translation_m"], thorough["translation_m"])


class _Graph(torch.nn.Module):
    """The network with a camera's pixels and the wanted slots as its inputs, as an export has them."""

    def __init__(self, network: ObjectsNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: torch.Tensor, slots: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return tuple(self.network(image.permute(0, 3, 1, 2).float() / 255, slots).values())


def chair_outlines(network: ObjectsNetwork) -> OutlineAlignment:
    """The chair's for the first object; the second one's turns the other way."""
    found, geometry = OutlineAlignment(num_views(any_side=False), 2), network.geometries[0]
    points, outward = outlines(MESH, geometry, outline_alignment.NUM_POINTS)
    for slot, sign in enumerate((1, -1)):
        found.put(sign * geometry.outline_rotations[:, 2], sign * points, sign * outward, slot)
    return found


def test_the_exported_graph_equals_torch_whichever_objects_are_asked_for(
    world: SeveralObjectsWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outline_alignment, "_REACHES_PX", (6.0,))  # four rounds take long to trace
    # With 220 each image is compared with 1,540 templates; with half of 48 the confidence hangs on rounding.
    monkeypatch.setattr(template_geometry, "NUM_VIEWS", 48)
    network = with_random_templates(world)
    network.outline = chair_outlines(network)
    network.look_less()
    network.reader.effort = network.reader.effort._replace(hypotheses=2, steps=(0, 1, 1))  # more take long to trace
    graph, names = _Graph(network).eval(), ["translation_m", "rotation_6d", "light", "confidence", "presence"]
    assert tracing_of(network) == Tracing(one_image=True, num_slots=2)
    session = onnxruntime.InferenceSession(to_onnx(graph, 640, 480, names, tracing_of(network)).SerializeToString())
    coarse = torch.rand(3, 3, 60, 80, generator=torch.Generator().manual_seed(2))
    smooth = torch.nn.functional.interpolate(coarse, (480, 640), mode="bicubic").clamp(0, 1)
    images = (255 * smooth).round().byte().permute(0, 2, 3, 1).contiguous()
    for batch, slots in ((3, None), (2, [0, 1]), (2, [1, 0]), (1, [0]), (2, [1])):
        given = {"image": images[:batch].numpy()} | ({} if slots is None else {"slots": np.array(slots)})
        with torch.no_grad():
            expected = dict(zip(names, graph(images[:batch], torch.tensor(slots or [0, 1])), strict=True))
        assert expected["translation_m"].shape == (batch, len(slots or [0, 1]), 3)
        for name, found in zip(names, session.run(names, given), strict=True):
            torch.testing.assert_close(torch.from_numpy(found), expected[name], atol=1e-3, rtol=1e-3)


def test_confidence_is_calibrated_by_photographs_that_agree_and_templates_stay(world: SeveralObjectsWorld) -> None:
    network = with_random_templates(world)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    frames = torch.randint(0, 255, (3, 3, 480, 640), dtype=torch.uint8, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        own = poses(network(frames[2:].float() / 255), 0)[0]
    # Only the third photograph has a label, and the other half, which reads it, learned from none: what is read agrees.
    rotation, position_m = np.full((3, 3, 3), np.nan), np.full((3, 3), np.nan)
    rotation[2], position_m[2] = own.rotation, own.translation_m
    unknown = Pose(np.full((3, 3, 3), np.nan), np.full((3, 3), np.nan))
    evidence = read_by_others(network, world, SceneLabels(world, frames, [Pose(rotation, position_m), unknown]))
    assert evidence.correct.tolist() == [[False, False], [False, False], [True, False]]
    assert np.isfinite(evidence.features).all()
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())

    calibrate_by(network, evidence)
    assert torch.equal(network.reader.pose_correct, before["reader.pose_correct"]), "too few to tell"
    random = np.random.default_rng(0)
    right, shown = random.random((90, 2)) < 0.4, random.random((90, 2)) < 0.7
    features = random.normal(size=(90, 2, 3))
    features[right, 0] += 3
    calibrate_by(network, Evidence(features, right & shown, shown))
    weights = network.reader.pose_correct.numpy()
    logits = (features * weights[:, :3]).sum(axis=2) + weights[:, 3]
    probability = network.reader.ceiling.numpy() / (1 + np.exp(-logits))
    assert ((probability > 0.5) == right).mean() > 0.85
    assert abs(probability.mean() - right.mean()) < 0.05, "what is not known is not taken as wrong"
    right[:45], features[:45] = random.random((45, 2)) < 0.6, features[:45] + 5
    calibrate_by(network, Evidence(features, right & shown, shown))
    assert network.reader.ceiling.numpy() == pytest.approx(0.7, abs=0.15), "not all poses that look best are right"


@pytest.mark.parametrize("by_heat_map", [False, True])
def test_the_heat_maps_alone_tell_presence_where_photographs_taught_them(
    world: SeveralObjectsWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, by_heat_map: bool
) -> None:
    monkeypatch.setattr(confidence_of_several, "NUM_FRAMES", 6)
    network = with_random_templates(world)
    network.look_less()
    confidence_of_several.calibrate(network, world, tmp_path, by_heat_map=by_heat_map)
    first, second = network.reader.presence
    assert (float(first[0]) == 0 == float(second[0])) == by_heat_map, "the weight of the templates' score"
    assert torch.equal(first, second) == by_heat_map, "one calibration for all objects"


@torch.no_grad()
def test_a_part_that_is_read_alike_often_is_calibrated_by_it(
    world: SeveralObjectsWorld, tmp_path: Path, greys: Callable[[int], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both reads of the first part agree in three of four photographs, those of the second one in none."""
    monkeypatch.setattr(confidence_of_several, "NUM_FRAMES", 6)
    network = with_random_templates(world)
    network.look_less()
    before = {name: value.clone() for name, value in network.reader.state_dict().items()}
    random, count = np.random.default_rng(1), 0

    def read(_network: object, _images: object, _output: object) -> dict[str, torch.Tensor]:
        nonlocal count
        number, virtual = count // NUM_READS_BY_TEMPLATES, VIRTUAL_CAMERAS[count % NUM_READS_BY_TEMPLATES]
        count += 1
        turned = Rotation.from_matrix(virtual.virtual_from_cam)
        wrong = Rotation.random(2, random_state=random)
        rotations = [wrong[0] if number % 4 == 0 else turned, wrong[1]]
        matrices = torch.from_numpy(np.stack([rotation.as_matrix() for rotation in rotations])).float()
        return {
            ROTATION_6D: rotation_6d_from_matrix(matrices)[None],
            TRANSLATION: torch.tensor([0.0, 0.0, 0.8 / virtual.zoom]).expand(1, 2, 3),
            CONFIDENCE: torch.full((1, 2, 1), 0.5),
        }

    hook = network.register_forward_hook(read)
    photographed = SeveralObjectsWorld("capture", world.members, greys(28), aligns_outlines=True)
    told = SelfTraining(network, photographed, 0.0, torch.device("cpu")).finish(tmp_path)
    assert told.splitlines() == [
        "chair-0: 21 of 28 photographs are read alike, which calibrates its confidence",
        "chair-1: 0 of 28 photographs are read alike, fewer than 20, so renderings calibrate its confidence; more "
        "photographs that show it help",
    ]
    hook.remove()
    after = network.reader.state_dict()
    assert after["presence_power"].tolist() == [0, 1], "of what is never read alike renderings tell the confidence"
    frames = torch.stack([torch.full((3, 480, 640), 9 * number / 255) for number in range(0, 28, 3)])
    confidence = torch.cat([network(frame[None])[CONFIDENCE] for frame in frames])
    assert abs(float(confidence[:, 0].mean()) - (0.75 * 28 + 1) / 30) < 0.05
    untouched = {name: value for name, value in after.items() if not name.startswith(("pose_correct", "presence"))}
    assert all(torch.equal(value, before[name]) for name, value in untouched.items())
