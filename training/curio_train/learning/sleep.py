"""Sleep: learn from codes of one's own making (not in the paper; after wake–sleep, Hinton et al. 1995).

Awake, the image loss compares re-renderings with the data. Asleep, the network reads renderings whose codes it knows,
because it made them up: half around what it predicts for the data, half from the range that the world declares. No
label of the data is used; the image loss keeps the codes near the data.
"""

import numpy as np
import torch
from torch import Tensor

from curio_train.metrics.assignment import canonical
from curio_train.scene_code import SceneCode
from curio_train.worlds.base import World


def sleep_codes(world: World, raw: SceneCode, noise: float, drawn: float, seed: tuple[int, ...]) -> dict[str, Tensor]:
    """As many codes to dream of as there are predictions.

    Args:
        world: Declares the range and draws from it.
        raw: The network's predictions before activation, in which 0 to ±1 is half the range and bounds are kept.
        noise: Standard deviation of the perturbation, in the units of ``raw``; each code gets a share of it drawn
            uniformly, so that small and large perturbations both occur.
        drawn: Share of the codes that are drawn from the world's range.
        seed: Decides every draw.

    Returns:
        Codes without gradient, rotations in their canonical form, because their length cannot be seen.
    """
    num = len(next(iter(raw.values())))
    num_drawn = round(drawn * num)
    random = np.random.default_rng(seed)
    shares = random.random(num).astype(np.float32) * noise
    perturbed = {
        name: value.detach() + _like(shares, value) * _like(random.standard_normal(value.shape, np.float32), value)
        for name, value in raw.items()
    }
    code = canonical(world.layout.activate(perturbed))
    if num_drawn:
        from_range = world.sample(num_drawn, seed)
        code = {name: torch.cat([from_range[name].to(value), value[num_drawn:]]) for name, value in code.items()}
    return code


def _like(values: np.ndarray, tensor: Tensor) -> Tensor:
    """On the device of ``tensor``, with trailing dimensions to broadcast over."""
    return torch.from_numpy(values).to(tensor).view(*values.shape, *(1,) * (tensor.dim() - values.ndim))
