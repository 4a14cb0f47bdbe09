"""``curio-detect`` as a process: killed, stopped, left by its reader, and where training cannot be imported."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

NUM_MANY = 1500  # enough that no machine is done before it is stopped


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-c", "from curio_serve.batch.detect_cli import main; main()", *map(str, arguments)]


def read(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.fixture
def many_frames(frames: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "many"
    folder.mkdir()
    for number in range(NUM_MANY):
        os.link(frames / f"{number % 6:06d}.png", folder / f"{number:04d}.png")
    return folder


def wait_for_lines(out: Path, count: int, process: subprocess.Popen[str]) -> None:
    while not out.exists() or out.read_bytes().count(b"\n") < count:
        assert process.poll() is None, process.communicate()
        time.sleep(0.005)


def without_times(out: Path) -> list[dict[str, Any]]:
    lines = read(out)
    for line in lines:
        del line["milliseconds"]
    return lines


def test_killed_again_and_again_it_neither_repeats_nor_loses_a_line(
    models_dir: Path, many_frames: Path, tmp_path: Path
) -> None:
    out, whole = tmp_path / "out.jsonl", tmp_path / "whole.jsonl"
    for count in (1, 100, 250):
        with subprocess.Popen(
            command(models_dir / "flat", many_frames, "--out", out), stderr=subprocess.PIPE, text=True
        ) as p:
            wait_for_lines(out, count, p)
            p.kill()
        assert count <= out.read_bytes().count(b"\n") < NUM_MANY
    subprocess.run(command(models_dir / "flat", many_frames, "--out", out), check=True, capture_output=True)
    subprocess.run(command(models_dir / "flat", many_frames, "--out", whole), check=True, capture_output=True)
    assert len(without_times(out)) == NUM_MANY
    assert without_times(out) == without_times(whole)


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_stopped_it_says_how_to_go_on(
    number: int, status: int, models_dir: Path, many_frames: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out.jsonl"
    arguments = command(models_dir / "flat", many_frames, "--out", out)
    with subprocess.Popen(arguments, stderr=subprocess.PIPE, text=True) as process:
        wait_for_lines(out, 20, process)
        process.send_signal(number)
        told = process.communicate()[1]
    assert process.returncode == status
    assert "Traceback" not in told
    assert f"--out {out}" in told
    assert out.read_bytes().endswith(b"\n")
    subprocess.run(arguments, check=True, capture_output=True)
    assert len(read(out)) == NUM_MANY


def test_stopped_while_it_follows_it_says_to_begin_again(models_dir: Path, many_frames: Path, tmp_path: Path) -> None:
    camera, out = tmp_path / "camera.json", tmp_path / "out.jsonl"
    camera.write_text('{"camera_matrix": [[300, 0, 160], [0, 301, 119], [0, 0, 1]]}')
    arguments = command(models_dir / "pinhole", many_frames, "--camera", camera, "--out", out, "--track")
    with subprocess.Popen(arguments, stderr=subprocess.PIPE, text=True) as process:
        wait_for_lines(out, 20, process)
        process.send_signal(signal.SIGINT)
        told = process.communicate()[1]
    assert process.returncode == 130
    assert "type the same again, with --overwrite" in told
    assert "to go on" not in told


def test_a_reader_that_leaves_is_no_traceback(models_dir: Path, many_frames: Path) -> None:
    with subprocess.Popen(
        command(models_dir / "flat", many_frames), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        told = process.stderr.read()
    assert process.returncode == 1
    assert told == ""


def test_it_runs_where_the_training_stack_cannot_be_imported(models_dir: Path, frames: Path, tmp_path: Path) -> None:
    for name in ("torch", "mitsuba", "drjit", "onnx", "trimesh", "curio_train"):
        (tmp_path / f"{name}.py").write_text("raise ImportError(__name__)")
    done = subprocess.run(
        command(models_dir / "flat", frames),
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
    )
    assert len(done.stdout.splitlines()) == 6


def test_help_imports_nothing_heavy() -> None:
    program = "import sys, curio_serve.batch.detect_cli; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert not {"numpy", "cv2", "onnxruntime", "scipy", "grpc", "google.protobuf"} & set(loaded)


def test_errors_are_one_clear_line_and_the_right_status(models_dir: Path, frames: Path) -> None:
    for arguments, status in (
        (["none", str(frames)], 2),
        ([str(frames), str(frames)], 1),
        ([str(models_dir / "flat"), str(frames), "--out", "/proc/none/out.jsonl"], 1),
        ([str(models_dir / "flat"), str(frames), "--out", "/dev/full"], 1),
    ):
        done = subprocess.run(command(*arguments), capture_output=True, text=True)
        assert done.returncode == status
        assert done.stderr.startswith("curio-detect: error: ")
        assert done.stderr.count("\n") == 1
        assert done.stdout == ""


def test_a_terminal_sees_how_far_it_is(models_dir: Path, frames: Path, tmp_path: Path) -> None:
    ours, terminal = os.openpty()
    out = tmp_path / "out.jsonl"
    with subprocess.Popen(command(models_dir / "flat", frames, "--out", out), stderr=terminal) as process:
        os.close(terminal)
        shown = b""
        with suppress(OSError), open(ours, "rb", buffering=0) as screen:  # it fails once the other side has gone
            while part := screen.read(1 << 16):
                shown += part
        assert process.wait() == 0
    assert f"{len(read(out))} images".encode() in shown
    assert b"0 without an answer" in shown


@pytest.mark.parametrize("number", [signal.SIGINT, None])
def test_a_list_on_standard_input_is_answered_as_it_comes(number: int | None, models_dir: Path, frames: Path) -> None:
    """A name is answered while the list is open; stopped while it waits for the next, or at its end, it ends well."""
    pipe = subprocess.PIPE
    with subprocess.Popen(
        command(models_dir / "flat", "-"), stdin=pipe, stdout=pipe, stderr=pipe, text=True
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        for name in ("000000.png", "000001.png"):
            process.stdin.write(f"{frames / name}\n")
            process.stdin.flush()
            assert json.loads(process.stdout.readline())["image"] == str(frames / name)
        if number is None:
            process.stdin.write(str(frames / "000002.png"))  # without an end of line
            more, told = process.communicate(timeout=60)
            assert json.loads(more)["image"] == str(frames / "000002.png")
        else:
            process.send_signal(number)
            _, told = process.stdout.read(), process.stderr.read() if process.stderr else ""
    assert process.returncode == (0 if number is None else 130)
    assert "Traceback" not in told
    assert "Fatal" not in told
