"""Colours and textures of the parts of a scene: of one kind before the parts are joined, so that none are lost."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import SimpleMaterial

from curio_train.errors import MeshError

_TRIMESH_DEFAULT_COLOR = (102, 102, 102)
_BESIDE = 0.01  # of a texture's side, by which coordinates may leave it


def joined(path: Path, scene: Any) -> Any:
    """The parts of a scene as one mesh.

    Textures are packed into one, with a patch for every part of a single colour. Where a part has several colours
    of its own, or one of several textures repeats, vertices get the colours that the textures have there.

    Args:
        path: The file, for errors.
        scene: The trimesh scene of its content, which is changed.

    Raises:
        MeshError: A texture cannot be decoded, or the colours cannot be joined.
    """
    names = {scene.graph[node][1] for node in scene.graph.nodes_geometry}
    parts = [scene.geometry[name] for name in names if isinstance(scene.geometry[name], trimesh.Trimesh)]
    _tell_apart(path, parts)
    _make_alike(parts)
    mesh = scene.to_mesh()
    if mesh.visual.kind is None and any(part.visual.kind is not None for part in parts):
        raise MeshError(
            f"{path}: found {len(parts)} parts whose colours cannot be joined; expected colours of vertices, or "
            "textures that fit in one; export it without colours, or with one texture"
        )
    return mesh


def appearance(mesh: Any) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None]:
    """Vertex colours, texture coordinates and texture; colours of faces are averaged at their corners."""
    visual = mesh.visual
    if visual.kind is None:
        return None, None, None
    if visual.kind == "texture":
        return None, np.asarray(visual.uv, dtype=np.float64), np.asarray(visual.material.image.convert("RGB"))
    return np.asarray(visual.vertex_colors)[:, :3] / 255.0, None, None


def _tell_apart(path: Path, parts: Sequence[Any]) -> None:
    """Leave to each part either a texture alone, or colours, or nothing."""
    materials: dict[int, SimpleMaterial] = {}  # parts may share an image
    for part in parts:
        visual = part.visual
        if visual.kind != "texture":
            continue
        image = getattr(visual.material, "baseColorTexture", None) or getattr(visual.material, "image", None)
        # Where there is no material trimesh makes a grey picture up; one read from a file has a format.
        if image is not None and image.format is not None and visual.uv is not None:
            if id(image) not in materials:
                materials[id(image)] = SimpleMaterial(image=_decoded(path, image))
            part.visual = TextureVisuals(visual.uv, materials[id(image)])
            continue
        color = np.asarray(visual.material.main_color)[:3]
        is_known = tuple(color) != _TRIMESH_DEFAULT_COLOR
        part.visual = ColorVisuals(vertex_colors=np.tile(color, (len(part.vertices), 1)) if is_known else None)


def _decoded(path: Path, image: Any) -> Any:
    try:
        if image.mode.startswith("I"):  # 16 bits a pixel, which Pillow would clip
            return Image.fromarray((np.asarray(image) / 257).round().astype(np.uint8)).convert("RGB")
        return image.convert("RGB")  # decodes only now
    except (OSError, ValueError) as exc:
        raise MeshError(f"{path}: its texture cannot be decoded ({exc})") from exc


def _make_alike(parts: Sequence[Any]) -> None:
    """Leave textures to all parts, or to none."""
    textured = [part for part in parts if part.visual.kind == "texture"]
    others = [part for part in parts if part.visual.kind != "texture"]
    if not textured:
        return
    can_pack = len({id(part.visual.material) for part in textured}) + len(others) == 1 or not any(
        map(_repeats, textured)
    )
    if can_pack and all(_num_colors(part) == 1 for part in others):
        for part in others:
            part.visual = TextureVisuals(material=SimpleMaterial(diffuse=part.visual.vertex_colors[0]))
    else:
        for part in textured:
            part.visual = part.visual.to_color()


def _repeats(part: Any) -> bool:
    """Whether its texture is laid side by side, which cannot be packed with others."""
    uv = np.asarray(part.visual.uv)
    return bool(uv.min(initial=0) < -_BESIDE or uv.max(initial=1) > 1 + _BESIDE)


def _num_colors(part: Any) -> int:
    return len(np.unique(part.visual.vertex_colors, axis=0))
