"""Render-and-compare on the detections of serving: the frame as the model saw it, poses there and back."""

from collections.abc import Sequence
from threading import Lock

import numpy as np
import torch
from curio_proto.v1.detector_pb2 import Detection
from curio_proto.v1.model_spec_pb2 import ModelSpec
from curio_serve.imaging.camera import PinholeCamera
from curio_serve.imaging.rotation import quaternion_xyzw
from curio_serve.imaging.view import CanonicalCamera, PinholeCrop, PinholeFrame
from curio_serve.models.detector import transformed

from curio_train.geometry import rotation_6d_from_matrix
from curio_train.meshes.meshes import Mesh
from curio_train.meshes.of_model import refuse_other_mesh
from curio_train.refinement.render_and_compare import DEFAULT_LIGHT, RenderAndCompare
from curio_train.scene_code import COLOR, LIGHT, ROTATION_6D, TRANSLATION, SceneCode, poses
from curio_train.worlds.base import Camera


class DetectionRefiner:
    """Refines the detections of one object; safe to share between threads, which take turns."""

    def __init__(self, mesh: Mesh, spec: ModelSpec, label: str) -> None:
        """Build the renderer.

        Args:
            mesh: Of the object.
            spec: Of a model that finds one kind of object, with K*.
            label: Names the mesh in errors.

        Raises:
            MeshError: The mesh is of another size or lies otherwise in its frame than the one the model learned.
        """
        (kind,) = spec.objects
        self._corners = np.reshape(kind.box_corners_m, (-1, 3)).tolist()
        refuse_other_mesh(mesh, kind, label)
        camera = spec.camera
        matrix = np.reshape(camera.camera_matrix, (3, 3))
        self._canonical = CanonicalCamera(camera.width, camera.height, matrix)
        self._refiner = RenderAndCompare(mesh, Camera(camera.width, camera.height, matrix), kind.diameter_m)
        self._lock = Lock()  # the renderer is not thread-safe
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
        image = torch.from_numpy(np.ascontiguousarray(crop.image)).permute(2, 0, 1)[None]
        code = _code(detections, light, crop.canonical_from_cam)
        with self._lock:
            refined, accepted = self._refiner.refine(image.expand(len(detections), -1, -1, -1), code)
            self.num_detections += len(detections)
            self.num_refined += int(accepted.sum())
        for detection, pose, is_better in zip(detections, poses(refined), accepted.tolist(), strict=True):
            if is_better:
                self._write(detection, crop, pose.rotation, pose.translation_m)

    def _write(self, detection: Detection, crop: PinholeCrop, seen: np.ndarray, position_m: np.ndarray) -> None:
        rotation, translation = crop.rotate(seen.tolist()), crop.translation(position_m.tolist())
        detection.translation_m[:] = translation
        detection.rotation[:] = rotation
        detection.rotation_6d[:] = [*rotation[0::3], *rotation[1::3]]
        detection.quaternion_xyzw[:] = quaternion_xyzw(rotation)
        detection.box_px[:] = crop.project(transformed(self._corners, rotation, translation))


def _code(detections: Sequence[Detection], light: Sequence[float], canonical_from_cam: np.ndarray) -> SceneCode:
    """Scene codes of the detections in the canonical camera, one a row."""
    rotation = torch.from_numpy(np.asarray(canonical_from_cam, np.float64))
    rotations = torch.tensor([list(one.rotation) for one in detections], dtype=torch.float64).reshape(-1, 3, 3)
    positions = torch.tensor([list(one.translation_m) for one in detections], dtype=torch.float64)
    towards_light = rotation @ torch.tensor(list(light) or DEFAULT_LIGHT, dtype=torch.float64)
    code = {
        ROTATION_6D: rotation_6d_from_matrix(rotation @ rotations)[:, None].float(),
        TRANSLATION: (positions @ rotation.T)[:, None].float(),
        LIGHT: towards_light.float().expand(len(detections), 3),
    }
    if all(one.color for one in detections):
        code[COLOR] = torch.tensor([list(one.color) for one in detections])[:, None]
    return code
