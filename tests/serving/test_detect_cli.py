"""``curio-detect`` on a model of this machine: what it writes, what it refuses, what it survives."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from curio_serve.batch.detect_cli import DetectArguments, run
from curio_serve.errors import CurioError, ModelError, UsageError
from onnx import helper, numpy_helper


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-c", "from curio_serve.batch.detect_cli import main; main()", *map(str, arguments)]


def detect(model: Path, *sources: Path | str, **flags: Any) -> int:
    """In this process; returns the exit status."""
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
        ({"images": ()}, "no images given"),
        ({"images": ("missing.png",)}, "missing.png: no such file"),
        ({"model": "pinhole"}, "--camera FILE"),
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
    call = {"model": "flat", "images": ("frames",), "out": Path("out"), **changes}
    with pytest.raises(UsageError, match=told):
        run(DetectArguments(**call))
    assert not (tmp_path / "out").exists()
    assert len(list(frames.iterdir())) == 6


def test_a_folder_without_images_is_no_success(models_dir: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match=r"no images in .*empty"):
        detect(models_dir / "flat", tmp_path / "empty", out=tmp_path / "out.jsonl")


def test_a_folder_that_is_no_model_is_named(models_dir: Path, frames: Path) -> None:
    with pytest.raises(CurioError, match="no model in"):
        detect(models_dir, frames)


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
