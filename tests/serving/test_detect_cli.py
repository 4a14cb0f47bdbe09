"""``curio-detect`` on a model of this machine: what it writes, what it refuses, what it survives."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
from curio_serve.batch.arguments import DetectArguments
from curio_serve.batch.detect_cli import run
from curio_serve.errors import CurioError, ModelError, UsageError
from onnx import helper, numpy_helper
from PIL import Image


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-c", "from curio_serve.batch.detect_cli import main; main()", *map(str, arguments)]


def detect(model: Path, *sources: Path | str, **flags: Any) -> int:
    """In this process; returns the exit status."""
    if flags.get("out") is not None:
        flags["out"] = str(flags["out"])
    return run(DetectArguments(str(model), tuple(map(str, sources)), **flags))


def read(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_a_folder_a_version_and_a_file_are_the_same_model(models_dir: Path, frames: Path, tmp_path: Path) -> None:
    found = []
    for index, model in enumerate(("flat", "flat/1", "flat/1/model.onnx")):
        out = tmp_path / f"{index}.jsonl"
        assert detect(models_dir / model, frames, out=out) == 0
        found.append([line["detections"] for line in read(out)])
    assert found[0] == found[1] == found[2]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"model": "models/none"}, "no such folder or file, nor HOST:PORT/NAME"),
        ({"model": "127.0.0.1:8500"}, "which model of that server"),
        ({"images": ()}, "no images given"),
        (
            {"model": "frames", "images": ("flat",)},
            "frames is no model; models come first, and then images: flat frames",
        ),
        ({"camera": Path("frames")}, "--camera: camera file frames cannot be read: Is a directory"),
        ({"camera": Path("frames/000000.png")}, "is no text; expected JSON or YAML"),
        ({"images": ("missing.png",)}, "missing.png: no such file"),
        ({"model": "pinhole"}, "--camera FILE"),
        ({"model": "pinhole", "images": (), "video": "clip.mp4", "out": None}, "--camera FILE"),
        ({"out": "s3://bucket/poses.mcap"}, "recordings are written to files alone"),
        ({"camera": Path("missing.json")}, "--camera: .*missing.json"),
        ({"jobs": 0}, "--jobs 0"),
        ({"min_confidence": 1.5}, "--min-confidence 1.5"),
        ({"max_detections": 0}, "--max-detections 0"),
        ({"obj_id": 3}, "--format bop"),
        ({"format": "bop"}, "flat"),
        ({"overlays": Path("frames")}, "--overlays"),
        ({"overlays": Path("frames/drawn")}, "--overlays"),
    ],
)
def test_wrong_calls_are_refused_before_anything_is_written(
    changes: dict[str, Any], told: str, models_dir: Path, frames: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "flat").symlink_to(models_dir / "flat")
    (tmp_path / "pinhole").symlink_to(models_dir / "pinhole")
    call = {"model": "flat", "images": ("frames",), "out": "out", **changes}
    with pytest.raises(UsageError, match=told):
        run(DetectArguments(**call))
    assert not (tmp_path / "out").exists()
    assert len(list(frames.iterdir())) == 6


def test_a_folder_without_images_is_no_success(models_dir: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match=r"no images in .*empty"):
        detect(models_dir / "flat", tmp_path / "empty", out=tmp_path / "out.jsonl")


def test_a_folder_that_is_no_model_is_named(tmp_path: Path, frames: Path) -> None:
    (tmp_path / "none").mkdir()
    with pytest.raises(CurioError, match="no model in"):
        detect(tmp_path / "none", frames)


def without_times(line: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in line.items() if name != "milliseconds"}


def test_several_models_have_a_line_each(models_dir: Path, frames: Path, camera: Path, tmp_path: Path) -> None:
    alone = {}
    for name in ("flat", "pinhole"):
        assert detect(models_dir / name, frames, camera=camera, out=tmp_path / name) == 0
        alone[name] = [without_times(line) for line in read(tmp_path / name)]
    expected = [line for pair in zip(alone["flat"], alone["pinhole"], strict=True) for line in pair]
    for named in ([models_dir], [models_dir / "flat", models_dir / "pinhole/1"]):
        assert detect(*named, frames, camera=camera, out=tmp_path / "both", overwrite=True) == 0
        assert [without_times(line) for line in read(tmp_path / "both")] == expected


def test_several_models_draw_into_one_picture(models_dir: Path, frames: Path, camera: Path, tmp_path: Path) -> None:
    drawn = {}
    for name in ("flat", "pinhole", "."):
        folder = tmp_path / "drawn" / name
        detect(models_dir / name, frames, camera=camera, out=tmp_path / "out", overwrite=True, overlays=folder)
        drawn[name] = cv2.imread(str(folder / "000000.png")).astype(int)
    plain = cv2.imread(str(frames / "000000.png")).astype(int)
    changed = {name: (picture != plain).any(axis=2) for name, picture in drawn.items()}
    assert changed["flat"].any()
    assert changed["pinhole"].any()
    assert (changed["."] == (changed["flat"] | changed["pinhole"])).all()


def test_nothing_is_written_over_the_images(models_dir: Path, frames: Path, tmp_path: Path) -> None:
    """Two folders beside each other share their parent, below which drawings have the images' own names."""
    other = tmp_path / "other"
    other.mkdir()
    (other / "a.png").write_bytes((frames / "000000.png").read_bytes())
    before = {path: path.read_bytes() for folder in (frames, other) for path in folder.iterdir()}
    with pytest.raises(UsageError, match="drawings would replace"):
        detect(models_dir / "flat", frames, other, out=tmp_path / "out.jsonl", overlays=tmp_path)
    (tmp_path / "link").symlink_to(frames)
    with pytest.raises(UsageError, match="drawings would replace"):
        detect(models_dir / "flat", frames, out=tmp_path / "out.jsonl", overlays=tmp_path / "link")
    with pytest.raises(UsageError, match="lies within the images' own folder"):
        detect(models_dir / "flat", frames, other, out=tmp_path / "out.jsonl", overlays=tmp_path / "link" / "drawn")
    with pytest.raises(UsageError, match="is one of the images"):
        detect(models_dir / "flat", other / "a.png", out=other / "a.png", overwrite=True)
    with pytest.raises(UsageError, match="is an image, a video or a model"):
        detect(models_dir / "flat", other, out=other / "a.png", overwrite=True)
    with pytest.raises(UsageError, match="is one of the images"):
        detect(models_dir / "flat", other / "*.png", out=other / "a.png", overwrite=True)
    assert {path: path.read_bytes() for path in before} == before


