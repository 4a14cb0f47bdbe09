"""Which images of several cameras go together, and when: by their times, their numbers, or the order of their names."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from curio_serve.batch.images.source_image import RecordedAt, SourceImage
from curio_serve.batch.images.sources import PassedOver, images
from curio_serve.batch.instants import Instants, refuse_other_images
from curio_serve.batch.tracked import timed
from curio_serve.errors import UsageError
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.rigs.rig import RigCamera

LABELS = ("left", "right")


def recorded(label: str, stamps_ms: Sequence[int]) -> list[SourceImage]:
    times = [1_700_000_000_000 + stamp for stamp in stamps_ms]
    return [SourceImage(f"{label}@{at % 10_000}", label, recorded=RecordedAt(label, at * 10**6, 0, "")) for at in times]


def frames(label: str, times_s: Sequence[float | None]) -> list[SourceImage]:
    return [SourceImage(f"{label}#{number}", label, number, time_s=at_s) for number, at_s in enumerate(times_s)]


def files(*names: str) -> list[SourceImage]:
    return [SourceImage(name, name) for name in names]


def paired(left: list[SourceImage], right: list[SourceImage]) -> tuple[list[tuple[str, ...]], list[str]]:
    taken = Instants([iter(left), iter(right)], LABELS)
    pairs = [tuple(image.name.lstrip("leftrigh@#") for image in instant.images) for instant in taken]
    return pairs, list(taken.unpaired.lines())


def test_frames_of_recordings_go_together_by_their_stamps() -> None:
    left, right = recorded("left", [0, 33, 67, 100, 133]), recorded("right", [5, 38, 105, 139])
    pairs, told = paired(left, right)
    assert pairs == [("0", "5"), ("33", "38"), ("100", "105"), ("133", "139")]
    assert told == ["--rig: 1 images were taken at no other camera's time, the first of them left@67"]
    late, told = paired(recorded("left", [0, 33, 67, 100]), recorded("right", [66, 99]))
    assert late == [("67", "66"), ("100", "99")]
    assert len(told) == 1


def test_frames_that_were_not_taken_together_do_not_go_together() -> None:
    """Clocks that were set otherwise, one that nobody set, and one that jumps."""
    pairs, told = paired(recorded("left", [0, 100, 200]), recorded("right", [1000, 1100]))
    assert pairs == []
    assert told[0].startswith("--rig: 3 images were taken at no other camera's time")
    unset = [SourceImage("right@0", "right", recorded=RecordedAt("right", 0, 0, ""))]
    assert paired(recorded("left", [0, 100]), unset)[0] == []
    pairs, told = paired(recorded("left", [0, 100, 9000]), recorded("right", [0, 100, 200, 9020]))
    assert pairs == [("0", "0"), ("100", "100"), ("9000", "9020")]
    assert len(told) == 1


def test_frames_of_videos_with_other_rates_go_together_by_their_times() -> None:
    pairs, told = paired(frames("left", [0, 0.04, 0.08, 0.12, 0.16]), frames("right", [0, 0.08, 0.16, 0.24]))
    assert pairs == [("0", "0"), ("2", "1"), ("4", "2")]
    assert told[-1] == "--rig: left ends before the others"
    for left, right in (([0, 0.04, 0.08], [0, 0.04]), ([0, 0.04], [0, 0.04, 0.08])):
        pairs, told = paired(frames("left", left), frames("right", right))
        assert len(pairs) == 2
        assert told == [f"--rig: {'right' if len(left) > 2 else 'left'} ends before the others"]


def test_a_damaged_frame_is_of_one_instant_alone() -> None:
    pairs, _ = paired(frames("left", [0, None, 0.08, 0.12]), frames("right", [0, 0.04, 0.08, 0.12]))
    assert pairs[-2:] == [("2", "2"), ("3", "3")]
    beginning = [replace(image, error="damaged") for image in frames("left", [None])]
    pairs, _ = paired(
        [*beginning, *frames("left", [None, 0.04, 0.08])[1:]], frames("right", [0, 0.02, 0.04, 0.06, 0.08])
    )
    assert pairs[-2:] == [("1", "2"), ("2", "4")]


def test_stamps_that_nobody_set_leave_the_order() -> None:
    pairs, told = paired(frames("left", [0, 0, 0]), frames("right", [0, 0, 0]))
    assert pairs == [("0", "0"), ("1", "1"), ("2", "2")]
    assert told == []


def test_without_stamps_the_times_of_recording_tell() -> None:
    """The second camera lost its third frame."""
    left, right = (
        [SourceImage(f"{label}@{at}", label, recorded=RecordedAt(label, 0, 10**18 + at * 10**6, "")) for at in times]
        for label, times in (("left", [0, 40, 80, 120]), ("right", [1, 41, 121]))
    )
    pairs, told = paired(left, right)
    assert pairs == [("0", "1"), ("40", "41"), ("120", "121")]
    assert len(told) == 1


def test_files_that_are_numbered_alike_stay_so() -> None:
    names = [("a/left_08.png", "b/right_8.png"), ("a/left_09.png", "b/right_9.png")]
    whole = Instants([iter(files(*side)) for side in zip(*names, strict=True)], LABELS)
    assert [tuple(image.name for image in instant.images) for instant in whole] == names
    missing = Instants([iter(files("a/1.png", "a/2.png")), iter(files("b/1.png", "b/3.png"))], LABELS)
    with pytest.raises(UsageError, match=r"a/2\.png and b/3\.png come together"):
        list(missing)
    of_cameras = Instants(
        [iter(files("a/f1_cam1.png", "a/f2_cam1.png")), iter(files("b/f1_cam2.png", "b/f2_cam2.png"))], LABELS
    )
    assert len(list(of_cameras)) == 2
    late = Instants([iter(files("a/0.png", "a/1.png")), iter(files("b/1.png", "b/2.png"))], LABELS)
    with pytest.raises(UsageError, match=r"a/1\.png and b/2\.png come together"):
        list(late)
    by_clock = Instants([iter(files("a/1001.png", "a/1012.png")), iter(files("b/1002.png", "b/1011.png"))], LABELS)
    assert len(list(by_clock)) == 2


def test_images_of_another_camera_or_number_are_refused(tmp_path: Path) -> None:
    rig = [RigCamera(name, PinholeCamera(np.diag([300.0, 300, 1])), np.eye(4)) for name in LABELS]
    for name, count in zip(LABELS, (2, 1), strict=True):
        (tmp_path / name).mkdir()
        for number in range(count):
            cv2.imwrite(str(tmp_path / name / f"{number}.png"), np.zeros((8, 8, 3), np.uint8))
    left, right = (str(tmp_path / name) for name in LABELS)
    for swapped in ([right, left], [f"{right}/*.png", f"{left}/*.png"], ["right.mp4", "left.mp4"]):
        with pytest.raises(UsageError, match=r"comes where camera left is expected; the order is left, right"):
            refuse_other_images(swapped, rig)
    with pytest.raises(UsageError, match="expected other images of each camera"):
        refuse_other_images([left, left], rig)
    with pytest.raises(UsageError, match=r"left has 2, .*right has 1"):
        refuse_other_images([left, right], rig)
    (tmp_path / "left" / "1.png").unlink()
    refuse_other_images([left, right], rig)


def test_names_are_ordered_by_the_numbers_in_them(tmp_path: Path) -> None:
    names = ["a2b10.png", "a2b9.png", "a10.png", "a09.png", "a9.png", "b.png", "10.png", "9.png"]
    for name in names:
        (tmp_path / name).write_bytes(b"")
    expected = ["9.png", "10.png", "a2b9.png", "a2b10.png", "a09.png", "a9.png", "a10.png", "b.png"]
    for argument in (str(tmp_path), f"{tmp_path}/*.png"):
        assert [Path(image.name).name for image in images([argument], PassedOver())] == expected


def test_times_of_a_recording_go_on_where_its_stamps_do_not() -> None:
    log_ns = [10**18 + number * 40_000_000 for number in range(4)]
    for stamps, steps_s in (
        ([0, 0, 0, 0], [0.04, 0.04, 0.04]),
        ([5_000_000_000, 5_050_000_000, 1_000_000_000, 1_050_000_000], [0.05, 0.04, 0.05]),
    ):
        images_ = [
            SourceImage(str(number), "run.mcap", recorded=RecordedAt("/image", stamp, log, ""))
            for number, (stamp, log) in enumerate(zip(stamps, log_ns, strict=True))
        ]
        times_s = [image.time_s for image in timed(images_, 30.0)]
        np.testing.assert_allclose(np.diff(np.array(times_s, float)), steps_s, atol=1e-6)
