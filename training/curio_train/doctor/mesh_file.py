"""A mesh file: whether it can be read, its unit and size, where its origin lies, its colours, symmetries, surface."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from curio_train.doctor.finding import Finding
from curio_train.doctor.surface import examine_surface
from curio_train.errors import CurioError
from curio_train.meshes.meshes import METRES, Mesh, Unit, load_mesh
from curio_train.meshes.symmetries import Symmetries, find_symmetries

# What people hold before a camera; outside it a unit was probably mistaken, though such things exist.
_USUAL_M = (0.01, 3.0)
_FARTHEST_CENTRE = 0.5  # of the diameter: then the origin lies outside most shapes
_MOST_FACES = 500_000


def examine_mesh(path: Path, unit: Unit | None) -> tuple[Mesh | None, list[Finding]]:
    """The mesh, where it can be trained on, and everything remarkable about it."""
    try:
        mesh = load_mesh(path, unit)
    except CurioError as exc:
        fault = "mesh size" if "found a diameter" in str(exc) else "mesh unreadable"
        return None, [Finding("mesh", "bad", str(exc), fault=fault)]
    extent = " x ".join(f"{size * 1000:.4g}" for size in np.ptp(mesh.vertices_m, axis=0))
    text = f"{path}: {len(mesh.faces):,} faces, {extent} mm, diameter {mesh.diameter_m * 1000:.4g} mm"
    findings = [Finding("mesh", "good", text), *_size(mesh, unit), *_origin(mesh), *_colours(mesh)]
    surface = list(examine_surface(mesh))
    if any(finding.fault == "stray parts" for finding in surface):
        return mesh, [*findings, *surface]  # its diameter is not the object's, and every tolerance is a share of it
    return mesh, [*findings, *surface, _symmetries(find_symmetries(mesh))]


def _size(mesh: Mesh, unit: Unit | None) -> Iterator[Finding]:
    low, high = _USUAL_M
    if len(mesh.faces) > _MOST_FACES:
        text = f"{len(mesh.faces):,} faces, more than rendering in small images can show"
        yield Finding("mesh size", "warning", text, f"Reduce it to {_MOST_FACES:,} or fewer", fault="mesh size")
    if low <= mesh.diameter_m <= high:
        return
    in_file = mesh.diameter_m / METRES[unit or "m"]
    others = [
        f"--mesh-unit {name} (diameter {in_file * metres * 1000:.4g} mm)"
        for name, metres in METRES.items()
        if name != (unit or "m") and low <= in_file * metres <= high
    ]
    text = f"a diameter of {mesh.diameter_m * 1000:.4g} mm is unusual; the unit may be another"
    remedy = f"If it is not the object's true size, set {' or '.join(others)}" if others else "Check the file's unit"
    yield Finding("mesh unit", "warning", text, remedy, "likely" if others else "possible", fault="mesh unit")


def _origin(mesh: Mesh) -> Iterator[Finding]:
    corners = mesh.box_corners_m
    distance = float(np.linalg.norm((corners[0] + corners[-1]) / 2))
    if distance > _FARTHEST_CENTRE * mesh.diameter_m:
        text = f"its middle lies {distance * 1000:.4g} mm from its origin, {distance / mesh.diameter_m:.1f} diameters"
        remedy = "Move the origin into the object: poses are of the origin, and small turns would move it far"
        yield Finding("mesh origin", "warning", text, remedy, fault="off-centre")


def _colours(mesh: Mesh) -> Iterator[Finding]:
    if mesh.texture is None and mesh.vertex_colors_srgb is None:
        text = "no colours: it will be rendered in one colour"
        yield Finding(
            "mesh colours",
            "warning",
            text,
            "Export it with vertex colours or a texture, if it has any",
            fault="no colour",
        )
        return
    kind = "a texture" if mesh.texture is not None else "vertex colours"
    yield Finding("mesh colours", "good", f"it has {kind}")


def _symmetries(found: Symmetries) -> Finding:
    """Not a fault: equal views cannot be told apart, and are scored as equal."""
    parts = [f"{len(found.discrete)} discrete"] * bool(found.discrete)
    for axis, _ in found.continuous:
        parts.append("any turn about (" + ", ".join(f"{value:.2f}" for value in axis) + ")")
    if not parts:
        return Finding("mesh symmetries", "good", "the shape has none")
    text = f"the shape has symmetries: {' and '.join(parts)}; poses that differ by them look the same without paint"
    return Finding("mesh symmetries", "good", text)
