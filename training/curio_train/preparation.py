"""What a world's options need before anything is trained: data is fetched, files of one's own are examined."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from curio_train.config import RunConfig
from curio_train.worlds.options import CaptureOptions, LinemodOptions


def prepared(config: RunConfig, cache: Path, warn: Callable[[str], None]) -> RunConfig:
    """The configuration of a new run, ready to be trained.

    Args:
        config: As called.
        cache: Where downloads are kept.
        warn: Told of what is doubtful.

    Raises:
        DataError: A download failed, or files of one's own are certain not to work.
    """
    options = config.world
    if isinstance(options, LinemodOptions) and options.data is None and options.download:
        from curio_train.data.download import download_linemod

        return replace(config, world=replace(options, data=download_linemod(cache), download=False))
    if isinstance(options, CaptureOptions):
        from curio_train.doctor.before_training import refuse_unfit

        for doubt in refuse_unfit(options):
            warn(doubt)
    return config
