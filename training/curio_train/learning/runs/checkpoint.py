"""The run folder: configuration and checkpoints, written so that a crash cannot leave half of one.

::

    RUN/config.json
        checkpoints/00001200/tensors.safetensors     weights, buffers, the optimisers' moments
                             course.json             see TrainingProgress
                             SHA256SUMS              of both
        checkpoints/00001400/…                       the last two are kept
        history.jsonl  samples.png  tensorboard/     written by ``progress``
"""

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import torch
from curio_serve.files import read_file
from curio_serve.systems import lock
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from curio_train.config import RunConfig
from curio_train.errors import CheckpointError, UsageError
from curio_train.learning.runs.configuration import CONFIG_FILE, MAX_JSON_BYTES, load_config, structured, to_json
from curio_train.learning.runs.provenance import last_session, open_sessions
from curio_train.learning.state import TrainingProgress, TrainState
from curio_train.worlds.base import World

_NUM_KEPT = 2
_TENSORS, _PROGRESS, _SUMS = "tensors.safetensors", "course.json", "SHA256SUMS"
MAX_TENSOR_BYTES = 1 << 31


class RunFolder:
    """The folder of one run."""

    path: Path
    """The folder."""
    config: RunConfig
    """What the run was started with."""

    def __init__(self, path: Path, config: RunConfig) -> None:
        self.path = path
        self.config = config

    @staticmethod
    def open(path: Path) -> "RunFolder":
        """An existing run.

        Raises:
            CheckpointError: The folder holds none, or its configuration is damaged.
        """
        return RunFolder(path, load_config(path))

    @staticmethod
    def refuse_used(path: Path) -> None:
        """Check that a folder is free for a new run.

        Raises:
            UsageError: It holds a run already.
        """
        if (path / CONFIG_FILE).exists():
            raise UsageError(
                f"{path} holds a run already; continue it with --resume {path}, or name another folder: --out"
            )

    def write_config(self, *, new: bool) -> None:
        """Write the configuration, of a new run or with the budgets of a resumed one.

        Raises:
            UsageError: The run is to be new and the folder holds one already.
            CheckpointError: The folder cannot be written.
        """
        file = self.path / CONFIG_FILE
        if new:
            self.refuse_used(self.path)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            draft = file.with_suffix(".tmp")
            _write_synced(draft, json.dumps(to_json(self.config), indent=2).encode())
            draft.replace(file)
            _sync_folder(self.path)
        except OSError as exc:
            raise self._not_writable(exc) from exc

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other processes from training this run for as long as the block lasts.

        Raises:
            CheckpointError: Another process trains it, or the folder cannot be written.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            sessions = open_sessions(self.path)
        except OSError as exc:
            raise self._not_writable(exc) from exc
        with sessions:
            if not lock(sessions.fileno()):
                raise CheckpointError(
                    f"another process trains {self.path}: {last_session(self.path)}; end it first, or name another "
                    "folder: --out"
                )
            yield

    def checkpoints(self) -> list[Path]:
        """Complete checkpoints, oldest first."""
        return sorted(path for path in (self.path / "checkpoints").glob("[0-9]*") if path.is_dir())

    def save(self, state: TrainState) -> None:
        """Write a checkpoint, then drop all but the last two.

        Raises:
            CheckpointError: It could not be written (disk full, …). The earlier ones are untouched.
        """
        target = self.path / "checkpoints" / f"{state.progress.step:08d}"
        draft, replaced = target.with_name("draft.tmp"), target.with_name("replaced.tmp")
        try:
            shutil.rmtree(draft, ignore_errors=True)  # of a process that was killed while writing
            draft.mkdir(parents=True)
            tensors = {name: value.detach().cpu().contiguous() for name, value in state.tensors().items()}
            contents = {_TENSORS: save(tensors), _PROGRESS: json.dumps(asdict(state.progress)).encode()}
            contents[_SUMS] = "".join(f"{_sha256(data)}  {name}\n" for name, data in contents.items()).encode()
            for name, data in contents.items():
                _write_synced(draft / name, data)
            _sync_folder(draft)
            if target.exists() and (target / _SUMS).read_bytes() != contents[_SUMS]:  # calibrated since
                target.rename(replaced)
            if not target.exists():
                draft.rename(target)
            _sync_folder(target.parent)
        except OSError as exc:
            shutil.rmtree(draft, ignore_errors=True)
            raise CheckpointError(self._not_written(target, exc)) from exc
        for old in (replaced, *self.checkpoints()[:-_NUM_KEPT]):
            shutil.rmtree(old, ignore_errors=True)

    def restore(self, state: TrainState) -> None:
        """Bring ``state`` to the last checkpoint; without any it stays at the start.

        Raises:
            CheckpointError: The last checkpoint is damaged, or of other networks.
        """
        if self.checkpoints():
            self._load_last(state.load)

    def last(self) -> tuple[dict[str, Tensor], TrainingProgress]:
        """All tensors of the last checkpoint's :class:`TrainState` by name, and the run's progress.

        Raises:
            CheckpointError: There is no checkpoint, or it is damaged.
        """
        checkpoints = self.checkpoints()
        if not checkpoints:
            raise CheckpointError(f"{self.path} has no checkpoint yet; train it first: --resume {self.path}")
        last = checkpoints[-1]
        try:
            tensors = read_file(last / _TENSORS, MAX_TENSOR_BYTES)
            progress = read_file(last / _PROGRESS, MAX_JSON_BYTES)
            if (last / _SUMS).exists():  # earlier versions wrote none
                sums = read_file(last / _SUMS, MAX_JSON_BYTES).decode().split()
                if sums != [_sha256(tensors), _TENSORS, _sha256(progress), _PROGRESS]:
                    raise ValueError(f"it is not what {_SUMS} says: damaged after it was written")
            return load(tensors), structured(json.loads(progress), TrainingProgress, _PROGRESS)
        except (OSError, ValueError, RecursionError, SafetensorError) as exc:
            raise CheckpointError(_unreadable(last, exc)) from exc

    def trained(self, world: World) -> TrainState:
        """The last checkpoint on the CPU, with the network in evaluation mode, for export and evaluation.

        Raises:
            CheckpointError: There is no checkpoint yet, or it cannot be read.
        """
        state = TrainState(self.config, world, torch.device("cpu"))
        self._load_last(state.load_trained)
        state.pose.network.eval()
        return state

    def _load_last(self, load: Callable[[dict[str, Tensor], TrainingProgress], None]) -> None:
        tensors, progress = self.last()
        try:
            load(tensors, progress)
        except RuntimeError as exc:
            raise CheckpointError(
                f"checkpoint {self.checkpoints()[-1]} is of another network than this version builds for its "
                f"configuration ({exc}); go on with it in the version that made it"
            ) from exc

    def _not_writable(self, exc: OSError) -> CheckpointError:
        return CheckpointError(f"cannot write the run folder {self.path}: {exc.strerror}; name another: --out")

    def _not_written(self, target: Path, exc: OSError) -> str:
        kept = self.checkpoints()
        remains = (
            f"{kept[-1]} is intact: make room, then go on with --resume {self.path}"
            if kept
            else "there is no earlier one"
        )
        return f"cannot write checkpoint {target}: {exc.strerror}; {remains}"


def _unreadable(checkpoint: Path, exc: Exception) -> str:
    return f"checkpoint {checkpoint} cannot be read ({exc}); delete this folder to go on from the one before it"


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _write_synced(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _sync_folder(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
