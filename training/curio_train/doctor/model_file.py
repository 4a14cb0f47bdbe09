"""An exported model: whether it can be run, and was trained for this mesh and such a camera."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from curio_proto.v1.model_spec_pb2 import ModelSpec
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.view import MOSTLY_SEARCHED, searched_fraction
from curio_serve.models.model import canonical_camera

from curio_train.camera import Intrinsics
from curio_train.doctor.finding import Finding
from curio_train.doctor.providers import examine_providers
from curio_train.errors import CurioError
from curio_train.exported_model import ExportedModel, find_model
from curio_train.meshes.meshes import METRES, Mesh

_SAME_SIZE = 0.01
_NARROWER = 2.0  # focal length over the model's, for images of one width


def examine_model(path: Path, mesh: Mesh | None, camera: Intrinsics | None) -> Iterator[Finding]:
    """Whether the model can be run, and was trained for this mesh and such a camera."""
    try:
        file = find_model(path)
        spec = ExportedModel.open(file).spec
    except CurioError as exc:
        yield Finding("model", "bad", str(exc), fault="model unreadable")
        return
    names = ", ".join(kind.name for kind in spec.objects)
    yield Finding("model", "good", f"{path}: {spec.name} of the world {spec.world}, finds {names}")
    yield from examine_providers(file)
    if mesh is not None:
        yield from _other_mesh(spec, mesh)
    if camera is not None and spec.camera.camera_matrix:
        yield from _other_view(spec, camera)


def _other_mesh(spec: ModelSpec, mesh: Mesh) -> Iterator[Finding]:
    own = next((kind for kind in spec.objects if kind.mesh_sha256 == mesh.sha256), None)
    if own is not None:
        if abs(mesh.diameter_m / own.diameter_m - 1) >= _SAME_SIZE:
            in_model, in_file = (f"{one.diameter_m * 1000:.4g} mm" for one in (own, mesh))
            text = f"{own.name} has a diameter of {in_model} in the model, and its mesh file one of {in_file}"
            yield Finding("model mesh", "bad", text, "Set --mesh-unit: a unit was mistaken", fault="mesh unit")
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
    told = f"than the model's own ({ratio:.2g} of its focal length)"
    view = canonical_camera(spec, spec.name)
    searched = searched_fraction(PinholeCamera(camera.matrix), view, camera.width, camera.height)
    if searched < MOSTLY_SEARCHED:
        text = f"the camera's view is wider {told}: {searched:.0%} of a frame, its middle, are searched"
        remedy = "Train with this camera, or ask curio-serve about regions of the frames"
        yield Finding("model camera", "warning", text, remedy, "possible", fault="other view")
    if ratio > _NARROWER:
        text = f"the camera's view is much narrower {told}: a frame fills the middle {1 / ratio:.0%} of its images"
        remedy = "Train with this camera, for the distances at which it sees the objects"
        yield Finding("model camera", "warning", text, remedy, "possible", fault="other view")
