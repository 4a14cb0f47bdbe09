"""Starting a run from the network of another run, or of an exported model (``--init``).

A model's ONNX file cannot be trained further: batch norm is folded into the convolutions, and the exporter renames and
shares constants. So each version also stores the network as it was trained, in ``weights.safetensors``.
"""

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

from curio_serve.files import check_regular
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from curio_train.config import RunConfig
from curio_train.errors import CheckpointError, CurioError, ExportError, UsageError
from curio_train.exported_model import WEIGHTS_FILE, ExportedModel, find_model
from curio_train.learning.runs.checkpoint import MAX_TENSOR_BYTES, RunFolder
from curio_train.learning.runs.configuration import CONFIG_FILE, load_config
from curio_train.learning.state import TrainState, under
from curio_train.networks.several_objects.network import ObjectsNetwork
from curio_train.networks.two_stage.network import TwoStageNetwork
from curio_train.worlds.options import ALL_CLASSES, CaptureOptions, LinemodOptions

_IMAGES, _SECONDS, _SYNTHETIC_LABELS = "images_seen", "training_seconds", "synthetic_labels"
_MESSAGE_LENGTH = 160


def begin_with(state: TrainState, path: Path) -> None:
    """Load a trained network into ``state``; optimisers and budget start anew.

    The last layer of a crop-pose stage begins with random weights where the other one reads other things of its object.

    Args:
        state: Of the new run.
        path: A run folder, a model folder (its latest version) or a version's folder.

    Raises:
        UsageError: There is no network there, or it is of another architecture.
        CheckpointError: The run is damaged or has no checkpoint, or the model has no readable weights.
    """
    if _is_run(path):
        tensors, before = RunFolder.open(path).last()
        tensors, images, seconds = under("pose.network.", tensors), before.all_images, before.all_seconds
    else:
        tensors, notes = _weights_and_notes(path)
        try:
            images, seconds = int(notes[_IMAGES]), float(notes[_SECONDS])
        except ValueError as exc:
            raise CheckpointError(f"{path}: its {WEIGHTS_FILE} says {notes}; export the model anew") from exc
    network = state.pose.network
    try:
        network.load_state_dict(_without_drawn(network, tensors) | _kept(network, tensors))
    except RuntimeError as exc:
        raise UsageError(
            f"--init {path}: its network does not fit this world ({_first_difference(exc)}); "
            "expected a run or a model of the same world and the same network flags, such as --two-stage, and for "
            "parts on a plane with as many parts (--counts) in the same poses (--lying)"
        ) from exc
    state.progress.images_before, state.progress.seconds_before = images, seconds


def check_objects_before(path: Path, names: Sequence[str]) -> None:
    """Refuse a first network whose slots are of the same objects in another order, or of more or fewer objects.

    Weights are taken over slot by slot, so that each object would begin as another one.

    Args:
        path: As for :func:`begin_with`.
        names: Of the new run's objects, in their order.

    Raises:
        UsageError: The network is of such objects, or there is none.
        CheckpointError: The run is damaged.
        ExportError: The model is broken.
    """
    before = _object_names(path)
    if not before or len(before) == len(names) == 1:
        return
    if len(before) != len(names) or (sorted(before) == sorted(names) and before != list(names)):
        raise UsageError(
            f"--init {path}: it finds {', '.join(before)}, and this run is of {', '.join(names)}; expected as many "
            "objects, and the same ones in the same order"
        )


def _object_names(path: Path) -> list[str]:
    """Names of the objects that a run or a model finds, in the order of their slots; none where it does not say."""
    if not _is_run(path):
        return [one.name for one in ExportedModel.open(find_model(path)).spec.objects]
    world = load_config(path).world
    if isinstance(world, CaptureOptions):
        return [mesh.stem for mesh in world.mesh]
    if isinstance(world, LinemodOptions) and world.class_name != ALL_CLASSES:
        return world.class_name.split(",")
    return []


