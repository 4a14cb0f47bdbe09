"""Writes a scene as a GLB file, which Blender and other 3D applications open, and reads its scene code back.

glTF is in metres with y up, and its cameras look along −z. The file's root frame is therefore the scene's camera frame
(OpenCV: y down, z forward) turned so that the scene's up direction points along +y; the camera has a node of its own.
What glTF has no field for (K, colour, confidence, the ambient light) is in the ``extras`` of the nodes.
"""

import json
import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from curio_serve.files import read_file
from curio_serve.imaging.rotation import is_rotation
from PIL import Image

from curio_train.drawing.axes import GL_FROM_CV, embed, linear, root_from_camera, towards_light
from curio_train.drawing.pictures import SceneContext
from curio_train.drawing.scenes import Placed, Scene, located
from curio_train.errors import DataError
from curio_train.geometry import Pose
from curio_train.meshes.meshes import MAX_BYTES, Mesh

_LUX = math.pi  # of a directional light of strength 1: the irradiance of a surface that faces it
_CAMERA, _SUN = "camera", "light"
_EXTRAS = "curio"
_SHEAR = 1e-3  # of a rotation times its transpose, as applications round it


def to_glb(scene: Scene, context: SceneContext) -> bytes:
    """A scene as the bytes of a GLB file.

    Each object is a node whose matrix is its pose; meshes have their own colours times the object's.

    Raises:
        DataError: An object has no mesh.
    """
    out = trimesh.Scene(base_frame="world")
    root = root_from_camera(context)
    for number, item in enumerate(scene.objects):
        matrix = root @ item.pose.matrix
        extras = {"object": item.kind, "color": list(item.color_srgb), "confidence": item.confidence}
        name = f"{number:02d}-{item.kind}"
        geometry = _geometry(context.mesh(item.kind), item)
        out.add_geometry(geometry, geom_name=name, node_name=name, transform=matrix, metadata={_EXTRAS: extras})
    light = context.light_of(scene)

    def add_camera_and_light(tree: dict[str, Any]) -> None:
        _add_camera(tree, scene, root, context.ambient)
        _add_light(tree, root[:3, :3] @ light)

    content: bytes = trimesh.exchange.gltf.export_glb(out, tree_postprocessor=add_camera_and_light)
    return content


def from_glb(path: Path) -> Scene:
    """The scene of a file that :func:`to_glb` wrote, with whatever was moved in it since.

    Raises:
        DataError: The file cannot be read, or was not written by curio.
    """
    tree = _tree(path)
    try:
        return _scene(tree, path)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, ArithmeticError) as exc:
        raise DataError(
            f"{path}: not a scene of curio ({type(exc).__name__}: {exc}); expected a file of curio-render --format glb"
        ) from exc


def _scene(tree: dict[str, Any], path: Path) -> Scene:
    every = tree.get("nodes", ())
    numbers = {node["name"]: number for number, node in enumerate(every) if _EXTRAS in node.get("extras", {})}
    nodes = {name: every[number] for name, number in numbers.items()}
    root_from = {name: _root_from(every, number) for name, number in numbers.items()}
    camera = nodes.pop(_CAMERA, None)
    if camera is None:
        raise DataError(f"{path}: found no camera written by curio; expected a file of curio-render --format glb")
    cam_from_root = np.linalg.inv(root_from[_CAMERA] @ embed(GL_FROM_CV))
    sun = nodes.pop(_SUN)
    strength = tree["extensions"]["KHR_lights_punctual"]["lights"][0]["intensity"] / _LUX
    about = camera["extras"][_EXTRAS]
    return Scene(
        path.stem,
        about["width"],
        about["height"],
        np.array(about["camera_matrix"]),
        tuple(_placed(node, cam_from_root @ root_from[name]) for name, node in nodes.items()),
        strength * (cam_from_root @ root_from[sun["name"]])[:3, 2],
        None if about["photograph"] is None else located(Path(about["photograph"]), path.parent),
        about["world"],
        tuple(map(float, about.get("distortion", ()))),
        about.get("exif_rotation") is True,
    )


def _geometry(mesh: Mesh, item: Placed) -> Any:
    """The mesh in its own colours times the object's, as transparent as the object is uncertain."""
    factor = [*linear(item.color_srgb), item.confidence]
    material = trimesh.visual.material.PBRMaterial(
        baseColorFactor=factor,
        baseColorTexture=None if mesh.texture is None else Image.fromarray(mesh.texture),
        alphaMode="OPAQUE" if item.confidence >= 1 else "BLEND",
        metallicFactor=0.0,
        roughnessFactor=1.0,
    )
    out = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    if mesh.texture is not None or mesh.vertex_colors_srgb is None:
        out.visual = trimesh.visual.TextureVisuals(uv=mesh.uv, material=material)
        return out
    # glTF multiplies a vertex's colour in linear light.
    albedo = linear(mesh.vertex_colors_srgb) * factor[:3]
    alpha = np.full((len(albedo), 1), item.confidence)
    out.visual = trimesh.visual.ColorVisuals(
        out, vertex_colors=np.rint(255 * np.hstack([albedo, alpha])).astype(np.uint8)
    )
    return out


