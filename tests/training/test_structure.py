"""Structure from motion on a generated sequence, the ground under it, and photographs that cannot work."""

import functools
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from curio_train.camera import Intrinsics, load_intrinsics
from curio_train.capture.ground import scale_by_distance, to_world
from curio_train.capture.structure import Structure, every_nth, recover
from curio_train.commands import train as train_command
from curio_train.errors import CameraError, DataError
from curio_train.geometry import camera_looking_at
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT, FOCAL = 480, 360, 520.0
MATRIX = np.array([[FOCAL, 0, 239.5], [0, FOCAL, 179.5], [0, 0, 1]])
NUM_FRAMES = 40
SIDE_M, TEXTURE_PX = 2.0, 1200
# Two walls behind a floor, seen from inside: none hides another. Origin, and the directions of u and v, y up.
PLANES = (
    ((-1.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    ((-1.0, 2.0, -1.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
    ((-1.0, 2.0, 1.0), (0.0, 0.0, -1.0), (0.0, -1.0, 0.0)),
)


def texture(seed: int) -> np.ndarray:
    """Rectangles of all sizes and greys."""
    random = np.random.default_rng(seed)
    image = np.full((TEXTURE_PX, TEXTURE_PX), 128, np.uint8)
    for _ in range(1200):
        x, y = random.integers(0, TEXTURE_PX, 2).tolist()
        width, height = (int(value) for value in 6 + random.exponential(28, 2))
        cv2.rectangle(image, (x, y), (x + width, y + height), int(random.integers(20, 236)), -1)
    return image


def pose(share: float) -> np.ndarray:
    """cam_from_world [4, 4] of a hand-held camera that goes a quarter round the room's middle."""
    angle = np.radians(5 + 80 * share)
    radius = 1.9 + 0.15 * np.sin(9 * share)
    eye = [radius * np.cos(angle), 1.1 + 0.25 * np.sin(7 * share), radius * np.sin(angle)]
    target = [-0.2 + 0.1 * np.sin(5 * share), 0.3, -0.2]
    rotation, shift = camera_looking_at(torch.tensor(eye, dtype=torch.float64), torch.tensor(target).double())
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, shift
    return matrix


def photograph(cam_from_world: np.ndarray, textures: list[np.ndarray]) -> np.ndarray:
    """A plane's picture is a homography of its texture: exact, but for the resampling done at twice the size."""
    fine = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1]]) @ MATRIX
    image = np.zeros((2 * HEIGHT, 2 * WIDTH), np.uint8)
    for (origin, along_u, along_v), picture in zip(PLANES, textures, strict=True):
        step = SIDE_M / TEXTURE_PX
        on_plane = np.stack([np.array(along_u) * step, np.array(along_v) * step, np.array(origin)], axis=1)
        homography = fine @ (cam_from_world[:3, :3] @ on_plane + np.outer(cam_from_world[:3, 3], [0, 0, 1]))
        warped = cv2.warpPerspective(picture, homography, (2 * WIDTH, 2 * HEIGHT), flags=cv2.INTER_AREA)
        inside = cv2.warpPerspective(np.full_like(picture, 255), homography, (2 * WIDTH, 2 * HEIGHT))
        image[inside > 127] = warped[inside > 127]
    return cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], np.ndarray]:
    folder = tmp_path_factory.mktemp("sequence")
    textures = [texture(seed) for seed in range(len(PLANES))]
    truth = np.stack([pose(number / (NUM_FRAMES - 1)) for number in range(NUM_FRAMES)])
    random, paths = np.random.default_rng(0), []
    for number, matrix in enumerate(truth):
        image = photograph(matrix, textures) + random.normal(0, 3, (HEIGHT, WIDTH))
        paths.append(folder / f"{number}.png")
        cv2.imwrite(str(paths[-1]), image.clip(0, 255).astype(np.uint8))
    return paths, truth


@pytest.fixture(scope="module")
def structure(sequence: tuple[list[Path], np.ndarray]) -> Structure:
    return recover(sequence[0])


def relative(structure: Structure, first: int, second: int) -> np.ndarray:
    """second_from_first, [4, 4]."""
    return structure.cam_from_world[second] @ np.linalg.inv(structure.cam_from_world[first])


def test_forty_frames(sequence: tuple[list[Path], np.ndarray], structure: Structure) -> None:
    truth = sequence[1]
    assert len(structure.photographs) == NUM_FRAMES
    assert structure.camera.matrix[0, 0] == pytest.approx(FOCAL, rel=0.02)
    baseline = np.linalg.norm(np.linalg.inv(truth[-1])[:3, 3] - np.linalg.inv(truth[0])[:3, 3])
    metric = scale_by_distance(structure, 0, NUM_FRAMES - 1, float(baseline))
    for number in range(1, NUM_FRAMES):
        true = truth[number] @ np.linalg.inv(truth[0])
        found = relative(metric, 0, number)
        turn = Rotation.from_matrix(found[:3, :3] @ true[:3, :3].T).magnitude()
        assert np.degrees(turn) < 0.5, number
        assert np.linalg.norm(found[:3, 3] - true[:3, 3]) < 0.02 * baseline, number


