"""One part of a batch through the renderer: primal image, interior gradient, outline gradient."""

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from curio_train.rendering.compositing import composite, gather_layer
from curio_train.rendering.layers import ROW_SIZE, Layer, LayerTracer, Rows, rows_from
from curio_train.rendering.pixels import PixelList
from curio_train.rendering.silhouettes import OFFSET_PX, OutlineSampler, OutlineSamples


@dataclass(frozen=True)
class Setting:
    """What all passes of a renderer share.

    Attributes:
        mi: Mitsuba.
        dr: Dr.Jit.
        tracer: Traces and shades rays.
        outlines: Finds and samples silhouettes.
        width: Of the images, pixels.
        height: Of the images, pixels.
        num_slots: Objects an image.
        samples_per_pixel: Rays a pixel and slot.
        outline_samples: Points on each object's outline.
    """

    mi: ModuleType
    dr: ModuleType
    tracer: LayerTracer
    outlines: OutlineSampler
    width: int
    height: int
    num_slots: int
    samples_per_pixel: int
    outline_samples: int


@dataclass(frozen=True)
class View:
    """The part of a batch that is traced at once.

    Attributes:
        images: First and last + 1 image.
        pixels: Pixels traced, all rows.
        intrinsics: float32 [rows, 4]: fx, fy, cx, cy.
    """

    images: tuple[int, int]
    pixels: PixelList
    intrinsics: np.ndarray


