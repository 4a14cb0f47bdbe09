"""The paper's validation experiment: curiosity in closed form, with no network at all.

N images each show one disc of known size on black; position t and luminance l of each, both in [0, 1], are to be found
by gradient descent. The image loss alone turns discs black that start beside the one they look for. The *oracle critic*
knows the distribution that the true parameters come from, the uniform one, and asks that the N guesses as a set look
as if drawn from it (paper, section "Validation experiment", and its appendix).

How the appendix is read, where it is loose (docs/paper_notes.md):

* "all possible subsets of p and a random sampling S": at every step the guesses are dealt into random groups, and each
  group is compared with fresh uniform samples of its own;
* "a steep Gaussian kernel": its width is stated here. Each guess is mirrored at the borders of the square, so that
  uniform guesses have the same density everywhere; else the border would look empty and draw them in;
* the estimate at a sample is the mean over the group of the product of both dimensions' kernels. Their average, as
  printed, would see the two marginals only, which black discs can satisfy in t;
* the discrepancy is the variance of these densities over the samples, as printed.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

Guesses = Float[Tensor, "num_objects 2"]
"""Position t, luminance l."""


@dataclass(frozen=True)
class ValidationSettings:
    """Of the experiment; fixed once for both of its halves.

    Attributes:
        num_objects: N problems (paper: 300).
        radius: Of a disc, in units of t.
        num_steps: Of Adam.
        learning_rate: Its largest change of a parameter a step.
        discrepancy_weight: Of the oracle critic; 0 leaves the image loss alone.
        kernel_width: Standard deviation of the kernel.
        group_size: Guesses that are compared with a sampling at once.
        num_samples: Size of a sampling S.
        tolerance: Largest distance (in t, l) from the truth that counts as solved.
    """

    num_objects: int = 300
    radius: float = 0.05
    num_steps: int = 6000
    learning_rate: float = 0.03
    discrepancy_weight: float = 0.3
    kernel_width: float = 0.2
    group_size: int = 30
    num_samples: int = 30
    tolerance: float = 0.05


# Curiosity is constant over the first half, fades to a hundredth, and is off while the discs already found settle.
_FADES_FROM, _OFF_FROM, _FADES_TO = 0.5, 0.85, 0.01


@dataclass(frozen=True, eq=False)
class Solution:
    """What became of all problems.

    Attributes:
        truth: Of each problem.
        path: [num_steps + 1, num_objects, 2]: every guess from the random start to the end.
        solved: Whether each ended within the tolerance.
    """

    truth: Guesses
    path: Float[Tensor, "num_states num_objects 2"]
    solved: Tensor

    @property
    def share(self) -> float:
        """Of the problems that were solved."""
        return float(self.solved.double().mean())


def solve(settings: ValidationSettings, seed: int) -> Solution:
    """Draw truths and starts, and descend; the same seed gives the same problems whatever the weight.

    Raises:
        ValueError: The guesses cannot be dealt into groups of that size.
    """
    if settings.num_objects % settings.group_size:
        raise ValueError(f"{settings.num_objects} objects cannot be dealt into groups of {settings.group_size}")
    generator = torch.Generator().manual_seed(seed)
    truth = torch.rand(settings.num_objects, 2, generator=generator)
    guess = torch.rand(settings.num_objects, 2, generator=generator).requires_grad_()
    optimizer = torch.optim.Adam([guess])
    path = [guess.detach().clone()]
    for step in range(settings.num_steps):
        progress = step / settings.num_steps
        loss = image_error(guess, truth, settings.radius).sum()
        if settings.discrepancy_weight and progress < _OFF_FROM:
            fading = max(0.0, (progress - _FADES_FROM) / (_OFF_FROM - _FADES_FROM))
            order = torch.randperm(settings.num_objects, generator=generator)
            groups = guess[order].view(-1, settings.group_size, 2)
            samples = torch.rand(len(groups), settings.num_samples, 2, generator=generator)
            oracle = settings.group_size * discrepancy(groups, samples, settings.kernel_width).sum()
            loss = loss + settings.discrepancy_weight * _FADES_TO**fading * oracle
        optimizer.param_groups[0]["lr"] = settings.learning_rate * min(1.0, (1 - progress) / (1 - _OFF_FROM))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        with torch.no_grad():
            guess.abs_()
            guess.copy_(1 - (1 - guess).abs())  # whoever leaves the square comes back in like light from a mirror
        path.append(guess.detach().clone())
    distance = (path[-1] - truth).norm(dim=-1)
    return Solution(truth, torch.stack(path), distance < settings.tolerance)


def image_error(guess: Guesses, truth: Guesses, radius: float) -> Float[Tensor, " num_objects"]:
    """Squared difference of both images of each problem, integrated over the image, in units of a disc's area.

    With discs D that share the part ``overlap`` of their area: ∫ (l D − l' D')² = l² + l'² − 2 l l' · overlap.
    """
    shared = overlap(guess[..., 0] - truth[..., 0], radius)
    return guess[..., 1] ** 2 + truth[..., 1] ** 2 - 2 * guess[..., 1] * truth[..., 1] * shared


def overlap(offset: Tensor, radius: float) -> Tensor:
    """Share of a disc's area that another of the same radius covers whose centre is ``offset`` away: the lens."""
    half = (offset.abs() / (2 * radius)).clamp(max=1 - 1e-6)  # the arccosine's slope is infinite at 1
    return 2 / math.pi * (torch.acos(half) - half * (1 - half.square()).sqrt())


def discrepancy(
    points: Float[Tensor, "*batch num_points 2"], samples: Float[Tensor, "*batch num_samples 2"], width: float
) -> Float[Tensor, "*batch"]:
    """Variance over the samples of the density of the points on the unit square; 0 where they are spread evenly."""
    product = torch.ones((), dtype=points.dtype)
    for axis in (0, 1):
        own, at = points[..., :, None, axis], samples[..., None, :, axis]
        mirrored = (own, -own, 2 - own)
        kernels = [torch.exp(-((point - at) ** 2) / (2 * width**2)) for point in mirrored]
        product = product * sum(kernels) / (width * math.sqrt(2 * math.pi))
    return product.mean(dim=-2).var(dim=-1)
