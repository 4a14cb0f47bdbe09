"""Whether a mesh is the one that a model learned."""

from pathlib import Path

import numpy as np
from curio_proto.v1.model_spec_pb2 import ObjectModel

from curio_train.errors import MeshError
from curio_train.meshes.meshes import METRES, Mesh

_TOLERANCE = 0.01  # of the diameter, between the mesh's box and the model's


def refuse_other_mesh(mesh: Mesh, kind: ObjectModel, label: str) -> None:
    """Refuse a mesh that is not the one that the model learned.

    Args:
        mesh: As it was read.
        kind: The model's object.
        label: Names the mesh in errors.

    Raises:
        MeshError: The mesh is of another size or lies otherwise in its frame.
    """
    corners_m = np.reshape(kind.box_corners_m, (-1, 3))
    ratio = mesh.diameter_m / kind.diameter_m
    if abs(ratio - 1) > _TOLERANCE:
        units = ", ".join(METRES)
        raise MeshError(
            f"{label}: its diameter is {mesh.diameter_m:.4g} m, the model's object has {kind.diameter_m:.4g} m; give "
            f"the mesh that the model was trained with, or its unit with --mesh-unit ({units})"
        )
    if np.abs(mesh.box_corners_m - corners_m).max() > _TOLERANCE * kind.diameter_m:
        raise MeshError(
            f"{label}: its box is from {_point(mesh.box_corners_m.min(0))} to {_point(mesh.box_corners_m.max(0))}, "
            f"the model's from {_point(corners_m.min(0))} to {_point(corners_m.max(0))}; give the mesh that the model "
            "was trained with, in the same frame"
        )


def refuse_changed_mesh(mesh: Mesh, sha256: str | None, file: Path) -> None:
    """Refuse a mesh file whose content is not what it was when a run began.

    Args:
        mesh: As it was read.
        sha256: Of the file then, hexadecimal; None: not known.
        file: Names the mesh in errors.

    Raises:
        MeshError: It has changed.
    """
    if sha256 is not None and mesh.sha256 != sha256:
        raise MeshError(
            f"{file}: is not the file that the run was trained with: its SHA-256 is {mesh.sha256[:12]}…, it was "
            f"{sha256[:12]}…; put that file back, or train the new part"
        )


def _point(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ") m"
