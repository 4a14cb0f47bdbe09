"""A version's golden image: the network's outputs where it was exported, to be compared with its outputs here.

``golden.npz`` holds ``image``, uint8 [height, width, 3], and the outputs for it by name, without a batch. Entries that
rounding decides on this image, such as the place of an object that it does not show, are nan and not compared.
"""

import io
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from curio_serve.errors import InternalError, ModelError
from curio_serve.files import read_file
from curio_serve.models.model import INPUT, Model

GOLDEN_FILE = "golden.npz"
LARGEST_DIFFERENCE = 1e-3
"""Between stored and computed outputs: metres, image widths, entries of matrices. Float16 weights on another processor
stay below, and what is stored of a model that computes in int8."""

_MAX_BYTES = 1 << 28


@dataclass(frozen=True, eq=False)
class Golden:
    """An image and its outputs."""

    path: Path
    """The file."""
    image: np.ndarray
    """uint8 RGB [height, width, 3] of the size of the model's camera."""
    outputs: Mapping[str, np.ndarray]
    """Outputs by name, without a batch dimension; at least one."""

    def differences(self, model: Model) -> dict[str, float]:
        """Largest absolute difference between each stored output and the model's.

        It is nan if the model's is not finite, or nothing of the stored one is.

        Raises:
            ModelError: The image cannot pass the graph, or an output is none of the graph's.
        """
        try:
            found = model.run(self.image[None])
        except InternalError as exc:
            raise ModelError(f"{self.path}: the golden image cannot pass the graph: {exc}") from exc
        for name, value in self.outputs.items():
            if name not in found or found[name][0].shape != value.shape:
                raise ModelError(
                    f"{self.path}: {name} {value.shape} is no output of the graph, which has {model.output_shapes}"
                )
        return {name: _largest_difference(found[name][0], value) for name, value in self.outputs.items()}


def _largest_difference(found: np.ndarray, stored: np.ndarray) -> float:
    compared = ~np.isnan(stored)
    if not compared.any():
        return float("nan")
    return float(np.abs(found[compared] - stored[compared]).max())


def read_golden(path: Path, model: Model) -> Golden:
    """The golden image in a file.

    Args:
        path: The file.
        model: That it is of.

    Raises:
        OSError: It cannot be read.
        ModelError: It is not an archive of arrays, or has no image of the model's size, or no output.
    """
    content = read_file(path, _MAX_BYTES)
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            outputs = dict(file)
    # zipfile raises RuntimeError for encrypted members and unknown methods; np.load returns a bare array as it is.
    except (ValueError, TypeError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as exc:
        raise ModelError(f"{path} is not an archive of arrays: {exc}; export the model again") from exc
    image, size = outputs.pop(INPUT, None), (model.camera.height, model.camera.width, 3)
    if image is None or image.shape != size or image.dtype != np.uint8 or not outputs:
        found = None if image is None else f"{image.dtype} {image.shape}"
        raise ModelError(f"{path}: image is {found}, outputs {sorted(outputs)}; expected uint8 {size} and an output")
    return Golden(path, image, outputs)


def check_golden(path: Path, model: Model) -> None:
    """Refuse a model whose outputs for the golden image differ from the stored ones.

    Args:
        path: The file; a version without one is not checked.
        model: To ask.

    Raises:
        OSError: The file cannot be read.
        ModelError: It is damaged, or the answers differ.
    """
    if not path.exists():
        return
    for name, off in read_golden(path, model).differences(model).items():
        if not off <= LARGEST_DIFFERENCE:
            raise ModelError(
                f"{path}: the network's {name} is {off:.3g} off for the golden image; at most "
                f"{LARGEST_DIFFERENCE:.3g} is accepted: this file, or this machine's runtime, does not compute "
                "what was exported; copy or export the model again"
            )
