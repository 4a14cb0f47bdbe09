"""``curio-train capture --assistant`` on drawn videos: what it keeps, what it says, and who may look."""

import json
import socket
import struct
import threading
import urllib.error
import urllib.request
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from curio_train.commands import train as train_command
from curio_train.commands.assist import Page
from curio_train.errors import UsageError

WIDTH, HEIGHT = 320, 240


def clutter(seed: int) -> np.ndarray:
    """A sharp picture with much contrast, uint8 BGR."""
    drawn = np.random.default_rng(seed).integers(30, 220, (HEIGHT // 8, WIDTH // 8, 3), np.uint8)
    return cv2.resize(drawn, (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)


def with_part(seed: int, x: int) -> np.ndarray:
    picture = clutter(seed)
    cv2.rectangle(picture, (x, 90), (x + 50, 140), (250, 60, 10), -1)
    return picture


def board(tilt: float) -> np.ndarray:
    """A chessboard of 7x6 squares, seen from the side."""
    squares = np.kron((np.indices((6, 7)).sum(axis=0) % 2 * 215 + 20).astype(np.uint8), np.ones((30, 30), np.uint8))
    flat = cv2.copyMakeBorder(squares, 30, 30, 50, 50, cv2.BORDER_CONSTANT, value=235)[:HEIGHT, :WIDTH]
    flat = cv2.resize(flat, (WIDTH, HEIGHT))
    corners = np.array([[0, 0], [WIDTH, 0], [WIDTH, HEIGHT], [0, HEIGHT]], np.float32)
    moved = corners + np.array([[tilt, tilt], [-tilt, 0], [0, 0], [0, -tilt]], np.float32)
    seen = cv2.warpPerspective(flat, cv2.getPerspectiveTransform(corners, moved), (WIDTH, HEIGHT), borderValue=(200,))
    return cv2.cvtColor(seen, cv2.COLOR_GRAY2BGR)


def video(path: Path, frames: Sequence[np.ndarray]) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (WIDTH, HEIGHT))
    assert writer.isOpened()
    for frame in frames:
        writer.write(frame)
    writer.release()
    return path


def call(capsys: pytest.CaptureFixture[str], *flags: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as exit_:
        train_command.train(["capture", "--assistant", "--port", "0", *map(str, flags)])
    captured = capsys.readouterr()
    return int(exit_.value.code or 0), captured.out, captured.err


def kept(folder: Path) -> list[np.ndarray]:
    return [cv2.imread(str(path)) for path in sorted(folder.iterdir())]


def test_good_frames_are_kept_until_there_are_enough(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    blurred = cv2.GaussianBlur(clutter(4), (0, 0), 12)
    black = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    frames = [clutter(1), clutter(1), blurred, black, clutter(2), clutter(1), clutter(3), clutter(5)]
    source = video(tmp_path / "walk.avi", frames)
    status, out, err = call(capsys, "--video", source, "--out", tmp_path / "photos", "--count", 3)
    assert status == 0, err
    assert "3 photographs, enough" in out
    assert "http://127.0.0.1:" in err
    for found, expected in zip(kept(tmp_path / "photos"), (clutter(1), clutter(2), clutter(3)), strict=True):
        assert np.abs(found.astype(int) - expected).mean() < 15


def test_too_few_are_gone_on_with(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photos = tmp_path / "photos"
    first = video(tmp_path / "first.avi", [clutter(1)] * 4)
    status, out, _ = call(capsys, "--video", first, "--out", photos, "--count", 2)
    assert (status, len(kept(photos))) == (1, 1)
    assert "1 of 2 photographs; 3 frames were like a photograph that was kept" in out
    second = video(tmp_path / "second.avi", [clutter(1), clutter(2)])
    status, out, _ = call(capsys, "--video", second, "--out", photos, "--count", 2)
    assert (status, len(kept(photos))) == (0, 2)


def test_the_empty_scene_comes_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frames = [clutter(1), clutter(1), with_part(1, 40), with_part(1, 180), with_part(1, 180)]
    source, empty = video(tmp_path / "part.avi", frames), tmp_path / "empty.jpg"
    status, _, err = call(capsys, "--video", source, "--out", tmp_path / "photos", "--count", 2, "--background", empty)
    assert status == 0, err
    assert np.abs(cv2.imread(str(empty)).astype(int) - clutter(1)).mean() < 15
    assert [bool(picture[115, 65, 0] > 200) for picture in kept(tmp_path / "photos")] == [True, False]


def test_enough_photographs_do_not_stand_for_the_empty_scene(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The background lies among them, is no photograph of the part, and is a PNG as its name says."""
    photos = tmp_path / "photos"
    source, empty = video(tmp_path / "part.avi", [with_part(1, 40)]), photos / "empty.png"
    assert call(capsys, "--video", source, "--out", photos, "--count", 1)[0] == 0
    black = video(tmp_path / "black.avi", [np.zeros((HEIGHT, WIDTH, 3), np.uint8)])
    flags = ["--out", photos, "--background", empty]
    status, out, _ = call(capsys, "--video", black, *flags, "--count", 1)
    assert (status, f"1 of 1 photographs, {empty} was not taken; 1 frames were mostly black" in out) == (1, True)
    status, out, err = call(capsys, "--video", video(tmp_path / "empty.avi", [clutter(1)]), *flags, "--count", 1)
    assert (status, f"{photos}: 1 photographs, enough" in out) == (0, True), err
    assert empty.read_bytes().startswith(b"\x89PNG")
    status, out, _ = call(capsys, "--video", source, *flags, "--count", 2)
    assert (status, "1 of 2 photographs; 1 frames were like a photograph" in out) == (1, True), out


@pytest.mark.parametrize("there", ["photos/0.png", "empty.png"])
def test_frames_of_another_size_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], there: str) -> None:
    (tmp_path / "photos").mkdir()
    cv2.imwrite(str(tmp_path / there), clutter(1)[:200, :300])
    flags = ["--video", video(tmp_path / "part.avi", [clutter(2)]), "--out", tmp_path / "photos"]
    if there == "empty.png":
        flags += ["--background", tmp_path / there]
    status, _, err = call(capsys, *flags)
    assert status == 1
    assert f"this frame has {WIDTH}x{HEIGHT} pixels, but {tmp_path / there} has 300x200" in err


def test_only_frames_with_the_board_are_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frames = [clutter(1), board(0), board(30), clutter(2)]
    source = video(tmp_path / "board.avi", frames)
    flags = ["--video", source, "--out", tmp_path / "photos", "--count", 2]
    status, out, err = call(capsys, *flags, "--board", 7, 6)
    assert (status, len(kept(tmp_path / "photos"))) == (0, 2), out + err


@pytest.mark.parametrize(
    ("flags", "told"),
    [
        (["--count", 0], "--count 0"),
        (["--marker-mm", 10], "--marker-mm 10.0 has no effect without --board"),
        (["--dictionary", "DICT_5X5_100"], "--dictionary DICT_5X5_100 has no effect without --board"),
        (["--video", "nowhere.avi"], "--video nowhere.avi"),
        (["--video", "²"], "--video ²: cannot be opened"),
        (["--video", ".", "--background", "empty.heic"], "--background empty.heic: expected a file name that ends in"),
    ],
)
def test_wrong_calls(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    flags: list[object],
    told: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    cv2.imwrite("frame.png", clutter(1))
    status, _, err = call(capsys, "--out", tmp_path / "photos", *flags)
    assert status == 2
    assert told in err


@pytest.mark.parametrize("flag", ["--out", "--background", "--video"])
def test_paths_that_cannot_be_reached(tmp_path: Path, capsys: pytest.CaptureFixture[str], flag: str) -> None:
    given = {"--out": tmp_path / "photos", "--video": video(tmp_path / "walk.avi", [clutter(1)])}
    flags = [word for pair in (given | {flag: tmp_path / ("a" * 300)}).items() for word in pair]
    status, _, err = call(capsys, *flags)
    assert status == (2 if flag == "--video" else 1)
    assert err.startswith(f"error: {flag} {tmp_path}")
    assert ("cannot be opened" if flag == "--video" else "File name too long") in err


def test_the_page_shows_the_newest_frame() -> None:
    with Page(0) as page:
        page.show(clutter(1), "1 of 80 kept", "blur 0.2", 7)
        with urllib.request.urlopen(page.address + "status", timeout=30) as answer:
            assert json.load(answer) == {"said": "1 of 80 kept", "more": "blur 0.2", "frame": 7}
        with urllib.request.urlopen(page.address + "frame.jpg?7", timeout=30) as answer:
            shown = cv2.imdecode(np.frombuffer(answer.read(), np.uint8), cv2.IMREAD_COLOR)
        assert shown.shape == (HEIGHT, WIDTH, 3)
        with urllib.request.urlopen(page.address, timeout=30) as answer:
            assert b"frame.jpg" in answer.read()
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(page.address + "etc/passwd", timeout=30)
    assert not any(thread.name == "page" and thread.is_alive() for thread in threading.enumerate())


def test_a_browser_that_goes_away_is_no_news(capsys: pytest.CaptureFixture[str]) -> None:
    with Page(0) as page:
        with socket.create_connection(("127.0.0.1", int(page.address.rstrip("/").rpartition(":")[2]))) as browser:
            browser.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # closing resets
            browser.sendall(b"GET /frame")
        with urllib.request.urlopen(page.address, timeout=30) as answer:
            assert b"frame.jpg" in answer.read()
        for thread in threading.enumerate():
            if "process_request_thread" in thread.name:
                thread.join(30)
    assert capsys.readouterr().err == ""


def test_a_taken_port_is_named() -> None:
    with Page(0) as page, pytest.raises(UsageError, match="--port"):
        Page(int(page.address.rstrip("/").rpartition(":")[2]))


def test_other_files_in_the_folder_are_no_photographs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "notes.txt").write_text("taken by the window")
    source = video(tmp_path / "walk.avi", [clutter(1), clutter(2), clutter(3)])
    status, out, err = call(capsys, "--video", source, "--out", folder, "--count", 2)
    assert status == 0, err
    assert "2 photographs, enough" in out
    assert (folder / "notes.txt").read_text() == "taken by the window"