def test_the_ground_becomes_y_0_and_the_first_camera_stands_towards_z(
    sequence: tuple[list[Path], np.ndarray], structure: Structure
) -> None:
    truth = sequence[1]
    baseline = np.linalg.norm(np.linalg.inv(truth[-1])[:3, 3] - np.linalg.inv(truth[0])[:3, 3])
    world = scale_by_distance(to_world(structure), 0, NUM_FRAMES - 1, float(baseline))
    heights = np.linalg.inv(truth)[:, 1, 3]
    assert world.centres[:, 1] == pytest.approx(heights, abs=0.02), "the floor, not a wall, is the ground"
    x, _, z = world.centres[0]
    assert x == pytest.approx(0, abs=0.01)
    assert z > 1
    ray = world.cam_from_world[0, 2, :3]
    meets = world.centres[0] - ray * world.centres[0, 1] / ray[1]
    assert meets == pytest.approx([0, 0, 0], abs=0.02), "the origin is what the first camera looks at"


def test_a_known_camera_is_kept(sequence: tuple[list[Path], np.ndarray]) -> None:
    camera = Intrinsics(MATRIX, WIDTH, HEIGHT)
    found = recover(every_nth(sequence[0], 4), camera)
    assert found.camera is camera
    turn = (sequence[1][36] @ np.linalg.inv(sequence[1][0]))[:3, :3]
    assert np.degrees(Rotation.from_matrix(relative(found, 0, 9)[:3, :3] @ turn.T).magnitude()) < 0.5


def test_a_camera_file_of_another_size_is_refused(sequence: tuple[list[Path], np.ndarray]) -> None:
    twice = Intrinsics(np.diag([2.0, 2, 1]) @ MATRIX, 2 * WIDTH, 2 * HEIGHT)
    with pytest.raises(DataError, match=f"0.png: found {WIDTH}x{HEIGHT} pixels.* {2 * WIDTH}x{2 * HEIGHT}"):
        recover(every_nth(sequence[0], 4), twice)


def test_all_coefficients_of_a_known_lens_count(tmp_path: Path) -> None:
    """Of a rational model they are large, and nearly cancel each other: these are a Kinect's."""
    lens = (0.52, -2.67, 0.0006, -0.0002, 1.52, 0.40, -2.49, 1.45)
    pixels = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1).reshape(-1, 1, 2).astype(np.float64)
    ideal = cv2.undistortPoints(pixels, MATRIX, np.array(lens), P=MATRIX).reshape(HEIGHT, WIDTH, 2).astype(np.float32)
    random, textures = np.random.default_rng(0), [texture(seed) for seed in range(len(PLANES))]
    truth, paths = [pose(number / 20) for number in range(8)], [tmp_path / f"{number}.png" for number in range(8)]
    for path, matrix in zip(paths, truth, strict=True):
        seen = cv2.remap(photograph(matrix, textures), ideal, None, cv2.INTER_CUBIC, borderValue=128)
        cv2.imwrite(str(path), (seen + random.normal(0, 2, seen.shape)).clip(0, 255).astype(np.uint8))
    found = recover(paths, Intrinsics(MATRIX, WIDTH, HEIGHT, lens))
    assert len(found.photographs) == 8
    turns = [relative(found, 0, n)[:3, :3] @ (truth[n] @ np.linalg.inv(truth[0]))[:3, :3].T for n in range(1, 8)]
    assert np.degrees(Rotation.from_matrix(np.stack(turns)).magnitude()).max() < 0.3


