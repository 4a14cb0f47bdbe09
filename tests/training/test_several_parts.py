"""Several parts of one's own in free space: their meshes become one detector with a slot for each."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from curio_train.commands.prepare import prepared
from curio_train.commands.train import Session, parse
from curio_train.config import Recipe, RunConfig
from curio_train.data import backgrounds
from curio_train.errors import UsageError
from curio_train.evaluation.unlabelled.photographed import judge
from curio_train.export.write_model import export
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.interruption import Interruption
from curio_train.learning.session import learn
from curio_train.learning.state import TrainState
from curio_train.scene_code import COLOR, CONFIDENCE, ROTATION_6D, TRANSLATION
from curio_train.templates.build import template_network
from curio_train.worlds import build
from curio_train.worlds.options import CaptureOptions, LinemodOptions
from curio_train.worlds.several_objects.world import SeveralObjectsWorld

WIDTH, HEIGHT = 160, 120


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two blocks without colours and a red one, in millimetres; photographs and a background image."""
    root = tmp_path_factory.mktemp("parts")
    trimesh.creation.box((80, 40, 20)).export(root / "block.stl")
    trimesh.creation.box((30, 30, 60)).export(root / "again.stl")
    red = trimesh.creation.box((60, 50, 40))
    red.visual.vertex_colors = np.tile([200, 30, 30, 255], (len(red.vertices), 1))
    red.export(root / "red.ply")
    camera = {"camera_matrix": [[180, 0, 79.5], [0, 180, 59.5], [0, 0, 1]], "width": WIDTH, "height": HEIGHT}
    (root / "camera.json").write_text(json.dumps(camera))
    (root / "photos").mkdir()
    plate = np.random.default_rng(0).integers(40, 220, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    for file in ("plate.png", *(f"photos/{number}.png" for number in range(4))):
        cv2.imwrite(str(root / file), plate)
    return root


def options(folder: Path, **changes: object) -> CaptureOptions:
    given = CaptureOptions(
        (folder / "block.stl", folder / "red.ply"),
        folder / "camera.json",
        folder / "photos",
        mesh_unit="mm",
        background=folder / "plate.png",
    )
    return replace(given, **changes)


@pytest.fixture(scope="module")
def world(folder: Path) -> SeveralObjectsWorld:
    found = build(options(folder))
    assert isinstance(found, SeveralObjectsWorld)
    return found


def test_each_part_has_a_slot_and_a_name(world: SeveralObjectsWorld) -> None:
    assert [(kind.name, kind.slots) for kind in world.objects] == [("block", (0,)), ("red", (1,))]
    assert (world.name, world.model_name) == ("capture", "block-red")
    code = world.sample(3, (0,))
    world.layout.check({name: value for name, value in code.items() if name in world.layout})
    assert COLOR not in code
    assert world.render(code).shape == (3, 3, world.camera.height, world.camera.width)


def test_parts_are_seen_from_all_sides_unless_they_stand_upright(folder: Path, world: SeveralObjectsWorld) -> None:
    upright = build(options(folder, upright=True))
    assert isinstance(upright, SeveralObjectsWorld)
    for seen, any_side in ((world, True), (upright, False)):
        network = seen.assemble([stage.network(RunConfig(options(folder)).network) for stage in seen.stages])
        assert [geometry.any_side for geometry in network.geometries] == [any_side, any_side]


def test_a_part_without_colours_is_painted_and_others_keep_theirs(folder: Path) -> None:
    block, red = build(options(folder)).members
    np.testing.assert_allclose(block.mesh.vertex_colors_srgb[0], block.typical_color)
    np.testing.assert_allclose(red.mesh.vertex_colors_srgb[0], np.array([200, 30, 30]) / 255, atol=0.01)
    only = build(options(folder, mesh=(folder / "block.stl", folder / "again.stl"), paint="#33804d"))
    assert all(np.allclose(one.mesh.vertex_colors_srgb[0], [0.2, 0.502, 0.302], atol=0.01) for one in only.members)
    mixed = build(options(folder, paint="#33804d")).members
    np.testing.assert_allclose(mixed[0].mesh.vertex_colors_srgb[0], [0.2, 0.502, 0.302], atol=0.01)
    np.testing.assert_allclose(mixed[1].mesh.vertex_colors_srgb[0], red.mesh.vertex_colors_srgb[0])
    with pytest.raises(UsageError, match=r"--paint #33804d: .*red\.ply has colours"):
        build(options(folder, mesh=(folder / "red.ply",), paint="#33804d"))


def test_no_colour_is_looked_for_beside_parts_that_have_their_own(folder: Path) -> None:
    said: list[str] = []
    given = options(folder)
    config = prepared(RunConfig(given, recipe=replace(Recipe(), self_training=0.0)), folder, said.append, said.append)
    assert isinstance(config.world, CaptureOptions)
    assert config.world.paint is None
    assert any("is not looked for beside parts that have their own" in line for line in said)


def test_calls_that_contradict_themselves_are_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="parts are named after their files: rename one"):
        options(folder, mesh=(folder / "block.stl", folder / "block.stl"))
    with pytest.raises(UsageError, match="--objects has commas between names"):
        options(folder, mesh=(folder / "block.stl", folder / "pin,long.stl"))
    config = RunConfig(options(folder), method="sleep")
    taught = replace(config, recipe=replace(config.recipe, self_training=0.5))
    with pytest.raises(UsageError, match="several parts in free space are not learned from photographs"):
        prepared(taught, tmp_path, print, print)
    with pytest.raises(UsageError, match="--method templates finds one object"):
        template_network(build(options(folder)))
    warnings: list[str] = []
    without = RunConfig(options(folder), method="templates", minutes=3.0, recipe=replace(Recipe(), self_training=0.0))
    with pytest.raises(UsageError, match="--method templates reads one part, found 2 --mesh; leave out --method"):
        prepared(without, tmp_path, print, print)
    without = replace(without, world=options(folder, mesh=(folder / "red.ply",)), recipe=Recipe())
    prepared(without, tmp_path, warnings.append, print)
    assert "--minutes 3.0 has no effect with --method templates, which trains nothing" in warnings
    assert not any("below" in warning for warning in warnings), "templates learn from no photograph, so few are enough"
    with pytest.raises(UsageError, match=r"--init .* has no effect with --method templates"):
        prepared(replace(without, init=tmp_path), tmp_path, print, print)
    with pytest.raises(UsageError, match="--class ape,can,ape: found a class twice"):
        LinemodOptions("ape,can,ape")
    with pytest.raises(UsageError, match="goes on in its own folder; leave out --out"):
        Session(out=tmp_path / "a", resume=tmp_path / "b")


