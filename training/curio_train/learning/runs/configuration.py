"""A run's configuration as JSON, and whether two of them are the same run."""

import json
from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_type_hints

from curio_train.config import RunConfig
from curio_train.errors import CheckpointError, ResumeMismatch, UsageError
from curio_train.worlds import WORLDS

CONFIG_FILE = "config.json"
_MAY_CHANGE = ("minutes", "images", "stop_below")  # when to stop is not what to learn


def world_name(config: RunConfig) -> str:
    """The registered name of a configuration's world."""
    return next(name for name, kind in WORLDS.items() if isinstance(config.world, kind))


def to_json(config: RunConfig) -> dict[str, Any]:
    """Plain values; the world's name stands among its options."""
    plain: dict[str, Any] = _plain(asdict(config))
    plain["world"] = {"name": world_name(config), **plain["world"]}
    return plain


def to_portable(config: RunConfig) -> dict[str, Any]:
    """The same without the folders that the world was given: what a model tells other machines of its making."""
    folders = [field.name for field in fields(config.world) if _has_paths(getattr(config.world, field.name))]
    plain = to_json(config)
    if config.init is not None:
        plain["init"] = config.init.name
    plain["world"] = {name: value for name, value in plain["world"].items() if name not in folders}
    return plain


def from_json(data: Mapping[str, Any]) -> RunConfig:
    """The configuration that :func:`to_json` made these values of.

    Raises:
        KeyError, TypeError, ValueError, UsageError: A field is missing, unknown or impossible.
    """
    options = dict(data["world"])
    world = _typed(WORLDS[options.pop("name")], options)
    hints = get_type_hints(RunConfig)
    return RunConfig(world, **{name: _typed(hints[name], data[name]) for name in data if name != "world"})


def load_config(run: Path) -> RunConfig:
    """The configuration of a run folder.

    Raises:
        CheckpointError: The folder holds none, or a field is missing, unknown or impossible.
    """
    file = run / CONFIG_FILE
    try:
        return from_json(json.loads(file.read_bytes()))
    except OSError as exc:
        raise CheckpointError(
            f"{run} is no run folder: cannot read {file} ({exc.strerror}); expected a folder named by --out"
        ) from exc
    except (KeyError, TypeError, ValueError, UsageError) as exc:
        raise CheckpointError(
            f"{file} is no configuration of this version ({type(exc).__name__}: {exc}); restore it, or start a new run"
        ) from exc


def refuse_other(stored: RunConfig, wanted: RunConfig, run: Path) -> None:
    """Refuse to go on with anything but what the run was started with; only budgets may change.

    Raises:
        ResumeMismatch: Names every field that differs, with both values.
    """
    before, now = _flat(to_json(stored)), _flat(to_json(wanted))
    differing = [
        f"{name} (run: {before.get(name)}, now: {now.get(name)})"
        for name in sorted(before.keys() | now.keys())
        if before.get(name) != now.get(name) and name not in _MAY_CHANGE
    ]
    if differing:
        raise ResumeMismatch(
            f"{run} was started with another configuration; it differs in {', '.join(differing)}. "
            "Leave these flags out to go on with the run's own values, or start a new run with --out"
        )


def _has_paths(value: Any) -> bool:
    return isinstance(value, Path) or (isinstance(value, tuple) and any(isinstance(one, Path) for one in value))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(entry) for name, entry in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain(entry) for entry in value]
    return str(value) if isinstance(value, Path) else value


def _typed(kind: Any, value: Any) -> Any:
    """A JSON value as the type that a dataclass field declares."""
    choices = get_args(kind)
    if value is None or (choices and NoneType in choices):
        return None if value is None else _typed(next(c for c in choices if c is not NoneType), value)
    if isinstance(kind, type) and is_dataclass(kind):
        hints = get_type_hints(kind)
        return kind(**{name: _typed(hints[name], entry) for name, entry in value.items()})
    if kind is Path:
        return Path(value)
    return tuple(_typed(choices[0] if choices else None, one) for one in value) if isinstance(value, list) else value


def _flat(value: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, entry in value.items():
        flat |= _flat(entry, f"{prefix}{name}.") if isinstance(entry, dict) else {prefix + name: entry}
    return flat
