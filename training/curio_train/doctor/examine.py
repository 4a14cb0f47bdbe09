"""Examines files before an hour is spent on them, and refuses those that will not work."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from curio_serve.files import write_whole

from curio_train.camera import Intrinsics
from curio_train.doctor.camera_file import examine_camera
from curio_train.doctor.finding import Finding
from curio_train.doctor.machine import examine_machine, examine_resources
from curio_train.doctor.mesh_file import examine_mesh
from curio_train.doctor.photographs import TOO_FEW, examine_photographs
from curio_train.doctor.picture_content import examine_background
from curio_train.errors import DataError
from curio_train.meshes.meshes import Mesh, Unit, load_mesh
from curio_train.meshes.symmetries import find_symmetries
from curio_train.worlds.options import CaptureOptions


@dataclass(frozen=True)
class Subjects:
    """The files to examine, in any combination; files that belong together are compared."""

    mesh: Path | None = None
    """A mesh file."""
    mesh_unit: Unit | None = None
    """Unit of its coordinates; the file's own unless given."""
    body: str | None = None
    """The one body of a CAD file to look at; all unless given."""
    camera: Path | None = None
    """A camera file of one camera."""
    photos: Path | None = None
    """A folder of photographs, taken with that camera."""
    background: Path | None = None
    """The empty scene, taken with that camera."""
    model: Path | None = None
    """A model folder, a version's folder or an .onnx file, trained for that mesh."""


def examine(subjects: Subjects, cache: Path) -> Iterator[Finding]:
    """The files that were named; without any, the machine.

    Args:
        subjects: What to look at. Beside files, only what is wrong with the machine and can be told at once is found.
        cache: Where image sets will be kept.
    """
    if subjects == Subjects():
        yield from examine_machine(cache)
        return
    yield from (finding for finding in examine_resources(cache) if finding.state != "good")
    yield from examine_files(subjects)


def examine_files(subjects: Subjects, empty: Sequence[Path] = ()) -> Iterator[Finding]:
    """The files alone, each beside what it has to agree with.

    Args:
        subjects: What to look at.
        empty: Further images of the empty scene, which are no photographs even where they lie among them.
    """
    mesh: Mesh | None = None
    camera: Intrinsics | None = None
    if subjects.mesh is not None:
        mesh, findings = examine_mesh(subjects.mesh, subjects.mesh_unit, subjects.body)
        yield from findings
    if subjects.camera is not None:
        camera, findings = examine_camera(subjects.camera)
        yield from findings
    if subjects.photos is not None:
        photographs, findings = examine_photographs(
            subjects.photos, camera, [*filter(None, (subjects.background, *empty))]
        )
        yield from findings
    else:
        photographs = []
    if subjects.background is not None:
        yield from examine_background(subjects.background, photographs, camera)
    if subjects.model is not None:
        from curio_train.doctor.model_file import examine_model

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
        write_whole(out, json.dumps({"1": entry | find_symmetries(loaded).as_bop()}, indent=2) + "\n")
    except OSError as exc:
        raise DataError(f"{out}: cannot be written ({exc.strerror}); name another file: --symmetries") from exc


_HARMLESS = "no colour"  # colours are part of the code, or estimated
_BROKEN = "photographs unreadable"  # all that matters about other scenes: they may differ in size and be few


def refuse_unfit(options: CaptureOptions, *, self_training: bool = True) -> list[str]:
    """Compare the meshes, the camera, the photographs and the background image; read all other images.

    Args:
        options: Names the files.
        self_training: Whether the network is to learn from the photographs off the plane, too.

    Returns:
        What is doubtful about them, a line each.

    Raises:
        DataError: Something is certain not to work; says everything that is.
    """
    first, *others = options.mesh
    unit, body = options.mesh_unit, options.body
    empty = _further_empty(options)
    subjects = [Subjects(first, unit, body, options.camera, options.photos, options.background)]
    subjects += [Subjects(mesh, unit, body) for mesh in others]
    found = [finding for subject in subjects for finding in examine_files(subject, empty)]
    found = [finding for finding in found if finding.state != "good" and finding.fault != _HARMLESS]
    if not self_training or options.plane is not None:  # the count matters where a part's model learns from them
        found = [finding for finding in found if finding.fault != TOO_FEW]
    further = {"backgrounds": options.backgrounds, "held-out": options.held_out, "second": options.second}
    for name, folder in further.items():
        if folder is not None:
            _, scenes = examine_photographs(folder, None, empty)
            found += [replace(finding, subject=name) for finding in scenes if finding.fault == _BROKEN]
    unfit = [finding for finding in found if finding.state == "bad" and finding.sure == "certain"]
    if unfit:
        raise DataError("\n".join(f"{finding.subject}: {finding}" for finding in unfit))
    return [f"{finding.subject}: {finding}" for finding in found]


def _further_empty(options: CaptureOptions) -> Sequence[Path]:
    """Images of the empty scene of parts on a plane, ``--background`` among them; in free space there is that alone.

    Raises:
        CameraError: The file of the plane cannot be used.
    """
    if options.plane is None or options.background is None:
        return ()
    from curio_train.capture.plane import CameraPoseFile
    from curio_train.worlds.tabletop.files import empty_scenes

    return empty_scenes(options, options.background, CameraPoseFile.read(options.plane))
