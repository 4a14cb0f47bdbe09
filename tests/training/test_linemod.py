import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from curio_train.commands.prepare import prepared
from curio_train.commands.train import parse
from curio_train.config import RunConfig
from curio_train.errors import CameraError, DataError, UsageError
from curio_train.export.write_model import export
from curio_train.geometry import matrix_from_rotation_6d
from curio_train.learning.runs.configuration import from_json, to_json
from curio_train.refinement.pseudo_labels import PseudoLabels
from curio_train.scene_code import LIGHT, ROTATION_6D, TRANSLATION
from curio_train.worlds import build
from curio_train.worlds.linemod import FAR_M, NEAR_M, read_camera_poses
from curio_train.worlds.options import LinemodOptions
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.single_object.viewpoints import MAX_LIGHT, MIN_LIGHT
from curio_train.worlds.single_object.world import EXPOSURE


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """A data set in BOP's layout with an ape of our own: an ellipsoid, in millimetres."""
    root = tmp_path_factory.mktemp("lm")
    (root / "models").mkdir()
    shape = trimesh.creation.icosphere(subdivisions=2)
    shape.apply_scale([30, 40, 50])
    shape.export(root / "models" / "obj_000001.ply")
    (root / "models" / "models_info.json").write_text(json.dumps({"1": {"diameter": 100.0}}))
    camera = {"fx": 572.4, "fy": 573.6, "cx": 325.3, "cy": 242.0, "width": 640, "height": 480}
    (root / "camera.json").write_text(json.dumps(camera))
    return root


