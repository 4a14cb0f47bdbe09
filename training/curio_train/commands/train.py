"""The command ``curio-train``. Heavy packages are imported only once its arguments are understood."""

import argparse
import dataclasses
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NoReturn, get_type_hints

import tyro
from curio_serve.command_line import HELP_ALL, join_help_lines, parsed, with_lists_joined
from curio_serve.version import answer_version
from tyro.conf import OmitArgPrefixes

from curio_train.capture.options import AssistantCommand, CalibrateCommand
from curio_train.commands.command_line.project_file import with_project
from curio_train.commands.command_line.running import CACHE, answer, report, warn
from curio_train.commands.command_line.short_help import print_short_help
from curio_train.config import NetworkConfig, Preset, Recipe, RunConfig, WorldOptions, preset_recipe
from curio_train.errors import UsageError, nearest
from curio_train.learning.runs.configuration import CONFIG_FILE, load_config, refuse_other, world_name
from curio_train.learning.runs.interruption import Interruption
from curio_train.worlds import WORLDS
from curio_train.worlds.options import LOCATOR_RECIPE, CaptureOptions, LinemodOptions

if TYPE_CHECKING:
    from curio_train.camera import Intrinsics
    from curio_train.capture.structure import Structure
    from curio_train.export.ahead import TracingAhead


@dataclass(frozen=True)
class Session:
    """Where and how this process trains. Sessions of one run may differ in it."""

    out: Path | None = None
    """Folder of the new run; runs/WORLD-METHOD-SEED unless given."""
    project: Path | None = None
    """TOML file of flags by their names; those typed beside it win."""
    resume: Path | None = None
    """Folder of a run to go on with, with its own configuration; budgets may be given anew."""
    cache: Path = CACHE
    """Where image sets that a world draws once are kept."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """auto takes CUDA where there is one."""
    checkpoint_minutes: float = 1.0
    """Minutes of training between checkpoints; 0: after every step."""

    def __post_init__(self) -> None:
        """Refuse what is no time, and two folders for one run."""
        if self.out is not None and self.resume is not None and self.out.absolute() != self.resume.absolute():
            raise UsageError(f"--out {self.out}: --resume {self.resume} goes on in its own folder; leave out --out")
        if not self.checkpoint_minutes >= 0:
            raise UsageError(f"--checkpoint-minutes is {self.checkpoint_minutes}, expected 0 or more")


@dataclass(frozen=True)
class TrainCommand:
    """Learn a world's poses from its images."""

    config: OmitArgPrefixes[RunConfig]
    session: OmitArgPrefixes[Session] = Session()


