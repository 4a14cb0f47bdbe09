"""What objects are seen in front of: a folder of photographs, or clutter of our own making.

Own clutter is rendered like everything else: coloured noise for a wall or a desk with prints and tiles on it, then
heaps of simple shapes with random patterns and light. It needs no download, nobody holds rights in it, and what is
trained over it may be shipped.
"""

import dataclasses
import hashlib
import json
import os
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from curio_train.data.clutter import dead_leaves_texture
from curio_train.data.photographs import Photographs
from curio_train.errors import DataError
from curio_train.geometry import random_rotations
from curio_train.meshes.meshes import Mesh
from curio_train.meshes.shapes import box, capsule, cone, sphere
from curio_train.rendering.renderer import Renderer

POOL_SIZE = 240
POOL_WIDTH, POOL_HEIGHT = 320, 240
CLUTTER_LAYERS = 3  # of NUM_SLOTS shapes each, one over the other
NUM_SLOTS = 8
_SEED = 20211


class Backgrounds(ABC):
    """A source of background images."""

    @abstractmethod
    def split(self, train: bool) -> "Backgrounds":
        """Four fifths of the sources for training, or the others for tests."""

    def of_crops(self, least: float, largest: float) -> "Backgrounds":
        """Views behind crops that span these fractions of a frame's width; the same where views are of any scale."""
        return self

    @abstractmethod
    def draw(self, count: int, width: int, height: int, seed: tuple[int, ...]) -> Float[Tensor, "count 3 height width"]:
        """Random views in sRGB [0, 1]; the same seed gives the same ones."""


class PhotographBackgrounds(Backgrounds):
    """Random crops of the photographs in a folder."""

    def __init__(self, photographs: Photographs) -> None:
        self._photographs = photographs

    def split(self, train: bool) -> "PhotographBackgrounds":
        return PhotographBackgrounds(self._photographs.subset(_share(len(self._photographs), train)))

    def draw(self, count: int, width: int, height: int, seed: tuple[int, ...]) -> Tensor:
        random = np.random.default_rng(seed)
        crops = [self._photographs.random_crop(width, height, random) for _ in range(count)]
        return torch.from_numpy(np.stack(crops)).permute(0, 3, 1, 2).float() / 255


class ClutterBackgrounds(Backgrounds):
    """Random crops of a pool of rendered clutter, drawn once and cached."""

    def __init__(self, pool: np.ndarray) -> None:
        self._pool = pool

    @classmethod
    def cached(cls, cache: Path, others: Sequence[Mesh] = ()) -> "ClutterBackgrounds":
        """Render the pool, or find it in the cache.

        Args:
            cache: Folder.
            others: Objects that may lie about where the one looked for lies, such as a data set's other ones: what a
                detector must not take for it.

        Raises:
            DataError: The cache folder cannot be written, or the file in it is damaged.
        """
        names = [mesh.sha256 for mesh in others]
        recipe = json.dumps([POOL_SIZE, POOL_WIDTH, POOL_HEIGHT, CLUTTER_LAYERS, NUM_SLOTS, _SEED, "v3", *names])
        path = cache.expanduser() / f"clutter-{hashlib.sha256(recipe.encode()).hexdigest()[:16]}.npy"
        if not path.is_file():
            _make_folder(path.parent)  # before half a minute is spent on the pictures
            _save(path, render_pool(POOL_SIZE, _SEED, others))
        try:
            return cls(np.load(path, mmap_mode="r"))
        except (OSError, ValueError, EOFError) as exc:
            raise DataError(f"{path}: the rendered clutter is damaged ({exc}); remove the file") from exc

    def split(self, train: bool) -> "ClutterBackgrounds":
        return ClutterBackgrounds(self._pool[_share(len(self._pool), train)])

    def draw(self, count: int, width: int, height: int, seed: tuple[int, ...]) -> Tensor:
        random = np.random.default_rng(seed)
        crops = [self._crop(width, height, random) for _ in range(count)]
        return torch.from_numpy(np.stack(crops)).permute(0, 3, 1, 2).float() / 255

    def _crop(self, width: int, height: int, random: np.random.Generator) -> np.ndarray:
        image = self._pool[random.integers(len(self._pool))]
        aspect = width / height
        largest = min(POOL_WIDTH, POOL_HEIGHT * aspect)
        crop_width = largest * random.uniform(0.4, 1.0)
        crop_height = crop_width / aspect
        left = int(random.uniform(0, POOL_WIDTH - crop_width))
        top = int(random.uniform(0, POOL_HEIGHT - crop_height))
        part = np.asarray(image[top : top + max(1, int(crop_height)), left : left + max(1, int(crop_width))])
        part = cv2.resize(
            part, (width, height), interpolation=cv2.INTER_AREA if crop_width > width else cv2.INTER_LINEAR
        )
        part = part[:, :: random.choice([-1, 1])]
        return part[..., random.permutation(3)]


