"""Our renderer beside stock Mitsuba: images a second, forward and backward, and how right the gradients are.

    python benchmarks/renderer.py --json            the comparison: minutes

Same poses, same samples a pixel, same run, in turns. Stock Mitsuba renders one image at a time (a scene holds one
camera and one pose), moved through the mesh's vertices. Each renderer's gradient of a squared image error, at exactly
the settings that are timed, is compared with central differences of its own converged rendering.
"""

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from curio_train.data.meshes import Mesh
from curio_train.data.shapes import sphere
from curio_train.rendering.renderer import Renderer
from scipy.spatial.transform import Rotation
from torch import Tensor

SIDE = 128
SAMPLES_PER_PIXEL = 4
BATCH = 128
AMBIENT = 0.3
FOCAL = 160.0
CAMERA = np.array([[FOCAL, 0, (SIDE - 1) / 2], [0, FOCAL, (SIDE - 1) / 2], [0, 0, 1]])
NUM_REFERENCE = 32
CONVERGED_SPP = 256
TURN_STEP, MOVE_STEP_M = 0.01, 0.0005

Poses = tuple[Tensor, Tensor, Tensor]  # rotation [b, 3, 3], translation_m [b, 3], light [b, 3]


def lump(subdivisions: int = 4) -> Mesh:
    """An asymmetric, partly concave, coloured object of about 0.1 m: 5,120 faces after four subdivisions."""
    ball = sphere(1.0, subdivisions)
    v = ball.vertices_m
    swell = 1 + 0.3 * np.sin(3 * v[:, :1]) * np.cos(4 * v[:, 1:2]) + 0.2 * v[:, 2:]
    vertices = 0.05 * v * swell
    return Mesh(vertices, ball.faces, 0.5 + 0.5 * np.sin(40 * vertices + np.arange(3)))


def draw_poses(count: int, seed: int, share: tuple[float, float] = (0.25, 0.5), side: int = SIDE) -> Poses:
    """Random poses with the object between a quarter and a half of the image's width."""
    random = np.random.default_rng(seed)
    depth = FOCAL * side / SIDE * 0.11 / (side * random.uniform(*share, count))
    lateral = random.uniform(-0.25, 0.25, (count, 2)) * depth[:, None] * SIDE / FOCAL
    light = random.normal(size=(count, 3)) * [0.6, 0.6, 0.2] - [0, 0, 0.6]
    rotation = Rotation.random(count, rng=random).as_matrix()
    return tuple(torch.from_numpy(x).float() for x in (rotation, np.c_[lateral, depth], light))


def ours(renderer: Renderer, poses: Poses, target: Tensor, seed: int) -> tuple[Tensor, Tensor]:
    """Gradient by (turn, translation) [b, 6] of each image's squared error, and the errors [b]."""
    rotation, translation, light = poses
    turn = torch.zeros_like(translation, requires_grad=True)
    move = torch.zeros_like(translation, requires_grad=True)
    image = _render(renderer, (turned(rotation, turn), translation + move, light), seed)
    error = (image - target).square().sum((1, 2, 3))
    error.sum().backward()
    return torch.cat([turn.grad, move.grad], dim=1), error.detach()


def _render(renderer: Renderer, poses: Poses, seed: int) -> Tensor:
    rotation, translation, light = poses
    side = renderer.setting.width
    return renderer(
        rotation[:, None],
        translation[:, None],
        camera_matrix=_camera(side),
        backgrounds=torch.zeros(len(rotation), 3, side, side),
        light=light,
        seed=seed,
    )


def _camera(side: int) -> np.ndarray:
    scale = side / SIDE
    return np.array([[FOCAL * scale, 0, (side - 1) / 2], [0, FOCAL * scale, (side - 1) / 2], [0, 0, 1]])


def turned(rotation: Tensor, turn: Tensor) -> Tensor:
    """Rotations turned by rotation vectors [b, 3] in the camera frame."""
    zero = torch.zeros_like(turn[:, 0])
    x, y, z = turn.unbind(1)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).unflatten(1, (3, 3))
    return torch.matrix_exp(skew) @ rotation