def _add_camera(tree: dict[str, Any], scene: Scene, root: np.ndarray, ambient: float) -> None:
    focal = float(scene.camera_matrix[1, 1])
    perspective = {
        "yfov": 2 * math.atan(scene.height / 2 / focal),
        "aspectRatio": scene.width / scene.height,
        "znear": 0.01,
    }
    tree["cameras"] = [{"type": "perspective", "perspective": perspective}]
    about = {
        "camera_matrix": np.asarray(scene.camera_matrix).tolist(),
        "width": scene.width,
        "height": scene.height,
        "ambient": ambient,
        "photograph": None if scene.photograph is None else str(scene.photograph),
        "world": scene.world,
        "distortion": list(scene.distortion),
        "exif_rotation": scene.exif_rotation,
    }
    # A glTF camera looks along −z with y up, the scene's along +z with y down.
    _add_node(tree, _CAMERA, root @ embed(GL_FROM_CV), {"camera": 0, "extras": {_EXTRAS: about}})


def _add_light(tree: dict[str, Any], light: np.ndarray) -> None:
    """A directional light, which shines along −z of its node; ``light`` points towards it, in glTF's frame."""
    matrix, strength = towards_light(light)
    lights = [{"type": "directional", "intensity": strength * _LUX}]
    tree.setdefault("extensions", {})["KHR_lights_punctual"] = {"lights": lights}
    tree.setdefault("extensionsUsed", []).append("KHR_lights_punctual")
    extension = {"extensions": {"KHR_lights_punctual": {"light": 0}}, "extras": {_EXTRAS: {}}}
    _add_node(tree, _SUN, matrix, extension)


def _add_node(tree: dict[str, Any], name: str, matrix: np.ndarray, more: dict[str, Any]) -> None:
    tree["nodes"].append({"name": name, "matrix": matrix.T.ravel().tolist(), **more})
    tree["scenes"][0]["nodes"].append(len(tree["nodes"]) - 1)


def _tree(path: Path) -> dict[str, Any]:
    """The JSON chunk of a GLB file."""
    try:
        content = read_file(path, MAX_BYTES)
        magic, _, _, length, _ = struct.unpack_from("<4sIIII", content)
        tree = json.loads(content[20 : 20 + length])
    except (OSError, struct.error, ValueError, RecursionError) as exc:
        raise DataError(f"{path}: not a readable GLB file ({exc})") from exc
    if magic != b"glTF" or not isinstance(tree, dict):
        raise DataError(f"{path}: found no glTF header, expected a GLB file")
    return tree


def _root_from(nodes: Sequence[dict[str, Any]], number: int) -> np.ndarray:
    """The transform from a node to the scene's root: applications put objects into groups that they move.

    Raises:
        ValueError: It is not rigid, or nodes are each other's children.
    """
    parent_of = {child: parent for parent, node in enumerate(nodes) for child in node.get("children", ())}
    matrix, name = _node_matrix(nodes[number]), nodes[number]["name"]
    for _ in nodes:
        if number not in parent_of:
            break
        number = parent_of[number]
        matrix = _node_matrix(nodes[number]) @ matrix
    else:
        raise ValueError(f"{name} is a child of its own")
    if not is_rotation(matrix[:3, :3], _SHEAR):
        raise ValueError(f"{name} is scaled or mirrored; poses are rigid, so undo that in the application")
    return matrix


def _node_matrix(node: dict[str, Any]) -> np.ndarray:
    """A node's transform to its parent, as a matrix or as translation, rotation (quaternion xyzw) and scale."""
    if "matrix" in node:
        return np.array(node["matrix"]).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    matrix: np.ndarray = trimesh.transformations.quaternion_matrix([w, x, y, z])
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    matrix[:3, :3] *= np.array(node.get("scale", (1.0, 1.0, 1.0)))
    return matrix


def _placed(node: dict[str, Any], cam_from_node: np.ndarray) -> Placed:
    extras, pose = node["extras"][_EXTRAS], Pose(cam_from_node[:3, :3], cam_from_node[:3, 3])
    return Placed(extras["object"], pose, tuple(extras["color"]), extras["confidence"])
