"""Pictures that stand in for photographs: path traced by stock Mitsuba, as far from our own renderer as a camera is.

What training does not know and these have: a lamp of some size and its soft shadows, light that objects throw on each
other and on the table, gloss, a lens with depth of field. What the sensor adds is in ``sensor.py``.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from curio_train.geometry import Pose
from curio_train.meshes.meshes import Mesh
from curio_train.rendering.parts import linear_from_srgb
from curio_train.rendering.stock import OPENCV_AXES, sensor
from curio_train.rendering.topology import adjacency, smooth_normals
from curio_train.rendering.variant import load_mitsuba

_BOUNCES = 5
_ROUGHNESS = 0.15
_OUT_OF_SIGHT_M = np.array([0.0, -100.0, 0.0])  # below the table
_LAMP_RADIANCE, _SKY_RADIANCE = (60.0, 56.0, 49.0), (0.5, 0.53, 0.6)


@dataclass(frozen=True, eq=False)
class SyntheticObject:
    """An object of a scene.

    Attributes:
        mesh: Its shape, and its colours where it has some.
        color_srgb: [3], where the mesh has none.
    """

    mesh: Mesh
    color_srgb: tuple[float, float, float] = (0.6, 0.6, 0.6)


class PathTracedScene:
    """A table under a lamp, with things that can be moved. World frame: y up, the table's top at y = 0, metres."""

    def __init__(
        self,
        objects: Sequence[SyntheticObject],
        table_srgb: np.ndarray,
        table_side_m: float,
        camera_matrix: np.ndarray,
        size: tuple[int, int],
        *,
        focus_m: float,
        aperture_m: float,
        samples_per_pixel: int,
    ) -> None:
        """Build the scene once; later only positions change, so that kernels are compiled once.

        Args:
            objects: What may stand on the table.
            table_srgb: [height, width, 3] uint8, the table's look.
            table_side_m: Of the square table.
            camera_matrix: K [3, 3] with the principal point in the middle, as Mitsuba's lens wants it.
            size: Width and height of an image.
            focus_m: What is sharp.
            aperture_m: Radius of the lens.
            samples_per_pixel: Light paths a pixel.

        Raises:
            RendererError: The renderer cannot start.
        """
        self._mitsuba = load_mitsuba()
        self._vertices = []
        shapes = {}
        for number, thing in enumerate(objects):
            shapes[f"thing_{number}"], vertices = self._shape(f"thing_{number}", thing)
            self._vertices.append(vertices)
        pinhole = sensor(self._mitsuba, camera_matrix, *size, samples_per_pixel)
        lens = {key: value for key, value in pinhole.items() if not key.startswith("principal_point")}
        lens |= {"type": "thinlens", "aperture_radius": aperture_m, "focus_distance": focus_m}
        description = {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": _BOUNCES},
            "sensor": lens,
            "table": self._table(table_srgb, table_side_m),
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": list(_SKY_RADIANCE)}},
            "lamp": self._lamp(table_side_m),
            **shapes,
        }
        self._scene = self._mitsuba.load_dict(description)
        self._parameters = self._mitsuba.traverse(self._scene)

    def photograph(self, cam_from_world: np.ndarray, poses: Sequence[np.ndarray | None], seed: int) -> np.ndarray:
        """Linear radiance [height, width, 3] that reaches the sensor.

        Args:
            cam_from_world: [4, 4], OpenCV's camera.
            poses: world_from_obj [4, 4] of each thing; None: it is not there.
            seed: Of the light paths.
        """
        mitsuba = self._mitsuba
        for number, (vertices, pose) in enumerate(zip(self._vertices, poses, strict=True)):
            placed = vertices + _OUT_OF_SIGHT_M if pose is None else Pose.from_matrix(pose).apply(vertices)
            key = f"thing_{number}.vertex_positions"
            self._parameters[key] = np.ascontiguousarray(placed, dtype=np.float32).ravel()
        world_from_sensor = np.linalg.inv(cam_from_world) @ OPENCV_AXES
        self._parameters["sensor.to_world"] = mitsuba.Transform4f(world_from_sensor.tolist())
        self._parameters.update()
        image = np.array(mitsuba.render(self._scene, seed=seed), dtype=np.float32)
        return image[..., :3]

    def _shape(self, name: str, thing: SyntheticObject) -> tuple[Any, np.ndarray]:
        """A glossy ``mitsuba.Mesh`` and its vertices [v, 3], doubled along folds. Normals follow the vertices."""
        mesh, mitsuba = thing.mesh, self._mitsuba
        source, faces, _ = smooth_normals(mesh.vertices_m, adjacency(mesh.vertices_m / mesh.diameter_m, mesh.faces))
        reflectance: dict[str, Any] = {"type": "rgb", "value": linear_from_srgb(np.array(thing.color_srgb)).tolist()}
        if mesh.vertex_colors_srgb is not None:
            reflectance = {"type": "mesh_attribute", "name": "vertex_color"}
        properties = mitsuba.Properties()
        properties["bsdf"] = mitsuba.load_dict(
            {"type": "roughplastic", "diffuse_reflectance": reflectance, "alpha": _ROUGHNESS, "nonlinear": True}
        )
        shape = mitsuba.Mesh(name, len(source), len(faces), has_vertex_normals=True, props=properties)
        if mesh.vertex_colors_srgb is not None:
            colors = linear_from_srgb(mesh.vertex_colors_srgb[source]).astype(np.float32)
            shape.add_attribute("vertex_color", 3, np.ascontiguousarray(colors).ravel())
        vertices = mesh.vertices_m[source]
        parameters = mitsuba.traverse(shape)
        parameters["vertex_positions"] = np.ascontiguousarray(vertices, dtype=np.float32).ravel()
        parameters["faces"] = np.ascontiguousarray(faces, dtype=np.uint32).ravel()
        parameters.update()
        return shape, vertices

    def _table(self, look_srgb: np.ndarray, side_m: float) -> dict[str, Any]:
        linear = linear_from_srgb(look_srgb.astype(np.float32) / 255).astype(np.float32)
        turn = self._mitsuba.ScalarTransform4f().rotate([1, 0, 0], -90).scale([side_m / 2, side_m / 2, 1])
        texture = {"type": "bitmap", "bitmap": self._mitsuba.Bitmap(np.ascontiguousarray(linear)), "raw": True}
        return {"type": "rectangle", "to_world": turn, "bsdf": {"type": "diffuse", "reflectance": texture}}

    def _lamp(self, side_m: float) -> dict[str, Any]:
        """A square lamp to one side above the table, a fifth of its side wide."""
        look = self._mitsuba.ScalarTransform4f().look_at(
            origin=[-0.35 * side_m, 0.6 * side_m, 0.25 * side_m], target=[0, 0, 0], up=[0, 0, 1]
        )
        radiance = {"type": "area", "radiance": {"type": "rgb", "value": list(_LAMP_RADIANCE)}}
        return {"type": "rectangle", "to_world": look.scale([0.1 * side_m, 0.1 * side_m, 1]), "emitter": radiance}
