"""From arguments to images: order, what is left out, and what it costs."""

import io
import os
import re
import tracemalloc
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from curio_serve.batch.images import sources
from curio_serve.batch.images.source_image import SourceImage
from curio_serve.batch.images.sources import PassedOver, check_arguments, common_folder, images
from curio_serve.errors import ImageError, UsageError


def touch(folder: Path, *names: str) -> None:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")


def names(*arguments: str | Path) -> list[str]:
    return [image.name for image in images([str(a) for a in arguments], PassedOver())]


def test_a_folder_gives_its_images_and_those_below_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    touch(
        tmp_path, "in/b.PNG", "in/a.jpg", "in/c/z.webp", "in/notes.txt", "in/.hidden.jpg", "in/.git/x.jpg", "in/d.jpeg"
    )
    monkeypatch.chdir(tmp_path)
    assert names("in") == ["in/a.jpg", "in/b.PNG", "in/c/z.webp", "in/d.jpeg"]
    assert names("in/") == names("in")


def test_order_does_not_depend_on_how_many_names_a_pass_keeps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    touch(tmp_path, *(f"{(7919 * i) % 1000:03d}.png" for i in range(1000)))
    monkeypatch.setattr(sources, "_NAMES_A_PASS", 64)
    assert [Path(n).stem for n in names(tmp_path)] == [f"{i:03d}" for i in range(1000)]


def test_of_a_bop_scene_only_the_photographs_count(tmp_path: Path) -> None:
    touch(tmp_path, *(f"test/000002/{kind}/000003.png" for kind in ("rgb", "depth", "mask", "mask_visib")))
    touch(tmp_path, "test/000002/scene_camera.json")
    assert names(tmp_path / "test") == [str(tmp_path / "test/000002/rgb/000003.png")]


def test_files_keep_the_order_of_the_arguments_whatever_their_suffix(tmp_path: Path) -> None:
    touch(tmp_path, "b.png", "a.dat")
    assert names(tmp_path / "b.png", tmp_path / "a.dat") == [str(tmp_path / "b.png"), str(tmp_path / "a.dat")]


def test_globs_are_expanded_unless_a_file_has_that_very_name(tmp_path: Path) -> None:
    touch(tmp_path, "2.png", "1.png", "x/3.png", "[1].png")
    assert names(tmp_path / "?.png") == [str(tmp_path / n) for n in ("1.png", "2.png")]
    assert names(tmp_path / "[1].png") == [str(tmp_path / "[1].png")]
    assert str(tmp_path / "x/3.png") in names(tmp_path / "**" / "*.png")


def test_a_list_on_standard_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    touch(tmp_path, "a.png", "in/b.png")
    listed = f"{tmp_path}/a.png\r\n\n{tmp_path}/in\n{tmp_path}/missing.png"
    monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=io.BytesIO(listed.encode())))
    assert names("-") == [f"{tmp_path}/a.png", f"{tmp_path}/in/b.png", f"{tmp_path}/missing.png"]


def test_a_missing_file_is_an_error_of_that_image(tmp_path: Path) -> None:
    for name in ("missing.png", "null\0byte.png"):
        with pytest.raises(ImageError, match="cannot be read"):
            SourceImage(name, str(tmp_path / name)).read()


def test_arguments_that_name_nothing_are_refused_before_the_start(tmp_path: Path) -> None:
    touch(tmp_path, "a.png")
    check_arguments([str(tmp_path / "a.png"), str(tmp_path), str(tmp_path / "*.png"), "-"])
    for arguments in ([], ["-", "-"], [str(tmp_path / "b.png")], [str(tmp_path / "*.jpg")]):
        with pytest.raises(UsageError):
            check_arguments(arguments)


def test_a_folder_that_may_not_be_listed_is_an_error_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    touch(tmp_path, "a/0.png", "b/0.png", "c/0.png")
    scandir = os.scandir

    def refuse(folder: str) -> Any:
        if folder.endswith("b"):
            raise PermissionError(13, "Permission denied", folder)
        return scandir(folder)

    monkeypatch.setattr(os, "scandir", refuse)
    found = list(images([str(tmp_path)], PassedOver()))
    assert [image.name for image in found] == [f"{tmp_path}/a/0.png", f"{tmp_path}/b", f"{tmp_path}/c/0.png"]
    with pytest.raises(ImageError, match="cannot be listed: Permission denied"):
        found[1].read()


def test_pipes_devices_and_endless_files_are_errors_of_these_images(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.png")
    (tmp_path / "b.png").symlink_to("/dev/zero")
    with (tmp_path / "c.png").open("wb") as sparse:
        sparse.truncate(20 << 30)
    for image, text in zip(
        images([str(tmp_path)], PassedOver()), ["not a regular", "not a regular", "at most"], strict=True
    ):
        with pytest.raises(ImageError, match=text):
            image.read()


def test_links_to_folders_are_named(tmp_path: Path) -> None:
    touch(tmp_path, "scenes/a.png", "elsewhere/b.png")
    (tmp_path / "scenes" / "more").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "scenes" / "round").symlink_to(tmp_path)
    passed_over = PassedOver()
    assert len(list(images([str(tmp_path / "scenes")], passed_over))) == 1
    (told,) = passed_over.lines()
    assert told.startswith("links to folders are not followed: ")
    assert "more" in told
    assert "round" in told


def test_a_link_in_a_circle_is_an_error_of_its_own(tmp_path: Path) -> None:
    touch(tmp_path, "a.png", "z.png")
    (tmp_path / "link.png").symlink_to("link.png")
    (tmp_path / "notes").symlink_to("notes")
    found = list(images([str(tmp_path)], PassedOver()))
    assert [Path(image.name).name for image in found] == ["a.png", "link.png", "z.png"]
    with pytest.raises(ImageError, match="cannot be read: Too many levels of symbolic links"):
        found[1].read()


