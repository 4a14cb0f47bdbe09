"""Chooses onnxruntime's execution providers and opens graphs with them.

The only file that imports onnxruntime, and that when a model is loaded.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING

from curio_serve.errors import ModelError, UsageError

if TYPE_CHECKING:
    import onnxruntime

CPU = "CPUExecutionProvider"
_SUFFIX = "ExecutionProvider"
_PACKAGES = {
    "openvino": "pip install onnxruntime-openvino in place of onnxruntime",
    "cuda": "pip install onnxruntime-gpu in place of onnxruntime",
    "tensorrt": "pip install onnxruntime-gpu, and TensorRT, in place of onnxruntime",
    "dml": "pip install onnxruntime-directml in place of onnxruntime, on Windows",
    "coreml": "onnxruntime has it on macOS alone",
}
# They compute on the processor itself.
_ON_PROCESSOR = frozenset({CPU, "OpenVINOExecutionProvider", "XnnpackExecutionProvider", "DnnlExecutionProvider"})
# Sends operators of its own kind to a web service and computes none of a network's.
_NOT_LOCAL = "AzureExecutionProvider"


@dataclass(frozen=True)
class Runtime:
    """The settings that networks run with."""

    providers: tuple[str, ...] = (CPU,)
    """onnxruntime's execution providers in order of preference."""
    max_batch: int = 1
    """Largest number of images of several calls in one run; 1: every call runs on its own."""


DEFAULT_RUNTIME = Runtime()


def available_providers() -> list[str]:
    """The providers of the installed onnxruntime that can compute a network here, in its own order and names."""
    return [name for name in load_onnxruntime().get_available_providers() if name != _NOT_LOCAL]


def short_name(provider: str) -> str:
    """The short name of a provider for ``--provider``: ``cpu`` for ``CPUExecutionProvider``."""
    return provider.removesuffix(_SUFFIX).lower()


def read_providers(text: str) -> tuple[str, ...]:
    """The providers that a ``--provider`` names, all of which the installed onnxruntime has.

    Args:
        text: Names in order of preference with commas between: short ones in any case, or onnxruntime's own.

    Returns:
        onnxruntime's names.

    Raises:
        UsageError: It has not one of them; lists those that it has.
    """
    found = {short_name(name): name for name in available_providers()}
    names = [short_name(name.strip()) for name in text.split(",")]
    for name in names:
        if name not in found:
            version = load_onnxruntime().__version__
            package = f". For {name}: {_PACKAGES[name]}" if name in _PACKAGES else ""
            raise UsageError(
                f"--provider {text}: onnxruntime {version}, as it is installed here, has no provider {name!r}; it has "
                f"{', '.join(f'{short} ({full})' for short, full in found.items())}{package}"
            )
    return tuple(dict.fromkeys(found[name] for name in names))


def on_processor(providers: Sequence[str]) -> bool:
    """Whether all providers compute on the CPU, where batches gain nothing."""
    return _ON_PROCESSOR.issuperset(providers)


def open_session(data: bytes, where: str, providers: Sequence[str]) -> "onnxruntime.InferenceSession":
    """A session with one thread a call: parallel calls share it, so that the weights are in memory once.

    Args:
        data: An ONNX file's content.
        where: The file, for messages.
        providers: onnxruntime's names, in order of preference; what they cannot compute the CPU does.

    Raises:
        ModelError: onnxruntime refuses the graph, or cannot start a provider.
    """
    onnxruntime = load_onnxruntime()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    options.enable_mem_pattern = (
        False  # plans of memory take more of it (docs/experiments/serving.md), and no less time
    )
    options.add_session_config_entry("session.load_model_format", "ONNX")
    try:
        # Without its own fallback, which prints to standard output and computes on the CPU.
        session = onnxruntime.InferenceSession(data, options, providers=list(providers), enable_fallback=0)
    except runtime_errors() as exc:
        on = "" if tuple(providers) == (CPU,) else f" with {', '.join(providers)}"
        raise ModelError(f"{where}: onnxruntime refuses the graph{on}: {exc}") from exc
    if missing := set(providers) - set(session.get_providers()):
        raise ModelError(
            f"{where}: onnxruntime could not start {', '.join(sorted(missing))} (its log says why; a driver or library "
            f"may be missing) and would compute with {', '.join(session.get_providers())}; choose another --provider"
        )
    return session


def runtime_errors() -> tuple[type[Exception], ...]:
    """Onnxruntime's exceptions, which share no base; its Python side and some providers raise Python's own."""
    from onnxruntime.capi import onnxruntime_pybind11_state as runtime

    names = ("Fail", "InvalidArgument", "InvalidGraph", "InvalidProtobuf", "NotImplemented", "NoModel", "EPFail")
    return (ValueError, RuntimeError, runtime.RuntimeException, *(getattr(runtime, name) for name in names))


def load_onnxruntime() -> ModuleType:
    """The package, with its telemetry off."""
    # Before the import: unless told not to, onnxruntime from 1.29 on writes an identifier into the user's cache folder
    # and uploads events to its makers (its Privacy.md).
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    import onnxruntime

    module: ModuleType = onnxruntime
    return module
