"""One part of a batch through the renderer: primal image and gradient."""

from dataclasses import replace
from typing import Any

from curio_train.rendering.edge_gradients import Outlines
from curio_train.rendering.instances import Instances
from curio_train.rendering.launch import Hits, Launch, RenderSettings, View
from curio_train.rendering.pixels import PixelSamples


class Pass:
    """One view: what was hit in the forward pass is kept for the backward pass."""

    def __init__(self, settings: RenderSettings, view: View) -> None:
        self.set, self.view = settings, view
        self.mi, self.dr = settings.mi, settings.dr
        self.hits: Hits | None = None

    def image(self, values: Any, background: Any) -> Any:
        """The flat [b, c, h, w] image; keeps what was hit."""
        self.hits = self._trace_pixels(Launch(self.set, self.view, background), self._instances(values))
        return self.relit(values, background)

    def relit(self, values: Any, background: Any) -> Any:
        """The image of what was hit before, with values that differ from those in light, colour and confidence alone.

        Objects do not stand in each other's light here unless it is the light of :meth:`image`.
        """
        dr, instances, launch = self.dr, self._instances(values), Launch(self.set, self.view, background)
        out = dr.opaque(background)  # memory of its own: the background's belongs to torch
        if self.hits:
            location, colors = launch.contributions(instances, self.hits)
            for color, where in zip(colors, launch.planes(location.pixel), strict=True):
                dr.scatter_add(out, color / self.set.samples_per_pixel, where, mode=dr.ReduceMode.Local)
        dr.eval(out)
        return out

    def gradient(self, values: Any, background: Any, image: Any, adjoint: Any) -> Any:
        """Gradient by ``values`` of the scalar product of ``image`` (as :meth:`image` gave it) and ``adjoint``."""
        dr, instances = self.dr, self._instances(values)
        dr.enable_grad(values)
        if self.hits:
            _, value = Launch(self.set, self.view, background).weighed(instances, self.hits, adjoint)
            dr.backward(value / self.set.samples_per_pixel)
        moved = Outlines(self.set, self.view, background).displacement(instances, image, adjoint)
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
            location, _ = self.hits.at(self.hits.lane)
            hidden = self.hits.occlusion.weight(self._instances(values), location, self.hits.record.t)
            hidden /= self.set.samples_per_pixel
            for weight, where in zip(
                launch.channels_at(adjoint, location.pixel), launch.planes(location.pixel), strict=True
            ):
                dr.scatter_add(through, -hidden * weight, where, mode=dr.ReduceMode.Local)
        dr.eval(through)
        return through

    def _instances(self, values: Any) -> Instances:
        return replace(self.view.query.instances(values, self.view.camera), appearance=self.view.appearance)

    def _trace_pixels(self, launch: Launch, instances: Instances) -> Hits | None:
        settings, view = self.set, self.view
        size, area = (settings.width, settings.height), settings.width * settings.height
        key = view.key + self.dr.opaque(self.mi.UInt32, view.images[0] * area)
        samples = PixelSamples(self.mi, self.dr, view.bounds, settings.num_slots, size, settings.samples_per_pixel, key)
        lane = self.dr.arange(self.mi.UInt32, len(samples))
        return launch.trace(instances, lane, samples.at, settings.samples_per_pixel, view.num_images * area)
