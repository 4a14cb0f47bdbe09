"""The page of ``curio-view``: a scene in 3D beside its photograph, its re-rendering and their difference (viser)."""

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import viser
from scipy.spatial.transform import Rotation

from curio_train.drawing.pictures import LIGHT
from curio_train.drawing.scenes import Placed, Scene
from curio_train.errors import DataError
from curio_train.geometry import Pose
from curio_train.viewing.comparison import Comparison, compare
from curio_train.viewing.fitting import walk
from curio_train.viewing.pages import Page
from curio_train.viewing.saving import save


class Viewer:
    """Shows pages in browsers; every browser sees the same page and may edit it."""

    def __init__(self, pages: Sequence[Page], out: Path, host: str, port: int) -> None:
        """Start the web server.

        Args:
            pages: At least one.
            out: File that the button *save* appends scene codes to.
            host: Address to listen on.
            port: To listen on.
        """
        self._pages, self._out = list(pages), out
        self._number, self._selected = 0, 0
        self._lock = threading.RLock()
        self._changed, self._ended = threading.Event(), threading.Event()
        self._fit_wanted = threading.Event()
        self.server = viser.ViserServer(host=host, port=port, label="curio-view", verbose=False)
        self.server.scene.set_up_direction("-y")  # the scene's camera frame: x right, y down, z forward
        self.server.gui.configure_theme(control_layout="fixed", control_width="large", dark_mode=False)
        self._build_panel()
        self._show_page(0)
        self._worker = threading.Thread(target=self._work, daemon=True)
        self._worker.start()

    @property
    def scene(self) -> Scene:
        """The scene code that is shown, with all edits."""
        return self._pages[self._number].scene

    def replace_pages(self, pages: Sequence[Page]) -> None:
        """Show new pages (of a newer checkpoint); stays at the same page number."""
        with self._lock:
            self._pages = list(pages)
            self._show_page(min(self._number, len(pages) - 1))

    def close(self) -> None:
        """End the worker and the web server."""
        self._ended.set()
        self._changed.set()
        self._worker.join()
        self.server.stop()

    # The panel.

    def _build_panel(self) -> None:
        gui = self.server.gui
        self._pager = gui.add_slider("page", 1, max(2, len(self._pages)), 1, 1, visible=len(self._pages) > 1)
        self._title = gui.add_markdown("")
        self._picture = gui.add_image(np.zeros((64, 128, 3), np.uint8), label="photograph | re-rendering", format="png")
        self._difference = gui.add_image(np.zeros((64, 128, 3), np.uint8), label="difference", format="png")
        self._loss = gui.add_markdown("")
        self._objects = gui.add_dropdown("object", ("0",))
        self._position = gui.add_vector3("position x, y, z (mm)", (0.0, 0.0, 0.0), step=0.1)
        self._rotation = gui.add_vector3("rotation vector x, y, z (degrees)", (0.0, 0.0, 0.0), step=0.1)
        self._color = gui.add_rgb("colour (sRGB)", (255, 255, 255))
        self._confidence = gui.add_slider("confidence", 0.0, 1.0, 0.01, 1.0)
        self._light = gui.add_vector3("light, towards it (camera frame)", (0.0, 0.0, 0.0), step=0.05)
        self._fit = gui.add_button("fit this object", hint="render-and-compare from where the object is now")
        self._progress = gui.add_markdown("")
        self._save = gui.add_button("save the code", hint=str(self._out))
        self._pager.on_update(self._by_user(lambda: self._show_page(int(self._pager.value) - 1)))
        self._objects.on_update(self._by_user(self._select))
        for control in (self._position, self._rotation, self._color, self._confidence):
            control.on_update(self._by_user(self._edit_object))
        self._light.on_update(self._by_user(self._edit_light))
        self._fit.on_click(lambda _: self._ask_for_fit())
        self._save.on_click(lambda _: self._write())

    def _by_user(self, action: Callable[[], None]) -> Callable[[Any], None]:
        """A callback that answers a browser's changes and ignores our own, which have no client."""

        def answer(event: Any) -> None:
            if event.client is not None:
                with self._lock:
                    action()

        return answer

    def _show_page(self, number: int) -> None:
        self._number, self._selected = number, 0
        page = self._pages[number]
        names = [f"{i}: {item.kind}" for i, item in enumerate(page.scene.objects)] or ["no object"]
        self._objects.options = tuple(names)
        self._objects.value = names[0]
        self._pager.max = max(2, len(self._pages))
        self._pager.value = number + 1
        self._title.content = f"**{page.scene.name}**, {page.scene.width}x{page.scene.height} pixels"
        self._progress.content = ""
        self._build_scene(page)
        self._show_values()
        self._changed.set()

    def _select(self) -> None:
        self._selected = self._objects.options.index(self._objects.value)
        self._show_values()

    def _show_values(self) -> None:
        """Put the scene's numbers into the controls."""
        light = self.scene.light
        self._light.value = _triple(LIGHT if light is None else light)
        if not self.scene.objects:
            return
        item = self.scene.objects[self._selected]
        self._position.value = _triple(1000 * item.pose.translation_m)
        self._rotation.value = _triple(Rotation.from_matrix(item.pose.rotation).as_rotvec(degrees=True))
        self._color.value = tuple(round(255 * value) for value in item.color_srgb)
        self._confidence.value = round(item.confidence, 2)

    # Edits.

    def _edit_object(self) -> None:
        if not self.scene.objects:
            return
        item = self.scene.objects[self._selected]
        rotation = Rotation.from_rotvec(self._rotation.value, degrees=True).as_matrix()
        if np.allclose(rotation, item.pose.rotation, atol=1e-3):
            rotation = item.pose.rotation  # not touched: keep every digit
        position_m = np.array(self._position.value) / 1000
        color = tuple(value / 255 for value in self._color.value)
        self._put(self._selected, Placed(item.kind, Pose(rotation, position_m), color, float(self._confidence.value)))

    def _edit_light(self) -> None:
        self._replace_scene(replace(self.scene, light=np.array(self._light.value, dtype=np.float64)))

    def _drag(self, number: int, handle: viser.TransformControlsHandle) -> None:
        item = self.scene.objects[number]
        w, x, y, z = handle.wxyz
        pose = Pose(Rotation.from_quat([x, y, z, w]).as_matrix(), np.array(handle.position, dtype=np.float64))
        self._selected = number
        self._objects.value = self._objects.options[number]
        self._replace_object(number, replace(item, pose=pose))
        self._show_values()

    def _put(self, number: int, item: Placed) -> None:
        """Replace an object and move its gizmo along."""
        self._replace_object(number, item)
        w, x, y, z = _wxyz(item.pose.rotation)
        self._gizmos[number].wxyz, self._gizmos[number].position = (w, x, y, z), _triple(item.pose.translation_m)

    def _replace_object(self, number: int, item: Placed) -> None:
        objects = list(self.scene.objects)
        objects[number] = item
        self._replace_scene(replace(self.scene, objects=tuple(objects)))

    def _replace_scene(self, scene: Scene) -> None:
        self._pages[self._number] = replace(self._pages[self._number], scene=scene)
        self._changed.set()

    # The scene in 3D.

    def _build_scene(self, page: Page) -> None:
        api = self.server.scene
        api.reset()
        api.set_up_direction("-y")
        scene = page.scene
        fov = 2 * math.atan(scene.height / 2 / float(scene.camera_matrix[1, 1]))
        reach = max((float(item.pose.translation_m[2]) for item in scene.objects), default=1.0)
        api.add_camera_frustum("/camera", fov, scene.width / scene.height, scale=0.3 * reach, image=page.image)
        self._gizmos = []
        for number, item in enumerate(scene.objects):
            mesh = page.context.mesh(item.kind)
            gizmo = api.add_transform_controls(
                f"/object{number}",
                scale=0.6 * mesh.diameter_m,
                wxyz=_wxyz(item.pose.rotation),
                position=_triple(item.pose.translation_m),
            )
            solid = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
            if mesh.vertex_colors_srgb is not None:
                solid.visual.vertex_colors = np.rint(255 * mesh.vertex_colors_srgb).astype(np.uint8)
            api.add_mesh_trimesh(f"/object{number}/mesh", solid)
            gizmo.on_update(self._by_user(lambda number=number, gizmo=gizmo: self._drag(number, gizmo)))
            self._gizmos.append(gizmo)

    # The worker: the renderer is not thread-safe, so one thread draws and fits.

    def _work(self) -> None:
        while not self._ended.is_set():
            self._changed.wait()
            self._changed.clear()
            if self._ended.is_set():
                return
            if self._fit_wanted.is_set():
                self._fit_wanted.clear()
                self._walk()
            with self._lock:
                page = self._pages[self._number]
            self._show(compare(page))

    def _show(self, drawn: Comparison) -> None:
        self._picture.image = np.hstack([drawn.image, drawn.rendering])
        self._difference.image = drawn.difference
        self._loss.content = f"image loss **{drawn.loss:.4g}** (squared difference, summed over pixels and channels)"

    def _ask_for_fit(self) -> None:
        self._fit_wanted.set()
        self._changed.set()

    def _walk(self) -> None:
        """Move the selected object by render-and-compare and show each step."""
        with self._lock:
            page, number = self._pages[self._number], self._selected
        if not page.scene.objects:
            return
        losses = []
        for step in walk(page, number):
            losses.append(step.loss)
            with self._lock:
                if self._pages[self._number].scene is not page.scene and len(losses) == 1:
                    return
                self._put(number, replace(page.scene.objects[number], pose=step.pose))
                page = self._pages[self._number]
                self._show_values()
            self._progress.content = f"fit: step {len(losses)}, loss {losses[0]:.4g} → {step.loss:.4g}"
            if len(losses) % 4 == 0:
                self._show(compare(page))
        self._progress.content += ", done"

    def _write(self) -> None:
        with self._lock:
            scene = self.scene
        try:
            save(scene, self._out)
        except DataError as exc:
            self._progress.content = f"**not saved**: {exc}"
            return
        self._progress.content = f"saved to {self._out}"


def _triple(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _wxyz(rotation: np.ndarray) -> tuple[float, float, float, float]:
    x, y, z, w = (float(value) for value in Rotation.from_matrix(rotation).as_quat())
    return w, x, y, z
