"""A run's configuration as JSON, and whether two of them are the same run."""

from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from curio_serve.files import read_json

from curio_train.config import RunConfig, WorldOptions
from curio_train.errors import CheckpointError, ResumeMismatch, UsageError
from curio_train.worlds import WORLDS

if TYPE_CHECKING:
    from cattrs import Converter

CONFIG_FILE = "config.json"
MAX_JSON_BYTES = 1 << 20
"""Size of the largest JSON file that a run folder may hold."""

T = TypeVar("T")
_MAY_CHANGE = ("minutes", "images", "stop_below")  # when to stop is not what to learn


def world_name(config: RunConfig) -> str:
    """The registered name of a configuration's world."""
    return _registered_name(config.world)


def _registered_name(world: WorldOptions) -> str:
    return next(name for name, kind in WORLDS.items() if isinstance(world, kind))


@cache
def _converter() -> "Converter":
    """A converter between dataclasses and JSON values; unknown keys are errors, and a world is stored with its name."""
    from cattrs import Converter  # not at --help
    from cattrs.gen import make_dict_structure_fn, make_dict_unstructure_fn

    converter = Converter(forbid_extra_keys=True, unstruct_collection_overrides={tuple: list})

    def from_world(world: WorldOptions) -> dict[str, Any]:
        return {"name": _registered_name(world), **make_dict_unstructure_fn(type(world), converter)(world)}

    def to_world(data: Mapping[str, Any], _: type) -> WorldOptions:
        if data.get("name") not in WORLDS:
            raise ValueError(f"found the world {data.get('name')!r}, expected one of {', '.join(WORLDS)}")
        kind = WORLDS[data["name"]]
        options = {name: value for name, value in data.items() if name != "name"}
        world: WorldOptions = make_dict_structure_fn(kind, converter)(kind.upgraded(options), kind)
        return world

    for kind in (bool, int, float, str):
        converter.register_structure_hook(kind, _unchanged)
    converter.register_unstructure_hook(WorldOptions, from_world)
    converter.register_structure_hook(WorldOptions, to_world)
    return converter


def _unchanged(value: Any, kind: type) -> Any:
    """A JSON value of the declared type as it is: ``"1"`` is no number, ``true`` is no 1."""
    if type(value) is not kind and not (kind is float and type(value) is int):
        raise ValueError(f"found {value!r}, expected {kind.__name__}")
    return value


def to_json(config: RunConfig) -> dict[str, Any]:
    """The configuration as JSON values; the world's name stands among its options."""
    plain: dict[str, Any] = _converter().unstructure(config)
    return plain


def to_portable(config: RunConfig) -> dict[str, Any]:
    """A configuration without paths of this machine: the recipe that is stored in an exported model."""
    folders = [field.name for field in fields(config.world) if _has_paths(getattr(config.world, field.name))]
    plain = to_json(config)
    if config.init is not None:
        plain["init"] = config.init.name
    plain["world"] = {name: value for name, value in plain["world"].items() if name not in folders}
    return plain


def from_json(data: Mapping[str, Any]) -> RunConfig:
    """The configuration that :func:`to_json` made these values of.

    Raises:
        ValueError: A field is missing, unknown or impossible; the text names it.
    """
    return structured(data, RunConfig, "config")


def structured(data: Any, kind: type[T], name: str) -> T:
    """A dataclass of JSON values.

    Args:
        data: An object with the values of its fields.
        kind: The dataclass.
        name: Of the whole, for messages.

    Raises:
        ValueError: A field is missing, unknown or impossible; the text names it.
    """
    from cattrs import BaseValidationError, transform_error

    if not isinstance(data, Mapping):
        raise ValueError(f"found {data!r}, expected an object")
    try:
        return _converter().structure(data, kind)
    except BaseValidationError as exc:
        raise ValueError("; ".join(transform_error(exc, path=name, format_exception=_reason))) from exc


def _reason(exc: BaseException, kind: type | None) -> str:
    """Cattrs's words for missing and unknown fields, else the error's own."""
    from cattrs.v import format_exception

    return str(exc) if isinstance(exc, UsageError | ValueError) else format_exception(exc, kind)


def load_config(run: Path) -> RunConfig:
    """The configuration of a run folder.

    Raises:
        CheckpointError: The folder holds none, or a field is missing, unknown or impossible.
    """
    file = run / CONFIG_FILE
    try:
        return from_json(read_json(file, MAX_JSON_BYTES))
    except OSError as exc:
        raise CheckpointError(
            f"{run} is no run folder: cannot read {file} ({exc.strerror}); expected a folder named by --out"
        ) from exc
    except ValueError as exc:
        raise CheckpointError(
            f"{file} is no configuration of this version ({exc}); restore it, or start a new run"
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


def _flat(value: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, entry in value.items():
        flat |= _flat(entry, f"{prefix}{name}.") if isinstance(entry, dict) else {prefix + name: entry}
    return flat
