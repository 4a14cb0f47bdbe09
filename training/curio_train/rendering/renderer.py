"""Scene codes to images for torch: forward and backward of a whole batch, in a few launches."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.color import linear_from_srgb
from curio_train.errors import RendererError
from curio_train.meshes.meshes import Mesh
from curio_train.meshes.simplification import simplified
from curio_train.rendering.bounds import project_bounds
from curio_train.rendering.edge_sampling import OutlineSampler
from curio_train.rendering.ground import Ground
from curio_train.rendering.instances import INSTANCE_SIZE, VALUES
from curio_train.rendering.launch import RenderSettings, View
from curio_train.rendering.materials import in_object_frame
from curio_train.rendering.parts import build_scene
from curio_train.rendering.passes import Pass
from curio_train.rendering.shadows import GroundShadows, fallen
from curio_train.rendering.tracing import LayerTracer, Objects, RayQuery
from curio_train.rendering.variant import load_mitsuba

MAX_RAYS = 4_000_000
"""Rays traced at once; larger batches are split, with the same result."""
MIN_FACES = 16_384
"""What a mesh may keep in any image; in larger images it is one face a pixel."""


class Renderer:
    """Renders batches of posed meshes over backgrounds, differentiably.

    Shading is albedo · (ambient + max(0, n·l)) in linear colour; samples are encoded to sRGB and composited. The
    gradient of everything that moves has an interior and a silhouette part (see edge_gradients.py).
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
        outline_samples: int = 512,
        object_shadows: bool = False,
    ) -> None:
        """Build the static scene.

        Args:
            meshes: One a kind of object. Those with many more faces than the images have pixels are traced simplified.
            kind_of_slot: Index into ``meshes`` for each slot of the scene code.
            width: Of the images, pixels.
            height: Of the images, pixels.
            ambient: Radiance from everywhere.
            samples_per_pixel: Rays a pixel.
            outline_samples: Points on each object's outline, for the gradient.
            object_shadows: Objects stand in each other's light; the moving border of these shadows has no gradient.

        Raises:
            RendererError: No usable libLLVM, or a mesh that cannot be rendered.
        """
        import drjit

        mitsuba = load_mitsuba()
        static = build_scene(mitsuba, [simplified(mesh, max(MIN_FACES, width * height)) for mesh in meshes])
        if not kind_of_slot or not all(0 <= k < len(meshes) for k in kind_of_slot):
            raise RendererError(f"kind_of_slot is {list(kind_of_slot)}; every slot needs one of {len(meshes)} meshes")
        self.settings = RenderSettings(
            mitsuba,
            drjit,
            LayerTracer(mitsuba, drjit, static.scene, ambient),
            OutlineSampler(mitsuba, drjit, static.edges, kind_of_slot),
            width,
            height,
            len(kind_of_slot),
            samples_per_pixel,
            outline_samples,
            object_shadows,
        )
        placements = [static.placements[k] for k in kind_of_slot]
        self._center = torch.tensor(np.array([p.center_m for p in placements]), dtype=torch.float32)
        self._radius = torch.tensor([p.radius_m for p in placements], dtype=torch.float32)
        self._offset = torch.tensor(np.array([p.offset for p in placements]), dtype=torch.float32)
        self._corners_m = np.array([p.corners_m for p in placements], dtype=np.float32)

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
        appearance: Float[Tensor, "batch slots size"] | None = None,
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
            appearance: Of the surfaces, see materials.py; None: all are dull and smooth.
            seed: Of the jitter within pixels and along outlines.

        Returns:
            sRGB images. Gradients flow to everything but ``camera_matrix``.

        Raises:
            RendererError: The camera matrix has skew or the shapes differ.
        """
        settings = self.settings
        expected = (rotation.shape[0], 3, settings.height, settings.width)
        if tuple(backgrounds.shape) != expected or rotation.shape[1] != settings.num_slots:
            raise RendererError(
                f"rotations {tuple(rotation.shape)} and backgrounds {tuple(backgrounds.shape)} do not fit a renderer "
                f"of {settings.num_slots} slots and {settings.width}x{settings.height} pixels"
            )
        device = rotation.device
        rotation, translation_m, light, color, confidence = _on_host(rotation, translation_m, light, color, confidence)
        instances = self._pack(rotation, translation_m, light, color, confidence)
        corners_m, intrinsics = self._corners(rotation, translation_m), _intrinsics(camera_matrix, len(rotation))
        turned = None if appearance is None else in_object_frame(appearance.cpu(), rotation.detach())
        views = self._views(corners_m, intrinsics, Objects(settings.mi, settings.dr), seed, turned)
        return _Render.apply(instances, backgrounds.cpu(), settings, views).to(device)

    @torch.no_grad()
    def cutouts(
        self,
        rotation: Float[Tensor, "batch slots 3 3"],
        translation_m: Float[Tensor, "batch slots 3"],
        *,
        camera_matrix: np.ndarray,
        lights: Float[Tensor, "lights 3"],
        seed: int = 0,
    ) -> tuple[Float[Tensor, "lights batch 3 height width"], Float[Tensor, "batch 1 height width"]]:
        """Render objects without backgrounds under each of some lights; rays are traced once for all of them.

        Arguments are those of a call, but for the lights, which are the same for all images.

        Returns:
            sRGB over black under each light, and the fraction of each pixel that objects cover. No gradient flows.

        Raises:
            RendererError: The camera matrix has skew, or objects stand in each other's light.
        """
        settings, device = self.settings, rotation.device
        if settings.object_shadows:
            raise RendererError("objects that stand in each other's light are rendered anew for each light")
        rotation, translation_m, lights = _on_host(rotation, translation_m, lights)
        count = len(rotation)
        packed = [self._pack(rotation, translation_m, light.expand(count, 3), None, None) for light in lights]
        corners_m, intrinsics = self._corners(rotation, translation_m), _intrinsics(camera_matrix, count)
        parts = [
            _cutouts_of(Pass(settings, view), packed)
            for view in self._views(corners_m, intrinsics, Objects(settings.mi, settings.dr), seed)
        ]
        colors, alpha = (torch.cat(of_parts, dim=-4) for of_parts in zip(*parts, strict=True))
        return colors.to(device), alpha.to(device)

    def shadows(
        self,
        rotation: Float[Tensor, "batch slots 3 3"],
        translation_m: Float[Tensor, "batch slots 3"],
        *,
        camera_matrix: np.ndarray,
        ground: Ground,
        light: Float[Tensor, "batch 3"],
        confidence: Float[Tensor, "batch slots"] | None = None,
        seed: int = 0,
    ) -> Float[Tensor, "batch 1 height width"]:
        """Fraction of the light that the objects keep from the ground seen in each pixel, see shadows.py.

        Arguments are those of a call; gradients flow to pose, light and confidence. Light from below the ground's
        horizon throws no shadow.

        Raises:
            RendererError: The camera matrix has skew.
        """
        settings, device = self.settings, rotation.device
        rotation, translation_m, light, confidence = _on_host(rotation, translation_m, light, confidence)
        instances = self._pack(rotation, translation_m, light, None, confidence)
        towards = np.repeat(light.detach().numpy(), settings.num_slots, axis=0)
        corners_m = fallen(self._corners(rotation, translation_m), towards, ground)
        query = GroundShadows(settings.mi, settings.dr, ground)
        views = self._views(corners_m, _intrinsics(camera_matrix, len(rotation)), query, seed)
        unshaded = torch.zeros(len(rotation), 1, settings.height, settings.width)
        return _Render.apply(instances, unshaded, settings, views).to(device)

    def _corners(self, rotation: Tensor, translation_m: Tensor) -> np.ndarray:
        """[batch · slots, n, 3], of polytopes around the objects, camera frame."""
        # In numpy: torch would wake its threads for it, and those then spin beside the renderer's.
        rotations, positions_m = (v.detach().numpy() for v in (rotation, translation_m))
        corners_m = self._corners_m @ rotations.swapaxes(-1, -2) + positions_m[:, :, None]
        return np.asarray(corners_m.reshape(-1, *corners_m.shape[2:]))

    def _pack(
        self, rotation: Tensor, translation_m: Tensor, light: Tensor, color: Tensor | None, confidence: Tensor | None
    ) -> Tensor:
        """[batch · slots, INSTANCE_SIZE], in the order of :data:`~curio_train.rendering.instances.VALUES`."""
        batch, slots = rotation.shape[:2]
        transposed = rotation.transpose(-1, -2)
        turned = (transposed @ translation_m[..., None])[..., 0]
        origin = -(turned + self._center) / self._radius[:, None] + self._offset
        matrix = transposed / self._radius[:, None, None]
        light_in_object = (transposed @ light[:, None, :, None])[..., 0]
        albedo = linear_from_srgb(color) if color is not None else torch.ones(batch, slots, 3)
        confidence = confidence if confidence is not None else torch.ones(batch, slots)
        parts = {
            "origin": origin,
            "matrix": matrix.flatten(2),
            "light": light_in_object,
            "albedo": albedo,
            "confidence": confidence[..., None],
        }
        return torch.cat([parts[name] for name in VALUES], dim=-1).reshape(-1, INSTANCE_SIZE)

    def _views(
        self,
        corners_m: np.ndarray,
        intrinsics: np.ndarray,
        query: RayQuery,
        seed: int,
        appearance: Tensor | None = None,
    ) -> list[View]:
        settings, n = self.settings, self.settings.num_slots
        per_instance = np.repeat(intrinsics, n, axis=0)
        bounds = project_bounds(corners_m, per_instance, settings.width, settings.height)
        camera = np.hstack([per_instance, np.tile(self._offset.numpy(), (len(intrinsics), 1))])
        key = settings.dr.opaque(settings.mi.UInt32, seed * 2654435761 & 0xFFFFFFFF)
        num_rays = bounds.num_pixels.reshape(-1, n).sum(1) * settings.samples_per_pixel
        views, first = [], 0
        while first < len(intrinsics):
            last = first + max(1, int(np.searchsorted(np.cumsum(num_rays[first:]), MAX_RAYS, side="right")))
            low, high = first * n, last * n
            part = settings.mi.Float(camera[low:high].ravel())
            own = None if appearance is None else settings.mi.Float(appearance.flatten(0, 1)[low:high].numpy().ravel())
            views.append(View((first, last), query, bounds.part(low, high), part, key, own))
            first = last
        return views


class _Render(torch.autograd.Function):
    """The bridge between torch and Dr.Jit: whole arrays of the host, once each way a view."""

    @staticmethod
    def forward(
        ctx: Any, instances: Tensor, backgrounds: Tensor, settings: RenderSettings, views: list[View]
    ) -> Tensor:
        ctx.settings, ctx.passes = settings, [Pass(settings, view) for view in views]
        parts = []
        for part, (values, background) in zip(ctx.passes, _parts(ctx, instances, backgrounds), strict=True):
            parts.append(_tensor(part.image(values, background), (-1, *backgrounds.shape[1:])))
        images = torch.cat(parts) if len(parts) > 1 else parts[0]
        ctx.save_for_backward(instances, backgrounds, images)
        return images

    @staticmethod
    def backward(ctx: Any, adjoint: Tensor) -> tuple[Tensor, Tensor | None, None, None]:
        instances, *images = ctx.saved_tensors
        gradients, behind = [], []
        for part, arrays in zip(ctx.passes, _parts(ctx, instances, *images, adjoint), strict=True):
            gradients.append(_tensor(part.gradient(*arrays), (-1, INSTANCE_SIZE)))
            if ctx.needs_input_grad[1]:
                values, background, _, weights = arrays
                through = part.gradient_of_background(values, background, weights)
                behind.append(_tensor(through, (-1, *adjoint.shape[1:])))
        return torch.cat(gradients).to(instances), torch.cat(behind).to(adjoint) if behind else None, None, None


def _cutouts_of(part: Pass, packed: list[Tensor]) -> tuple[Tensor, Tensor]:
    """One view's colours over black, and coverage, of the instances of all views under each light."""
    settings, (first, last) = part.set, part.view.images
    shape = (last - first, 3, settings.height, settings.width)
    black, full = (torch.full(shape, shade).view(-1) for shade in (0.0, 1.0))
    background, everything = settings.mi.Float(black), settings.mi.Float(full)
    n, colors = settings.num_slots, []
    for number, instances in enumerate(packed):
        values = settings.mi.Float(instances[first * n : last * n].contiguous().view(-1))
        colors.append(_tensor((part.relit if number else part.image)(values, background), shape))
    through = _tensor(part.gradient_of_background(values, background, everything), shape)
    return torch.stack(colors), 1 - through[:, :1]


