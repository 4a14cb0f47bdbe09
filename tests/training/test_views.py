"""curio-render: detections and scene codes to pictures."""

import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import trimesh
from curio_train.commands import render as render_command
from curio_train.drawing.scenes import mesh_world
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT = 64, 48
MATRIX = [[70.0, 0.0, 30.0], [0.0, 66.0, 25.0], [0.0, 0.0, 1.0]]
HUGE = [[9e4, 0.0, 45_000.0], [0.0, 9e4, 40_000.0], [0.0, 0.0, 1.0]]
PLACE = [0.02, -0.01, 0.4]


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit status, stdout and stderr of the command."""
    with pytest.raises(SystemExit) as exit_:
        render_command.render([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return int(exit_.value.code or 0), out, err


def pixels(path: Path) -> np.ndarray:
    """[height, width, 3] in [0, 1]."""
    image = cv2.imread(str(path))
    assert image is not None, path
    return image[..., ::-1].astype(np.float64) / 255


def detection_line(**changes: Any) -> dict[str, Any]:
    """A line as curio-detect writes it."""
    detection = {
        "object": "egg",
        "confidence": 1.0,
        "translation_m": PLACE,
        "rotation": np.eye(3).tolist(),
        "rotation_6d": [1, 0, 0, 0, 1, 0],
        "quaternion_xyzw": [0, 0, 0, 1],
        "color": [0.9, 0.4, 0.2],
        "box_px": None,
    }
    line = {"image": "frames/one.jpg", "width": WIDTH, "height": HEIGHT, "camera_matrix": MATRIX}
    return {
        **line,
        "detections": [detection],
        "light": [0.2, -0.4, -0.4],
        "model": {"name": "egg", "version": 1},
    } | changes


@pytest.fixture
def egg(tmp_path: Path) -> Path:
    """A convex mesh."""
    shape = trimesh.creation.icosphere(subdivisions=3)
    path = tmp_path / "egg.ply"
    trimesh.Trimesh(np.asarray(shape.vertices) * [0.06, 0.08, 0.05], shape.faces).export(path)
    return path


@pytest.fixture
def lines(tmp_path: Path) -> Path:
    """Two detections, and between them a frame that could not be read."""
    path = tmp_path / "poses.jsonl"
    failed = {"image": "frames/two.jpg", "error": "not an image", "model": {"name": "egg", "version": 1}}
    records = [detection_line(), failed, detection_line(image="three.png", light=None)]
    path.write_text("".join(json.dumps(record) + "\n" for record in records))
    return path


def test_detections_become_pictures(capsys, lines: Path, egg: Path, tmp_path: Path) -> None:
    status, out, err = run(capsys, lines, "--mesh", egg, "--out", tmp_path / "pictures")
    assert (status, err) == (0, "")
    assert [Path(line).name for line in out.splitlines()] == ["000001-one.png", "000003-three.png"]
    image = pixels(Path(out.splitlines()[0]))
    assert image.shape == (HEIGHT, WIDTH, 3)
    line, column = np.nonzero(image.sum(-1) > 0.1)
    x, y, z = PLACE
    assert column.mean() == pytest.approx(70 * x / z + 30, abs=0.7)
    assert line.mean() == pytest.approx(66 * y / z + 25, abs=0.7)
    red, green, blue = image[25, 33]
    assert red > green > blue


def test_path_tracer_shows_the_same_object(capsys, lines: Path, egg: Path, tmp_path: Path) -> None:
    """One convex object lights and hides nothing else: both draw the same, also where pixels are not square."""
    for folder, flag in (("ours", []), ("traced", ["--path-traced", "--samples", 256])):
        assert run(capsys, lines, "--mesh", egg, "--out", tmp_path / folder, "--height", 96, *flag)[0] == 0
    ours, traced = (pixels(tmp_path / folder / "000001-one.png") for folder in ("ours", "traced"))
    assert ours.shape == traced.shape == (96, 128, 3)
    seen = (ours.sum(-1) > 0) | (traced.sum(-1) > 0)
    assert seen.sum() > 300
    assert np.abs(ours - traced)[seen].mean() < 0.02


def test_objects_lie_over_their_photograph(capsys, egg: Path, tmp_path: Path) -> None:
    photograph = tmp_path / "one.png"
    content = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    cv2.imwrite(str(photograph), content)
    scenes = tmp_path / "scene.json"
    scenes.write_text(json.dumps(detection_line(image=str(photograph)), indent=1))
    for flags in ([], ["--path-traced"]):
        call = [scenes, "--mesh", f"egg={egg}", "--out", tmp_path, "--over-photograph", "--samples", 16, *flags]
        status, out, _ = run(capsys, *call)
        assert status == 0
        image = pixels(Path(out.strip())) * 255
        assert np.abs(image[:8] - content[:8, :, ::-1]).max() <= 1
        assert np.abs(image[20:30, 30:36] - content[20:30, 30:36, ::-1]).mean() > 20


def test_poses_of_a_rig_are_drawn_as_its_first_camera_sees_them(capsys, egg: Path, tmp_path: Path) -> None:
    """The same object in the frame of the camera and in that of a rig, which lies elsewhere, is the same picture."""
    turn = Rotation.from_euler("xyz", [160, 35, 10], degrees=True).as_matrix()
    cam_from_rig = np.eye(4)
    cam_from_rig[:3, :3], cam_from_rig[:3, 3] = turn, [0.3, -0.2, 0.5]
    line = detection_line(views=["frames/one.jpg", "other/one.jpg"], cam_from_rig=cam_from_rig.tolist())
    line["detections"][0] |= {
        "translation_m": (turn.T @ (PLACE - cam_from_rig[:3, 3])).tolist(),
        "rotation": turn.T.tolist(),
    }
    seen = []
    for name, content in (("camera", detection_line()), ("rig", line)):
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
        status, out, err = run(capsys, tmp_path / f"{name}.json", "--mesh", egg, "--out", tmp_path / name)
        assert status == 0, err
        seen.append(pixels(Path(out.strip())))
    assert (seen[0].sum(-1) > 0.1).sum() > 50
    assert seen[1] == pytest.approx(seen[0], abs=2 / 255)


def test_the_camera_is_carried_round_the_middles_of_objects(capsys, egg: Path, tmp_path: Path) -> None:
    """A mesh whose origin is far from its middle, placed at the same spot, is seen the same from the side."""
    away = np.array([0.3, -0.1, 0.2])
    loaded = trimesh.load_mesh(egg)
    trimesh.Trimesh(loaded.vertices + away, loaded.faces).export(tmp_path / "away.ply")
    seen = []
    for mesh, place in ((egg, PLACE), (tmp_path / "away.ply", (PLACE - away).tolist())):
        scenes = tmp_path / "scene.json"
        line = detection_line()
        line["detections"][0]["translation_m"] = place
        scenes.write_text(json.dumps(line))
        status, out, err = run(capsys, scenes, "--mesh", mesh, "--out", tmp_path / mesh.stem, "--turn-deg", 90)
        assert status == 0, err
        seen.append(pixels(Path(out.strip())))
    assert (seen[0].sum(-1) > 0.1).sum() > 50
    assert np.abs(seen[0] - seen[1]).mean() < 0.01


@pytest.mark.parametrize("name", ["varied", "light"])
def test_codes_look_as_in_their_world(capsys, tmp_path: Path, name: str) -> None:
    """From the world's own camera and from 90° round the scene."""
    world = mesh_world(name)
    code = world.sample(1, (3, 4))
    scenes = tmp_path / "codes.jsonl"
    scenes.write_text(json.dumps({"world": name, "code": {key: value[0].tolist() for key, value in code.items()}}))
    with torch.no_grad():
        expected = {0: world.render(code), 90: world.novel_view(code)}
    for turn, image in expected.items():
        status, out, err = run(capsys, scenes, "--out", tmp_path / str(turn), "--turn-deg", turn)
        assert status == 0, err
        difference = np.abs(pixels(Path(out.strip())) - image[0].permute(1, 2, 0).numpy())
        assert difference.mean() < 0.01, turn
        assert image.std() > 0.05


