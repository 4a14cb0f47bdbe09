"""The plane that parts stand on: files of camera places, what is seen of it, and where anything ever lay."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from curio_train.capture.plane import CameraPoseFile, changed_pixels, points_on_plane
from curio_train.errors import CameraError, DataError
from curio_train.geometry import Pose

WIDTH, HEIGHT = 96, 72
MATRIX = np.array([[110.0, 0, 47.5], [0, 110, 35.5], [0, 0, 1]])


def camera(tilt_deg: float) -> np.ndarray:
    """A metre above the plane, looking along -z and that much down."""
    tilt = np.radians(tilt_deg)
    matrix = np.eye(4)
    down = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    matrix[:3, :3] = down @ np.diag([1.0, -1.0, -1.0])
    matrix[:3, 3] = -matrix[:3, :3] @ np.array([0, 1.0, 0])
    return matrix


def test_pixels_look_at_the_plane_and_nothing_above_the_horizon() -> None:
    level = camera(5)
    points = points_on_plane(MATRIX, level, WIDTH, HEIGHT)
    assert np.isnan(points[0]).all()
    seen = points[np.isfinite(points).all(axis=2)]
    assert len(seen) > 1000
    assert np.allclose(seen[:, 1], 0)
    back = Pose.from_matrix(level).apply(seen)
    pixels = (back @ MATRIX.T)[:, :2] / back[:, 2:]
    rows, columns = np.nonzero(np.isfinite(points).all(axis=2))
    assert np.allclose(pixels, np.stack([columns, rows], axis=1), atol=1e-6)


def test_where_things_ever_were_is_told_from_noise_and_exposure() -> None:
    random = np.random.default_rng(0)
    plate = random.integers(100, 140, (3, 64, 64)).astype(np.uint8)
    photographs = [(plate * random.uniform(0.95, 1.05)).clip(0, 255).astype(np.uint8) for _ in range(20)]
    with pytest.raises(DataError, match="nothing but the background"):
        changed_pixels(photographs, [plate] * 20)
    for number, photograph in enumerate(photographs):
        photograph[:, 20:30, 2 * number : 2 * number + 8] = 20
    mask = changed_pixels(photographs, [plate] * 20)
    assert mask[22:28, 4:40].all()
    assert not mask[:15].any()
    assert not mask[35:].any()


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (None, "cannot be read"),
        ("{", "not JSON"),
        ("[1]", "expected an object"),
        ("{}", r"has no pose of plate\.png"),
        (json.dumps({"plate.png": {"cam_from_world": [[1, 2], [3, 4]]}}), r"shape \(2, 2\)"),
        (json.dumps({"plate.png": {"cam_from_world": "here"}}), "no matrix"),
        (json.dumps({"plate.png": {"cam_from_world": np.diag([2, 2, 2, 1]).tolist()}}), "not rigid"),
        (json.dumps({"plate.png": {"cam_from_world": camera(-20).tolist()}}), "looks up"),
        (json.dumps({"plate.png": {"cam_from_world": camera(20).tolist(), "unit": None}}), "--distance-m or --objects"),
        (json.dumps({"plate.png": {"cam_from_world": camera(20).tolist(), "unit": "mm"}}), "the unit is 'mm'"),
        ("[" * 100_000, "not JSON .*nested too deeply"),
    ],
)
def test_camera_places_that_do_not_do(tmp_path: Path, content: str | None, expected: str) -> None:
    file = tmp_path / "views.json"
    if content is not None:
        file.write_text(content)
    with pytest.raises(CameraError, match=expected):
        CameraPoseFile.read(file).pose_above_plane(tmp_path / "plate.png")


def test_a_pose_is_in_metres_unless_its_file_says_otherwise(tmp_path: Path) -> None:
    for name, more in (("said.json", {"unit": "m"}), ("silent.json", {})):
        (tmp_path / name).write_text(json.dumps({"plate.png": {"cam_from_world": camera(20).tolist()} | more}))
        found = CameraPoseFile.read(tmp_path / name).pose_above_plane(tmp_path / "plate.png")
        assert np.array_equal(found, camera(20))


def test_a_file_of_camera_places_is_a_regular_file(tmp_path: Path) -> None:
    pipe, large = tmp_path / "pipe.json", tmp_path / "large.json"
    os.mkfifo(pipe)
    large.touch()
    os.truncate(large, 50 << 30)
    for file, expected in ((pipe, "not a regular file"), (Path("/dev/zero"), "not a regular file"), (large, "at most")):
        with pytest.raises(CameraError, match=f"--plane {file}: cannot be read .*{expected}"):
            CameraPoseFile.read(file)


def test_a_file_of_no_photograph_says_so(tmp_path: Path) -> None:
    (tmp_path / "views.json").write_text("{}")
    with pytest.raises(CameraError, match=r"has no pose of plate\.png, nor of any other photograph"):
        CameraPoseFile.read(tmp_path / "views.json").pose_above_plane(tmp_path / "plate.png")


def test_photographs_of_one_name_in_two_folders_are_told_apart(tmp_path: Path) -> None:
    for folder in ("around", "photos"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a.png").write_bytes(b"")
    entry = {"cam_from_world": camera(40).tolist()}
    (tmp_path / "views.json").write_text(json.dumps({"a.png": entry | {"folder": "around"}}))
    views = CameraPoseFile.read(tmp_path / "views.json")
    assert views.is_known(tmp_path / "around" / "a.png")
    assert not views.is_known(tmp_path / "photos" / "a.png")
    (tmp_path / "around" / "a.png").unlink()
    (tmp_path / "around").rmdir()
    assert views.is_known(tmp_path / "photos" / "a.png"), "they may have been moved since"
    (tmp_path / "views.json").write_text(json.dumps({"a.png": entry}))
    assert CameraPoseFile.read(tmp_path / "views.json").is_known(tmp_path / "photos" / "a.png")
