"""The controls of the page: pictures, loss, and one control for each field of the scene code, with its unit (viser)."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from curio_train.drawing.scenes import Placed, Scene
from curio_train.geometry import Pose
from curio_train.viewing.comparison import Comparison

_ROUNDED_DEG = 0.051  # of rotation vectors: what a control of this step rounds off


class Panel:
    """The column of controls. Setting a control here calls no callback: those answer browsers alone."""

    def __init__(self, gui: viser.GuiApi) -> None:
        blank = np.full((64, 128, 3), 255, np.uint8)
        self.pager: Any = gui.add_slider("page", 1, 2, 1, 1, visible=False)
        self._title = gui.add_markdown("")
        self._pair = gui.add_image(blank, label="photograph and re-rendering", format="png")
        self._difference = gui.add_image(blank, label="difference", format="png")
        self._loss = gui.add_markdown("")
        self.objects: Any = gui.add_dropdown("object", ("no object",))
        self.position: Any = gui.add_vector3("position (mm)", (0.0, 0.0, 0.0), step=0.1, hint="camera frame, x y z")
        self.rotation: Any = gui.add_vector3(
            "rotation (°)", (0.0, 0.0, 0.0), step=0.1, hint="rotation vector cam_from_obj, x y z"
        )
        self.color: Any = gui.add_rgb("colour (sRGB)", (255, 255, 255))
        self.confidence: Any = gui.add_slider("confidence (0 to 1)", 0.0, 1.0, 0.01, 1.0)
        self.light: Any = gui.add_vector3(
            "light (strength)", (0.0, 0.0, 0.0), step=0.05, hint="camera frame, points to it"
        )
        self.fit = gui.add_button("fit this object", hint="render-and-compare from where the object is now")
        self._message = gui.add_markdown("")
        self.save = gui.add_button("save the code")

    def on_object(self, callback: Callable[[Any], None]) -> None:
        """Call back when a browser changes a field of the object."""
        for control in (self.position, self.rotation, self.color, self.confidence):
            control.on_update(callback)

    def show_page(self, number: int, num_pages: int, scene: Scene) -> None:
        """Name the page and its objects."""
        self.pager.max, self.pager.visible = max(2, num_pages), num_pages > 1
        self.pager.value = number + 1
        self._title.content = f"**{scene.name}**, {scene.width}x{scene.height} pixels"
        names = tuple(f"{i}: {item.kind or 'object'}" for i, item in enumerate(scene.objects)) or ("no object",)
        self.objects.options = names
        self.objects.value = names[0]
        self.message("")

    def show_values(self, scene: Scene, light: np.ndarray, selected: int) -> None:
        """Show the light [3] and one object's fields."""
        self.light.value = _triple(light)
        if not scene.objects:
            return
        item = scene.objects[selected]
        self.objects.value = self.objects.options[selected]
        self.position.value = _triple(1000 * item.pose.translation_m)
        self.rotation.value = _rotation_vector_deg(item.pose.rotation)
        self.color.value = tuple(round(255 * value) for value in item.color_srgb)
        self.confidence.value = _shown(item.confidence)

    def edited(self, item: Placed) -> Placed:
        """An object with the fields that the controls show; a field that is as it was keeps all its digits."""
        rotation = item.pose.rotation
        if not np.allclose(self.rotation.value, _rotation_vector_deg(rotation), rtol=0, atol=_ROUNDED_DEG):
            rotation = Rotation.from_rotvec(self.rotation.value, degrees=True).as_matrix()
        confidence = float(self.confidence.value)
        if confidence == _shown(item.confidence):
            confidence = item.confidence
        color = tuple(value / 255 for value in self.color.value)
        if np.allclose(color, item.color_srgb, atol=0.5 / 255):
            color = item.color_srgb
        return Placed(item.kind, Pose(rotation, np.array(self.position.value) / 1000), color, confidence)

    def show_pictures(self, drawn: Comparison) -> None:
        """Show photograph, re-rendering, difference and loss."""
        self._pair.image = np.hstack([drawn.image, drawn.rendering])
        self._difference.image = drawn.difference
        if not drawn.shows_objects:
            self._loss.content = "no image loss: no object is in the picture"
            return
        self._loss.content = f"image loss **{drawn.loss:.4g}** (squared difference, summed over pixels and channels)"

    def show_photograph(self, image: np.ndarray) -> None:
        """Show a photograph that nothing can be compared with."""
        self._pair.image = image
        self._loss.content = "no image loss: nothing was rendered"

    def message(self, text: str) -> None:
        """Say what was done, or what failed."""
        self._message.content = text


def _shown(confidence: float) -> float:
    """A confidence as its control shows it."""
    return round(confidence, 2)


def _rotation_vector_deg(rotation: np.ndarray) -> tuple[float, float, float]:
    return _triple(Rotation.from_matrix(rotation).as_rotvec(degrees=True))


def _triple(values: Sequence[float] | np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
