"""What users of stock Mitsuba do: one scene an image, its vertices moved, its own integrator differentiated.

The baseline of benchmarks/rendering/renderer.py; nothing in training uses it.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from curio_train.meshes.meshes import Mesh
from curio_train.rendering.stock import PosedMesh, emitters, load_scene, sensor
from curio_train.rendering.tracing import srgb_from_linear

BEST: Mapping[str, Any] = {"type": "direct_projective", "sppi": 0, "guiding": "none"}
"""Its fastest setting that has gradients of position: no indirect silhouettes, there are none."""

DEFAULTS: Mapping[str, Any] = {"type": "direct_projective"}
REFERENCE: Mapping[str, Any] = {"type": "direct"}


class StockPoses:
    """One object under fixed light before a camera, to be rendered at many poses, one after the other."""

    def __init__(
        self,
        mitsuba: Any,
        drjit: Any,
        mesh: Mesh,
        camera_matrix: np.ndarray,
        size: tuple[int, int],
        ambient: float,
        light: np.ndarray,
        integrator: Mapping[str, Any],
        samples_per_pixel: int,
    ) -> None:
        """Load the scene; ``light`` [3] points towards the light, camera frame; ``size`` is (width, height)."""
        self.mi, self.dr, self.samples_per_pixel = mitsuba, drjit, samples_per_pixel
        posed = PosedMesh(mesh, np.eye(3), np.zeros(3))
        camera = sensor(mitsuba, camera_matrix, *size, samples_per_pixel)
        self.scene = load_scene(mitsuba, [posed], camera, emitters(ambient, light), dict(integrator))
        self.parameters = mitsuba.traverse(self.scene)
        self.vertices = mitsuba.Point3f(drjit.unravel(mitsuba.Point3f, self.parameters["object_0.vertex_positions"]))

    def _render(self, rotation: np.ndarray, translation_m: np.ndarray, turn: Any, shift: Any, seed: int) -> Any:
        """Image in sRGB, a tensor [height, width, 3]; ``turn`` (axis · angle) and ``shift`` are small, attached."""
        mi, dr = self.mi, self.dr
        turned = mi.Matrix3f(rotation.astype(np.float32)) @ self.vertices
        moved = turned + dr.cross(turn, turned) + mi.Vector3f(*[float(v) for v in translation_m]) + shift
        self.parameters["object_0.vertex_positions"] = dr.ravel(moved)
        self.parameters.update()
        image = mi.render(self.scene, self.parameters, spp=self.samples_per_pixel, seed=seed, seed_grad=seed + 1)
        return srgb_from_linear(dr, image[..., :3])

    def image(self, rotation: np.ndarray, translation_m: np.ndarray, seed: int) -> np.ndarray:
        """SRGB image [height, width, 3] of the object at cam_from_obj (``rotation`` [3, 3], ``translation_m`` [3])."""
        with self.dr.suspend_grad():
            image = self._render(rotation, translation_m, self.mi.Vector3f(0), self.mi.Vector3f(0), seed)
            return np.array(image)

    def gradient(self, rotation: np.ndarray, translation_m: np.ndarray, target: np.ndarray, seed: int) -> np.ndarray:
        """Gradient [6] of the summed squared difference to ``target`` by (turn about the object's origin, shift)."""
        mi, dr = self.mi, self.dr
        turn, shift = mi.Vector3f(0), mi.Vector3f(0)
        dr.enable_grad(turn, shift)
        image = self._render(rotation, translation_m, turn, shift, seed)
        dr.backward(dr.sum(dr.square(image - mi.TensorXf(target)), axis=None))
        return np.array([*dr.grad(turn).numpy().ravel(), *dr.grad(shift).numpy().ravel()])
