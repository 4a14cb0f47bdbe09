"""Our image is stock Mitsuba's: shading, colours, textures, cameras."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from curio_train.meshes.meshes import Mesh, load_mesh
from curio_train.rendering.renderer import Renderer
from curio_train.rendering.stock import OPENCV_AXES, PosedMesh, emitters, load_scene, sensor
from PIL import Image

AMBIENT = 0.3
LIGHT = np.array([0.3, -0.4, -0.5])
DIRECT = {"type": "direct", "hide_emitters": True}


def stock_image(mitsuba: Any, scene: Any, samples: int = 1024) -> np.ndarray:
    """What the scene's objects look like over black, encoded to sRGB before they meet the background."""
    linear = np.array(mitsuba.render(scene, spp=samples))
    alpha = linear[..., 3:].clip(0, 1)
    color = (linear[..., :3] / np.maximum(alpha, 1e-6)).clip(0, 1)
    return alpha * np.where(color <= 0.0031308, 12.92 * color, 1.055 * np.maximum(color, 1e-6) ** (1 / 2.4) - 0.055)


def our_image(renderer: Renderer, rotation, translation_m, matrix, size: tuple[int, int], **more) -> np.ndarray:
    """One image [height, width, 3] over black."""
    image = renderer(
        torch.tensor(rotation, dtype=torch.float32)[None, None],
        torch.tensor(translation_m, dtype=torch.float32)[None, None],
        camera_matrix=matrix,
        backgrounds=torch.zeros(1, 3, size[1], size[0]),
        light=torch.tensor(LIGHT[None], dtype=torch.float32),
        **more,
    )
    return image[0].permute(1, 2, 0).numpy()


def difference(ours: np.ndarray, stock: np.ndarray) -> float:
    """Mean absolute difference over the pixels that either shows the object in."""
    seen = (ours.sum(-1) > 0) | (stock.sum(-1) > 0)
    assert seen.sum() > 100, "the object is hardly in the picture"
    return float(np.abs(ours - stock)[seen].mean())


@pytest.mark.parametrize("size", [(64, 64), (75, 48)], ids=["square", "odd-sized"])
@pytest.mark.parametrize("pose", range(3))
def test_image_equals_stock(mitsuba, meshes, draw, pose: int, size: tuple[int, int]) -> None:
    matrix = np.array([[90.0, 0, size[0] * 0.4], [0, 90.0, size[1] * 0.6], [0, 0, 1]])
    codes = draw(8, 1, 2)
    # The second half of the codes lies near the optical axis.
    rotation, translation_m = (v[4 + pose, 0].double().numpy() for v in (codes.rotation, codes.translation_m))
    color = codes.color[4 + pose, 0]
    posed = PosedMesh(meshes["pebble"], rotation, translation_m, tuple(color.tolist()))
    camera = sensor(mitsuba, matrix, *size, samples_per_pixel=1024)
    stock = stock_image(mitsuba, load_scene(mitsuba, [posed], camera, emitters(AMBIENT, LIGHT), DIRECT))
    renderer = Renderer([meshes["pebble"]], [0], *size, ambient=AMBIENT, samples_per_pixel=64)
    ours = our_image(renderer, rotation, translation_m, matrix, size, color=color[None, None])
    assert difference(ours, stock) <= 0.01


