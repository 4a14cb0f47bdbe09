"""Mesh files as the renderer wants them: in metres, checked, with their colours.

Units are settled here, once: nothing behind :func:`load_mesh` knows millimetres.
"""

import dataclasses
import hashlib
import io
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh
from curio_serve.files import read_file

from curio_train.errors import MeshError, UsageError
from curio_train.meshes.appearance import appearance, joined
from curio_train.meshes.beside import Beside
from curio_train.meshes.cad import CAD_SUFFIXES, read_cad
from curio_train.meshes.color_range import refuse_bytes_as_fractions
from curio_train.meshes.extent import box_corners, diameter
from curio_train.meshes.gltf import GLTF_SUFFIXES, read_gltf, refuse_unread
from curio_train.meshes.stable_poses import hull_points

Unit = Literal["m", "cm", "mm", "inch"]
METRES: Mapping[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
SMALLEST_M, LARGEST_M = 0.001, 20.0
MAX_BYTES = 1 << 28  # of a mesh, a material or a texture; in memory a mesh takes eight times that
SUFFIXES = (".ply", ".obj", ".stl", *GLTF_SUFFIXES, ".off", *CAD_SUFFIXES)

# What trimesh's readers let through on damaged files, found by feeding them such.
logging.getLogger("trimesh").addHandler(logging.NullHandler())  # what it logs is told as errors here
_READER_ERRORS = (
    *(ValueError, LookupError, TypeError, AttributeError, ImportError, RuntimeError, OSError),
    *(MemoryError, ArithmeticError),
)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with colours, in the object frame (the file's), metres."""

    vertices_m: np.ndarray
    """[num_vertices, 3] float64, all of them used by a face."""
    faces: np.ndarray
    """[num_faces, 3] int64."""
    vertex_colors_srgb: np.ndarray | None = None
    """[num_vertices, 3] in [0, 1], or None: no colour is known, or ``texture`` has it."""
    uv: np.ndarray | None = None
    """[num_vertices, 2] with v upwards from the texture's lower edge, or None. A vertex on a seam occurs once a side,
    so vertices of equal position are common in textured meshes."""
    texture: np.ndarray | None = None
    """[height, width, 3] uint8 sRGB, or None."""
    sha256: str = field(default="")
    """SHA-256 of the file's bytes; for a generated shape of the arrays' bytes, for a CAD file of :func:`to_ply`'s."""
    bodies: tuple[str, ...] = ()
    """Names of the bodies of a CAD file that it was merged from."""

    def __post_init__(self) -> None:
        """Name generated shapes after their content."""
        if not self.sha256:
            content = self.vertices_m.astype("<f8").tobytes() + self.faces.astype("<i8").tobytes()
            object.__setattr__(self, "sha256", hashlib.sha256(content).hexdigest())

    @cached_property
    def diameter_m(self) -> float:
        """Largest distance of two vertices."""
        return diameter(self.vertices_m)

    @cached_property
    def box_corners_m(self) -> np.ndarray:
        """Corners [8, 3] of the axis-aligned box, in the order of :func:`~curio_train.meshes.extent.box_corners`."""
        return box_corners(self.vertices_m)

    @cached_property
    def hull_m(self) -> np.ndarray:
        """Points of its convex hull, see :func:`~curio_train.meshes.stable_poses.hull_points`."""
        return hull_points(self.vertices_m)

    def thinned_m(self, num: int) -> np.ndarray:
        """About ``num`` of the vertices, or all if there are fewer: every n-th, [k, 3]."""
        return self.vertices_m[:: max(1, len(self.vertices_m) // num)]

    def moved(self, by_m: np.ndarray) -> "Mesh":
        """This mesh with every vertex moved [3]; it is named after its file as before."""
        return dataclasses.replace(self, vertices_m=self.vertices_m + by_m)


def load_mesh(path: Path, unit: Unit | None = None, body: str | None = None) -> Mesh:
    """Read a PLY, OBJ, STL, glTF, OFF, STEP or IGES file; parts of a scene and bodies of an assembly become one mesh.

    Faces without area are kept: they are part of the file and the renderer passes over them. A colour or factor that
    a material has beside its texture is not applied. Colours of glTF are linear light, and are encoded to sRGB.

    Args:
        path: The file.
        unit: Of its coordinates (``--mesh-unit``). Default: the file's own where it names one (glTF is always in
            metres), else metres. BOP's PLY files are in "mm" and don't say so. CAD files always name theirs.
        body: Name of the one body of a CAD file to take (``--body``), in its own frame. Default: all of them.

    Raises:
        UsageError: A unit for a CAD file, a body of a file of another kind, or the extra ``cad`` is not installed.
        MeshError: Missing, empty, no mesh, without faces, broken coordinates or indices, or of impossible size.
    """
    content = _read(path)
    if path.suffix.lower() in CAD_SUFFIXES:
        return _from_cad(path, content, unit, body)
    if body is not None:
        raise UsageError(f"--body {body}: {path} is no CAD file; expected one of {' '.join(CAD_SUFFIXES)}")
    loaded = _parse(path, content)
    if path.suffix.lower() == ".stl":
        loaded.merge_vertices()  # STL repeats the corners of every triangle
    _check(path, loaded)
    loaded.remove_unreferenced_vertices()  # stray points would count towards the diameter
    colors, uv, texture = appearance(loaded)
    read_unit = unit or _unit_of(path, loaded)
    mesh = Mesh(
        vertices_m=np.asarray(loaded.vertices, dtype=np.float64) * METRES[read_unit],
        faces=np.asarray(loaded.faces, dtype=np.int64),
        vertex_colors_srgb=colors,
        uv=uv,
        texture=texture,
        sha256=hashlib.sha256(content).hexdigest(),
    )
    _check_size(path, mesh, read_unit, given=unit is not None)
    return mesh


def to_ply(mesh: Mesh) -> bytes:
    """A PLY file that :func:`load_mesh` reads back to the last bit: vertices in metres, their colours, and faces.

    A texture is left out.
    """
    coordinates = [(axis, "<f8") for axis in "xyz"]
    channels = [] if mesh.vertex_colors_srgb is None else [(name, "u1") for name in ("red", "green", "blue")]
    vertices = np.zeros(len(mesh.vertices_m), coordinates + channels)
    for (name, _), values in zip(coordinates, mesh.vertices_m.T, strict=True):
        vertices[name] = values
    if mesh.vertex_colors_srgb is not None:
        for (name, _), values in zip(channels, mesh.vertex_colors_srgb.T, strict=True):
            vertices[name] = np.round(values * 255)
    faces = np.zeros(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    header = [
        *("ply", "format binary_little_endian 1.0", "comment coordinates in metres", f"element vertex {len(vertices)}"),
        *(f"property double {name}" for name, _ in coordinates),
        *(f"property uchar {name}" for name, _ in channels),
        *(f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"),
    ]
    return ("\n".join(header) + "\n").encode() + vertices.tobytes() + faces.tobytes()


def _from_cad(path: Path, content: bytes, unit: Unit | None, body: str | None) -> Mesh:
    if unit is not None:
        raise UsageError(
            f"--mesh-unit {unit}: {path} is a CAD file, which names its own unit; leave it out, and write "
            "other meshes beside it in metres"
        )
    try:
        merged, bodies = read_cad(path, content, body)
    except _READER_ERRORS as exc:
        raise MeshError(f"{path}: what OpenCASCADE made of it is no mesh ({exc}); export it again") from exc
    _check(path, merged)
    colors, _, _ = appearance(merged)
    mesh = Mesh(
        np.asarray(merged.vertices, np.float64), np.asarray(merged.faces, np.int64), colors, sha256="-", bodies=bodies
    )
    _check_size(path, mesh, "m", given=False)
    return dataclasses.replace(mesh, sha256=hashlib.sha256(to_ply(mesh)).hexdigest())


def _read(path: Path) -> bytes:
    if path.is_dir():
        raise MeshError(f"{path}: is a folder; expected a mesh file")
    if path.suffix.lower() not in SUFFIXES:
        raise MeshError(f"{path}: unknown kind of mesh {path.suffix!r}; expected one of {' '.join(SUFFIXES)}")
    try:
        content = read_file(path, MAX_BYTES)
    except OSError as exc:
        raise MeshError(f"{path}: the mesh cannot be read ({exc.strerror})") from exc
    if not content:
        raise MeshError(f"{path}: the mesh file is empty (0 bytes); copy or download it again")
    return content


def _parse(path: Path, content: bytes) -> Any:
    kind = path.suffix.lower().lstrip(".")
    resolver = Beside(path, MAX_BYTES)
    try:
        if kind in ("glb", "gltf"):
            refuse_unread(path, content, kind)
            scene = read_gltf(content, kind, resolver)
        else:
            refuse_bytes_as_fractions(path, content, kind)
            scene = trimesh.load_scene(io.BytesIO(content), file_type=kind, process=False, resolver=resolver)
        points = [part for part in scene.geometry.values() if isinstance(part, trimesh.PointCloud)]
        if len(points) == len(scene.geometry) > 0:
            raise _no_surface(path, sum(len(cloud.vertices) for cloud in points))
        mesh = joined(path, scene)
        if kind != "ply" or mesh.visual.kind is None:  # a PLY file may have colours of vertices as well
            resolver.refuse_missing()
        return mesh
    except _READER_ERRORS as exc:
        # Without its optional packages for odd encodings trimesh names those; they would not make a mesh of garbage.
        reason = "garbled text" if isinstance(exc, ImportError) else exc
        raise MeshError(f"{path}: not a readable {kind.upper()} mesh ({reason}); is the file complete?") from exc


def _check(path: Path, loaded: Any) -> None:
    vertices, faces = np.asarray(loaded.vertices), np.asarray(loaded.faces)
    if path.suffix.lower() == ".stl" and len(faces) == 0:  # trimesh takes a binary file that is cut off for text
        raise MeshError(f"{path}: not a readable STL mesh (it holds no triangle); is the file complete?")
    if len(faces) == 0:
        raise _no_surface(path, len(vertices))
    num_broken = int((~np.isfinite(vertices).all(axis=1)).sum())
    if num_broken:
        raise MeshError(f"{path}: {num_broken} of {len(vertices)} vertices are NaN or infinite; repair the mesh")
    low, high = int(faces.min()), int(faces.max())
    if low < 0 or high >= len(vertices):
        wrong = low if low < 0 else high
        raise MeshError(f"{path}: a face names vertex {wrong}, but there are {len(vertices)}; is the file complete?")
    if not loaded.area > 0:
        raise MeshError(f"{path}: its {len(faces)} faces have no area; export the surface of a solid")


def _no_surface(path: Path, num_vertices: int) -> MeshError:
    kind = path.suffix.lstrip(".").upper()
    return MeshError(
        f"{path}: found {num_vertices} vertices and no faces in this {kind} file; a surface is needed, not a "
        "point cloud; is the file complete?"
    )


def _unit_of(path: Path, loaded: Any) -> str:
    """The unit the file names; metres where it names none or one we don't know."""
    if path.suffix.lower() in GLTF_SUFFIXES:
        return "m"
    named = {"meters": "m", "millimeters": "mm", "centimeters": "cm", "inches": "inch", "in": "inch"}
    unit = str(loaded.units)
    return named.get(unit, unit if unit in METRES else "m")


def _check_size(path: Path, mesh: Mesh, unit: str, *, given: bool) -> None:
    if SMALLEST_M <= mesh.diameter_m <= LARGEST_M:
        return
    fitting = [
        name for name, scale in METRES.items() if SMALLEST_M <= mesh.diameter_m / METRES[unit] * scale <= LARGEST_M
    ]
    found = f"{mesh.diameter_m / METRES[unit]:.6g} {unit} = {mesh.diameter_m:.6g} m"
    source = f"--mesh-unit {unit}" if given else f"read as {unit}; the file names no other unit"
    remedy = f"set --mesh-unit to {' or '.join(fitting)}" if fitting else "rescale the mesh"
    if path.suffix.lower() in CAD_SUFFIXES:
        source, remedy = "in the file's own unit", "export it again in its true unit"
    raise MeshError(
        f"{path}: found a diameter of {found} ({source}), expected {SMALLEST_M:g} to {LARGEST_M:g} m; {remedy}"
    )
