"""Which images several cameras took at the same instants: by their times, or else by the order of their names."""

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain, zip_longest
from pathlib import PurePath

from curio_serve.batch.images.source_image import SourceImage
from curio_serve.batch.images.sources import PassedOver, images
from curio_serve.errors import UsageError
from curio_serve.rigs.rig import RigCamera

_NUMBER = re.compile(r"\d+")
_FARTHEST_S = 0.5  # between images of one instant: what moves is elsewhere by then, and what lies is seen again


@dataclass(frozen=True)
class RigImage:
    """The images of all cameras at one instant."""

    images: tuple[SourceImage, ...]
    """One image of each camera, in the rig's order."""

    @property
    def name(self) -> str:
        """Names of all images, by which a result file's line is known to be of this instant."""
        return "|".join(image.name for image in self.images)


@dataclass
class Unpaired:
    """Counts images that no image of the other cameras goes with, for a summary at the end."""

    num: int = 0
    """How many."""
    first: str = ""
    """The first one's name."""
    ended: str = ""
    """Names the camera whose images ended first, where others have more."""

    def count(self, image: SourceImage) -> None:
        """Count one."""
        self.num, self.first = self.num + 1, self.first or image.name

    def lines(self) -> Iterator[str]:
        """The summary, in lines."""
        if self.num:
            yield f"--rig: {self.num} images were taken at no other camera's time, the first of them {self.first}"
        if self.ended:
            yield f"--rig: {self.ended} ends before the others"


@dataclass
class Instants:
    """The images of each instant.

    Frames of recordings and videos have times, and those that are nearest in time go together, half a second apart at
    most. Files have none: those of each camera are taken in the order of their names.
    """

    cameras: Sequence[Iterator[SourceImage]]
    """The images of each camera, in their order."""
    labels: Sequence[str]
    """Names each camera's images in errors."""
    unpaired: Unpaired = field(default_factory=Unpaired)
    """What was left out so far."""

    def __iter__(self) -> Iterator[RigImage]:
        """One instant after the other.

        Raises:
            UsageError: Images without times are not as many of each camera, or numbered otherwise.
        """
        first = [next(camera, None) for camera in self.cameras]
        if None in first or any(image is not None and _has_no_time(image) for image in first):
            return self._by_order(first)
        return self._by_time([image for image in first if image is not None])

    def _by_order(self, first: Sequence[SourceImage | None]) -> Iterator[RigImage]:
        has_numbers, before = len({_number(image) for image in first if image is not None}) == 1, list[str]()
        for count, found in enumerate(chain((tuple(first),), zip_longest(*self.cameras))):
            there = [image for image in found if image is not None]
            if not there:
                return
            if len(there) < len(found):
                ended = self.labels[found.index(None)]
                raise UsageError(
                    f"--rig: {ended} has {count} images, others have more; expected as many of each camera"
                )
            numbers = [_number(image) for image in there]
            is_behind, before = _is_behind(numbers, before), numbers
            if len({*numbers}) > 1 and (has_numbers or is_behind):
                names = " and ".join(image.name for image in there)
                raise UsageError(f"--rig: {names} come together and have other numbers; is an image missing before?")
            yield RigImage(tuple(there))

    def _by_time(self, heads: list[SourceImage]) -> Iterator[RigImage]:
        following = [next(camera, None) for camera in self.cameras]
        while True:
            latest = max(_time_s(head) or 0.0 for head in heads)
            for number, camera in enumerate(self.cameras):
                while (then := following[number]) is not None and _is_nearer(then, heads[number], latest):
                    self.unpaired.count(heads[number])
                    heads[number], following[number] = then, next(camera, None)
            early = [number for number, head in enumerate(heads) if _is_early(head, latest)]
            for number in early:
                self.unpaired.count(heads[number])
            if not early:
                yield RigImage(tuple(heads))
            is_more_to_come = bool(early) or any(following)
            for number in early or range(len(heads)):
                if (then := following[number]) is None:
                    self.unpaired.ended = self.labels[number] if is_more_to_come else ""
                    return
                heads[number], following[number] = then, next(self.cameras[number], None)


def refuse_other_images(arguments: Sequence[str], cameras: Sequence[RigCamera]) -> None:
    """Refuse images that cannot be those of a rig's cameras, before any work.

    Args:
        arguments: One of each camera, as on the command line.
        cameras: Of the rig's file.

    Raises:
        UsageError: They are named after another camera, such as ``right left`` for the cameras left and right, or
            folders hold different numbers of images.
    """
    names = [camera.name for camera in cameras]
    if len({os.path.realpath(argument) for argument in arguments}) < len(arguments):
        raise UsageError(f"--rig: found {' '.join(arguments)}; expected other images of each camera")
    for argument, name in zip(arguments, names, strict=True):
        own = next((part for part in reversed(PurePath(argument).parts) if "*" not in part), "")
        own = own if os.path.isdir(argument) or "*" in argument else PurePath(own).stem
        if own != name and own in names:
            raise UsageError(
                f"--rig: {argument} comes where camera {name} is expected; the order is {', '.join(names)}"
            )
    if all(map(os.path.isdir, arguments)):
        counts = [sum(1 for _ in images([argument], PassedOver())) for argument in arguments]
        if len({*counts}) > 1:
            found = ", ".join(f"{argument} has {count}" for argument, count in zip(arguments, counts, strict=True))
            raise UsageError(f"--rig: expected as many images of each camera; {found}")


def _time_s(image: SourceImage) -> float | None:
    if image.recorded is None:
        return image.time_s
    return (image.recorded.stamp_ns or image.recorded.log_time_ns) * 1e-9  # 0: nobody set the stamp


def _has_no_time(image: SourceImage) -> bool:
    """Whether no image of this camera has a time; a damaged frame of a video has none where others do."""
    is_damaged_frame = image.video_frame is not None and image.error != ""
    return _time_s(image) is None and not is_damaged_frame


def _is_nearer(then: SourceImage, now: SourceImage, latest: float) -> bool:
    """Whether a camera's next image is nearer in time; one that is damaged has no time, and is never."""
    at_s, now_s = _time_s(then), _time_s(now)
    return at_s is not None and now_s is not None and abs(at_s - latest) < abs(now_s - latest)


def _is_early(image: SourceImage, latest: float) -> bool:
    """Whether an image was taken too long before another camera's; one that is damaged has no time, and was not."""
    at_s = _time_s(image)
    return at_s is not None and latest - at_s > _FARTHEST_S


def _is_behind(numbers: Sequence[str], before: Sequence[str]) -> bool:
    """Whether a camera's image has the number that another camera's had an instant ago."""
    return any(
        number != "" and number == was
        for own, number in enumerate(numbers)
        for other, was in enumerate(before)
        if own != other
    )


def _number(image: SourceImage) -> str:
    """The last number in an image's file name, without leading zeros; empty where it has none."""
    found = _NUMBER.findall(PurePath(image.name).stem)
    return found[-1].lstrip("0") if found else ""