def test_a_files_name_forges_no_line(models_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a\ncurio-detect: all is well\x1b[31m.png").write_bytes(b"no picture")
    (tmp_path / "b\ncurio-detect: all is well\x1b[31m.txt").touch()
    assert detect(models_dir / "flat", tmp_path, out=tmp_path / "out.jsonl") == 1
    told = capsys.readouterr().err
    assert "\x1b" not in told
    assert "\ncurio-detect: all is well" not in told
    for name in (r"a\x0acurio-detect: all is well\x1b[31m.png", r"b\x0acurio-detect: all is well\x1b[31m.txt"):
        assert name in told


def test_nothing_is_written_over_what_a_call_reads(models_dir: Path, frames: Path, camera: Path) -> None:
    before = camera.read_bytes()
    with pytest.raises(UsageError, match=r"--out .* is the file of --camera"):
        detect(models_dir / "pinhole", frames, camera=camera, out=camera, overwrite=True)
    assert camera.read_bytes() == before


def test_nothing_is_written_over_a_model(models_dir: Path, frames: Path, tmp_path: Path) -> None:
    model = tmp_path / "model.onnx"
    model.write_bytes(next((models_dir / "flat").glob("*/model.onnx")).read_bytes())
    before = model.read_bytes()
    with pytest.raises(UsageError, match=r"--out .*model\.onnx is an image, a video or a model"):
        detect(model, frames, out=model, overwrite=True)
    assert model.read_bytes() == before


def test_models_whose_results_look_the_same_are_refused(models_dir: Path, frames: Path, tmp_path: Path) -> None:
    shutil.copytree(models_dir / "flat", tmp_path / "again" / "flat")
    with pytest.raises(UsageError, match=r"two models are flat/\d"):
        detect(models_dir / "flat", tmp_path / "again" / "flat", frames)


def test_a_model_named_twice_is_refused(models_dir: Path, frames: Path) -> None:
    with pytest.raises(UsageError, match="pinhole is named twice"):
        detect(models_dir, models_dir / "pinhole", frames)


def test_an_exif_rotation_that_is_not_applied_is_told(
    models_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (320, 240)).save(tmp_path / "turned.jpg", exif=exif)
    Image.new("RGB", (320, 240)).save(tmp_path / "upright.jpg")
    detect(models_dir / "flat", tmp_path, out=tmp_path / "out")
    told = capsys.readouterr().err
    assert f"1 image has an EXIF rotation that was not applied (first: {tmp_path}/turned.jpg)" in told
    detect(models_dir / "flat", tmp_path, out=tmp_path / "out", overwrite=True, exif_rotation=True)
    assert "EXIF" not in capsys.readouterr().err


def test_frames_that_show_more_than_the_model_is_shown_are_told(
    models_dir: Path, frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = tmp_path / "camera.json"
    for focal_px in (100.0, 900.0):
        matrix = [[focal_px, 0, 159.5], [0, focal_px, 119.5], [0, 0, 1]]
        camera.write_text(json.dumps({"camera_matrix": matrix}))
        detect(models_dir / "pinhole", frames, camera=camera, out=tmp_path / "out", overwrite=True)
        told = capsys.readouterr().err
        wide = f"6 images show more than the model's camera saw in training (first: {frames}/000000.png): the middle"
        assert (wide in told) == (focal_px == 100), told


def test_a_model_that_exhausts_memory_is_refused(frames: Path, tmp_path: Path, spot_onnx: Callable[..., Any]) -> None:
    """Its graph fills 6 GiB before the first image; a check in another process with limits finds that out."""
    model = spot_onnx(False)
    constants = (("huge", [3 << 29]), ("all", [0]))
    model.graph.initializer.extend(numpy_helper.from_array(np.array(value), name) for name, value in constants)
    (last,) = [node for node in model.graph.node if "confidence" in node.output]
    last.output[list(last.output).index("confidence")] = "confidence_alone"
    model.graph.node.extend(
        [
            helper.make_node("ConstantOfShape", ["huge"], ["zeros"]),
            helper.make_node("ReduceMax", ["zeros", "all"], ["zero"], keepdims=1),
            helper.make_node("Add", ["confidence_alone", "zero"], ["confidence"]),
        ]
    )
    onnx.save(model, tmp_path / "huge.onnx")
    with pytest.raises(ModelError, match=r"huge\.onnx"):
        detect(tmp_path / "huge.onnx", frames)


def test_standard_input_and_output(models_dir: Path, frames: Path) -> None:
    listed = "".join(f"{path}\n" for path in sorted(frames.iterdir(), reverse=True))
    done = subprocess.run(
        command(models_dir / "flat", "-"), input=listed, capture_output=True, text=True, check=True, env=os.environ
    )
    assert [json.loads(line)["image"] for line in done.stdout.splitlines()] == listed.split()
    assert "6 images" in done.stderr


def test_a_file_is_not_gone_on_with_by_another_camera(
    models_dir: Path, frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera, out = tmp_path / "camera.json", tmp_path / "poses.jsonl"
    for focal_px, lens, told in (
        (900.0, 0.0, None),
        (300.0, 0.0, "by another camera .fx 900 px, k1 0; now 300 px, 0"),
        (900.0, 0.1, "by another camera .fx 900 px, k1 0; now 900 px, 0.1"),
        (900.0, 0.0, None),
    ):
        matrix = [[focal_px, 0, 160], [0, focal_px, 120], [0, 0, 1]]
        camera.write_text(json.dumps({"camera_matrix": matrix, "distortion": [lens, 0, 0, 0]}))
        if told is None:
            assert detect(models_dir / "pinhole", frames, camera=camera, out=out) == 0
            cv2.imwrite(str(frames / "000007.png"), cv2.imread(str(frames / "000000.png")))
            continue
        with pytest.raises(UsageError, match=told):
            detect(models_dir / "pinhole", frames, camera=camera, out=out)
    assert len(read(out)) == 7
    (frames / "000008.png").write_bytes(b"no image")
    for _ in range(2):
        assert detect(models_dir / "pinhole", frames, camera=camera, out=out) == 1
    assert "--overwrite answers all again" in capsys.readouterr().err
