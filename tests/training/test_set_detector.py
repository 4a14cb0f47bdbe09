"""The dense detector: between pixels and positions, how slots are filled, the loss of all cells."""

from pathlib import Path

import numpy as np
import pytest
import torch
from curio_train.config import NetworkConfig, Recipe, RunConfig
from curio_train.errors import UsageError
from curio_train.learning.parallel import Ranks
from curio_train.learning.trainer import Trainer
from curio_train.metrics.assignment import scene_error
from curio_train.networks.grid import STRIDE, CellGrid, per_cell
from curio_train.networks.set_detector import HEAT_MAP, dense_loss, fill_slots
from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, TRANSLATION, SceneCode, index
from curio_train.worlds import WORLDS, build
from curio_train.worlds.generated.mesh_world import MeshWorld
from curio_train.worlds.image_sets import StoredImages
from torch import Tensor

CELLS = NetworkConfig(reading="cells")
CPU = Ranks(0, 1, torch.device("cpu"))
FAST = Recipe(batch_size=16, micro_batch_size=16, learning_rate=2e-3, gradient_clip=10.0)


@pytest.fixture(scope="module")
def worlds() -> dict[str, MeshWorld]:
    return {name: build(WORLDS[name]()) for name in ("spheres", "varied", "light")}


def grid_of(world: MeshWorld) -> CellGrid:
    return world.network(CELLS).grid


def kinds_of(world: MeshWorld) -> list[tuple[int, ...]]:
    return [kind.slots for kind in world.objects]


def perfect_predictions(world: MeshWorld, code: SceneCode) -> tuple[Tensor, dict[str, Tensor]]:
    """A heat map, and values that are an object's own at the cells around it and far off elsewhere."""
    grid, kinds = grid_of(world), kinds_of(world)
    batch, cells = len(code[TRANSLATION]), len(grid.pixels)
    fields = [field for field in world.layout.fields if field.per_object and field.name != CONFIDENCE]
    heat = torch.zeros(batch, len(kinds), cells)
    values = {field.name: torch.full((batch, len(kinds), cells, field.size), 0.3) for field in fields}
    far = grid.locate(grid.pixels, torch.zeros(cells, 1))
    values[TRANSLATION] = far.expand(batch, len(kinds), cells, 3).clone()
    splat = grid.splat_weights(grid.project(code[TRANSLATION]))
    present = code[CONFIDENCE][..., 0] if CONFIDENCE in code else torch.ones(code[TRANSLATION].shape[:2])
    for image in range(batch):
        for kind, slots in enumerate(kinds):
            for slot in slots:
                if not present[image, slot]:
                    continue
                at = splat.cell[image, slot]
                heat[image, kind, at] += splat.weight[image, slot]
                for name, value in values.items():
                    value[image, kind, at] = code[name][image, slot]
    return heat, values


@pytest.mark.parametrize("name", ["spheres", "light"])
def test_positions_are_found_again_by_their_pixels(worlds: dict[str, MeshWorld], name: str) -> None:
    world = worlds[name]
    grid, position = grid_of(world), world.sample(50, (1,))[TRANSLATION]
    along = {"spheres": (position[..., 2:] - 3.0) / 0.7, "light": torch.zeros(50, position.shape[1], 1)}[name]
    assert torch.allclose(grid.locate(grid.project(position), along), position, atol=1e-4)


def test_rays_above_the_horizon_do_not_lead_out_of_the_world(worlds: dict[str, MeshWorld]) -> None:
    world = worlds["light"]
    grid, field = grid_of(world), world.layout[TRANSLATION]
    pixels = torch.tensor([[64.0, -500.0], [-900.0, -900.0]]).requires_grad_()
    found = grid.locate(pixels, torch.zeros(2, 1))
    assert found.abs().max() < 3.01 * max(field.upper)
    found.sum().backward()
    assert pixels.grad.isfinite().all()


def test_points_behind_the_camera_have_finite_pixels(worlds: dict[str, MeshWorld]) -> None:
    pixels = grid_of(worlds["spheres"]).project(torch.tensor([[0.0, 0, 0], [0.1, 0.1, -1.0]]))
    assert pixels.isfinite().all()