def train(arguments: Sequence[str] | None = None) -> None:
    """``curio-train WORLD …``: exit status 0 done, 1 failed, 2 wrong call, 128 + signal when interrupted."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    answer_version("curio-train", given)
    if given[:1] == ["capture"] and "--calibrate" in given:
        calibration = parsed(CalibrateCommand, given[1:], "curio-train capture")
        sys.exit(answer(lambda _: _calibrate(calibration)))
    if given[:1] == ["capture"] and "--assistant" in given:
        assistance = parsed(AssistantCommand, given[1:], "curio-train capture")
        sys.exit(answer(lambda interruption: _assist(assistance, interruption)))
    sys.exit(answer(lambda interruption: _train(parse(given), interruption)))


def _calibrate(command: CalibrateCommand) -> int:
    from curio_train.commands.calibrate import run

    def by_objects(
        models: Path, data: Path | None, camera: "Intrinsics"
    ) -> "Callable[[Structure], tuple[Structure, str]]":
        from curio_train.evaluation.unlabelled.scene_scale import scale_by_objects

        return scale_by_objects(models, data, camera, report)

    print(run(command, by_objects))
    return 0


def _assist(command: AssistantCommand, interruption: Interruption) -> int:
    from curio_train.commands.assist import run

    return run(command, interruption, report)


def parse(arguments: list[str]) -> TrainCommand:
    """A call as typed; what it leaves out comes from the preset, or from the run it resumes.

    Raises:
        SystemExit: Help was printed, or the call is wrong.
        CurioError: It names a world, a file or a run that cannot be used.
    """
    world, *typed = arguments or [""]
    if world not in WORLDS:
        return _refuse_world(arguments)
    kind = WORLDS[world]
    arguments = with_lists_joined(arguments, ("--mesh", "--counts"))
    typed = [_dashed(word) for word in with_project(arguments, _path_flags())[1:]]
    default, stored = _defaults(world, typed)
    prog, about = f"curio-train {world}", (kind.__doc__ or "").partition("\n\n")[0]
    join_help_lines([RunConfig, Recipe, NetworkConfig, *WORLDS.values()])
    if stored is None and {"-h", "--help"} & set(typed) and HELP_ALL not in typed:
        print_short_help(prog, about, default.world, default, Session())
    command = parsed(TrainCommand, typed, prog, default=TrainCommand(default), description=about)
    if stored is not None and command.session.resume is not None:
        refuse_other(stored, command.config, command.session.resume)
    return command


def _dashed(word: str) -> str:
    """A flag as its help writes it, where it was typed with underscores, which count as dashes."""
    flag, equals, value = word.partition("=")
    return flag.replace("_", "-") + equals + value if flag.startswith("--") else word


def _defaults(world: str, typed: list[str]) -> tuple[RunConfig, RunConfig | None]:
    """The configuration that flags change, and that of the run to resume, if there is one."""
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", nargs="?", default="laptop")
    first.add_argument("--resume", nargs="?", type=Path)
    first.add_argument("--photos", nargs="?")
    first.add_argument("--method", nargs="?")
    first.add_argument("--two-stage", action="store_true")
    first.add_argument("--one-stage", "--no-gaze", action="store_true")
    first.add_argument("--mesh", nargs="*", default=[])
    first.add_argument("--plane", nargs="?")
    seen, _ = first.parse_known_args(typed)

    stored = load_config(seen.resume) if seen.resume else None
    if stored is not None and world_name(stored) == world:
        return stored, stored
    kind = WORLDS[world]
    preset: Preset = "paper" if seen.preset == "paper" else "laptop"  # an unknown preset is tyro's to refuse
    recipe = preset_recipe(preset, kind)
    if world == "linemod" and seen.photos is None:  # then --self-training is an error, and its default must be none
        recipe = replace(recipe, self_training=0.0)
    if preset == "laptop" and seen.method in (None, kind.default_method) and _names_locator(world, seen):
        recipe = replace(recipe, **LOCATOR_RECIPE)
    if world == "capture" and (seen.plane is not None or _names_locator(world, seen)):
        recipe = replace(recipe, self_training=0.0)
    return RunConfig(_unset(kind), method=kind.default_method, recipe=recipe), stored


def _names_locator(world: str, seen: argparse.Namespace) -> bool:
    """Whether the flags ask for a detector whose poses are told by templates, and whose locator is trained."""
    if world == "capture":
        return len(seen.mesh) > 1 and seen.plane is None
    return world == "linemod" and not (seen.two_stage or seen.one_stage)


def _refuse_world(arguments: list[str]) -> NoReturn:
    """Print the list of worlds, or refuse what is none of them."""
    if arguments and not arguments[0].startswith("-"):
        raise UsageError(
            f"{arguments[0]} is no world{nearest(arguments[0], WORLDS)}; expected one of {', '.join(WORLDS)}"
        )
    tyro.cli(
        tyro.extras.subcommand_type_from_defaults(
            {name: TrainCommand(RunConfig(_unset(kind))) for name, kind in WORLDS.items()},
            {name: (kind.__doc__ or "").partition("\n\n")[0] for name, kind in WORLDS.items()},
        ),
        args=["--help" if word == HELP_ALL else word for word in arguments],
        prog="curio-train",
        description=f"Learn to read poses from images without labels. Worlds: {', '.join(WORLDS)}.",
    )
    raise UsageError(f"found {' '.join(arguments)} before the world; expected curio-train WORLD and then flags")


def _path_flags() -> set[str]:
    """Names of all flags that are files or folders."""
    hints = [hint for kind in (*WORLDS.values(), RunConfig, Session) for hint in get_type_hints(kind).items()]
    return {name for name, kind in hints if kind in (Path, Path | None, tuple[Path, ...])}


def _unset(kind: type[WorldOptions]) -> WorldOptions:
    """Options of a world with those that the user has to give marked as missing."""
    required = [field.name for field in dataclasses.fields(kind) if field.default is field.default_factory]
    return kind(**dict.fromkeys(required, tyro.MISSING))


def _traced_ahead(config: RunConfig, num_threads: int) -> "AbstractContextManager[TracingAhead | None]":
    """The graph of one's own part, which is exported at once, where a second core can trace it meanwhile."""
    from curio_train.export.ahead import TracingAhead

    return TracingAhead(config) if num_threads > 1 and isinstance(config.world, CaptureOptions) else nullcontext()


