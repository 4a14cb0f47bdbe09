"""The search for scenes among hypotheses: greedy, then again for what does not explain its part of the image."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, UInt8
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from curio_train.scene_code import COLOR, CONFIDENCE, LIGHT, TRANSLATION, YAW, SceneCode, index, joined
from curio_train.worlds.generated.hypotheses.bank import NUM_YAWS, YAWS, Bank, empty_scenes
from curio_train.worlds.generated.hypotheses.descent import better_of, descended, image_losses
from curio_train.worlds.generated.hypotheses.places import Places
from curio_train.worlds.generated.hypotheses.suns import Sun, Suns
from curio_train.worlds.generated.mesh_world import MeshWorld

_AT_ONCE = 128  # places: the crops of all of them would be allocated anew each time, which takes longer than the rest
_MAX_PEAKS = 72  # places of an image that are compared again after each object
_LEAST_IMPROVEMENT = 0.3  # squared error that an object must explain better than what is behind it
_EXPLAINED = 0.006  # mean squared error of an object's pixels and those around it, a sum over the channels
_AROUND_PX = 2
_REACHES_M = (0.0, 0.5, 0.8)  # objects so near to one that explains nothing are searched for again, too
_UNEXPLAINED = 1.4  # loss of an image that is searched again, in lower quartiles of all images' losses


class _Object(NamedTuple):
    """The object that explains most of an image, as every kind of object."""

    place: int
    improvement: Float[Tensor, " kinds"]
    """Squared error that the kind's best hypothesis explains better than what is behind."""
    hypothesis: Int[Tensor, " kinds"]
    color: Float[Tensor, "kinds 3"]


class _View(NamedTuple):
    """What is known of an image before objects are searched for in it."""

    image: Float[Tensor, "3 height width"]
    errors: Float[Tensor, "1 height width"]
    """Squared error of what is behind the objects, a sum over the channels."""
    unexplained: Float[Tensor, "1 height width"]
    """1 where pixels count."""
    code: SceneCode
    """Code of one scene: its sun, and the objects that are there already."""


class _Crops(NamedTuple):
    """Crops of a view around the places at which objects are worth looking for."""

    peaks: Int[Tensor, " peaks"]
    """Numbers of the places."""
    pixels: Float[Tensor, "peaks 3 area"]
    errors: Float[Tensor, "peaks 1 area"]


