"""Finds the models that a server offers in a folder, loads them, and swaps them while serving.

A model is ``<root>/<name>/<version>/model.onnx``. The loaded models are one immutable table, replaced as a whole, so
that a call sees the old or the new state and never a mixture. A check in a child process with bounded memory and time
comes before loading; a candidate that fails it leaves the models that serve untouched.
"""

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from curio_serve.errors import CheckNotDone, ModelError, ModelNotFound
from curio_serve.models.golden import GOLDEN_FILE
from curio_serve.models.model import BESIDE, Model
from curio_serve.models.model_folder import MODEL_FILE, is_model_name, load_version, versions
from curio_serve.models.runtime import DEFAULT_RUNTIME, Runtime

Key = tuple[str, int]
Signature = tuple[tuple[int, int, int, int], ...]
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 5.0, 600.0  # before a check that was not done is tried again
_FOLDER = 0  # in place of a version: the model's folder itself


@dataclass(frozen=True)
class Change:
    """The fate of one version when the folder was scanned."""

    name: str
    """Name of the model."""
    version: int
    """Version of the model; 0: its folder cannot be read."""
    event: str
    """One of "loaded", "unloaded", "refused"."""
    reason: str = ""
    """Why it was refused."""


class Repository:
    """Models under one folder."""

    def __init__(
        self,
        root: Path,
        num_versions: int = 2,
        runtime: Runtime = DEFAULT_RUNTIME,
        check: Callable[[Path, int], None] | None = None,
    ) -> None:
        """Nothing is loaded yet: see :meth:`refresh`.

        Args:
            root: Folder of models.
            num_versions: Newest versions of each model to keep.
            runtime: How networks are run.
            check: Called with a model's folder and a version before this process opens the file; raises ModelError.
        """
        self._root, self._num_versions, self._runtime, self._check = root, num_versions, runtime, check
        self._models: Mapping[str, Mapping[int, Model]] = {}
        self._seen: dict[Key, Signature] = {}
        self._put_off: dict[Key, tuple[int, float]] = {}  # how many checks were not done, and when the next is

    def get(self, name: str, version: int = 0) -> Model:
        """A loaded model; version 0 is the latest.

        Raises:
            ModelNotFound: Lists what is there.
        """
        loaded = self._models.get(name)
        if not loaded:
            raise ModelNotFound(f"no model {name[:64]!r}; loaded are {sorted(self._models)}")
        if version and version not in loaded:
            raise ModelNotFound(f"model {name!r} has no version {version}; loaded are {sorted(loaded)}")
        return loaded[version or max(loaded)]

    def __iter__(self) -> Iterator[tuple[str, Mapping[int, Model]]]:
        """Name and versions of each model, by name."""
        return iter(sorted(self._models.items()))

    def refresh(self) -> list[Change]:
        """Scan the folder, load versions that are new or changed, and drop those that are gone.

        Returns:
            The changes. A refused candidate is not tried again until its files change; one whose check was not done is
            tried again, after ever longer pauses.

        Raises:
            ModelError: The folder itself cannot be read.
        """
        changes: list[Change] = []
        models: dict[str, Mapping[int, Model]] = {}
        seen: dict[Key, Signature] = {}
        for folder in self._folders():
            if loaded := self._versions(folder, seen, changes):
                models[folder.name] = loaded
        for name, previous in self._models.items():
            changes += [Change(name, v, "unloaded") for v in previous if v not in models.get(name, {})]
        self._seen, self._models = seen, models
        return changes

    def _versions(self, folder: Path, seen: dict[Key, Signature], changes: list[Change]) -> Mapping[int, Model]:
        """The versions of a model to serve: the newest ones that load; if its folder cannot be read, the present ones.

        Args:
            folder: Of the model.
            seen: Signatures of the versions found are added to it.
            changes: Changes are added to it.
        """
        name = folder.name
        try:
            found = versions(folder)
        except ModelError as exc:
            seen |= {key: signature for key, signature in self._seen.items() if key[0] == name}
            if (name, _FOLDER) not in seen:
                changes.append(Change(name, _FOLDER, "refused", str(exc)))
            seen[name, _FOLDER] = ()
            return self._models.get(name, {})
        loaded: dict[int, Model] = {}
        for version in reversed(found):
            if len(loaded) == self._num_versions:
                break
            seen[name, version] = _signature(folder, version)
            model = self._current(folder, version, seen[name, version], changes)
            if model is not None:
                loaded[version] = model
        return loaded

    def _current(self, folder: Path, version: int, signature: Signature, changes: list[Change]) -> Model | None:
        """A version's model: loaded anew if its files changed; else, or if that fails, the present one."""
        key, present = (folder.name, version), self._models.get(folder.name, {}).get(version)
        failed, next_s = self._put_off.get(key, (0, math.inf))
        if self._seen.get(key) == signature and time.monotonic() < next_s:
            return present
        try:
            if self._check is not None:
                self._check(folder, version)
            model = load_version(folder, version, self._runtime)
        except ModelError as exc:
            self._put_off.pop(key, None)
            if isinstance(exc, CheckNotDone):
                pause_s = min(_FIRST_PAUSE_S * 2**failed, _LONGEST_PAUSE_S)
                self._put_off[key] = failed + 1, time.monotonic() + pause_s
            changes.append(Change(folder.name, version, "refused", str(exc)))
            return present
        self._put_off.pop(key, None)
        changes.append(Change(folder.name, version, "loaded"))
        return model

    def _folders(self) -> list[Path]:
        try:
            return sorted(folder for folder in self._root.iterdir() if is_model_name(folder.name) and folder.is_dir())
        except OSError as exc:
            raise ModelError(
                f"models folder {self._root} cannot be read: {exc.strerror}; "
                f"expected a folder with <name>/<version>/{MODEL_FILE}"
            ) from exc


def _signature(folder: Path, version: int) -> Signature:
    files = (
        *(folder / str(version) / name for name in (MODEL_FILE, GOLDEN_FILE, *BESIDE)),
        folder / "SHA256SUMS",
        folder / "config.pbtxt",
    )
    signature = []
    for file in files:
        try:
            stat = file.stat()
        except OSError:
            signature.append((0, 0, 0, 0))
        else:
            # When it was last changed in any way, as another owner or mode may be what makes it fit to be read; on
            # Windows that is when it was made.
            signature.append((stat.st_ctime_ns, stat.st_mtime_ns, stat.st_size, stat.st_ino))
    return tuple(signature)