class Stock:
    """Stock Mitsuba, one image at a time: pose through the vertices, ``direct_projective``, gradients by its own AD."""

    def __init__(self, mesh: Mesh, best: bool) -> None:
        """Load the scene; ``best``: without the sampling of indirect silhouettes, which do not exist here."""
        import drjit
        import mitsuba

        self.mi, self.dr = mitsuba, drjit
        linear = np.where(
            mesh.vertex_colors_srgb <= 0.04045,
            mesh.vertex_colors_srgb / 12.92,
            ((mesh.vertex_colors_srgb + 0.055) / 1.055) ** 2.4,
        )
        properties = mitsuba.Properties()
        properties["bsdf"] = mitsuba.load_dict(
            {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
        )
        shape = mitsuba.Mesh("lump", len(mesh.vertices_m), len(mesh.faces), has_vertex_normals=True, props=properties)
        shape.add_attribute("vertex_color", 3, linear.astype(np.float32).ravel())
        parameters = mitsuba.traverse(shape)
        parameters["vertex_positions"] = mesh.vertices_m.astype(np.float32).ravel()
        parameters["faces"] = mesh.faces.astype(np.uint32).ravel()
        parameters.update()
        projective = {"sppi": 0, "guiding": "none"} if best else {}
        # A camera at the origin that looks along z with y down is Mitsuba's own turned by 180° about z.
        to_world = mitsuba.ScalarTransform4f().look_at(origin=[0, 0, 0], target=[0, 0, 1], up=[0, -1, 0])
        self.scene = mitsuba.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "direct_projective", "hide_emitters": True, **projective},
                "sensor": {
                    "type": "perspective",
                    "to_world": to_world,
                    "fov": float(np.degrees(2 * np.arctan(SIDE / 2 / FOCAL))),
                    "near_clip": 0.001,
                    "film": {
                        "type": "hdrfilm",
                        "width": SIDE,
                        "height": SIDE,
                        "pixel_format": "rgb",
                        "rfilter": {"type": "box"},
                        "sample_border": True,
                    },
                    "sampler": {"type": "independent"},
                },
                "ambient": {"type": "constant", "radiance": AMBIENT},
                "sun": {
                    "type": "directional",
                    "direction": [0, 0, 1],
                    "irradiance": {"type": "rgb", "value": [1, 1, 1]},
                },
                "lump": shape,
            }
        )
        self.parameters = mitsuba.traverse(self.scene)
        self.vertices = mitsuba.Point3f(*mesh.vertices_m.astype(np.float32).T)

    def image(self, poses: Poses, index: int, offset: Any, spp: int, seed: int) -> Any:
        """Linear radiance [height, width, 3] of one pose; ``offset`` (turn 3, move 3) may carry a gradient."""
        mi, dr = self.mi, self.dr
        rotation, translation, light = (x[index].tolist() for x in poses)
        matrix = mi.Matrix3f(rotation)
        point = matrix @ self.vertices
        turn, move = mi.Vector3f(*offset[:3]), mi.Vector3f(*offset[3:])
        # Rodrigues to second order: exact for the small steps taken here.
        point = point + dr.cross(turn, point) + 0.5 * dr.cross(turn, dr.cross(turn, point))
        point = point + mi.Vector3f(*translation) + move
        self.parameters["lump.vertex_positions"] = dr.ravel(point)
        strength = float(np.linalg.norm(light))
        direction = [-value / strength for value in light]
        self.parameters["sun.to_world"] = mi.Transform4f().look_at(
            origin=[0, 0, 0], target=direction, up=[0.3, 0.9, 0.1]
        )
        self.parameters["sun.irradiance.value"] = mi.Color3f(np.pi * strength)
        self.parameters.update()
        return mi.render(self.scene, self.parameters, spp=spp, seed=seed, seed_grad=seed + 1)

    def error(self, poses: Poses, index: int, target: np.ndarray, offset: Any, spp: int, seed: int) -> Any:
        """Squared error of one image against a linear target."""
        difference = self.image(poses, index, offset, spp, seed) - self.mi.TensorXf(target)
        return self.dr.sum(difference * difference, axis=None)

    def gradient(self, poses: Poses, index: int, target: np.ndarray, spp: int, seed: int) -> np.ndarray:
        """[6], by (turn, translation)."""
        dr = self.dr
        offset = [self.mi.Float(0.0) for _ in range(6)]
        dr.enable_grad(offset)
        dr.backward(self.error(poses, index, target, offset, spp, seed))
        return np.array([dr.grad(value).numpy()[0] for value in offset])


def central_differences(error: Callable[[int, float], np.ndarray]) -> np.ndarray:
    """[b, 6] from an error [b] that is a function of axis and step."""
    steps = [TURN_STEP] * 3 + [MOVE_STEP_M] * 3
    return np.stack([(error(i, s) - error(i, -s)) / (2 * s) for i, s in enumerate(steps)], axis=1)