@pytest.mark.parametrize(
    ("content", "arguments", "status", "message"),
    [
        (None, [], 1, "cannot be read"),
        ("", [], 1, "the file is empty"),
        ('{"image": 1}\n{"broken', [], 1, "line 1: found .* expected a line of curio-detect"),
        ('{"error": "no"}\n{"broken', [], 1, "line 2: not JSON"),
        ("[1, 2]", [], 1, "expected a line of curio-detect"),
        (detection_line(detections=[{"object": "egg"}]), [], 1, "line 1: not a scene"),
        (detection_line(light=[0, 1]), [], 1, "light is .* expected finite numbers of shape"),
        (detection_line(camera_matrix=None), [], 1, "it is flat"),
        (detection_line(views=["a.jpg", "b.jpg"]), [], 1, "line 1: its poses are in the frame of a rig"),
        (detection_line(cam_from_rig=[1, 0]), [], 1, "cam_from_rig is .* expected finite numbers of shape"),
        (detection_line(camera_matrix=[[1, 2], [3, 4]]), [], 1, "camera_matrix"),
        (detection_line(), ["--over-photograph"], 1, "one.jpg: the photograph cannot be read"),
        (detection_line(), ["--over-photograph", "--turn-deg", "5"], 2, "exclude each other"),
        (detection_line(), ["--world", "chairs"], 2, "exclude each other"),
        (detection_line(), ["--samples", "0"], 2, "at least 1"),
        (detection_line(), ["--height", "100000"], 2, "--height 100000 for a picture of .*x100000 pixels, expected at"),
        (detection_line(width=90_000, height=80_000, camera_matrix=HUGE), [], 1, "picture of 90000x80000 pixels"),
        ({"world": "atlantis", "code": {}}, [], 1, "expected one of spheres"),
        ({"world": "circles", "code": {}}, [], 1, "expected one of spheres"),
        ({"world": "spheres", "code": {"light": [1, 2]}}, [], 1, "scene code has"),
    ],
)
def test_bad_input_is_one_message(
    capsys, egg: Path, tmp_path: Path, content: object, arguments: list[str], status: int, message: str
) -> None:
    scenes = tmp_path / "scenes.jsonl"
    if content is not None:
        scenes.write_text(content if isinstance(content, str) else json.dumps(content))
    found, out, err = run(capsys, scenes, "--mesh", egg, "--out", tmp_path / "out", *arguments)
    assert (found, out) == (status, "")
    assert err.startswith("error: ")
    assert re.search(message, err), err


