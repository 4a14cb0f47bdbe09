"""How much is tried for each object when templates are matched and aligned."""

from typing import NamedTuple

from curio_train.networks.templates.rolls import ROLLS_DEG


class Effort(NamedTuple):
    """How much is tried for each object: accuracy for time (docs/experiments/real_photographs.md)."""

    hypotheses: int = 3
    """Poses that each pass aligns."""
    closer: int = 2
    """Number of poses of the first pass around which crops are cut again, at their own distance; 0: one pass is all."""
    rolls_deg: tuple[float, ...] = ROLLS_DEG
    """Rolls of the crops of the second pass; an odd number around 0, and 0 alone where there is no second pass."""
    margin_px: int = 16
    """Pixels of crops in which templates are shifted, to each side; a multiple of the coarse stride."""
    steps: tuple[int, int, int] = (3, 5, 4)
    """Steps of the alignment: in the first of two passes, in the last, and of the best pose with its neighbours."""
    neighbours: int = 4
    """Templates around the best pose whose answers are averaged, in each crop of its place."""
    halved: bool = False
    """Whether crops are cut at half of the resolution, and the trunk reads them as if they were doubled."""


ONE_LOOK = Effort(hypotheses=4, closer=0, rolls_deg=(0.0,), margin_px=8, steps=(0, 3, 4), neighbours=3, halved=True)
"""One pass over one crop of half the resolution: an eighth of the time, one place an object."""
