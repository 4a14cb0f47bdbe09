"""What is evaluated: the network of a run folder or an exported model, as a function from images to scene codes."""

import dataclasses
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from curio_train.config import RunConfig
from curio_train.errors import ExportError, UsageError
from curio_train.exported_model import ExportedModel, find_model
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.configuration import CONFIG_FILE, from_json
from curio_train.learning.runs.provenance import run_sessions
from curio_train.learning.state import TrainState
from curio_train.networks.templates.quick_trunk import with_quick_trunk
from curio_train.scene_code import joined
from curio_train.worlds import WORLDS, build
from curio_train.worlds.base import World

Predict = Callable[[Tensor], dict[str, Tensor]]
"""Any number of uint8 images [num, 3, height, width] to their scene codes."""

_PIXELS_AT_ONCE = 1 << 20  # three frames of 640x480


@dataclass(frozen=True)
class Subject:
    """Something that reads poses from images."""

    config: RunConfig
    """What it was trained with."""
    world: World
    """World in which it was trained."""
    predict: Predict
    """Reads images."""
    images_seen: int
    """Images shown in training, to it and to the networks that it began as."""
    training_seconds: float
    """Seconds of training, of it and of the networks that it began as."""
    commit: str
    """Commit of the code that trained it."""

    def untrained(self) -> Predict:
        """The network as it was before the first step, from the same seed."""
        return _reader(TrainState(self.config, self.world, torch.device("cpu")).pose.network.eval())


def load_subject(path: Path, data: Path | None = None) -> Subject:
    """The network behind a path.

    Args:
        path: A run folder, a model folder (its latest version), a version's folder, or an .onnx file.
        data: Data folder, for models of worlds that need one: an exported model doesn't name its maker's.

    Raises:
        UsageError: It is neither, or ``data`` is missing.
        CheckpointError: The run is damaged or has no checkpoint.
        ExportError: The model cannot be used.
        DataError: What the world needs cannot be read.
    """
    if not path.exists():
        raise UsageError(f"{path}: there is no such file or folder; expected a run folder or an exported model")
    if (path / CONFIG_FILE).exists():
        return _from_run(path)
    return _from_model(find_model(path), data)


def _from_run(path: Path) -> Subject:
    run = RunFolder.open(path)
    world = build(run.config.world)
    state = run.trained(world)
    progress = state.progress
    return Subject(
        run.config,
        world,
        _reader(state.pose.network),
        progress.all_images,
        progress.all_seconds,
        run_sessions(path)[0].commit,
    )


def _reader(network: nn.Module) -> Predict:
    network = with_quick_trunk(network)

    @torch.no_grad()
    def predict(images: Tensor) -> dict[str, Tensor]:
        code: dict[str, Tensor] = network(images.float() / 255)
        return code

    return _in_parts(predict)


def _in_parts(predict: Predict) -> Predict:
    """Read few images at once: crops of eight objects in twenty frames take 17 GB."""

    def of_all(images: Tensor) -> dict[str, Tensor]:
        num = max(1, _PIXELS_AT_ONCE // (images.shape[2] * images.shape[3]))
        return joined([predict(part) for part in images.split(num)])

    return of_all


def _from_model(file: Path, data: Path | None) -> Subject:
    model = ExportedModel.open(file)
    config = _config_of(model, file, data)
    world = build(config.world)
    spec = model.spec
    return Subject(config, world, model_reader(model, world), spec.images_seen, spec.training_seconds, spec.commit)


def model_reader(model: ExportedModel, world: World) -> Predict:
    """Reads images by an exported model of the world."""

    def predict(images: Tensor) -> dict[str, Tensor]:
        return world.outputs.to_code(model(images.permute(0, 2, 3, 1).contiguous()))

    return _in_parts(predict)


def _config_of(model: ExportedModel, file: Path, data: Path | None) -> RunConfig:
    """The configuration in a model's specification, with this machine's data folder."""
    try:
        recipe = json.loads(model.spec.recipe)
        options = recipe["world"]
        kind = WORLDS[options["name"]]
        recipe["world"] = options | _data_option(kind, options, data, file)
        return from_json(recipe)
    except (ValueError, TypeError, KeyError) as exc:
        raise ExportError(f"{file}: its recipe is no configuration of this version ({exc}); export it again") from exc


def _data_option(kind: type[Any], options: Mapping[str, Any], data: Path | None, file: Path) -> dict[str, str]:
    needed = {field.name for field in dataclasses.fields(kind) if field.default is field.default_factory}
    if missing := sorted(needed - options.keys()):
        raise UsageError(
            f"{file} is a model of world {options['name']}, which does not hold its maker's {', '.join(missing)}; give "
            "the run folder that it was exported from"
        )
    if "data" not in {field.name for field in dataclasses.fields(kind)}:
        return {}
    if data is None:
        raise UsageError(f"{file} is a model of world {options['name']}, which needs its data: --data DIR")
    return {"data": str(data)}
