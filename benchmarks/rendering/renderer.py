"""Our renderer and stock Mitsuba on the same poses: images a second, and how good the gradients are.

    python benchmarks/rendering/renderer.py --json    ours, stock at its best, stock as it comes; ten minutes
    python benchmarks/rendering/renderer.py --sweep   how cost grows with batch, slots, faces and image size
    python benchmarks/rendering/renderer.py --memory  peak of 128 images with 8 slots, growth over 2,000 steps

The sweep and the memory are written to docs/results.

Gradients are compared at exactly the settings that are timed, as the cosine to central differences of a converged
rendering of the same renderer, the loss being the squared error to another pose; the worse of rotation and position is
the figure. Ours and stock take turns, so that a busy machine slows both.
"""

import argparse
import json
import resource
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from curio_train.geometry import matrix_from_rotation_6d, rotation_6d_from_matrix
from curio_train.meshes.meshes import Mesh
from curio_train.rendering.renderer import Renderer
from curio_train.rendering.variant import load_mitsuba
from scipy.spatial.transform import Rotation
from stock import baseline
from stock.baseline import StockPoses
from stock.gradient_check import TURN, central_differences, cosine, gradients, turned
from torch import Tensor

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results"
SIZE, BATCH, SAMPLES = 128, 128, 4
AMBIENT, LIGHT = 0.3, np.array([0.3, -0.4, -0.8])
NUM_COMPARED, NUM_STOCK_COMPARED, NUM_DEFAULTS_COMPARED = 64, 16, 6
STOCK_CONVERGED = 512  # more than ours needs: stock samples its pixels independently
POSITION = "translation_m"
OFFSETS = {TURN: 0.3, POSITION: 0.01}


def log(text: str) -> None:
    """Progress, on stderr."""
    print(f"{time.strftime('%H:%M:%S')} {text}", file=sys.stderr, flush=True)


def root_mesh(subdivisions: int = 4) -> Mesh:
    """A decimetre of root: concave, without symmetry, with vertex colours; 20 · 4**subdivisions faces (5,120)."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    x, y, z = np.asarray(sphere.vertices).T[:, :, None]
    vertices = 0.05 * sphere.vertices * (1 + 0.3 * np.sin(3 * x) * np.cos(4 * y) + 0.2 * z)
    return Mesh(vertices, np.asarray(sphere.faces), 0.5 + 0.4 * np.sin(40 * vertices + [0, 1, 2]))


@dataclass(frozen=True)
class Poses:
    """Objects that fill a quarter to a half of the image's width: rotation [b, n, 3, 3], translation_m [b, n, 3], K."""

    rotation: Tensor
    translation_m: Tensor
    matrix: np.ndarray
    size: int

    def first(self, count: int) -> "Poses":
        return Poses(self.rotation[:count], self.translation_m[:count], self.matrix, self.size)


def draw_poses(mesh: Mesh, batch: int, num_slots: int = 1, size: int = SIZE) -> Poses:
    """The same for the same arguments."""
    rng = np.random.default_rng(0)
    focal = 0.9 * size
    matrix = np.array([[focal, 0, (size - 1) / 2], [0, focal, (size - 1) / 2], [0, 0, 1]])
    share = rng.uniform(0.25, 0.5, (batch, num_slots, 1))
    depth = 0.9 * mesh.diameter_m / share
    lateral = rng.uniform(-1, 1, (batch, num_slots, 2)) * (0.5 - share / 2) * depth / 0.9
    rotation = Rotation.random(batch * num_slots, random_state=0).as_matrix().reshape(batch, num_slots, 3, 3)
    place = np.concatenate([lateral, depth], axis=2)
    return Poses(*(torch.tensor(v, dtype=torch.float32) for v in (rotation, place)), matrix, size)


def background(count: int, size: int) -> Tensor:
    """What stock shows behind its object: the ambient light, in sRGB."""
    return torch.full((count, 3, size, size), 1.055 * AMBIENT ** (1 / 2.4) - 0.055)