def test_a_point_is_splatted_onto_the_cells_around_it(worlds: dict[str, MeshWorld]) -> None:
    grid = grid_of(worlds["spheres"])
    pixels = torch.tensor([[16.0, 24.0], [18.0, 24.0], [20.0, 28.0], [-40.0, 400.0]])
    cell, weight = grid.splat_weights(pixels)
    assert torch.allclose(weight.sum(dim=-1), torch.ones(4))
    pairs = zip(cell.tolist(), weight.tolist(), strict=True)
    on_cell, beside, between, outside = (dict(zip(*pair, strict=True)) for pair in pairs)
    assert on_cell[3 * grid.columns + 2] == 1
    assert beside[3 * grid.columns + 2] == pytest.approx(1 - 2 / STRIDE)
    assert set(between.values()) == {0.25}
    assert outside[(grid.rows - 1) * grid.columns] == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("name", ["spheres", "varied", "light"])
def test_slots_are_filled_with_the_predictions_of_their_cells(worlds: dict[str, MeshWorld], name: str) -> None:
    world = worlds[name]
    code = world.sample(40, (2,))
    grid, kinds = grid_of(world), kinds_of(world)
    heat, values = perfect_predictions(world, code)
    # Objects of a kind that share cells overwrite each other in this construction: only the others are judged.
    pixels = grid.project(code[TRANSLATION])
    kind_of_slot = torch.cat([torch.full((len(slots),), number) for number, slots in enumerate(kinds)])
    pixels = pixels + 1e3 * kind_of_slot[:, None]
    if CONFIDENCE in code:
        pixels = pixels + 1e4 * (1 - code[CONFIDENCE]) * torch.arange(1.0, 1 + len(kind_of_slot))[:, None]
    near = torch.cdist(pixels, pixels) + 1e3 * torch.eye(pixels.shape[1])
    lone = near.flatten(1).amin(dim=1) > 3 * STRIDE
    assert lone.sum() >= 3
    found = fill_slots(grid, [len(slots) for slots in kinds], heat, values)
    read = {field: found.get(field, code[field]) for field in code}
    assert scene_error(world.layout, index(read, lone), index(code, lone), kinds).max() < 1e-2


def test_the_surest_object_comes_first_and_empty_slots_last(worlds: dict[str, MeshWorld]) -> None:
    grid = grid_of(worlds["varied"])
    heat, along = torch.zeros(1, 1, len(grid.pixels)), torch.zeros(len(grid.pixels), 1)
    heat[0, 0, 35], heat[0, 0, 130] = 0.4, 0.9
    values = {TRANSLATION: grid.locate(grid.pixels, along)[None, None]}
    found = fill_slots(grid, [3], heat, values)
    assert found[CONFIDENCE][0, :, 0].tolist() == pytest.approx([0.9, 0.4, 0.0], abs=1e-5)
    assert torch.allclose(found[TRANSLATION][0, :2], values[TRANSLATION][0, 0, [130, 35]], atol=1e-4)
    assert found[TRANSLATION].isfinite().all()


def test_two_things_in_neighbouring_cells_are_told_apart_by_where_those_put_them(worlds: dict[str, MeshWorld]) -> None:
    grid = grid_of(worlds["varied"])
    heat, along = torch.zeros(1, 1, len(grid.pixels)), torch.zeros(len(grid.pixels), 1)
    heat[0, 0, 100], heat[0, 0, 101] = 1.0, 1.0
    shift = torch.zeros_like(grid.pixels)
    shift[101, 0] = 3.0
    apart = {TRANSLATION: grid.locate(grid.pixels + shift, along)[None, None]}
    assert fill_slots(grid, [2], heat, apart)[CONFIDENCE][0, :, 0].tolist() == pytest.approx([1, 1], abs=1e-5)
    shift[101, 0] = -6.0
    together = {TRANSLATION: grid.locate(grid.pixels + shift, along)[None, None]}
    found = fill_slots(grid, [2], heat, together)
    assert found[CONFIDENCE][0, :, 0].tolist() == pytest.approx([1, 0], abs=1e-5)
    middle = grid.project(found[TRANSLATION])[0, 0] - grid.pixels[100]
    assert middle.tolist() == pytest.approx([1, 0], abs=1e-2)


