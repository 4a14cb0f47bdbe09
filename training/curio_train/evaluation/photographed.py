"""Judge what is read in photographs without a label, by drawing it again (paper, section "Real world data").

The prediction is rendered from the own camera and, the paper's novel-view test, from a second known one over its plate,
and compared with what was photographed there: DSSIM sharp, and with both images behind a 9x9 Gaussian filter, which
leaves out much of what no renderer knows of a camera. The empty plate is the measure of all: a prediction that is no
nearer to the photograph than a scene without parts has found nothing.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from curio_train.evaluation.subject import Predict
from curio_train.metrics.images import blurred, dssim
from curio_train.scene_code import SceneCode
from curio_train.worlds.base import View, World

_TRUSTED, _DOUBTFUL = 0.9, 0.6
_NAMES = ("own_view", "second_view")
_BATCH_SIZE = 50


@dataclass(frozen=True, eq=False)
class Judgement:
    """How far re-renderings are from photographs.

    Attributes:
        metrics: Of each view ``…_dssim`` and ``…_dssim_blurred``, the same of the empty plate as ``…_plate_…``, and
            ``better_than_plate``, the share of scenes in which the last view is nearer than its plate.
        verdict: Whether to trust the model, and what to do if not.
        columns: Photograph and re-rendering of each view by heading, [num, 3, height, width] in [0, 1], worst first.
    """

    metrics: Mapping[str, float]
    verdict: str
    columns: Mapping[str, Tensor]

    @property
    def summary(self) -> dict[str, Any]:
        """All but the pictures, as JSON takes it."""
        count = len(next(iter(self.columns.values())))
        return {"num_photographs": count, "metrics": dict(self.metrics), "verdict": self.verdict}


@torch.no_grad()
def judge(world: World, predict: Predict) -> Judgement | None:
    """Compare re-renderings with photographs; None in worlds without photographs to judge by.

    Args:
        world: With its views.
        predict: Reads the own camera's photographs.
    """
    views = world.views()
    if not views:
        return None
    code = _read(predict, views[0].photographs)
    drawn = [_drawn(world, number, code) for number in range(len(views))]
    metrics: dict[str, float] = {}
    for name, view, images in zip(_NAMES, views, drawn, strict=False):
        error, of_plate = _errors(view, images)
        metrics |= {f"{name}_{kind}": float(values.mean()) for kind, values in error.items()}
        metrics |= {f"{name}_plate_{kind}": float(values.mean()) for kind, values in of_plate.items()}
    worst = error["dssim_blurred"]
    metrics["better_than_plate"] = float((worst < of_plate["dssim_blurred"]).double().mean())
    order = worst.argsort(descending=True)
    columns = {}
    for heading, view, images in zip(("", ", second camera"), views, drawn, strict=False):
        columns["photograph" + heading] = view.photographs[order].float() / 255
        columns["prediction" + heading] = images[order]
    return Judgement(metrics, _verdict(metrics["better_than_plate"], len(worst), len(views) > 1), columns)


def _read(predict: Predict, photographs: Tensor) -> SceneCode:
    batches = [predict(batch) for batch in photographs.split(_BATCH_SIZE)]
    return {name: torch.cat([batch[name] for batch in batches]) for name in batches[0]}


def _drawn(world: World, view: int, code: SceneCode) -> Tensor:
    """The scenes as the own (0) or the second camera sees them."""
    return (world.novel_view(code) if view else world.render(code)).clamp(0, 1)


def _errors(view: View, images: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Of re-renderings, and of the plate in place of them."""
    photographs, plate = view.photographs.float() / 255, view.plate.float() / 255
    of_both = []
    for shown in (images, plate.expand_as(photographs)):
        soft = dssim(blurred(shown), blurred(photographs))
        of_both.append({"dssim": dssim(shown, photographs), "dssim_blurred": soft})
    return of_both[0], of_both[1]


def _verdict(share: float, num: int, second: bool) -> str:
    where = "from the second camera" if second else "from the own camera, which cannot tell depth,"
    found = f"in {share:.0%} of {num} scenes what was found, seen {where} is nearer to the photograph than the plate is"
    if share >= _TRUSTED:
        return f"Trust it: {found}."
    if share >= _DOUBTFUL:
        return f"Trust it with care: {found}; look at the worst scenes, and train longer (--images) or --method sleep."
    return (
        f"Do not trust it: {found}. Train longer (--images) or with --method sleep; if that does not help, look "
        "whether --plane, --mesh-unit and --up fit: parts that are drawn beside themselves in the second view do not "
        "stand where the plane is."
    )