def our_images(renderer: Renderer, poses: Poses, moved: dict[str, Tensor], seed: int, behind: Tensor) -> Tensor:
    """Images of displaced poses, see differences.py."""
    rotation, translation_m = turned(poses.rotation, moved[TURN]), poses.translation_m + moved[POSITION]
    return render(renderer, rotation, translation_m, poses.matrix, seed, behind)


def render(renderer: Renderer, rotation: Tensor, translation_m: Tensor, matrix: np.ndarray, seed: int, behind: Tensor):
    light = torch.tensor(LIGHT, dtype=torch.float32).expand(len(behind), 3)
    return renderer(rotation, translation_m, camera_matrix=matrix, backgrounds=behind, light=light, seed=seed)


def our_step(renderer: Renderer, poses: Poses, *, backward: bool = True) -> Callable[[int], None]:
    """One forward pass from scene codes, and one backward pass to them."""
    behind = background(len(poses.rotation), poses.size)
    adjoint = torch.randn(behind.shape, generator=torch.Generator().manual_seed(0))
    rotation_6d = rotation_6d_from_matrix(poses.rotation)

    def step(seed: int) -> None:
        code = [v.clone().requires_grad_(backward) for v in (rotation_6d, poses.translation_m)]
        images = render(renderer, matrix_from_rotation_6d(code[0]), code[1], poses.matrix, seed, behind)
        if backward:
            images.backward(adjoint)

    return step


def seconds(step: Callable[[int], Any], repeats: int) -> list[float]:
    """Wall times of single calls."""
    found = []
    for seed in range(repeats):
        start = time.perf_counter()
        step(seed)
        found.append(time.perf_counter() - start)
    return found


def our_cosine(mesh: Mesh, poses: Poses) -> float:
    """Of the gradients at the timed samples to central differences at 144 a pixel."""
    timed = Renderer([mesh], [0], SIZE, SIZE, ambient=AMBIENT, samples_per_pixel=SAMPLES)
    converged = Renderer([mesh], [0], SIZE, SIZE, ambient=AMBIENT, samples_per_pixel=144)
    behind = background(len(poses.rotation), SIZE)
    zeros = {name: torch.zeros_like(poses.translation_m) for name in OFFSETS}
    noise = torch.Generator().manual_seed(9)
    offsets = {name: scale * torch.randn(zeros[name].shape, generator=noise) for name, scale in OFFSETS.items()}
    with torch.no_grad():
        target = our_images(converged, poses, offsets, 1, behind)

    def loss(renderer: Renderer, seed: int) -> Callable[[Any], Tensor]:
        return lambda m: (our_images(renderer, poses, m, seed, behind) - target).square().flatten(1).sum(1)

    expected = central_differences(loss(converged, 2), zeros, list(OFFSETS))
    found = gradients(loss(timed, 3), zeros)
    cosines = {name: cosine(found[name], expected[name]) for name in OFFSETS}
    log(f"ours: cosine of {cosines} over {len(poses.rotation)} poses")
    return min(cosines.values())


