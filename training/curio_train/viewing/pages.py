"""What ``curio-view`` can open, as pages: a result file, photographs read by a model, a run folder, or a world."""

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from curio_train.drawing.album import MeshFiles, scene_context, scenes_of
from curio_train.drawing.mesh_check import check_meshes
from curio_train.drawing.photograph import photograph_of
from curio_train.drawing.pictures import SceneContext
from curio_train.drawing.scenes import Scene, mesh_world, scene_of_code
from curio_train.errors import CurioError, DataError, UsageError
from curio_train.evaluation.subject import load_subject
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.configuration import CONFIG_FILE
from curio_train.scene_code import index
from curio_train.worlds import WORLDS
from curio_train.worlds.base import World
from curio_train.worlds.generated.mesh_world import MeshWorld
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object.viewpoints import AMBIENT
from curio_train.worlds.single_object.world import SingleObjectWorld
from curio_train.worlds.tabletop.world import TabletopWorld

NUM_DRAWN = 8
"""Scenes that a world or a run shows."""

_SEED = 7


@dataclass(frozen=True, eq=False)
class Page:
    """One image with the scene code that was read in it."""

    scene: Scene
    """The scene code."""
    context: SceneContext
    """Meshes and whatever else a code does not say."""
    image: np.ndarray
    """[height, width, 3] uint8 sRGB: a photograph, or the rendering that a run was validated with."""
    over_image: bool
    """Whether objects are drawn over the image (photographs), or over the world's own background."""

    @property
    def light(self) -> np.ndarray:
        """The light that the scene is drawn under [3], camera frame; the usual one where neither knows it."""
        return self.context.light_of(self.scene)


@dataclass(frozen=True)
class Opening:
    """The call of ``curio-view``; see :func:`open_pages`."""

    path: str
    """A result file, a photograph or a folder of them, a run folder, or the name of a generated world."""
    meshes: MeshFiles = field(default_factory=MeshFiles)
    """Meshes of the objects in a result file."""
    model: str | None = None
    """Model folder or server address that reads photographs."""
    camera: Path | None = None
    """Camera file of the photographs."""
    cache: Path = Path()
    """Where image sets that a world draws once are kept."""


def open_pages(opening: Opening) -> list[Page]:
    """The pages of what a path or a name means.

    A JSON Lines file of ``curio-detect`` has a page for each image; a photograph, or a folder of them, is read by
    ``--model`` first; a run folder shows validation images of its newest checkpoint; the name of a generated world
    draws scenes of it.

    Raises:
        UsageError: The path is none of these, or a flag is missing.
        DataError: A file cannot be read, or holds no scene.
        MeshError: A mesh cannot be read.
        CheckpointError: The run folder is damaged or has no checkpoint.
    """
    path = Path(opening.path)
    if not path.exists() and opening.path in WORLDS:
        return list(_of_world(opening.path))
    if not path.exists():
        raise UsageError(f"{path}: there is no such file or folder, and no world of that name; expected {_EXPECTED}")
    if (path / CONFIG_FILE).exists():
        return list(_of_run(path, opening.cache))
    if path.suffix in (".json", ".jsonl", ".glb"):
        return _of_results(path, opening)
    return _of_photographs(path, opening)


def newer_pages(opening: Opening) -> Callable[[], list[Page] | None]:
    """A function that opens a run folder again once it has a newer checkpoint; else, and for all else, None."""
    path = Path(opening.path)
    if not (path / CONFIG_FILE).exists():
        return lambda: None
    run = RunFolder.open(path)
    seen = run.checkpoints()[-1:]

    def reload() -> list[Page] | None:
        nonlocal seen
        latest = run.checkpoints()[-1:]
        if latest == seen:
            return None
        seen = latest
        return open_pages(opening)

    return reload


_EXPECTED = (
    "a result file of curio-detect, a .glb of curio-render, a photograph, a run folder, or one of the worlds "
    + ", ".join(WORLDS)
)