def _first_difference(exc: RuntimeError) -> str:
    """The last line of torch's message, without the names of all parameters that are missing or too many."""
    return textwrap.shorten(str(exc).splitlines()[-1], _MESSAGE_LENGTH, placeholder=" …")


def weights_file(state: TrainState, config: RunConfig, *, half: bool) -> bytes:
    """The content of ``weights.safetensors``: the network for :func:`begin_with`, and notes on its training.

    Args:
        state: Whose network it is.
        config: What it was trained with.
        half: Store matrices and convolutions as float16; vectors stay float32, because batch norm divides by some.

    Raises:
        ExportError: A weight is too large for float16.
    """
    tensors = {name: value.contiguous() for name, value in _learned(state.pose.network).items()}
    if half:
        tensors = {
            name: value.half() if value.dim() > 1 and value.is_floating_point() else value
            for name, value in tensors.items()
        }
        if not all(value.isfinite().all() for value in tensors.values()):
            raise ExportError("a weight is too large for float16; export without --half")
    notes = {
        _IMAGES: str(state.progress.all_images),
        _SECONDS: str(state.progress.all_seconds),
        _SYNTHETIC_LABELS: str(uses_synthetic_labels(config)),
    }
    return save(tensors, notes)


def uses_synthetic_labels(config: RunConfig) -> bool:
    """Whether true poses of renderings were used to train a network, as in the paper's LineMOD table.

    The runs and models that it was initialised from count, too; one that cannot be read any more counts as yes.
    """
    if config.terms.label or config.terms.sleep or config.terms.templates:
        return True
    if config.init is None:
        return False
    try:
        if _is_run(config.init):
            return uses_synthetic_labels(load_config(config.init))
        return _weights_and_notes(config.init)[1][_SYNTHETIC_LABELS] != str(False)
    except CurioError:
        return True


def method_before(config: RunConfig) -> str | None:
    """The method that trained the run which this one began as; None where it began as no run that can be read."""
    if config.init is None or not _is_run(config.init):
        return None
    try:
        return load_config(config.init).method
    except CurioError:
        return None


def _learned(network: nn.Module) -> dict[str, Tensor]:
    """The state of a network without its templates or outlines, which are drawn anew."""
    return _without_drawn(network, network.state_dict())


def _without_drawn(network: nn.Module, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    drawn = network.DRAWN if isinstance(network, ObjectsNetwork | TwoStageNetwork) else ()
    return {name: value for name, value in tensors.items() if not name.startswith(drawn)}


def _kept(network: nn.Module, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """What a network does not take from another: what is drawn, and a last layer of another size."""
    own = network.state_dict()
    last = TwoStageNetwork.LAST if isinstance(network, TwoStageNetwork) else ()
    kept = {
        name for name in own if name.startswith(last) and name in tensors and own[name].shape != tensors[name].shape
    }
    return {name: own[name] for name in kept | (own.keys() - _learned(network).keys())}


def _is_run(path: Path) -> bool:
    return (path / CONFIG_FILE).exists()


def _weights_and_notes(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The content of a model's ``weights.safetensors``."""
    file = find_model(path).with_name(WEIGHTS_FILE)
    if not file.exists():
        raise CheckpointError(
            f"{file.parent} was exported without {WEIGHTS_FILE} and cannot be trained further; name a newer version, "
            "or the run folder that it was exported from"
        )
    try:
        check_regular(file.stat(), file, MAX_TENSOR_BYTES)
        with safe_open(file, framework="pt") as content:
            tensors = {name: content.get_tensor(name) for name in content.keys()}  # noqa: SIM118 (no mapping)
            notes = content.metadata() or {}
    except (OSError, SafetensorError) as exc:
        raise CheckpointError(f"{file} cannot be read ({exc}); copy it again, or export the model anew") from exc
    if missing := {_IMAGES, _SECONDS, _SYNTHETIC_LABELS} - notes.keys():
        raise CheckpointError(f"{file} does not say its {', '.join(sorted(missing))}; export the model anew")
    return tensors, notes
