"""The specification of an exported model: what it answers, about which objects, as seen by which camera."""

from collections.abc import Sequence

import numpy as np
from curio_proto.v1.model_spec_pb2 import CanonicalCamera, ModelSpec, ObjectModel, Symmetry
from curio_proto.v1.model_spec_pb2 import Field as FieldSpec
from curio_serve.models.spec import SCHEMA_VERSION
from curio_serve.planes.stable_poses import STABLE_POSES_FILE

from curio_train.meshes.stable_poses import stable_poses, to_text
from curio_train.scene_code import Field
from curio_train.worlds.base import ObjectKind, World


def model_spec(world: World, name: str) -> ModelSpec:
    """The specification of a world's model, without its origin."""
    camera = world.camera
    matrix: Sequence[float] = [] if camera.matrix is None else np.asarray(camera.matrix, float).ravel().tolist()
    return ModelSpec(
        schema_version=SCHEMA_VERSION,
        name=name,
        world=world.name,
        num_slots=world.layout.num_slots,
        fields=[_field_spec(field) for field in world.outputs.fields],
        objects=[_object_model(kind) for kind in world.objects],
        camera=CanonicalCamera(
            width=camera.width, height=camera.height, camera_matrix=matrix, is_default=camera.is_default
        ),
    )


def stable_poses_file(world: World) -> dict[str, bytes]:
    """The file beside a model that says how its objects can stand on a plane, by its name.

    Empty where they always stand in the same way, or are flat.
    """
    hulls_m = [(kind.name, kind.hull_m) for kind in world.objects if kind.hull_m is not None]
    if len(hulls_m) < len(world.objects):
        return {}
    return {STABLE_POSES_FILE: to_text(stable_poses(hulls_m)).encode()}


def _field_spec(field: Field) -> FieldSpec:
    return FieldSpec(
        name=field.name,
        size=field.size,
        per_object=field.per_object,
        unit=field.unit,
        frame=field.frame,
        lower=field.lower,
        upper=field.upper,
        activation=field.activation,
    )


def _object_model(kind: ObjectKind) -> ObjectModel:
    discrete = [Symmetry(transform=np.asarray(matrix, float).ravel()) for matrix in kind.symmetries]
    continuous = [Symmetry(axis=axis, offset_m=offset) for axis, offset in kind.symmetry_axes]
    return ObjectModel(
        name=kind.name,
        mesh_sha256=kind.mesh_sha256,
        diameter_m=kind.diameter_m,
        box_corners_m=np.asarray(kind.box_corners_m, float).ravel(),
        symmetries=discrete + continuous,
        slots=kind.slots,
        center_m=kind.center_m if any(kind.center_m) else (),
    )