def _draws_templates(options: WorldOptions) -> bool:
    """Whether poses are told by templates, which are drawn before a locator is trained."""
    if isinstance(options, LinemodOptions):
        return options.gaze and not options.two_stage
    return isinstance(options, CaptureOptions) and options.names_several


def _how_to_go_on(config: RunConfig, path: Path) -> str:
    return f"go on with: {shlex.join(['curio-train', world_name(config), '--resume', str(path)])}"


@contextmanager
def _saying_how_to_go_on(config: RunConfig, path: Path) -> Iterator[None]:
    """Say it where a signal stops what comes before the first step, if the run folder is written already."""
    try:
        yield
    except KeyboardInterrupt:
        if (path / CONFIG_FILE).exists():
            report(_how_to_go_on(config, path))
        raise


def _train(command: TrainCommand, interruption: Interruption) -> int:
    from curio_serve.files import direct

    from curio_train.commands.finish import end
    from curio_train.commands.prepare import prepared, with_kept_meshes
    from curio_train.learning.hardware import one_thread
    from curio_train.learning.loop import Outcome
    from curio_train.learning.runs.checkpoint import RunFolder
    from curio_train.learning.runs.without_training import draw_templates
    from curio_train.learning.session import learn

    session, config = command.session, command.config
    path = (
        session.resume
        or (session.out and direct(session.out))
        or Path("runs") / f"{world_name(config)}-{config.method}-{config.seed}"
    )
    if not session.resume:
        RunFolder.refuse_used(path)  # before files are examined, which takes its time
        config = with_kept_meshes(prepared(config, session.cache, warn, report), path)
    if config.terms.templates:
        if session.device == "cuda":
            raise UsageError("--device cuda: --method templates runs on the CPU; leave it out")
        with one_thread() as num_threads, _traced_ahead(config, num_threads) as ahead:
            is_old = session.resume is not None
            with _saying_how_to_go_on(config, path):
                seconds = draw_templates(config, path, session.cache, num_threads, resume=is_old).seconds
            print(f"{path}: templates drawn and calibrated in {seconds:.0f} s")
            report(end(path, config, session.cache, warn, report, ahead))
        return 0
    report(
        f"{path}: drawing the objects' templates, which takes a minute or two for each"
        if _draws_templates(config.world) and not (session.resume and RunFolder.open(path).checkpoints())
        else f"{path}: preparing images and renderer, which takes a minute or so where it was not done before"
    )
    with _saying_how_to_go_on(config, path):
        outcome, progress = learn(
            config,
            path,
            interruption,
            resume=session.resume is not None,
            cache=session.cache,
            device=session.device,
            checkpoint_minutes=session.checkpoint_minutes,
        )
    if int(os.environ.get("RANK", "0")) == 0:
        loss = "" if progress.image_loss is None else f", image loss {progress.image_loss:.4g}"
        print(f"{path}: {outcome.value} after {progress.images:,} images in {progress.seconds / 60:.1f} minutes{loss}")
        if outcome is Outcome.INTERRUPTED:
            report(_how_to_go_on(config, path))
        else:
            report(end(path, config, session.cache, warn, report))
    if outcome is Outcome.INTERRUPTED and interruption.signum is not None:
        return 128 + interruption.signum
    return 0
