"""A part of one's own: an STL, a camera file, photographs and a background image become a world that can be learned."""

import json
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.models.detector import Detector
from curio_serve.models.model import Model
from curio_serve.models.model_folder import open_model
from curio_train.camera import Intrinsics
from curio_train.commands import train as train_command
from curio_train.config import NetworkConfig, RunConfig
from curio_train.data import backgrounds
from curio_train.data.background_image import BackgroundImages
from curio_train.data.photographs import NUM_JUDGED
from curio_train.doctor.examine import refuse_unfit
from curio_train.errors import CameraError, DataError, MeshError, UsageError
from curio_train.evaluation.evaluate import evaluate
from curio_train.evaluation.subject import load_subject
from curio_train.exported_model import find_model
from curio_train.geometry import matrix_from_rotation_6d
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.initial import begin_with
from curio_train.learning.state import TrainState
from curio_train.refinement import render_and_compare
from curio_train.refinement.pseudo_labels import PseudoLabels
from curio_train.scene_code import COLOR, CONFIDENCE, ROTATION_6D, TRANSLATION
from curio_train.worlds import build
from curio_train.worlds.base import World
from curio_train.worlds.capture import CapturePhotographs
from curio_train.worlds.options import CaptureOptions
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from safetensors.torch import load_file
from torch import Tensor

WIDTH, HEIGHT = 160, 120


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An unpainted bracket in millimetres, symmetric under half a turn; 12 photographs, background image, clutter."""
    root = tmp_path_factory.mktemp("part")
    base = trimesh.creation.box((80, 40, 20))
    tower = trimesh.creation.box((20, 20, 50))
    tower.apply_translation((0, 0, 30))
    trimesh.util.concatenate([base, tower]).export(root / "bracket.stl")
    camera = {"camera_matrix": [[180, 0, 79.5], [0, 180, 59.5], [0, 0, 1]], "width": WIDTH, "height": HEIGHT}
    (root / "camera.json").write_text(json.dumps(camera | {"distortion": [0.1, 0, 0, 0, 0]}))
    random = np.random.default_rng(0)
    plate = cv2.resize(random.integers(40, 220, (12, 16, 3), dtype=np.uint8), (WIDTH, HEIGHT))
    cv2.imwrite(str(root / "plate.png"), plate)
    (root / "photos").mkdir()
    for number in range(12):
        photo = plate.copy()
        x, y = random.integers(20, (WIDTH - 50, HEIGHT - 50))
        photo[y : y + 30, x : x + 30] = random.integers(0, 255, (30, 30, 3))
        cv2.imwrite(str(root / "photos" / f"{number:02d}.png"), photo)
    return root


@pytest.fixture
def cache(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where ten pictures of clutter are kept, instead of 240, which take half a minute."""
    monkeypatch.setattr(backgrounds, "POOL_SIZE", 10)
    return folder / "cache"


def options(folder: Path, **changes: object) -> CaptureOptions:
    usual = {"mesh": (folder / "bracket.stl",), "camera": folder / "camera.json", "photos": folder / "photos"}
    return CaptureOptions(**{**usual, "mesh_unit": "mm", "background": folder / "plate.png"} | changes)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def world(folder: Path) -> TwoStageWorld:
    found = build(options(folder))
    assert isinstance(found, TwoStageWorld)
    return found


def test_the_part_is_what_its_file_says(world: TwoStageWorld) -> None:
    kind = world.object.kind
    assert (kind.name, world.model_name, world.name) == ("bracket", "bracket", "capture")
    assert kind.diameter_m == pytest.approx(np.linalg.norm([0.08, 0.04, 0.02]) * 1.0, rel=0.1)
    (half_turn,) = kind.symmetries
    assert np.allclose(half_turn[:3, :3], np.diag([-1, -1, 1]), atol=0.02)


def test_an_unpainted_part_has_any_colour_and_says_which(world: TwoStageWorld) -> None:
    code = world.sample(400, (1,))
    world.layout.check(code)
    colors = code[COLOR][:, 0]
    saturation = 1 - colors.amin(1) / colors.amax(1)
    assert saturation.min() < 0.05
    assert saturation.max() > 0.9
    assert colors.amax(1).min() < 0.2
    second = world.stages[1]
    scenes = second.sample(6, (1,))
    scenes[CONFIDENCE][:] = 1
    light, dark = (scenes | {COLOR: torch.full((6, 1, 3), value)} for value in (0.9, 0.2))
    assert (second.render(light) - second.render(dark)).mean() > 0.02
    read = second.network(NetworkConfig()).eval()(second.render(scenes))
    assert read[COLOR].shape == (6, 1, 3)
    wrong = read | {COLOR: 1 - scenes[COLOR].round()}
    right = read | {COLOR: scenes[COLOR]}
    assert second.code_loss(wrong, scenes) > second.code_loss(right, scenes)


