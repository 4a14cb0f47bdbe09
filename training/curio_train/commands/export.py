"""The command ``curio-export``. Heavy packages are imported only once its arguments are understood."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import FlagCreatePairsOff, Positional, arg

from curio_train.commands.field_help import parsed
from curio_train.commands.running import CACHE, answer
from curio_train.errors import UsageError


@dataclass(frozen=True)
class ExportCommand:
    """Write a run's network as the next version of a model that any ONNX runtime can serve."""

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """The run folder. Its training images are not needed."""
    out: Path = Path("models")
    """Folder of models; the model goes to OUT/NAME/VERSION/model.onnx."""
    name: str | None = None
    """Of the model; the world's name, or LineMOD's class, unless given."""
    half: FlagCreatePairsOff[bool] = False
    """Store weights as float16: half the size, computed with in float32."""
    int8: FlagCreatePairsOff[bool] = False
    """Convolutions in int8: a third of the size, and faster. Draws renderings; refused if accuracy falls by a point."""
    cache: Path = CACHE
    """Where image sets that a world draws once are kept, for --int8."""


def export(arguments: Sequence[str] | None = None) -> None:
    """``curio-export RUN …``; exit status as of :func:`~curio_train.commands.train.train`."""
    command = parsed(ExportCommand, arguments, "curio-export")
    sys.exit(answer(lambda _: _export(command)))


def _export(command: ExportCommand) -> int:
    if command.half and command.int8:
        raise UsageError("--half and --int8 are two ways to store the same weights; give one of them")
    from curio_train.evaluation.int8 import int8
    from curio_train.export.graph import export

    reduce = int8(command.cache.expanduser()) if command.int8 else None
    with Console(stderr=True).status("tracing, and comparing torch with onnxruntime"):
        done = export(command.run, command.out, command.name, half=command.half, reduce=reduce)
    print(
        f"{done.path}: {done.num_bytes / 1e6:.1f} MB, differs from torch by at most {done.parity_error:.2g}"
        + (f", from the float32 weights by {done.rounding_error:.2g}" if command.half else "")
    )
    if command.int8:
        print(f"{done.weights}; outputs differ by at most {done.rounding_error:.2g} on the check images")
    return 0
