"""Render-and-compare on the detections of serving: the frame as the model saw it, poses there and back."""

import json
from collections.abc import Mapping, Sequence
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
import torch
from curio_proto.v1.detector_pb2 import Detection
from curio_proto.v1.model_spec_pb2 import ModelSpec
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.rotation import quaternion_xyzw
from curio_serve.imaging.view import CanonicalCamera, PinholeCrop, PinholeFrame
from curio_serve.models.object_frames import center_of, middle_from_origin, origin_from_middle, transformed

from curio_train.geometry import rotation_6d_from_matrix
from curio_train.meshes.inset import inset
from curio_train.meshes.meshes import Mesh
from curio_train.meshes.of_model import refuse_other_mesh
from curio_train.refinement.render_and_compare import DEFAULT_LIGHT, RenderAndCompare
from curio_train.refinement.template_poses import uses_templates
from curio_train.scene_code import COLOR, LIGHT, ROTATION_6D, TRANSLATION, SceneCode, poses
from curio_train.worlds.base import Camera
from curio_train.worlds.linemod import SCAN_EXCESS_M


class NamedMesh(NamedTuple):
    """The mesh of an object."""

    label: str
    """Names it in errors."""
    mesh: Mesh
    """The mesh as its file has it."""


class DetectionRefiner:
    """Refines the detections of a model; safe to share between threads, which take turns."""

    def __init__(self, spec: ModelSpec, meshes: Mapping[str, NamedMesh]) -> None:
        """Build a renderer for each object.

        Args:
            spec: Of a model with K*.
            meshes: Of its objects, by their names.

        Raises:
            MeshError: A mesh is of another size or lies otherwise in its frame than the one the model learned.
        """
        matrix = np.reshape(spec.camera.camera_matrix, (3, 3))
        self._canonical = CanonicalCamera(spec.camera.width, spec.camera.height, matrix)
        camera = Camera(spec.camera.width, spec.camera.height, matrix)
        recipe = _recipe(spec)  # of all objects, of which the specification may have a part
        num_objects = max(len(spec.objects), len(recipe.get("world", {}).get("mesh_sha256", ())))
        from_templates = uses_templates(recipe, num_objects)
        excess_m = SCAN_EXCESS_M if from_templates and spec.world == "linemod" else 0.0
        self._corners, self._centers_m, self._refiners = {}, {}, {}
        for kind in spec.objects:
            label, mesh = meshes[kind.name]
            refuse_other_mesh(mesh, kind, label)
            self._corners[kind.name] = np.reshape(kind.box_corners_m, (-1, 3)).tolist()
            self._centers_m[kind.name] = center_of(kind)
            mesh = mesh.moved(-center_of(kind))
            self._refiners[kind.name] = RenderAndCompare(
                inset(mesh, excess_m) if excess_m else mesh, camera, kind.diameter_m, from_templates=from_templates
            )
        self._lock = Lock()  # the renderers are not thread-safe
        self.num_detections = self.num_refined = 0

    def __call__(
        self, pixels: np.ndarray, camera: PinholeCamera, detections: Sequence[Detection], light: Sequence[float]
    ) -> None:
        """Replace the poses and boxes of a frame's detections where a better pose is found.

        Args:
            pixels: uint8 RGB [height, width, 3].
            camera: Of the frame.
            detections: With rotations; metres in the frame's camera.
            light: [3] towards the light in the frame's camera; none: from above.
        """
        crop = PinholeFrame(pixels, camera, self._canonical).crop()
        for name, refiner in self._refiners.items():
            if of_object := [one for one in detections if one.object == name]:
                self._refine(refiner, crop, of_object, light)

    def _refine(
        self, refiner: RenderAndCompare, crop: PinholeCrop, detections: Sequence[Detection], light: Sequence[float]
    ) -> None:
        """Refine the detections of one object."""
        image = torch.from_numpy(np.ascontiguousarray(crop.image)).permute(2, 0, 1)[None]
        center_m = self._centers_m[detections[0].object]
        code = _code(detections, light, crop.canonical_from_cam, center_m)
        with self._lock:
            refined, accepted, *_ = refiner.refine(image.expand(len(detections), -1, -1, -1), code)
            self.num_detections += len(detections)
            self.num_refined += int(accepted.sum())
        for detection, pose, is_better in zip(detections, poses(refined), accepted.tolist(), strict=True):
            if is_better:
                origin_m = origin_from_middle(pose.translation_m, pose.rotation, center_m)
                self._write(detection, crop, pose.rotation, origin_m)

    def _write(self, detection: Detection, crop: PinholeCrop, seen: np.ndarray, position_m: np.ndarray) -> None:
        rotation, translation = crop.rotate(seen.tolist()), crop.translation(position_m.tolist())
        detection.translation_m[:] = translation
        detection.rotation[:] = rotation
        detection.rotation_6d[:] = [*rotation[0::3], *rotation[1::3]]
        detection.quaternion_xyzw[:] = quaternion_xyzw(rotation)
        detection.box_px[:] = crop.project(transformed(self._corners[detection.object], rotation, translation))


def _recipe(spec: ModelSpec) -> Mapping[str, Any]:
    """The configuration that the model was trained with; empty where it does not say it."""
    try:
        recipe = json.loads(spec.recipe)
    except ValueError:
        return {}
    return recipe if isinstance(recipe, dict) else {}


def _code(
    detections: Sequence[Detection], light: Sequence[float], canonical_from_cam: np.ndarray, center_m: np.ndarray
) -> SceneCode:
    """Scene codes of the detections in the canonical camera, one a row, with positions of the object's middle."""
    rotation = torch.from_numpy(np.asarray(canonical_from_cam, np.float64))
    turned = np.array([one.rotation for one in detections]).reshape(-1, 3, 3)
    origins_m = np.array([one.translation_m for one in detections])
    rotations, positions = map(torch.from_numpy, (turned, middle_from_origin(origins_m, turned, center_m)))
    towards_light = rotation @ torch.tensor(list(light) or DEFAULT_LIGHT, dtype=torch.float64)
    code = {
        ROTATION_6D: rotation_6d_from_matrix(rotation @ rotations)[:, None].float(),
        TRANSLATION: (positions @ rotation.T)[:, None].float(),
        LIGHT: towards_light.float().expand(len(detections), 3),
    }
    if all(one.color for one in detections):
        code[COLOR] = torch.tensor([list(one.color) for one in detections])[:, None]
    return code
