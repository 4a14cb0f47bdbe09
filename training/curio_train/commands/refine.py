"""What ``curio-detect`` asks this package for with a mesh; its errors are serving's, as serving's command tells them.

The command itself is serving's, which installs without this package's dependencies.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from curio_proto.v1.model_spec_pb2 import ModelSpec
from curio_serve import errors as serving
from curio_serve.imaging.silhouette import Surface

from curio_train.errors import CurioError, MeshError, UsageError

if TYPE_CHECKING:
    from curio_train.meshes.meshes import Mesh, Unit
    from curio_train.refinement.detections import DetectionRefiner

_LEVELS = 3  # RUN/models/NAME/VERSION


def refiner(spec: ModelSpec, model: str, mesh: Path | None, unit: "Unit | None") -> "DetectionRefiner":
    """Render-and-compare for a model's detections.

    Args:
        spec: Of the model.
        model: As it was named.
        mesh: Of its object; None: that of the run in whose folder the model lies.
        unit: Of the mesh's coordinates; None: the file's own, or metres.

    Raises:
        curio_serve.errors.UsageError: The model does not find one kind of object in space, or there is no mesh of it.
        curio_serve.errors.ModelError: The renderer cannot be used here.
    """
    if len(spec.objects) != 1 or not spec.camera.camera_matrix:
        raise serving.UsageError(
            f"--refine is for models of one kind of object in space; {spec.name or model} finds "
            f"{len(spec.objects)} kinds in world {spec.world!r}"
        )
    from curio_train.refinement.detections import DetectionRefiner

    try:
        label, found = _mesh(spec, model, mesh, unit)
        return DetectionRefiner(found, spec, label)
    except (MeshError, UsageError) as exc:
        raise serving.UsageError(f"--refine: {exc}") from exc
    except CurioError as exc:
        raise serving.ModelError(f"--refine: {exc}") from exc


def surface(spec: ModelSpec, model: str, mesh: Path | None, unit: "Unit | None") -> Surface | None:
    """The mesh of a model's object, for contours in drawings.

    Args:
        spec: Of the model.
        model: As it was named.
        mesh: Of its object; None: that of the run in whose folder the model lies.
        unit: Of the mesh's coordinates; None: the file's own, or metres.

    Returns:
        Its triangles; None where no mesh is named and the model lies in no run's folder, or the run's mesh is gone.

    Raises:
        curio_serve.errors.UsageError: The named mesh cannot be read, is none of the model's object, or the model has
            several kinds of objects or flat ones.
    """
    if len(spec.objects) != 1 or not spec.camera.camera_matrix:
        if mesh is not None:
            raise serving.UsageError(
                f"--mesh is for models of one kind of object in space; {spec.name or model} finds "
                f"{len(spec.objects)} kinds in world {spec.world!r}"
            )
        return None
    if mesh is None and _of_run(Path(model)) is None:
        return None
    from curio_train.meshes.of_model import refuse_other_mesh

    try:
        label, found = _mesh(spec, model, mesh, unit)
        refuse_other_mesh(found, spec.objects[0], label)
    except (MeshError, UsageError) as exc:
        if mesh is None:
            return None
        raise serving.UsageError(f"--overlays: {exc}") from exc
    return Surface(found.vertices_m, found.faces)


def _mesh(spec: ModelSpec, model: str, mesh: Path | None, unit: "Unit | None") -> tuple[str, "Mesh"]:
    from curio_train.meshes.meshes import load_mesh

    if mesh is not None:
        return f"--mesh {mesh}", load_mesh(mesh, unit)
    beside = _of_run(Path(model))
    if beside is None:
        raise UsageError(
            f"found no mesh with {model}: it lies in no run's folder of a part; give --mesh FILE, the mesh that "
            f"{spec.objects[0].name} was trained with"
        )
    return str(beside[0]), load_mesh(*beside)


def _of_run(model: Path) -> "tuple[Path, Unit | None, str | None] | None":
    """File, unit and body of the mesh that a run was trained with, where a model lies in its folder."""
    from curio_train.learning.runs.checkpoint import RunFolder
    from curio_train.learning.runs.configuration import CONFIG_FILE
    from curio_train.worlds.options import CaptureOptions

    for folder in list(model.absolute().parents)[: _LEVELS + 1]:
        if (folder / CONFIG_FILE).is_file():
            world = RunFolder.open(folder).config.world
            if isinstance(world, CaptureOptions):
                return world.mesh[0], world.mesh_unit, world.body
            return None
    return None