def _of_world(name: str) -> Iterator[Page]:
    world = mesh_world(name)
    codes = world.sample(NUM_DRAWN, (_SEED,))
    images = world.render(codes).clamp(0, 1)
    for number in range(NUM_DRAWN):
        scene = scene_of_code(world, index(codes, slice(number, number + 1)), number)
        yield Page(scene, SceneContext.of_world(world), _uint8(images[number]), over_image=False)


def _of_run(path: Path, cache: Path) -> Iterator[Page]:
    """Validation images, and what the network of the newest checkpoint reads in them."""
    subject = load_subject(path)
    world = subject.world
    context = _context(path, world)
    source = world.source("validation", 0, with_code=False, cache=cache)
    images = source.batch(0, NUM_DRAWN).images
    codes = subject.predict((images * 255).round().byte())
    for number in range(NUM_DRAWN):
        scene = scene_of_code(world, index(codes, slice(number, number + 1)), number)
        yield Page(scene, context, _uint8(images[number]), over_image=scene.world is None)


def _context(path: Path, world: World) -> SceneContext:
    if isinstance(world, TabletopWorld):
        return SceneContext({part.kind.name: part.mesh_of_file for part in world.parts}, world.setup.ambient)
    if isinstance(world, MeshWorld):
        return SceneContext.of_world(world)
    if isinstance(world, SingleObjectWorld):
        return SceneContext({"": world.object.mesh_of_file}, AMBIENT)
    if isinstance(world, SeveralObjectsWorld):
        return SceneContext({one.kind.name: one.mesh_of_file for one in world.members}, AMBIENT)
    raise UsageError(f"{path}: world {world.name} is flat; curio-view shows scenes in three dimensions")


def _of_results(path: Path, opening: Opening) -> list[Page]:
    pages = []
    given = scene_context(opening.meshes)
    for scene in scenes_of(path):
        context = SceneContext.of_world(mesh_world(scene.world)) if scene.world else given
        if context is None:
            raise UsageError(f"{path}: detections do not hold the shape of the objects; add --mesh FILE or NAME=FILE")
        check_meshes(scene, context)
        has_photograph = scene.photograph is not None
        image = photograph_of(scene) if has_photograph else np.zeros((scene.height, scene.width, 3), np.uint8)
        pages.append(Page(scene, context, image, over_image=has_photograph))
    if not pages:
        raise DataError(f"{path}: every line reports an error; there is nothing to show")
    return pages


def _of_photographs(path: Path, opening: Opening) -> list[Page]:
    """Read photographs with ``curio-detect``, in a process of its own, and open its result file."""
    if opening.model is None:
        runs = sorted(str(file.parent) for file in path.glob(f"*/{CONFIG_FILE}"))
        if runs:
            raise UsageError(f"{path}: holds runs; give one of them, such as {runs[0]}")
        raise UsageError(f"{path}: photographs are read by a model: add --model MODEL (and --camera FILE)")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "found.jsonl"
        camera: Sequence[str] = () if opening.camera is None else ("--camera", str(opening.camera))
        script = "from curio_serve.batch.detect_cli import main; main()"
        command = [sys.executable, "-c", script, opening.model, str(path), *camera, "--out", str(out)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode or not out.exists():
            raise DataError(f"curio-detect {opening.model} {path} failed: {done.stderr.strip() or done.returncode}")
        errors = [row["error"] for row in map(json.loads, out.read_text().splitlines()) if "error" in row]
        try:
            return _of_results(out, opening)
        except CurioError:
            if errors:
                raise DataError(f"{path}: {errors[0]}") from None
            raise


def _uint8(image: torch.Tensor) -> np.ndarray:
    pixels: np.ndarray = (image.detach().permute(1, 2, 0) * 255).round().byte().numpy()
    return np.ascontiguousarray(pixels)