def test_missing_meshes_are_named(capsys, lines: Path, egg: Path, tmp_path: Path) -> None:
    assert "add --mesh FILE or --world" in run(capsys, lines, "--out", tmp_path)[2]
    assert "no mesh for object 'egg'" in run(capsys, lines, "--out", tmp_path, "--mesh", f"ball={egg}")[2]
    assert "with different names" in run(capsys, lines, "--out", tmp_path, "--mesh", egg, egg)[2]


def test_a_scene_goes_to_a_3d_application_and_comes_back(capsys, lines: Path, egg: Path, tmp_path: Path) -> None:
    assert run(capsys, lines, "--mesh", egg, "--out", tmp_path / "glb", "--format", "glb")[0] == 0
    assert run(capsys, lines, "--mesh", egg, "--out", tmp_path / "there", "--height", 120)[0] == 0
    file = min((tmp_path / "glb").iterdir())
    assert run(capsys, file, "--mesh", egg, "--out", tmp_path / "back", "--height", 120)[0] == 0
    there, back = (pixels(min((tmp_path / name).iterdir())) for name in ("there", "back"))
    assert back == pytest.approx(there, abs=2 / 255)


def test_a_folder_that_cannot_be_made(capsys, lines: Path, egg: Path, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    status, _, err = run(capsys, lines, "--mesh", egg, "--out", tmp_path / "taken")
    assert status == 1
    assert "the folder cannot be made" in err
