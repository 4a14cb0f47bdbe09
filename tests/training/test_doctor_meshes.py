"""Faults planted one by one in a good mesh, and meshes of scanned objects, which have none."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from curio_train.doctor.examine import Subjects, examine_files
from curio_train.doctor.finding import Finding


def alarms(subjects: Subjects) -> list[Finding]:
    return [finding for finding in examine_files(subjects) if finding.state != "good"]


def part() -> trimesh.Trimesh:
    """An asymmetric solid of 100 mm with vertex colours."""
    shape = trimesh.creation.icosphere(subdivisions=3, radius=50)
    x, y, z = shape.vertices.T
    shape.vertices = np.stack([x * (1 + 0.004 * y), y * 0.6 + 0.003 * x * x, z * 0.8 + 0.2 * x], axis=1)
    shape.vertices -= shape.bounds.mean(axis=0)
    shape.visual.vertex_colors = np.tile([200, 150, 40, 255], (len(shape.vertices), 1)).astype(np.uint8)
    return shape


def test_a_good_mesh_raises_no_alarm(tmp_path: Path) -> None:
    part().export(tmp_path / "part.ply")
    assert alarms(Subjects(mesh=tmp_path / "part.ply", mesh_unit="mm")) == []


def in_inches(shape: trimesh.Trimesh) -> None:
    shape.apply_scale(1 / 25.4)


def inside_out(shape: trimesh.Trimesh) -> None:
    shape.invert()


def half_inside_out(shape: trimesh.Trimesh) -> None:
    faces = shape.faces.copy()
    faces[::5] = faces[::5, ::-1]
    shape.faces = faces


def with_a_hole(shape: trimesh.Trimesh) -> None:
    shape.update_faces(shape.triangles_center[:, 2] < 30)


def without_colour(shape: trimesh.Trimesh) -> None:
    shape.visual = trimesh.visual.ColorVisuals()


def with_flat_faces(shape: trimesh.Trimesh) -> None:
    flat = shape.faces[:100].copy()
    flat[:, 2] = flat[:, 1]
    shape.faces = np.concatenate([shape.faces, flat])


def with_walls_inside(shape: trimesh.Trimesh) -> None:
    first = shape.faces[:200]
    walls = np.stack([first[:, 0], first[:, 1], np.full(len(first), shape.faces[-1, 0])], axis=1)
    shape.faces = np.concatenate([shape.faces, walls])


def with_a_stray_part(shape: trimesh.Trimesh) -> None:
    count = len(shape.vertices)
    shape.vertices = np.concatenate([shape.vertices, [[500, 0, 0], [501, 0, 0], [500, 1, 0]]])
    shape.faces = np.concatenate([shape.faces, [[count, count + 1, count + 2]]])


@pytest.mark.parametrize(
    ("spoil", "fault"),
    [
        (in_inches, "mesh unit"),
        (inside_out, "inside out"),
        (half_inside_out, "mixed orientation"),
        (with_a_hole, "holes"),
        (without_colour, "no colour"),
        (with_flat_faces, "degenerate faces"),
        (with_walls_inside, "non-manifold"),
        (with_a_stray_part, "stray parts"),
    ],
)
def test_faults_of_the_mesh(tmp_path: Path, spoil: Callable[[trimesh.Trimesh], None], fault: str) -> None:
    shape = part()
    spoil(shape)
    shape.export(tmp_path / "part.ply")
    assert fault in {finding.fault for finding in alarms(Subjects(mesh=tmp_path / "part.ply", mesh_unit="mm"))}


@pytest.mark.parametrize("unit", ["m", "cm", "inch"])
def test_a_mistaken_unit(tmp_path: Path, unit: str) -> None:
    """Millimetres read as metres or inches are refused or unusual, as centimetres they make a part of a metre."""
    part().apply_scale(4).export(tmp_path / "part.ply")
    (finding,) = alarms(Subjects(mesh=tmp_path / "part.ply", mesh_unit=unit))  # type: ignore[arg-type]
    assert finding.fault in ("mesh unit", "mesh size")
    assert "--mesh-unit" in f"{finding}"


def test_an_unreadable_mesh(tmp_path: Path) -> None:
    (tmp_path / "part.ply").write_bytes(b"ply garbage")
    (finding,) = alarms(Subjects(mesh=tmp_path / "part.ply"))
    assert (finding.fault, finding.state) == ("mesh unreadable", "bad")


@pytest.mark.skipif("CURIO_DATA" not in os.environ, reason="CURIO_DATA names no folder with LM-O")
@pytest.mark.parametrize("number", [1, 5, 6, 8, 9, 10, 11, 12])
def test_no_alarm_on_meshes_of_lmo(number: int) -> None:
    path = Path(os.environ["CURIO_DATA"]) / "lmo" / "models" / f"obj_{number:06}.ply"
    assert alarms(Subjects(mesh=path, mesh_unit="mm")) == []


def test_a_distant_origin_is_no_fault(tmp_path: Path) -> None:
    """Of a part without symmetries, and of a plate whose origin is the middle of an edge, as in many CAD files."""
    shape = part()
    shape.apply_translation([300, 0, 0])
    shape.export(tmp_path / "part.ply")
    assert alarms(Subjects(mesh=tmp_path / "part.ply", mesh_unit="mm")) == []
    plate = trimesh.creation.box((100, 60, 20))
    plate.apply_translation([50, 0, 0])
    plate.export(tmp_path / "plate.stl")
    (finding,) = alarms(Subjects(mesh=tmp_path / "plate.stl", mesh_unit="mm"))
    assert finding.fault == "no colour"
