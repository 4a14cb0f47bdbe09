"""What ``curio-detect`` asks this package for with a mesh; its errors are serving's, as serving's command tells them.

The command itself is serving's, which installs without this package's dependencies.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from curio_proto.v1.model_spec_pb2 import ModelSpec
from curio_serve import errors as serving
from curio_serve.imaging.silhouette import Surface

from curio_train.errors import CheckpointError, CurioError, MeshError, UsageError

if TYPE_CHECKING:
    from curio_train.meshes.meshes import Unit
    from curio_train.refinement.detections import DetectionRefiner, NamedMesh

_LEVELS = 3  # RUN/models/NAME/VERSION


class _File(NamedTuple):
    """A mesh file that may be an object's."""

    path: Path
    unit: "Unit | None"
    body: str | None
    label: str


def refiner(spec: ModelSpec, model: str, meshes: Sequence[Path], unit: "Unit | None") -> "DetectionRefiner":
    """Render-and-compare for a model's detections.

    Args:
        spec: Of the model.
        model: As it was named.
        meshes: Files of its objects, or folders of them; none: those of the run in whose folder the model lies. The one
            file for one object may be another than the one the model was trained with, if it is of the same size.
        unit: Of the meshes' coordinates; None: the files' own, or metres.

    Raises:
        curio_serve.errors.UsageError: The model does not find objects in space, or there is no mesh of one of them.
        curio_serve.errors.ModelError: The renderer cannot be used here.
    """
    if not spec.objects or not spec.camera.camera_matrix:
        raise serving.UsageError(
            f"--refine is for models of objects in space; {spec.name or model} is of the flat world {spec.world!r}"
        )
    from curio_train.refinement.detections import DetectionRefiner

    try:
        return DetectionRefiner(spec, _meshes(spec, model, _files(model, meshes, unit)))
    except (MeshError, UsageError) as exc:
        raise serving.UsageError(f"--refine: {exc}") from exc
    except CurioError as exc:
        raise serving.ModelError(f"--refine: {exc}") from exc


def surfaces(spec: ModelSpec, model: str, meshes: Sequence[Path], unit: "Unit | None") -> Mapping[str, Surface]:
    """The meshes of a model's objects, for contours in drawings.

    Args:
        spec: Of the model.
        model: As it was named.
        meshes: As of :func:`refiner`.
        unit: Of the meshes' coordinates; None: the files' own, or metres.

    Returns:
        Triangles of each object by its name; none where no mesh is named and the model lies in no run's folder, or the
        run's meshes are gone.

    Raises:
        curio_serve.errors.UsageError: A named mesh cannot be read or is none of the model's objects, or these are flat.
    """
    if not spec.objects or not spec.camera.camera_matrix:
        if meshes:
            raise serving.UsageError(
                f"--mesh is for models of objects in space; {spec.name or model} is of the flat world {spec.world!r}"
            )
        return {}
    from curio_train.meshes.of_model import refuse_other_mesh

    try:
        found = _meshes(spec, model, _files(model, meshes, unit))
        for kind in spec.objects:
            refuse_other_mesh(found[kind.name].mesh, kind, found[kind.name].label)
    except (MeshError, UsageError) as exc:
        if not meshes:
            return {}
        raise serving.UsageError(f"--overlays: {exc}") from exc
    return {name: Surface(one.mesh.vertices_m, one.mesh.faces) for name, one in found.items()}


def _meshes(spec: ModelSpec, model: str, files: Sequence[_File]) -> "Mapping[str, NamedMesh]":
    """A mesh for each object: the only one for the only object, else the one with the SHA-256 that the model names."""
    from curio_train.meshes.meshes import load_mesh
    from curio_train.refinement.detections import NamedMesh

    loaded = [NamedMesh(file.label, load_mesh(file.path, file.unit, file.body)) for file in files]
    if len(spec.objects) == 1 and len(loaded) == 1:
        return {spec.objects[0].name: loaded[0]}
    by_sha256 = {one.mesh.sha256: one for one in loaded}
    missing = [kind.name for kind in spec.objects if kind.mesh_sha256 not in by_sha256]
    if missing:
        found = f"{len(loaded)} mesh files, but none" if loaded else "no mesh"
        raise UsageError(
            f"found {found} of {', '.join(missing)} for {model}; give the files that it was trained with, --mesh FILE "
            "once for each object or --mesh FOLDER for all"
        )
    return {kind.name: by_sha256[kind.mesh_sha256] for kind in spec.objects}


def _files(model: str, meshes: Sequence[Path], unit: "Unit | None") -> list[_File]:
    if not meshes:
        return list(_of_run(Path(model)))
    return [
        _File(path, unit, None, f"--mesh {path}")
        for given in meshes
        for path in (_in_folder(given) if given.is_dir() else [given])
    ]


def _in_folder(folder: Path) -> list[Path]:
    from curio_train.meshes.meshes import SUFFIXES

    return sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)


def _of_run(model: Path) -> Iterator[_File]:
    """The mesh files that a run was trained with, where a model lies in its folder."""
    from curio_train.learning.runs.checkpoint import RunFolder
    from curio_train.learning.runs.configuration import CONFIG_FILE
    from curio_train.worlds.options import CaptureOptions

    for folder in list(model.absolute().parents)[: _LEVELS + 1]:
        if (folder / CONFIG_FILE).is_file():
            try:
                world = RunFolder.open(folder).config.world
            except CheckpointError:  # another program's file, or a run of another version
                return
            if isinstance(world, CaptureOptions):
                yield from (_File(path, world.mesh_unit, world.body, str(path)) for path in world.mesh)
            return
