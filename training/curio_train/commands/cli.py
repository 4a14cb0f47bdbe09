"""The command lines of training. Each imports its heavy packages only once its arguments are understood."""

import argparse
import dataclasses
import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_type_hints

import tyro
from rich.console import Console
from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, arg

from curio_train.capture.options import CalibrateCommand
from curio_train.config import Preset, RunConfig, WorldOptions, preset_recipe
from curio_train.errors import CurioError, UsageError
from curio_train.learning.runs.configuration import load_config, refuse_other, world_name
from curio_train.learning.runs.interruption import Interrupted, Interruption, interruptible
from curio_train.project_file import with_project
from curio_train.worlds import WORLDS

if TYPE_CHECKING:
    from curio_train.capture.structure import Structure


@dataclass(frozen=True)
class Session:
    """Where and how this process trains; may differ between the sessions of one run.

    Attributes:
        out: Folder of the new run; runs/WORLD-METHOD-SEED unless given.
        project: TOML file of flags by their names; those typed beside it win.
        resume: Folder of a run to go on with, with its own configuration; budgets may be given anew.
        cache: Where image sets that a world draws once are kept.
        device: auto takes CUDA where there is one.
        checkpoint_minutes: Minutes of training between checkpoints.
    """

    out: Path | None = None
    project: Path | None = None
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
    if given[:1] == ["capture"] and "--calibrate" in given:
        calibration = tyro.cli(CalibrateCommand, args=given[1:], prog="curio-train capture")
        sys.exit(answer(lambda _: _calibrate(calibration)))
    sys.exit(answer(lambda interruption: _train(_parse(given), interruption)))


