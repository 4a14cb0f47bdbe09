"""The models that a command line names before its images: one, several, or all of a folder such as ``models/``."""

import os
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress

from curio_serve.errors import UsageError
from curio_serve.models.hub import fetch, is_on_hub
from curio_serve.models.model_folder import CONFIG_FILE, MODEL_FILE

SERVED_MODEL = re.compile(r"(?P<address>(?:\[[^\]]+\]|[^/:\[\]]+):\d{1,5})/(?P<model>[^/]+(?:/\d+)?)")
"""``HOST:PORT/NAME`` or ``HOST:PORT/NAME/VERSION``."""


def split_models(first: str, rest: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The models and the images of a call ``MODEL [MODEL ...] IMAGES...``.

    Args:
        first: The first argument, always a model or a folder of models.
        rest: The others; those at their beginning that are models are taken as such.

    Raises:
        UsageError: A model is named twice, or after the images.
        CurioError: A model on a hub cannot be had.
    """
    count = 0
    while count < len(rest) and _names_models(rest[count]):
        count += 1
    if count and count == len(rest) and os.path.exists(first) and not _names_models(first):
        raise UsageError(f"{first} is no model; models come first, and then images: {' '.join((*rest, first))}")
    models = tuple(model for argument in (first, *rest[:count]) for model in _expanded(argument))
    places = [os.path.realpath(model) if os.path.exists(model) else model for model in models]
    twice = next((model for number, model in enumerate(models) if places[number] in places[:number]), None)
    if twice is not None:
        raise UsageError(f"{twice} is named twice; name each model once, and then the images")
    return models, tuple(rest[count:])


def is_model(path: str) -> bool:
    """Whether a path is a model's folder, a version's folder or an .onnx file; a folder of a million images is none."""
    if not os.path.isdir(path):
        return path.endswith(".onnx") and os.path.isfile(path)
    if any(os.path.exists(os.path.join(path, name)) for name in (CONFIG_FILE, MODEL_FILE)):
        return True
    return any(
        folder.name.isdecimal() and os.path.exists(os.path.join(folder.path, MODEL_FILE)) for folder in _folders(path)
    )


def _names_models(argument: str) -> bool:
    if os.path.exists(argument):
        return is_model(argument) or bool(_models_in(argument))
    return is_on_hub(argument) or SERVED_MODEL.fullmatch(argument) is not None


def _expanded(argument: str) -> list[str]:
    """The argument itself; for a folder of models or a model on a hub, the models in it."""
    if is_on_hub(argument):
        return _models_in(str(fetch(argument, lambda line: print(f"curio-detect: {line}", file=sys.stderr))))
    return [argument] if not os.path.isdir(argument) or is_model(argument) else _models_in(argument) or [argument]


def _models_in(folder: str) -> list[str]:
    """Model folders in a folder, by name; nothing deeper is looked at."""
    found = (entry.path for entry in _folders(folder) if os.path.exists(os.path.join(entry.path, CONFIG_FILE)))
    return sorted(found)


def _folders(path: str) -> Iterator[os.DirEntry[str]]:
    """The folders in a folder; none if it cannot be listed (reading its images then reports that)."""
    with suppress(OSError), os.scandir(path) as entries:
        yield from (entry for entry in entries if entry.is_dir())
