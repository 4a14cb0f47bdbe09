"""Judge what is read in photographs without a label, by drawing it again (paper, section "Real world data").

The prediction is rendered from the own camera and compared with what was photographed there: agreement inside the
silhouette and around it (``agreement.py``). On a plane, and for the paper's novel-view test from a second known camera
over its background image, also by DSSIM sharp, and with both images behind a 9x9 Gaussian filter, which leaves out much
of what no renderer knows of a camera. The empty background image is the measure there: a prediction that is no nearer
to the photograph than a scene without parts has found nothing.

In free space a photograph agrees where the overlap is 0.75 or more, or where no background image is known, 0.4 or more
of it is explained. Of the 250 photographs of ``agreement.py`` 93 % of the right poses had such an overlap (were so
explained: 95 %), and 21 % (43 %) of those turned by more than 30 degrees: a model that is right everywhere agrees with
over nine photographs in ten. Of what agreed 41 % were right to a tenth of the diameter and 80 % to a fifth, of the rest
13 % and 42 %; without a background image nearly the same.

On a plane, a scene without parts is easily beaten: parts that lie on their sides instead of standing (a wrong --up)
were nearer to the photographs than it in all of ten scenes. Their overlap was 0.40, that of parts that stood 0.69.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from curio_train.evaluation.subject import Predict
from curio_train.evaluation.unlabelled.agreement import differing, draw, inlier_ratio, inside, overlap
from curio_train.evaluation.unlabelled.closeups import closeups, outlined
from curio_train.metrics.images import blurred, dssim
from curio_train.scene_code import CONFIDENCE, TRANSLATION, SceneCode
from curio_train.worlds.base import PhotographSet, World
from curio_train.worlds.capture import CapturePhotographs
from curio_train.worlds.several_objects.world import SeveralObjectsWorld
from curio_train.worlds.single_object.two_stage import TwoStageWorld
from curio_train.worlds.tabletop.world import TabletopWorld

_TRUSTED, _DOUBTFUL = 0.9, 0.6
_LEAST_OVERLAP = 0.55  # on a plane, of what is trusted
_NAMES = ("own_view", "second_view")
_AGREES = {"overlap": 0.75, "explained": 0.4}
_NUM_IN_SPACE = 48
_DRAWN_AT_ONCE = 8  # frames of a camera are larger than images of a plane
_LIKELY = 0.5  # confidence from which parts are drawn in free space, whether they explain the photograph or not


@dataclass(frozen=True, eq=False)
class Judgement:
    """Metrics that compare re-renderings with photographs, and a verdict in words."""

    metrics: Mapping[str, float]
    """Means ``own_view_inside`` and ``own_view_overlap`` (without a background image ``own_view_explained``).

    In free space also ``own_view_agreeing``, the fraction of photographs that agree. On a plane, of each view,
    ``…_dssim`` and ``…_dssim_blurred``, the same of the empty background image as ``…_plate_…``, and
    ``better_than_plate``, the fraction of scenes in which the last view is nearer than its background image.
    """
    verdict: str
    """Whether to trust the model, and what to do if not."""
    columns: Mapping[str, Tensor]
    """Photographs, close-ups and re-renderings by heading, [num, 3, height, width] in [0, 1], worst first."""
    captions: Sequence[str]
    """The file and the figures of each row; on a plane also how many of which parts were found."""

    @property
    def summary(self) -> dict[str, Any]:
        """All but the pictures, as JSON takes it."""
        return {"num_photographs": len(self.captions), "metrics": dict(self.metrics), "verdict": self.verdict}


@torch.no_grad()
def judge(world: World, predict: Predict) -> Judgement | None:
    """Compare re-renderings with photographs; None in worlds without photographs to judge by.

    Args:
        world: With its photographs.
        predict: Reads the own camera's photographs.

    Raises:
        DataError: A photograph or the background image cannot be read, or is not of the camera's size.
    """
    if isinstance(world, TabletopWorld):
        return _on_plane(world, predict)
    if isinstance(world, TwoStageWorld | SeveralObjectsWorld) and isinstance(world.photographs, CapturePhotographs):
        photographs = world.photographs
        paths, judged = photographs.judged(_NUM_IN_SPACE)
        names = [path.name for path in paths]
        return _in_space(world, predict, names, judged, photographs.background_image())
    return None


def _on_plane(world: TabletopWorld, predict: Predict) -> Judgement:
    views = [view for view in (world.photographs.own, world.photographs.second) if view is not None]
    code = predict(views[0].photographs)
    drawn = [_drawn(world, number, code) for number in range(len(views))]
    photographs, background_image = views[0].photographs.float() / 255, views[0].background_image.float() / 255
    agreed, *_ = _agreement(
        world, _certain(code), photographs, background_image, _differing(photographs, background_image)
    )
    metrics = _means(agreed)
    for name, view, images in zip(_NAMES, views, drawn, strict=False):
        error, of_background_image = _errors(view, images)
        metrics |= {f"{name}_{kind}": float(values.mean()) for kind, values in error.items()}
        metrics |= {f"{name}_plate_{kind}": float(values.mean()) for kind, values in of_background_image.items()}
    worst = error["dssim_blurred"]
    metrics["better_than_plate"] = float((worst < of_background_image["dssim_blurred"]).double().mean())
    order = worst.argsort(descending=True)
    columns = {}
    for heading, view, images in zip(("", ", second camera"), views, drawn, strict=False):
        columns["photograph" + heading] = view.photographs[order].float() / 255
        columns["prediction" + heading] = images[order]
    verdict = _verdict(metrics["better_than_plate"], metrics["own_view_overlap"], len(worst), len(views) > 1)
    found, names = _found(world, code), views[0].names or [""] * len(worst)
    figures = _captions(agreed | {"blurred DSSIM": worst}, order)
    captions = [
        "\n".join(line for line in (names[row], found[row], text) if line)
        for row, text in zip(order.tolist(), figures, strict=True)
    ]
    return Judgement(metrics, verdict, columns, captions)


def _found(world: World, code: SceneCode) -> list[str]:
    """How many of which parts were found in each image, such as "2 bracket, 1 cube"."""
    there = _certain(code).get(CONFIDENCE, torch.ones_like(code[TRANSLATION][..., :1]))[..., 0]
    counts = {kind.name: there[:, list(kind.slots)].sum(dim=1).long().tolist() for kind in world.objects}
    return [", ".join(f"{count[row]} {name}" for name, count in counts.items()) for row in range(len(there))]


def _in_space(
    world: World, predict: Predict, names: Sequence[str], photographs: Tensor, background_image: Tensor | None
) -> Judgement:
    code = dict(predict((photographs * 255).round().byte()))
    differs = None if background_image is None else _differing(photographs, background_image)
    if CONFIDENCE in code:
        code[CONFIDENCE] = _shown(world, code, photographs, background_image, differs)
    agreed, images, masks = _agreement(world, code, photographs, background_image, differs)
    measure = "explained" if background_image is None else "overlap"
    order = agreed[measure].argsort()
    metrics = _means(agreed)
    metrics["own_view_agreeing"] = float((agreed[measure] >= _AGREES[measure]).double().mean())
    num_empty = 0 if differs is None else int((~differs.flatten(1).any(dim=1)).sum())
    verdict = _verdict_in_space(metrics["own_view_agreeing"], len(photographs), background_image is not None, num_empty)
    seen, drawn, where = photographs[order], images[order], masks[order]
    columns = {
        "photograph": seen,
        "close-up": closeups(seen, where),
        "its contour": closeups(outlined(seen, where), where),
        "what was found": closeups(drawn, where),
    }
    captions = [f"{names[row]}\n{text}" for row, text in zip(order.tolist(), _captions(agreed, order), strict=True)]
    return Judgement(metrics, verdict, columns, captions)


def _shown(
    world: World, code: SceneCode, photographs: Tensor, background_image: Tensor | None, differs: Tensor | None
) -> Tensor:
    """Which parts are drawn, 0 or 1, as the code's confidence.

    The likeliest is, however unsure: whether it is right is the question. So are all that are likely. Of the others,
    one after the other, those with which the drawing agrees better: a right part may have a low confidence where
    renderings calibrate it, and which parts a photograph shows is not known.
    """
    confidence, num = code[CONFIDENCE], code[CONFIDENCE].shape[1]
    ranks = confidence.argsort(dim=1, descending=True).argsort(dim=1)
    shown = (ranks == 0) | (confidence >= _LIKELY)
    if num == 1:
        return shown.to(confidence)
    measure = "explained" if differs is None else "overlap"

    def agreement(of_shown: Tensor) -> Tensor:
        drawn = dict(code) | {CONFIDENCE: of_shown.to(confidence)}
        return _agreement(world, drawn, photographs, background_image, differs)[0][measure]

    best = agreement(shown)
    for rank in range(1, num):
        more = shown | (ranks == rank)
        found = agreement(more)
        shown = torch.where((found > best)[:, None, None], more, shown)
        best = torch.maximum(best, found)
    return shown.to(confidence)


def _differing(photographs: Tensor, background_image: Tensor) -> Bool[Tensor, "num height width"]:
    return torch.cat([differing(some, background_image) for some in photographs.split(_DRAWN_AT_ONCE)])


def _agreement(
    world: World, code: SceneCode, photographs: Tensor, background_image: Tensor | None, differs: Tensor | None
) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """Numbers of each photograph by name; what was found, drawn over the background image or the photographs; masks."""
    found: dict[str, list[Tensor]] = {"inside": [], "explained" if differs is None else "overlap": []}
    images, masks = [], []
    for start in range(0, len(photographs), _DRAWN_AT_ONCE):
        some = slice(start, start + _DRAWN_AT_ONCE)
        seen, drawing = photographs[some], draw(world, {name: values[some] for name, values in code.items()})
        behind = seen if background_image is None else background_image.expand_as(seen)
        found["inside"].append(inside(seen, drawing, behind))
        if differs is None:
            found["explained"].append(inlier_ratio(seen, drawing))
        else:
            found["overlap"].append(overlap(drawing.silhouette, differs[some]))
        images.append(drawing.over(behind))
        masks.append(drawing.silhouette)
    return {name: torch.cat(values) for name, values in found.items()}, torch.cat(images), torch.cat(masks)


def _certain(code: SceneCode) -> SceneCode:
    """Slots are there or not, so that silhouettes are those of whole parts."""
    return dict(code) | ({CONFIDENCE: code[CONFIDENCE].round()} if CONFIDENCE in code else {})


def _means(numbers: Mapping[str, Tensor]) -> dict[str, float]:
    return {f"own_view_{name}": float(values.mean()) for name, values in numbers.items()}


def _captions(numbers: Mapping[str, Tensor], order: Tensor) -> list[str]:
    return ["\n".join(f"{name} {values[row]:.2f}" for name, values in numbers.items()) for row in order.tolist()]


def _drawn(world: TabletopWorld, view: int, code: SceneCode) -> Tensor:
    """The scenes as the own (0) or the second camera sees them."""
    return (world.novel_view(code) if view else world.render(code)).clamp(0, 1)


def _errors(view: PhotographSet, images: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Errors of re-renderings, and of the background image in place of them."""
    photographs, background_image = view.photographs.float() / 255, view.background_image.float() / 255
    of_both = []
    for shown in (images, background_image.expand_as(photographs)):
        soft = dssim(blurred(shown), blurred(photographs))
        of_both.append({"dssim": dssim(shown, photographs), "dssim_blurred": soft})
    return of_both[0], of_both[1]