class GroundHypotheses:
    """All hypotheses of a world whose objects stand on the ground."""

    def __init__(self, world: MeshWorld) -> None:
        """Choose places and suns; banks are rendered when an image asks for them.

        Args:
            world: With a ground and yaws.
        """
        self._world, self._suns = world, Suns(world)
        height_m = float(np.mean([kind.mesh.vertices_m[:, 1].max() for kind in world.kinds])) / 2
        self._places = Places(world, height_m)
        self._banks = dict[int, Bank]()  # by number of the sun
        slots = [kind.slots for kind in world.objects]
        self._kind_of_slot = np.repeat(np.arange(len(slots)), [len(members) for members in slots])

    @torch.no_grad()
    def explain(self, images: UInt8[Tensor, "batch 3 height width"]) -> dict[str, Tensor]:
        """The scene codes found for images, with a confidence of 0 for slots whose object was not found."""
        found, losses = descended(self._world, joined([self._first(image.float() / 255) for image in images]), images)
        for reach_m in _REACHES_M:
            again = losses > _UNEXPLAINED * losses.quantile(0.25)
            if not again.any():
                break
            rows = again.nonzero()[:, 0]
            before = index(found, rows)
            codes = [
                self._again(image.float() / 255, index(before, slice(n, n + 1)), reach_m)
                for n, image in enumerate(images[rows])
            ]
            searched = descended(self._world, joined(codes), images[rows])
            better, losses[rows] = better_of(*searched, before, losses[rows])
            for name, value in better.items():
                found[name][rows] = value
        return found

    def _first(self, image: Float[Tensor, "3 height width"]) -> dict[str, Tensor]:
        """The scene of an image under the sun with which it is explained best."""
        suns, lit = self._suns.of_image(image)
        errors = self._ground_errors(image, lit)
        views = [_View(image, errors, torch.ones_like(errors), self._empty(sun)) for sun in suns]
        crops = self._crops(views[0], self._bank(suns[0].bank))
        found = [self._with_objects(view, crops, self._bank(sun.bank)) for view, sun in zip(views, suns, strict=True)]
        return self._best(found, image)

    def _best(self, codes: Sequence[dict[str, Tensor]], image: Float[Tensor, "3 height width"]) -> dict[str, Tensor]:
        """The code whose rendering is nearest to the image."""
        if len(codes) == 1:
            return codes[0]
        pictures = (image * 255).round().byte().expand(len(codes), -1, -1, -1)
        return codes[int(image_losses(self._world, joined(codes), pictures).argmin())]

    def _empty(self, sun: Sun) -> dict[str, Tensor]:
        code = empty_scenes(self._world, 1)
        if sun.light is not None:
            code[LIGHT] = sun.light[None]
        return code

    def _again(self, image: Float[Tensor, "3 height width"], code: SceneCode, reach_m: float) -> dict[str, Tensor]:
        """The scene with new objects in place of those that do not explain their part of the image."""
        bank = self._bank_of(code)
        residual = (self._world.render(code)[0] - image).square().sum(dim=0, keepdim=True)
        masks = {slot: self._mask(code, slot, bank) for slot in code[CONFIDENCE][0, :, 0].nonzero()[:, 0].tolist()}
        bad = [slot for slot, mask in masks.items() if _mean_around(residual, mask) > _EXPLAINED]
        position = code[TRANSLATION][0]
        gone = [s for s in masks if any((position[s] - position[b]).norm() <= reach_m for b in bad)]
        kept = {**code, CONFIDENCE: code[CONFIDENCE].clone()}
        kept[CONFIDENCE][0, gone] = 0
        behind = self._world.render(kept)[0]
        of_ground = self._ground_errors(image, self._suns.of_image(image)[1])
        errors = torch.minimum((behind - image).square().sum(dim=0, keepdim=True), of_ground)
        unexplained = torch.ones_like(errors)
        for slot in masks.keys() - set(gone):
            unexplained = unexplained * (1 - masks[slot])
        view = _View(image, errors, unexplained, kept)
        code = self._with_objects(view, self._crops(view, bank), bank)
        new = (code[CONFIDENCE] > kept[CONFIDENCE])[0, :, 0].nonzero()[:, 0].tolist()
        for slot in new:
            code = self._turned(code, slot, image)
        return code

    def _turned(self, code: dict[str, Tensor], slot: int, image: Tensor) -> dict[str, Tensor]:
        """The scene with one of its objects in the yaw in which its rendering is nearest to the image."""
        yaw = torch.atan2(code[YAW][0, slot, 1], code[YAW][0, slot, 0]) + YAWS[::2]  # the gradient does the rest
        turned = joined([code] * len(yaw))
        turned[YAW][:, slot] = torch.stack([yaw.cos(), yaw.sin()], dim=-1)
        return self._best([index(turned, slice(n, n + 1)) for n in range(len(yaw))], image)

    def _with_objects(self, view: _View, crops: _Crops, bank: Bank) -> dict[str, Tensor]:
        """The code of the view with all objects that are found in it, in the slots in which they explain most."""
        free = (view.code[CONFIDENCE][0, :, 0] == 0).nonzero()[:, 0].tolist()
        found = self._objects(view, crops, bank, free)
        code = {name: value.clone() for name, value in view.code.items()}
        if not found:
            return code
        gains = np.stack([one.improvement.numpy() for one in found])[:, self._kind_of_slot[free]]
        for number, column in zip(*linear_sum_assignment(gains, maximize=True), strict=True):
            one, slot = found[number], free[column]
            kind = self._kind_of_slot[slot]
            yaw = YAWS[one.hypothesis[kind] % NUM_YAWS] + self._places.turns[one.place]
            code[TRANSLATION][0, slot] = self._places.positions[one.place]
            code[YAW][0, slot] = torch.stack([yaw.cos(), yaw.sin()])
            code[CONFIDENCE][0, slot] = 1
            if COLOR in code:
                code[COLOR][0, slot] = one.color[kind]
        return code

    def _crops(self, view: _View, bank: Bank) -> _Crops:
        """Crops around the places where one of the bank's hypotheses explains most."""
        layers, places = torch.cat([view.image, view.errors, view.unexplained]), self._places
        best = []
        for some in torch.arange(len(places.positions)).split(_AT_ONCE):
            pixels, errors, weights = places.cut(layers, some).split((3, 1, 1), dim=1)
            best.append(bank.improvements(pixels, errors, weights, places.scales[some]).amax(dim=1))
        peaks = places.peaks(torch.cat(best), _MAX_PEAKS)
        pixels, errors, _ = places.cut(layers, peaks).split((3, 1, 1), dim=1)
        return _Crops(peaks, pixels, errors)

    def _objects(self, view: _View, crops: _Crops, bank: Bank, free: Sequence[int]) -> list[_Object]:
        """The objects that a view lacks, the one that explains most first, at most one a free slot."""
        places, (peaks, pixels, errors) = self._places, crops
        taken = list(view.code[TRANSLATION][0, view.code[CONFIDENCE][0, :, 0] > 0])
        unexplained, found = view.unexplained, list[_Object]()
        for _ in free:
            weights = places.cut(unexplained, peaks)
            improvements = bank.improvements(pixels, errors, weights, places.scales[peaks])
            for position in taken:
                improvements[places.near(position, peaks)] = -1
            best = int(improvements.amax(dim=1).argmax())
            if improvements[best].max() < _LEAST_IMPROVEMENT:
                break
            place, by_kind = int(peaks[best]), improvements[best].unflatten(0, (-1, NUM_YAWS))
            hypotheses = by_kind.argmax(dim=1) + NUM_YAWS * torch.arange(len(by_kind))
            colors = bank.colors(hypotheses, pixels[best], weights[best])
            found.append(_Object(place, by_kind.amax(dim=1), hypotheses, colors))
            taken.append(places.positions[place])
            unexplained = unexplained * (1 - places.paste(bank.masks[improvements[best].argmax()], place))
        return found

    def _ground_errors(self, image: Float[Tensor, "3 height width"], lit: float) -> Float[Tensor, "1 height width"]:
        """Squared error of the ground, as deep in shadow at each pixel as explains the pixel best."""
        ground = image.mean(dim=0, keepdim=True).clamp(self._suns.dark, lit)
        return (image - ground).square().sum(dim=0, keepdim=True)

    def _mask(self, code: SceneCode, slot: int, bank: Bank) -> Float[Tensor, "1 height width"]:
        """About where an object is in the image, whatever stands before it."""
        place = self._places.nearest(code[TRANSLATION][0, slot])
        yaw = torch.atan2(code[YAW][0, slot, 1], code[YAW][0, slot, 0]) - self._places.turns[place]
        number = int((yaw / (YAWS[1] - YAWS[0])).round()) % NUM_YAWS
        return self._places.paste(bank.masks[int(self._kind_of_slot[slot]) * NUM_YAWS + number], place)

    def _bank_of(self, code: SceneCode) -> Bank:
        """The bank whose sun is nearest to a scene's."""
        if LIGHT not in code:
            return self._bank(0)
        suns = torch.stack([sun for sun in self._suns.banks if sun is not None])
        return self._bank(int((suns - code[LIGHT]).norm(dim=1).argmin()))

    def _bank(self, number: int) -> Bank:
        if number not in self._banks:
            self._banks[number] = Bank(self._world, self._places, self._suns.banks[number])
        return self._banks[number]


def _mean_around(residual: Float[Tensor, "1 height width"], mask: Float[Tensor, "1 height width"]) -> float:
    """Mean of a map over a mask and some pixels around it."""
    wide = F.max_pool2d(mask, 2 * _AROUND_PX + 1, 1, _AROUND_PX) > 0.5
    return float(residual[wide].mean()) if wide.any() else 0.0