def test_before_a_plate_crops_have_more_turns(folder: Path, world: TwoStageWorld) -> None:
    elsewhere = build(options(folder, background=None))
    assert world.stage_schedule.count(0) == elsewhere.stage_schedule.count(0) == 1
    assert len(world.stage_schedule) > len(elsewhere.stage_schedule)


def test_a_painted_part_keeps_its_colours(folder: Path, tmp_path: Path) -> None:
    shape = trimesh.load_mesh(folder / "bracket.stl")
    shape.visual.vertex_colors = np.tile([200, 30, 30, 255], (len(shape.vertices), 1))
    shape.export(tmp_path / "red.ply")
    painted = build(options(folder, mesh=(tmp_path / "red.ply",)))
    assert COLOR not in painted.layout
    assert COLOR not in painted.sample(2, (0,))


def test_it_is_seen_from_all_sides_or_from_above(folder: Path, world: TwoStageWorld) -> None:
    def lowest_camera(seen: TwoStageWorld) -> float:
        code = seen.sample(300, (2,))
        turn = matrix_from_rotation_6d(code[ROTATION_6D][:, 0])
        camera = -(turn.transpose(1, 2) @ code[TRANSLATION][:, 0, :, None])
        return float(camera[:, 2].min())

    assert lowest_camera(world) < -0.3
    upright = build(options(folder, upright=True))
    assert isinstance(upright, TwoStageWorld)
    assert lowest_camera(upright) > -1e-4


