"""The frames in samples/: a data set's objects over clutter of our own making, to try models on.

    python benchmarks/pictures/samples.py --data DIR

Nothing of the data set but its meshes and camera enters a frame. True poses lie beside them in poses.json.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
import tyro
from curio_train.commands.command_line.running import answer
from curio_train.data.backgrounds import ClutterBackgrounds
from curio_train.data.bop import BopDataset
from curio_train.geometry import Pose
from curio_train.rendering.renderer import Renderer
from curio_train.worlds.single_object.viewpoints import (
    AMBIENT,
    allocentric_to_egocentric,
    random_lights,
    upper_hemisphere_rotations,
)
from torch import Tensor

SEED = 20_211
NEAR_M, FAR_M = 0.6, 1.0
LARGEST_SLOPE = (0.42, 0.30)  # of a frame 640 pixels wide at LineMOD's focal length: objects are whole
APART = 0.17  # least distance of two objects' slopes


@dataclass(frozen=True)
class Settings:
    """What to draw.

    Attributes:
        data: BOP data set whose meshes and camera are used.
        out: Folder of the frames.
        num_frames: How many.
        cache: Where clutter is kept.
    """

    data: Path
    out: Path = Path("samples")
    num_frames: int = 4
    cache: Path = Path("~/.cache/curio-pose")


def draw(settings: Settings) -> int:
    """Render all frames, each with every object that found a free place."""
    dataset = BopDataset(settings.data)
    names, camera, random = dataset.classes, dataset.camera, np.random.default_rng(SEED)
    meshes = [dataset.mesh(name) for name in names]
    renderer = Renderer(meshes, range(len(names)), camera.width, camera.height, ambient=AMBIENT)
    behind = ClutterBackgrounds.cached(settings.cache).split(train=False)
    settings.out.mkdir(parents=True, exist_ok=True)
    poses: dict[str, list[dict[str, object]]] = {}
    for number in range(settings.num_frames):
        place = _places(len(names), random)
        rotation = allocentric_to_egocentric(place, upper_hemisphere_rotations(len(names), random))
        with torch.no_grad():
            image = renderer(
                rotation[None],
                place[None],
                camera_matrix=camera.matrix,
                backgrounds=behind.draw(1, camera.width, camera.height, (SEED, number)),
                light=random_lights(1, random),
                seed=number,
            )[0]
        name = f"{number:02d}.jpg"
        _write(settings.out / name, image, random)
        poses[name] = [
            _record(name, Pose(*pose)) for name, *pose in zip(names, rotation.numpy(), place.numpy(), strict=True)
        ]
    description = {"camera_matrix": camera.matrix.tolist(), "width": camera.width, "height": camera.height}
    (settings.out / "camera.json").write_text(json.dumps(description) + "\n", encoding="utf-8")
    (settings.out / "poses.json").write_text(json.dumps(poses, indent=1) + "\n", encoding="utf-8")
    print(f"{settings.out}: {settings.num_frames} frames of {', '.join(names)}")
    return 0


def _places(count: int, random: np.random.Generator) -> Tensor:
    """Positions [count, 3], metres, none before another."""
    slopes: list[np.ndarray] = []
    while len(slopes) < count:
        slope = random.uniform(-1, 1, 2) * LARGEST_SLOPE
        if all(np.linalg.norm(slope - other) > APART for other in slopes):
            slopes.append(slope)
    depth = random.uniform(NEAR_M, FAR_M, (count, 1))
    return torch.from_numpy(np.concatenate([np.stack(slopes) * depth, depth], axis=1)).float()


def _record(name: str, pose: Pose) -> dict[str, object]:
    return {"object": name, "rotation": pose.rotation.round(6).tolist(), "translation_m": pose.translation_m.tolist()}


def _write(path: Path, image: Tensor, random: np.random.Generator) -> None:
    """A little noise, as a sensor's, then JPEG."""
    pixels = image.clamp(0, 1).permute(1, 2, 0).numpy() * 255 + random.normal(0, 2, (*image.shape[1:], 3))
    cv2.imwrite(str(path), pixels.clip(0, 255).astype(np.uint8)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])


if __name__ == "__main__":
    parsed = tyro.cli(Settings, description=__doc__)
    raise SystemExit(answer(lambda _: draw(parsed)))