@pytest.fixture(scope="module")
def photographs(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("photographs")
    random = np.random.default_rng(0)
    for number in range(5):
        cv2.imwrite(str(folder / f"{number}.png"), random.integers(0, 90, (96, 96, 3), dtype=np.uint8))
    return folder


@pytest.fixture(scope="module")
def world(data, photographs):
    return build(LinemodOptions("ape", data, photographs, gaze=False))


def test_poses_come_from_the_published_range(world):
    code = world.sample(400, (1,))
    exposure = code.pop(EXPOSURE)
    assert exposure.shape == (400, 1, 3)
    assert 0.1 < exposure.min() < 0.5 < 1.1 < exposure.max() < 2.5
    world.layout.check(code)
    position = code[TRANSLATION][:, 0]
    assert position[:, 2].min() >= NEAR_M
    assert position[:, 2].max() <= FAR_M
    pixels = position @ torch.from_numpy(world.camera.matrix).float().T
    pixels = pixels[:, :2] / pixels[:, 2:]
    assert pixels.min() > -1
    assert pixels.max() < 128
    strength = code[LIGHT].norm(dim=1)
    assert strength.min() >= MIN_LIGHT - 1e-5
    assert strength.max() <= MAX_LIGHT + 1e-5
    rotation = matrix_from_rotation_6d(code[ROTATION_6D][:, 0])
    camera_in_object = -(rotation.transpose(1, 2) @ position[..., None])[..., 0]
    assert camera_in_object[:, 2].min() > -1e-4, "a camera below the table"


def test_the_whole_frame_fits_the_canonical_camera(world):
    """The frame's corners keep their place: 640 pixels become 128, the 480 lie in the middle."""
    frame = np.array([[572.4, 0, 325.3], [0, 573.6, 242.0], [0, 0, 1]])
    corners = np.array([[-0.5, -0.5, 1], [639.5, 479.5, 1]]).T
    seen = world.camera.matrix @ np.linalg.solve(frame, corners)
    assert pytest.approx(np.array([[-0.5, 15.5], [127.5, 111.5]])) == seen[:2].T


def test_batches_are_a_function_of_the_step_and_keep_labels_to_themselves(world, tmp_path):
    source = world.source("train", 0, with_code=False, cache=tmp_path)
    first, again, other = source.batch(5, 4), source.batch(5, 4), source.batch(6, 4)
    assert first.code is None
    assert torch.allclose(first.images, again.images, rtol=0, atol=1e-6)  # sums of a pixel come in any order
    assert not torch.equal(first.images, other.images)
    held_out = world.source("test", 0, with_code=True, cache=tmp_path).batch(5, 4)
    assert held_out.code is not None
    assert not torch.equal(first.images, held_out.images)
    redrawn = world.render(held_out.code, held_out.backgrounds)
    assert torch.allclose(redrawn, held_out.images, rtol=0, atol=1e-6)
    assert not torch.equal(held_out.images, held_out.backgrounds), "no object in any picture"


def test_gradients_reach_every_field(world, tmp_path):
    batch = world.source("train", 0, with_code=True, cache=tmp_path).batch(0, 4)
    moved = {name: (value + 0.01).requires_grad_() for name, value in batch.code.items()}
    (world.render(moved, batch.backgrounds) - batch.images).square().sum().backward()
    for name, value in moved.items():
        assert value.grad.isfinite().all(), name
        assert value.grad.abs().sum() > 0, name


def test_a_card_names_the_source_of_the_mesh_and_no_folder(data, tmp_path, write_run, monkeypatch):
    typed = [
        "/opt/env/bin/curio-train",
        "linemod",
        "--class",
        "ape",
        "--data",
        str(data),
        "--out",
        str(tmp_path / "run"),
    ]
    monkeypatch.setattr(sys, "argv", typed)
    run = write_run(tmp_path / "run", options=LinemodOptions("ape", data, gaze=False))
    text = (export(run, tmp_path / "models").path.parent / "CARD.md").read_text()
    assert f"curio-train linemod --class ape --data {data.name} --out run`" in text
    assert str(data) not in text
    assert str(tmp_path) not in text
    assert "LineMOD (Hinterstoisser et al. 2012)" in text
    assert "CC BY 4.0" in text


def test_unknown_class_and_missing_data_are_named(data, tmp_path):
    with pytest.raises(UsageError, match="ape"):
        build(LinemodOptions("teapot", data))
    with pytest.raises(DataError, match="driller"):
        build(LinemodOptions("driller", data))
    with pytest.raises(DataError, match="hf download"):
        build(LinemodOptions("ape", tmp_path / "nothing"))


def test_frames_without_labels_teach_a_gaze_alone(data, photographs, tmp_path):
    with pytest.raises(UsageError, match=r"--photos .*leave out --one-stage"):
        build(LinemodOptions("ape", data, photographs, photos=photographs, gaze=False))
    read = []

    def remember(world):
        return lambda images: read.append(images) or world.sample(len(images), (1,))

    without = build(LinemodOptions("ape", data, photographs, two_stage=True))
    assert (
        PseudoLabels.from_photographs(without, lambda images: read.append(images) or without.sample(len(images), (1,)))
        is None
    )
    assert not read

    frames = tmp_path / "frames"
    frames.mkdir()
    grey = np.full((480, 640, 3), 90, np.uint8)
    for number in range(3):
        cv2.imwrite(str(frames / f"{number}.png"), grey + number)
    taught = build(LinemodOptions("ape", data, photographs, photos=frames, two_stage=True))
    assert (
        PseudoLabels.from_photographs(taught, lambda images: read.append(images) or taught.sample(len(images), (1,)))
        is None
    )
    (seen,) = read
    assert (seen.mean((1, 2, 3)) * 255).tolist() == pytest.approx([90, 91, 92])

    cv2.imwrite(str(frames / "9.png"), grey[:96])
    with pytest.raises(DataError, match=r"9\.png"):
        PseudoLabels.from_photographs(taught, lambda images: taught.sample(len(images), (1,)))
    with pytest.raises(DataError, match=r"9\.png"):  # before an hour is lost, too
        prepared(RunConfig(LinemodOptions("ape", data, photos=frames), method="sleep"), tmp_path, print, print)


def test_the_method_decides_which_network_finds_one_object(data, tmp_path):
    def found(method, **chosen):
        config = RunConfig(LinemodOptions("ape", data, **chosen), method=method)
        return build(prepared(config, tmp_path, print, print).world)

    assert isinstance(found("sleep"), SeveralObjectsWorld)
    assert isinstance(found("sleep", two_stage=True), TwoStageWorld)
    assert isinstance(found("hypotheses"), TwoStageWorld)
    assert isinstance(found("templates"), TwoStageWorld)
    assert not isinstance(found("our", gaze=False), SeveralObjectsWorld | TwoStageWorld)


@pytest.mark.parametrize("flags", [{"two_stage": True}, {"gaze": False}])
@pytest.mark.parametrize("names", ["all", "ape,can"])
def test_networks_of_one_object_are_refused_for_several(data, flags, names):
    with pytest.raises(UsageError, match=f"-stage: finds one object, found --class {names}"):
        LinemodOptions(names, data, **flags)
    with pytest.raises(UsageError, match="expected one network"):
        LinemodOptions("ape", data, gaze=False, two_stage=True)


def test_runs_that_are_older_than_the_flag_keep_their_network(data):
    def reread(options):
        stored = to_json(RunConfig(options, method="sleep"))
        del stored["world"]["two_stage"]
        return from_json(stored).world

    assert reread(LinemodOptions("ape", data)).two_stage
    assert not reread(LinemodOptions("ape", data, gaze=False)).two_stage
    assert not reread(LinemodOptions("all", data)).two_stage
    assert not reread(LinemodOptions("ape,can", data)).two_stage


def view() -> list[list[float]]:
    """From below, looking up: a camera rolls and tilts as it is carried around."""
    s = np.sqrt(0.5)
    tilted = np.array([[1, 0, 0], [0, s, -s], [0, s, s]])
    return [[*row, shift] for row, shift in zip(tilted, tilted @ [0, 0.8, 0], strict=True)] + [[0, 0, 0, 1]]


def test_where_frames_were_taken_is_known_in_metres_or_not_at_all(data, tmp_path):
    frames = [tmp_path / f"{number}.png" for number in range(3)]
    file = tmp_path / "views.json"
    file.write_text(json.dumps({"0.png": {"cam_from_world": view(), "unit": "m"}, "1.png": {"cam_from_world": view()}}))
    cameras = read_camera_poses(file, frames)
    assert cameras.in_metres
    assert cameras.known.tolist() == [True, False, False]
    assert cameras.cam_from_world[0].tolist() == view()

    with pytest.raises(CameraError, match=r'"unit": "m".*--objects'):
        read_camera_poses(file, frames[1:])
    file.write_text(json.dumps({"0.png": {"cam_from_world": [[1, 2], [3, 4]], "unit": "m"}}))
    with pytest.raises(CameraError, match=r"--views .*0\.png: cam_from_world has shape"):
        read_camera_poses(file, frames)
    with pytest.raises(UsageError, match=r"--views .*--photos"):
        build(LinemodOptions("ape", data, views=file))
    for frame in frames:
        cv2.imwrite(str(frame), np.full((480, 640, 3), 90, np.uint8))
    with pytest.raises(CameraError, match="shape"):  # before an hour is lost
        prepared(
            RunConfig(LinemodOptions("ape", data, photos=tmp_path, views=file), method="sleep"), tmp_path, print, print
        )


def test_a_run_without_such_frames_learns_nothing_from_them(data, tmp_path):
    frames = tmp_path / "frames"
    frames.mkdir()
    cv2.imwrite(str(frames / "0.png"), np.zeros((480, 640, 3), np.uint8))
    call = ["linemod", "--class", "ape", "--data", str(data)]
    for words, fraction in (([], 0.0), (["--photos", str(frames)], 0.5)):
        config = parse(call + words).config
        assert prepared(config, tmp_path, print, print).recipe.self_training == fraction
    with pytest.raises(UsageError, match=r"--self-training 0\.5: found no photographs .* expected --photos"):
        prepared(parse([*call, "--self-training", "0.5"]).config, tmp_path, print, print)
    told: list[str] = []
    for words in (["--self-training", "0"], ["--preset", "paper", "--method", "sleep"]):
        prepared(parse([*call, "--photos", str(frames), *words]).config, tmp_path, told.append, print)
    assert [f"--photos {frames}: with --self-training 0 nothing is learned from them" in one for one in told] == [
        True
    ] * 2
    with pytest.raises(UsageError, match="--method hypotheses does not learn from photographs"):
        prepared(parse([*call, "--photos", str(frames), "--method", "hypotheses"]).config, tmp_path, print, print)


@pytest.mark.parametrize("flag", ["--two-stage", "--two_stage"])
def test_a_flag_with_underscores_counts_as_with_dashes(data: Path, flag: str) -> None:
    """Also where it decides about the recipe of its network."""
    config = parse(["linemod", "--class", "ape", "--data", str(data), flag]).config
    assert (config.recipe.batch_size, config.recipe.budget_images) == (64, 240_000)