def test_texture_lies_as_in_the_file(mitsuba, meshes, tmp_path: Path) -> None:
    ring, size = meshes["ring"], (64, 64)
    material = trimesh.visual.material.SimpleMaterial(image=Image.fromarray(ring.texture))
    visual = trimesh.visual.TextureVisuals(uv=ring.uv, material=material)
    path = tmp_path / "ring.obj"
    trimesh.Trimesh(ring.vertices_m, ring.faces, visual=visual, process=False).export(path)
    loaded = load_mesh(path, "m")
    assert loaded.texture is not None
    (picture,) = tmp_path.glob("*.png")
    matrix = np.array([[120.0, 0, 31.5], [0, 120.0, 31.5], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, 3] = 0, 0, 0.25
    bsdf = {"type": "diffuse", "reflectance": {"type": "bitmap", "filename": str(picture)}}
    theirs = {"type": "obj", "filename": str(path), "to_world": mitsuba.ScalarTransform4f(pose), "bsdf": bsdf}
    # Uniform light alone, which a torus shades a little where it sees itself: seen from above it is nearly even.
    scene = {"type": "scene", "integrator": DIRECT, "sensor": sensor(mitsuba, matrix, *size, samples_per_pixel=256)}
    stock = stock_image(mitsuba, mitsuba.load_dict({**scene, **emitters(1.0, np.zeros(3)), "ring": theirs}), 256)
    renderer = Renderer([loaded], [0], *size, ambient=1.0, samples_per_pixel=16)
    dark = torch.zeros(1, 3)
    ours = renderer(
        torch.eye(3)[None, None],
        torch.tensor([[[0, 0, 0.25]]]),
        camera_matrix=matrix,
        backgrounds=torch.zeros(1, 3, 64, 64),
        light=dark,
    )[0]
    right = difference(ours.permute(1, 2, 0).numpy(), stock)
    upside_down = difference(ours.flip(1).permute(1, 2, 0).numpy(), stock)
    assert right <= 0.03
    assert right < upside_down / 5


def test_pixels_need_not_be_square(meshes) -> None:
    """An image with fy = fx / 2 is the one with fy = fx with its lines averaged in pairs."""
    rotation, translation_m = np.eye(3), np.array([0.01, -0.02, 0.3])
    square = np.array([[100.0, 0, 30], [0, 100.0, 33], [0, 0, 1]])
    flat = np.array([[100.0, 0, 30], [0, 50.0, 16.25], [0, 0, 1]])
    tall = Renderer([meshes["pebble"]], [0], 64, 64, ambient=AMBIENT, samples_per_pixel=64)
    low = Renderer([meshes["pebble"]], [0], 64, 32, ambient=AMBIENT, samples_per_pixel=64)
    expected = our_image(tall, rotation, translation_m, square, (64, 64)).reshape(32, 2, 64, 3).mean(1)
    found = our_image(low, rotation, translation_m, flat, (64, 32))
    assert difference(found, expected) <= 0.01


def test_every_image_may_have_its_own_camera(meshes, draw, camera_matrix) -> None:
    codes = draw(4, 1, 3)
    renderer = Renderer([meshes["root"]], [0], 64, 64, ambient=AMBIENT)
    matrices = np.stack([camera_matrix + np.diag([5.0 * i, 3.0 * i, 0]) for i in range(4)])

    def render(rows: slice, matrix: np.ndarray) -> torch.Tensor:
        return renderer(
            codes.rotation[rows],
            codes.translation_m[rows],
            camera_matrix=matrix,
            backgrounds=codes.backgrounds[rows],
            light=codes.light[rows],
        )

    together = render(slice(None), matrices)
    assert torch.allclose(together[:1], render(slice(1), matrices[0]), atol=1e-5)
    assert not torch.allclose(together, render(slice(None), matrices[0]), atol=0.1)


def test_axes_of_the_camera_are_opencvs(mitsuba, meshes) -> None:
    """Right is right and down is down, in our images and in stock's."""
    matrix = np.array([[90.0, 0, 31.5], [0, 90.0, 31.5], [0, 0, 1]])
    posed = PosedMesh(meshes["box"], np.eye(3), np.array([0.1, 0.05, 0.4]))
    camera = sensor(mitsuba, matrix, 64, 64, samples_per_pixel=16)
    stock = stock_image(mitsuba, load_scene(mitsuba, [posed], camera, emitters(1.0, np.zeros(3)), DIRECT), 16)
    renderer = Renderer([meshes["box"]], [0], 64, 64, ambient=1.0)
    ours = our_image(renderer, posed.rotation, posed.translation_m, matrix, (64, 64))
    assert np.allclose(OPENCV_AXES, np.diag([-1, -1, 1, 1]))
    for image in (stock, ours):
        lines, columns = np.nonzero(image.sum(-1) > 0.5)
        assert columns.mean() == pytest.approx(31.5 + 90 * 0.1 / 0.4, abs=2)
        assert lines.mean() == pytest.approx(31.5 + 90 * 0.05 / 0.4, abs=2)


def test_color_of_the_code_is_an_srgb_albedo(meshes) -> None:
    """White light of radiance 1 gives the colour back, over an object that has none of its own."""
    plain = Mesh(meshes["pebble"].vertices_m, meshes["pebble"].faces)
    renderer = Renderer([plain], [0], 16, 16, ambient=1.0)
    color = torch.tensor([[[0.2, 0.5, 0.9]]])
    image = renderer(
        torch.eye(3)[None, None],
        torch.tensor([[[0, 0, 0.1]]]),
        camera_matrix=np.array([[40.0, 0, 7.5], [0, 40, 7.5], [0, 0, 1]]),
        backgrounds=torch.zeros(1, 3, 16, 16),
        light=torch.zeros(1, 3),
        color=color,
    )
    assert torch.allclose(image[0, :, 8, 8], color[0, 0], atol=1e-3)
