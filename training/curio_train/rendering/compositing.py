"""Layers to pixels: per ray sample, by depth, attenuated by confidence; with confidence 1 that is exact occlusion.

Paper, section "Differentiable Rendering with Confidence".
"""

from types import ModuleType
from typing import Any

from curio_train.rendering.layers import Layer


def composite(dr: ModuleType, layers: list[Layer], background: list[Any]) -> list[Any]:
    """Colour of each sample, 3 arrays.

    A layer's weight is its alpha times what all nearer layers let through. Written without a sort, every layer asks
    every other whether it is nearer (equal depths: the earlier slot), so the program does not depend on the data.
    """
    rgb = [0.0, 0.0, 0.0]
    through = 1.0
    for i, layer in enumerate(layers):
        weight = layer.alpha
        for j, other in enumerate(layers):
            if i == j:
                continue
            nearer = other.depth_m <= layer.depth_m if j < i else other.depth_m < layer.depth_m
            weight = weight * dr.select(nearer, 1 - other.alpha, 1)
        rgb = [total + weight * value for total, value in zip(rgb, layer.rgb, strict=True)]
        through = through * (1 - layer.alpha)
    return [total + through * value for total, value in zip(rgb, background, strict=True)]


def gather_layer(dr: ModuleType, layer: Layer, ray: Any, present: Any) -> Layer:
    """One slot's layer for each sample: its ray's entry, or nothing where the slot has no ray there.

    Each ray belongs to one sample, so gradients are scattered without conflict.
    """

    def take(values: Any) -> Any:
        return dr.gather(type(values), values, ray, active=present, mode=dr.ReduceMode.Permute)

    depth = dr.select(present, dr.gather(type(layer.depth_m), layer.depth_m, ray, active=present), dr.inf)
    return Layer(take(layer.alpha), depth, [take(c) for c in layer.rgb])
