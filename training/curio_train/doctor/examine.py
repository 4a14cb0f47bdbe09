"""Look at a machine, a mesh, a camera file, photographs and a model before an hour is spent on them."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from curio_train.camera import Intrinsics
from curio_train.doctor.background import examine_background
from curio_train.doctor.camera_file import examine_camera
from curio_train.doctor.finding import Finding
from curio_train.doctor.machine import examine_machine
from curio_train.doctor.mesh_file import examine_mesh
from curio_train.doctor.model import examine_model
from curio_train.doctor.photographs import examine_photographs
from curio_train.errors import DataError
from curio_train.meshes.meshes import Mesh, Unit, load_mesh
from curio_train.meshes.symmetries import find_symmetries


@dataclass(frozen=True)
class Subjects:
    """What is to be looked at, in any combination; what belongs together is compared.

    Attributes:
        mesh: A mesh file.
        mesh_unit: Of its coordinates; the file's own unless given.
        camera: Camera JSON, or BOP's ``camera.json``.
        photos: A folder of photographs, taken with that camera.
        background: The empty scene, taken with that camera.
        model: A model folder, a version's folder or an .onnx file, trained for that mesh.
    """

    mesh: Path | None = None
    mesh_unit: Unit | None = None
    camera: Path | None = None
    photos: Path | None = None
    background: Path | None = None
    model: Path | None = None


def examine(subjects: Subjects, cache: Path) -> Iterator[Finding]:
    """Everything that was asked for, the machine first.

    Args:
        subjects: What to look at.
        cache: Where image sets will be kept.
    """
    yield from examine_machine(cache)
    yield from examine_files(subjects)


def examine_files(subjects: Subjects) -> Iterator[Finding]:
    """The files alone, each beside what it has to agree with."""
    mesh: Mesh | None = None
    camera: Intrinsics | None = None
    if subjects.mesh is not None:
        mesh, findings = examine_mesh(subjects.mesh, subjects.mesh_unit)
        yield from findings
    if subjects.camera is not None:
        camera, findings = examine_camera(subjects.camera)
        yield from findings
    if subjects.photos is not None:
        photographs, findings = examine_photographs(subjects.photos, camera)
        yield from findings
    else:
        photographs = []
    if subjects.background is not None:
        yield from examine_background(subjects.background, photographs)
    if subjects.model is not None:
        yield from examine_model(subjects.model, mesh, camera)


def save_symmetries(mesh: Path, unit: Unit | None, out: Path) -> None:
    """Write a mesh's size and symmetries as an entry of BOP's ``models_info.json`` (millimetres), under the number 1.

    Raises:
        MeshError: It cannot be read.
        DataError: The file cannot be written.
    """
    loaded = load_mesh(mesh, unit)
    low, high = loaded.box_corners_m[0] * 1000, loaded.box_corners_m[-1] * 1000
    entry: dict[str, object] = {"diameter": loaded.diameter_m * 1000}
    for axis, start, size in zip("xyz", low, high - low, strict=True):
        entry |= {f"min_{axis}": float(start), f"size_{axis}": float(size)}
    try:
        out.write_text(json.dumps({"1": entry | find_symmetries(loaded).as_bop()}, indent=2) + "\n", encoding="utf-8")
    except OSError as exc:
        raise DataError(f"{out}: cannot be written ({exc.strerror}); name another file: --symmetries") from exc
