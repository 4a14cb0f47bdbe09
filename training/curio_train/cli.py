"""The command lines of training. Each imports its heavy packages only once its arguments are understood."""

import argparse
import dataclasses
import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console
from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, arg

from curio_train.config import PRESETS, RunConfig, WorldOptions
from curio_train.errors import CurioError
from curio_train.learning.configuration import load_config, refuse_other, world_name
from curio_train.learning.interruption import Interrupted, Interruption, interruptible
from curio_train.worlds import WORLDS


@dataclass(frozen=True)
class Session:
    """Where and how this process trains; may differ between the sessions of one run.

    Attributes:
        out: Folder of the new run; runs/WORLD-METHOD-SEED unless given.
        resume: Folder of a run to go on with, with its own configuration; budgets may be given anew.
        cache: Where image sets that a world draws once are kept.
        device: auto takes CUDA where there is one.
        checkpoint_minutes: Minutes of training between checkpoints.
    """

    out: Path | None = None
    resume: Path | None = None
    cache: Path = Path("~/.cache/curio-pose")
    device: Literal["auto", "cpu", "cuda"] = "auto"
    checkpoint_minutes: float = 1.0


@dataclass(frozen=True)
class TrainCommand:
    """Learn a world's poses from its images."""

    config: OmitArgPrefixes[RunConfig]
    session: OmitArgPrefixes[Session] = Session()


def train(arguments: Sequence[str] | None = None) -> None:
    """``curio-train WORLD …``: exit status 0 done, 1 failed, 2 wrong call, 128 + signal when interrupted."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    sys.exit(answer(lambda interruption: _train(_parse(given), interruption)))


def answer(work: Callable[[Interruption], int]) -> int:
    """Do a command's work and return its exit status; each deliberate error is one message on stderr."""
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    with interruptible() as interruption:
        try:
            return work(interruption)
        except CurioError as exc:
            console.print("error:", str(exc), style="bold red", markup=False)
            return exc.exit_status
        except Interrupted as exc:
            console.print(f"stopped by {exc}; whatever was saved before is intact", markup=False)
            return exc.exit_status
        except BrokenPipeError:  # the reader of our output (head, less) has seen enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1


def _parse(arguments: list[str]) -> TrainCommand:
    """The call as typed; what it leaves out comes from the preset, or from the run it resumes."""
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", nargs="?", default="laptop")
    first.add_argument("--resume", nargs="?", type=Path)
    seen, _ = first.parse_known_args(arguments)

    recipe = PRESETS.get(seen.preset, PRESETS["laptop"])  # an unknown preset is tyro's to refuse
    defaults = {
        name: RunConfig(_unset(kind), method=kind.default_method, recipe=recipe, network=kind.default_network)
        for name, kind in WORLDS.items()
    }
    stored = load_config(seen.resume) if seen.resume else None
    if stored is not None:
        defaults[world_name(stored)] = stored
    commands = tyro.extras.subcommand_type_from_defaults(
        {name: TrainCommand(config) for name, config in defaults.items()},
        {name: (kind.__doc__ or "").partition("\n\n")[0] for name, kind in WORLDS.items()},
    )
    command: TrainCommand = tyro.cli(
        commands,
        args=arguments,
        prog="curio-train",
        description=f"Learn to read poses from images without labels. Worlds: {', '.join(WORLDS)}.",
    )
    if stored is not None:
        refuse_other(stored, command.config, seen.resume)
    return command


def _unset(kind: type[WorldOptions]) -> WorldOptions:
    """Options of a world with those that the user has to give marked as missing."""
    required = [field.name for field in dataclasses.fields(kind) if field.default is field.default_factory]
    return kind(**dict.fromkeys(required, tyro.MISSING))


def _train(command: TrainCommand, interruption: Interruption) -> int:
    from curio_train.learning.loop import Outcome
    from curio_train.learning.session import learn

    config, session = command.config, command.session
    path = session.resume or session.out or Path("runs") / f"{world_name(config)}-{config.method}-{config.seed}"
    outcome, course = learn(
        config,
        path,
        interruption,
        resume=session.resume is not None,
        cache=session.cache,
        device=session.device,
        checkpoint_minutes=session.checkpoint_minutes,
    )
    if int(os.environ.get("RANK", "0")) == 0:
        loss = "" if course.image_loss is None else f", image loss {course.image_loss:.4g}"
        print(f"{path}: {outcome.value} after {course.images:,} images in {course.seconds / 60:.1f} minutes{loss}")
        if outcome is Outcome.INTERRUPTED:
            print(f"go on with: curio-train {world_name(config)} --resume {path}", file=sys.stderr)
    if outcome is Outcome.INTERRUPTED and interruption.signum is not None:
        return 128 + interruption.signum
    return 0


