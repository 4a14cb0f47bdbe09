"""From how far does the image loss lead back? What gradients alone can find in the worlds on the ground.

    python benchmarks/paper/basins.py [--worlds chairs multi light] [--scenes 24] [--steps 60] [--json]

Starts from true scenes in which one object is turned, or moved in a random direction, or has exchanged its place with
one of another shape; everything else is known. The image loss then descends its gradient in the places and yaws of all
objects, once between the images as they are and once between blurred ones. Printed, and in docs/results/basins.json:
the share of those objects that come back.

yaw_deg, position_m   by how far the object was off: the share within 10 degrees, or 30 mm, in the end
exchanged             the share within 30 mm; null where all objects have one shape
"""

import json
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from curio_train.geometry import matrix_from_yaw, rotation_angle_deg
from curio_train.learning.runs.provenance import commit, machine
from curio_train.metrics.images import blurred
from curio_train.scene_code import CONFIDENCE, TRANSLATION, YAW, SceneCode, index
from curio_train.worlds import WORLDS, build
from curio_train.worlds.base import World
from curio_train.worlds.generated.hypotheses.descent import Descent
from torch import Tensor

_TURNS_DEG, _MOVES_M = (15, 30, 60, 90, 180), (0.05, 0.1, 0.2, 0.4)
_BLUR_SIDE_PX = 25  # of the Gaussian filter, 4.1 pixels wide
_BACK_DEG, _BACK_M = 10.0, 0.03
_FIRST_STEPS, _SLOWER = {TRANSLATION: 0.02, YAW: 0.1}, 0.97  # see Descent


@dataclass(frozen=True)
class Settings:
    """What to run.

    Attributes:
        worlds: Those with yaws on the ground.
        scenes: Of each world; a different object is off in each.
        steps: Of descent.
        seed: Of scenes and directions.
        json: Print the result as one JSON object on the last line.
        out: The file of results.
    """

    worlds: tuple[Literal["chairs", "multi", "light"], ...] = ("chairs", "multi", "light")
    scenes: int = 24
    steps: int = 60
    seed: int = 0
    json: bool = False
    out: Path = Path("docs/results/basins.json")


class Scenes:
    """Scenes of a world, in each of which one object is put in the wrong place or yaw."""

    several_shapes: Tensor
    """Whether each scene has an object of another shape than that one, [scenes]."""

    def __init__(self, world: World, count: int, seed: int) -> None:
        self._world, self._count = world, count
        self._code = world.sample(count, (seed, 0))
        present = self._code.get(CONFIDENCE, torch.ones(count, world.layout.num_slots, 1))[..., 0]
        random = torch.Generator().manual_seed(seed)
        self._slot = torch.multinomial(present, 1, generator=random)[:, 0]
        self._angle = 2 * math.pi * torch.rand(count, generator=random)
        kind = torch.tensor([number for number, kind in enumerate(world.objects) for _ in kind.slots])
        others = present * (kind[None] != kind[self._slot][:, None])
        self.several_shapes = others.sum(dim=1) > 0
        self._other = torch.multinomial(others + ~self.several_shapes[:, None] * 1.0, 1, generator=random)[:, 0]
        with torch.no_grad():
            self._images = world.render(self._code)

    def turned(self, degrees: float) -> dict[str, Tensor]:
        """With that object turned, to either side in turns."""
        sign = torch.ones(self._count)
        sign[1::2] = -1
        yaw = self._code[YAW][self._rows, self._slot]
        angle = torch.atan2(yaw[:, 1], yaw[:, 0]) + sign * math.radians(degrees)
        return self._with(YAW, torch.stack([angle.cos(), angle.sin()], dim=-1))

    def moved(self, meters: float) -> dict[str, Tensor]:
        """With that object moved along the ground."""
        zero = torch.zeros(self._count)
        step = meters * torch.stack([self._angle.cos(), zero, self._angle.sin()], dim=-1)
        return self._with(TRANSLATION, self._code[TRANSLATION][self._rows, self._slot] + step)

    def exchanged(self) -> dict[str, Tensor]:
        """With that object in the place of one of another shape where there is one, and the other way round."""
        code = self._with(TRANSLATION, self._code[TRANSLATION][self._rows, self._other])
        code[TRANSLATION][self._rows, self._other] = self._code[TRANSLATION][self._rows, self._slot]
        return code

    def descended(self, start: SceneCode, steps: int, side_px: int) -> dict[str, Tensor]:
        """Where the image loss leads from there."""
        descent, images = Descent(start, _FIRST_STEPS, _SLOWER), blurred(self._images, side_px)
        for _ in range(steps):
            rendered = blurred(self._world.render({**start, **descent.free}), side_px)
            descent.step((rendered - images).square().sum())
        return {**start, **{name: value.detach() for name, value in descent.free.items()}}

    def are_back(self, found: SceneCode, name: str) -> Tensor:
        """Whether the object of each scene is back."""
        one, true = (code[name][self._rows, self._slot] for code in (found, self._code))
        if name == YAW:
            return rotation_angle_deg(matrix_from_yaw(one), matrix_from_yaw(true)) < _BACK_DEG
        return (one - true).norm(dim=-1) < _BACK_M

    @property
    def _rows(self) -> Tensor:
        return torch.arange(self._count)

    def _with(self, name: str, values: Tensor) -> dict[str, Tensor]:
        code = index(self._code, slice(None))
        code[name] = code[name].clone()
        code[name][self._rows, self._slot] = values
        return code


def shares(scenes: Scenes, steps: int, side_px: int) -> dict[str, Any]:
    """By kind of error and its size, the share of objects that come back."""

    def back(start: SceneCode, name: str) -> Tensor:
        return scenes.are_back(scenes.descended(start, steps, side_px), name).float()

    def share(start: SceneCode, name: str) -> float:
        return round(float(back(start, name).mean()), 3)

    apart = scenes.several_shapes
    exchanged = back(scenes.exchanged(), TRANSLATION)[apart].mean() if apart.any() else None
    return {
        "exchanged": None if exchanged is None else round(float(exchanged), 3),
        "yaw_deg": {str(size): share(scenes.turned(size), YAW) for size in _TURNS_DEG},
        "position_m": {str(size): share(scenes.moved(size), TRANSLATION) for size in _MOVES_M},
    }


def main(settings: Settings) -> None:
    """All worlds, sharp and blurred."""
    torch.set_num_threads(1)
    begun, result = time.monotonic(), dict[str, Any]()
    for name in settings.worlds:
        scenes = Scenes(build(WORLDS[name]()), settings.scenes, settings.seed)
        result[name] = {}
        for look, side_px in (("sharp", 1), ("blurred", _BLUR_SIDE_PX)):
            result[name][look] = shares(scenes, settings.steps, side_px)
            print(name, look, result[name][look], file=sys.stderr)
    made = {"scenes": settings.scenes, "steps": settings.steps, "seed": settings.seed, "blur_side_px": _BLUR_SIDE_PX}
    result |= made | {"minutes": (time.monotonic() - begun) / 60, "machine": machine(), "commit": commit()}
    settings.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    if settings.json:
        print(json.dumps(result))


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
