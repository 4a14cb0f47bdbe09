"""The five worlds of meshes: statistics, views, gradients, image sets, export frames, and that every method learns."""

import copy
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from curio_train.config import METHODS, ConvStack, MethodName, NetworkConfig, Recipe, RunConfig
from curio_train.errors import DataError
from curio_train.geometry import matrix_from_yaw
from curio_train.learning.parallel import Ranks
from curio_train.learning.trainer import Trainer
from curio_train.metrics.assignment import scene_error
from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION, YAW
from curio_train.worlds import WORLDS, build
from curio_train.worlds.generated.mesh_world import MeshWorld
from curio_train.worlds.image_sets import StoredImages
from torch import Tensor

NAMES = ("spheres", "chairs", "varied", "multi", "light")
SLOTS = {"spheres": 3, "chairs": 5, "varied": 5, "multi": 8, "light": 10}
THIN = NetworkConfig(
    encoder=ConvStack((8, 16, 16, 32, 32), (11, 5, 3, 3, 3), (4, 2, 2, 2, 2), (0, 1, 1, 1, 0)),
    critic=ConvStack((8, 8, 16, 16, 1), (11, 5, 3, 3, 3), (4, 4, 2, 2, 2), (0, 0, 1, 1, 1)),
)
FAST = Recipe(
    batch_size=6,
    micro_batch_size=6,
    learning_rate=6e-3,
    critic_learning_rate=1e-4,
    critic_weight=0.1,
    sleep_weight=0.1,
    sleep_drawn=1.0,
)
TRAINED = [name for name, terms in METHODS.items() if not (terms.templates or terms.hypotheses)]


@pytest.fixture(scope="module")
def worlds() -> dict[str, MeshWorld]:
    return {name: build(WORLDS[name]()) for name in NAMES}


@pytest.fixture(params=NAMES)
def world(request: pytest.FixtureRequest, worlds: dict[str, MeshWorld]) -> MeshWorld:
    return worlds[request.param]


def footprint_radii(world: MeshWorld) -> np.ndarray:
    """Of each slot, measured anew: how far its mesh reaches from the axis it turns about, or from its centre."""
    axes = [0, 2] if YAW in world.layout else [0, 1, 2]
    radii = [np.linalg.norm(kind.mesh.vertices_m[:, axes], axis=1).max() for kind in world.kinds]
    return np.repeat(radii, [kind.num_slots for kind in world.kinds])


def pixels_of(world: MeshWorld, code: dict[str, Tensor], novel: bool) -> np.ndarray:
    """Where all vertices of all objects project to, [num, 2]."""
    pose = world.setup.novel_cam_from_world if novel else world.setup.cam_from_world
    found = []
    meshes = np.repeat(np.array(world.kinds, dtype=object), [kind.num_slots for kind in world.kinds])
    turns = (
        matrix_from_yaw(code[YAW]).numpy() if YAW in code else np.tile(np.eye(3), (*code[TRANSLATION].shape[:2], 1, 1))
    )
    for slot, kind in enumerate(meshes):
        own = np.einsum("bij,nj->bni", turns[:, slot], kind.mesh.vertices_m) + code[TRANSLATION][:, slot, None].numpy()
        projected = (pose.apply(own)) @ world.camera.matrix.T
        found.append((projected[..., :2] / projected[..., 2:]).reshape(-1, 2))
    return np.concatenate(found)


def test_slots_and_fields_are_the_papers(world: MeshWorld) -> None:
    code = world.sample(4, (0,))
    world.layout.check(code)
    assert world.layout.num_slots == SLOTS[world.name]
    assert sorted(slot for kind in world.objects for slot in kind.slots) == list(range(world.layout.num_slots))
    assert (COLOR in world.layout) == (world.name != "chairs")
    assert (YAW in world.layout) == (world.name in ("chairs", "multi", "light"))
    assert (CONFIDENCE in world.layout) == (world.name in ("varied", "light"))
    assert (LIGHT in world.layout) == (world.name == "light")


