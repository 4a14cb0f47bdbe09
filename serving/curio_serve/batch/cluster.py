"""Runs ``curio-detect`` on a Ray cluster: actors on every node hold the model, take images by name and answer in order.

The nodes need this package, and the images, the model and the drawings' folder under the same paths as here.
"""

import logging
import os
import pickle
import socket
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import replace
from itertools import islice
from typing import Any, TypeAlias

import cv2

from curio_serve.batch.images.remote_files import is_url
from curio_serve.batch.images.source_image import SourceImage
from curio_serve.batch.results.formats import ImageLines
from curio_serve.errors import CurioError, Unavailable, UsageError

Opening: TypeAlias = Callable[[], Callable[[SourceImage], ImageLines]]
# One data set after another, so that memory does not depend on the number of images; large, because each starts actors.
_IMAGES_A_DATA_SET = 1 << 16
_IMAGES_A_BLOCK = 64
_REACH_TIMEOUT_S = 10.0


class _Worker:
    """A Ray actor: the model is opened once, where it runs."""

    def __init__(self, open_answering: Opening) -> None:
        cv2.setNumThreads(1)
        self._answer = open_answering()

    def __call__(self, row: dict[str, Any]) -> dict[str, bytes]:
        try:
            return {"answer": pickle.dumps(self._answer(pickle.loads(row["image"])))}
        except CurioError as exc:  # raised again on this side, as what it is
            return {"answer": pickle.dumps(exc)}


def over_cluster(
    address: str, open_answering: Opening, images: Iterable[SourceImage]
) -> Generator[ImageLines, None, None]:
    """The answers in the order of the images.

    Args:
        address: ``local`` for a cluster of this machine alone, ``auto`` for the one this machine is part of, or
            ``HOST:PORT``.
        open_answering: Called on the nodes.
        images: May be endless; taken in large portions.

    Raises:
        UsageError: Ray is not installed.
        Unavailable: The cluster is out of reach or broke down.
        CurioError: What was raised there.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray.data
    except ImportError as exc:
        raise UsageError("--ray needs Ray, which is not installed: pip install 'curio-pose[ray]'") from exc
    try:
        _check_reachable(address)
        ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, ValueError, RuntimeError) as exc:
        raise Unavailable(f"--ray {address}: no cluster to work with: {exc}") from exc
    try:
        logging.getLogger("ray.data").setLevel(logging.ERROR)
        context = ray.data.DataContext.get_current()
        context.execution_options.preserve_order = True
        context.enable_progress_bars = False
        remaining = iter(images)
        while portion := list(islice(remaining, _IMAGES_A_DATA_SET)):
            yield from _answers(ray, open_answering, portion)
    except ray.exceptions.RayError as exc:
        raise Unavailable(f"--ray {address}: the cluster broke down: {exc}") from exc
    finally:
        ray.shutdown()


def _check_reachable(address: str) -> None:
    """Check that somebody listens at the address: Ray itself would try for minutes.

    Raises:
        OSError: Nobody does.
        ValueError: The port is no number.
    """
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if colon:
        socket.create_connection((host, int(port)), timeout=_REACH_TIMEOUT_S).close()


def _answers(ray: Any, open_answering: Opening, portion: list[SourceImage]) -> Iterator[ImageLines]:
    num_blocks = max(1, len(portion) // _IMAGES_A_BLOCK)
    rows = [{"image": pickle.dumps(for_other_nodes(image))} for image in portion]
    num_actors = max(1, int(ray.cluster_resources().get("CPU", 1)))
    answered = ray.data.from_items(rows, override_num_blocks=num_blocks).map(
        _Worker,
        fn_constructor_args=(open_answering,),
        compute=ray.data.ActorPoolStrategy(min_size=1, max_size=num_actors),
    )
    for row in answered.iter_rows():
        answer = pickle.loads(row["answer"])
        if isinstance(answer, CurioError):
            raise answer
        yield answer


def for_other_nodes(image: SourceImage) -> SourceImage:
    """The image with an absolute path: other nodes have other working folders."""
    return image if is_url(image.path) else replace(image, path=os.path.abspath(image.path))
