"""Writes a scene as a USD file: objects with their colours, light and camera, in metres with y up."""

import math
import tempfile
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, Vt

from curio_train.drawing.axes import GL_FROM_CV, embed, linear, root_from_camera, towards_light
from curio_train.drawing.pictures import SceneContext
from curio_train.drawing.scenes import Placed, Scene
from curio_train.meshes.meshes import Mesh

_FOCAL = 35.0  # of the camera, in tenths of a metre as USD counts; only its proportion to the aperture matters


def to_usd(scene: Scene, context: SceneContext) -> bytes:
    """A scene as the bytes of a USD file.

    The root frame is that of :func:`~curio_train.drawing.glb.to_glb`. A texture becomes the colours of the vertices.

    Raises:
        DataError: An object has no mesh.
    """
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/scene").GetPrim())
    root = root_from_camera(context)
    for number, item in enumerate(scene.objects):
        _add_object(stage, number, item, context.mesh(item.kind), root @ item.pose.matrix)
    _add_camera(stage, scene, root)
    _add_lights(stage, root[:3, :3] @ context.light_of(scene), context.ambient)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.usdc"
        stage.GetRootLayer().Export(str(path))
        return path.read_bytes()


def _add_object(stage: Usd.Stage, number: int, item: Placed, mesh: Mesh, matrix: np.ndarray) -> None:
    name = "".join(letter if letter.isascii() and letter.isalnum() else "_" for letter in item.kind)
    shape = UsdGeom.Mesh.Define(stage, f"/scene/object_{number:02d}_{name}")
    shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(mesh.vertices_m.astype(np.float32)))
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.faces.astype(np.int32).ravel()))
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    color = shape.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
    color.Set(Vt.Vec3fArray.FromNumpy((_albedo(mesh) * linear(item.color_srgb)).astype(np.float32)))
    shape.CreateDisplayOpacityPrimvar(UsdGeom.Tokens.constant).Set([item.confidence])
    prim = shape.GetPrim()
    prim.CreateAttribute("curio:object", Sdf.ValueTypeNames.String).Set(item.kind)
    prim.CreateAttribute("curio:confidence", Sdf.ValueTypeNames.Double).Set(item.confidence)
    _place(shape, matrix)


def _albedo(mesh: Mesh) -> np.ndarray:
    """Albedo of each vertex, [num_vertices, 3] in linear light."""
    if mesh.vertex_colors_srgb is not None:
        return linear(mesh.vertex_colors_srgb)
    if mesh.texture is None or mesh.uv is None:
        return np.ones((len(mesh.vertices_m), 3))
    height, width = mesh.texture.shape[:2]
    across, up = (mesh.uv % 1.0).T
    column = np.minimum((across * width).astype(int), width - 1)
    row = np.minimum(((1 - up) * height).astype(int), height - 1)
    return linear(mesh.texture[row, column] / 255)


def _add_camera(stage: Usd.Stage, scene: Scene, root: np.ndarray) -> None:
    """A camera with the whole of K but its skew: apertures are the image's size in units of the focal length."""
    (fx, _, cx), (_, fy, cy) = np.asarray(scene.camera_matrix)[:2]
    camera = UsdGeom.Camera.Define(stage, "/scene/camera")
    camera.CreateFocalLengthAttr(_FOCAL)
    camera.CreateHorizontalApertureAttr(_FOCAL * scene.width / fx)
    camera.CreateVerticalApertureAttr(_FOCAL * scene.height / fy)
    # Pixel centres are at integers, so the image's middle is at (width - 1) / 2; offsets move it right and up.
    camera.CreateHorizontalApertureOffsetAttr(_FOCAL * ((scene.width - 1) / 2 - cx) / fx)
    camera.CreateVerticalApertureOffsetAttr(_FOCAL * (cy - (scene.height - 1) / 2) / fy)
    camera.CreateClippingRangeAttr(Gf.Vec2f(0.01, 1000))
    _place(camera, root @ embed(GL_FROM_CV))


def _add_lights(stage: Usd.Stage, light: np.ndarray, ambient: float) -> None:
    """A distant lamp, whose irradiance is π times the light's strength, and a dome of the ambient radiance."""
    matrix, strength = towards_light(light)
    sun = UsdLux.DistantLight.Define(stage, "/scene/light")
    sun.CreateIntensityAttr(strength * math.pi)
    sun.CreateNormalizeAttr(True)
    _place(sun, matrix)
    UsdLux.DomeLight.Define(stage, "/scene/ambient").CreateIntensityAttr(ambient)


def _place(shape: UsdGeom.Xformable, matrix: np.ndarray) -> None:
    shape.AddTransformOp().Set(Gf.Matrix4d(matrix.T.tolist()))  # USD multiplies rows from the left
