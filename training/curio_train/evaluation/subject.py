"""What is evaluated: the network of a run folder or an exported model, as a function from images to scene codes."""

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from curio_proto.v1.model_spec_pb2 import ModelSpec
from torch import Tensor, nn

from curio_train.config import RunConfig
from curio_train.counting import counted
from curio_train.errors import ExportError, UsageError
from curio_train.exported_model import ExportedModel, find_model
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.configuration import CONFIG_FILE, from_json, world_name
from curio_train.learning.runs.provenance import run_sessions
from curio_train.learning.state import TrainState
from curio_train.networks.templates.quick_trunk import quicken
from curio_train.scene_code import joined
from curio_train.worlds import WORLDS, build
from curio_train.worlds.base import World
from curio_train.worlds.options import LinemodOptions

Predict = Callable[[Tensor], dict[str, Tensor]]
"""Any number of uint8 images [num, 3, height, width] to their scene codes."""

_MISSING = "{path}: there is no such file or folder; expected a run folder or an exported model"
_OTHER_RECIPE = "{file}: its recipe is no configuration of this version ({exc}); export it again"
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
        data: Data folder, for models of worlds that need one: an exported model doesn't name its maker's; and for runs
            whose own is gone.

    Raises:
        UsageError: It is neither, ``data`` is missing, or its meshes are not those that a model was trained with.
        CheckpointError: The run is damaged or has no checkpoint.
        ExportError: The model cannot be used.
        DataError: What the world needs cannot be read.
    """
    if not path.exists():
        raise UsageError(_MISSING.format(path=path))
    if (path / CONFIG_FILE).exists():
        return _from_run(path, data)
    return _from_model(find_model(path), data)


def refuse_without_frames(path: Path) -> None:
    """Refuse what has no real frames to be scored on: all but LineMOD.

    Raises:
        UsageError: It is of another world, or there is nothing at the path.
        CheckpointError: The run is damaged.
        ExportError: The model cannot be used.
    """
    if not path.exists():
        raise UsageError(_MISSING.format(path=path))
    if (path / CONFIG_FILE).exists():
        name = world_name(RunFolder.open(path).config)
    else:
        name = _recipe_of(ExportedModel.open(find_model(path)), path)["world"]["name"]
    if WORLDS[name] is not LinemodOptions:
        raise UsageError(f"--download: world {name} has no real frames; leave it out")


def _from_run(path: Path, data: Path | None) -> Subject:
    run = RunFolder.open(path)
    options = run.config.world
    if data is not None and isinstance(options, LinemodOptions) and options.data and not options.data.exists():
        options = dataclasses.replace(options, data=data)
    world = build(options)
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
    quicken(network)

    @torch.no_grad()
    def predict(images: Tensor) -> dict[str, Tensor]:
        code: dict[str, Tensor] = network(images.float() / 255)
        return code

    return _in_parts(predict)


def _in_parts(predict: Predict) -> Predict:
    """Read few images at once: crops of eight objects in twenty frames take 17 GB."""

    def of_all(images: Tensor) -> dict[str, Tensor]:
        num = max(1, _PIXELS_AT_ONCE // (images.shape[2] * images.shape[3]))
        parts = images.split(num)
        return joined([predict(part) for part in counted(parts, len(parts), "reading images, batches")])

    return of_all


def _from_model(file: Path, data: Path | None) -> Subject:
    model = ExportedModel.open(file)
    config = _config_of(model, file, data)
    world = build(config.world)
    spec = model.spec
    _refuse_other_meshes(world, spec, f"--data {data}", file)
    return Subject(config, world, model_reader(model, world), spec.images_seen, spec.training_seconds, spec.commit)


def _refuse_other_meshes(world: World, spec: ModelSpec, given: str, file: Path) -> None:
    for kind, learned in zip(world.objects, spec.objects, strict=True):
        if learned.mesh_sha256 and kind.mesh_sha256 != learned.mesh_sha256:
            raise UsageError(
                f"{given}: its mesh of {kind.name} is not the one that {file} was trained with (SHA-256 "
                f"{kind.mesh_sha256[:12]}…, expected {learned.mesh_sha256[:12]}…); give the data set of that mesh"
            )


def model_reader(model: ExportedModel, world: World) -> Predict:
    """Reads images by an exported model of the world."""

    def predict(images: Tensor) -> dict[str, Tensor]:
        return world.outputs.to_code(model(images.permute(0, 2, 3, 1).contiguous()))

    return _in_parts(predict)


def _config_of(model: ExportedModel, file: Path, data: Path | None) -> RunConfig:
    """The configuration in a model's specification, with this machine's data folder."""
    recipe = _recipe_of(model, file)
    options = recipe["world"]
    names = [one.name for one in model.spec.objects]
    recipe["world"] = options | _data_options(WORLDS[options["name"]], options, data, file, names)
    try:
        return from_json(recipe)
    except (ValueError, TypeError, KeyError) as exc:
        raise ExportError(_OTHER_RECIPE.format(file=file, exc=exc)) from exc


def _recipe_of(model: ExportedModel, file: Path) -> dict[str, Any]:
    """The configuration as it is stored, of a world that this version has."""
    try:
        recipe: dict[str, Any] = json.loads(model.spec.recipe)
        WORLDS[recipe["world"]["name"]]
    except (ValueError, TypeError, KeyError) as exc:
        raise ExportError(_OTHER_RECIPE.format(file=file, exc=exc)) from exc
    return recipe


def _data_options(
    kind: type[Any], options: Mapping[str, Any], data: Path | None, file: Path, names: Sequence[str]
) -> dict[str, str]:
    """Where the data are, and which of its classes are the model's: "all" would be those of this data set."""
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
    return {"data": str(data)} | ({"class_name": ",".join(names)} if len(names) > 1 else {})
