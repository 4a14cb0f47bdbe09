"""One part of a batch through the renderer: primal image and gradient."""

from dataclasses import replace
from typing import Any

from curio_train.rendering.edge_gradients import Outlines
from curio_train.rendering.instances import Instances
from curio_train.rendering.launch import Hits, Launch, RenderSettings, View
from curio_train.rendering.pixels import PixelSamples


class Pass:
    """One view: what was hit in the forward pass is kept for the backward pass."""

    def __init__(self, setting: RenderSettings, view: View) -> None:
        self.set, self.view = setting, view
        self.mi, self.dr = setting.mi, setting.dr
        self.hits: Hits | None = None

    def image(self, values: Any, background: Any) -> Any:
        """The flat [b, c, h, w] image; keeps what was hit."""
        dr, rows, launch = self.dr, self._rows(values), Launch(self.set, self.view, background)
        self.hits = self._trace_pixels(launch, rows)
        out = dr.opaque(background)  # memory of its own: the background's belongs to torch
        if self.hits:
            place, colors = launch.contributions(rows, self.hits)
            for color, where in zip(colors, launch.planes(place.pixel), strict=True):
                dr.scatter_add(out, color / self.set.samples_per_pixel, where, mode=dr.ReduceMode.Local)
        dr.eval(out)
        return out

    def gradient(self, values: Any, background: Any, image: Any, adjoint: Any) -> Any:
        """Gradient by ``values`` of the scalar product of ``image`` (as :meth:`image` gave it) and ``adjoint``."""
        dr, rows = self.dr, self._rows(values)
        dr.enable_grad(values)
        if self.hits:
            _, value = Launch(self.set, self.view, background).weighed(rows, self.hits, adjoint)
            dr.backward(value / self.set.samples_per_pixel)
        moved = Outlines(self.set, self.view, background).displacement(rows, image, adjoint)
        if moved is not None:
            dr.backward(moved)
        gradient = dr.grad(values)
        dr.disable_grad(values)
        dr.eval(gradient)
        return gradient

    def gradient_of_background(self, values: Any, background: Any, adjoint: Any) -> Any:
        """Gradient by ``background``: the adjoint where and as far as the background is seen."""
        dr, launch = self.dr, Launch(self.set, self.view, background)
        through = dr.opaque(adjoint)
        if self.hits:
            place, _ = self.hits.at(self.hits.lane)
            hidden = self.hits.occlusion.weight(self._rows(values), place, self.hits.record.t)
            hidden /= self.set.samples_per_pixel
            for weight, where in zip(launch.look(adjoint, place.pixel), launch.planes(place.pixel), strict=True):
                dr.scatter_add(through, -hidden * weight, where, mode=dr.ReduceMode.Local)
        dr.eval(through)
        return through

    def _rows(self, values: Any) -> Instances:
        return replace(self.view.sight.rows(values, self.view.camera), finish=self.view.finish)

    def _trace_pixels(self, launch: Launch, rows: Instances) -> Hits | None:
        setting, view = self.set, self.view
        size, area = (setting.width, setting.height), setting.width * setting.height
        key = view.key + self.dr.opaque(self.mi.UInt32, view.images[0] * area)
        samples = PixelSamples(self.mi, self.dr, view.bounds, setting.num_slots, size, setting.samples_per_pixel, key)
        lane = self.dr.arange(self.mi.UInt32, len(samples))
        return launch.trace(rows, lane, samples.at, setting.samples_per_pixel, view.num_images * area)