def prediction(world: MeshWorld, code: SceneCode) -> dict[str, Tensor]:
    heat, values = perfect_predictions(world, code)
    of_scene = {field.name: code[field.name] for field in world.layout.fields if not field.per_object}
    logits = torch.logit(heat.clamp(1e-4, 1 - 1e-4))
    return {HEAT_MAP: logits, **{per_cell(name): value for name, value in values.items()}, **of_scene}


def test_dense_loss_is_least_at_the_truth(worlds: dict[str, MeshWorld]) -> None:
    world = worlds["light"]
    code = world.sample(6, (3,))
    grid, kinds = grid_of(world), kinds_of(world)

    def error(read: SceneCode) -> Tensor:
        return dense_loss(world.layout, kinds, grid, read, code, world.slot_infos)

    true = prediction(world, code)
    least = error(true)
    for name in (per_cell(TRANSLATION), per_cell(COLOR), LIGHT, HEAT_MAP):
        assert (error({**true, name: true[name] + 0.4}) > least + 0.05).all(), name


def test_absent_objects_teach_no_cell_anything(worlds: dict[str, MeshWorld]) -> None:
    world = worlds["varied"]
    code = world.sample(6, (4,))
    moved = dict(code) | {COLOR: torch.where(code[CONFIDENCE] > 0, code[COLOR], 1 - code[COLOR])}
    assert not torch.equal(moved[COLOR], code[COLOR])
    read, grid, kinds = prediction(world, code), grid_of(world), kinds_of(world)
    errors = [dense_loss(world.layout, kinds, grid, read, true, world.slot_infos) for true in (code, moved)]
    assert torch.equal(*errors)


@pytest.mark.parametrize("name", ["spheres", "light"])
@pytest.mark.parametrize("method", ["sleep", "super", "noncur", "our"])
def test_a_few_steps_of_every_method(worlds: dict[str, MeshWorld], name: str, method: str) -> None:
    world = worlds[name]
    config = RunConfig(WORLDS[name](), method=method, recipe=FAST, network=CELLS)
    with torch.no_grad():
        code = world.sample(16, (5,))
        images = world.render(code)
    stored = (images * 255).round().byte()
    source = StoredImages(stored, code if method == "super" else None, seed=0, shuffle=False)
    trainer = Trainer(config, world, [source], CPU)
    rows = [trainer.step(1.0) for _ in range(12)]
    term = {"sleep": "sleep", "super": "label"}.get(method, "image")
    means = [np.mean([row[term] for row in part]) for part in (rows[:3], rows[-3:])]
    assert np.isfinite(means).all()
    assert method == "our" or means[1] < means[0]  # curiosity may make images worse for a while
    assert world.layout.fields[0].name in trainer.state.pose.network(images[:2])


def test_image_loss_trains_the_heat_map_in_worlds_of_fixed_numbers(worlds: dict[str, MeshWorld]) -> None:
    world = worlds["spheres"]
    network = world.network(CELLS)
    images = world.render(world.sample(4, (6,)))
    code = network(images)
    world.render(code).sum().backward()
    heat_gradient = network.cells[-1].bias.grad.view(1, -1)[:, 0]
    assert heat_gradient.abs().min() > 0
    assert CONFIDENCE not in network.eval()(images)


def test_wake_sleep_of_the_dense_decoder_draws_from_the_range(worlds: dict[str, MeshWorld], tmp_path: Path) -> None:
    source = worlds["spheres"].source("test", 0, with_code=False, cache=tmp_path)
    recipe = Recipe(batch_size=4, micro_batch_size=4)
    config = RunConfig(WORLDS["spheres"](), method="wake_sleep", network=CELLS, recipe=recipe)
    trainer = Trainer(config, worlds["spheres"], [source], CPU)
    first = trainer.synthetic.take(0)[0]
    assert torch.equal(first[TRANSLATION], worlds["spheres"].sample(4, (config.seed, 0, 1))[TRANSLATION])
    assert set(trainer.step(1.0)) == {"image", "sleep"}


def test_worlds_without_the_dense_decoder_refuse_it(worlds: dict[str, MeshWorld], tmp_path: Path) -> None:
    source = worlds["spheres"].source("test", 0, with_code=False, cache=tmp_path)
    circles = build(WORLDS["circles"]())
    with pytest.raises(UsageError, match="--reading cells: circles has no such decoder"):
        Trainer(RunConfig(WORLDS["circles"](), method="noncur", network=CELLS), circles, [source], CPU)
