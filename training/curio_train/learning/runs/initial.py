"""What a run may begin with: the network of another run, or of an exported model.

A model's ONNX file is for running: batch norm is folded into the convolutions, and the exporter names and shares
constants as it likes. So a version keeps the network as it was trained beside it, in ``weights.safetensors``.
"""

from dataclasses import dataclass
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from curio_train.config import RunConfig
from curio_train.errors import CheckpointError, CurioError, ExportError, UsageError
from curio_train.export.folder import WEIGHTS_FILE, find_model
from curio_train.learning.runs.checkpoint import RunFolder
from curio_train.learning.runs.configuration import CONFIG_FILE, load_config
from curio_train.learning.state import TrainState, under

_IMAGES, _SECONDS, _TAUGHT = "images_seen", "training_seconds", "synthetic_labels"


@dataclass(frozen=True)
class Initial:
    """A trained network.

    Attributes:
        tensors: Its weights and buffers, by name.
        images_seen: By it, and by the networks that it began as.
        training_seconds: Likewise.
    """

    tensors: dict[str, Tensor]
    images_seen: int
    training_seconds: float

    @staticmethod
    def open(path: Path) -> "Initial":
        """The network behind a path.

        Args:
            path: A run folder, a model folder (its latest version) or a version's folder.

        Raises:
            UsageError: It is none of them.
            CheckpointError: The run is damaged or has no checkpoint, or the model has no readable weights.
        """
        if _is_run(path):
            tensors, course = RunFolder.open(path).last()
            return Initial(under("pose.network.", tensors), course.all_images, course.all_seconds)
        tensors, notes = _read(path)
        return Initial(tensors, int(notes[_IMAGES]), float(notes[_SECONDS]))


def begin_with(state: TrainState, path: Path) -> None:
    """Give ``state`` the network behind a path (see :meth:`Initial.open`), and nothing else of it.

    Raises:
        UsageError: The networks are not of one kind, or there is none.
        CheckpointError: It cannot be read.
    """
    initial = Initial.open(path)
    try:
        state.pose.network.load_state_dict(initial.tensors)
    except RuntimeError as exc:
        raise UsageError(
            f"--init {path}: its network does not fit this world ({str(exc).splitlines()[-1].strip()}); "
            "expected a run or a model of the same world and the same network flags"
        ) from exc
    state.course.images_before, state.course.seconds_before = initial.images_seen, initial.training_seconds


def weights_file(state: TrainState, config: RunConfig, *, half: bool) -> bytes:
    """The content of ``weights.safetensors``: what :func:`begin_with` needs, and what figures tell of its making.

    Args:
        state: Whose network it is.
        config: What it was trained with.
        half: Store matrices and convolutions as float16; vectors, which batch norm divides by, stay float32.

    Raises:
        ExportError: A weight is too large for float16.
    """
    tensors = {name: value.contiguous() for name, value in state.pose.network.state_dict().items()}
    if half:
        tensors = {
            name: value.half() if value.dim() > 1 and value.is_floating_point() else value
            for name, value in tensors.items()
        }
        if not all(value.isfinite().all() for value in tensors.values()):
            raise ExportError("a weight is too large for float16; export without --half")
    notes = {
        _IMAGES: str(state.course.all_images),
        _SECONDS: str(state.course.all_seconds),
        _TAUGHT: str(uses_synthetic_labels(config)),
    }
    return save(tensors, notes)


def uses_synthetic_labels(config: RunConfig) -> bool:
    """Whether poses of renderings taught a network, in the sense of the paper's LineMOD table, or the one it began as.

    A network that began as another, of which nothing is known any more, counts as so taught.
    """
    if config.terms & {"label", "sleep"} or config.method == "templates":
        return True
    if config.init is None:
        return False
    try:
        if _is_run(config.init):
            return uses_synthetic_labels(load_config(config.init))
        return _read(config.init)[1][_TAUGHT] != str(False)
    except CurioError:
        return True


def _is_run(path: Path) -> bool:
    return (path / CONFIG_FILE).exists()


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors and the notes of a model's weights."""
    file = find_model(path).with_name(WEIGHTS_FILE)
    if not file.exists():
        raise CheckpointError(
            f"{file.parent} was exported without weights to go on from ({WEIGHTS_FILE}); name a newer version, or the "
            "run folder that it was exported from"
        )
    try:
        with safe_open(file, framework="pt") as content:
            tensors = {name: content.get_tensor(name) for name in content.keys()}  # noqa: SIM118 (no mapping)
            notes = content.metadata() or {}
    except (OSError, SafetensorError) as exc:
        raise CheckpointError(f"{file} cannot be read ({exc}); copy it again, or export the model anew") from exc
    if missing := {_IMAGES, _SECONDS, _TAUGHT} - notes.keys():
        raise CheckpointError(f"{file} does not say its {', '.join(sorted(missing))}; export the model anew")
    return tensors, notes