def test_slots_of_a_shape_stand_together(worlds: dict[str, MeshWorld]) -> None:
    assert {kind.name: kind.slots for kind in worlds["multi"].objects} == {
        "W": (0, 1), "X": (2, 3), "Y": (4, 5), "Z": (6, 7)
    }  # fmt: skip
    assert {kind.name: kind.slots for kind in worlds["light"].objects} == {
        "capsule": (0, 1, 2, 3), "box": (4, 5, 6), "cone": (7, 8, 9)
    }  # fmt: skip


def test_draws_fill_their_ranges_and_are_repeatable(world: MeshWorld) -> None:
    code = world.sample(1000, (7,))
    for field in world.layout.fields:
        lower, upper = torch.tensor(field.lower), torch.tensor(field.upper)
        values = code[field.name].flatten(0, -2)
        assert (values >= lower - 1e-6).all()
        assert (values <= upper + 1e-6).all()
        if field.name in (TRANSLATION, YAW, CONFIDENCE):
            assert torch.allclose(values.amin(0), lower, atol=0.01)
            assert torch.allclose(values.amax(0), upper, atol=0.01)
    again, other = world.sample(1000, (7,)), world.sample(1000, (8,))
    assert all(torch.equal(code[name], again[name]) for name in code)
    assert not torch.equal(code[TRANSLATION], other[TRANSLATION])


def test_no_two_objects_of_a_scene_intersect(world: MeshWorld) -> None:
    code = world.sample(500, (3,))
    distance = torch.cdist(code[TRANSLATION], code[TRANSLATION]).numpy()
    radii = footprint_radii(world)
    apart = radii[:, None] + radii[None, :]
    np.fill_diagonal(apart, 0)
    assert (distance >= apart - 1e-5).all()


@pytest.mark.parametrize(("name", "fewest", "most"), [("varied", 2, 5), ("light", 2, 10)])
def test_every_number_of_objects_is_as_likely(worlds: dict[str, MeshWorld], name: str, fewest: int, most: int) -> None:
    confidence = worlds[name].sample(5000, (1,))[CONFIDENCE][..., 0]
    assert set(confidence.unique().tolist()) == {0.0, 1.0}
    numbers = np.bincount(confidence.sum(1).long().numpy(), minlength=most + 1)
    assert numbers[:fewest].sum() == 0
    assert numbers[fewest:] / 5000 == pytest.approx(1 / (most - fewest + 1), abs=0.03)
    assert confidence.mean(0).numpy() == pytest.approx((fewest + most) / 2 / most, abs=0.03)  # no slot is preferred


def test_suns_stand_between_30_and_80_degrees_on_all_sides(worlds: dict[str, MeshWorld]) -> None:
    world = worlds["light"]
    sun = world.setup.light(world.sample(4000, (2,)))
    length = sun.norm(dim=1)
    assert length.numpy() == pytest.approx(0.7, abs=1e-5)
    height = (sun[:, 1] / length).numpy()
    assert np.degrees(np.arcsin(height)).min() == pytest.approx(30, abs=0.2)
    assert np.degrees(np.arcsin(height)).max() == pytest.approx(80, abs=0.2)
    assert height.mean() == pytest.approx((np.sin(np.radians(30)) + np.sin(np.radians(80))) / 2, abs=0.01)
    assert sun[:, [0, 2]].mean(0).abs().max() < 0.03


def test_every_object_is_whole_in_both_views(world: MeshWorld) -> None:
    code = world.sample(300, (5,))
    for novel in (False, True):
        pixels = pixels_of(world, code, novel)
        assert pixels.min() > 0
        assert pixels.max() < 127


def test_objects_on_the_ground_throw_shadows(worlds: dict[str, MeshWorld]) -> None:
    """Where an object is moved out of the picture its shadow goes, too."""
    world = worlds["chairs"]
    code = world.sample(4, (0,))
    with torch.no_grad():
        image, ground = world.render(code), world.render({**code, TRANSLATION: code[TRANSLATION] + 1000})
    grey = (image.amax(1) - image.amin(1)) < 1e-3  # the chairs are brown
    darker = (ground - image).amin(1) > 0.1
    assert (grey & darker).flatten(1).sum(1).min() > 20