def test_a_method_that_cannot_train_them_leaves_no_run(folder: Path, tmp_path: Path) -> None:
    config = RunConfig(options(folder), method="our")
    with pytest.raises(UsageError, match="reads them by templates: use --method sleep"):
        learn(config, tmp_path / "run", Interruption(), resume=False, cache=tmp_path)
    assert not (tmp_path / "run").exists()


def test_slots_of_a_first_network_are_of_the_same_parts(folder: Path, tmp_path: Path) -> None:
    """Its weights would be those of the other part, without a word."""
    before = RunConfig(options(folder), method="sleep")
    RunFolder(tmp_path / "before", before).write_config(new=True)
    for meshes, names in ((("red.ply", "block.stl"), "red, block"), (("red.ply",), "red")):
        swapped = replace(before, world=options(folder, mesh=tuple(folder / mesh for mesh in meshes)))
        swapped = replace(swapped, init=tmp_path / "before")
        with pytest.raises(UsageError, match=f"it finds block, red, and this run is of {names}; expected as many"):
            learn(swapped, tmp_path / "run", Interruption(), resume=False, cache=tmp_path)
    assert not (tmp_path / "run").exists()


def test_what_learned_from_no_photograph_cannot_look_less(folder: Path, tmp_path: Path) -> None:
    config = RunConfig(options(folder), method="sleep")
    run = RunFolder(tmp_path / "run", config)
    run.write_config(new=True)
    run.save(TrainState(config, build(config.world), torch.device("cpu")))
    with pytest.raises(UsageError, match="--fast is for detectors that learned from photographs"):
        export(tmp_path / "run", tmp_path / "models", fast=True)
    assert not (tmp_path / "models").exists()


def test_the_command_trains_a_locator(folder: Path) -> None:
    meshes = [str(folder / "block.stl"), str(folder / "red.ply")]
    flags = ["--camera", str(folder / "camera.json"), "--photos", str(folder / "photos")]
    several, one = (parse(["capture", "--mesh", *some, *flags]).config.recipe for some in (meshes, meshes[:1]))
    assert (several.batch_size, several.budget_images, several.self_training) == (16, 19_200, 0.0)
    assert (one.batch_size, one.budget_images, one.self_training) == (64, 240_000, 0.5)


def test_photographs_judge_parts_that_are_likely_there(
    folder: Path, world: SeveralObjectsWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backgrounds, "POOL_SIZE", 4)

    def predict(images: torch.Tensor) -> dict[str, torch.Tensor]:
        code = world.sample(len(images), (5,))
        return code | {CONFIDENCE: torch.tensor([0.9, 0.2])[:, None].expand(len(images), 2, 1)}

    found = judge(world, predict)
    assert found is not None
    assert found.summary["num_photographs"] == 4
    assert found.metrics["own_view_overlap"] == 0, "the photographs show the background alone"


def test_parts_that_explain_a_photograph_are_drawn_however_unsure(
    folder: Path, world: SeveralObjectsWorld, tmp_path: Path
) -> None:
    """Both are there; in the second and fourth photograph the unsure one is read elsewhere, and is left out."""
    plate = torch.tensor([0.1, 0.8, 0.3])[:, None, None].expand(3, HEIGHT, WIDTH)
    made = dict(world.sample(4, (5,))) | {CONFIDENCE: torch.ones(4, 2, 1)}
    (tmp_path / "photos").mkdir()
    for number, image in enumerate([plate, *world.render(made, plate.expand(4, -1, -1, -1))]):
        pixels = (255 * image.flip(0).permute(1, 2, 0)).round().byte().numpy()
        cv2.imwrite(str(tmp_path / ("plate.png" if number == 0 else f"photos/{number}.png")), pixels)
    seen = build(options(folder, photos=tmp_path / "photos", background=tmp_path / "plate.png"))
    read = made | {CONFIDENCE: torch.tensor([[0.3], [0.1]]).expand(4, 2, 1)}
    elsewhere = {name: values.clone() for name, values in read.items()}
    for name in (TRANSLATION, ROTATION_6D):
        elsewhere[name][1::2, 1] = elsewhere[name][[0, 2], 1]
    found, less = (judge(seen, lambda _, code=code: dict(code)) for code in (read, elsewhere))
    assert found is not None
    assert less is not None
    assert found.metrics["own_view_overlap"] > 0.85
    assert found.metrics["own_view_agreeing"] == 1
    assert less.metrics["own_view_overlap"] < found.metrics["own_view_overlap"] - 0.1
