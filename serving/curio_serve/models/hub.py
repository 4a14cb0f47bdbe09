"""Models on a hub, through huggingface_hub: ``hf://ORG/NAME`` or ``hf://ORG/NAME@REVISION``.

A repository holds a folder of models as ``curio-export --push`` writes it, ``NAME/{config.pbtxt, CARD.md, SHA256SUMS,
VERSION/model.onnx}``, beside the README.md that the hub shows. huggingface_hub keeps what was fetched in its cache, and
finds token, address and cache as everywhere (``HF_TOKEN``, ``HF_ENDPOINT``, ``HF_HOME``, ``HF_HUB_OFFLINE``).
"""

import hashlib
import os
import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from curio_serve.errors import ModelError, Unavailable, UsageError
from curio_serve.models.model import BESIDE
from curio_serve.models.model_folder import CONFIG_FILE, MODEL_FILE, SUMS_FILE, listed_sums

if TYPE_CHECKING:
    from huggingface_hub import HfApi

SCHEME = "hf://"
_PART = r"[A-Za-z0-9][A-Za-z0-9_.-]{0,95}"
_REPOSITORY = re.compile(rf"{_PART}/{_PART}")
_MODEL = re.compile(rf"(?P<name>{_PART})/(?P<version>[1-9][0-9]{{0,8}})/{re.escape(MODEL_FILE)}")
# weights.safetensors is for training
_FETCHED = [
    "*/config.pbtxt",
    "*/CARD.md",
    "*/SHA256SUMS",
    f"*/*/{MODEL_FILE}",
    "*/*/golden.npz",
    *(f"*/*/{file}" for file in BESIDE),
]


def is_on_hub(model: str) -> bool:
    """Whether a name is an address on a hub."""
    return model.startswith(SCHEME)


def is_repository(name: str) -> bool:
    """Whether a text is a valid name of a repository: ``ORG/NAME``."""
    return _REPOSITORY.fullmatch(name) is not None


def models_in(files: Iterable[str]) -> dict[str, list[int]]:
    """The models among the files of a repository: versions by name.

    Args:
        files: Paths in the repository.
    """
    there, found = set(files), dict[str, list[int]]()
    for match in filter(None, map(_MODEL.fullmatch, sorted(there))):
        name = match["name"]
        if {f"{name}/{CONFIG_FILE}", f"{name}/{SUMS_FILE}"} <= there:
            found.setdefault(name, []).append(int(match["version"]))
    return found


def open_hub() -> "HfApi":
    """The hub.

    Raises:
        UsageError: The extra ``hub`` is not installed.
    """
    try:
        from huggingface_hub import HfApi
        from huggingface_hub.utils import disable_progress_bars
    except ImportError as exc:
        raise UsageError(f"{SCHEME} needs the extra hub: pip install 'curio-pose[hub]' ({exc})") from exc
    if not sys.stderr.isatty():
        disable_progress_bars()
    return HfApi(endpoint=os.environ.get("HF_ENDPOINT"), library_name="curio-pose")


def timeout_s() -> float:
    """Seconds in which a hub has to answer a first request: 10, or what ``HF_HUB_ETAG_TIMEOUT`` says."""
    from huggingface_hub.constants import HF_HUB_ETAG_TIMEOUT

    return float(HF_HUB_ETAG_TIMEOUT)


def fetch(address: str, report: Callable[[str], None]) -> Path:
    """A folder of models from a hub, or from the cache if the hub does not answer.

    Args:
        address: ``hf://ORG/NAME`` or ``hf://ORG/NAME@REVISION``; a revision is a branch, a tag or a commit.
        report: Called with a line where the cache stands in for the hub.

    Returns:
        The folder in the cache. Each file has the SHA-256 that SHA256SUMS lists.

    Raises:
        UsageError: The address is malformed, there is no such repository or revision, or it is private.
        ModelError: The repository holds no model of ours, or a file is damaged.
        Unavailable: The hub does not answer, and the cache has no copy.
    """
    repository, _, revision = address.removeprefix(SCHEME).partition("@")
    if not is_repository(repository) or (address.endswith("@") and not revision):
        raise UsageError(f"{address}: expected {SCHEME}ORG/NAME or {SCHEME}ORG/NAME@REVISION")
    folder = _fetched(open_hub(), address, repository, revision or None, report)
    for model in sorted({file.parent.parent for file in folder.glob(f"*/*/{MODEL_FILE}")}):
        check_sums(model)
    return folder


