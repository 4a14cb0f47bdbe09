"""Parts on a plane: STL files, photographs, background images and cameras become a world."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from curio_train.commands import train as train_command
from curio_train.config import METHODS, NetworkConfig, Recipe, RunConfig
from curio_train.doctor.examine import refuse_unfit
from curio_train.errors import CameraError, DataError, UsageError
from curio_train.evaluation.evaluate import evaluate
from curio_train.evaluation.unlabelled.photographed import judge
from curio_train.export.write_model import export
from curio_train.geometry import Pose, camera_looking_at
from curio_train.learning.parallel import ranks
from curio_train.learning.runs.configuration import load_config
from curio_train.learning.trainer import Trainer
from curio_train.meshes.meshes import load_mesh
from curio_train.metrics.images import blurred
from curio_train.rendering.renderer import Renderer
from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, ROTATION_6D, TRANSLATION, YAW
from curio_train.worlds import build
from curio_train.worlds.options import CaptureOptions
from curio_train.worlds.tabletop.world import TabletopWorld
from paper.captures_table import markdown, row

ROOT = Path(__file__).parents[2]
WIDTH, HEIGHT, NUM = 96, 72, 12
MATRIX = np.array([[110.0, 0, 47.5], [0, 110, 35.5], [0, 0, 1]])
RED = (0.8, 0.15, 0.1)
AZIMUTHS = {"a": 0.0, "b": 90.0}


def pose(azimuth_deg: float, height: float = 0.5) -> np.ndarray:
    azimuth = np.radians(azimuth_deg)
    eye = torch.tensor([0.55 * np.sin(azimuth), height, 0.55 * np.cos(azimuth)])
    rotation, shift = camera_looking_at(eye, torch.zeros(3, dtype=torch.float64))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.numpy(), shift.numpy()
    return matrix


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two red wedges 80 mm long (z up), photographed by two cameras a quarter apart; the true places beside them."""
    root = tmp_path_factory.mktemp("table")
    corners = [[0, 0, 0], [80, 0, 0], [0, 40, 0], [80, 40, 0], [0, 0, 50], [0, 40, 50]]
    trimesh.Trimesh(corners).convex_hull.export(root / "wedge.stl")
    camera = {"camera_matrix": MATRIX.tolist(), "width": WIDTH, "height": HEIGHT}
    (root / "camera.json").write_text(json.dumps(camera))
    renderer = Renderer([load_mesh(root / "wedge.stl", "mm")], [0, 0], WIDTH, HEIGHT, ambient=0.3)
    random = np.random.default_rng(0)
    z_up = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])  # world_from_file of a wedge that is not turned
    places = random.uniform(-0.06, 0.06, (NUM, 2, 2)) + np.array([[-0.1, 0], [0.1, 0]])
    views = {}
    for side, azimuth in AZIMUTHS.items():
        grey = cv2.resize(random.integers(120, 150, (9, 12, 3), dtype=np.uint8), (WIDTH, HEIGHT))
        (root / side).mkdir()
        cv2.imwrite(str(root / side / f"plate-{side}.png"), grey)  # among the photographs, as people keep it
        views[f"plate-{side}.png"] = {"cam_from_world": pose(azimuth).tolist()}
        plate = torch.from_numpy(cv2.cvtColor(grey, cv2.COLOR_BGR2RGB)).permute(2, 0, 1).float() / 255
        cam_from_world = Pose.from_matrix(torch.from_numpy(pose(azimuth)).float())
        where = torch.zeros(NUM, 2, 3)
        where[..., [0, 2]] = torch.from_numpy(places).float()
        own = torch.from_numpy(z_up).float()
        images = renderer(
            (cam_from_world.rotation @ own).expand(NUM, 2, 3, 3),
            cam_from_world.apply(where),
            camera_matrix=MATRIX,
            backgrounds=plate.expand(NUM, -1, -1, -1),
            light=(cam_from_world.rotation @ torch.tensor([0.0, 0.7, 0.0])).expand(NUM, 3),
            color=torch.tensor(RED).expand(NUM, 2, 3),
        )
        for number, image in enumerate((images.permute(0, 2, 3, 1).numpy() * 255).round().astype(np.uint8)):
            cv2.imwrite(str(root / side / f"{number:02}.png"), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    (root / "views.json").write_text(json.dumps(views))
    np.save(root / "places.npy", places)
    return root


def options(folder: Path, **changes: object) -> CaptureOptions:
    usual = {
        "mesh": (folder / "wedge.stl",),
        "camera": folder / "camera.json",
        "photos": folder / "a",
        "mesh_unit": "mm",
        "background": folder / "a" / "plate-a.png",
        "plane": folder / "views.json",
        "counts": ("2",),
        "second": folder / "b",
        "second_background": folder / "b" / "plate-b.png",
    }
    return CaptureOptions(**{**usual, **changes})  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def world(folder: Path) -> TabletopWorld:
    found = build(options(folder))
    assert isinstance(found, TabletopWorld)
    return found


def truth(folder: Path, world: TabletopWorld) -> dict[str, torch.Tensor]:
    """What was photographed, as the world's code; the middle of a wedge is the code's place."""
    places = torch.from_numpy(np.load(folder / "places.npy")).float()
    code = {name: torch.zeros(NUM, 2, 3) for name in (TRANSLATION, COLOR)}
    # The file's x, 80 mm long, is the world's z, and its y, 40 mm, the world's x.
    code[TRANSLATION][..., 0], code[TRANSLATION][..., 2] = places[..., 0] + 0.02, places[..., 1] + 0.04
    code[COLOR][:] = torch.tensor(RED)
    code[YAW] = torch.tensor([1.0, 0.0]).expand(NUM, 2, 2)
    code[LIGHT] = torch.zeros(NUM, 2)
    return {field.name: code[field.name] for field in world.layout.fields}


def test_a_true_code_looks_like_its_photographs_from_both_cameras(folder: Path, world: TabletopWorld) -> None:
    code = truth(folder, world)
    own, second = world.photographs.own, world.photographs.second
    assert second is not None
    for view, drawn in ((own, world.render(code)), (second, world.novel_view(code))):
        photographs = view.photographs / 255
        assert (drawn - photographs).abs().mean() < 0.25 * (view.background_image / 255 - photographs).abs().mean()


def test_true_codes_score_better_than_wrong_ones(folder: Path, world: TabletopWorld) -> None:
    """And what looks right from the own camera alone is found out by the second."""
    code = truth(folder, world)
    moved = code | {TRANSLATION: code[TRANSLATION] + torch.tensor([0.1, 0.0, 0.0])}
    tipped = build(options(folder, up="y"))
    shown = ((world, code), (world, moved), (tipped, code))
    right, wrong, on_its_side = (judge(place, lambda _, code=found: code) for place, found in shown)
    assert right is not None
    assert wrong is not None
    assert on_its_side is not None
    assert "Trust it with care" in on_its_side.verdict
    assert "(--up)" in on_its_side.verdict
    for name in ("own_view_dssim", "own_view_dssim_blurred", "second_view_dssim", "second_view_dssim_blurred"):
        assert right.metrics[name] < wrong.metrics[name]
        assert right.metrics[name] < right.metrics[name.replace("view_", "view_plate_")]
    assert right.metrics["better_than_plate"] == 1
    for name, least in (("own_view_overlap", 0.75), ("own_view_inside", 0.75)):
        assert wrong.metrics[name] + 0.2 < right.metrics[name]
        assert right.metrics[name] > least
    assert f"overlap by {right.metrics['own_view_overlap']:.2f}" in right.verdict
    assert right.verdict.startswith("Trust it: in 100% of 12")
    assert wrong.verdict.startswith("Do not trust it")
    assert [*right.columns][2:] == ["photograph, second camera", "prediction, second camera"]
    names, parts = zip(*(caption.split("\n")[:2] for caption in right.captions), strict=True)
    assert sorted(names) == sorted(world.photographs.own.names)
    (kind,) = world.objects
    assert set(parts) == {f"2 {kind.name}"}


def test_draws_lie_where_photographs_show_parts(folder: Path, world: TabletopWorld) -> None:
    code = world.sample(100, (3,))
    world.layout.check(code)
    assert torch.equal(code[TRANSLATION], world.sample(100, (3,))[TRANSLATION])
    x, y, z = code[TRANSLATION].flatten(0, 1).unbind(1)
    assert float(y.abs().max()) == 0
    assert float(x.abs().max()) < 0.3
    assert float(z.abs().max()) < 0.3
    drawn = world.render(code)
    plate = world.photographs.own.background_image / 255
    changed = ((drawn - plate).abs().amax(dim=1) > 0.1).float().mean(dim=(1, 2))
    assert float(changed.min()) > 0.005, "each draw is seen"


@pytest.mark.parametrize("row", ["our", "noncur", "sleep", "wake_sleep", "sleep_cells"])
def test_a_few_steps_bring_photographs_or_dreams_nearer(
    world: TabletopWorld, folder: Path, tmp_path: Path, row: str
) -> None:
    method, network = row.removesuffix("_cells"), NetworkConfig(reading="cells" if row.endswith("_cells") else "whole")
    recipe = Recipe(batch_size=NUM, micro_batch_size=NUM, learning_rate=1e-3, gradient_clip=1.0, critic_weight=0.1)
    config = RunConfig(options(folder), method=method, recipe=recipe, network=network)
    source = world.source("train", 0, with_code=False, cache=tmp_path)
    fixed = world.sample(NUM, (5,))
    with ranks("cpu") as here:
        trainer = Trainer(config, world, [source], here)

        def image_error() -> float:
            with torch.no_grad():
                read = trainer.state.stages[0](source.images / 255)
                return float((seen(world, world.render(read)) - seen(world, source.images / 255)).square().mean())

        def dream_error() -> float:
            with torch.no_grad():
                return float(world.code_loss(trainer.state.stages[0](world.render(fixed)), fixed))

        error = image_error if METHODS[method].image else dream_error
        before = error()
        for _ in range(12):
            trainer.step(1.0)
        assert error() < before


def seen(world: TabletopWorld, images: torch.Tensor) -> torch.Tensor:
    """As image loss and critic see them."""
    return blurred(images, world.comparison_blur_px)


def test_image_loss_and_critic_see_both_through_a_filter(world: TabletopWorld) -> None:
    sharp = torch.zeros(1, 3, 128, 128)
    sharp[..., 64, 64] = 1
    soft = seen(world, sharp)
    assert float(soft.sum()) == pytest.approx(3, rel=1e-4)
    assert float(soft[0, 0, 64, 64]) < 0.1
    assert float(soft[0, 0, 64, 69]) == 0, "nine pixels wide"
    assert torch.allclose(seen(world, torch.ones(1, 3, 128, 128)), torch.ones(1, 3, 128, 128), atol=1e-5)


def test_counts_that_vary_have_confidences(folder: Path) -> None:
    varied = build(options(folder, counts=("0-3",)))
    assert varied.layout.num_slots == 3
    present = varied.sample(200, (0,))[CONFIDENCE].sum(dim=(1, 2))
    assert set(present.tolist()) == {0.0, 1.0, 2.0, 3.0}


def test_round_parts_have_no_yaw_and_what_lies_has_a_free_rotation(folder: Path, tmp_path: Path) -> None:
    trimesh.creation.cone(20, 50, sections=48).export(tmp_path / "cone.stl")
    cones = build(options(folder, mesh=(tmp_path / "cone.stl",)))
    assert YAW not in cones.layout
    mixed = build(options(folder, mesh=(tmp_path / "cone.stl", folder / "wedge.stl"), counts=("1", "1")))
    turns = mixed.sample(20, (0,))[YAW]
    assert torch.equal(turns[:, 0], torch.tensor([1.0, 0.0]).expand(20, 2))
    assert mixed.objects[0].slots == (0,)
    lying = build(options(folder, lying=True))
    code = lying.sample(30, (1,))
    assert ROTATION_6D in lying.layout
    turned = torch.einsum(
        "bsij,vj->bsvi", lying.orientation.rotation(code).double(), torch.from_numpy(lying.parts[0].mesh.vertices_m)
    )
    lowest = (turned[..., 1] + code[TRANSLATION][..., None, 1]).amin(dim=-1)
    assert float(lowest.abs().max()) < 1e-6, "it touches the plane"


@pytest.mark.parametrize("lying", [False, True])
def test_a_model_answers_in_the_camera_frame_and_the_files(folder: Path, lying: bool) -> None:
    """Where a corner of the file is seen is where the code puts it, and the code can be had back."""
    found = build(options(folder, lying=lying))
    assert isinstance(found, TabletopWorld)
    code = found.sample(8, (2,))
    outputs = found.outputs.from_code(code)
    assert outputs["rotation"].det().sub(1).abs().max() < 1e-5
    file_corner = torch.tensor([0.0, 0.0, 0.05], dtype=torch.float64)  # of the upper edge
    seen = outputs[TRANSLATION].double() + outputs["rotation"].double() @ file_corner
    part = found.parts[0]
    own_corner = part.file_from_own.inverse().to(file_corner).apply(file_corner)
    in_world = found.orientation.rotation(code).double() @ own_corner + code[TRANSLATION]
    expected = found.setup.cam_from_world.to(in_world).apply(in_world)
    assert torch.allclose(seen, expected, atol=1e-5)
    again = found.outputs.to_code(outputs)
    assert torch.allclose(
        found.orientation.rotation(again).double(), found.orientation.rotation(code).double(), atol=1e-4
    )
    assert torch.allclose(again[TRANSLATION], code[TRANSLATION], atol=1e-6)


def test_a_camera_that_moves_has_a_plate_for_each_photograph(folder: Path, tmp_path: Path) -> None:
    views = json.loads((folder / "views.json").read_text())
    turned = {"plate": str(folder / "b" / "plate-b.png"), "cam_from_world": pose(90).tolist()}
    (tmp_path / "views.json").write_text(json.dumps(views | {"03.png": turned}))
    moving = build(options(folder, plane=tmp_path / "views.json"))
    batch = moving.source("train", 0, with_code=False, cache=tmp_path).batch(0, NUM)
    assert batch.backgrounds is not None
    differing = (batch.backgrounds - batch.backgrounds[0]).abs().amax(dim=(1, 2, 3)) > 0.02
    assert differing.sum() in (1, NUM - 1)
    higher = {"plate": str(folder / "b" / "plate-b.png"), "cam_from_world": pose(90, height=0.7).tolist()}
    (tmp_path / "views.json").write_text(json.dumps(views | {"03.png": higher}))
    with pytest.raises(CameraError, match=r"03\.png was taken 0\.7 m above"):
        build(options(folder, plane=tmp_path / "views.json"))


def test_camera_poses_that_are_far_too_far_are_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "views.json").write_text(json.dumps({"plate-a.png": {"cam_from_world": pose(90, 60.0).tolist()}}))
    with pytest.raises(CameraError, match=r"m away from the plane.*cam_from_world is in metres"):
        build(options(folder, plane=tmp_path / "views.json"))


