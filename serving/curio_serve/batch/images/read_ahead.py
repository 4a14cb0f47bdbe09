"""Fetches images behind URLs a few at a time and ahead: a store is slow to answer, but answers many at once."""

from collections.abc import Generator, Iterable
from dataclasses import replace

from curio_serve.batch.images.parallel import in_order
from curio_serve.batch.images.remote_files import is_url
from curio_serve.batch.images.source_image import SourceImage
from curio_serve.errors import ImageError

_NUM_READERS = 4


def read_ahead(images: Iterable[SourceImage]) -> Generator[SourceImage, None, None]:
    """The images in their order, those behind URLs with their content; a few dozen are in memory at a time.

    Raises:
        Unavailable: A store does not answer; raised where the turn of the image comes.
    """
    yield from in_order(_fetched, images, _NUM_READERS)


def _fetched(image: SourceImage) -> SourceImage:
    if not is_url(image.path) or image.error:
        return image
    try:
        return replace(image, data=image.read())
    except ImageError as exc:
        return replace(image, error=str(exc))
