"""Scenes on the ground, found by image loss among rendered hypotheses.

The image loss has local minima in yaw and shape, and no gradient where a prediction does not overlap its object. Over
a finite set of hypotheses it needs none: every kind of object is rendered once in each of :data:`NUM_YAWS` yaws, and
these renderings are compared with an image at every place of the ground. The colour with the least error has a closed
form, so one comparison is a few matrix products. The best hypothesis of an image is taken first; the pixels that it
explains no longer count for the next. What is found then descends the gradient of the image loss: places and yaws lie
between those of the hypotheses. Only the image is read, no scene code.

A hypothesis is rendered in the middle of the ground. At other places it is scaled by the distance, and turned with the
ray; perspective inside of an object, shadows, and objects' shades on each other are neglected.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, UInt8
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from curio_train.scene_code import COLOR, CONFIDENCE, TRANSLATION, YAW, index, joined
from curio_train.worlds.generated.mesh_world import MeshWorld

NUM_YAWS = 24
_SIDE = 24  # of a crop, pixels in the middle of the ground; the worlds' objects are 15 to 20 pixels high and wide
_STEP_M = 0.06  # between places
_MAX_PEAKS = 72  # places of an image that are compared again after each object
_LEAST_IMPROVEMENT = 0.3  # squared error that an object must explain better than the ground does
_CLOSENESS = 0.9  # of two objects, in sums of the smallest radius: places are off by half a step
_COVERED = 0.5  # coverage from which a pixel is the object's
_LEAST_POWER = 1e-2
_COLOR_RANGE = 0.02, 0.98  # of found colours: sRGB is steep at 0, and the network's sigmoid at both ends
_STEPS = {TRANSLATION: 0.02, YAW: 0.1, COLOR: 0.05}  # of the first step of refinement, metres and units of the code
_NUM_STEPS, _SLOWER = 16, 0.93  # each step is so much shorter
_REFINED_AT_ONCE = 50


class Found(NamedTuple):
    """The object that explains most of an image, as every kind of object."""

    place: int
    """Number of its place."""
    improvement: Float[Tensor, " kinds"]
    """Squared error that the kind's best hypothesis explains better than the ground does."""
    hypothesis: Int[Tensor, " kinds"]
    """Number of that hypothesis."""
    color: Float[Tensor, "kinds 3"]
    """sRGB colour with which it has the least error."""


