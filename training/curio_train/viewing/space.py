"""The scene in three dimensions: objects with gizmos, and the camera with its photograph (viser)."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import trimesh
import viser
from scipy.spatial.transform import Rotation

from curio_train.drawing.scenes import Placed
from curio_train.geometry import Pose
from curio_train.meshes.meshes import Mesh
from curio_train.viewing.pages import Page

_IMAGE_PLANE = 1.5  # distance of the photograph from the camera, in that of the farthest object
_BOX_EDGES = [(0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7)]
_BOX_COLOR = (40, 120, 220)


class Space:
    """Shows one page's scene; its frame is the camera's (x right, y down, z forward), metres."""

    def __init__(self, server: viser.ViserServer, on_drag: Callable[[int, Pose], None]) -> None:
        """Remember whom to tell.

        Args:
            server: Of the page.
            on_drag: Called with an object's number and its new cam_from_obj when a browser drags it.
        """
        self._server, self._on_drag = server, on_drag
        self._gizmos: list[viser.TransformControlsHandle] = []
        self._reach_m, self._fov = 1.0, 1.0
        server.scene.set_up_direction("-y")
        server.on_client_connect(self._look)

    def show(self, page: Page) -> None:
        """Replace what is shown by a page's scene."""
        api, scene = self._server.scene, page.scene
        for gizmo in self._gizmos:
            gizmo.remove()
        self._fov = 2 * math.atan(scene.height / 2 / float(scene.camera_matrix[1, 1]))
        self._reach_m = max((float(page.context.middle(item)[2]) for item in scene.objects), default=1.0)
        api.add_camera_frustum(
            "/camera", self._fov, scene.width / scene.height, scale=_IMAGE_PLANE * self._reach_m, image=page.image
        )
        self._gizmos = [self._add(number, item, page) for number, item in enumerate(scene.objects)]

    def move(self, number: int, pose: Pose) -> None:
        """Move an object; no callback is called."""
        self._gizmos[number].wxyz, self._gizmos[number].position = _wxyz(pose), _xyz(pose)

    def _add(self, number: int, item: Placed, page: Page) -> viser.TransformControlsHandle:
        mesh, name = page.context.mesh(item.kind), f"/object{number}"
        gizmo = self._server.scene.add_transform_controls(
            name, scale=0.6 * mesh.diameter_m, depth_test=False, wxyz=_wxyz(item.pose), position=_xyz(item.pose)
        )
        self._server.scene.add_mesh_trimesh(f"{name}/mesh", _solid(mesh))
        edges = mesh.box_corners_m[np.array(_BOX_EDGES)].astype(np.float32)
        self._server.scene.add_line_segments(f"{name}/box", edges, _BOX_COLOR, thickness=0.005 * mesh.diameter_m)
        gizmo.on_update(partial(self._dragged, number))
        return gizmo

    def _dragged(self, number: int, event: Any) -> None:
        if event.client is None:  # moved by us
            return
        w, x, y, z = event.target.wxyz
        rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
        self._on_drag(number, Pose(rotation, np.array(event.target.position, dtype=np.float64)))

    def _look(self, client: viser.ClientHandle) -> None:
        """Let a new browser see the scene as the camera does."""
        client.camera.up_direction = (0.0, -1.0, 0.0)
        client.camera.position = (0.0, 0.0, 0.0)
        client.camera.look_at = (0.0, 0.0, self._reach_m)
        client.camera.fov = self._fov


def _solid(mesh: Mesh) -> trimesh.Trimesh:
    colors = None if mesh.vertex_colors_srgb is None else np.rint(255 * mesh.vertex_colors_srgb).astype(np.uint8)
    return trimesh.Trimesh(mesh.vertices_m, mesh.faces, vertex_colors=colors, process=False)


def _xyz(pose: Pose) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in pose.translation_m)
    return x, y, z


def _wxyz(pose: Pose) -> tuple[float, float, float, float]:
    x, y, z, w = (float(value) for value in Rotation.from_matrix(pose.rotation).as_quat())
    return w, x, y, z
