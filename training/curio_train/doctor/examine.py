"""Examines files before an hour is spent on them, and refuses those that will not work."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from curio_proto.v1.model_spec_pb2 import ModelSpec

from curio_train.camera import Intrinsics
from curio_train.doctor.camera_file import examine_camera
from curio_train.doctor.finding import Finding
from curio_train.doctor.machine import examine_machine
from curio_train.doctor.mesh_file import examine_mesh
from curio_train.doctor.photographs import examine_photographs
from curio_train.doctor.picture_content import examine_background
from curio_train.errors import CurioError, DataError
from curio_train.exported_model import ExportedModel, find_model
from curio_train.meshes.meshes import METRES, Mesh, Unit, load_mesh
from curio_train.meshes.symmetries import find_symmetries
from curio_train.worlds.options import CaptureOptions


@dataclass(frozen=True)
class Subjects:
    """The files to examine, in any combination; files that belong together are compared."""

    mesh: Path | None = None
    """A mesh file."""
    mesh_unit: Unit | None = None
    """Of its coordinates; the file's own unless given."""
    body: str | None = None
    """The one body of a CAD file to look at; all unless given."""
    camera: Path | None = None
    """Camera JSON, or BOP's ``camera.json``."""
    photos: Path | None = None
    """A folder of photographs, taken with that camera."""
    background: Path | None = None
    """The empty scene, taken with that camera."""
    model: Path | None = None
    """A model folder, a version's folder or an .onnx file, trained for that mesh."""


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
        mesh, findings = examine_mesh(subjects.mesh, subjects.mesh_unit, subjects.body)
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


def save_symmetries(mesh: Path, unit: Unit | None, body: str | None, out: Path) -> None:
    """Write a mesh's size and symmetries as an entry of BOP's ``models_info.json`` (millimetres), under the number 1.

    Raises:
        MeshError: It cannot be read.
        DataError: The file cannot be written.
    """
    loaded = load_mesh(mesh, unit, body)
    low, high = loaded.box_corners_m[0] * 1000, loaded.box_corners_m[-1] * 1000
    entry: dict[str, object] = {"diameter": loaded.diameter_m * 1000}
    for axis, start, size in zip("xyz", low, high - low, strict=True):
        entry |= {f"min_{axis}": float(start), f"size_{axis}": float(size)}
    try:
        out.write_text(json.dumps({"1": entry | find_symmetries(loaded).as_bop()}, indent=2) + "\n", encoding="utf-8")
    except OSError as exc:
        raise DataError(f"{out}: cannot be written ({exc.strerror}); name another file: --symmetries") from exc


_HARMLESS_ON_A_PLANE = ("no colour",)  # colours are part of the code
_HARMLESS = (*_HARMLESS_ON_A_PLANE, "too few")  # off the plane nothing is learned from the photographs
_BROKEN = "photographs unreadable"  # all that matters about other scenes: they may differ in size and be few


def refuse_unfit(options: CaptureOptions) -> list[str]:
    """Compare the meshes, the camera, the photographs and the background image; read every other background.

    Returns:
        What is doubtful about them, a line each.

    Raises:
        DataError: Something is certain not to work; says everything that is.
    """
    first, *others = options.mesh
    unit, body = options.mesh_unit, options.body
    subjects = [Subjects(first, unit, body, options.camera, options.photos, options.background)]
    subjects += [Subjects(mesh, unit, body) for mesh in others]
    found = [finding for subject in subjects for finding in examine_files(subject)]
    harmless = _HARMLESS if options.plane is None else _HARMLESS_ON_A_PLANE
    found = [finding for finding in found if finding.state != "good" and finding.fault not in harmless]
    if options.backgrounds is not None:
        _, scenes = examine_photographs(options.backgrounds, None)
        found += [replace(finding, subject="backgrounds") for finding in scenes if finding.fault == _BROKEN]
    unfit = [finding for finding in found if finding.state == "bad" and finding.sure == "certain"]
    if unfit:
        raise DataError("\n".join(f"{finding.subject}: {finding}" for finding in unfit))
    return [f"{finding.subject}: {finding}" for finding in found]


_SAME_SIZE = 0.01
_OTHER_VIEW = 2.0


def examine_model(path: Path, mesh: Mesh | None, camera: Intrinsics | None) -> Iterator[Finding]:
    """Whether the model can be run, and was trained for this mesh and such a camera."""
    try:
        spec = ExportedModel.open(find_model(path)).spec
    except CurioError as exc:
        yield Finding("model", "bad", str(exc), fault="model unreadable")
        return
    names = ", ".join(kind.name for kind in spec.objects)
    yield Finding("model", "good", f"{path}: {spec.name} of the world {spec.world}, finds {names}")
    if mesh is not None:
        yield from _other_mesh(spec, mesh)
    if camera is not None and spec.camera.camera_matrix:
        yield from _other_view(spec, camera)


def _other_mesh(spec: ModelSpec, mesh: Mesh) -> Iterator[Finding]:
    if any(kind.mesh_sha256 == mesh.sha256 for kind in spec.objects):
        return
    ratios = [mesh.diameter_m / kind.diameter_m for kind in spec.objects if kind.diameter_m > 0]
    diameters = ", ".join(f"{kind.diameter_m * 1000:.4g} mm" for kind in spec.objects)
    text = f"the model was trained for another mesh file: SHA-256 {mesh.sha256[:12]}… is none of the model's"
    size = f"its objects have diameters of {diameters}, the mesh {mesh.diameter_m * 1000:.4g} mm"
    if any(abs(ratio - 1) < _SAME_SIZE for ratio in ratios):
        remedy = "The size agrees: it may be another export of the same part. Check its origin and axes, or train again"
        yield Finding("model mesh", "warning", f"{text}; {size}", remedy, fault="other mesh")
        return
    steps = {a / b for a in METRES.values() for b in METRES.values() if a != b}
    unit = any(abs(ratio / step - 1) < _SAME_SIZE for ratio in ratios for step in steps)
    remedy = "Set --mesh-unit: a unit was mistaken" if unit else "Name the model's own mesh, or train for this one"
    yield Finding("model mesh", "bad", f"{text}; {size}", remedy, fault="mesh unit" if unit else "other mesh")


def _other_view(spec: ModelSpec, camera: Intrinsics) -> Iterator[Finding]:
    """Any K can be warped to the model's, but what lies outside the model's view is not seen."""
    own = np.array(spec.camera.camera_matrix).reshape(3, 3)[0, 0] / spec.camera.width
    ratio = camera.matrix[0, 0] / camera.width / own
    if not 1 / _OTHER_VIEW <= ratio <= _OTHER_VIEW:
        wider = "wider" if ratio < 1 else "narrower"
        text = f"the camera's view is much {wider} than the model's own ({ratio:.2g} of its focal length)"
        remedy = "Objects will be seen at other sizes than in training: train with this camera"
        yield Finding("model camera", "warning", text, remedy, "possible", fault="other view")
