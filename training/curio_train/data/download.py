"""LineMOD from BOP's repository on the Hugging Face hub, https://huggingface.co/datasets/bop-benchmark/lm.

::

    CACHE/bop/lm/camera.json  models/  test/  …        the data set, as bop.py reads it
    CACHE/bop/lm/.download/NAME.zip.SHA256.part        an archive that is on its way, continued by the next call
                           NAME.zip.done               it was checked and unpacked; it is not kept

huggingface_hub throws away what it had of a file when it is interrupted, so the parts are kept here. The hub states the
SHA-256 of each archive; HF_ENDPOINT names another hub, HF_TOKEN a token, as everywhere.
"""

import hashlib
import os
import shutil
import stat
import sys
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from huggingface_hub import get_hf_file_metadata, hf_hub_url
from huggingface_hub.constants import ENDPOINT
from huggingface_hub.errors import GatedRepoError, HTTPError
from huggingface_hub.file_download import HfFileMetadata, http_get
from huggingface_hub.utils import WeakFileLock, build_hf_headers, disable_progress_bars

from curio_train.errors import DataError

REPOSITORY = "bop-benchmark/lm"
TRAINING_ARCHIVES = ("lm_base.zip", "lm_models.zip")
"""Cameras and targets, and meshes: all that training reads. Some repositories pack everything into a folder ``lm``."""

SCORING_ARCHIVES = (*TRAINING_ARCHIVES, "lm_test_all.zip")
"""These, and all real frames, which are for scoring alone."""

_STATE = ".download"
_AGAIN = "what has arrived is kept: give the same command again"
_OFFLINE = "or download it elsewhere and name its folder: --data DIR"


def linemod_folder(cache: Path) -> Path:
    """The folder that a download is kept in."""
    return cache.expanduser() / "bop" / "lm"


def missing_archives(cache: Path, archives: Sequence[str] = TRAINING_ARCHIVES) -> list[str]:
    """Archives that were not downloaded yet."""
    state = linemod_folder(cache) / _STATE
    return [name for name in archives if not (state / f"{name}.done").exists()]


def download_bytes(archives: Sequence[str]) -> int:
    """Size of archives as the hub states it.

    Raises:
        DataError: The hub cannot be reached, or states none.
    """
    hub = os.environ.get("HF_ENDPOINT") or ENDPOINT
    with _as_data_errors(f"cannot ask {hub} for the size of {REPOSITORY}", "try again with a network"):
        return sum(_stated_size(name, _metadata(name)) for name in archives)


def download_linemod(cache: Path, archives: Sequence[str] = TRAINING_ARCHIVES) -> Path:
    """The folder of LineMOD, downloaded as far as it is not there yet.

    Args:
        cache: Folder for it.
        archives: What of it is needed.

    Raises:
        DataError: The hub cannot be reached, refuses, or sends something else; or there is no place to keep it.
    """
    folder = linemod_folder(cache)
    state = folder / _STATE
    with _as_data_errors(f"cannot download {REPOSITORY} to {folder}"):
        state.mkdir(parents=True, exist_ok=True)
        if not sys.stderr.isatty():
            disable_progress_bars()
        with WeakFileLock(state / "lock"):  # runs of several classes may be started at once
            for name in missing_archives(cache, archives):
                _fetch(name, folder, state)
    return folder


@contextmanager
def _as_data_errors(failure: str, again: str = _AGAIN) -> Iterator[None]:
    """Turns every failure of a download into a DataError that says what to do."""
    try:
        yield
    except GatedRepoError as exc:
        raise DataError(
            f"{failure}: its owners ask for consent first; give it on the hub's page and log in: hf auth login"
        ) from exc
    except HTTPError as exc:  # of connections, too
        status = getattr(getattr(exc, "response", None), "status_code", None)
        if status in (401, 403, 404):
            raise DataError(f"{failure}: the hub answers {status}; does HF_ENDPOINT name a hub? {_OFFLINE}") from exc
        raise DataError(f"{failure}: {_first_line(exc)}; {again}, {_OFFLINE}") from exc
    # RuntimeError: it is encrypted, or packed by a method that zipfile does not know.
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as exc:
        raise DataError(f"{failure}: the archive is damaged as published ({exc}); {_OFFLINE}") from exc
    except OSError as exc:
        reason = exc.strerror or _first_line(exc)
        raise DataError(f"{failure}: {reason}; {again}, name another --cache, {_OFFLINE}") from exc


