"""The command ``curio-doctor``. Heavy packages are imported only once its arguments are understood."""

import dataclasses
import itertools
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from curio_serve.command_line import parsed
from rich.console import Console

from curio_train.commands.command_line.running import CACHE, answer
from curio_train.errors import UsageError


@dataclass(frozen=True)
class DoctorCommand:
    """Check the mesh, camera file, photographs and model that are named; without any, this machine."""

    mesh: tuple[Path, ...] = ()
    """Mesh file: PLY, OBJ, STL, glTF, OFF, STEP or IGES; of several parts all of them."""
    mesh_unit: Literal["m", "cm", "mm", "inch"] | None = None
    """Unit of the coordinates; the file's own, or metres, unless given."""
    body: str | None = None
    """Name of the one body of a STEP or IGES file to take, in its own frame; all of them, as placed, unless given."""
    camera: Path | None = None
    """Camera file: camera JSON, BOP's camera.json, or YAML of OpenCV or ROS."""
    photos: Path | None = None
    """Folder of photographs, taken with that camera where one is given."""
    background: Path | None = None
    """Photograph of the empty scene, taken as the others were."""
    model: Path | None = None
    """Model folder, version folder or .onnx file, made for that mesh and camera where they are given."""
    symmetries: Path | None = None
    """New file for the symmetries of the mesh's shape, as an entry of BOP's models_info.json."""
    cache: Path = CACHE
    """Where image sets that a world draws once will be kept."""


def doctor(arguments: Sequence[str] | None = None) -> None:
    """``curio-doctor …``: exit status 1 where something will not work."""
    command = parsed(DoctorCommand, arguments, "curio-doctor", lists=("--mesh",))
    sys.exit(answer(lambda _: _examine(command)))


def _examine(command: DoctorCommand) -> int:
    from curio_train.doctor.examine import Subjects, examine, examine_files, save_symmetries

    for flag in ("symmetries", "mesh_unit", "body"):
        if getattr(command, flag) is not None and not command.mesh:
            name = f"--{flag.replace('_', '-')}"
            raise UsageError(f"{name} {getattr(command, flag)}: found no --mesh that it is about; add that")
    if command.symmetries is not None and os.path.lexists(command.symmetries):
        raise UsageError(
            f"--symmetries {command.symmetries}: there is such a file already, and other objects may be in it; name "
            "a new one"
        )
    colours = {"good": "green", "warning": "yellow", "bad": "bold red"}
    console, status = Console(highlight=False, soft_wrap=True), 0
    if command.symmetries is not None and len(command.mesh) > 1:
        raise UsageError(f"--symmetries {command.symmetries} is for one --mesh, found {len(command.mesh)}")
    names = [field.name for field in dataclasses.fields(Subjects) if field.name != "mesh"]
    first = Subjects(next(iter(command.mesh), None), **{name: getattr(command, name) for name in names})
    others = (dataclasses.replace(first, mesh=mesh, photos=None, background=None) for mesh in command.mesh[1:])
    of_others = itertools.chain.from_iterable(map(examine_files, others))
    of_meshes = (finding for finding in of_others if finding.subject.startswith(("mesh", "model mesh")))
    for finding in itertools.chain(examine(first, command.cache), of_meshes):
        console.print(f"[{colours[finding.state]}]{finding.state:>7}[/]  [bold]{finding.subject}[/]: ", end="")
        console.print(str(finding), markup=False)
        status = max(status, finding.state == "bad")
    if command.symmetries is not None:
        save_symmetries(command.mesh[0], command.mesh_unit, command.body, command.symmetries)
    return status
