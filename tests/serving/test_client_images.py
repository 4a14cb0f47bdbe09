"""What the client takes for an image and other values, and what it says about anything else."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from curio_serve.client import detect_request
from curio_serve.errors import ArgumentError, ImageError
from PIL import Image


def test_bytes_of_every_kind_are_sent_as_they_are() -> None:
    for content in (b"no image", bytearray(b"no image"), memoryview(b"no image")):
        assert detect_request("ape", content).encoded == b"no image"  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("image", "told"),
    [
        (None, r"the image is a NoneType.*cv2\.imread gives None"),
        (Image.new("RGB", (20, 20)), "the image is a Image; expected pixels"),
        ("null\0.png", "cannot be read"),
        (Path("missing.png"), "cannot be read"),
        (np.zeros((20, 20, 3)), "uint8"),
    ],
)
def test_what_is_no_image_is_an_image_error(image: Any, told: str) -> None:
    with pytest.raises(ImageError, match=told):
        detect_request("ape", image)


@pytest.mark.parametrize(
    "values",
    [
        {"max_detections": -1},
        {"min_confidence": "0.5"},
        {"regions": (200, 120, 160, 120)},
        {"model": 5},
        {"request_id": "\ud800"},
    ],
    ids=str,
)
def test_values_of_the_wrong_kind_are_argument_errors(values: dict[str, Any]) -> None:
    with pytest.raises(ArgumentError):
        detect_request(**{"model": "ape", "image": b"no image"} | values)