class Stock:
    """Stock Mitsuba on single poses of a batch."""

    def __init__(self, mesh: Mesh, poses: Poses) -> None:
        import drjit

        mitsuba = load_mitsuba()
        mitsuba.set_log_level(mitsuba.LogLevel.Error)  # it warns on stdout of motion across the frame's border
        self.rotation, self.place = (v[:, 0].double().numpy() for v in (poses.rotation, poses.translation_m))

        def build(integrator: Any, samples: int) -> StockPoses:
            size = (poses.size, poses.size)
            return StockPoses(mitsuba, drjit, mesh, poses.matrix, size, AMBIENT, LIGHT, integrator, samples)

        self.best, self.defaults = build(baseline.BEST, SAMPLES), build(baseline.DEFAULTS, SAMPLES)
        self.converged = build(baseline.REFERENCE, STOCK_CONVERGED)
        self.black = np.zeros((poses.size, poses.size, 3), dtype=np.float32)

    def step(self, poses: StockPoses) -> Callable[[int], np.ndarray]:
        """One forward and backward pass of the pose with the seed's number."""
        return lambda seed: poses.gradient(self.rotation[seed], self.place[seed], self.black, seed)

    def cosines(self) -> dict[str, float]:
        """Of the gradients at the timed samples to central differences of converged images, best and defaults."""
        rng = np.random.default_rng(9)
        found: dict[str, list[np.ndarray]] = {"best": [], "defaults": [], "expected": []}
        for i in range(NUM_STOCK_COMPARED):
            turn, shift = rng.normal(size=(2, 3)) * [[OFFSETS[TURN]], [OFFSETS[POSITION]]]
            target = self.converged.image(_turned(turn) @ self.rotation[i], self.place[i] + shift, 1)
            found["best"].append(self.best.gradient(self.rotation[i], self.place[i], target, i))
            if i < NUM_DEFAULTS_COMPARED:
                found["defaults"].append(self.defaults.gradient(self.rotation[i], self.place[i], target, i))
            found["expected"].append(self._differences(i, target))
        result = {}
        for name in ("best", "defaults"):
            pairs = [np.array(found[key][: len(found[name])]).reshape(-1, 2, 3) for key in (name, "expected")]
            groups = [cosine(*(torch.tensor(v[:, k]) for v in pairs)) for k in range(2)]
            log(f"stock, {name}: cosine of rotation, position {groups} over {len(found[name])} poses")
            result[name] = min(groups)
        return result

    def _differences(self, i: int, target: np.ndarray) -> np.ndarray:
        found = []
        for step in np.diag([0.01] * 3 + [0.0005] * 3):
            ends = [
                np.square(
                    self.converged.image(_turned(s * step[:3]) @ self.rotation[i], self.place[i] + s * step[3:], 2)
                    - target
                ).sum()
                for s in (1, -1)
            ]
            found.append((ends[0] - ends[1]) / (2 * step.max()))
        return np.array(found)


