"""A model's folder in Triton's layout, written whole or not at all.

::

    OUT/NAME/config.pbtxt        the tensors, the same for all versions
             CARD.md             where each version comes from, newest first
             SHA256SUMS          of every file of the versions
             1/  2/  …           versions; none is ever overwritten
                 model.onnx           what is served
                 golden.npz           an image and its outputs, which a server asks again before it serves the version
                 weights.safetensors  the network as it was trained, to train it further; no server reads it
                 reliability.json     when its answers are sure, and how far off they are, where that was measured
                 stable_poses.json    how its objects can stand on a plane
"""

import hashlib
import os
import re
import secrets
import shutil
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from curio_serve.files import write_whole
from curio_serve.models.golden import GOLDEN_FILE
from curio_serve.models.model import BESIDE
from curio_serve.models.model_folder import CONFIG_FILE, MODEL_FILE, SUMS_FILE, is_model_name, versions

from curio_train.errors import ExportError, UsageError
from curio_train.exported_model import WEIGHTS_FILE

_CARD = "CARD.md"
_LISTED = (MODEL_FILE, GOLDEN_FILE, WEIGHTS_FILE, *BESIDE)
_MAX_BATCH_SIZE = 64
_NOT_IN_NAMES, _LONGEST_NAME = re.compile(r"[^A-Za-z0-9_.-]+"), 64


@dataclass(frozen=True)
class ModelFolder:
    """The folder of one model, which need not exist yet."""

    path: Path
    """OUT/NAME."""

    @staticmethod
    def named(out: Path, name: str) -> "ModelFolder":
        """The folder for a model of that name.

        Raises:
            UsageError: The name cannot be a model's, or something else has the folder's place.
            ExportError: There is a file in the place of the folder of models.
        """
        if not is_model_name(name):
            raise UsageError(f"--name {name!r}: expected letters, digits, _, - and ., at most 64, no leading dot")
        if out.exists() and not out.is_dir():
            raise ExportError(f"cannot write {out / name}: {out} is no folder; name another folder: --out")
        folder = ModelFolder(out / name)
        if folder.path.exists() and not folder.versions():
            raise UsageError(
                f"{folder.path} exists and is no model folder (it has no <version>/{MODEL_FILE}); choose another "
                "--name or --out"
            )
        return folder

    @staticmethod
    def fitting_name(text: str) -> str:
        """A model's name made of another, such as a file's: ``Trager-links`` of ``Träger links``."""
        plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
        return _NOT_IN_NAMES.sub("-", plain).strip("-.")[:_LONGEST_NAME] or "part"

    def versions(self) -> list[int]:
        """Versions that are there, ascending."""
        return versions(self.path) if self.path.is_dir() else []

    def next_version(self) -> int:
        """The number after the largest that a version, or anything else in the folder, has."""
        taken = [int(path.name) for path in self.path.iterdir() if path.name.isdecimal()] if self.path.is_dir() else []
        return max(taken, default=0) + 1

    def files(self) -> list[Path]:
        """All files of the model that are there."""
        of_versions = [self.path / str(version) / name for version in self.versions() for name in _LISTED]
        return [
            file
            for file in (*(self.path / name for name in (CONFIG_FILE, _CARD, SUMS_FILE)), *of_versions)
            if file.is_file()
        ]

    def card(self) -> str:
        """Where each version comes from, in Markdown; empty where there is no card."""
        return _text(self.path / _CARD)

    def refuse_other_tensors(self, config: str) -> None:
        """Make sure that a version with these tensors may stand beside those that are there.

        Args:
            config: From :func:`triton_config`.

        Raises:
            ExportError: It may not.
        """
        path = self.path / CONFIG_FILE
        if path.exists() and path.read_text(encoding="utf-8") != config:
            raise ExportError(
                f"{self.path} holds a model with other inputs or outputs (see {path}); versions of one model must "
                "agree in them: choose another --name"
            )

    def add(self, version: int, files: Mapping[str, bytes], config: str, card: str) -> Path:
        """Write a version.

        Args:
            version: From :meth:`next_version`.
            files: Contents of the version's files, by name.
            config: From :func:`triton_config`.
            card: Markdown, a section about this version.

        Returns:
            The version's folder.

        Raises:
            ExportError: It could not be written. Nothing of it is left behind, and what was there is as before.
        """
        target = self.path / str(version)
        try:
            with _draft(self.path) as draft:
                if self.path.exists():
                    self._add_version(draft, target, files, config, card)
                else:
                    _fill(draft, self.path.name, version, files, card, config)
                    draft.rename(self.path)
        except OSError as exc:
            raise ExportError(f"cannot write {target}: {exc.strerror}; name another folder: --out") from exc
        return target

    def put_beside(self, version: int, file: str, text: str) -> Path:
        """Write a file that says more of a version beside its model, in place of an earlier one.

        Args:
            version: That is there.
            file: Its name, one of :data:`~curio_serve.models.model.BESIDE`.
            text: Its content.

        Returns:
            The file's path.

        Raises:
            ExportError: It could not be written.
        """
        path, listed = self.path / str(version) / file, f"{version}/{file}"
        lines = [line for line in _text(self.path / SUMS_FILE).splitlines() if not line.endswith(f"  {listed}")]
        lines.append(f"{hashlib.sha256(text.encode()).hexdigest()}  {listed}")
        try:
            write_whole(path, text)
            if (self.path / SUMS_FILE).exists():  # else one that lists this file alone would say that others are none
                write_whole(self.path / SUMS_FILE, "".join(f"{line}\n" for line in lines))
        except OSError as exc:
            raise ExportError(f"cannot write {path}: {exc.strerror}") from exc
        return path

    def _add_version(self, draft: Path, target: Path, files: Mapping[str, bytes], config: str, card: str) -> None:
        """Beside earlier versions: first what speaks of it, at last the version itself, by one rename."""
        _write(draft, files)
        before = _text(self.path / SUMS_FILE).splitlines()
        others = [line for line in before if f"  {target.name}/" not in line]
        sums = "".join(f"{line}\n" for line in others) + _sums(target.name, files)
        card_before = _text(self.path / _CARD)
        title, _, earlier = card_before.partition("\n\n")
        if not (self.path / CONFIG_FILE).exists():
            write_whole(self.path / CONFIG_FILE, config)
        if target.exists():
            raise ExportError(f"cannot write {target}: another export has just written it; export again")
        has_sums = (self.path / SUMS_FILE).exists()  # without them, those of one version would exclude the others
        try:
            if has_sums:
                write_whole(self.path / SUMS_FILE, sums)
            write_whole(self.path / _CARD, f"{title or _title(self.path.name)}\n\n{card}\n{earlier}")
            draft.rename(target)
        except OSError:
            if has_sums:
                write_whole(self.path / SUMS_FILE, "".join(f"{line}\n" for line in before))
            if card_before:
                write_whole(self.path / _CARD, card_before)
            else:
                (self.path / _CARD).unlink(missing_ok=True)
            raise


