"""The command ``curio-render``. Heavy packages are imported only once its arguments are understood."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from curio_serve.command_line import parsed
from tyro.conf import FlagCreatePairsOff, Positional, arg

from curio_train.commands.command_line.running import answer


@dataclass(frozen=True)
class RenderCommand:
    """Draw scenes for people: what curio-detect found, or scene codes of generated worlds."""

    scenes: Annotated[Positional[Path], arg(metavar="SCENES")]
    """Lines of curio-detect, or of {"world": NAME, "code": {FIELD: numbers}}; or one such JSON object."""
    out: Path
    """Folder for the files, one a scene."""
    format: Literal["png", "glb", "usd", "rrd"] = "png"
    """png: a picture. glb, usd: objects, light and camera in three dimensions, for Blender and other 3D applications.
    rrd: one Rerun recording of all scenes, with photographs, boxes and confidence over time."""
    mesh: tuple[str, ...] = ()
    """Mesh file of the objects, or NAME=FILE for each kind of them; a code's world brings its own."""
    mesh_unit: Literal["m", "cm", "mm", "inch"] | None = None
    """Unit of their coordinates; the file's own, or metres, unless given."""
    body: str | None = None
    """Name of the one body of a STEP or IGES file to take, in its own frame; all of them, as placed, unless given."""
    world: str | None = None
    """Generated world that detections are of: its meshes, light and ground."""
    height: int | None = None
    """Height of the pictures in pixels; the scene's own unless given."""
    turn_deg: float = 0.0
    """Carries the camera round the objects, degrees; 90 is the novel view that worlds are scored from."""
    over_photograph: FlagCreatePairsOff[bool] = False
    """Draw over the photograph that the objects were found in."""
    path_traced: FlagCreatePairsOff[bool] = False
    """Draw with stock Mitsuba's path tracer, shadows and light between surfaces included."""
    samples: int = 64
    """Rays or paths a pixel."""


def render(arguments: Sequence[str] | None = None) -> None:
    """``curio-render SCENES --out DIR …``; exit status as of :func:`~curio_train.commands.train.train`."""
    command = parsed(RenderCommand, arguments, "curio-render", lists=("--mesh",))
    sys.exit(answer(lambda _: _render(command)))


def _render(command: RenderCommand) -> int:
    from curio_train.drawing.album import MeshFiles, draw
    from curio_train.drawing.pictures import RenderOptions

    options = RenderOptions(
        command.height, command.turn_deg, command.over_photograph, command.path_traced, command.samples
    )
    meshes = MeshFiles(command.mesh, command.mesh_unit, command.body)
    for path in draw(command.scenes, command.out, meshes, command.world, options, command.format):
        print(path)
    return 0
