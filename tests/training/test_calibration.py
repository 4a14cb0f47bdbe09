"""Calibration from rendered photographs of boards, whose camera is known."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from curio_train.camera import load_intrinsics, save_intrinsics
from curio_train.capture.calibration import Board, calibrate
from curio_train.capture.options import CalibrateCommand
from curio_train.capture.plane import CameraPoseFile
from curio_train.commands.calibrate import run
from curio_train.commands.train import train
from curio_train.errors import CameraError, DataError, UsageError
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT = 640, 480
MATRIX = np.array([[610.0, 0, 326.0], [0, 606.0, 233.0], [0, 0, 1]])
DISTORTION = np.array([-0.12, 0.05, 0.001, -0.0005, 0.0])
SQUARE_M = 0.03
PX_PER_SQUARE = 60
PLAIN = Board(9, 6, SQUARE_M)
CHARUCO = Board(9, 6, SQUARE_M, 0.022)


def picture(board: Board) -> np.ndarray:
    """The board as it is printed, half a square of white round it."""
    size = (board.columns * PX_PER_SQUARE, board.rows * PX_PER_SQUARE)
    if board.marker_m is None:
        column, row = np.meshgrid(np.arange(size[0]) // PX_PER_SQUARE, np.arange(size[1]) // PX_PER_SQUARE)
        image = np.where((column + row) % 2, 255, 0).astype(np.uint8)
    else:
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        printed = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_m, board.marker_m, dictionary)
        image = printed.generateImage(size)
    return cv2.copyMakeBorder(image, *(PX_PER_SQUARE // 2,) * 4, cv2.BORDER_CONSTANT, value=255)


def photograph(image: np.ndarray, turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """What a distorting camera sees of it: each pixel's ray, undistorted, meets the board's plane."""
    u, v = np.meshgrid(np.arange(WIDTH, dtype=np.float64), np.arange(HEIGHT, dtype=np.float64))
    rays = cv2.undistortPoints(np.stack([u, v], axis=-1).reshape(-1, 1, 2), MATRIX, DISTORTION).reshape(-1, 2)
    step = SQUARE_M / PX_PER_SQUARE
    middle = (np.array(image.shape[::-1]) - 1) / 2
    on_board = np.stack([turn[:, 0] * step, turn[:, 1] * step, shift - turn[:, :2] @ middle * step], axis=1)
    back = np.linalg.inv(on_board)
    seen = np.concatenate([rays, np.ones((len(rays), 1))], axis=1) @ back.T
    places = (seen[:, :2] / seen[:, 2:]).reshape(HEIGHT, WIDTH, 2).astype(np.float32)
    smooth = cv2.GaussianBlur(image, (0, 0), 0.8)
    return cv2.remap(smooth, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderValue=140)


def write(
    folder: Path,
    board: Board,
    count: int,
    largest_tilt_deg: float = 35.0,
    *,
    away_m: tuple[float, float] = (0.38, 0.55),
) -> Path:
    random, image = np.random.default_rng(1), picture(board)
    for number in range(count):
        tilt = random.uniform(-largest_tilt_deg, largest_tilt_deg, 2)
        turn = Rotation.from_euler("xyz", [*tilt, random.uniform(-20, 20)], degrees=True).as_matrix()
        shift = np.array([*random.uniform(-0.06, 0.06, 2), random.uniform(*away_m)])
        noise = random.normal(0, 2, (HEIGHT, WIDTH))
        photo = (photograph(image, turn, shift) + noise).clip(0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"{number:02}.png"), photo)
    return folder


@pytest.mark.parametrize("board", [PLAIN, CHARUCO], ids=["chessboard", "ChArUco"])
def test_the_camera_is_found(tmp_path: Path, board: Board) -> None:
    found = calibrate(write(tmp_path, board, 16), board)
    assert found.num_views >= 12
    assert found.error_px < 0.3
    assert found.camera.matrix == pytest.approx(MATRIX, rel=0.01, abs=4)
    seen = [
        cv2.projectPoints(np.array([[0.35, 0.25, 1.0]]), np.zeros(3), np.zeros(3), matrix, np.array(distortion))[0]
        for matrix, distortion in ((MATRIX, DISTORTION), (found.camera.matrix, found.camera.distortion))
    ]
    assert np.abs(seen[0] - seen[1]).max() < 2, "towards the corner, where distortion counts"


def test_a_lens_is_only_as_complex_as_the_boards_tell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "middle").mkdir()
    found = calibrate(write(tmp_path / "middle", PLAIN, 14, away_m=(0.9, 1.0)), PLAIN)
    assert found.error_px < 0.3
    assert (found.camera.distortion[1], found.camera.distortion[4]) == (0, 0)
    corner = [
        cv2.projectPoints(np.array([[0.5, 0.36, 1.0]]), np.zeros(3), np.zeros(3), matrix, np.array(distortion))[0]
        for matrix, distortion in ((MATRIX, DISTORTION), (found.camera.matrix, found.camera.distortion))
    ]
    assert np.abs(corner[0] - corner[1]).max() < 12, "with k2 and k3 it would be off by far more"
    assert "photograph the board there, too" in found.doubt
    flags = ["--images", str(tmp_path / "middle"), "--board", "8", "5", "--camera-out", str(tmp_path / "camera.json")]
    with pytest.raises(SystemExit):
        train(["capture", "--calibrate", *flags])
    assert "towards the frame's border the lens is uncertain by up to" in capsys.readouterr().out


def test_views_that_are_too_alike(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match="tilt the board"):
        calibrate(write(tmp_path, PLAIN, 8, largest_tilt_deg=0.2), PLAIN)


def test_another_board_is_not_found(tmp_path: Path) -> None:
    write(tmp_path, PLAIN, 6)
    with pytest.raises(CameraError, match="found no board of 8x5 squares in 6 or more of 6 photographs"):
        calibrate(tmp_path, Board(8, 5, SQUARE_M, 0.02))
    with pytest.raises(CameraError, match="found no board of 12x9 squares nor of as many inner corners"):
        calibrate(tmp_path, Board(12, 9, SQUARE_M))


def test_squares_and_inner_corners_are_both_understood(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "board").mkdir()
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "board", PLAIN, 10)
    for counts, text in (("9 6", "counts squares"), ("8 5", "counts the inner corners of a board of 9x6 squares")):
        with pytest.raises(SystemExit) as exit_:
            train(["capture", "--calibrate", "--images", "board", "--board", *counts.split(), "--square-mm", "30"])
        assert exit_.value.code == 0
        assert f"--board {counts} {text}" in capsys.readouterr().out
        assert load_intrinsics(tmp_path / "camera.json").matrix == pytest.approx(MATRIX, rel=0.02, abs=8)


def test_photographs_of_two_sizes(tmp_path: Path) -> None:
    write(tmp_path, PLAIN, 2)
    cv2.imwrite(str(tmp_path / "99.png"), np.zeros((100, 100), np.uint8))
    with pytest.raises(DataError, match="expected one size"):
        calibrate(tmp_path, PLAIN)


@pytest.mark.parametrize(
    "values",
    [(9, 6, 0.00003), (2, 6, 0.03), (9, 6, -1.0), (9, 6, 0.03, 0.05), (9, 6, 0.03, 0.02, "DICT_OF_MINE")],
    ids=str,
)
def test_boards_that_cannot_be(values: tuple[int, int, float]) -> None:
    with pytest.raises(CameraError, match="expected"):
        Board(*values)


def test_the_last_photograph_says_where_the_camera_stands_over_the_board(tmp_path: Path) -> None:
    (tmp_path / "boards").mkdir()
    folder = write(tmp_path / "boards", PLAIN, 12)
    turn = Rotation.from_euler("xyz", [-40, 5, 10], degrees=True).as_matrix()
    middle_m = np.array([0.02, -0.01, 0.6])
    cv2.imwrite(str(folder / "table.png"), photograph(picture(PLAIN), turn, middle_m))
    outputs = {"camera_out": tmp_path / "camera.json", "plane_out": tmp_path / "plane.json"}
    told = run(CalibrateCommand(images=folder, board=(9, 6), **outputs), lambda *_: pytest.fail("no structure"))
    found = CameraPoseFile.read(tmp_path / "plane.json").plane(tmp_path / "any.png")
    normal = -turn[:, 2] * np.sign(turn[:, 2] @ middle_m)
    assert found.normal @ normal > np.cos(np.radians(0.5))
    assert found.offset_m == pytest.approx(normal @ middle_m, abs=0.003)
    assert f"stands {-found.offset_m:.3f} m above the board and looks" in told
    assert "in the last photograph, table.png," in told
    assert "right if squares are 30 mm (--square-mm)" in told
    same = CalibrateCommand(images=folder, board=(9, 6), plane_out=Path("camera.json"))
    with pytest.raises(UsageError, match=r"--plane-out .* is the file of --camera-out, too"):
        run(same, lambda *_: pytest.fail("no structure"))
    cv2.imwrite(str(folder / "zebra.png"), np.full((HEIGHT, WIDTH), 90, np.uint8))
    with pytest.raises(CameraError, match=r"zebra\.png, the last photograph, does not show the whole board"):
        run(CalibrateCommand(images=folder, board=(9, 6), **outputs), lambda *_: pytest.fail("no structure"))


def test_no_file_is_written_over_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The camera that is read among them, by whatever path."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    camera, views = Path("camera.json"), Path("folder/../camera.json")
    camera.write_text("{}")
    for given, told in (
        ({"camera": camera, "views_out": views}, r"--views-out .* is the file of --camera, too"),
        ({"views_out": views}, r"--views-out .* is the file of --camera-out, too"),
        ({"camera_out": Path("a"), "views_out": Path("a")}, "--views-out a is the file of --camera-out, too"),
        ({"camera_out": Path("a"), "plane_out": Path("a"), "board": (9, 6)}, "--plane-out a is the file of"),
    ):
        with pytest.raises(UsageError, match=told):
            run(CalibrateCommand(images=tmp_path, **given), lambda *_: pytest.fail("no structure"))
    assert camera.read_text() == "{}"


def test_the_camera_file_is_read_as_written(tmp_path: Path) -> None:
    camera = load_intrinsics(_written(tmp_path, {"distortion": DISTORTION.tolist()}))
    save_intrinsics(tmp_path / "again.json", camera)
    again = load_intrinsics(tmp_path / "again.json")
    assert (again.matrix == camera.matrix).all()
    assert (again.width, again.height, again.distortion) == (WIDTH, HEIGHT, tuple(DISTORTION))
    with pytest.raises(CameraError, match="cannot be written"):
        save_intrinsics(tmp_path / "none" / "camera.json", camera)
    (tmp_path / "folder").mkdir()
    with pytest.raises(CameraError, match=r"folder: cannot be written \(.*\); name another file: --camera-out"):
        save_intrinsics(tmp_path / "folder", camera)
    there = sorted(path.name for path in tmp_path.iterdir())
    assert there == ["again.json", "camera.json", "folder"], "no draft is left"


def _written(folder: Path, other: dict[str, object]) -> Path:
    path = folder / "camera.json"
    path.write_text(json.dumps({"camera_matrix": MATRIX.tolist(), "width": WIDTH, "height": HEIGHT} | other))
    return path


def test_photographs_of_a_board_are_no_sequence_and_small_boards_are_read_one_way(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--dictionary DICT_5X5_100 has no effect without --marker-mm"):
        run(
            CalibrateCommand(images=tmp_path, board=(6, 4), dictionary="DICT_5X5_100"),
            lambda *_: pytest.fail("no structure"),
        )
    with pytest.raises(UsageError, match="--every 3 is for photographs of a scene"):
        run(CalibrateCommand(images=tmp_path, board=(6, 4), every=3), lambda *_: pytest.fail("no structure"))
    assert [(board.columns, board.rows) for board in Board(3, 4, 0.03).readings] == [(4, 5)]
    assert [(board.columns, board.rows) for board in Board(4, 5, 0.03).readings] == [(5, 6), (4, 5)]