def triton_config(name: str, image: Sequence[int], outputs: Mapping[str, Sequence[int]]) -> str:
    """Triton's description of a model.

    Args:
        name: Of its folder.
        image: Shape of the uint8 input, the batch left out.
        outputs: Shape of each float32 output, the batch left out, in order.
    """

    def tensor(name: str, kind: str, shape: Sequence[int]) -> str:
        return f'  {{ name: "{name}" data_type: {kind} dims: [ {", ".join(map(str, shape))} ] }}'

    found = ",\n".join(tensor(output, "TYPE_FP32", shape) for output, shape in outputs.items())
    head = f'name: "{name}"\nbackend: "onnxruntime"\nmax_batch_size: {_MAX_BATCH_SIZE}\n'
    return f"{head}input [\n{tensor('image', 'TYPE_UINT8', image)}\n]\noutput [\n{found}\n]\n"


@contextmanager
def _draft(folder: Path) -> Iterator[Path]:
    """An empty folder on the target's disk, which disappears unless it is renamed. Servers pass over its name."""
    draft = folder.with_name(f".{folder.name}-{os.getpid()}-{secrets.token_hex(4)}.tmp")
    draft.mkdir(parents=True)
    try:
        yield draft
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _fill(folder: Path, name: str, version: int, files: Mapping[str, bytes], card: str, config: str) -> None:
    (folder / str(version)).mkdir()
    _write(folder / str(version), files)
    (folder / CONFIG_FILE).write_text(config, encoding="utf-8")
    (folder / SUMS_FILE).write_text(_sums(str(version), files), encoding="utf-8")
    (folder / _CARD).write_text(f"{_title(name)}\n\n{card}", encoding="utf-8")


def _write(folder: Path, files: Mapping[str, bytes]) -> None:
    for name, content in files.items():
        (folder / name).write_bytes(content)


def _title(name: str) -> str:
    return f"# {name}"


def _sums(version: str, files: Mapping[str, bytes]) -> str:
    """Lines in ``sha256sum``'s format."""
    listed = (name for name in _LISTED if name in files)
    return "".join(f"{hashlib.sha256(files[name]).hexdigest()}  {version}/{name}\n" for name in listed)


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8") if path.exists() else ""
