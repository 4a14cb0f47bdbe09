"""Loads models from folders in Triton's layout: ``<name>/{config.pbtxt, CARD.md, SHA256SUMS, <version>/model.onnx}``.

The files beside the ONNX file are checked, too: its hash in SHA256SUMS, the tensors in config.pbtxt, and, if a version
has ``golden.npz`` (``image`` uint8 [height, width, 3] and the outputs for it by name, without a batch), whether the
network gives those outputs on this machine.

A version's folder is named 1 to 999999999 in ASCII digits without a leading zero; as in Triton, others are passed over.
"""

import hashlib
import re
import stat
from pathlib import Path

from curio_proto.files.triton_config_pb2 import TritonConfig, TritonType
from google.protobuf import text_format

from curio_serve.errors import ModelError
from curio_serve.files import read_file
from curio_serve.models.golden import GOLDEN_FILE, check_golden
from curio_serve.models.model import BESIDE, INPUT, Model, load
from curio_serve.models.runtime import DEFAULT_RUNTIME, Runtime

CONFIG_FILE = "config.pbtxt"
MODEL_FILE = "model.onnx"
SUMS_FILE = "SHA256SUMS"
MODELS_OF_RUN = "models"
"""The folder of models in a run folder of curio-train."""

_MAX_TEXT_BYTES = 1 << 20
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_VERSION = re.compile(r"[1-9][0-9]{0,8}")


def is_model_name(name: str) -> bool:
    """Whether a text is a valid model name: at most 64 letters, digits, ``_``, ``-`` and ``.``, no leading dot."""
    return _NAME.fullmatch(name) is not None


def versions(folder: Path) -> list[int]:
    """Versions in a model's folder, ascending.

    Raises:
        ModelError: It cannot be read.
    """
    try:
        return sorted(
            int(entry.name) for entry in folder.iterdir() if _VERSION.fullmatch(entry.name) and _has_model(entry)
        )
    except OSError as exc:
        raise ModelError(f"model folder {folder} cannot be read: {exc.strerror}") from exc


