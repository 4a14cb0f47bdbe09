"""Watching it learn (paper, appendix, section "Visualizing training"): image loss, curiosity, and both.

    python benchmarks/closed_form/watching.py [--json] [--steps 1200] [--out docs/results]

One disc in five dimensions (x, y, r, g, b) and in six (z as well), each learned three times. Writes a GIF a scene,
watching_5d.gif and watching_6d.gif, in which the top row shows the images and the others what each loss makes of them
from step to step; and watching.png, the same as a sheet of moments. Printed: how far the discs of 500 images are from
where they are in the end, in image widths and units of z, and their squared colour error.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, get_args

import numpy as np
import torch
import tyro
from curio_train.learning.runs.provenance import commit, machine
from curio_train.metrics.assignment import parameter_errors
from discs.watching import Discs, Loss, Moment, Scene, watch
from PIL import Image

_LOSSES: Sequence[Loss] = get_args(Loss)
_NUM_SHOWN, _NUM_SCORED, _NUM_FRAMES, _NUM_MOMENTS = 8, 500, 60, 7
_GAP = 2  # pixels between pictures


@dataclass(frozen=True, eq=False)
class Story:
    """A scene's images, and the moments of learning by loss."""

    images: np.ndarray
    moments: dict[Loss, list[Moment]]


def tell(scene: Scene, steps: int, seed: int) -> tuple[Story, dict[str, dict[str, float]]]:
    """Learn a scene with each loss; the errors at the end by loss."""
    world = Discs(scene)
    truth = world.sample(_NUM_SCORED, (seed, 0, 1))
    images = world.render(truth)
    moments, errors = {}, {}
    for loss in _LOSSES:
        every = max(1, steps // _NUM_FRAMES)
        moments[loss] = list(watch(world, loss, images[:_NUM_SHOWN], steps, every, seed))
        errors[loss] = parameter_errors(world.layout, moments[loss][-1].read(images), truth)
    return Story(images[:_NUM_SHOWN].numpy(), moments), errors


def row(images: np.ndarray) -> np.ndarray:
    """Pictures [num, 3, h, w] side by side, [h, width, 3] bytes."""
    padded = np.pad(images, ((0, 0), (0, 0), (_GAP, _GAP), (_GAP, _GAP)), constant_values=1.0)
    return (np.concatenate(padded.transpose(0, 2, 3, 1), axis=1).clip(0, 1) * 255).round().astype(np.uint8)


def animate(story: Story, file: Path) -> None:
    """A frame a moment: the images, then a row a loss."""
    num = min(len(moments) for moments in story.moments.values())
    frames = []
    for number in range(num):
        shown = [story.moments[loss][number].rendered.numpy() for loss in _LOSSES]
        frames.append(Image.fromarray(np.concatenate([row(story.images), *map(row, shown)])).quantize(64))
    times = [100] * (num - 1) + [3000]
    frames[0].save(file, save_all=True, append_images=frames[1:], duration=times, loop=0, optimize=True)


def sheet(stories: dict[Scene, Story], file: Path) -> None:
    """A row a scene and loss: the way of one image at a few moments, then some images above what became of them."""
    from matplotlib.figure import Figure

    rows = [(scene, loss) for scene in stories for loss in _LOSSES]
    figure = Figure(figsize=(13, 1.35 * len(rows)), layout="constrained")
    axes = figure.subplots(len(rows), 2, width_ratios=(_NUM_MOMENTS + 1, _NUM_SHOWN), squeeze=False)
    for (scene, loss), (left, right) in zip(rows, axes, strict=True):
        story = stories[scene]
        moments = story.moments[loss]
        chosen = [moments[int(n)] for n in np.linspace(0, 1, _NUM_MOMENTS) ** 1.5 * (len(moments) - 1)]
        way = [story.images[:1], *(moment.rendered[:1].numpy() for moment in chosen)]
        left.imshow(row(np.concatenate(way)))
        end = moments[-1].rendered.numpy()
        right.imshow(np.concatenate([row(story.images), row(end)]))
        left.set_title(f"{scene}, {loss}: image, then steps {', '.join(str(m.step) for m in chosen)}", fontsize=8)
        right.set_title("images above, predictions at the end below", fontsize=8)
        left.set_axis_off()
        right.set_axis_off()
    figure.savefig(file, dpi=70)


def main(
    json_output: Annotated[bool, tyro.conf.arg(name="json")] = False,
    steps: int = 1200,
    seed: int = 0,
    out: Path = Path("docs/results"),
) -> None:
    """Learn both scenes with each loss, and draw how it went.

    Args:
        json_output: Print one JSON object instead of a line a scene and loss.
        steps: Of training, 32 images each.
        seed: Of weights and images.
        out: Folder of the pictures.
    """
    torch.set_num_threads(1)  # tiny networks
    started = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    stories: dict[Scene, Story] = {}
    result: dict[str, Any] = {}
    for scene in get_args(Scene):
        stories[scene], result[scene] = tell(scene, steps, seed)
        animate(stories[scene], out / f"watching_{scene.lower()}.gif")
    sheet(stories, out / "watching.png")
    if json_output:
        seconds = round(time.monotonic() - started, 1)
        made = {"steps": steps, "seed": seed, "seconds": seconds, "machine": machine(), "commit": commit()}
        print(json.dumps(result | made))
        return
    for scene, by_loss in result.items():
        for loss, errors in by_loss.items():
            print(f"{scene} {loss:>10}: position {errors['position']:.3f} off, colour {errors['color_mse']:.4f}")


if __name__ == "__main__":
    tyro.cli(main)
