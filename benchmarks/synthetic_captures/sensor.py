"""From light to a stored photograph: shake, vignetting, noise, white balance and a camera's tone curve."""

from dataclasses import dataclass

import cv2
import numpy as np

_LONGEST_SHAKE_PX = 2.5
_VIGNETTE = 0.25  # of the light is lost in the corners
_WHITE_BALANCE = (1.04, 1.0, 0.94)
_FULL_WELL = 6000.0  # electrons of a white pixel: shot noise is their square root
_READ_NOISE = 8.0  # electrons


@dataclass(frozen=True)
class Sensor:
    """A small camera.

    Attributes:
        exposure: What linear radiance is multiplied by.
    """

    exposure: float = 1.0

    def develop(self, radiance: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """The photograph, [height, width, 3] uint8 sRGB.

        Args:
            radiance: [height, width, 3] linear, at least 0.
            random: Draws shake, exposure and noise.
        """
        light = _shaken(radiance.astype(np.float64), random) * self.exposure * random.uniform(0.94, 1.06)
        light *= _vignette(*light.shape[:2])[..., None] * np.array(_WHITE_BALANCE)
        electrons = random.poisson(np.clip(light, 0, 4) * _FULL_WELL) + random.normal(0, _READ_NOISE, light.shape)
        return (_srgb(np.clip(electrons / _FULL_WELL, 0, 1)) * 255 + 0.5).astype(np.uint8)


def _shaken(light: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Blurred along a short straight path, as when hand or object moves while the shutter is open."""
    length, angle = random.uniform(0, _LONGEST_SHAKE_PX), random.uniform(0, np.pi)
    steps = np.linspace(-0.5, 0.5, 5) * length
    moved = [
        cv2.warpAffine(
            light,
            np.array([[1, 0, step * np.cos(angle)], [0, 1, step * np.sin(angle)]]),
            light.shape[1::-1],
            borderMode=cv2.BORDER_REPLICATE,
        )
        for step in steps
    ]
    result: np.ndarray = np.mean(moved, axis=0)
    return result


def _vignette(height: int, width: int) -> np.ndarray:
    down, across = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    falloff: np.ndarray = 1 - _VIGNETTE * (down**2 + across**2) / 2
    return falloff


def _srgb(linear: np.ndarray) -> np.ndarray:
    encoded: np.ndarray = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return encoded
