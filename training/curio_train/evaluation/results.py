"""Stores the measurements of a run as JSON in its folder; export and reports read them."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from curio_serve.files import write_whole

from curio_train.errors import CheckpointError


def keep(file: Path, result: Mapping[str, Any]) -> None:
    """Write a result whole or not at all.

    Raises:
        CheckpointError: The run folder cannot be written.
    """
    try:
        write_whole(file, json.dumps(result, indent=2))
    except OSError as exc:
        raise CheckpointError(f"cannot write {file}: {exc.strerror}; make the run folder writable") from exc