def cosines(found: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Cosine of gradients stacked over all poses, for each group of parameters."""
    groups = {"rotation": slice(0, 3), "position": slice(3, 6)}
    pairs = {name: (found[:, part].ravel(), reference[:, part].ravel()) for name, part in groups.items()}
    return {name: float(a @ b / (np.linalg.norm(a) * np.linalg.norm(b))) for name, (a, b) in pairs.items()}


def moved(poses: Poses, axis: int, step: float) -> Poses:
    """All poses turned (axes 0–2) or moved (3–5) by a step."""
    rotation, translation, light = poses
    change = torch.zeros(len(rotation), 6)
    change[:, axis] = step
    return turned(rotation, change[:, :3]), translation + change[:, 3:], light


def our_cosines(mesh: Mesh, renderer: Renderer, poses: Poses, targets: Poses) -> dict[str, float]:
    """Of our gradients at the timed settings."""
    exact = Renderer([mesh], [0], SIDE, SIDE, ambient=AMBIENT, samples_per_pixel=CONVERGED_SPP)
    with torch.no_grad():
        target = _render(exact, targets, 7)

        def error(axis: int, step: float) -> np.ndarray:
            image = _render(exact, moved(poses, axis, step), 1)
            return (image - target).square().sum((1, 2, 3)).double().numpy()

        reference = central_differences(error)
    return cosines(ours(renderer, poses, target, 3)[0].numpy(), reference)


def stock_reference(stock: Stock, poses: Poses, targets: Poses) -> tuple[list[np.ndarray], np.ndarray]:
    """Converged targets of stock Mitsuba, and central differences of its converged rendering."""
    still = [stock.mi.Float(0.0)] * 6
    count = len(poses[0])
    images = [np.array(stock.image(targets, i, still, CONVERGED_SPP, 7)) for i in range(count)]

    def error(axis: int, step: float) -> np.ndarray:
        offset = [stock.mi.Float(step if i == axis else 0.0) for i in range(6)]
        values = [stock.error(poses, i, images[i], offset, CONVERGED_SPP, 1).numpy() for i in range(count)]
        return np.array(values, dtype=float).ravel()

    return images, central_differences(error)


def rate(work: Callable[[int], int], seconds: float) -> float:
    """Images a second: ``work(round)`` says how many it did; the first round is not counted."""
    work(0)
    begun, done, number = time.perf_counter(), 0, 1
    while time.perf_counter() - begun < seconds:
        done += work(number)
        number += 1
    return done / (time.perf_counter() - begun)


def compare(seconds: float, rounds: int, outline_samples: int) -> dict[str, Any]:
    """The comparison: rates are medians of rounds in which all renderers take turns."""
    mesh = lump()
    poses, targets = draw_poses(BATCH, 1), draw_poses(BATCH, 2)
    targets = (poses[0], poses[1] + 0.1 * (targets[1] - poses[1]), poses[2])
    renderer = Renderer(
        [mesh],
        [0],
        SIDE,
        SIDE,
        ambient=AMBIENT,
        samples_per_pixel=SAMPLES_PER_PIXEL,
        outline_samples=outline_samples,
    )
    best, defaults = Stock(mesh, best=True), Stock(mesh, best=False)
    few = tuple(x[:NUM_REFERENCE] for x in poses), tuple(x[:NUM_REFERENCE] for x in targets)
    with torch.no_grad():
        target = _render(renderer, targets, 5)
    images, reference = stock_reference(best, *few)

    def forward(number: int) -> int:
        with torch.no_grad():
            _render(renderer, poses, number)
        return BATCH

    def both(number: int) -> int:
        ours(renderer, poses, target, number)
        return BATCH

    def one(stock: Stock) -> Callable[[int], int]:
        def work(number: int) -> int:
            index = number % NUM_REFERENCE
            stock.gradient(poses, index, images[index], SAMPLES_PER_PIXEL, number)
            return 1

        return work

    works = {"forward": forward, "ours": both, "stock": one(best), "defaults": one(defaults)}
    rates = [{name: rate(work, seconds) for name, work in works.items()} for _ in range(rounds)]
    medians = {name: float(np.median([r[name] for r in rates])) for name in works}
    stock_gradients = np.stack(
        [best.gradient(few[0], i, images[i], SAMPLES_PER_PIXEL, 3) for i in range(NUM_REFERENCE)]
    )
    our, theirs = our_cosines(mesh, renderer, *few), cosines(stock_gradients, reference)
    return {
        "images_per_s": medians["ours"],
        "stock_images_per_s": medians["stock"],
        "ratio": float(np.median([r["ours"] / r["stock"] for r in rates])),
        "ratio_defaults": float(np.median([r["ours"] / r["defaults"] for r in rates])),
        "gradient_cosine": min(our.values()),
        "stock_gradient_cosine": min(theirs.values()),
        "forward_images_per_s": medians["forward"],
        "gradient_cosines": our,
        "stock_gradient_cosines": theirs,
        "stock_default_images_per_s": medians["defaults"],
        "rounds": rates,
        "settings": {
            "batch": BATCH,
            "side_px": SIDE,
            "samples_per_pixel": SAMPLES_PER_PIXEL,
            "faces": len(mesh.faces),
            "outline_samples": renderer.setting.outline_samples,
            "reference_poses": NUM_REFERENCE,
        },
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object on the last line")
    parser.add_argument("--seconds", type=float, default=8.0, help="a renderer and round")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--outline-samples", type=int, default=512, help="points on each outline, of ours")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # the little that torch does here must not spin beside the renderer's threads
    result = compare(arguments.seconds, arguments.rounds, arguments.outline_samples)
    if not arguments.json:
        for name, value in result.items():
            print(f"{name:>24}  {value}")
    print(json.dumps(result))


if __name__ == "__main__":
    main()
