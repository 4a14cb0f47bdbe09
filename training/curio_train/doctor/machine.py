"""This machine: memory, disk and libLLVM at once; with ``abilities``, whether it renders and how fast it trains."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from curio_train.doctor.finding import Finding
from curio_train.errors import CurioError
from curio_train.rendering.llvm import check_llvm

_ENOUGH_MEMORY_GIB = 3.0  # a run of the paper's networks takes about 1.5
_ENOUGH_DISK_GIB = 2.0  # image sets, a run's checkpoints, exported models


def examine_machine(cache: Path) -> Iterator[Finding]:
    """All of the machine; trials of the renderer and of training take some ten seconds."""
    from curio_train.doctor import abilities

    yield abilities.platform_found()
    resources = list(examine_resources(cache))
    yield from resources
    yield abilities.cuda_found()
    if resources[-1].state == "good":
        yield from abilities.tried()


def examine_resources(cache: Path) -> Iterator[Finding]:
    """Memory, disk and, last, libLLVM: what can be told at once."""
    yield _memory()
    for folder in dict.fromkeys((Path.cwd(), _existing(cache.expanduser()))):
        yield _disk(folder)
    yield _llvm()


def _memory() -> Finding:
    fields = dict(line.split(":") for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines())
    total, available = (int(fields[name].split()[0]) / 2**20 for name in ("MemTotal", "MemAvailable"))
    text = f"{available:.1f} of {total:.1f} GiB are free"
    if available < _ENOUGH_MEMORY_GIB:
        text = f"{text}, training wants {_ENOUGH_MEMORY_GIB:g}"
        return Finding("memory", "warning", text, "Lower --micro-batch-size", fault="memory")
    return Finding("memory", "good", text)


def _disk(folder: Path) -> Finding:
    free = shutil.disk_usage(folder).free / 2**30
    subject, text = f"disk at {folder}", f"{free:.1f} GiB are free"
    if not os.access(folder, os.W_OK):
        return Finding(subject, "bad", "cannot be written", "Choose other folders: --out and --cache", fault="disk")
    if free < _ENOUGH_DISK_GIB:
        text = f"{text}, a run wants {_ENOUGH_DISK_GIB:g}"
        return Finding(subject, "warning", text, "Make room, or choose other folders: --out and --cache", fault="disk")
    return Finding(subject, "good", text)


def _existing(path: Path) -> Path:
    """The folder, or the closest above it that is there and can be reached."""
    return next(folder for folder in (path, *path.absolute().parents) if os.path.isdir(folder))


def _llvm() -> Finding:
    try:
        return Finding("libLLVM", "good", check_llvm())
    except CurioError as exc:
        return Finding("libLLVM", "bad", str(exc), fault="libLLVM")
