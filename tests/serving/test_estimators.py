"""One suite for both estimators: what ``curio-detect`` writes, with the model on this machine and behind a server."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from curio_serve.batch.arguments import DetectArguments
from curio_serve.batch.detect_cli import run

SIZE = (320, 240)
K = [[300.0, 0, 160.0], [0, 301.0, 119.0], [0, 0, 1]]


@pytest.fixture(params=["local", "remote"])
def detect(request: pytest.FixtureRequest, models_dir: Path) -> Callable[..., int]:
    """``detect(model, *images, **flags)``: exit status of a call in this process."""
    where = models_dir if request.param == "local" else request.getfixturevalue("server").address

    def call(model: str, *images: Path | str, **flags: Any) -> int:
        if flags.get("out") is not None:
            flags["out"] = str(flags["out"])
        return run(DetectArguments(f"{where}/{model}", tuple(map(str, images)), **flags))

    return call


def read(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_a_folder_gives_a_line_an_image_in_order(detect: Callable[..., int], frames: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.jsonl"
    assert detect("flat", frames, out=out, jobs=3) == 0
    lines = read(out)
    assert [line["image"] for line in lines] == [str(frames / f"{n:06d}.png") for n in range(6)]
    for number, line in enumerate(lines):
        assert (line["width"], line["height"]) == SIZE
        assert line["camera_matrix"] is None
        assert line["model"] == {"name": "flat", "version": 1}
        (found,) = line["detections"]
        expected = [(100 + 20 * number - 159.5) / 320, (120 - 119.5) / 320, 0]
        np.testing.assert_allclose(found["translation_m"], expected, atol=0.003)
        assert found["rotation"] is None
        assert line["milliseconds"]["inference"] > 0


def test_poses_in_space_use_the_camera_file(
    detect: Callable[..., int], frames: Path, camera: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out.jsonl"
    assert detect("pinhole", frames, camera=camera, out=out) == 0
    for number, line in enumerate(read(out)):
        assert line["camera_matrix"] == K
        (found,) = line["detections"]
        x, y, z = found["translation_m"]
        np.testing.assert_allclose([300 * x / z + 160, 301 * y / z + 119], [100 + 20 * number, 120], atol=0.5)
        rotation = np.array(found["rotation"])
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
        np.testing.assert_allclose(rotation[:, :2].T.ravel(), found["rotation_6d"], atol=1e-12)
        assert np.shape(found["box_px"]) == (8, 2)
        assert len(line["light"]) == 3


def test_confidence_and_count_select(detect: Callable[..., int], tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((240, 320, 3), np.uint8))
    for threshold, count in ((0.0, 1), (0.5, 0)):
        out = tmp_path / f"{threshold}.jsonl"
        assert detect("flat", tmp_path / "black.png", out=out, min_confidence=threshold) == 0
        assert len(read(out)[0]["detections"]) == count


def bad_images() -> dict[str, bytes]:
    """By name, images that are refused; every other kind in the next function is accepted."""
    jpeg = cv2.imencode(".jpg", np.full((240, 320, 3), 90, np.uint8))[1].tobytes()
    return {
        "empty.jpg": b"",
        "text.png": b"this is not an image",
        "cut.jpg": jpeg[:300],
        "tiny.png": cv2.imencode(".png", np.zeros((1, 1, 3), np.uint8))[1].tobytes(),
    }


def good_images() -> dict[str, bytes]:
    plain = np.full((240, 320, 3), 90, np.uint8)
    return {
        "16bit.png": cv2.imencode(".png", plain.astype(np.uint16) * 257)[1].tobytes(),
        "grey.png": cv2.imencode(".png", plain[..., 0])[1].tobytes(),
        "alpha.png": cv2.imencode(".png", np.dstack([plain, plain[..., :1]]))[1].tobytes(),
    }


def test_bad_images_get_an_error_line_and_stop_nothing(
    detect: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "mixed"
    folder.mkdir()
    for name, data in (bad_images() | good_images()).items():
        (folder / name).write_bytes(data)
    out = tmp_path / "out.jsonl"
    assert detect("flat", folder, out=out) == 1
    lines = {Path(line["image"]).name: line for line in read(out)}
    assert set(lines) == {*bad_images(), *good_images()}
    for name, line in lines.items():
        assert ("error" in line) == (name in bad_images())
        assert ("detections" in line) != ("error" in line)
    told = capsys.readouterr().err
    assert "4 images have no answer" in told
    assert all(name in told for name in bad_images())
    assert detect("flat", folder, out=out) == 1  # gone on with nothing to do: still not all right


def test_a_camera_of_another_size_is_an_error_of_each_image(
    detect: Callable[..., int], frames: Path, tmp_path: Path
) -> None:
    camera = tmp_path / "camera.json"
    camera.write_text(json.dumps({"camera_matrix": K, "width": 640, "height": 480}))
    out = tmp_path / "out.jsonl"
    assert detect("pinhole", frames, camera=camera, out=out) == 1
    assert all("640x480" in line["error"] and "320x240" in line["error"] for line in read(out))


def test_overlays_mirror_the_images_and_leave_them_alone(
    detect: Callable[..., int], frames: Path, camera: Path, tmp_path: Path
) -> None:
    (frames / "below").mkdir()
    first = frames / "000000.png"
    (frames / "below" / "000000.png").write_bytes(first.read_bytes())
    before = first.read_bytes()
    drawn = tmp_path / "drawn"
    assert detect("pinhole", frames, camera=camera, out=tmp_path / "out", overlays=drawn) == 0
    found = sorted(str(path.relative_to(drawn)) for path in drawn.rglob("*") if path.is_file())
    assert found == sorted(str(path.relative_to(frames)) for path in frames.rglob("*") if path.is_file())
    assert first.read_bytes() == before
    picture = cv2.imread(str(drawn / "000000.png"))
    assert picture.shape == (240, 320, 3)
    assert (picture != cv2.imread(str(first))).any(axis=2).sum() > 200


def test_bop_scenes_take_k_by_image_number_and_give_bop_results(
    detect: Callable[..., int], frames: Path, tmp_path: Path
) -> None:
    scene = tmp_path / "test" / "000007"
    scene.mkdir(parents=True)
    frames.rename(scene / "rgb")
    cameras = {str(n): {"cam_K": [300 + n, 0, 160, 0, 301, 119, 0, 0, 1], "depth_scale": 1} for n in range(6)}
    (scene / "scene_camera.json").write_text(json.dumps(cameras))
    flags = {"camera": scene / "scene_camera.json"}
    lines, results = tmp_path / "out.jsonl", tmp_path / "out.csv"
    assert detect("pinhole", tmp_path / "test", out=lines, **flags) == 0
    assert [line["camera_matrix"][0][0] for line in read(lines)] == [300 + n for n in range(6)]
    assert detect("pinhole", tmp_path / "test", out=results, format="bop", obj_id=4, **flags) == 0
    with results.open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["scene_id", "im_id", "obj_id", "score", "R", "t", "time"]
    for number, (row, line) in enumerate(zip(rows, read(lines), strict=True)):
        assert (row["scene_id"], row["im_id"], row["obj_id"]) == ("7", str(number), "4")
        (found,) = line["detections"]
        np.testing.assert_allclose(
            np.array(row["t"].split(), float), 1000 * np.array(found["translation_m"]), rtol=1e-6
        )
        np.testing.assert_allclose(np.array(row["R"].split(), float), np.ravel(found["rotation"]), atol=1e-6)


def with_exif_orientation(jpeg: bytes, orientation: int) -> bytes:
    """The same file with an EXIF segment that has that one entry."""
    tiff = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0" + bytes([orientation, 0, 0, 0]) + b"\0\0\0\0"
    segment = b"Exif\0\0" + tiff
    return jpeg[:2] + b"\xff\xe1" + (len(segment) + 2).to_bytes(2, "big") + segment + jpeg[2:]


def test_exif_rotation_is_ignored_unless_asked_for_and_then_turns_k(
    detect: Callable[..., int], camera: Path, tmp_path: Path, spot_image: Callable[..., np.ndarray]
) -> None:
    pixels = spot_image(*SIZE, 200, 100, 12, 12, (255, 255, 255))
    stored = cv2.imencode(".jpg", pixels)[1].tobytes()
    (tmp_path / "turned.jpg").write_bytes(with_exif_orientation(stored, 6))
    answers = {}
    for flag in (False, True):
        out = tmp_path / f"{flag}.jsonl"
        status = detect("pinhole", tmp_path / "turned.jpg", camera=camera, out=out, exif_rotation=flag)
        assert status == 0
        (answers[flag],) = read(out)
    assert (answers[False]["width"], answers[False]["height"]) == (320, 240)
    assert (answers[True]["width"], answers[True]["height"]) == (240, 320)
    assert answers[False]["camera_matrix"] == K
    assert answers[True]["camera_matrix"] == [[301, 0, 239 - 119], [0, 300, 160], [0, 0, 1]]
    assert "exif_rotation" not in answers[False]
    assert answers[True]["exif_rotation"] is True
    x, y, z = answers[False]["detections"][0]["translation_m"]
    # a quarter turn clockwise takes (x, y) to (-y, x)
    np.testing.assert_allclose(answers[True]["detections"][0]["translation_m"], [-y, x, z], rtol=0.03, atol=0.01)


def test_the_distortion_that_was_used_is_written_as_it_is_of_the_turned_frame(
    detect: Callable[..., int], tmp_path: Path, spot_image: Callable[..., np.ndarray]
) -> None:
    stored = cv2.imencode(".jpg", spot_image(*SIZE, 200, 100, 12, 12, (255, 255, 255)))[1].tobytes()
    (tmp_path / "turned.jpg").write_bytes(with_exif_orientation(stored, 6))
    (tmp_path / "upright.jpg").write_bytes(stored)
    images = [tmp_path / "turned.jpg", tmp_path / "upright.jpg"]
    written = {}
    for given in ([-0.2, 0.05, 0.001, 0.002, 0.0], [0.0] * 5):
        camera, out = tmp_path / "camera.json", tmp_path / "out.jsonl"
        camera.write_text(json.dumps({"camera_matrix": K, "width": 320, "height": 240, "distortion": given}))
        assert detect("pinhole", *images, camera=camera, out=out, exif_rotation=True, overwrite=True) == 0
        written[given[0]] = read(out)
    turned, upright = written[-0.2]
    assert turned["distortion"] == [-0.2, 0.05, 0.002, -0.001, 0.0]
    assert upright["distortion"] == [-0.2, 0.05, 0.001, 0.002, 0.0]
    assert ["exif_rotation" in line for line in (turned, upright)] == [True, False]
    assert all("distortion" not in line for line in written[0.0])


def test_videos_give_a_line_a_frame(
    detect: Callable[..., int], tmp_path: Path, spot_image: Callable[..., np.ndarray]
) -> None:
    clip = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(clip), cv2.VideoWriter.fourcc(*"MJPG"), 10, SIZE)
    for number in range(4):
        writer.write(spot_image(*SIZE, 100 + 20 * number, 120, 12, 12, (255, 255, 255)))
    writer.release()
    out, drawn = tmp_path / "out.jsonl", tmp_path / "drawn"
    assert detect("flat", clip, out=out, overlays=drawn) == 0
    lines = read(out)
    assert [line["image"] for line in lines] == [f"{clip}#{n}" for n in range(4)]
    steps = np.diff([line["detections"][0]["translation_m"][0] for line in lines])
    np.testing.assert_allclose(steps, 20 / 320, atol=0.005)
    assert len(list((drawn / "clip.avi").iterdir())) == 4
