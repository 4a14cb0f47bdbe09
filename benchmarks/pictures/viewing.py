"""How fast the page of curio-view follows an edit: ``python benchmarks/pictures/viewing.py [--json]``.

pictures_per_second   comparisons of a photograph with the re-rendering of an edited scene, one object, 256x256 pixels,
                      on all cores; the page sends each of them to the browser. At least 10 on two cores
"""

import dataclasses
import json
import os
import statistics
import time
from dataclasses import dataclass

import numpy as np
import tyro
from curio_train.drawing.pictures import SceneContext
from curio_train.drawing.scenes import Placed, Scene
from curio_train.geometry import Pose
from curio_train.meshes.shapes import chair
from curio_train.viewing.comparison import HEIGHT_PX, compare
from curio_train.viewing.pages import Page

K = np.array([[300.0, 0, 127.5], [0, 300.0, 127.5], [0, 0, 1]])


@dataclass(frozen=True)
class Arguments:
    """Measure how fast re-renderings follow edits."""

    json: bool = False
    """Print one JSON object on the last line instead of a table."""
    edits: int = 100
    """Edits that are timed."""


def main() -> None:
    """Move an object a little, again and again, and compare each time."""
    arguments = tyro.cli(Arguments)
    mesh = chair(0.2)
    scene = Scene("timed", HEIGHT_PX, HEIGHT_PX, K, (Placed("chair", Pose(np.eye(3), np.array([0, 0, 0.6]))),), None)
    image = np.full((HEIGHT_PX, HEIGHT_PX, 3), 128, np.uint8)
    page = Page(scene, SceneContext({"chair": mesh}), image, over_image=True)
    seconds = []
    for number in range(arguments.edits + 1):
        item = scene.objects[0]
        moved = dataclasses.replace(item, pose=Pose(np.eye(3), np.array([0.0005 * number, 0, 0.6])))
        begin = time.perf_counter()
        compare(dataclasses.replace(page, scene=dataclasses.replace(scene, objects=(moved,))))
        seconds.append(time.perf_counter() - begin)
    figures = {
        "pictures_per_second": round(1 / statistics.median(seconds[1:]), 1),  # the first compiles kernels
        "first_picture_s": round(seconds[0], 2),
        "cores": len(os.sched_getaffinity(0)),
    }
    print(json.dumps(figures) if arguments.json else "\n".join(f"{name:22} {value}" for name, value in figures.items()))


if __name__ == "__main__":
    main()