def _share(count: int, train: bool) -> slice:
    border = max(1, count * 4 // 5)
    return slice(border) if train else slice(min(border, count - 1), None)


def render_pool(count: int, seed: int, others: Sequence[Mesh] = ()) -> np.ndarray:
    """Draw uint8 [count, height, width, 3] images of clutter, with ``others`` spread over its heaps."""
    random = np.random.default_rng(seed)
    meshes = [_patterned(mesh, random) for mesh in _shapes(random) for _ in range(4)]
    images = np.stack([_desk(random) for _ in range(count)])
    pool = torch.from_numpy(images).permute(0, 3, 1, 2).contiguous()
    for layer in range(CLUTTER_LAYERS):
        known = list(others[layer::CLUTTER_LAYERS])[:NUM_SLOTS]
        shapes = [meshes[kind] for kind in random.choice(len(meshes), NUM_SLOTS)]
        kinds = [*known, *shapes[len(known) :]]
        renderer = Renderer(kinds, range(NUM_SLOTS), POOL_WIDTH, POOL_HEIGHT, ambient=0.35)
        for start in range(0, count, 40):
            part = slice(start, start + 40)
            pool[part] = _clutter_layer(renderer, pool[part], random, layer)
    return (pool.clamp(0, 1) * 255).round().byte().permute(0, 2, 3, 1).numpy()


def _clutter_layer(renderer: Renderer, behind: Tensor, random: np.random.Generator, seed: int) -> Tensor:
    count = len(behind)
    focal = 0.9 * POOL_WIDTH
    depth = random.uniform(0.5, 1.6, (count, NUM_SLOTS))
    across = random.uniform([-0.6, -0.45], [0.6, 0.45], (count, NUM_SLOTS, 2))
    position = np.concatenate([across * depth[..., None], depth[..., None]], axis=-1)
    rotation = random_rotations(count * NUM_SLOTS, random).unflatten(0, (count, NUM_SLOTS)).float()
    light = random.normal(size=(count, 3)) * [0.6, 0.6, 0.3] + [0, -0.5, -0.6]
    camera = np.array([[focal, 0, (POOL_WIDTH - 1) / 2], [0, focal, (POOL_HEIGHT - 1) / 2], [0, 0, 1]])
    with torch.no_grad():
        return renderer(
            rotation,
            torch.from_numpy(position).float(),
            camera_matrix=camera,
            backgrounds=behind,
            light=torch.from_numpy(light).float(),
            color=torch.from_numpy(_tints(count, random)).float(),
            confidence=torch.from_numpy(random.random((count, NUM_SLOTS)) < 0.8).float(),
            seed=seed,
        )


def _tints(count: int, random: np.random.Generator) -> np.ndarray:
    """Colours that multiply the shapes' own, most of them nearly grey."""
    grey = random.uniform(0.35, 1.0, (count, NUM_SLOTS, 1))
    return np.clip(
        grey + random.normal(size=(count, NUM_SLOTS, 3)) * random.uniform(0, 0.25, (count, NUM_SLOTS, 1)), 0, 1
    )


def _shapes(random: np.random.Generator) -> list[Mesh]:
    size = random.uniform(0.04, 0.2, 8)
    return [
        sphere(size[0] / 2, 4),
        _subdivided(box((size[1], size[1] * 0.6, size[1] * 1.4)), 4),
        _subdivided(box((0.25, 0.02, 0.18)), 4),
        _subdivided(cone(size[3] / 2, size[3] * 1.3), 2),
        capsule(size[4] / 4, size[4] * 1.5),
        capsule(0.012, 0.3),
    ]


def _subdivided(mesh: Mesh, times: int) -> Mesh:
    """A mesh with more vertices, so that a pattern of vertex colours is fine enough."""
    vertices, faces = mesh.vertices_m, mesh.faces
    for _ in range(times):
        corners = vertices[faces]
        middles = (corners + np.roll(corners, -1, axis=1)) / 2
        points = np.concatenate([corners, middles], axis=1).reshape(-1, 3)
        local = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])
        faces = (np.arange(len(faces))[:, None, None] * 6 + local).reshape(-1, 3)
        vertices = points
    return Mesh(vertices, faces)


def _patterned(mesh: Mesh, random: np.random.Generator) -> Mesh:
    """Smooth random stripes and spots on the vertices: mostly light and dark, a little coloured; some objects plain."""
    waves = random.normal(size=(6, 3)) * random.uniform(20, 250, (6, 1))
    phase = random.uniform(0, 2 * np.pi, 6)
    mixing = random.normal(size=(6, 1)) + random.normal(size=(6, 3)) * random.uniform(0, 0.6)
    field = np.sin(mesh.vertices_m @ waves.T + phase) @ mixing * random.choice([0, 0.05, 0.1, 0.2])
    base = random.uniform(0.15, 0.9) + random.normal(size=3) * random.uniform(0, 0.2)
    return dataclasses.replace(mesh, vertex_colors_srgb=np.clip(base + field, 0, 1))


def _desk(random: np.random.Generator) -> np.ndarray:
    """Coloured noise with more of it at low frequencies, under leaves: float32 [height, width, 3] in [0, 1]."""
    image = np.empty((POOL_HEIGHT, POOL_WIDTH, 3), np.float32)
    image[:] = random.uniform(0.1, 0.9) + random.normal(size=3) * random.uniform(0, 0.2)
    shared = np.zeros((POOL_HEIGHT, POOL_WIDTH), np.float32)
    for octave in (2, 4, 8, 16, 32, 64):
        grid = random.normal(size=(octave, octave + octave // 3 + 1)).astype(np.float32) * random.uniform(0, 0.25)
        shared += cv2.resize(grid, (POOL_WIDTH, POOL_HEIGHT), interpolation=cv2.INTER_CUBIC) / np.sqrt(octave)
    image += shared[..., None] * random.uniform(0.3, 1.0, 3).astype(np.float32)
    np.clip(image, 0, 1, out=image)
    dead_leaves_texture(image, random)
    return image


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as exc:
        raise DataError(f"cannot make {folder}: {exc.strerror}; name a writable folder: --cache") from exc


def _save(path: Path, pool: np.ndarray) -> None:
    partial = path.with_suffix(f".{os.getpid()}.tmp")  # runs that begin together each write their own
    try:
        with partial.open("wb") as file:
            np.save(file, pool)
        partial.replace(path)
    except OSError as exc:
        partial.unlink(missing_ok=True)
        raise DataError(f"cannot write {path}: {exc.strerror}; name a folder with space: --cache") from exc