def _verdict(fraction: float, overlaps: float, num: int, second: bool) -> str:
    where = "from the second camera" if second else "from the own camera, which cannot tell depth"
    found = (
        f"in {fraction:.0%} of {num} scenes what was found, seen {where}, is nearer to the photograph than no part, "
        f"and drawn parts and the difference from the background overlap by {overlaps:.2f}"
    )
    if fraction >= _DOUBTFUL and overlaps < _LEAST_OVERLAP:
        return (
            f"Trust it with care: {found}, which is little; look whether parts are drawn the right way up (--up) and "
            "in their size (--mesh-unit), and train longer (--images), with --method sleep if it was another."
        )
    if fraction >= _TRUSTED:
        return f"Trust it: {found}."
    if fraction >= _DOUBTFUL:
        advice = "look at the worst scenes, and train longer (--images), with --method sleep if it was another"
        return f"Trust it with care: {found}; {advice}."
    return (
        f"Do not trust it: {found}. Train longer (--images), with --method sleep if it was another; if that does not "
        "help, look whether --plane, --mesh-unit and --up fit: parts that are drawn beside themselves in the second "
        "view do not stand where the plane is."
    )


def _verdict_in_space(fraction: float, num: int, has_background_image: bool, num_empty: int) -> str:
    measure = (
        "covers what differs from the background image" if has_background_image else "explains what stands out there"
    )
    found = f"in {fraction:.0%} of {num} photographs what was found {measure}"
    limits = "a tenth of a diameter cannot be told from a fifth"
    if not has_background_image:
        limits += "; --background tells right from wrong better"
    advice = (
        "train longer (--images), with --method sleep if it was another, or tell the network more where that was not "
        "done (its colour by --background or --paint, --upright, narrower --near-m and --far-m)"
    )
    if fraction >= _TRUSTED:
        text = f"Trust it: {found}; {limits}."
    elif fraction >= _DOUBTFUL:
        text = f"Trust it with care: {found}; look at the worst ones, and {advice}; {limits}."
    else:
        text = (
            f"Do not trust it: {found}. {advice.capitalize()}; if that does not help, look whether --mesh-unit, the "
            "camera file and --background fit (curio-doctor)."
        )
    return text + (f" {num_empty} of them show nothing but the background image: leave those out." if num_empty else "")