def test_hidden_objects_leave_no_trace(worlds: dict[str, MeshWorld]) -> None:
    for name in ("varied", "light"):
        world = worlds[name]
        code = world.sample(4, (0,))
        moved = {**code, COLOR: torch.where(code[CONFIDENCE] > 0, code[COLOR], 1 - code[COLOR])}
        assert torch.allclose(world.render(code), world.render(moved), atol=1e-6)
        empty = world.render({**code, CONFIDENCE: torch.zeros_like(code[CONFIDENCE])})
        assert torch.allclose(empty, world.render({**code, TRANSLATION: code[TRANSLATION] + 1000}), atol=1e-6)


def test_novel_view_is_from_the_side(worlds: dict[str, MeshWorld]) -> None:
    world = worlds["spheres"]
    code = world.sample(1, (0,))
    # Right of the middle, and high: from 90° round it is as high, and in the middle, nearer or farther than the centre.
    code[TRANSLATION] = torch.tensor([[[0.6, -0.4, 3.0], [0.0, 9.0, 3.0], [0.0, 9.0, 3.0]]])
    for view, column in ((world.render(code), 0.6), (world.novel_view(code), 0.0)):
        rows, columns = torch.nonzero(view[0].amax(0) > 0.02, as_tuple=True)
        assert columns.float().mean().item() == pytest.approx(63.5 + 148 * column / 3, abs=1)
        assert rows.float().mean().item() < 63.5
    turned = world.setup.novel_cam_from_world.rotation @ world.setup.cam_from_world.rotation.T
    assert np.degrees(np.arccos((np.trace(turned) - 1) / 2)) == pytest.approx(90)


@pytest.mark.parametrize("name", ["chairs", "multi", "light"])
def test_novel_camera_stands_as_high_and_as_far_and_looks_at_the_same_place(
    worlds: dict[str, MeshWorld], name: str
) -> None:
    stage = worlds[name].setup
    eyes = [-pose.rotation.T @ pose.translation_m for pose in (stage.cam_from_world, stage.novel_cam_from_world)]
    assert eyes[0][1] == pytest.approx(eyes[1][1])
    assert eyes[0][[0, 2]] @ eyes[1][[0, 2]] == pytest.approx(0, abs=1e-9)
    assert np.linalg.norm(eyes[0]) == pytest.approx(np.linalg.norm(eyes[1]))
    axis = [
        pose.rotation @ [0, 0.15, 0] + pose.translation_m for pose in (stage.cam_from_world, stage.novel_cam_from_world)
    ]
    assert axis == [pytest.approx([0, 0, 4], abs=1e-9)] * 2


def test_image_gradients_reach_every_field(world: MeshWorld) -> None:
    code = {name: value.clone().requires_grad_() for name, value in world.sample(2, (4,)).items()}
    target = world.render(world.sample(2, (5,)))
    (world.render(code) - target).square().sum().backward()
    for name, value in code.items():
        assert value.grad.isfinite().all()
        assert value.grad.abs().max() > 0, name


@pytest.mark.parametrize("name", NAMES)
def test_export_and_back(worlds: dict[str, MeshWorld], name: str) -> None:
    world = worlds[name]
    code = world.sample(5, (6,))
    outputs = world.outputs.from_code(code)
    back = world.outputs.to_code(outputs)
    for field in world.layout.fields:
        assert torch.allclose(back[field.name], code[field.name], atol=1e-5), field.name
    assert set(outputs) - {"rotation"} == {field.name for field in world.outputs.fields}
    for field in world.outputs.fields:
        if field.lower:
            values = outputs[field.name].reshape(-1, field.size)
            assert (values >= torch.tensor(field.lower) - 1e-5).all()
            assert (values <= torch.tensor(field.upper) + 1e-5).all()