def _parts(ctx: Any, instances: Tensor, *images: Tensor) -> Iterator[list[Any]]:
    """Each view's instances and images as flat Dr.Jit arrays."""
    for part in ctx.passes:
        first, last = part.view.images
        n = ctx.settings.num_slots
        tensors = [instances[first * n : last * n], *(image[first:last] for image in images)]
        yield [ctx.settings.mi.Float(t.detach().float().contiguous().view(-1)) for t in tensors]


def _tensor(array: Any, shape: tuple[int, ...]) -> Tensor:
    return torch.from_numpy(array.numpy()).view(shape)


def _on_host(*tensors: Any) -> list[Any]:
    """Float32 on the CPU, from where Dr.Jit takes arrays whatever its variant; None stays None."""
    return [None if tensor is None else tensor.float().cpu() for tensor in tensors]


def _intrinsics(camera_matrix: np.ndarray, batch: int) -> np.ndarray:
    """float32 [batch, 4]: fx, fy, cx, cy."""
    k = np.broadcast_to(np.asarray(camera_matrix, dtype=np.float64), (batch, 3, 3))
    if np.any(k[:, 0, 1]):
        raise RendererError(f"camera matrix with skew {k[0, 0, 1]}: only pinhole cameras without skew are rendered")
    return k[:, [0, 1, 0, 1], [0, 1, 2, 2]].astype(np.float32)