def _first_line(exc: Exception) -> str:
    return (str(exc) or type(exc).__name__).splitlines()[0]


def _fetch(name: str, folder: Path, state: Path) -> None:
    """Download, check and unpack one archive."""
    found = _metadata(name)
    size, endpoint = _stated_size(name, found), os.environ.get("HF_ENDPOINT")
    url = hf_hub_url(REPOSITORY, name, repo_type="dataset", revision=found.commit_hash, endpoint=endpoint)
    part = _receive(name, url, found, size, state)
    with part.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if digest != found.etag:
        part.unlink()
        raise DataError(
            f"{REPOSITORY}/{name}: its SHA-256 is {digest}, the hub says {found.etag}; it was damaged on the way and "
            "thrown away: give the same command again"
        )
    _unpack(part, name, folder)
    (state / f"{name}.done").write_text(f"{digest}  {name}\n", encoding="utf-8")
    part.unlink()


def _metadata(name: str) -> HfFileMetadata:
    endpoint = os.environ.get("HF_ENDPOINT")
    return get_hf_file_metadata(hf_hub_url(REPOSITORY, name, repo_type="dataset", endpoint=endpoint))


def _stated_size(name: str, found: HfFileMetadata) -> int:
    if found.size is None or found.etag is None or len(found.etag) != 64:
        raise DataError(
            f"{REPOSITORY}/{name}: the hub states size {found.size} and checksum {found.etag}, expected a SHA-256; is "
            f"HF_ENDPOINT a hub? {_OFFLINE}"
        )
    return found.size


def _receive(name: str, url: str, found: HfFileMetadata, size: int, state: Path) -> Path:
    """The whole archive, going on from what an earlier call has left."""
    part = state / f"{name}.{found.etag}.part"
    if part.exists() and part.stat().st_size > size:
        part.unlink()
    with part.open("ab") as file:
        _refuse_without_space(name, size - file.tell(), state)
        http_get(
            url,
            file,
            resume_size=file.tell(),
            headers=build_hf_headers(),
            expected_size=size,
            displayed_filename=name,
        )
    return part


def _unpack(archive: Path, name: str, folder: Path) -> None:
    """All files of an archive, each written inside the folder or not at all."""
    with zipfile.ZipFile(archive) as content:
        members = [member for member in content.infolist() if not member.is_dir()]
        targets = [folder / _inside(member, name) for member in members]
        _refuse_without_space(name, sum(member.file_size for member in members), folder)
        for member, target in zip(members, targets, strict=True):
            target.parent.mkdir(parents=True, exist_ok=True)
            with content.open(member) as source, target.open("wb") as file:
                shutil.copyfileobj(source, file)


def _inside(member: zipfile.ZipInfo, archive: str) -> PurePosixPath:
    """The path of an archive's member in the data folder.

    Raises:
        DataError: Somewhere else, or it is a link.
    """
    path = PurePosixPath(member.filename.replace("\\", "/"))
    if (
        not path.parts
        or path.is_absolute()
        or ".." in path.parts
        or ":" in path.parts[0]
        or stat.S_ISLNK(member.external_attr >> 16)
    ):
        raise DataError(
            f"{REPOSITORY}/{archive}: holds {member.filename!r}, which would be written outside its folder or is a "
            "link; nothing of it was unpacked. Is HF_ENDPOINT a hub that you trust?"
        )
    return PurePosixPath(*path.parts[1:]) if path.parts[0] == "lm" else path


def _refuse_without_space(name: str, num_bytes: int, folder: Path) -> None:
    free = shutil.disk_usage(folder).free
    if num_bytes > free:
        raise DataError(
            f"{REPOSITORY}/{name}: needs {num_bytes / 1e9:.2f} GB, {folder} has {free / 1e9:.2f} GB left; make room, "
            "or name another folder: --cache"
        )
