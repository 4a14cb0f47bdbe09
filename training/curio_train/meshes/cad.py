"""CAD files (STEP, IGES) as triangles, by OpenCASCADE (package cascadio, extra ``cad``).

A file is tessellated twice: coarsely for its diameter, then so finely that no triangle is farther from the surface
than a thousandth of that diameter, nor turned by more than 0.35 rad against its neighbour on a curved surface. That is
done in a process of its own, so that what crashes or stalls OpenCASCADE ends that process alone:

    python -m curio_train.meshes.cad step|iges [BODY] < part.step > part.glb
"""

import importlib.util
import io
import json
import os
import re
import struct
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh

from curio_train.errors import MeshError, UsageError
from curio_train.meshes.extent import diameter
from curio_train.meshes.gltf import srgb_from_linear

Kind = Literal["step", "iges"]
CAD_SUFFIXES = (".step", ".stp", ".iges", ".igs")
TOLERANCE = 1e-3  # of the diameter
_ANGLE_RAD = 0.35
_COARSE_MM, _FINEST_MM = 1e6, 1e-6  # with the first, the angle alone limits the triangles
_TIMEOUT_S = 600
_FLAT = 1e-6  # of the diameter
_NUM_NAMED = 12
_PLAIN_SRGB = 0.7  # of bodies without a colour beside others that have one
_MM_OF_M = {"step": 1000.0, "iges": 1.0}  # cascadio 0.1 leaves IGES in millimetres and calls them metres
_DECORATION = re.compile(r"\x1b\[[0-9;]*m|\*{2,}")  # colours and frames of OpenCASCADE's messages


@dataclass(frozen=True, eq=False)
class _Body:
    """The triangles of one body with one colour; a body of several colours is several of these."""

    number: int
    """Number of the body; an assembly has another one for each place that a part is in."""
    name: str
    """Name of the part that it is."""
    vertices_mm: np.ndarray
    """[num_vertices, 3], the body's own frame."""
    faces: np.ndarray
    """[num_faces, 3]."""
    placements: Sequence[np.ndarray]
    """file_from_body, [4, 4] with the translation in millimetres; one for each time that the file has the body."""
    color_srgb: np.ndarray | None
    """[3] in [0, 1]."""


def read_cad(path: Path, content: bytes, body: str | None = None) -> tuple[trimesh.Trimesh, tuple[str, ...]]:
    """The bodies of a CAD file as one mesh in metres, whatever the file's own unit is.

    Args:
        path: The file.
        content: Of the file.
        body: Name of the one to take, in its own frame. None: all, as the file places them.

    Returns:
        The mesh, with vertex colours where any body has a colour, and the names of its bodies.

    Raises:
        UsageError: The extra ``cad`` is not installed.
        MeshError: The file is cut off or damaged, or holds no surface, a flat sheet, or no body of that name.
    """
    if importlib.util.find_spec("cascadio") is None:
        raise UsageError(f"{path}: CAD files need the extra cad: pip install 'curio-pose[cad]'")
    kind: Kind = "iges" if path.suffix.lower() in (".iges", ".igs") else "step"
    _refuse_cut_off(path, kind, content)
    bodies = _chosen(path, _tessellated(path, kind, content, body), body)
    vertices = np.concatenate(_placed(bodies)) / 1000
    _refuse_sheet(path, vertices)
    return _joined(bodies, vertices), _names(bodies)


def named(bodies: Sequence[str]) -> str:
    """Names for a person to read, each once: ``plate, bolt (2)``."""
    counts = Counter(bodies)
    names = [name if count == 1 else f"{name} ({count})" for name, count in counts.items()]
    return ", ".join(names[:_NUM_NAMED]) + (f" and {len(names) - _NUM_NAMED} more" if len(names) > _NUM_NAMED else "")


