"""glTF files as scenes with colours in sRGB: the file has its textures in sRGB, all other colours in linear light."""

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from curio_train.errors import MeshError

GLTF_SUFFIXES = (".glb", ".gltf")

_READABLE = ("KHR_materials_", "KHR_lights_", "EXT_texture_webp")  # beginnings of names of extensions
_FLOAT32 = 5126


def srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    """Encode linear light to sRGB (IEC 61966-2-1), both in [0, 1]."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def read_gltf(content: bytes, kind: str, resolver: trimesh.resolvers.Resolver) -> Any:
    """The scene of a glTF file. Colours of vertices are multiplied by their material's, as the specification says.

    A colour beside a texture is not applied. Of a material's colour trimesh keeps 256 steps of linear light, which are
    coarse in the dark: the darkest is 13 of 255 in sRGB.

    Args:
        content: Of the file.
        kind: ``glb`` or ``gltf``.
        resolver: Reads the files beside it.
    """
    read = trimesh.exchange.gltf.load_glb if kind == "glb" else trimesh.exchange.gltf.load_gltf
    described = read(io.BytesIO(content), resolver=resolver)
    for part in described["geometry"].values():
        _encode(part)
    return trimesh.load_scene(described)


def refuse_unread(path: Path, content: bytes, kind: str) -> None:
    """Refuse a file with something that trimesh passes over without a word, and that changes shape or texture.

    Args:
        path: The file, for errors.
        content: Its content.
        kind: ``glb`` or ``gltf``.

    Raises:
        MeshError: Says what it is.
        ValueError: The file is damaged; as LookupError, TypeError and AttributeError.
    """
    file = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")] if kind == "glb" else content)
    for found in _unread(file):
        raise MeshError(f"{path}: has {found}, which curio does not read; export it without, uncompressed")


def _unread(file: dict[str, Any]) -> Iterator[str]:
    for name in file.get("extensionsRequired", ()):
        if not name.startswith(_READABLE):
            yield f"the extension {name}"
    for primitive in (primitive for mesh in file.get("meshes", ()) for primitive in mesh["primitives"]):
        used = {name: file["accessors"][number] for name, number in primitive["attributes"].items()}
        used |= {"indices": file["accessors"][primitive["indices"]]} if "indices" in primitive else {}
        for name, accessor in used.items():
            if "sparse" in accessor:
                yield f"a sparse accessor ({name})"
        texture = _texture(file, primitive)
        if texture is None:
            continue
        if "KHR_texture_transform" in texture.get("extensions", ()):
            yield "a texture with KHR_texture_transform"
        if texture.get("texCoord", 0) != 0:
            yield f"a texture with other coordinates than the first (TEXCOORD_{texture['texCoord']})"
        if used.get("TEXCOORD_0", {}).get("componentType", _FLOAT32) != _FLOAT32:
            yield "texture coordinates that are whole numbers"


def _texture(file: dict[str, Any], primitive: dict[str, Any]) -> dict[str, Any] | None:
    """The texture of a primitive's colours, if it has one."""
    if "material" not in primitive:
        return None
    rough = file["materials"][primitive["material"]].get("pbrMetallicRoughness", {})
    found: dict[str, Any] | None = rough.get("baseColorTexture")
    return found


def _encode(part: dict[str, Any]) -> None:
    """Give a part without a texture its colours in sRGB, as colours of vertices."""
    colors, factor = part.get("vertex_colors"), None
    if (visual := part.get("visual")) is not None:
        if visual.material.baseColorTexture is not None and visual.uv is not None:
            return
        del part["visual"]
        colors, factor = visual.vertex_attributes.get("color"), visual.material.baseColorFactor
    if colors is None and factor is None:
        return
    linear = np.ones((len(part["vertices"]), 3))
    for known in (colors, factor):
        if known is not None:
            linear = linear * _fractions(np.asarray(known))[..., :3]
    part["vertex_colors"] = np.round(255 * srgb_from_linear(linear)).astype(np.uint8)


def _fractions(stored: np.ndarray) -> np.ndarray:
    """Stored values in [0, 1]: whole numbers are fractions of the largest of their type."""
    largest = np.iinfo(stored.dtype).max if stored.dtype.kind in "iu" else 1
    return np.clip(np.nan_to_num(stored / largest), 0, 1)
