"""Stand-in captures: what lies in the folder, that labels are true, and that interrupted work goes on."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from curio_train.errors import DataError, UsageError
from curio_train.geometry import Pose
from curio_train.meshes.meshes import load_mesh
from scipy.spatial.transform import Rotation
from synthetic_captures import scenes
from synthetic_captures.boards import calibrated, photograph_boards
from synthetic_captures.captures import Amount, make
from synthetic_captures.sensor import Sensor

AMOUNT = Amount(num_photos=3, num_tests=1, samples_per_pixel=8)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stand_ins")
    assert make("sphere_real", folder, AMOUNT, lambda _: None) == 7
    return folder / "sphere_real"


def test_labels_say_where_things_are_seen(capture: Path) -> None:
    """Against the empty plate, each sphere is where its pose and the true camera put it."""
    labels = json.loads((capture / "labels" / "test.json").read_text())
    views = json.loads((capture / "views.json").read_text())
    for file, things in labels["photographs"].items():
        photo, plate = (cv2.imread(str(capture / path)).astype(float) for path in (file, views[file]["plate"]))
        changed = cv2.GaussianBlur(np.abs(photo - plate).max(axis=2), (0, 0), 2) > 40
        assert len(things) == 3
        for thing in things:
            at = np.array(labels["camera_matrix"]) @ np.array(thing["cam_from_obj"])[:3, 3]
            column, row = (at[:2] / at[2]).round().astype(int)
            assert changed[row, column], f"{file}: nothing at ({column}, {row})"
        assert 0.01 < changed.mean() < 0.25


def test_cameras_stand_a_quarter_apart_and_are_known_but_for_small_errors(capture: Path) -> None:
    views = json.loads((capture / "views.json").read_text())
    a, b = (np.array(views[f"test/{side}/0000.png"]["cam_from_world"]) for side in "ab")
    centres = [-(matrix[:3, :3].T @ matrix[:3, 3])[[0, 2]] for matrix in (a, b)]
    angle = np.degrees(np.arccos(centres[0] @ centres[1] / np.linalg.norm(centres[0]) / np.linalg.norm(centres[1])))
    assert angle == pytest.approx(90, abs=1)
    off = Rotation.from_matrix(a[:3, :3] @ scenes.cam_from_world(0)[:3, :3].T).magnitude()
    assert 0 < np.degrees(off) < 1


@pytest.mark.parametrize("name", scenes.NAMES)
def test_cameras_are_calibrated_from_photographs_of_a_board(name: str, tmp_path: Path) -> None:
    true, size = scenes.camera_matrix(name), scenes.frame_size(name)
    photograph_boards(tmp_path, true, size, scenes.NAMES.index(name))
    camera = calibrated(tmp_path)
    assert (camera.width, camera.height) == size
    off = np.abs(camera.matrix - true)
    assert 0 < off[0, 0] < 0.02 * true[0, 0]
    assert 0 < off[:2, 2].max() < 0.015 * size[0]


def test_training_files_hold_no_labels(capture: Path) -> None:
    apart = [path for path in capture.rglob("*") if path.is_file() and path.parent.name != "labels"]
    assert {path.suffix for path in apart} == {".png", ".json", ".stl"}
    for path in apart:
        if path.suffix == ".json":
            assert "cam_from_obj" not in path.read_text()
    mesh = load_mesh(capture / "meshes" / "sphere.stl")
    assert mesh.diameter_m == pytest.approx(0.07, rel=0.01)
    assert mesh.vertex_colors_srgb is None


def test_an_interrupted_call_goes_on_with_the_same_pictures(capture: Path) -> None:
    kept, lost = capture / "photos" / "0000.png", capture / "photos" / "0002.png"
    before, written = cv2.imread(str(lost)).astype(int), kept.stat().st_mtime_ns
    lost.unlink()
    assert make("sphere_real", capture.parent, AMOUNT, lambda _: None) == 1
    assert np.abs(cv2.imread(str(lost)).astype(int) - before).max() <= 2
    assert kept.stat().st_mtime_ns == written


@pytest.mark.parametrize(
    ("name", "fewest", "most"), [("sphere_real", 3, 3), ("bunny", 1, 1), ("shapes", 5, 12), ("part", 1, 1)]
)
def test_scenes_are_drawn_by_seed_and_nothing_touches(name: str, fewest: int, most: int) -> None:
    kinds = [kind for kind in scenes.kinds(name) for _ in range(kind.count)]
    for number in range(20):
        things, again = (scenes.draw(name, np.random.default_rng((7, number))) for _ in range(2))
        assert fewest <= len(things) <= most
        assert all((a.world_from_obj == b.world_from_obj).all() for a, b in zip(things, again, strict=True))
        clouds = []
        for thing in things:
            clouds.append(Pose.from_matrix(thing.world_from_obj).apply(kinds[thing.slot].mesh.vertices_m))
            assert clouds[-1][:, 1].min() == pytest.approx(0, abs=1e-9), "it stands on the table"
        for number_a, a in enumerate(clouds):
            for b in clouds[:number_a]:
                assert np.linalg.norm(a[::7, None] - b[None, ::7], axis=2).min() > 0


def test_a_sensor_adds_noise_vignetting_and_never_the_same_twice() -> None:
    light, random = np.full((64, 96, 3), 0.4), np.random.default_rng(0)
    first, second = (Sensor().develop(light, random).astype(float) for _ in range(2))
    assert (first - second).std() > 0.3
    assert first[28:36, 44:52].mean() > first[:6, :6].mean() + 8, "corners are darker"
    assert first[..., 0].mean() > first[..., 2].mean(), "warm"


def test_unknown_scene_and_bad_folder(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="sphere_real, bunny, shapes"):
        make("cube", tmp_path, AMOUNT, lambda _: None)
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="cannot be written"):
        make("bunny", tmp_path / "file", AMOUNT, lambda _: None)