def _refuse_cut_off(path: Path, kind: Kind, content: bytes) -> None:
    """Refuse a file without its end, which OpenCASCADE reads as far as it goes, or calls a fault of syntax."""
    if kind == "step":
        is_whole, end = b"END-ISO-10303-21" in content[-4096:], "END-ISO-10303-21;"
    else:
        lines = content[-4096:].split(b"\n")
        is_whole, end = any(line[72:73] == b"T" for line in lines), "a terminate section (T in column 73)"
    if not is_whole:
        raise MeshError(f"{path}: not a complete {kind.upper()} file: it does not end with {end}; copy it again")


def _tessellated(path: Path, kind: Kind, content: bytes, body: str | None) -> list[_Body]:
    command = [sys.executable, "-m", "curio_train.meshes.cad", kind, *([] if body is None else [body])]
    try:
        done = subprocess.run(command, input=content, capture_output=True, timeout=_TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired as exc:
        raise MeshError(f"{path}: OpenCASCADE did not mesh it within {_TIMEOUT_S} s; export a simpler part") from exc
    lines = [" ".join(line.split()) for line in _DECORATION.sub("", done.stderr.decode(errors="replace")).splitlines()]
    last = next((line for line in reversed(lines) if line), "without a word")
    if done.returncode:
        raise MeshError(f"{path}: OpenCASCADE ended with status {done.returncode} on it ({last}); export it again")
    bodies = _from_glb(done.stdout, kind) if done.stdout else []
    if not bodies:
        what = "curves and no surface, as a drawing has" if done.stdout else f"no body (OpenCASCADE: {last})"
        raise MeshError(f"{path}: found {what}; export the part itself, as a solid, to STEP AP214 or AP242")
    return bodies


def main() -> None:
    """Tessellate the CAD file on standard input as GLB to standard output; nothing where it holds no shape."""
    kind: Kind = "iges" if sys.argv[1] == "iges" else "step"
    wanted = sys.argv[2:]
    out = os.dup(1)
    os.dup2(2, 1)  # OpenCASCADE prints
    content = sys.stdin.buffer.read()
    glb = _glb(content, kind, _COARSE_MM)
    bodies = _from_glb(glb, kind) if glb else []
    if wanted:
        bodies = _named(bodies, wanted[0]) or bodies  # whoever reads the output says that there is none
    if bodies:
        glb = _glb(content, kind, max(TOLERANCE * diameter(np.concatenate(_placed(bodies))), _FINEST_MM))
    with open(out, "wb") as file:
        file.write(glb)


def _glb(content: bytes, kind: Kind, tolerance_mm: float) -> bytes:
    import cascadio

    # In one thread the order of the triangles is the same each time.
    return cascadio.load(content, file_type=kind, tol_linear=tolerance_mm, tol_angular=_ANGLE_RAD, use_parallel=False)


def _from_glb(content: bytes, kind: Kind) -> list[_Body]:
    """The bodies with triangles; curves beside them are left out."""
    mm_of_m = _MM_OF_M[kind]
    (length,) = struct.unpack_from("<I", content, 12)
    meshes = json.loads(content[20 : 20 + length])["meshes"]
    names = [(i, mesh.get("name", f"body {i}")) for i, mesh in enumerate(meshes) for _ in mesh["primitives"]]
    scene = trimesh.load_scene(io.BytesIO(content), file_type="glb", process=False)
    placements: dict[str, list[np.ndarray]] = {}
    for node in scene.graph.nodes_geometry:
        pose, geometry = scene.graph[node]
        placement = np.array(pose)
        placement[:3, 3] *= mm_of_m
        placements.setdefault(str(geometry), []).append(placement)
    return [
        _Body(*name, np.asarray(part.vertices) * mm_of_m, np.asarray(part.faces), placements[key], _color_srgb(part))
        for name, (key, part) in zip(names, scene.geometry.items(), strict=True)
        if isinstance(part, trimesh.Trimesh) and len(part.faces) and key in placements
    ]


def _color_srgb(part: trimesh.Trimesh) -> np.ndarray | None:
    """Base colours of glTF are linear light."""
    factor = getattr(getattr(part.visual, "material", None), "baseColorFactor", None)
    if factor is None:
        return None
    return srgb_from_linear(np.asarray(factor)[:3] / 255)


def _chosen(path: Path, bodies: list[_Body], name: str | None) -> list[_Body]:
    if name is None:
        return bodies
    chosen = _named(bodies, name)
    if len(sizes := _sizes_mm([one for one in bodies if one.name == name])) > 1:
        raise MeshError(
            f"{path}: bodies of {' and '.join(sizes)} mm are called {name!r}; give each a name of its own in the CAD "
            "application, and export it again"
        )
    if not chosen:
        raise MeshError(f"{path}: found no body {name!r}, expected one of: {named(_names(bodies))}")
    return chosen


def _sizes_mm(bodies: Sequence[_Body]) -> list[str]:
    """The different sizes of bodies in their own frames."""
    by_number: dict[int, list[np.ndarray]] = {}
    for one in bodies:
        by_number.setdefault(one.number, []).append(one.vertices_mm)
    extents = [np.ptp(np.concatenate(parts), axis=0) for parts in by_number.values()]
    return sorted({" x ".join(f"{length:.4g}" for length in extent) for extent in extents})


def _named(bodies: list[_Body], name: str) -> list[_Body]:
    """The first body of that name, in its own frame."""
    own = [one for one in bodies if one.name == name]
    return [replace(one, placements=[np.eye(4)]) for one in own if one.number == own[0].number]


def _names(bodies: Sequence[_Body]) -> tuple[str, ...]:
    """The name of each body, once for each place that it has."""
    parts = {one.number: one for one in bodies}.values()
    return tuple(one.name for one in parts for _ in one.placements)


def _placed(bodies: Sequence[_Body]) -> list[np.ndarray]:
    """Vertices of every place of every body, in the file's frame, millimetres."""
    return [trimesh.transform_points(one.vertices_mm, pose) for one in bodies for pose in one.placements]


def _refuse_sheet(path: Path, vertices_m: np.ndarray) -> None:
    centred = vertices_m - vertices_m.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    extents = np.ptp(centred @ axes, axis=0)
    if extents.min() < _FLAT * extents.max():
        raise MeshError(
            f"{path}: all of its surface lies in one plane: a sheet without thickness; expected a solid. Give it its "
            "thickness in the CAD program (thicken, extrude) and export it again"
        )


def _joined(bodies: Sequence[_Body], vertices_m: np.ndarray) -> trimesh.Trimesh:
    """One mesh; vertices in the same place and of the same colour become one."""
    places = [one for one in bodies for _ in one.placements]
    starts = np.cumsum([0, *(len(one.vertices_mm) for one in places)])
    faces = np.concatenate([one.faces + start for one, start in zip(places, starts[:-1], strict=True)])
    colors = None
    if any(one.color_srgb is not None for one in places):
        plain = np.full(3, _PLAIN_SRGB)
        each = [plain if one.color_srgb is None else one.color_srgb for one in places]
        sizes = [len(one.vertices_mm) for one in places]
        colors = np.repeat(np.round(np.array(each) * 255).astype(np.uint8), sizes, axis=0)
    # Vertices of other bodies stay apart, where two touch as well.
    numbers = np.repeat(np.arange(len(places)), [len(one.vertices_mm) for one in places])
    key = np.column_stack([np.round(vertices_m / max(np.ptp(vertices_m, axis=0).max(), 1e-12) * 1e7), numbers])
    _, kept, merged = np.unique(key, axis=0, return_index=True, return_inverse=True)
    faces = merged.ravel()[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    return trimesh.Trimesh(
        vertices_m[kept], faces, vertex_colors=None if colors is None else colors[kept], process=False
    )


if __name__ == "__main__":
    main()