@dataclass(frozen=True)
class EvaluateCommand:
    """Score a run or a model on held-out images of its world, beside the same network untrained.

    Attributes:
        path: A run folder, a model folder (its latest version), a version's folder, or an .onnx file.
        split: Which images of the world.
        num_images: How many images.
        data: BOP data set whose real frames are scored as well; needed for an exported LineMOD model.
        bop_results: Folder for a results file of the real frames in BOP's format.
        json: Print the result as one JSON object on the last line.
        cache: Where image sets that a world draws once are kept.
    """

    path: Annotated[Positional[Path], arg(metavar="RUN_OR_MODEL")]
    split: Literal["train", "validation", "test"] = "test"
    num_images: int = 500
    data: Path | None = None
    bop_results: Path | None = None
    json: FlagCreatePairsOff[bool] = False
    cache: Path = Session.cache


def evaluate(arguments: Sequence[str] | None = None) -> None:
    """``curio-eval RUN_OR_MODEL …``; exit status as of :func:`train`."""
    command = tyro.cli(EvaluateCommand, args=arguments, prog="curio-eval")
    sys.exit(answer(lambda _: _evaluate(command)))


def _evaluate(command: EvaluateCommand) -> int:
    from curio_train.evaluation.evaluate import evaluate
    from curio_train.evaluation.tables import print_evaluation

    with Console(stderr=True).status("") as status:
        result = evaluate(
            command.path,
            split=command.split,
            num_images=command.num_images,
            data=command.data,
            bop_results=command.bop_results,
            cache=command.cache,
            progress=status.update,
        )
    print_evaluation(result, Console())
    if command.json:
        print(json.dumps(result))
    return 0


@dataclass(frozen=True)
class ExportCommand:
    """Write a run's network as the next version of a model that any ONNX runtime can serve.

    Attributes:
        run: The run folder. Its training images are not needed.
        out: Folder of models; the model goes to OUT/NAME/VERSION/model.onnx.
        name: Of the model; the world's name, or LineMOD's class, unless given.
        half: Store weights as float16: half the size, computed with in float32.
    """

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    out: Path = Path("models")
    name: str | None = None
    half: FlagCreatePairsOff[bool] = False


def export(arguments: Sequence[str] | None = None) -> None:
    """``curio-export RUN …``; exit status as of :func:`train`."""
    command = tyro.cli(ExportCommand, args=arguments, prog="curio-export")
    sys.exit(answer(lambda _: _export(command)))


def _export(command: ExportCommand) -> int:
    from curio_train.export import export

    with Console(stderr=True).status("tracing, and comparing torch with onnxruntime"):
        done = export(command.run, command.out, command.name, half=command.half)
    print(
        f"{done.path}: {done.num_bytes / 1e6:.1f} MB, differs from torch by at most {done.parity_error:.2g}"
        + (f", from the float32 weights by {done.rounding_error:.2g}" if command.half else "")
    )
    return 0


@dataclass(frozen=True)
class DoctorCommand:
    """Check this machine, and a mesh, a camera file and photographs where they are given, before training on them.

    Attributes:
        mesh: Mesh file: PLY, OBJ, STL, glTF or OFF.
        mesh_unit: Unit of its coordinates; the file's own, or metres, unless given.
        camera: Camera JSON, or BOP's camera.json.
        photos: Folder of photographs, taken with that camera where one is given.
        cache: Where image sets that a world draws once will be kept.
    """

    mesh: Path | None = None
    mesh_unit: Literal["m", "cm", "mm", "inch"] | None = None
    camera: Path | None = None
    photos: Path | None = None
    cache: Path = Session.cache


def doctor(arguments: Sequence[str] | None = None) -> None:
    """``curio-doctor …``: exit status 1 where something will not work."""
    command = tyro.cli(DoctorCommand, args=arguments, prog="curio-doctor")
    sys.exit(answer(lambda _: _examine(command)))


def _examine(command: DoctorCommand) -> int:
    from curio_train.doctor import examine

    colours = {"good": "green", "warning": "yellow", "bad": "bold red"}
    console, status = Console(highlight=False, soft_wrap=True), 0
    for finding in examine(command.mesh, command.mesh_unit, command.camera, command.photos, command.cache):
        console.print(f"[{colours[finding.state]}]{finding.state:>7}[/]  [bold]{finding.subject}[/]: ", end="")
        console.print(finding.text, markup=False)
        status = max(status, finding.state == "bad")
    return status
