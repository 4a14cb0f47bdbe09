"""Checks for ``curio-detect --track``, which follows frames in order, in this process, from the first one on."""

import math
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from curio_serve.batch.arguments import DetectArguments
from curio_serve.errors import UsageError
from curio_serve.tracking.follower import MAX_OBJECTS

if TYPE_CHECKING:
    from curio_serve.batch.images.source_image import RecordedAt, SourceImage
    from curio_serve.batch.results.recorded_poses import PoseRecording
    from curio_serve.batch.results.result_file import ResultFile
    from curio_serve.batch.results.result_parts import ResultParts

_LEAST_STEP_NS = 1_000_000


def check_tracking(arguments: DetectArguments, models: Sequence[str]) -> DetectArguments:
    """The call with one image worked on at a time, if it follows objects.

    Raises:
        UsageError: It has an option that does not go with following, or one that needs it.
    """
    if not arguments.track:
        if (arguments.track_objects, arguments.frame_rate) != (
            DetectArguments.track_objects,
            DetectArguments.frame_rate,
        ):
            raise UsageError("--track-objects and --frame-rate are for --track: give it, too, or leave them out")
        return arguments
    if remote := [model for model in models if not os.path.exists(model)]:
        raise UsageError(
            f"--track: {remote[0]} is behind a server; name a model on this machine, or set `track` in DetectStream"
        )
    is_recording = arguments.out is not None and arguments.out.lower().endswith(".mcap")
    if arguments.ray is not None or arguments.refine or arguments.format != "jsonl" or is_recording:
        raise UsageError(
            "--track follows on one machine and writes JSON Lines; leave out --ray, --refine and --format, and name "
            "--out so"
        )
    whole = arguments.max_detections, arguments.max_instances
    if any(given is not None for given in whole) or arguments.reads != 1:
        raise UsageError(
            "--track: say by --track-objects how many are followed, and leave out --max-detections, --max-instances "
            "and --reads"
        )
    if not 1 <= arguments.track_objects <= MAX_OBJECTS:
        raise UsageError(f"--track-objects {arguments.track_objects}: expected 1 to {MAX_OBJECTS}")
    if not (math.isfinite(arguments.frame_rate) and arguments.frame_rate > 0):
        raise UsageError(f"--frame-rate {arguments.frame_rate}: expected more than 0 frames/s")
    return replace(arguments, jobs=1)


def from_the_first(
    output: "ResultFile | ResultParts | PoseRecording", remaining: "Iterator[SourceImage]"
) -> "Iterator[SourceImage]":
    """The unanswered images, which have to be all: tracks of an earlier run are lost.

    Raises:
        UsageError: The result file already has answers.
    """
    first = next(remaining, None)  # the file is read now
    if output.num_images:
        raise UsageError(
            f"--track: {output.label} holds {output.num_images} images, and following cannot go on in the middle; "
            "give --overwrite, or another --out"
        )
    if first is not None:
        yield first
        yield from remaining


def timed(frames: "Iterable[SourceImage]", frame_rate: float) -> "Iterator[SourceImage]":
    """Frames with the time at which each was taken: as the recording or video says, or one after the other.

    A frame that cannot be read takes its time all the same. Where the stamps of a recording do not go forward, because
    nobody set them or a clock was set back, the time between two frames is that between their recordings.

    Args:
        frames: Those of a stream one after the other.
        frame_rate: Of frames that carry no time, frames/s.
    """
    stream, number, before, time_ns = "", 0, None, 0
    for frame in frames:
        if frame.stream != stream:
            stream, number, before = frame.stream, -1, None
        number, recorded = number + 1, frame.recorded
        time_s = number / frame_rate if frame.time_s is None else frame.time_s
        if recorded is not None:
            time_ns = recorded.stamp_ns if before is None else time_ns + _step_ns(before, recorded)
            before, time_s = recorded, time_ns / 1e9
        yield replace(frame, time_s=time_s)


def _step_ns(before: "RecordedAt", now: "RecordedAt") -> int:
    """Nanoseconds between two frames of a recording, at least a millisecond."""
    step_ns = now.stamp_ns - before.stamp_ns
    return step_ns if step_ns > 0 else max(now.log_time_ns - before.log_time_ns, _LEAST_STEP_NS)
