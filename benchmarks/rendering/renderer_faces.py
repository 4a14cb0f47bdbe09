"""What a mesh of 1.3 million faces costs beside one of 5,120, and what tracing it simplified changes.

    python benchmarks/rendering/renderer_faces.py [--json]

Training steps as in training.py, few faces and many in turns: ``step_speed_kept`` and ``renderer_speed_kept`` are the
shares of speed that remain. Then a mesh of 327,680 faces that fills nine tenths of the image, simplified and in full:
``difference_rms`` of the images (sRGB in [0, 1]), ``other_samples_rms`` between two renderings in full that differ in
their samples alone, and the cosine of the gradients by rotation and by position.
"""

import argparse
import json
import statistics
from collections.abc import Callable
from typing import Any

import torch
from curio_train.rendering import renderer as renderer_module
from curio_train.rendering.renderer import Renderer
from renderer import AMBIENT, POSITION, Poses, background, draw_poses, log, our_images, root_mesh
from stock.gradient_check import TURN, cosine, gradients
from torch import Tensor

from training import LumpWorld, lump, measure

FEW_AND_MANY = (4, 8)  # subdivisions: 5,120 and 1,310,720 faces
ROUNDS, STEPS = 5, 3
FINE = 7  # subdivisions: 327,680 faces, which can still be built in full while one waits
SIZES = {(128, 128): 64, (320, 240): 24}
FILLED = 0.9


def speed() -> dict[str, Any]:
    """Steps with few faces and with many; each goes first in every other round."""
    meshes = [lump(subdivisions) for subdivisions in FEW_AND_MANY]
    log("simplifying and building")
    worlds = [LumpWorld(mesh) for mesh in meshes]
    rounds = []
    for turn in range(ROUNDS):
        order = (0, 1) if turn % 2 else (1, 0)
        timed = {k: measure(worlds[k], "bfloat16", STEPS)[1:] for k in order}
        (few, few_rendering), (many, many_rendering) = timed[0], timed[1]
        rounds.append(
            {
                "step_speed_kept": few / many,
                "renderer_speed_kept": few_rendering / many_rendering,
                "renderer_share": many_rendering / many,
            }
        )
        log(f"round {turn + 1} of {ROUNDS}: {rounds[-1]}")
    median = {name: round(statistics.median(r[name] for r in rounds), 3) for name in rounds[0]}
    return {"faces": [len(mesh.faces) for mesh in meshes], **median, "rounds": rounds}


def accuracy(width: int, height: int, count: int) -> dict[str, float]:
    """The fine mesh simplified for images of this size, beside itself."""
    mesh = root_mesh(FINE)
    poses = centred(draw_poses(mesh, count, size=height), mesh.diameter_m, width)
    behind = background(count, 1).expand(count, 3, height, width).contiguous()
    zeros = {name: torch.zeros_like(poses.translation_m) for name in (TURN, POSITION)}
    simple = Renderer([mesh], [0], width, height, ambient=AMBIENT)
    renderer_module.MIN_FACES, usual = len(mesh.faces), renderer_module.MIN_FACES
    full = Renderer([mesh], [0], width, height, ambient=AMBIENT)
    renderer_module.MIN_FACES = usual
    found, expected, other = (
        our_images(renderer, poses, zeros, seed, behind) for renderer, seed in ((simple, 0), (full, 0), (full, 1))
    )
    target = expected.roll((height // 32, height // 32), dims=(2, 3))

    def loss(renderer: Renderer) -> Callable[[Any], Tensor]:
        return lambda moved: (our_images(renderer, poses, moved, 0, behind) - target).square().flatten(1).sum(1)

    ours, theirs = gradients(loss(simple), zeros), gradients(loss(full), zeros)
    return {
        "difference_rms": round(float((found - expected).square().mean().sqrt()), 5),
        "other_samples_rms": round(float((other - expected).square().mean().sqrt()), 5),
        "rotation_cosine": round(cosine(ours[TURN], theirs[TURN]), 4),
        "position_cosine": round(cosine(ours[POSITION], theirs[POSITION]), 4),
    }


def centred(poses: Poses, diameter_m: float, width: int) -> Poses:
    """The same turns in the middle of images of another width, as near as ``FILLED`` says."""
    matrix = poses.matrix.copy()
    matrix[0, 2] = (width - 1) / 2
    place = torch.zeros_like(poses.translation_m)
    place[..., 2] = matrix[1, 1] / poses.size * diameter_m / FILLED
    return Poses(poses.rotation, place, matrix, poses.size)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object (the default indents it)")
    wanted = parser.parse_args()
    figures = {f"{w}x{h}": accuracy(w, h, count) for (w, h), count in SIZES.items()}
    log(f"simplified beside full: {figures}")
    print(json.dumps(speed() | figures, indent=None if wanted.json else 1))


if __name__ == "__main__":
    main()