def test_a_pipe_is_no_video(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "clip.mp4")
    (found,) = images([str(tmp_path / "clip.mp4")], PassedOver())
    assert found.error == "cannot be read: not a regular file"


def test_relative_names_stay_apart_below_the_common_folder(tmp_path: Path) -> None:
    touch(tmp_path, "a/0.png", "b/0.png", "b/c/0.png")
    assert common_folder([str(tmp_path / "a")]) == tmp_path / "a"
    assert common_folder([str(tmp_path / "b/0.png"), str(tmp_path / "b/c/0.png")]) == tmp_path / "b"
    assert common_folder([str(tmp_path / "a"), str(tmp_path / "b/*.png")]) == tmp_path


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """Five frames, each of one grey."""
    path = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for shade in range(5):
        writer.write(np.full((48, 64, 3), 40 * shade, np.uint8))
    writer.release()
    return path


def test_a_video_gives_its_frames(clip: Path) -> None:
    frames = list(images([str(clip)], PassedOver()))
    assert [f.name for f in frames] == [f"{clip}#{i}" for i in range(5)]
    for i, frame in enumerate(frames):
        assert frame.pixels is not None
        assert frame.pixels.shape == (48, 64, 3)
        assert abs(frame.pixels.mean() - 40 * i) < 4
    assert frames[3].relative_name == str(clip / "000003.jpg")


def test_after_a_damaged_frame_a_video_goes_on(clip: Path) -> None:
    content = bytearray(clip.read_bytes())
    _, _, second, third, *_ = (found.start() for found in re.finditer(rb"00dc", content))  # after one in the header
    content[second + 8 : third] = bytes(third - second - 8)
    clip.write_bytes(content)
    frames = list(images([str(clip)], PassedOver()))
    assert [frame.name for frame in frames] == [f"{clip}#{i}" for i in range(5)]
    with pytest.raises(ImageError, match="damaged"):
        frames[1].read()
    assert frames[4].pixels is not None
    assert abs(frames[4].pixels.mean() - 160) < 4
    assert [frame.time_s for frame in frames] == [0, None, *map(pytest.approx, (0.2, 0.3, 0.4))]


def test_times_of_a_video_whose_beginning_is_damaged_go_forward(clip: Path) -> None:
    content = bytearray(clip.read_bytes())
    _, first, second, third, *_ = (found.start() for found in re.finditer(rb"00dc", content))
    for start, end in ((first, second), (second, third)):
        content[start + 8 : end] = bytes(end - start - 8)
    clip.write_bytes(content)
    times = [frame.time_s for frame in images([str(clip)], PassedOver())]
    assert times == [None, None, *map(pytest.approx, (0.2, 0.3, 0.4))]


def test_a_video_that_is_cut_off_ends_with_an_error(clip: Path) -> None:
    content = clip.read_bytes()
    _, _, _, third, *_ = (found.start() for found in re.finditer(rb"00dc", content))  # after one in the header
    clip.write_bytes(content[: third + 8])
    frames = list(images([str(clip)], PassedOver()))
    assert [frame.name for frame in frames] == [f"{clip}#{i}" for i in range(3)]
    with pytest.raises(ImageError, match="damaged"):
        frames[2].read()


def test_a_video_that_is_none_gives_one_error(tmp_path: Path) -> None:
    touch(tmp_path, "clip.mp4")
    (image,) = images([str(tmp_path / "clip.mp4")], PassedOver())
    with pytest.raises(ImageError, match="not a video"):
        image.read()


def test_memory_does_not_grow_with_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same peak for a folder twenty times as large, with passes that are small against both."""
    monkeypatch.setattr(sources, "_NAMES_A_PASS", 100)
    peaks = []
    for count in (200, 4_000):
        folder = tmp_path / str(count)
        folder.mkdir()
        for i in range(count):
            (folder / f"{i:06d}.png").touch()
        tracemalloc.start()
        assert sum(1 for _ in images([str(folder)], PassedOver())) == count
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.5 * peaks[0] + 20_000


def test_what_is_no_image_is_counted_and_named(tmp_path: Path) -> None:
    for name in ("a.jpg", "._a.jpg", "b.HEIC", "notes.txt", "more.txt", "deep/c.png", "empty/readme.md"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    passed_over = PassedOver()
    assert [Path(image.name).name for image in images([str(tmp_path)], passed_over)] == ["a.jpg", "c.png"]
    assert list(images([str(tmp_path / "empty")], passed_over)) == []
    empty, counted, heic = passed_over.lines()
    assert empty == f"{tmp_path / 'empty'} holds no image"
    assert counted.startswith("passed over: 6 files are no images: ")
    assert counted.count(", ") == 5
    assert {"._a.jpg", "b.HEIC", "notes.txt", "more.txt", "readme.md"} < set(counted.replace(",", "").split())
    assert heic.startswith("HEIC pictures have to be converted")


def test_of_many_files_that_are_no_images_the_first_are_named() -> None:
    passed_over = PassedOver()
    for number in range(1_030):
        passed_over.file(f"{number}.txt")
    (line,) = passed_over.lines()
    assert line.endswith("18.txt, 19.txt and 1,010 more")


def test_a_model_after_images_is_no_folder_of_images(tmp_path: Path) -> None:
    (tmp_path / "can").mkdir()
    (tmp_path / "can" / "config.pbtxt").touch()
    with pytest.raises(UsageError, match="name all models before the first image"):
        check_arguments([str(tmp_path / "can"), str(tmp_path)])