def _fetched(hub: "HfApi", address: str, repository: str, revision: str | None, report: Callable[[str], None]) -> Path:
    from huggingface_hub.errors import (
        GatedRepoError,
        HTTPError,
        LocalEntryNotFoundError,
        RepositoryNotFoundError,
        RevisionNotFoundError,
    )

    try:
        found = hub.model_info(repository, revision=revision, timeout=timeout_s())
        _refuse_others(address, [file.rfilename for file in found.siblings or ()])
        return Path(hub.snapshot_download(repository, revision=revision, allow_patterns=_FETCHED))
    except GatedRepoError as exc:
        raise UsageError(
            f"{address}: its owners ask for consent first; give it on the hub's page, then {_LOG_IN}"
        ) from exc
    except RepositoryNotFoundError as exc:
        raise UsageError(f"{address}: the hub has no such repository, or it is private: {_LOG_IN}") from exc
    except RevisionNotFoundError as exc:
        raise UsageError(f"{address}: the repository has no such revision; expected a branch, tag or commit") from exc
    except (HTTPError, ConnectionError, LocalEntryNotFoundError) as exc:
        reason = why_unreachable(exc)
    except OSError as exc:
        raise ModelError(f"{address} cannot be kept in the cache: {exc.strerror or first_line(exc)}") from exc
    try:
        folder = hub.snapshot_download(repository, revision=revision, allow_patterns=_FETCHED, local_files_only=True)
    except LocalEntryNotFoundError as exc:
        raise Unavailable(f"{address}: {reason}, and the cache has no whole copy of it; try again later") from exc
    report(f"{address}: {reason}; the copy in the cache is used")
    return Path(folder)


_LOG_IN = "log in (hf auth login) or set HF_TOKEN"


def why_unreachable(exc: Exception) -> str:
    """Why a hub gave no answer, in a few words."""
    from huggingface_hub.errors import OfflineModeIsEnabled

    if isinstance(exc, OfflineModeIsEnabled):
        return "HF_HUB_OFFLINE forbids to ask the hub"
    response = getattr(exc, "response", None)
    if response is not None:
        return f"the hub answers {response.status_code}"
    return f"the hub does not answer ({first_line(exc)})"


def first_line(exc: Exception) -> str:
    """The first line of an error's text, or its kind."""
    return next((line for line in str(exc).splitlines() if line.strip()), type(exc).__name__)


def _refuse_others(address: str, files: list[str]) -> None:
    if not models_in(files):
        some = ", ".join(files[:5]) + (", …" if len(files) > 5 else "") or "no file"
        raise ModelError(
            f"{address} holds no model of curio's: expected NAME/{CONFIG_FILE}, NAME/{SUMS_FILE} and "
            f"NAME/VERSION/{MODEL_FILE}, as curio-export --push writes them; found {some}"
        )


def check_sums(folder: Path) -> None:
    """Compare a model's folder with its SHA256SUMS. A listed file that is not there passes: not all are fetched.

    A ``model.onnx`` that is not listed is refused when it is loaded.

    Raises:
        ModelError: One differs or cannot be read.
    """
    try:
        sums = listed_sums(folder)
        for name, expected in sums.items():
            if (file := folder / name).is_file():
                with file.open("rb") as content:
                    found = hashlib.file_digest(content, "sha256").hexdigest()
                if found != expected:
                    raise ModelError(
                        f"{file} has SHA-256 {found[:12]}…, but {SUMS_FILE} says {expected[:12]}…: it was damaged on "
                        f"its way or replaced; remove {file.resolve()} and run the same command again"
                    )
    except OSError as exc:
        raise ModelError(f"{exc.filename} cannot be read: {exc.strerror}") from exc
