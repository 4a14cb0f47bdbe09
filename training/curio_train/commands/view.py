"""The command ``curio-view``. Heavy packages are imported only once its arguments are understood."""

import ipaddress
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal

from curio_serve.command_line import parsed
from tyro.conf import Positional, arg

from curio_train.commands.command_line.running import CACHE, answer, report
from curio_train.errors import UsageError


@dataclass(frozen=True)
class ViewCommand:
    """Open scene codes in the browser: see them beside their photographs, edit them, fit them, and save them."""

    what: Annotated[Positional[str], arg(metavar="WHAT")]
    """Result file of curio-detect, photograph or folder of photographs (with --model), run folder, or the name of a
    generated world such as chairs."""
    model: str | None = None
    """Model folder, or HOST:PORT/MODEL of a server, that reads the photographs."""
    camera: Path | None = None
    """Camera file of the photographs."""
    mesh: tuple[str, ...] = ()
    """Mesh file of the objects, or NAME=FILE for each kind of them."""
    mesh_unit: Literal["m", "cm", "mm", "inch"] | None = None
    """Unit of their coordinates; the file's own, or metres, unless given."""
    body: str | None = None
    """Name of the one body of a STEP or IGES file to take, in its own frame; all of them, as placed, unless given."""
    out: Path = Path("edited.jsonl")
    """File that the button "save the code" appends to."""
    host: str = "127.0.0.1"
    """Address to listen on; whoever reaches it can see and edit the scenes."""
    port: int = 8080
    """Port to listen on."""
    cache: Path = CACHE
    """Where image sets that a world draws once are kept."""


def view(arguments: Sequence[str] | None = None) -> None:
    """``curio-view WHAT …``; exit status as of :func:`~curio_train.commands.train.train`."""
    command = parsed(ViewCommand, arguments, "curio-view", lists=("--mesh",))
    sys.exit(answer(lambda _: _view(command)))


def _view(command: ViewCommand) -> int:
    if find_spec("viser") is None:
        raise UsageError("curio-view needs the extra view: pip install 'curio-pose[train,view]'")
    from curio_train.drawing.album import MeshFiles
    from curio_train.viewing.pages import Opening, newer_pages, open_pages
    from curio_train.viewing.viewer import Viewer

    meshes = MeshFiles(command.mesh, command.mesh_unit, command.body)
    opening = Opening(command.what, meshes, command.model, command.camera, command.cache.expanduser())
    viewer = Viewer(open_pages(opening), command.out, command.host, command.port, newer_pages(opening))
    try:
        report(f"curio-view: http://{command.host}:{command.port}, {_reach(command.host)}; Ctrl-C ends it")
        threading.Event().wait()
    finally:
        viewer.close()
    return 0


def _reach(host: str) -> str:
    try:
        local = ipaddress.ip_address(host).is_loopback
    except ValueError:
        local = host == "localhost"
    return "for this machine alone" if local else "for everyone who can reach this address"
