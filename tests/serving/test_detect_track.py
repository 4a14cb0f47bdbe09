"""``curio-detect --track``: videos and folders as streams, one after the other."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from curio_serve.batch.arguments import DetectArguments
from curio_serve.batch.detect_cli import run
from curio_serve.errors import UsageError


def _tracks(out: Path) -> list[dict[str, object]]:
    records = [json.loads(line) for line in out.read_text().splitlines()]
    return [detection["track"] for record in records for detection in record.get("detections", ())]


def test_each_folder_is_a_stream_of_its_own(models_dir: Path, frames: Path, camera: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    for file in sorted(frames.iterdir())[:2]:
        (other / file.name).write_bytes(file.read_bytes())
    out = tmp_path / "out.jsonl"
    arguments = DetectArguments(
        str(models_dir / "pinhole"), (str(frames), str(other)), camera=camera, out=str(out), track=True, frame_rate=10.0
    )
    assert run(arguments) == 0
    tracks = _tracks(out)
    assert [track["track_id"] for track in tracks] == [1] * 8
    assert [track["age_s"] for track in tracks] == pytest.approx([0, 0.1, 0.2, 0.3, 0.4, 0.5, 0, 0.1])
    # 20 pixels a frame at f = 300 px and a distance of 1.25 m, ten frames a second
    assert tracks[5]["velocity_m_s"][0] == pytest.approx(0.83, rel=0.05)  # type: ignore[index]
    with pytest.raises(UsageError, match="holds 8 images"):
        run(arguments)
    out.write_text(out.read_text().splitlines(keepends=True)[0])
    with pytest.raises(UsageError, match=r'answers with other options: .*"track": true'):
        run(replace(arguments, track=False, frame_rate=DetectArguments.frame_rate))
    plain = tmp_path / "plain.jsonl"
    run(DetectArguments(str(models_dir / "pinhole"), (str(frames),), camera=camera, out=str(plain)))
    assert "track" not in plain.read_text()


def test_a_frame_that_cannot_be_read_takes_its_time(
    models_dir: Path, frames: Path, camera: Path, tmp_path: Path
) -> None:
    (frames / "000002.png").write_bytes(b"no image")
    (frames / "000003.png").write_bytes(b"")
    out = tmp_path / "out.jsonl"
    arguments = DetectArguments(str(models_dir / "pinhole"), (str(frames),), camera=camera, out=str(out), track=True)
    assert run(replace(arguments, frame_rate=10.0)) == 1
    tracks = _tracks(out)
    assert [track["age_s"] for track in tracks] == pytest.approx([0, 0.1, 0.4, 0.5])
    assert tracks[-1]["velocity_m_s"][0] == pytest.approx(0.83, rel=0.05)  # type: ignore[index]


def test_a_video_says_when_its_frames_were_taken(
    models_dir: Path, camera: Path, tmp_path: Path, spot_image: Callable[..., np.ndarray]
) -> None:
    video, out = tmp_path / "clip.avi", tmp_path / "out.jsonl"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (320, 240))
    for number in range(5):
        writer.write(spot_image(320, 240, 100 + 5 * number, 120, 12, 12, (255, 128, 0)))
    writer.release()
    run(DetectArguments(str(models_dir / "pinhole"), (str(video),), camera=camera, out=str(out), track=True))
    assert [track["age_s"] for track in _tracks(out)] == pytest.approx([0, 0.05, 0.1, 0.15, 0.2])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"format": "csv"}, "JSON Lines"),
        ({"ray": "local"}, "one machine"),
        ({"refine": True}, "--refine"),
        ({"out": "poses.mcap"}, "JSON Lines"),
        ({"max_detections": 2}, "--track-objects"),
        ({"track_objects": 0}, "expected 1 to 16"),
        ({"frame_rate": 0.0}, "more than 0 frames/s"),
        ({"track": False, "track_objects": 2}, "are for --track"),
        ({"track": False, "frame_rate": 10.0}, "are for --track"),
    ],
)
def test_what_cannot_be_followed_is_refused(
    models_dir: Path, frames: Path, camera: Path, change: dict[str, object], said: str
) -> None:
    with pytest.raises(UsageError, match=said):
        run(
            DetectArguments(
                str(models_dir / "pinhole"),
                (str(frames),),
                **{"camera": camera, "track": True, **change},  # type: ignore[arg-type]
            )
        )


def test_a_model_behind_a_server_is_refused(frames: Path) -> None:
    with pytest.raises(UsageError, match="DetectStream"):
        run(DetectArguments("127.0.0.1:1/pinhole", (str(frames),), track=True))
