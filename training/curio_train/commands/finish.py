"""What a finished run leaves beside itself: a report, and of one's own part a model that can be served."""

import functools
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from curio_serve.models.model_folder import MODELS_OF_RUN

from curio_train.config import RunConfig
from curio_train.errors import CurioError, ExportError
from curio_train.second_process import SecondProcess
from curio_train.worlds.options import CaptureOptions

if TYPE_CHECKING:
    from onnx import ModelProto

    from curio_train.export.ahead import TracingAhead
    from curio_train.export.graph import Graph


def end(
    run: Path,
    config: RunConfig,
    cache: Path,
    warn: Callable[[str], None],
    say: Callable[[str], None],
    ahead: "TracingAhead | None" = None,
) -> str:
    """Write the report and, of one's own part, the next version of RUN/models/NAME.

    Args:
        run: The run folder.
        config: Its configuration.
        cache: Where worlds keep their image sets.
        warn: Called with the reason if the report could not be made; the run has succeeded all the same.
        say: Called with what is done next, because each takes up to minutes.
        ahead: Traces the graph of its model, if that was begun before. A further process then makes the report.

    Returns:
        How to go on, for the user.

    Raises:
        ExportError: No model could be made. The run is whole.
    """
    from curio_train.evaluation.reporting.report import REPORT_FILE, report_training

    if isinstance(config.world, CaptureOptions) and ahead is not None:
        say(f"{run}: writing report and model")
        with SecondProcess(report_training, run, cache) as reporting:
            told = functools.cache(lambda: _told(reporting.result, warn))
            return _exported(run, config.world.camera, told, say, ahead.model)
    say(f"{run}: writing the report")
    try:
        verdict = report_training(run, cache)
    except CurioError as exc:
        verdict = _told(exc, warn)
    if isinstance(config.world, CaptureOptions):
        say(f"{run}: writing the model, which takes a minute or two")
        return _exported(run, config.world.camera, lambda: verdict, say)
    viewed = "" if config.world.is_flat else f", or curio-view {run}"
    return (
        f"to see what it learned: {run / REPORT_FILE}{viewed}\n"
        f"to serve it: curio-export {run} --out models/, then curio-serve models/"
    )


def _told(verdict: str | CurioError, warn: Callable[[str], None]) -> str:
    if isinstance(verdict, str):
        return verdict
    warn(str(verdict))
    return ""


def _exported(
    run: Path,
    camera: Path,
    verdict: Callable[[], str],
    say: Callable[[str], None],
    traced: "Callable[[Graph], ModelProto | None]" = lambda _: None,
) -> str:
    from curio_train.export.write_model import export

    models = run / MODELS_OF_RUN
    again = shlex.join(["curio-export", str(run), "--out", str(models)])
    try:
        done = export(run, models, ahead=traced, report=verdict)
    except CurioError as exc:
        raise ExportError(
            f"{run} is trained and whole, but no model could be made of it ({exc}). Once that is put right: {again}"
        ) from exc
    except KeyboardInterrupt:
        say(f"{run} is trained and whole; to make its model: {again}")
        raise
    said = verdict()
    return (
        f"{done.path}: the model, {done.num_bytes / 1e6:.1f} MB; what it finds in the photographs: {run}/report.html\n"
        + (f"by its photographs, without labels: {said}\n" if said else "")
        + f"to serve it: curio-serve {shlex.quote(str(models))}\n"
        f"to try it:   curio-detect {shlex.quote(str(done.path.parent))} PHOTOS --camera {shlex.quote(str(camera))} "
        "--out poses.jsonl --overlays overlays/"
    )