class GroundHypotheses:
    """All hypotheses of a world whose objects stand on the ground under a sun that does not move."""

    def __init__(self, world: MeshWorld) -> None:
        """Render every kind of object in every yaw.

        Args:
            world: With yaws, and without a light in its scene code.
        """
        self._world, self._grid = world, world.grid
        self._height_m = float(np.mean([kind.mesh.vertices_m[:, 1].max() for kind in world.kinds])) / 2
        self._closest_m = _CLOSENESS * 2 * min(world.radii_m)
        self._places = self._lay_places()
        middle = torch.zeros(1, 3)
        self._pixels, self._scales = self._seen(self._places), self._depth(middle) / self._depth(self._places)
        self._turns = self._bearing(self._places) - self._bearing(middle)
        self._ground = world.render(self._code(1))[0].detach()
        num_kinds = len(world.objects)
        self._kinds = torch.arange(num_kinds).repeat_interleave(NUM_YAWS)
        self._yaws = (torch.arange(NUM_YAWS) * (2 * math.pi / NUM_YAWS)).repeat(num_kinds)
        self._shades, self._masks = (torch.cat(parts) for parts in zip(*map(self._draw, range(num_kinds)), strict=True))

    @torch.no_grad()
    def explain(self, images: UInt8[Tensor, "batch 3 height width"]) -> dict[str, Tensor]:
        """The scene codes found for images, with a confidence of 0 for slots whose object was not found."""
        found = joined([self._assigned(self._objects(image.float() / 255)) for image in images])
        batches = range(0, len(images), _REFINED_AT_ONCE)
        return joined(
            [
                self._refined(index(found, slice(n, n + _REFINED_AT_ONCE)), images[n : n + _REFINED_AT_ONCE])
                for n in batches
            ]
        )

    @torch.enable_grad()
    def _refined(self, code: dict[str, Tensor], images: Tensor) -> dict[str, Tensor]:
        """The codes after some steps along the gradient of the image loss, of each image those with its lowest loss."""
        free = {name: code[name].clone().requires_grad_() for name in _STEPS if name in code}
        groups = [{"params": [value], "lr": _STEPS[name]} for name, value in free.items()]
        optimizer = torch.optim.Adam(groups, betas=(0.7, 0.9))
        best, lowest = code, torch.full((len(images), 1, 1), math.inf)
        for _ in range(_NUM_STEPS):
            losses = (
                (self._world.render({**code, **free}) - images.float() / 255).square().sum((1, 2, 3))[:, None, None]
            )
            better = losses.detach() < lowest
            best = best | {name: torch.where(better, value.detach(), best[name]) for name, value in free.items()}
            lowest = torch.minimum(lowest, losses.detach())
            optimizer.zero_grad()
            losses.sum().backward()
            position = free[TRANSLATION].grad
            assert position is not None
            position[..., 1] = 0  # objects stand
            optimizer.step()
            for group in optimizer.param_groups:
                group["lr"] *= _SLOWER
            if COLOR in free:
                free[COLOR].data.clamp_(*_COLOR_RANGE)
        return best

    def _objects(self, image: Float[Tensor, "3 height width"]) -> list[Found]:
        """The objects of an image, the one that explains most first."""
        error = (image - self._ground).square().sum(dim=0, keepdim=True)
        pixels, errors = self._cut(torch.cat([image, error]), self._pixels, self._scales).split((3, 1), dim=1)
        improvements = self._improvements(pixels, errors, torch.ones_like(errors), self._scales)
        peaks = self._peaks(improvements.amax(dim=1))
        pixels, errors, scales = pixels[peaks], errors[peaks], self._scales[peaks]
        unexplained, found = torch.ones_like(error), list[Found]()
        for _ in range(self._world.layout.num_slots):
            weights = self._cut(unexplained, self._pixels[peaks], scales)
            improvements = self._improvements(pixels, errors, weights, scales)
            for one in found:
                improvements[self._near(one.place, peaks)] = -1
            best = int(improvements.amax(dim=1).argmax())
            if improvements[best].max() < _LEAST_IMPROVEMENT:
                break
            found.append(self._as_every_kind(int(peaks[best]), improvements[best], pixels[best], weights[best]))
            unexplained = unexplained * (1 - self._paste(int(improvements[best].argmax()), int(peaks[best])))
        return found

    def _improvements(
        self,
        pixels: Float[Tensor, "places 3 area"],
        errors: Float[Tensor, "places 1 area"],
        weights: Float[Tensor, "places 1 area"],
        scales: Float[Tensor, " places"],
    ) -> Float[Tensor, "places hypotheses"]:
        """Squared error of the ground less that of each hypothesis in its best colour, over the hypothesis's pixels."""
        ground = ((errors - pixels.square().sum(dim=1, keepdim=True)) * weights)[:, 0] @ self._masks.T
        gains = [
            self._gain((pixels[:, c] * weights[:, 0]) @ shades.T, weights[:, 0] @ shades.square().T)
            for c, shades in enumerate(self._shades.unbind(dim=1))
        ]
        improvements: Tensor = (ground + torch.stack(gains).sum(dim=0)) * scales.square()[:, None]
        return improvements

    def _gain(self, product: Tensor, power: Tensor) -> Tensor:
        """Largest value of 2 c · product - c² · power; c, the colour, is free or 1."""
        if COLOR in self._world.layout:
            return product.square() / (power + _LEAST_POWER)
        return 2 * product - power

    def _as_every_kind(self, place: int, improvements: Tensor, pixels: Tensor, weights: Tensor) -> Found:
        by_kind = improvements.unflatten(0, (-1, NUM_YAWS))
        best = by_kind.argmax(dim=1) + NUM_YAWS * torch.arange(len(by_kind))
        shades = self._shades[best] * weights
        color = (shades * pixels).sum(dim=2) / ((shades * self._shades[best]).sum(dim=2) + _LEAST_POWER)
        return Found(place, by_kind.amax(dim=1), best, color.clamp(*_COLOR_RANGE))

    def _assigned(self, found: list[Found]) -> dict[str, Tensor]:
        """The scene code [1, …] whose slots together explain most."""
        code, slots = self._code(1), [kind.slots for kind in self._world.objects]
        kind_of_slot = np.repeat(np.arange(len(slots)), [len(members) for members in slots])
        if not found:
            return code
        gains = np.stack([one.improvement.numpy() for one in found])[:, kind_of_slot]
        for number, slot in zip(*linear_sum_assignment(gains, maximize=True), strict=True):
            place, _, hypotheses, colors = found[number]
            kind = kind_of_slot[slot]
            yaw = self._yaws[hypotheses[kind]] + self._turns[place]
            code[TRANSLATION][0, slot] = self._places[place]
            code[YAW][0, slot] = torch.stack([yaw.cos(), yaw.sin()])
            code[CONFIDENCE][0, slot] = 1
            if COLOR in code:
                code[COLOR][0, slot] = colors[kind]
        return code

    def _lay_places(self) -> Float[Tensor, "places 3"]:
        """A square grid of places, row after row."""
        field = self._world.layout[TRANSLATION]
        axes = [torch.arange(field.lower[axis], field.upper[axis] + _STEP_M / 2, _STEP_M) for axis in (0, 2)]
        x, z = torch.meshgrid(*axes, indexing="ij")
        return torch.stack([x, torch.zeros_like(x), z], dim=-1).flatten(0, 1)

    def _peaks(self, improvements: Float[Tensor, " places"]) -> Int[Tensor, " peaks"]:
        """Places that are better than their neighbours, the best first, and after them the best of the others."""
        side = math.isqrt(len(improvements))
        around = F.max_pool2d(improvements.view(1, side, side), 3, 1, 1).flatten()
        lead = (improvements >= around) * (improvements.max() - improvements.min() + 1)
        return (improvements + lead).topk(min(_MAX_PEAKS, len(improvements))).indices

    def _near(self, place: int, peaks: Tensor) -> Tensor:
        return (self._places[peaks] - self._places[place]).norm(dim=1) < self._closest_m

    def _draw(self, kind: int) -> tuple[Float[Tensor, "yaws 3 area"], Float[Tensor, "yaws area"]]:
        """Crops of an object of the kind in all yaws, white if it may have any colour: its pixels, and where it is."""
        yaw, slot = self._yaws[:NUM_YAWS], self._world.objects[kind].slots[0]
        code = self._code(NUM_YAWS)
        code[YAW][:, slot] = torch.stack([yaw.cos(), yaw.sin()], dim=-1)
        code[CONFIDENCE][:, slot] = 1
        dark = torch.zeros_like(self._ground).expand(NUM_YAWS, -1, -1, -1)
        on_black, on_white = (self._world.render(code, behind).detach() for behind in (dark, dark + 1))
        coverage = 1 - (on_white - on_black).mean(dim=1, keepdim=True)
        middle = self._seen(torch.zeros(1, 3))
        crops = [self._cut(one, middle, torch.ones(1)) for one in torch.cat([on_black, coverage], dim=1)]
        shades, covered = torch.cat(crops).split((3, 1), dim=1)
        mask = (covered > _COVERED).float()
        return shades * mask, mask[:, 0]

    def _code(self, count: int) -> dict[str, Tensor]:
        """Codes of empty scenes: all objects are in the middle and invisible."""
        slots = self._world.layout.num_slots
        code = {TRANSLATION: torch.zeros(count, slots, 3), YAW: torch.tensor([1.0, 0.0]).repeat(count, slots, 1)}
        if COLOR in self._world.layout:
            code[COLOR] = torch.ones(count, slots, 3)
        return code | {CONFIDENCE: torch.zeros(count, slots, 1)}

    def _cut(
        self, image: Float[Tensor, "channels height width"], pixels: Float[Tensor, "places 2"], scales: Tensor
    ) -> Float[Tensor, "places channels area"]:
        """Crops around pixels, enlarged by one over their scales."""
        steps = torch.arange(_SIDE) - (_SIDE - 1) / 2
        x = pixels[:, 0, None, None] + scales[:, None, None] * steps
        y = pixels[:, 1, None, None] + scales[:, None, None] * steps[:, None]
        grid = torch.stack(torch.broadcast_tensors(x, y), dim=-1).flatten(1, 2)
        size = grid.new_tensor([image.shape[2] - 1, image.shape[1] - 1])
        cut = F.grid_sample(image[None], (grid / size * 2 - 1)[None], padding_mode="border", align_corners=True)
        return cut[0].transpose(0, 1)

    def _paste(self, hypothesis: int, place: int) -> Float[Tensor, "1 height width"]:
        """Where in the image the hypothesis is at the place."""
        height, width = self._ground.shape[1:]
        reach = self._scales[place] * (_SIDE - 1) / 2
        x = (torch.arange(width) - self._pixels[place, 0]) / reach
        y = (torch.arange(height) - self._pixels[place, 1])[:, None] / reach
        grid = torch.stack(torch.broadcast_tensors(x, y), dim=-1)[None]
        mask = self._masks[hypothesis].view(1, 1, _SIDE, _SIDE)
        return F.grid_sample(mask, grid, align_corners=True)[0]

    def _seen(self, position: Float[Tensor, "places 3"]) -> Float[Tensor, "places 2"]:
        """Pixels of the middles of objects that stand at positions."""
        return self._grid.project(self._raised(position))

    def _depth(self, position: Float[Tensor, "places 3"]) -> Float[Tensor, " places"]:
        return self._world.setup.cam_from_world.to(position).apply(self._raised(position))[:, 2]

    def _raised(self, position: Float[Tensor, "places 3"]) -> Float[Tensor, "places 3"]:
        return position + position.new_tensor([0.0, self._height_m, 0.0])

    def _bearing(self, position: Float[Tensor, "places 3"]) -> Float[Tensor, " places"]:
        """Angle about y of the camera's ray to positions."""
        rotation, translation_m = self._world.setup.cam_from_world.to(position)
        ray = position + translation_m @ rotation
        return torch.atan2(ray[:, 0], ray[:, 2])
