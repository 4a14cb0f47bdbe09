"""Exported models in training: found, opened and run by serving's own code, with training's errors."""

from pathlib import Path

import torch
from curio_proto.v1.model_spec_pb2 import ModelSpec
from curio_serve.errors import InternalError, ModelError
from curio_serve.files import read_file
from curio_serve.models import model as serving
from curio_serve.models.model_folder import MODEL_FILE, in_run, versions
from torch import Tensor

from curio_train.errors import ExportError, UsageError

WEIGHTS_FILE = "weights.safetensors"
"""File beside a version's ONNX file with the network as it was trained, to train it further."""

_OF_RUN = "config.json"


class ExportedModel:
    """An exported model, run as serving runs it."""

    def __init__(self, content: bytes, where: str) -> None:
        """Open a model.

        Args:
            content: Of the file.
            where: The file, for messages.

        Raises:
            ExportError: It is not an exported model, or onnxruntime refuses it.
        """
        try:
            self._model = serving.from_bytes(content, where)
        except ModelError as exc:
            raise ExportError(str(exc)) from exc

    @staticmethod
    def open(path: Path) -> "ExportedModel":
        """The model in a file.

        Raises:
            ExportError: It cannot be read or used.
        """
        try:
            return ExportedModel(read_file(path, serving.MAX_BYTES), str(path))
        except OSError as exc:
            raise ExportError(f"{path} cannot be read: {exc.strerror}; expected an exported .onnx file") from exc

    @property
    def spec(self) -> ModelSpec:
        """The model's specification."""
        return self._model.spec

    def __call__(self, images: Tensor) -> dict[str, Tensor]:
        """Outputs by name.

        Args:
            images: uint8 RGB [batch, height, width, 3] of the canonical camera's size.

        Raises:
            ExportError: onnxruntime failed on them, or an output is not finite.
        """
        try:
            outputs = self._model.run(images.numpy())
        except InternalError as exc:
            raise ExportError(str(exc)) from exc
        return {name: torch.from_numpy(value) for name, value in outputs.items()}


def find_model(path: Path) -> Path:
    """The ONNX file of a model folder (latest version), of a version's folder, or the file itself.

    Raises:
        UsageError: There is none.
    """
    if path.is_file():
        return path
    if (path / MODEL_FILE).is_file():
        return path / MODEL_FILE
    try:
        found = versions(path) if path.is_dir() else []
    except ModelError as exc:
        raise UsageError(str(exc)) from exc
    if not found and (where := in_run(path)):
        raise UsageError(f"{path}: no model{where}")
    if not found and (path / _OF_RUN).is_file():
        raise UsageError(f"{path}: a run whose model is not written yet; do that first: curio-export {path}")
    if not found:
        raise UsageError(
            f"{path}: neither a run folder ({_OF_RUN}) nor a model (<version>/{MODEL_FILE}); expected what "
            "curio-train or curio-export wrote"
        )
    return path / str(found[-1]) / MODEL_FILE