def test_backgrounds_are_the_plate_and_clutter(folder: Path, world: TwoStageWorld, cache: Path) -> None:
    source = world.stages[0].source("train", 0, with_code=False, cache=cache)
    frames = source.backgrounds(0, 60)
    assert frames.shape == (60, 3, HEIGHT // 4, WIDTH // 4)
    assert torch.equal(frames, source.backgrounds(0, 60))
    plate = cv2.cvtColor(cv2.imread(str(folder / "plate.png")), cv2.COLOR_BGR2RGB)
    small = torch.from_numpy(cv2.resize(plate, (WIDTH // 4, HEIGHT // 4), interpolation=cv2.INTER_AREA) / 255)
    flat = torch.cat([frames.flatten(1), small.permute(2, 0, 1).float().flatten()[None]])
    alike = torch.corrcoef(flat)[-1, :-1] > 0.7
    assert 42 <= alike.sum() <= 58, "seventeen of twenty are the background image"
    crops = world.stages[1].source("train", 0, with_code=False, cache=cache).backgrounds(0, 8)
    assert crops.shape == (8, 3, 64, 64)


def photographs(world: World) -> CapturePhotographs:
    assert isinstance(world, TwoStageWorld)
    assert isinstance(world.photographs, CapturePhotographs)
    return world.photographs


def test_photographs_come_in_the_canonical_size_without_distortion(folder: Path, world: TwoStageWorld) -> None:
    _, found = photographs(world).judged(5)
    assert found.shape == (5, 3, world.camera.height, world.camera.width)
    assert photographs(world).judged(100)[1].shape[0] == 12
    plate = photographs(world).background_image()
    assert plate is not None
    assert (found[0] == plate).all(dim=0).float().mean() > 0.9, "but for a square that differs"
    lens = world.object.camera.matrix, np.array(world.object.camera.distortion)
    straight = cv2.undistort(cv2.cvtColor(cv2.imread(str(folder / "photos" / "00.png")), cv2.COLOR_BGR2RGB), *lens)
    within = cv2.undistort(np.full_like(straight, 255), *lens) == 255  # elsewhere OpenCV's is black, and ours goes on
    seen = (found[0] * 255).round().permute(1, 2, 0).numpy()
    assert np.abs(seen - straight)[within].max() <= 255 / 32  # its maps are rounded to 1/32 pixel
    assert within.mean() > 0.8
    assert seen[0, 0].any()


def test_a_model_is_not_judged_by_what_it_learned_from(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of many photographs, here each of another grey; of a few it learns nothing, and nothing of what it can't find."""
    monkeypatch.setattr(render_and_compare, "_STEPS", 1)  # the greys show nothing that more steps could find
    for number in range(2 * NUM_JUDGED):
        cv2.imwrite(str(tmp_path / f"{number:03}.png"), np.full((HEIGHT, WIDTH, 3), 3 * number, np.uint8))
    many, few = build(options(folder, photos=tmp_path)), build(options(folder))
    read: list[Tensor] = []

    def predict(images: Tensor) -> dict[str, Tensor]:
        read.append(images)
        return many.sample(len(images), (1,))

    def greys(images: Tensor) -> set[int]:
        return set((images[:, 0, HEIGHT // 2, WIDTH // 2] * 85).round().int().tolist())

    _, judged = photographs(many).judged(1000)
    assert len(greys(judged)) == NUM_JUDGED
    assert PseudoLabels.from_photographs(many, predict) is None
    assert greys(torch.cat(read)) == set(range(2 * NUM_JUDGED)) - greys(judged)
    read.clear()
    assert PseudoLabels.from_photographs(few, predict) is None
    assert not read
    assert PseudoLabels.from_photographs(many, predict, seconds=0) is None
    first, spread = greys(read[0]), greys(torch.cat(read[1:]))
    assert len(first) == len(spread) == 20, "without time for more, one batch is tried and one is labelled"
    assert max(spread) - min(spread) > max(first) - min(first)


def test_the_background_image_among_the_photographs_neither_teaches_nor_judges(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "photos", tmp_path / "photos")
    among = shutil.copy(folder / "plate.png", tmp_path / "photos")
    for number in range(2 * NUM_JUDGED - 13):
        shutil.copy(folder / "photos" / "00.png", tmp_path / "photos" / f"copy{number}.png")
    found = photographs(build(options(folder, photos=tmp_path / "photos", background=Path(among))))
    assert len(found.paths()) == 2 * NUM_JUDGED - 1
    assert Path(among) not in found.judged(1000)[0]
    assert not found.unlabelled_paths(), "one too few to learn from"


def test_what_contradicts_itself_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--near-m 1"):
        options(folder, near_m=1.0, far_m=0.5)
    with pytest.raises(UsageError, match="--background and --backgrounds"):
        options(folder, backgrounds=folder / "photos")
    for near_m, far_m, told in ((0.05, 1.0, "inside it"), (300.0, 1000.0, "--far-m 1000:.*pixels large.*in metres")):
        with pytest.raises(UsageError, match=told):
            build(options(folder, near_m=near_m, far_m=far_m))
    with pytest.raises(MeshError, match="--mesh-unit to"):
        build(options(folder, mesh_unit=None))
    with pytest.raises(MeshError, match=r"none\.stl"):
        build(options(folder, mesh=(folder / "none.stl",)))
    (tmp_path / "camera.json").write_text("{")
    with pytest.raises(CameraError, match="not JSON"):
        build(options(folder, camera=tmp_path / "camera.json"))


def test_files_that_do_not_belong_together_are_refused_all_at_once(folder: Path, tmp_path: Path) -> None:
    assert not any("camera" in doubt for doubt in refuse_unfit(options(folder)))
    small = cv2.resize(cv2.imread(str(folder / "plate.png")), (80, 60))
    cv2.imwrite(str(tmp_path / "plate.png"), small)
    camera = json.loads((folder / "camera.json").read_text()) | {"width": 200, "height": 150}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    with pytest.raises(DataError) as refusal:
        refuse_unfit(options(folder, camera=tmp_path / "camera.json", background=tmp_path / "plate.png"))
    text = str(refusal.value)
    assert all(size in text for size in ("200x150", "80x60"))
    assert len(text.splitlines()) == 2
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "cut.png").write_bytes((folder / "plate.png").read_bytes()[:500])
    with pytest.raises(DataError, match=r"backgrounds: .*cut\.png"):
        refuse_unfit(options(folder, background=None, backgrounds=tmp_path / "other"))
    with pytest.raises(DataError, match="80x60"):
        BackgroundImages.read(tmp_path / "plate.png", Intrinsics(np.eye(3), WIDTH, HEIGHT))


def test_few_photographs_are_said_where_training_would_learn_from_them(folder: Path) -> None:
    (doubt,) = refuse_unfit(options(folder))
    assert "only 12; below 80" in doubt
    assert refuse_unfit(options(folder), self_training=False) == []


def call(*words: object) -> int:
    with pytest.raises(SystemExit) as exit_:
        train_command.train(["capture", *map(str, words)])
    return int(exit_.value.code or 0)


def check_followed_poses_are_aligned(model: Model) -> None:
    """What is read from crops, as of an object that is followed, is aligned with its outline as whole frames are."""
    assert model.crop_stage is not None
    assert model.outline_stage is not None
    camera, focal_px = PinholeCamera(np.asarray(model.camera.matrix)), model.camera.focal_lengths[0]
    pixels = np.random.default_rng(0).integers(0, 255, (480, 640, 3), np.uint8)
    expected_m = np.array([0.0, 0.0, 0.7])
    read = model.crop_stage.read(pixels, camera, expected_m, focal_px)
    aligned = model.outline_stage.aligned(pixels, camera, read, focal_px)
    found = Detector(model).read_crops(pixels, camera, expected_m)
    np.testing.assert_array_equal(found.translation_m, aligned.translation_m)
    np.testing.assert_array_equal(found.rotation, aligned.rotation)
    assert not np.array_equal(aligned.translation_m, read.translation_m)


def test_from_files_to_a_model_by_a_project_file(
    folder: Path,
    tmp_path: Path,
    cache: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    small_checks: None,
) -> None:
    """The whole way, three steps long; the report shows photographs beside what was found in them."""
    project = folder / "bracket.toml"
    project.write_text(
        'mesh = "bracket.stl"\nmesh-unit = "mm"\ncamera = "camera.json"\nphotos = "photos"\nbackground = "plate.png"\n'
        "upright = true\nimages = 1200\nbatch-size = 4\nmicro-batch-size = 4\n"
    )
    run = tmp_path / "run"
    monkeypatch.setattr(sys, "argv", ["curio-train", "capture", "--project", str(project)])
    run.mkdir()
    (run / "models").write_text("in the way")
    assert call("--project", project, "--images", 12, "--cache", cache, "--out", run) == 1
    assert f"curio-export {run} --out {run / 'models'}" in capsys.readouterr().err
    (run / "models").unlink()
    assert call("--resume", run, "--cache", cache) == 0, "nothing was lost"
    told = capsys.readouterr().err
    assert f"curio-serve {run / 'models'}" in told
    assert "by its photographs, without labels: Do not trust it: in 0% of" in told
    assert f"curio-detect {run / 'models' / 'bracket'} PHOTOS --camera {folder / 'camera.json'}" in told
    check_followed_poses_are_aligned(open_model(run / "models" / "bracket"))
    config = RunFolder.open(run).config
    assert vars(config.world) | {"judged": (), "mesh_sha256": ()} == vars(options(folder, upright=True))
    assert (config.images, config.recipe.batch_size) == (12, 4)
    report = (run / "report.html").read_text()
    assert 'id="photographs"' in report
    assert "what was found covers what differs from the background image" in report
    assert "capture: bracket; sleep, seed 0" in report
    card = (run / "models" / "bracket" / "CARD.md").read_text()
    assert str(folder) not in card
    assert "In 12 photographs, without labels: Do not trust it: " in card, "as the report says"
    with pytest.raises(UsageError, match="run folder"):
        load_subject(run / "models" / "bracket" / "1")
    config_file = run / "config.json"
    config_file.write_text(config_file.read_text().replace(str(folder / "photos"), str(tmp_path / "gone")))
    warnings: list[str] = []
    assert evaluate(run, num_images=4, cache=cache, warn=warnings.append)["metrics"], "scores need no photographs"
    assert ["gone" in warning for warning in warnings] == [True]
    assert 'class="scores"' in (run / "report.html").read_text()


def test_project_files_that_cannot_be_used(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "part.toml"
    for content, expected in ((None, "cannot be read"), ("", "empty"), ("mesh =", "not TOML"), ("a = {b = 1}", "dict")):
        if content is not None:
            file.write_text(content)
        assert call("--project", file) == 2
        assert expected in capsys.readouterr().err


def test_training_begins_with_the_network_of_another_object(folder: Path, world: TwoStageWorld) -> None:
    """An unpainted part's colour is read, too, so the last layer has another size than that of a painted object."""
    shipped = Path(__file__).parents[2] / "models" / "ape"
    weights = load_file(find_model(shipped).with_name("weights.safetensors"))
    state = TrainState(RunConfig(options(folder), method="sleep"), world, torch.device("cpu"))
    begin_with(state, shipped)
    begun = state.pose.network.state_dict()
    others = {name for name, value in weights.items() if not torch.equal(begun[name].float(), value.float())}
    assert others == {"second.cells.2.weight", "second.cells.2.bias"}
    assert len(begun["second.cells.2.bias"]) == len(weights["second.cells.2.bias"]) + 3
