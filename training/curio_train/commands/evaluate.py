"""The command ``curio-eval``. Heavy packages are imported only once its arguments are understood."""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from curio_serve.command_line import parsed
from rich.console import Console
from tyro.conf import FlagCreatePairsOff, Positional, arg

from curio_train.commands.command_line.running import CACHE, answer, report, warn
from curio_train.commands.linemod_data import fetched_linemod

if TYPE_CHECKING:
    from curio_serve.planes.camera_poses import GivenPlane


@dataclass(frozen=True)
class EvaluateCommand:
    """Score a run or a model on held-out images of its world, beside the same network untrained."""

    path: Annotated[Positional[Path], arg(metavar="RUN_OR_MODEL")]
    """A run folder, a model folder (its latest version), a version's folder, or an .onnx file."""
    split: Literal["train", "validation", "test"] = "test"
    """Which images of the world."""
    num_images: int | None = None
    """How many images; unless given, 100 of linemod and of capture without --plane, which are rendered for it,
    and 500 of others."""
    data: Path | None = None
    """BOP data set whose real frames are scored as well; needed for an exported LineMOD model."""
    download: FlagCreatePairsOff[bool] = False
    """Without --data, fetch LineMOD with its real frames into --cache, once, some gigabytes, and score on them."""
    bop_results: Path | None = None
    """Folder for a results file of the real frames in BOP's format."""
    refine: FlagCreatePairsOff[bool] = False
    """Score the poses once more after rendering and comparing; needs the renderer, as serving never does."""
    reads: int = 1
    """Read each image that many times, as curio-detect --reads does."""
    plane: Annotated[str | None, arg(metavar="FILE|objects")] = None
    """With --data: move poses onto the plane on which objects stand, as curio-detect --plane does."""
    json: FlagCreatePairsOff[bool] = False
    """Print the result as one JSON object on the last line."""
    cache: Path = CACHE
    """Where image sets that a world draws once are kept."""


def evaluate(arguments: Sequence[str] | None = None) -> None:
    """``curio-eval RUN_OR_MODEL …``; exit status as of :func:`~curio_train.commands.train.train`."""
    command = parsed(EvaluateCommand, arguments, "curio-eval")
    sys.exit(answer(lambda _: _evaluate(command)))


def _evaluate(command: EvaluateCommand) -> int:
    from curio_train.evaluation.evaluate import evaluate
    from curio_train.evaluation.reporting.tables import print_evaluation
    from curio_train.evaluation.subject import refuse_without_frames

    if command.download and command.data is None:
        refuse_without_frames(command.path)  # before gigabytes are fetched
        command = replace(command, data=fetched_linemod(command.cache, report, ask=False, frames=True))
    names = ("split", "num_images", "data", "bop_results", "refine", "reads", "cache")
    given = {name: getattr(command, name) for name in names}
    given["plane"] = _plane(command.plane)
    with Console(stderr=True).status("") as status:
        result = evaluate(command.path, **given, progress=status.update, warn=warn)
    print_evaluation(result, Console())
    if command.json:
        print(json.dumps(result))
    return 0


def _plane(given: str | None) -> "GivenPlane":
    from curio_train.capture.plane import CameraPoseFile

    plane = CameraPoseFile.named(given)
    if isinstance(plane, CameraPoseFile):
        plane.refuse_impossible_planes()
    return plane