def test_the_command(
    sequence: tuple[list[Path], np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths, truth = sequence
    baseline = np.linalg.norm(np.linalg.inv(truth[39])[:3, 3] - np.linalg.inv(truth[0])[:3, 3])
    flags = ["--images", str(paths[0].parent), "--every", "3", "--distance-m", str(baseline)]
    flags += ["--camera-out", str(tmp_path / "camera.json"), "--views-out", str(tmp_path / "views.json")]
    with pytest.raises(SystemExit) as exit_:
        train_command.train(["capture", "--calibrate", *flags])
    assert not exit_.value.code
    out = capsys.readouterr().out
    assert "placed 14 of 14 photographs, points off by" in out
    assert f"in metres, {baseline:g} from 0.png to 39.png" in out
    assert load_intrinsics(tmp_path / "camera.json").matrix[0, 0] == pytest.approx(FOCAL, rel=0.02)
    view = json.loads((tmp_path / "views.json").read_text())["0.png"]
    assert view["unit"] == "m"
    first = np.array(view["cam_from_world"])
    height = -(first[:3, :3].T @ first[:3, 3])[1]
    assert height == pytest.approx(np.linalg.inv(truth[0])[1, 3], abs=0.03), "metres above the ground"


def test_a_camera_file_that_was_not_named_is_left(
    sequence: tuple[list[Path], np.ndarray],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    found = functools.cache(lambda photographs: recover(photographs, None))  # each call is given the same ones
    monkeypatch.setattr("curio_train.commands.calibrate.recover", lambda given, _camera: found(tuple(given)))
    call = ["capture", "--calibrate", "--images", str(sequence[0][0].parent), "--every", "5"]

    def said(*flags: str) -> str:
        with pytest.raises(SystemExit) as exit_:
            train_command.train([*call, *flags])
        assert not exit_.value.code
        return capsys.readouterr().out

    assert "\ncamera.json: focal length" in said()
    assert load_intrinsics(tmp_path / "camera.json").width == WIDTH
    (tmp_path / "camera.json").write_text("from a board")
    assert "camera.json is there already and was left as it is: to write this camera, add --camera-out" in said()
    assert (tmp_path / "camera.json").read_text() == "from a board"
    assert "\ncamera.json: focal length" in said("--camera-out", "camera.json")
    assert load_intrinsics(tmp_path / "camera.json").width == WIDTH


def calibrate_with_a_stranger(
    frames: list[Path], stranger: int, folder: Path, capsys: pytest.CaptureFixture[str]
) -> tuple[int, str, str]:
    """The command on every fifth of 40 frames, one of which shows another scene; each camera is at its distance."""
    (folder / "images").mkdir()
    for number, path in enumerate(frames):
        if number == stranger:
            cv2.imwrite(str(folder / "images" / path.name), texture(100)[:HEIGHT, :WIDTH])
        else:
            (folder / "images" / path.name).symlink_to(path)
    flags = ["--images", folder / "images", "--every", 5, "--distance-m", 1.0, "--camera-out", folder / "camera.json"]
    with pytest.raises(SystemExit) as exit_:
        train_command.train(["capture", "--calibrate", *map(str, flags), "--views-out", str(folder / "views.json")])
    captured = capsys.readouterr()
    return int(exit_.value.code or 0), captured.out, captured.err


@pytest.mark.parametrize(("stranger", "end"), [(0, "first"), (35, "last")], ids=["first", "last"])
def test_a_distance_to_a_camera_without_a_place_is_refused(
    stranger: int,
    end: str,
    sequence: tuple[list[Path], np.ndarray],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    status, _, err = calibrate_with_a_stranger(sequence[0], stranger, tmp_path, capsys)
    assert status == 1
    assert f"from 0.png to 35.png, but {stranger}.png was not placed" in err
    assert f"new {end} photograph" in err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["images"], "nothing of a wrong scale is written"


def test_photographs_without_a_place_are_named(
    sequence: tuple[list[Path], np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, err = calibrate_with_a_stranger(sequence[0], 20, tmp_path, capsys)
    assert status == 0, err
    assert "placed 7 of 8 photographs (not placed: 20.png), points off by" in out
    assert "20.png" not in json.loads((tmp_path / "views.json").read_text())


def test_no_texture(tmp_path: Path) -> None:
    random, paths = np.random.default_rng(0), [tmp_path / f"{number}.png" for number in range(8)]
    for path in paths:
        cv2.imwrite(str(path), (random.normal(128, 1.5, (HEIGHT, WIDTH))).astype(np.uint8))
    with pytest.raises(CameraError, match="texture"):
        recover(paths)


def test_no_overlap(tmp_path: Path) -> None:
    paths = [tmp_path / f"{number}.png" for number in range(6)]
    for number, path in enumerate(paths):
        cv2.imwrite(str(path), texture(100 + number)[:HEIGHT, :WIDTH])
    with pytest.raises(CameraError, match="overlap"):
        recover(paths)


def test_a_still_camera_sees_no_depth(tmp_path: Path) -> None:
    random, image = np.random.default_rng(0), photograph(pose(0.5), [texture(seed) for seed in range(3)])
    paths = [tmp_path / f"{number}.png" for number in range(6)]
    for path in paths:
        noisy = (image + random.normal(0, 3, image.shape)).clip(0, 255)
        cv2.imwrite(str(path), noisy.astype(np.uint8))
    with pytest.raises(CameraError):
        recover(paths)


def test_too_few_photographs(sequence: tuple[list[Path], np.ndarray]) -> None:
    with pytest.raises(DataError, match="at least 3"):
        recover(sequence[0][:2])
    with pytest.raises(DataError, match="--every 30 leaves 2; expected at least"):
        every_nth(sequence[0], 30)
