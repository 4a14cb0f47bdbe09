"""Photographs that scenes are drawn over: as a pinhole camera of the scene's K takes them, from files and videos."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from curio_serve.imaging.camera import PinholeCamera
from curio_train.drawing.album import MeshFiles, draw
from curio_train.drawing.glb import from_glb, to_glb
from curio_train.drawing.photograph import photograph_of
from curio_train.drawing.pictures import RenderOptions, SceneContext
from curio_train.drawing.scenes import Scene, read_scenes
from curio_train.errors import DataError
from curio_train.meshes.meshes import to_ply
from curio_train.meshes.shapes import box
from curio_train.viewing.pages import Opening, Page, open_pages
from curio_train.viewing.saving import save
from PIL import Image
from rerun.chunk import RrdReader

WIDTH, HEIGHT = 320, 240
K = np.array([[280.0, 0, 158.0], [0, 285.0, 121.0], [0, 0, 1]])
DISTORTION = (-0.3, 0.1, 0.002, -0.001, 0.0)
POINTS = np.array([[-0.4, -0.3, 1], [0.4, -0.25, 1], [-0.35, 0.3, 1], [0.1, 0.05, 1]])
COLORS = ((255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255))


def spots(camera: PinholeCamera) -> np.ndarray:
    """A dark image that shows each of the points as a disc of its colour."""
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for (x, y), color in zip(camera.project(POINTS), COLORS, strict=True):
        cv2.circle(pixels, (round(16 * x), round(16 * y)), 16 * 5, color, cv2.FILLED, cv2.LINE_AA, shift=4)
    return pixels


def found_px(pixels: np.ndarray) -> np.ndarray:
    """Where the discs are [4, 2]; the white one is what has all colours."""
    bright = pixels.astype(float) > 128
    rest = [bright[..., i] & ~bright.all(axis=2) for i in range(3)]
    return np.array([np.argwhere(shown)[:, ::-1].mean(axis=0) for shown in (*rest, bright.all(axis=2))])


def written(file: Path, image: str | Path, camera: PinholeCamera, size: tuple[int, int], **more: Any) -> Path:
    """A result file that says what curio-detect says of an image without objects."""
    record = {"image": str(image), "width": size[0], "height": size[1], "camera_matrix": camera.matrix.tolist()}
    distorted = {"distortion": list(camera.distortion)} if camera.distortion else {}
    file.write_text(json.dumps(record | distorted | more | {"detections": [], "light": None}) + "\n")
    return file


@pytest.fixture
def mesh(tmp_path: Path) -> Path:
    path = tmp_path / "box.ply"
    path.write_bytes(to_ply(box((0.1, 0.2, 0.3))))
    return path


def over_photograph(results: Path, mesh: Path) -> np.ndarray:
    options = RenderOptions(over_photograph=True)
    (path,) = draw(results, results.parent / "drawn", MeshFiles((str(mesh),), "m"), None, options)
    return cv2.imread(str(path))[..., ::-1]


def viewed(results: Path, mesh: Path) -> np.ndarray:
    (page,) = open_pages(Opening(str(results), MeshFiles((str(mesh),), "m")))
    assert page.over_image
    return page.image


def recorded(results: Path, mesh: Path) -> np.ndarray:
    (path,) = draw(results, results.parent / "drawn", MeshFiles((str(mesh),), "m"), None, RenderOptions(), "rrd")
    batches = [chunk.to_record_batch() for chunk in RrdReader(path).stream() if chunk.entity_path == "/camera/image"]
    ((blob,),) = [batch.column("EncodedImage:blob").to_pylist() for batch in batches]
    return cv2.imdecode(np.frombuffer(bytes(blob[0]), np.uint8), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)


WAYS = pytest.mark.parametrize("shown", [over_photograph, viewed, recorded])


@WAYS
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_photograph_is_turned_and_undistorted(
    shown: Callable[[Path, Path], np.ndarray], orientation: int, mesh: Path, tmp_path: Path
) -> None:
    stored, turns = PinholeCamera(K, DISTORTION), {1: 0, 3: 2, 6: 1, 8: 3}[orientation]
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(spots(stored)).save(tmp_path / "a.jpg", exif=exif, quality=95)
    camera, size = stored.turned(turns, WIDTH, HEIGHT), (HEIGHT, WIDTH) if turns % 2 else (WIDTH, HEIGHT)
    rotated = {} if orientation == 1 else {"exif_rotation": True}
    image = shown(written(tmp_path / "poses.jsonl", tmp_path / "a.jpg", camera, size, **rotated), mesh)
    assert image.shape == (*size[::-1], 3)
    rotation = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # of what the camera sees, by a quarter turn clockwise
    seen = POINTS @ np.linalg.matrix_power(rotation, turns).T
    expected_px = PinholeCamera(camera.matrix).project(seen)
    assert found_px(image) == pytest.approx(expected_px, abs=0.6)


@WAYS
def test_lines_without_the_fields_show_the_photograph_as_stored(
    shown: Callable[[Path, Path], np.ndarray], mesh: Path, tmp_path: Path
) -> None:
    camera = PinholeCamera(K)
    exif = Image.Exif()
    exif[0x0112] = 3
    Image.fromarray(spots(camera)).save(tmp_path / "a.png", exif=exif)
    image = shown(written(tmp_path / "poses.jsonl", tmp_path / "a.png", camera, (WIDTH, HEIGHT)), mesh)
    assert np.array_equal(image, spots(camera))


@pytest.mark.parametrize("form", ["glb", "jsonl"])
def test_an_edited_scene_keeps_its_photograph(form: str, tmp_path: Path) -> None:
    camera = PinholeCamera(K, DISTORTION)
    (scene,) = read_scenes(written(tmp_path / "a.jsonl", "a.jpg", camera, (WIDTH, HEIGHT), exif_rotation=True))
    file, context = tmp_path / f"edited.{form}", SceneContext({"": box((0.1, 0.2, 0.3))})
    if form == "glb":
        file.write_bytes(to_glb(scene, context))
    else:
        save(Page(scene, context, spots(camera), over_image=True), file)
    back = from_glb(file) if form == "glb" else next(read_scenes(file))
    assert (back.distortion, back.exif_rotation) == (DISTORTION, True)


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """Four frames, each brighter than the one before."""
    path = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (WIDTH, HEIGHT))
    for number in range(4):
        writer.write(np.full((HEIGHT, WIDTH, 3), 50 * number, np.uint8))
    writer.release()
    return path


@WAYS
@pytest.mark.parametrize("name", ["clip.avi#2", "{}/clip.avi#2"])
def test_a_frame_of_a_video_is_read_from_it(
    shown: Callable[[Path, Path], np.ndarray], name: str, clip: Path, mesh: Path
) -> None:
    camera, name = PinholeCamera(K), name.format(clip.parent)
    image = shown(written(clip.parent / "poses.jsonl", name, camera, (WIDTH, HEIGHT)), mesh)
    assert image == pytest.approx(np.full((HEIGHT, WIDTH, 3), 100), abs=3)


def test_frames_of_a_video_come_in_any_order(clip: Path) -> None:
    def frame(number: int) -> np.ndarray:
        return photograph_of(Scene("a", WIDTH, HEIGHT, K, (), None, Path(f"{clip}#{number}")))

    assert [round(frame(number).mean() / 50) for number in (0, 1, 1, 3, 3, 0, 2)] == [0, 1, 1, 3, 3, 0, 2]
    with pytest.raises(DataError, match=r"found 4 frames .* expected frame 4"):
        frame(4)
    assert round(frame(1).mean() / 50) == 1


def test_frames_after_a_damaged_one_are_those_that_were_detected_in(clip: Path) -> None:
    parts = clip.read_bytes().split(b"00dc")  # the header, and from the third on the frames
    parts[3] = parts[3][:4] + bytes(len(parts[3]) - 4)
    clip.write_bytes(b"00dc".join(parts))
    scenes = [Scene("a", WIDTH, HEIGHT, K, (), None, Path(f"{clip}#{number}")) for number in range(4)]
    assert [round(photograph_of(scenes[number]).mean() / 50) for number in (2, 3)] == [2, 3]
    with pytest.raises(DataError, match="damaged at frame 1"):
        photograph_of(scenes[1])


@WAYS
@pytest.mark.parametrize(
    ("image", "told"),
    [
        ("run.mcap#/camera/image_raw@1700000000.100000000", "frames of recordings cannot be drawn over"),
        ("gone.png", "gone.png: the photograph cannot be read"),
        ("gone.mp4#12", "gone.mp4: the photograph cannot be read"),
        ("poses.jsonl#0", "found 0 frames that can be decoded"),
        ("small.png", "found 64x64 pixels, expected the shape"),
    ],
)
def test_what_cannot_be_drawn_over_is_named(
    shown: Callable[[Path, Path], np.ndarray], image: str, told: str, mesh: Path, tmp_path: Path
) -> None:
    (tmp_path / "run.mcap").write_bytes(b"")
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((64, 64, 3), np.uint8))
    camera = PinholeCamera(K, DISTORTION)  # so that the recording does not take the file as it is
    with pytest.raises(DataError, match=told):
        shown(written(tmp_path / "poses.jsonl", image, camera, (WIDTH, HEIGHT)), mesh)
