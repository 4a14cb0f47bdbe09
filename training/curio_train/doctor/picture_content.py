"""What photographs show: blur, repetition, exposure, and red swapped with blue in some of them."""

from collections.abc import Iterator, Sequence

import numpy as np

from curio_train.doctor.finding import Finding
from curio_train.doctor.photograph import Photograph

_BLURRED = 0.6  # sharp photographs of clutter: up to 0.45; blurred with a sigma of 2.5 pixels: 0.65 and more
_TOLERATED = 0.1  # share of photographs
_EQUAL_LEVELS = 4.0  # two frames of one still scene differ by more somewhere, if anything moved
_COMPARED = 60  # neighbours in brightness that each is compared with
_MOSTLY_LOST = 0.6
_BETTER_SWAPPED = 0.6


def examine_content(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Findings that concern the pictures themselves."""
    yield from _blur(photographs)
    yield from _duplicates(photographs)
    yield from _exposure(photographs)
    yield from _swapped(photographs)


def _blur(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    blurred = [photo for photo in photographs if photo.blur > _BLURRED]
    if len(blurred) > _TOLERATED * len(photographs):
        worst = max(blurred, key=lambda photo: photo.blur)
        text = f"{len(blurred)} of {len(photographs)} are blurred, most of all {worst.path.name}"
        remedy = "Focus on the object, hold the camera still, use more light; or remove them"
        yield Finding("photograph sharpness", "warning", text, remedy, "likely", fault="blurred")


def _duplicates(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Equal pictures have equal brightness: only neighbours in that order are compared."""
    thumbnails = np.stack([photo.thumbnail for photo in photographs])
    order = np.argsort(thumbnails.mean(axis=(1, 2, 3)), kind="stable")
    pairs = []
    for place, number in enumerate(order):
        others = order[place + 1 : place + 1 + _COMPARED]
        equal = np.abs(thumbnails[others] - thumbnails[number]).max(axis=(1, 2, 3), initial=0) < _EQUAL_LEVELS
        pairs += [(int(number), int(other)) for other in others[equal]]
    repeated = {max(pair) for pair in pairs}
    if repeated:
        first, second = sorted(min(pairs))
        names = f"{photographs[first].path.name} and {photographs[second].path.name}"
        text = f"{len(repeated)} of {len(photographs)} repeat another, for instance {names}"
        yield Finding(
            "photograph copies", "warning", text, "Remove the copies: they teach nothing new", fault="duplicates"
        )


def _exposure(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    lost = [photo for photo in photographs if photo.lost > _MOSTLY_LOST]
    if len(lost) > _TOLERATED * len(photographs):
        text = f"{len(lost)} of {len(photographs)} are mostly black or white, for instance {lost[0].path.name}"
        yield Finding("photograph exposure", "warning", text, "Expose for the object", "likely", fault="exposure")


def _swapped(photographs: Sequence[Photograph]) -> Iterator[Finding]:
    """Raw frames read as BGR here and RGB there: some look like the others only with red and blue exchanged."""
    thumbnails = np.stack([photo.thumbnail for photo in photographs])
    typical = np.median(thumbnails, axis=0)
    swapped = [photo for photo in photographs if looks_swapped(photo.thumbnail, typical)]
    if 0 < len(swapped) < len(photographs):
        text = f"{len(swapped)} of {len(photographs)} have red and blue exchanged, for instance {swapped[0].path.name}"
        yield Finding(
            "photograph colours",
            "bad",
            text,
            "Save raw frames as RGB (OpenCV's are BGR)",
            "likely",
            fault="swapped colours",
        )


def looks_swapped(picture: np.ndarray, reference: np.ndarray) -> bool:
    """Whether a thumbnail is much closer to the reference with red and blue exchanged."""
    as_is = np.abs(picture - reference).mean()
    exchanged = np.abs(picture[..., ::-1] - reference).mean()
    return bool(exchanged < _BETTER_SWAPPED * as_is)
