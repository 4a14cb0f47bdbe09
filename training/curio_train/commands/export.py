"""The command ``curio-export``. Heavy packages are imported only once its arguments are understood."""

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from curio_serve.command_line import parsed
from rich.console import Console
from tyro.conf import FlagCreatePairsOff, Positional, arg

from curio_train.commands.command_line.running import CACHE, answer
from curio_train.errors import CurioError, UsageError

if TYPE_CHECKING:
    from curio_train.data.photographs import UnlabelledPhotographs


@dataclass(frozen=True)
class ExportCommand:
    """Write a run's network as the next version of a model that any ONNX runtime can serve."""

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """The run folder; its training images are not needed. With --push or --intervals also a model's folder."""
    out: Path = Path("models")
    """Folder of models; the model goes to OUT/NAME/VERSION/model.onnx."""
    name: str | None = None
    """Name of the model. None: the one class of LineMOD, the name of the mesh file (of several parts, all joined by -),
    or else the world's name."""
    half: FlagCreatePairsOff[bool] = False
    """Store weights as float16: half the size, computed with in float32."""
    int8: FlagCreatePairsOff[bool] = False
    """Large convolutions in int8: faster and smaller, with --half also what is left. Draws renderings; refused if
    accuracy falls by a point."""
    fast: FlagCreatePairsOff[bool] = False
    """Look at each of several objects once, in one crop of half the resolution: an eighth of the time. For runs that
    learned from --photos."""
    cache: Path = CACHE
    """Where image sets that a world draws once are kept, for --int8 and --intervals."""
    intervals: FlagCreatePairsOff[bool] = False
    """Measure on renderings when answers are sure and how far off they are: 90 % intervals. Minutes."""
    data: Path | None = None
    """Data set of a LineMOD model's folder, for --intervals."""
    photos: Path | None = None
    """Folder of unlabelled photographs of a still scene, in order: --intervals adjusts to how its answers differ."""
    views: Path | None = None
    """File with the camera poses of --photos, as curio-train capture --calibrate --views-out writes it."""
    push: Annotated[str | None, arg(metavar="ORG/NAME")] = None
    """Put the model on a Hugging Face hub, where hf://ORG/NAME names it. A new repository is private."""
    license: str | None = None
    """Licence on the hub's card, as the hub spells it, such as apache-2.0. None: the mesh's, if the card names one."""


def export(arguments: Sequence[str] | None = None) -> None:
    """``curio-export RUN …``; exit status as of :func:`~curio_train.commands.train.train`."""
    command = parsed(ExportCommand, arguments, "curio-export")
    sys.exit(answer(lambda _: _export(command)))


def _export(command: ExportCommand) -> int:
    if command.push is None and command.license is not None:
        raise UsageError("--license is for the hub's card: give it together with --push")
    if (command.photos is None) != (command.views is None) or (command.photos is not None and not command.intervals):
        raise UsageError("--photos, --views and --intervals go together: photographs adjust what renderings measure")
    if command.push is None and not command.intervals:
        _write(command)
        return 0
    from curio_train.export.folder import ModelFolder

    if command.push is not None:
        from curio_train.export.hub import check_repository

        check_repository(command.push)
    views = _views(command)
    is_written = bool(ModelFolder(command.run).versions())
    if is_written and (command.half or command.int8 or command.fast or command.name is not None):
        done = "measured" if command.push is None else "pushed"
        raise UsageError(
            f"{command.run} is a model and {done} as it is; --half, --int8, --fast and --name are for run folders"
        )
    folder, is_measured = command.run if is_written else _write(command).parent, not command.intervals
    try:
        if command.intervals:
            _measure(command, folder, views)
            is_measured = True
        if command.push is not None:
            _push(folder, command.push, command.license)
    except CurioError as exc:
        if is_written:
            raise
        if is_measured:
            license_ = [] if command.license is None else ["--license", command.license]
            again = ["curio-export", str(folder), "--push", str(command.push), *license_]
            raise type(exc)(f"{exc}\n{folder} was written; to push it again: {shlex.join(again)}") from exc
        raise type(exc)(
            f"{exc}\n{folder} was written, and not measured; once that is put right, the same call writes and measures "
            "its next version"
        ) from exc
    return 0


def _push(folder: Path, repository: str, licence: str | None) -> None:
    from curio_train.export.hub import push

    with Console(stderr=True).status(f"pushing {folder}"):
        print(push(folder, repository, licence))


def _views(command: ExportCommand) -> "UnlabelledPhotographs | None":
    """The photographs to adjust by, found and read before a model is made for minutes."""
    if command.photos is None or command.views is None:
        return None
    from curio_train.evaluation.unlabelled.self_consistency import read_views

    return read_views(command.photos, command.views)


def _measure(command: ExportCommand, folder: Path, views: "UnlabelledPhotographs | None") -> None:
    """Measure the latest version of a model on renderings, and write what was found beside it."""
    from curio_serve.models.reliability import RELIABILITY_FILE
    from google.protobuf import json_format

    from curio_train.evaluation.reliability import NUM_IMAGES, fit_reliability, held_out_answers
    from curio_train.evaluation.subject import load_subject, model_reader
    from curio_train.evaluation.unlabelled.self_consistency import adjusted, adjustment, photographed_pairs
    from curio_train.export.folder import ModelFolder
    from curio_train.exported_model import ExportedModel, find_model

    world = load_subject(command.run, command.data).world
    predict = model_reader(ExportedModel.open(find_model(folder)), world)
    pairs = None if views is None else photographed_pairs(world, predict, views)
    answers = held_out_answers(world, predict, "validation", NUM_IMAGES, command.cache.expanduser())
    on_renderings, target = fit_reliability(answers), ModelFolder(folder)
    found = on_renderings if views is None else adjusted(on_renderings, answers, pairs or (), len(views.paths))
    text = json_format.MessageToJson(found, preserving_proto_field_name=True) + "\n"
    path = target.put_beside(target.versions()[-1], RELIABILITY_FILE, text)
    for one, of, before in zip(found.objects, answers, on_renderings.objects, strict=True):
        print(
            f"{path}: {one.object} is sure from a confidence of {one.min_confidence:.2g}, as in "
            f"{(of.confidences >= before.min_confidence).mean():.0%} of {len(of.confidences)} renderings that show it"
        )
    if views is not None:
        print(adjustment(found))


def _write(command: ExportCommand) -> Path:
    """Write the next version of the model, and print what it is."""
    from curio_train.evaluation.int8 import int8
    from curio_train.export.write_model import export

    reduce = int8(command.cache.expanduser(), half=command.half) if command.int8 else None
    with Console(stderr=True).status("tracing, and comparing torch with onnxruntime"):
        done = export(command.run, command.out, command.name, half=command.half, fast=command.fast, reduce=reduce)
    print(
        f"{done.path}: {done.num_bytes / 1e6:.1f} MB, differs from torch by at most {done.parity_error:.2g}"
        + (f", from the float32 weights by {done.rounding_error:.2g}" if command.half else "")
    )
    if command.int8:
        print(f"{done.weights}; outputs differ by at most {done.rounding_error:.2g} on the check images")
    return done.path