def _has_model(version: Path) -> bool:
    """Whether a version's folder has a model. True if that cannot be found out: loading it then reports why."""
    try:
        return stat.S_ISREG((version / MODEL_FILE).stat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:
        return True


def load_version(folder: Path, version: int, runtime: Runtime = DEFAULT_RUNTIME) -> Model:
    """Load one version of a model's folder.

    Raises:
        ModelError: Says what is wrong with it.
    """
    path = folder / str(version) / MODEL_FILE
    model = load(path, folder.name, version, runtime)
    try:
        _check_sum(folder, f"{version}/{MODEL_FILE}", model.sha256)
        for file, (field, _) in BESIDE.items():
            if model.spec.HasField(field):
                _check_file_sum(folder, f"{version}/{file}")
            elif (folder / SUMS_FILE).exists() and f"{version}/{file}" in listed_sums(folder):
                missing = folder / str(version) / file
                raise ModelError(f"{missing} is missing, and {SUMS_FILE} lists it; copy the folder again")
        _check_config(folder, model)
        check_golden(folder / str(version) / GOLDEN_FILE, model)
    except OSError as exc:
        raise ModelError(f"{exc.filename} cannot be read: {exc.strerror}") from exc
    return model


def in_run(path: Path) -> str:
    """Where the models of a training run are, for messages; empty for any other folder."""
    folder = path / MODELS_OF_RUN
    found = sorted(one.name for one in folder.iterdir() if one.is_dir()) if folder.is_dir() else []
    return f". {path} is a run: name {folder / found[0]}" if found else ""


def open_model(path: str | Path, runtime: Runtime = DEFAULT_RUNTIME) -> Model:
    """Load the MODEL of a command line: a model folder (its latest version), a version folder or an .onnx file.

    Args:
        path: What was typed.
        runtime: How the network is run.

    Raises:
        ModelError: There is no model, or it cannot be used.
    """
    path = Path(path)
    if path.is_file():
        return load(path, runtime=runtime)
    if not path.is_dir():
        raise ModelError(f"no model at {path}; expected a model folder, a version folder or an .onnx file")
    resolved = path.resolve()
    if (path / MODEL_FILE).is_file():
        if _VERSION.fullmatch(resolved.name):
            return load_version(resolved.parent, int(resolved.name), runtime)
        return load(path / MODEL_FILE, runtime=runtime)
    found = versions(path)
    if not found:
        raise ModelError(
            f"no model in {path}; expected {path}/<version>/{MODEL_FILE}, as curio-export writes it{in_run(path)}"
        )
    try:
        return load_version(resolved, found[-1], runtime)
    except ModelError as exc:
        if len(found) == 1:
            raise
        raise ModelError(f"{exc}; the version before can be named: {path / str(found[-2])}") from exc


def listed_sums(folder: Path) -> dict[str, str]:
    """SHA-256 in lower case by file, as SHA256SUMS in a model's folder lists them (``sha256sum``'s format).

    Raises:
        OSError: It cannot be read.
    """
    text = read_file(folder / SUMS_FILE, _MAX_TEXT_BYTES).decode("utf-8", errors="replace")
    lines = (line.split(maxsplit=1) for line in text.splitlines())
    return {parts[1].strip().lstrip("*").removeprefix("./"): parts[0].lower() for parts in lines if len(parts) == 2}


def _check_sum(folder: Path, file: str, sha256: str) -> None:
    """Compare with SHA256SUMS, if the folder has one."""
    sums = folder / SUMS_FILE
    if not sums.exists():
        return
    expected = listed_sums(folder)
    if file not in expected:
        raise ModelError(f"{sums} does not list {file}; it lists {sorted(expected)}. Export again, or add its line")
    if expected[file] != sha256:
        raise ModelError(
            f"{folder / file} has SHA-256 {sha256[:12]}…, but SHA256SUMS says {expected[file][:12]}…: "
            "the file is damaged or was replaced; copy it again"
        )


def _check_file_sum(folder: Path, file: str) -> None:
    _check_sum(folder, file, hashlib.sha256((folder / file).read_bytes()).hexdigest())


def _check_config(folder: Path, model: Model) -> None:
    """Compare config.pbtxt, if the folder has one, with the graph."""
    path = folder / CONFIG_FILE
    if not path.exists():
        return
    text = read_file(path, _MAX_TEXT_BYTES)
    try:
        config = text_format.Parse(text.decode("utf-8"), TritonConfig(), allow_unknown_field=True)
    except (text_format.ParseError, UnicodeDecodeError, RecursionError) as exc:
        raise ModelError(f"{path} is not a Triton model configuration: {exc}") from exc
    if config.name not in ("", folder.name):
        raise ModelError(f"{path}: name is {config.name!r}; Triton wants the folder's, {folder.name!r}")
    if "onnxruntime" not in (config.backend, config.platform.removesuffix("_onnx")):
        raise ModelError(f'{path}: backend is {config.backend or config.platform!r}; expected "onnxruntime"')
    if config.max_batch_size < 1:
        raise ModelError(f"{path}: max_batch_size is {config.max_batch_size}; expected at least 1: the batch is free")
    inputs = {t.name: (t.data_type, list(t.dims)) for t in config.input}
    expected = {INPUT: (TritonType.TYPE_UINT8, [model.camera.height, model.camera.width, 3])}
    if inputs != expected:
        raise ModelError(
            f"{path}: inputs are {inputs}; the graph has {expected} (type {TritonType.TYPE_UINT8} is UINT8)"
        )
    outputs = {t.name: (t.data_type, list(t.dims)) for t in config.output}
    expected = {name: (TritonType.TYPE_FP32, list(shape)) for name, shape in model.output_shapes.items()}
    if outputs != expected:
        raise ModelError(f"{path}: outputs are {outputs}; the graph has {expected}")
