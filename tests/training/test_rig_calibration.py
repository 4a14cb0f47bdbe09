"""Rigs from drawn photographs of boards, whose cameras are known."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from curio_serve.rigs.rig import read_rig_file
from curio_train.capture.calibration import Board
from curio_train.capture.rig import calibrate_rig
from curio_train.commands.train import train
from curio_train.errors import CameraError, DataError
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT, SQUARE_M, PX = 640, 480, 0.03, 60
MATRICES = [
    np.array([[610.0, 0, 326.0], [0, 606.0, 233.0], [0, 0, 1]]),
    np.array([[560.0, 0, 315], [0, 560, 241], [0, 0, 1]]),
]
CHARUCO, PLAIN, SQUARE = Board(9, 6, SQUARE_M, 0.022), Board(9, 6, SQUARE_M), Board(8, 8, SQUARE_M)
INNER, SQUARE_INNER = Board(8, 5, SQUARE_M), Board(7, 7, SQUARE_M)
"""The plain boards counted by inner corners. These are looked for first, and looking for squares in vain takes long."""


def _second(roll_deg: float = -2) -> np.ndarray:
    """Right from left: 0.25 m beside it, turned towards the same place."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [3, 28, roll_deg], degrees=True).as_matrix()
    pose[:3, 3] = np.array([0, 0, 0.48]) - pose[:3, :3] @ np.array([0, 0, 0.47]) + np.array([0.0, 0.01, 0.0])
    return pose


def _print(board: Board) -> np.ndarray:
    size = (board.columns * PX, board.rows * PX)
    if board.marker_m is None:
        row, column = np.indices(size[::-1]) // PX
        image = np.where((row + column) % 2, 255, 0).astype(np.uint8)
    else:
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        image = cv2.aruco.CharucoBoard((9, 6), SQUARE_M, board.marker_m, dictionary).generateImage(size)
    return cv2.GaussianBlur(cv2.copyMakeBorder(image, *(PX // 2,) * 4, cv2.BORDER_CONSTANT, value=255), (0, 0), 0.8)


def _write(folder: Path, board: Board, count: int = 14, roll_deg: float = -2) -> Path:
    random, image = np.random.default_rng(3), _print(board)
    step, middle = SQUARE_M / PX, (np.array(image.shape[::-1]) - 1) / 2
    for number in range(count):
        held = np.eye(4)
        angles = [*random.uniform(-30, 30, 2), random.uniform(-15, 15)]
        held[:3, :3] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
        held[:3, 3] = [*random.uniform(-0.03, 0.03, 2), random.uniform(0.42, 0.52)]
        for name, matrix, pose in (("left", MATRICES[0], np.eye(4)), ("right", MATRICES[1], _second(roll_deg))):
            seen = pose @ held
            on_board = np.array([[step, 0, -step * middle[0]], [0, step, -step * middle[1]], [0, 0, 1]])
            homography = matrix @ np.stack([seen[:3, 0], seen[:3, 1], seen[:3, 3]], axis=1) @ on_board
            photo = cv2.warpPerspective(image, homography, (WIDTH, HEIGHT), flags=cv2.INTER_AREA, borderValue=140)
            photo = (photo + random.normal(0, 2, photo.shape)).clip(0, 255).astype(np.uint8)
            (folder / name).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / name / f"{number:02}.png"), photo)
    return folder


@pytest.mark.parametrize(
    ("board", "asked", "roll_deg"),
    [
        (PLAIN, PLAIN, -2),
        (CHARUCO, CHARUCO, -2),
        (SQUARE, SQUARE_INNER, -2),
        (SQUARE, SQUARE_INNER, 45),
        (SQUARE, SQUARE_INNER, 90),
        (PLAIN, INNER, 90),
    ],
    ids=["chessboard", "ChArUco", "square chessboard", "rolled, square", "turned, square", "turned"],
)
def test_cameras_are_found_where_they_stand(tmp_path: Path, board: Board, asked: Board, roll_deg: float) -> None:
    rig = calibrate_rig(_write(tmp_path, board, roll_deg=roll_deg), asked)
    assert rig.names == ("left", "right")
    assert rig.num_instants[1] >= 8
    error = np.linalg.inv(_second(roll_deg)) @ rig.cam_from_rig[1]
    assert np.linalg.norm(error[:3, 3]) < 0.006
    assert np.degrees(np.arccos((np.trace(error[:3, :3]) - 1) / 2)) < 0.6


def test_the_command_writes_what_serving_reads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, out = _write(tmp_path / "boards", CHARUCO), tmp_path / "rig.json"
    (folder / ".thumbnails").mkdir()
    flags = ["--board", "9", "6", "--square-mm", "30", "--marker-mm", "22", "--rig-out", str(out)]
    with pytest.raises(SystemExit) as ended:
        train(["capture", "--calibrate", "--images", str(folder), *flags])
    assert ended.value.code == 0
    left, right = read_rig_file(out)
    assert (left.name, right.name, left.camera.size) == ("left", "right", (WIDTH, HEIGHT))
    np.testing.assert_allclose(right.cam_from_rig, _second(), atol=0.012)
    said = capsys.readouterr().out
    assert "2 cameras" in said
    assert "distances are right if squares are 30 mm (--square-mm)" in said
    assert "right: focal length" in said
    with pytest.raises(SystemExit) as ended:
        train(["capture", "--calibrate", "--images", str(folder), "--rig-out", str(out)])
    assert ended.value.code == 2
    assert json.loads(out.read_text())["cameras"][0]["cam_from_rig"] == np.eye(4).tolist()


def test_photographs_of_no_rig_are_refused(tmp_path: Path) -> None:
    folder = _write(tmp_path / "boards", CHARUCO, 9)
    for path in (folder / "right").iterdir():
        path.rename(path.with_name(f"other{path.name}"))
    with pytest.raises(CameraError, match="left and right both see the board in 0 photographs"):
        calibrate_rig(folder, CHARUCO)
    shuffled = sorted((folder / "right").iterdir())
    for number, path in enumerate(shuffled):
        path.rename(path.with_name(f"{(number + 1) % len(shuffled):02}.png"))
    with pytest.raises(CameraError, match="did a camera or the board move"):
        calibrate_rig(folder, CHARUCO)
    with pytest.raises(DataError, match="has 0 folders"):
        calibrate_rig(folder / "left", CHARUCO)
    for name, reason in (("none", "No such file or directory"), ("a" * 300, "File name too long")):
        with pytest.raises(DataError, match=rf"{name}: cannot be listed \({reason}\)"):
            calibrate_rig(tmp_path / name, CHARUCO)