@pytest.mark.parametrize("name", ["chairs", "multi", "light"])
def test_exported_poses_are_what_the_camera_sees(worlds: dict[str, MeshWorld], name: str) -> None:
    world = worlds[name]
    code = world.sample(3, (9,))
    outputs = world.outputs.from_code(code)
    assert torch.allclose(outputs[ROTATION_6D][..., :3], outputs["rotation"][..., 0])
    by_export, by_world = [], pixels_of(world, code, novel=False)
    slots = [kind for kind in world.kinds for _ in range(kind.num_slots)]
    for slot, kind in enumerate(slots):
        rotation, shift = outputs["rotation"][:, slot].numpy(), outputs[TRANSLATION][:, slot].numpy()
        projected = (np.einsum("bij,nj->bni", rotation, kind.mesh.vertices_m) + shift[:, None]) @ world.camera.matrix.T
        by_export.append((projected[..., :2] / projected[..., 2:]).reshape(-1, 2))
    assert np.concatenate(by_export) == pytest.approx(by_world, abs=1e-3)
    if name == "light":
        turn = torch.from_numpy(world.setup.cam_from_world.rotation).float()
        assert torch.allclose(outputs[LIGHT], world.setup.light(code) @ turn.T, atol=1e-6)
        assert (outputs[LIGHT] @ turn)[:, 1].min() > 0


@pytest.mark.usefixtures("small_image_sets")
@pytest.mark.parametrize("name", NAMES)
def test_without_codes_the_label_file_is_not_opened(worlds: dict[str, MeshWorld], name: str, tmp_path: Path) -> None:
    world = worlds[name]
    labelled = world.source("test", 0, with_code=True, cache=tmp_path)
    assert len(labelled) == 50
    again = world.render(labelled.code)  # as drawn: all at once, jittered alike
    assert (labelled.batch(0, 50).images - again).abs().max() <= 0.5 / 255 + 1e-6
    (labels,) = tmp_path.glob(f"{name}-*/test.codes.npz")
    labels.write_bytes(b"unreadable")
    unlabelled = world.source("test", 0, with_code=False, cache=tmp_path).batch(0, 2)
    assert unlabelled.code is None
    assert torch.equal(unlabelled.images, labelled.batch(0, 2).images)
    with pytest.raises(DataError, match=r"test\.codes\.npz is damaged"):
        world.source("test", 0, with_code=True, cache=tmp_path)


@pytest.mark.parametrize("method", TRAINED)
@pytest.mark.parametrize("name", NAMES)
def test_every_method_learns_a_fixed_batch(worlds: dict[str, MeshWorld], name: str, method: MethodName) -> None:
    world = worlds[name]
    config = RunConfig(WORLDS[name](), method=method, recipe=FAST, network=THIN)
    with torch.no_grad():
        code = world.sample(FAST.batch_size, (3,))
        images = (world.render(code) * 255).round().byte()
    source = StoredImages(images, code if method == "super" else None, seed=0, shuffle=False)
    trainer = Trainer(config, world, [source], Ranks(0, 1, torch.device("cpu")))
    # Sleep dreams of other codes at every step, and their mean error varies: it is judged by the same ones throughout.
    judge = reading_error(world, trainer) if method == "sleep" else None

    before = judge() if judge else 0.0
    rows = [trainer.step(1.0) for _ in range(20 if judge else 10)]
    assert all(math.isfinite(value) for row in rows for value in row.values())
    if judge:
        assert judge() < 0.98 * before
    else:
        term = "label" if method == "super" else "image"
        assert max(row[term] for row in rows[-2:]) < 0.995 * rows[0][term]


@torch.no_grad()
def reading_error(world: MeshWorld, trainer: Trainer) -> Callable[[], float]:
    """How far off a trainer's network reads 48 renderings, always the same; Eq. 1."""
    code = world.sample(48, (4,))
    images = world.render(code)
    groups = tuple(kind.slots for kind in world.objects)

    @torch.no_grad()
    def error() -> float:
        network = copy.deepcopy(trainer.state.stages[0])  # normalises by this batch, and the statistics of runs stay
        return scene_error(world.layout, network(images), code, groups).mean().item()

    return error
