"""Exports in int8, refused where that costs accuracy."""

from pathlib import Path

import onnx

from curio_train.errors import ExportError
from curio_train.evaluation.evaluate import draw
from curio_train.evaluation.scores import accuracy
from curio_train.evaluation.subject import Predict, model_reader
from curio_train.export.int8 import to_int8
from curio_train.export.onnx import store_half
from curio_train.export.write_model import Reduce, Reduced
from curio_train.exported_model import ExportedModel
from curio_train.worlds.base import World

NUM_CALIBRATION, NUM_HELD_OUT = 64, 500
LARGEST_LOSS = 0.01
"""Largest loss of accuracy that is allowed, as a fraction of all objects."""


def int8(cache: Path, *, half: bool) -> Reduce:
    """The reduction to int8, calibrated on renderings of the validation split and judged on those of the test split.

    Args:
        cache: Where worlds keep their image sets.
        half: Whether to store weights that are not reduced as float16.
    """

    def reduce(world: World, model: onnx.ModelProto) -> Reduced:
        quantised = to_int8(model, draw(world, "validation", NUM_CALIBRATION, cache).images)
        held_out = draw(world, "test", NUM_HELD_OUT, cache)
        before, after = (
            accuracy(world, _reader(world, one)(held_out.images), held_out.code) for one in (model, quantised)
        )
        figures = f"accuracy on {len(held_out.images)} held-out renderings {after:.1%} in int8, {before:.1%} in float32"
        if after < before - LARGEST_LOSS:
            raise ExportError(
                f"{figures}: int8 costs more than {100 * LARGEST_LOSS:g} point; nothing was written. "
                "Export without --int8"
            )
        if half:
            store_half(quantised)
        return Reduced(quantised, f"int8 convolutions, else {'float16' if half else 'float32'}; {figures}")

    return reduce


def _reader(world: World, model: onnx.ModelProto) -> Predict:
    return model_reader(ExportedModel(model.SerializeToString(), "the exported graph"), world)