class Pass:
    """One view's samples: built in the forward pass, kept (with the faces hit) for the backward pass."""

    def __init__(self, setting: Setting, view: View, seed: int) -> None:
        self.set, self.view, self.seed = setting, view, seed
        self.mi, self.dr = setting.mi, setting.dr
        mi, pixels = self.mi, view.pixels
        self.row, self.pixel = mi.UInt32(pixels.row), mi.UInt32(pixels.index)
        self.x, self.y = mi.Float(pixels.x), mi.Float(pixels.y)
        self.intrinsics = [mi.Float(np.ascontiguousarray(c)) for c in view.intrinsics.T]
        self.num_images = view.images[1] - view.images[0]
        self.lookup: Any = None
        if setting.num_slots > 1:
            self._build_lookup(pixels)
        self.hit: Any = None

    def _build_lookup(self, pixels: PixelList) -> None:
        """For every pixel that any slot touches: which entry of the pixel list belongs to each slot."""
        n, area = self.set.num_slots, self.set.width * self.set.height
        table = np.full((n, self.num_images * area), -1, dtype=np.int32)
        table[pixels.row % np.uint32(n), pixels.index] = np.arange(len(pixels.row), dtype=np.int32)
        touched = np.flatnonzero((table >= 0).any(0)).astype(np.uint32)
        self.lookup = [self.mi.Int32(table[slot, touched]) for slot in range(n)]
        self.pixel_of_ray, self.pixel = self.pixel, self.mi.UInt32(touched)

    def sample_colors(self, rows: Rows, background: Any) -> list[Any]:
        """Colour of every sample (pixels x samples), 3 sRGB arrays; ``background`` is the flat [b, 3, h, w] array."""
        mi, dr, spp = self.mi, self.dr, self.set.samples_per_pixel
        pixel_of_ray = self.pixel if self.lookup is None else self.pixel_of_ray
        lane = dr.arange(mi.UInt32, len(self.row) * spp)
        source = lane // spp
        row = dr.gather(mi.UInt32, self.row, source)
        dx, dy = self._direction(dr.gather(mi.UInt32, pixel_of_ray, source), lane - source * spp, source, row)
        ray = self.set.tracer.rays(rows, row, dx, dy)
        if self.hit is None:
            self.hit = self.set.tracer.intersect(ray)
        layer = self.set.tracer.shade(rows, row, ray, self.hit)
        layers = [layer]
        if self.lookup is not None:
            dr.eval(layer.alpha, layer.depth_m, layer.rgb, self.hit)
            sample = dr.arange(mi.UInt32, len(self.pixel) * spp)
            source = sample // spp
            layers = [self._slot_layer(layer, entries, source, sample - source * spp) for entries in self.lookup]
        return composite(dr, layers, self._at_pixels(background, dr.gather(mi.UInt32, self.pixel, source)))

    def _slot_layer(self, layer: Layer, entries: Any, source: Any, sample: Any) -> Layer:
        entry = self.dr.gather(self.mi.Int32, entries, source)
        ray = self.mi.UInt32(self.dr.maximum(entry, 0)) * self.set.samples_per_pixel + sample
        return gather_layer(self.dr, layer, ray, entry >= 0)

    def _direction(self, pixel: Any, sample: Any, source: Any, row: Any) -> tuple[Any, Any]:
        """Camera direction (dx, dy, 1) of a jittered sample; the same for all slots at a pixel."""
        mi, dr = self.mi, self.dr
        grid = int(self.set.samples_per_pixel**0.5)
        stratified = grid * grid == self.set.samples_per_pixel
        first = self.view.images[0] * self.set.width * self.set.height
        key = dr.opaque(mi.UInt32, (self.seed * 2654435761 + first) & 0xFFFFFFFF)
        u, v = (mi.Float(a) * 2.0**-32 for a in mi.sample_tea_32(pixel + key, sample))
        if stratified:
            u, v = (u + mi.Float(sample % grid)) / grid, (v + mi.Float(sample // grid)) / grid
        fx, fy, cx, cy = (dr.gather(mi.Float, c, row) for c in self.intrinsics)
        x, y = dr.gather(mi.Float, self.x, source), dr.gather(mi.Float, self.y, source)
        return (x + u - 0.5 - cx) / fx, (y + v - 0.5 - cy) / fy

    def _at_pixels(self, flat: Any, pixel: Any, active: Any = True) -> list[Any]:
        """The three channels of a flat [b, 3, h, w] array at pixels."""
        return [self.dr.gather(self.mi.Float, flat, i, active) for i in self._planes(pixel)]

    def _planes(self, pixel: Any) -> list[Any]:
        area = self.set.width * self.set.height
        first = pixel + (pixel // area) * (2 * area)
        return [first + channel * area for channel in range(3)]

    def image(self, rows: Rows, background: Any) -> Any:
        """The flat [b, 3, h, w] image; keeps the faces hit."""
        dr, spp = self.dr, self.set.samples_per_pixel
        out = self.mi.Float(background)
        if len(self.row) == 0:
            return out
        colors = self.sample_colors(rows, background)
        dr.eval(colors, self.hit)
        for color, where in zip(colors, self._planes(self.pixel), strict=True):
            dr.scatter(out, dr.block_sum(color, spp) / spp, where)
        dr.eval(out)
        return out

    def gradient(self, columns: list[Any], background: Any, adjoint: Any) -> np.ndarray:
        """Gradient [rows, 19] of the scalar product of image and ``adjoint``."""
        dr, spp = self.dr, self.set.samples_per_pixel
        if len(self.row) == 0:
            return np.zeros((len(columns[0]), ROW_SIZE), dtype=np.float32)
        dr.enable_grad(columns)
        colors = self.sample_colors(rows_from(columns), background)
        lane = dr.arange(self.mi.UInt32, len(self.pixel) * spp)
        weights = self._at_pixels(adjoint, dr.gather(self.mi.UInt32, self.pixel, lane // spp))
        dr.backward(sum(c * w for c, w in zip(colors, weights, strict=True)) / spp)
        interior = [dr.grad(column) for column in columns]
        dr.disable_grad(columns)
        total = np.stack([column.numpy() for column in interior], axis=1)
        total[:, :12] += self._outline_gradient(rows_from(columns), background, adjoint)
        return total

    def _outline_gradient(self, rows: Rows, background: Any, adjoint: Any) -> np.ndarray:
        """[rows, 12]: the silhouette part, by origin and matrix."""
        dr = self.dr
        num_rows = self.num_images * self.set.num_slots
        rng = np.random.default_rng((self.seed, self.view.images[0]))
        jitter = rng.random((num_rows, self.set.outline_samples))
        points = self.set.outlines.sample(rows, self.intrinsics, jitter)
        if points is None:
            return np.zeros((num_rows, 12), dtype=np.float32)
        force = self._force(rows, points, background, adjoint)
        m = [dr.gather(self.mi.Float, v, points.row) for v in rows.matrix]
        scale = 1 / (dr.square(m[0]) + dr.square(m[1]) + dr.square(m[2]))
        arm = points.scene_point - self.mi.Vector3f(*[dr.gather(self.mi.Float, v, points.row) for v in rows.origin])
        # q = s² Mᵀ (p − o), hence ∂L/∂o = −s² M g and ∂L/∂M = s² (p − o) gᵀ for the force g on q.
        by_origin = [
            -scale * (m[3 * i] * force[0] + m[3 * i + 1] * force[1] + m[3 * i + 2] * force[2]) for i in range(3)
        ]
        by_matrix = [scale * arm[i] * force[j] for i in range(3) for j in range(3)]
        dr.eval(by_origin, by_matrix)
        sums = [dr.block_sum(value, self.set.outline_samples) for value in by_origin + by_matrix]
        return np.stack([value.numpy() for value in sums], axis=1)

    def _force(self, rows: Rows, points: OutlineSamples, background: Any, adjoint: Any) -> list[Any]:
        """Gradient by each outline point's camera-frame position: jump · adjoint · normal, through the projection."""
        mi, dr = self.mi, self.dr
        width, height = self.set.width, self.set.height
        column, line = dr.floor(points.x + 0.5), dr.floor(points.y + 0.5)
        inside = (column >= 0) & (column < width) & (line >= 0) & (line < height) & (points.weight > 0)
        image = points.row // self.set.num_slots
        pixel = dr.select(
            inside, (image * height + mi.UInt32(dr.maximum(line, 0))) * width + mi.UInt32(dr.maximum(column, 0)), 0
        )
        behind = self._at_pixels(background, pixel, inside)
        minus, plus = self._both_sides(rows, points, behind, inside)
        weights = self._at_pixels(adjoint, pixel, inside)
        jump = sum((a - b) * w for a, b, w in zip(minus, plus, weights, strict=True))
        push = dr.select(inside, jump * points.weight, 0)
        fx, fy = (dr.gather(mi.Float, v, points.row) for v in self.intrinsics[:2])
        q = points.camera_point
        gx, gy = push * points.normal_x * fx / q.z, push * points.normal_y * fy / q.z
        return [gx, gy, -(gx * q.x + gy * q.y) / q.z]

    def _both_sides(
        self, rows: Rows, points: OutlineSamples, behind: list[Any], active: Any
    ) -> tuple[list[Any], list[Any]]:
        """Composited colour a little to either side of the outline; other slots are seen at the outline itself."""
        dr, slots = self.dr, self.set.num_slots
        image = points.row // slots
        own = points.row - image * slots
        others = [self._layer_at(rows, points, image * slots + (own + k) % slots, 0.0, active) for k in range(1, slots)]
        sides = []
        for offset in (-OFFSET_PX, OFFSET_PX):
            layers = [self._layer_at(rows, points, points.row, offset, active), *others]
            sides.append(composite(dr, layers, behind))
        return sides[0], sides[1]

    def _layer_at(self, rows: Rows, points: OutlineSamples, row: Any, offset_px: float, active: Any) -> Layer:
        fx, fy, cx, cy = (self.dr.gather(self.mi.Float, v, points.row) for v in self.intrinsics)
        dx = (points.x + offset_px * points.normal_x - cx) / fx
        dy = (points.y + offset_px * points.normal_y - cy) / fy
        tracer = self.set.tracer
        ray = tracer.rays(rows, row, dx, dy)
        return tracer.shade(rows, row, ray, tracer.intersect(ray, active))