def test_pictures_that_do_not_belong_together(folder: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "plate-b.png"), np.zeros((36, 48, 3), np.uint8))
    with pytest.raises(DataError, match="found 48x36 pixels"):
        build(options(folder, second_background=tmp_path / "plate-b.png"))
    (tmp_path / "other").mkdir()
    cv2.imwrite(str(tmp_path / "other" / "x.png"), cv2.imread(str(folder / "b" / "plate-b.png")))
    with pytest.raises(DataError, match="named like one in"):
        build(options(folder, second=tmp_path / "other"))
    with pytest.raises(UsageError, match="its camera stands where that of --background"):
        build(options(folder, second=folder / "a", second_background=folder / "a" / "plate-a.png"))
    assert not any("background" in doubt for doubt in refuse_unfit(options(folder)))


def test_photographs_have_no_labels(world: TabletopWorld, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no labels"):
        world.source("train", 0, with_code=True, cache=tmp_path)


def call(*words: object) -> int:
    with pytest.raises(SystemExit) as exit_:
        train_command.train(["capture", *map(str, words)])
    return int(exit_.value.code or 0)


def test_from_files_to_a_model_by_a_project_file(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_checks: None
) -> None:
    """The whole way, three steps long: train, resume, judge, export, and a row of the table."""
    monkeypatch.setattr("curio_train.worlds.image_sets.NUM_IMAGES", {"train": 4, "validation": 4, "test": 4})
    project = folder / "table.toml"
    project.write_text(
        'mesh = ["wedge.stl"]\nmesh-unit = "mm"\ncamera = "camera.json"\nphotos = "a"\nbackground = "a/plate-a.png"\n'
        'plane = "views.json"\ncounts = [2]\nsecond = "b"\nsecond-background = "b/plate-b.png"\nmethod = "our"\n'
        "batch-size = 4\nmicro-batch-size = 4\n"
    )
    run = tmp_path / "run"
    assert call("--project", project, "--images", 8, "--cache", tmp_path, "--out", run) == 0
    assert load_config(run).network.reading == "cells"
    assert call("--resume", run, "--images", 12, "--cache", tmp_path) == 0
    report = (run / "report.html").read_text()
    assert 'id="verdict"' in report
    assert "rust it" in report
    found = evaluate(run, num_images=4, cache=tmp_path)
    assert found["photographs"]["num_photographs"] == NUM
    assert found["images_seen"] == 12
    text = markdown({"bunny": {"our": row(found)}}, "a command")
    assert f"| `our` | {found['photographs']['metrics']['second_view_dssim']:.4f} (0.36)" in text
    done = export(run, tmp_path / "models")
    assert done.path == tmp_path / "models" / "wedge" / "1"
    assert str(folder) not in (done.path.parent / "CARD.md").read_text()
