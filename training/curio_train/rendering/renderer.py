"""Scene codes to images for torch: forward and backward of a whole batch, in a few launches."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.data.meshes import Mesh
from curio_train.errors import RendererError
from curio_train.rendering.compositing import composite, gather_layer
from curio_train.rendering.layers import ROW_SIZE, Layer, LayerTracer, Rows, rows_from
from curio_train.rendering.pixels import PixelList, list_pixels
from curio_train.rendering.scene import build_scene
from curio_train.rendering.silhouettes import OFFSET_PX, OutlineSampler, OutlineSamples
from curio_train.rendering.variant import Variant, load_mitsuba

MAX_RAYS = 4_000_000
"""Rays traced at once; larger batches are split, with the same result."""


@dataclass(frozen=True)
class _View:
    """The part of a batch that is traced at once.

    Attributes:
        images: First and last + 1 image.
        pixels: Pixels traced, all rows.
        intrinsics: float32 [rows, 4]: fx, fy, cx, cy.
    """

    images: tuple[int, int]
    pixels: PixelList
    intrinsics: np.ndarray


class Renderer:
    """Renders batches of posed meshes over backgrounds, differentiably.

    Shading is albedo · (ambient + max(0, n·l)) in linear colour; samples are encoded to sRGB and composited. The
    gradient of everything that moves has an interior and a silhouette part (see silhouettes.py).
    """

    def __init__(
        self,
        meshes: Sequence[Mesh],
        kind_of_slot: Sequence[int],
        width: int,
        height: int,
        *,
        ambient: float,
        samples_per_pixel: int = 4,
        outline_samples: int = 256,
        variant: Variant = "llvm_ad_rgb",
    ) -> None:
        """Build the static scene.

        Args:
            meshes: One a kind of object.
            kind_of_slot: Index into ``meshes`` for each slot of the scene code.
            width: Of the images, pixels.
            height: Of the images, pixels.
            ambient: Radiance from everywhere.
            samples_per_pixel: Rays a pixel.
            outline_samples: Points on each object's outline, for the gradient.
            variant: See variant.py.

        Raises:
            RendererError: No usable libLLVM, or a mesh that cannot be rendered.
        """
        import drjit

        self._mi, self._dr = load_mitsuba(variant), drjit
        if not kind_of_slot or not all(0 <= k < len(meshes) for k in kind_of_slot):
            raise RendererError(f"kind_of_slot is {list(kind_of_slot)}; every slot needs one of {len(meshes)} meshes")
        self.width, self.height = width, height
        self.num_slots = len(kind_of_slot)
        self.samples_per_pixel, self.outline_samples = samples_per_pixel, outline_samples
        static = build_scene(self._mi, meshes)
        self._tracer = LayerTracer(self._mi, drjit, static.scene, ambient)
        self._outlines = OutlineSampler(self._mi, drjit, static.edges, kind_of_slot)
        placements = [static.placements[k] for k in kind_of_slot]
        self._center = torch.tensor(np.array([p.center_m for p in placements]), dtype=torch.float32)
        self._radius = torch.tensor([p.radius_m for p in placements], dtype=torch.float32)
        self._offset = torch.tensor(np.array([p.offset for p in placements]), dtype=torch.float32)

    def __call__(
        self,
        rotation: Float[Tensor, "batch slots 3 3"],
        translation_m: Float[Tensor, "batch slots 3"],
        *,
        camera_matrix: np.ndarray,
        backgrounds: Float[Tensor, "batch 3 height width"],
        light: Float[Tensor, "batch 3"],
        color: Float[Tensor, "batch slots 3"] | None = None,
        confidence: Float[Tensor, "batch slots"] | None = None,
        seed: int = 0,
    ) -> Float[Tensor, "batch 3 height width"]:
        """Render a batch.

        Args:
            rotation: cam_from_obj.
            translation_m: cam_from_obj, OpenCV camera frame.
            camera_matrix: K, [3, 3] or one an image [batch, 3, 3]; pixel centres at integers.
            backgrounds: sRGB in [0, 1].
            light: Camera frame, towards the light; its length is the strength.
            color: sRGB albedo that multiplies the mesh's own; None: 1.
            confidence: In [0, 1]; None: 1.
            seed: Of the jitter within pixels and along outlines.

        Returns:
            sRGB images. Gradients flow to everything but ``camera_matrix`` and ``backgrounds``.

        Raises:
            RendererError: The camera matrix has skew or the shapes differ.
        """
        batch = rotation.shape[0]
        if tuple(backgrounds.shape) != (batch, 3, self.height, self.width) or rotation.shape[1] != self.num_slots:
            raise RendererError(
                f"rotations {tuple(rotation.shape)} and backgrounds {tuple(backgrounds.shape)} do not fit a renderer of "
                f"{self.num_slots} slots and {self.width}x{self.height} pixels"
            )
        rows = self._pack(rotation, translation_m, light, color, confidence)
        centers = torch.einsum("bnij,nj->bni", rotation, self._center) + translation_m
        views = self._views(centers.detach().reshape(-1, 3).numpy(), _intrinsics(camera_matrix, batch))
        return _Render.apply(rows, backgrounds, self, views, seed)

    def _pack(
        self, rotation: Tensor, translation_m: Tensor, light: Tensor, color: Tensor | None, confidence: Tensor | None
    ) -> Tensor:
        """[batch · slots, 19], the columns of :class:`Rows`."""
        batch, slots = rotation.shape[:2]
        transposed = rotation.transpose(-1, -2)
        turned = (transposed @ translation_m[..., None])[..., 0]
        origin = -(turned + self._center) / self._radius[:, None] + self._offset
        matrix = transposed / self._radius[:, None, None]
        light_in_object = (transposed @ light[:, None, :, None])[..., 0]
        albedo = linear_from_srgb(color) if color is not None else torch.ones(batch, slots, 3)
        confidence = confidence if confidence is not None else torch.ones(batch, slots)
        parts = [origin, matrix.flatten(2), light_in_object, albedo, confidence[..., None]]
        return torch.cat(parts, dim=-1).reshape(-1, ROW_SIZE)

    def _views(self, centers_m: np.ndarray, intrinsics: np.ndarray) -> list[_View]:
        n = self.num_slots
        radii = np.tile(self._radius.numpy(), len(intrinsics))
        per_row = np.repeat(intrinsics, n, axis=0)
        pixels = list_pixels(centers_m, radii, per_row, n, self.width, self.height)
        image = pixels.row // np.uint32(n)
        counts = np.bincount(image, minlength=len(intrinsics)) * self.samples_per_pixel
        views, first = [], 0
        while first < len(intrinsics):
            total = np.cumsum(counts[first:])
            last = first + max(1, int(np.searchsorted(total, MAX_RAYS, side="right")))
            low, high = np.searchsorted(image, [first, last])
            part = PixelList(
                pixels.row[low:high] - np.uint32(first * n),
                pixels.x[low:high],
                pixels.y[low:high],
                pixels.index[low:high] - np.uint32(first * self.width * self.height),
            )
            views.append(_View((first, last), part, per_row[first * n : last * n]))
            first = last
        return views


class _Pass:
    """One view's samples: built in the forward pass, kept (with the faces hit) for the backward pass."""

    def __init__(self, renderer: Renderer, view: _View, seed: int) -> None:
        self.r, self.view, self.seed = renderer, view, seed
        self.mi, self.dr = renderer._mi, renderer._dr
        mi, pixels = self.mi, view.pixels
        self.row, self.pixel = mi.UInt32(pixels.row), mi.UInt32(pixels.index)
        self.x, self.y = mi.Float(pixels.x), mi.Float(pixels.y)
        self.intrinsics = [mi.Float(np.ascontiguousarray(c)) for c in view.intrinsics.T]
        self.num_images = view.images[1] - view.images[0]
        self.lookup: Any = None
        if renderer.num_slots > 1:
            self._build_lookup(pixels)
        self.hit: Any = None

    def _build_lookup(self, pixels: PixelList) -> None:
        """For every pixel that any slot touches: which entry of the pixel list belongs to each slot."""
        n, area = self.r.num_slots, self.r.width * self.r.height
        table = np.full((n, self.num_images * area), -1, dtype=np.int32)
        table[pixels.row % np.uint32(n), pixels.index] = np.arange(len(pixels.row), dtype=np.int32)
        touched = np.flatnonzero((table >= 0).any(0)).astype(np.uint32)
        self.lookup = [self.mi.Int32(table[slot, touched]) for slot in range(n)]
        self.pixel_of_ray, self.pixel = self.pixel, self.mi.UInt32(touched)

    def sample_colors(self, rows: Rows, background: Any) -> list[Any]:
        """sRGB of every sample (pixels x samples), 3 arrays; ``background`` is the flat [b, 3, h, w] array."""
        mi, dr, spp = self.mi, self.dr, self.r.samples_per_pixel
        pixel_of_ray = self.pixel if self.lookup is None else self.pixel_of_ray
        lane = dr.arange(mi.UInt32, len(self.row) * spp)
        source = lane // spp
        row = dr.gather(mi.UInt32, self.row, source)
        dx, dy = self._direction(dr.gather(mi.UInt32, pixel_of_ray, source), lane - source * spp, source, row)
        ray = self.r._tracer.rays(rows, row, dx, dy)
        if self.hit is None:
            self.hit = self.r._tracer.intersect(ray)
        layer = self.r._tracer.shade(rows, row, ray, self.hit)
        layers = [layer]
        if self.lookup is not None:
            dr.eval(layer.alpha, layer.depth_m, layer.rgb, self.hit)
            sample = dr.arange(mi.UInt32, len(self.pixel) * spp)
            source = sample // spp
            layers = [self._slot_layer(layer, entries, source, sample - source * spp) for entries in self.lookup]
        return composite(dr, layers, self._at_pixels(background, dr.gather(mi.UInt32, self.pixel, source)))

    def _slot_layer(self, layer: Layer, entries: Any, source: Any, sample: Any) -> Layer:
        entry = self.dr.gather(self.mi.Int32, entries, source)
        ray = self.mi.UInt32(self.dr.maximum(entry, 0)) * self.r.samples_per_pixel + sample
        return gather_layer(self.dr, layer, ray, entry >= 0)

    def _direction(self, pixel: Any, sample: Any, source: Any, row: Any) -> tuple[Any, Any]:
        """Camera direction (dx, dy, 1) of a jittered sample; the same for all slots at a pixel."""
        mi, dr = self.mi, self.dr
        grid = int(self.r.samples_per_pixel**0.5)
        stratified = grid * grid == self.r.samples_per_pixel
        first = self.view.images[0] * self.r.width * self.r.height
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
        area = self.r.width * self.r.height
        first = pixel + (pixel // area) * (2 * area)
        return [first + channel * area for channel in range(3)]

    def image(self, rows: Rows, background: Any) -> Any:
        """The flat [b, 3, h, w] image; keeps the faces hit."""
        dr, spp = self.dr, self.r.samples_per_pixel
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
        dr, spp = self.dr, self.r.samples_per_pixel
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
        num_rows = self.num_images * self.r.num_slots
        rng = np.random.default_rng((self.seed, self.view.images[0]))
        jitter = rng.random((num_rows, self.r.outline_samples))
        points = self.r._outlines.sample(rows, self.intrinsics, jitter)
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
        sums = [dr.block_sum(value, self.r.outline_samples) for value in by_origin + by_matrix]
        return np.stack([value.numpy() for value in sums], axis=1)

    def _force(self, rows: Rows, points: OutlineSamples, background: Any, adjoint: Any) -> list[Any]:
        """Gradient by the camera-frame position of each outline point: jump · adjoint · normal through the projection."""
        mi, dr = self.mi, self.dr
        width, height = self.r.width, self.r.height
        column, line = dr.floor(points.x + 0.5), dr.floor(points.y + 0.5)
        inside = (column >= 0) & (column < width) & (line >= 0) & (line < height) & (points.weight > 0)
        image = points.row // self.r.num_slots
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
        dr, slots = self.dr, self.r.num_slots
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
        tracer = self.r._tracer
        ray = tracer.rays(rows, row, dx, dy)
        return tracer.shade(rows, row, ray, tracer.intersect(ray, active))


class _Render(torch.autograd.Function):
    """The bridge between torch and Dr.Jit: whole arrays, once each way a view."""

    @staticmethod
    def forward(
        ctx: Any, rows: Tensor, backgrounds: Tensor, renderer: Renderer, views: list[_View], seed: int
    ) -> Tensor:
        ctx.renderer = renderer
        ctx.passes = [_Pass(renderer, view, seed) for view in views]
        ctx.save_for_backward(rows, backgrounds)
        images = torch.empty_like(backgrounds, dtype=torch.float32, memory_format=torch.contiguous_format)
        with renderer._dr.suspend_grad():
            for part in ctx.passes:
                low, high = part.view.images
                image = part.image(
                    rows_from(_columns(renderer, rows, part.view)), _flat(renderer, backgrounds[low:high])
                )
                images[low:high] = torch.from_numpy(image.numpy()).reshape(high - low, *backgrounds.shape[1:])
        return images

    @staticmethod
    def backward(ctx: Any, adjoint: Tensor) -> tuple[Tensor, None, None, None, None]:
        rows, backgrounds = ctx.saved_tensors
        renderer = ctx.renderer
        parts = []
        for part in ctx.passes:
            low, high = part.view.images
            columns = _columns(renderer, rows, part.view)
            parts.append(
                part.gradient(columns, _flat(renderer, backgrounds[low:high]), _flat(renderer, adjoint[low:high]))
            )
        return torch.from_numpy(np.nan_to_num(np.concatenate(parts))).to(rows), None, None, None, None


def _columns(renderer: Renderer, rows: Tensor, view: _View) -> list[Any]:
    low, high = (i * renderer.num_slots for i in view.images)
    values = rows[low:high].detach().float().cpu().numpy()
    return [renderer._mi.Float(np.ascontiguousarray(column)) for column in values.T]


def _flat(renderer: Renderer, images: Tensor) -> Any:
    return renderer._mi.Float(images.detach().float().contiguous().cpu().numpy().ravel())


def _intrinsics(camera_matrix: np.ndarray, batch: int) -> np.ndarray:
    """float32 [batch, 4]: fx, fy, cx, cy."""
    k = np.broadcast_to(np.asarray(camera_matrix, dtype=np.float64), (batch, 3, 3))
    if np.any(k[:, 0, 1]):
        raise RendererError(f"camera matrix with skew {k[0, 0, 1]}: only pinhole cameras without skew are rendered")
    return k[:, [0, 1, 0, 1], [0, 1, 2, 2]].astype(np.float32)


def linear_from_srgb(srgb: Tensor) -> Tensor:
    """Decode sRGB (IEC 61966-2-1) to linear light, differentiably; values are clipped to [0, 1]."""
    srgb = srgb.clamp(0, 1)
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb.clamp(min=0.04) + 0.055) / 1.055) ** 2.4)