def _calibrate(command: CalibrateCommand) -> int:
    from curio_train.commands.calibrate import run

    def by_objects(structure: "Structure", models: Path, data: Path | None) -> "tuple[Structure, str]":
        from curio_train.evaluation.scene_scale import scale_by_objects

        return scale_by_objects(structure, models, data, _tell)

    print(run(command, by_objects))
    return 0


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
    arguments = with_project(arguments, _path_flags())
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", nargs="?", default="laptop")
    first.add_argument("--resume", nargs="?", type=Path)
    seen, _ = first.parse_known_args(arguments)

    preset: Preset = "paper" if seen.preset == "paper" else "laptop"  # an unknown preset is tyro's to refuse
    defaults = {
        name: RunConfig(_unset(kind), method=kind.default_method, recipe=preset_recipe(preset, kind))
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


def _path_flags() -> set[str]:
    """Names of all flags that are files or folders."""
    hints = [hint for kind in (*WORLDS.values(), RunConfig, Session) for hint in get_type_hints(kind).items()]
    return {name for name, kind in hints if kind in (Path, Path | None, tuple[Path, ...])}


def _unset(kind: type[WorldOptions]) -> WorldOptions:
    """Options of a world with those that the user has to give marked as missing."""
    required = [field.name for field in dataclasses.fields(kind) if field.default is field.default_factory]
    return kind(**dict.fromkeys(required, tyro.MISSING))


def _train(command: TrainCommand, interruption: Interruption) -> int:
    from curio_train.commands.finish import end
    from curio_train.commands.prepare import prepared
    from curio_train.learning.loop import Outcome
    from curio_train.learning.runs.session import draw_templates, learn

    session = command.session
    config = command.config if session.resume else prepared(command.config, session.cache, _warn, _tell)
    path = session.resume or session.out or Path("runs") / f"{world_name(config)}-{config.method}-{config.seed}"
    if config.method == "templates":
        seconds = draw_templates(config, path, session.cache).seconds
        print(f"{path}: templates drawn and described in {seconds:.0f} s")
        _tell(end(path, config, session.cache, _warn))
        return 0
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
        else:
            _tell(end(path, config, session.cache, _warn))
    if outcome is Outcome.INTERRUPTED and interruption.signum is not None:
        return 128 + interruption.signum
    return 0


def _warn(text: str) -> None:
    _tell(f"warning: {text}")


def _tell(text: str) -> None:
    print(text, file=sys.stderr)


@dataclass(frozen=True)
class EvaluateCommand:
    """Score a run or a model on held-out images of its world, beside the same network untrained.

    Attributes:
        path: A run folder, a model folder (its latest version), a version's folder, or an .onnx file.
        split: Which images of the world.
        num_images: How many images.
        data: BOP data set whose real frames are scored as well; needed for an exported LineMOD model.
        bop_results: Folder for a results file of the real frames in BOP's format.
        refine: Score the poses once more after rendering and comparing; needs the renderer, as serving never does.
        json: Print the result as one JSON object on the last line.
        cache: Where image sets that a world draws once are kept.
    """

    path: Annotated[Positional[Path], arg(metavar="RUN_OR_MODEL")]
    split: Literal["train", "validation", "test"] = "test"
    num_images: int = 500
    data: Path | None = None
    bop_results: Path | None = None
    refine: FlagCreatePairsOff[bool] = False
    json: FlagCreatePairsOff[bool] = False
    cache: Path = Session.cache


def evaluate(arguments: Sequence[str] | None = None) -> None:
    """``curio-eval RUN_OR_MODEL …``; exit status as of :func:`train`."""
    command = tyro.cli(EvaluateCommand, args=arguments, prog="curio-eval")
    sys.exit(answer(lambda _: _evaluate(command)))


def _evaluate(command: EvaluateCommand) -> int:
    from curio_train.evaluation.evaluate import evaluate
    from curio_train.evaluation.tables import print_evaluation

    names = ("split", "num_images", "data", "bop_results", "refine", "cache")
    given = {name: getattr(command, name) for name in names}
    with Console(stderr=True).status("") as status:
        result = evaluate(command.path, **given, progress=status.update, warn=_warn)
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
    from curio_train.export.graph import export

    with Console(stderr=True).status("tracing, and comparing torch with onnxruntime"):
        done = export(command.run, command.out, command.name, half=command.half)
    print(
        f"{done.path}: {done.num_bytes / 1e6:.1f} MB, differs from torch by at most {done.parity_error:.2g}"
        + (f", from the float32 weights by {done.rounding_error:.2g}" if command.half else "")
    )
    return 0


@dataclass(frozen=True)
class DoctorCommand:
    """Check this machine, and a mesh, a camera file, photographs and a model where they are given, before using them.

    Attributes:
        mesh: Mesh file: PLY, OBJ, STL, glTF or OFF.
        mesh_unit: Unit of its coordinates; the file's own, or metres, unless given.
        camera: Camera JSON, or BOP's camera.json.
        photos: Folder of photographs, taken with that camera where one is given.
        background: Photograph of the empty scene, taken as the others were.
        model: Model folder, version folder or .onnx file, made for that mesh and camera where they are given.
        symmetries: File for the symmetries of the mesh's shape, as an entry of BOP's models_info.json.
        cache: Where image sets that a world draws once will be kept.
    """

    mesh: Path | None = None
    mesh_unit: Literal["m", "cm", "mm", "inch"] | None = None
    camera: Path | None = None
    photos: Path | None = None
    background: Path | None = None
    model: Path | None = None
    symmetries: Path | None = None
    cache: Path = Session.cache


def doctor(arguments: Sequence[str] | None = None) -> None:
    """``curio-doctor …``: exit status 1 where something will not work."""
    command = tyro.cli(DoctorCommand, args=arguments, prog="curio-doctor")
    sys.exit(answer(lambda _: _examine(command)))


def _examine(command: DoctorCommand) -> int:
    from curio_train.doctor.examine import Subjects, examine, save_symmetries

    if command.symmetries is not None and command.mesh is None:
        raise UsageError(f"--symmetries {command.symmetries}: found no --mesh to find them from")
    colours = {"good": "green", "warning": "yellow", "bad": "bold red"}
    console, status = Console(highlight=False, soft_wrap=True), 0
    names = [field.name for field in dataclasses.fields(Subjects)]
    for finding in examine(Subjects(**{name: getattr(command, name) for name in names}), command.cache):
        console.print(f"[{colours[finding.state]}]{finding.state:>7}[/]  [bold]{finding.subject}[/]: ", end="")
        console.print(str(finding), markup=False)
        status = max(status, finding.state == "bad")
    if command.symmetries is not None and command.mesh is not None:
        save_symmetries(command.mesh, command.mesh_unit, command.symmetries)
    return status


@dataclass(frozen=True)
class RenderCommand:
    """Draw scenes for people: what curio-detect found, or scene codes of generated worlds.

    Attributes:
        scenes: Lines of curio-detect, or of {"world": NAME, "code": {FIELD: numbers}}; or one such JSON object.
        out: Folder for the pictures, one PNG a scene.
        mesh: Mesh file of the objects, or NAME=FILE for each kind of them; a code's world brings its own.
        mesh_unit: Unit of their coordinates; the file's own, or metres, unless given.
        world: Generated world that detections are of: its meshes, light and ground.
        height: Of the pictures in pixels; the scene's own unless given.
        turn_deg: Carries the camera round the objects, degrees; 90 is the novel view that worlds are scored from.
        over_photograph: Draw over the photograph that the objects were found in.
        path_traced: Draw with stock Mitsuba's path tracer, shadows and light between surfaces included.
        samples: Rays or paths a pixel.
    """

    scenes: Annotated[Positional[Path], arg(metavar="SCENES")]
    out: Path
    mesh: tuple[str, ...] = ()
    mesh_unit: Literal["m", "cm", "mm", "inch"] | None = None
    world: str | None = None
    height: int | None = None
    turn_deg: float = 0.0
    over_photograph: FlagCreatePairsOff[bool] = False
    path_traced: FlagCreatePairsOff[bool] = False
    samples: int = 64


def render(arguments: Sequence[str] | None = None) -> None:
    """``curio-render SCENES --out DIR …``; exit status as of :func:`train`."""
    command = tyro.cli(RenderCommand, args=arguments, prog="curio-render")
    sys.exit(answer(lambda _: _render(command)))


def _render(command: RenderCommand) -> int:
    from curio_train.drawing.album import draw
    from curio_train.drawing.pictures import RenderOptions

    wish = RenderOptions(
        command.height, command.turn_deg, command.over_photograph, command.path_traced, command.samples
    )
    for path in draw(command.scenes, command.out, command.mesh, command.mesh_unit, command.world, wish):
        print(path)
    return 0
