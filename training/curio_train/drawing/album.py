"""A file of scenes to a folder of pictures."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from curio_train.drawing.pictures import RenderOptions, SceneContext, picture
from curio_train.drawing.scenes import mesh_world, read_scenes
from curio_train.errors import DataError, UsageError
from curio_train.meshes.meshes import Unit, load_mesh


def draw(
    scenes: Path, out: Path, meshes: Sequence[str], mesh_unit: Unit | None, world: str | None, wish: RenderOptions
) -> Iterator[Path]:
    """Draw every scene of a file and yield the pictures' paths as they are written.

    Args:
        scenes: See :func:`~curio_train.drawing.scenes.read_scenes`.
        out: Folder; made where it is missing.
        meshes: FILE or NAME=FILE, as on the command line.
        mesh_unit: Of their coordinates; the file's own unless given.
        world: Generated world that brings meshes, light and ground; a code names its own.
        wish: How to draw.

    Raises:
        UsageError: Both meshes and a world, or neither where one is needed.
        DataError: The file of scenes, a photograph or the folder.
        MeshError: A mesh.
        RendererError: No usable libLLVM.
    """
    if meshes and world:
        raise UsageError("--mesh and --world exclude each other: a world brings its own meshes")
    given = _surroundings(meshes, mesh_unit, world)
    for scene in read_scenes(scenes):
        around = SceneContext.of_world(mesh_world(scene.world)) if scene.world else given
        if around is None:
            raise UsageError(f"{scenes}: detections don't say what the objects look like; add --mesh FILE or --world")
        path = out / f"{scene.name}.png"
        _write(path, picture(scene, around, wish))
        yield path


def _surroundings(meshes: Sequence[str], mesh_unit: Unit | None, world: str | None) -> SceneContext | None:
    if world:
        return SceneContext.of_world(mesh_world(world))
    files = {name if divided else "": Path(file if divided else name) for name, divided, file in map(_parts, meshes)}
    if len(files) < len(meshes):
        raise UsageError(f"--mesh {' '.join(meshes)}: expected one FILE, or NAME=FILE with different names")
    return SceneContext({name: load_mesh(file, mesh_unit) for name, file in files.items()}) if files else None


def _parts(text: str) -> tuple[str, str, str]:
    """NAME, "=", FILE; a text that is a file as it stands is no pair."""
    return (text, "", "") if Path(text).exists() else text.partition("=")


def _write(path: Path, image: np.ndarray) -> None:
    done, content = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.tobytes() if done else b"")
    except OSError as exc:
        raise DataError(f"{path}: the picture cannot be written ({exc.strerror}); choose another --out") from exc
