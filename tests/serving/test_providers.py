"""``--provider``: one rule for server and command line, and a refusal that lists what there is."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import onnx
import pytest
from curio_serve.batch.arguments import DetectArguments
from curio_serve.batch.detect_cli import run
from curio_serve.errors import ModelError, UsageError
from curio_serve.models.runtime import (
    CPU,
    available_providers,
    on_processor,
    open_session,
    read_providers,
    short_name,
)
from curio_serve.server.config import ServeConfig
from curio_serve.server.server import PoseServer


@pytest.mark.parametrize("text", ["cpu", "CPU", " cpu ", "cpu,cpu", "CPUExecutionProvider"])
def test_short_names_and_onnxruntimes_own(text: str) -> None:
    assert read_providers(text) == (CPU,)


@pytest.mark.parametrize(
    ("full", "short"),
    [
        ("OpenVINOExecutionProvider", "openvino"),
        ("CUDAExecutionProvider", "cuda"),
        ("TensorrtExecutionProvider", "tensorrt"),
        ("CoreMLExecutionProvider", "coreml"),
        ("DmlExecutionProvider", "dml"),
    ],
)
def test_short_names_of_others(full: str, short: str) -> None:
    import onnxruntime

    assert full in onnxruntime.get_all_providers(), "onnxruntime calls it otherwise now"
    assert short_name(full) == short
    assert on_processor([full, CPU]) == (short == "openvino")


@pytest.mark.parametrize("text", ["", "cpu,", "vulkan", "cpu vulkan"])
def test_what_there_is_not_is_refused_with_what_there_is(text: str) -> None:
    with pytest.raises(UsageError, match=r"^--provider .* has no provider '.*'; it has .*cpu \(CPUExecutionProvider\)"):
        read_providers(text)


def test_the_package_that_brings_a_provider_is_named() -> None:
    absent = "openvino" if "OpenVINOExecutionProvider" not in available_providers() else "cuda"
    with pytest.raises(UsageError, match=f"For {absent}: pip install onnxruntime-"):
        read_providers(absent)


def test_a_provider_that_cannot_be_started_is_refused_and_not_replaced(
    spot_onnx: Callable[..., onnx.ModelProto], capfd: pytest.CaptureFixture[str]
) -> None:
    """onnxruntime itself would say so on standard output, where results go, and compute on the CPU."""
    with pytest.raises(ModelError, match=r"spot\.onnx: onnxruntime .*NoSuchExecutionProvider"):
        open_session(spot_onnx(False).SerializeToString(), "spot.onnx", ("NoSuchExecutionProvider", CPU))
    assert capfd.readouterr().out == ""


def test_server_and_command_line_refuse_alike(models_dir: Path, frames: Path) -> None:
    with pytest.raises(UsageError) as of_server:
        PoseServer(ServeConfig(models_dir, provider="vulkan"))
    with pytest.raises(UsageError) as of_command:
        run(DetectArguments(str(models_dir / "flat"), (str(frames),), provider="vulkan"))
    assert str(of_server.value) == str(of_command.value)


def test_the_command_line_detects_with_the_provider(models_dir: Path, frames: Path, tmp_path: Path) -> None:
    outs = [tmp_path / "default.jsonl", tmp_path / "named.jsonl"]
    for out, flags in zip(outs, ({}, {"provider": "CPUExecutionProvider"}), strict=True):
        assert run(DetectArguments(str(models_dir / "flat"), (str(frames),), out=str(out), **flags)) == 0
    found = [[line.split('"milliseconds"')[0] for line in out.read_text().splitlines()] for out in outs]
    assert found[0] == found[1]
    assert len(found[0]) == 6


def test_a_servers_model_takes_no_provider(server: Any, frames: Path) -> None:
    with pytest.raises(UsageError, match="--provider openvino: found a model on a server, which chooses its own"):
        run(DetectArguments(f"{server.address}/flat", (str(frames),), provider="openvino"))
