"""Evaluates a network that reads each image several times, as ``curio-detect --reads`` does."""

from dataclasses import replace

import numpy as np
import torch
from curio_serve.errors import ArgumentError
from curio_serve.models.repeated import RepeatedReader
from torch import Tensor

from curio_train.errors import UsageError
from curio_train.evaluation.subject import Subject
from curio_train.export.spec import model_spec


def reading_repeatedly(subject: Subject, num_reads: int) -> Subject:
    """A network that reads each image several times.

    Raises:
        UsageError: Its world allows no more than one, or not that many.
    """
    outputs = subject.world.outputs

    def run(images: np.ndarray) -> dict[str, np.ndarray]:
        code = subject.predict(torch.from_numpy(images).permute(0, 3, 1, 2).contiguous())
        return {name: values.numpy() for name, values in outputs.from_code(code).items()}

    try:
        reader = RepeatedReader(model_spec(subject.world, subject.world.name), run, num_reads)
    except ArgumentError as exc:
        raise UsageError(f"--reads: {exc}") from exc

    def predict(images: Tensor) -> dict[str, Tensor]:
        values = reader(images.permute(0, 2, 3, 1).contiguous().numpy())
        return outputs.to_code({name: torch.from_numpy(value) for name, value in values.items()})

    return replace(subject, predict=predict)