def _turned(rotvec: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(rotvec).as_matrix()


def compare() -> dict[str, float]:
    """The figures of ``--json``."""
    mesh = root_mesh()
    poses = draw_poses(mesh, BATCH)
    renderer = Renderer([mesh], [0], SIZE, SIZE, ambient=AMBIENT, samples_per_pixel=SAMPLES)
    step, forward, stock = our_step(renderer, poses), our_step(renderer, poses, backward=False), Stock(mesh, poses)
    log("compiling kernels")
    for warm in (step, forward, stock.step(stock.best), stock.step(stock.defaults)):
        seconds(warm, 2)
    ours, ours_forward, best, defaults = [], [], [], []
    for turn in range(8):
        ours += seconds(step, 4)
        best += seconds(stock.step(stock.best), 6)
        ours_forward += seconds(forward, 2)
        defaults += seconds(stock.step(stock.defaults), 1)
        log(f"round {turn + 1} of 8: {BATCH / ours[-1]:.0f} images/s, stock {1 / best[-1]:.1f} images/s")
    images_per_s, stock_images_per_s = BATCH / statistics.median(ours), 1 / statistics.median(best)
    log("differences of converged renderings")
    stock_cosines = stock.cosines()
    return {
        "images_per_s": round(images_per_s, 1),
        "stock_images_per_s": round(stock_images_per_s, 2),
        "ratio": round(images_per_s / stock_images_per_s, 1),
        "ratio_defaults": round(images_per_s * statistics.median(defaults), 1),
        "gradient_cosine": round(our_cosine(mesh, poses.first(NUM_COMPARED)), 4),
        "stock_gradient_cosine": round(stock_cosines["best"], 4),
        "forward_images_per_s": round(BATCH / statistics.median(ours_forward), 1),
    }


def sweep_point(subdivisions: int, batch: int, num_slots: int, size: int) -> dict[str, float]:
    """Forward and backward of one combination."""
    mesh = root_mesh(subdivisions)
    start = time.perf_counter()
    renderer = Renderer([mesh], [0] * num_slots, size, size, ambient=AMBIENT, samples_per_pixel=SAMPLES)
    built = time.perf_counter() - start
    step = our_step(renderer, draw_poses(mesh, batch, num_slots, size))
    seconds(step, 2)
    wall = statistics.median(seconds(step, 7))
    log(f"{len(mesh.faces)} faces, {batch} images, {num_slots} slots, {size} px: {batch / wall:.1f} images/s")
    return {
        "images_per_s": round(batch / wall, 1),
        "seconds_per_step": round(wall, 4),
        "seconds_to_build": round(built, 2),
    }


def sweep() -> dict[str, list[dict[str, float]]]:
    """One axis at a time, the others as in the comparison (image sizes with 16 images)."""
    return {
        "batch": [{"batch": n, **sweep_point(4, n, 1, SIZE)} for n in (1, 2, 4, 8, 16, 32, 64, 128, 256, 512)],
        "slots": [{"slots": n, **sweep_point(4, BATCH, n, SIZE)} for n in (1, 2, 4, 6, 8, 10)],
        "faces": [{"faces": 20 * 4**s, **sweep_point(s, BATCH, 1, SIZE)} for s in range(1, 9)],
        "image_size": [{"image_size": n, **sweep_point(4, 16, 1, n)} for n in (64, 96, 128, 192, 256, 384, 512)],
    }


def plot(points: dict[str, list[dict[str, float]]], path: Path) -> None:
    """Four panels of images a second."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 6), layout="constrained")
    titles = {
        "batch": "images a batch",
        "slots": "slots an image",
        "faces": "faces",
        "image_size": "image size, pixels",
    }
    for axes, (name, label) in zip(figure.subplots(2, 2).flat, titles.items(), strict=True):
        axes.plot([p[name] for p in points[name]], [p["images_per_s"] for p in points[name]], marker="o")
        axes.set(xlabel=label, ylabel="images/s, forward + backward", xscale="log", yscale="log")
        axes.grid(True, which="both", alpha=0.3)
    figure.suptitle(
        "One object of 5,120 faces, 128 images of 128x128, 4 samples a pixel, unless the axis says otherwise"
    )
    figure.savefig(path, dpi=110)


def memory() -> dict[str, float]:
    """Peak of the whole process in GiB at 128 images with 8 slots, then growth over 2,000 smaller steps."""
    mesh = root_mesh()
    renderer = Renderer([mesh], [0] * 8, SIZE, SIZE, ambient=AMBIENT, samples_per_pixel=SAMPLES)
    seconds(our_step(renderer, draw_poses(mesh, BATCH, 8)), 3)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    log(f"peak {peak:.2f} GiB")
    step = our_step(renderer, draw_poses(mesh, 8, 8))
    resident = []
    for seed in range(2100):
        step(seed)
        if seed % 100 == 99:
            resident.append(_resident_mib())
    log(f"resident MiB every 100 steps: {[round(v) for v in resident]}")
    return {"peak_gib": round(peak, 2), "growth_mib_in_2000_steps": round(resident[-1] - resident[0], 1)}


def _resident_mib() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--json", action="store_true", help="print the comparison as one JSON object (the default prints lines)"
    )
    parser.add_argument(
        "--sweep", action="store_true", help="measure how cost grows; writes renderer_sweep.json and .png"
    )
    parser.add_argument("--memory", action="store_true", help="measure memory; writes renderer_memory.json")
    wanted = parser.parse_args()
    if wanted.sweep:
        points = sweep()
        (RESULTS / "renderer_sweep.json").write_text(json.dumps(points, indent=1) + "\n")
        plot(points, RESULTS / "renderer_sweep.png")
    elif wanted.memory:
        (RESULTS / "renderer_memory.json").write_text(json.dumps(memory()) + "\n")
    else:
        figures = compare()
        print(
            json.dumps(figures) if wanted.json else "\n".join(f"{key:>24} {value:g}" for key, value in figures.items())
        )


if __name__ == "__main__":
    main()
