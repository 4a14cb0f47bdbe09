"""A file of scenes to a folder of pictures, or of files for 3D applications."""

import dataclasses
import importlib.util
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from curio_train.drawing.glb import from_glb, to_glb
from curio_train.drawing.mesh_check import check_meshes
from curio_train.drawing.pictures import RenderOptions, SceneContext, picture
from curio_train.drawing.scenes import Scene, mesh_world, read_scenes
from curio_train.errors import DataError, UsageError
from curio_train.meshes.meshes import Unit, load_mesh

Format = Literal["png", "glb", "usd", "rrd"]
_PACKAGES = {"usd": "pxr", "rrd": "rerun"}
_EXTRAS = {"usd": "usd", "rrd": "rerun"}


@dataclass(frozen=True)
class MeshFiles:
    """The meshes of objects, as on the command line."""

    files: tuple[str, ...] = ()
    """FILE or NAME=FILE."""
    unit: Unit | None = None
    """Unit of their coordinates; the files' own unless given."""
    body: str | None = None
    """The one body of a CAD file to take; all unless given."""


def draw(
    scenes: Path,
    out: Path,
    meshes: MeshFiles,
    world: str | None,
    options: RenderOptions,
    form: Format = "png",
) -> Iterator[Path]:
    """Draw every scene of a file and yield the paths as they are written, one a scene, or one recording of all.

    Args:
        scenes: See :func:`~curio_train.drawing.scenes.read_scenes`.
        out: Folder; made where it is missing.
        meshes: Of the objects.
        world: Generated world that brings meshes, light and ground; a code names its own.
        options: How to draw pictures.
        form: ``png``: pictures. ``glb`` and ``usd``: objects, light and camera in three dimensions. ``rrd``: one Rerun
            recording, with photographs, cameras, boxes and confidence over time.

    Raises:
        UsageError: Options of pictures for another format; both meshes and a world, or neither where one is needed; one
            mesh without a name for several kinds of objects; or the format's extra is not installed.
        DataError: The file of scenes, a photograph or the folder; or a mesh is not of the object that was detected.
        MeshError: A mesh.
        RendererError: No usable libLLVM.
    """
    if meshes.files and world:
        raise UsageError("--mesh and --world exclude each other: a world brings its own meshes")
    if form != "png" and (given_flags := _of_pictures(options)):
        raise UsageError(f"{', '.join(given_flags)}: for pictures; --format {form} writes none, leave it out")
    if form in _PACKAGES and importlib.util.find_spec(_PACKAGES[form]) is None:
        raise UsageError(f"--format {form} needs the extra {_EXTRAS[form]}: pip install 'curio-pose[{_EXTRAS[form]}]'")
    given = SceneContext.of_world(mesh_world(world)) if world else scene_context(meshes)
    drawn = _with_context(scenes, given)
    if form == "rrd":
        yield _recorded(out / f"{scenes.stem}.rrd", drawn)
        return
    for scene, around in drawn:
        path = out / f"{scene.name}.{form}"
        _write(path, _content(scene, around, options, form))
        yield path


def _of_pictures(options: RenderOptions) -> list[str]:
    """The flags that are not as they are unless given."""
    usual = RenderOptions()
    fields = (field.name for field in dataclasses.fields(options))
    return [f"--{name.replace('_', '-')}" for name in fields if getattr(options, name) != getattr(usual, name)]


def _with_context(scenes: Path, given: SceneContext | None) -> Iterator[tuple[Scene, SceneContext]]:
    for scene in scenes_of(scenes):
        around = SceneContext.of_world(mesh_world(scene.world)) if scene.world else given
        if around is None:
            raise UsageError(f"{scenes}: detections don't say what the objects look like; add --mesh FILE or --world")
        check_meshes(scene, around)
        yield scene, around


def _content(scene: Scene, around: SceneContext, options: RenderOptions, form: Format) -> bytes:
    if form == "png":
        return _png(picture(scene, around, options))
    if form == "glb":
        return to_glb(scene, around)
    from curio_train.drawing.usd import to_usd  # of an extra

    return to_usd(scene, around)


def _recorded(path: Path, scenes: Iterable[tuple[Scene, SceneContext]]) -> Path:
    from curio_train.drawing.recording import write_recording  # of an extra

    _make_folder(path.parent)
    write_recording(path, scenes)
    return path


def scenes_of(file: Path) -> Iterator[Scene]:
    """The scenes of a GLB file that curio wrote, or of JSON Lines; see :func:`read_scenes`.

    Raises:
        DataError: The file cannot be read, or holds no scene.
    """
    return iter([from_glb(file)]) if file.suffix.lower() == ".glb" else read_scenes(file)


def scene_context(meshes: MeshFiles) -> SceneContext | None:
    """The meshes of objects; None if none is given.

    Raises:
        UsageError: Two of them have the same name, or there is one body for several.
        MeshError: A mesh cannot be read.
    """
    parts = map(_parts, meshes.files)
    files = {name if divided else "": Path(file if divided else name) for name, divided, file in parts}
    if len(files) < len(meshes.files):
        raise UsageError(f"--mesh {' '.join(meshes.files)}: expected one FILE, or NAME=FILE with different names")
    if meshes.body is not None and len(files) != 1:
        raise UsageError(f"--body {meshes.body}: expected one --mesh with it, found {len(files)}")
    loaded = {name: load_mesh(file, meshes.unit, meshes.body) for name, file in files.items()}
    return SceneContext(loaded) if loaded else None


def _parts(text: str) -> tuple[str, str, str]:
    """NAME, "=", FILE; a text that is a file as it stands is no pair."""
    return (text, "", "") if Path(text).exists() else text.partition("=")


def _png(image: np.ndarray) -> bytes:
    _, content = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))
    return content.tobytes()


def _write(path: Path, content: bytes) -> None:
    _make_folder(path.parent)
    try:
        path.write_bytes(content)
    except OSError as exc:
        raise DataError(f"{path}: the file cannot be written ({exc.strerror}); choose another --out") from exc


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as exc:
        raise DataError(f"{folder}: the folder cannot be made ({exc.strerror}); choose another --out") from exc
