"""This machine: processor, memory, disk, CUDA, libLLVM, whether a picture comes out, and how long training takes."""

import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import torch

from curio_train.config import preset_recipe
from curio_train.doctor.finding import Finding
from curio_train.errors import CurioError
from curio_train.rendering.variant import check_llvm, optix_available
from curio_train.worlds import WORLDS

_ENOUGH_MEMORY_GIB = 3.0  # a run of the paper's networks takes about 1.5
_ENOUGH_DISK_GIB = 2.0  # image sets, a run's checkpoints, exported models
_TRIAL_LIMIT_S = 180


def examine_machine(cache: Path) -> Iterator[Finding]:
    """Processor, memory, disk, CUDA, libLLVM, and whether a picture comes out."""
    yield _platform()
    yield _memory()
    for folder in dict.fromkeys((Path.cwd(), _existing(cache.expanduser()))):
        yield _disk(folder)
    yield _cuda()
    llvm = _llvm()
    yield llvm
    if llvm.state == "good":
        rendering = _rendering()
        yield rendering
        if rendering.state == "good":
            yield _training_time()


def _platform() -> Finding:
    found = f"{platform.system()} {platform.machine()}, Python {platform.python_version()}"
    cores = f"{len(os.sched_getaffinity(0))} cores for this process, torch {torch.__version__}"
    supported = (platform.system(), platform.machine()) == ("Linux", "x86_64")
    if supported:
        return Finding("platform", "good", f"{found}, {cores}")
    remedy = "Supported is Linux on x86-64; elsewhere nothing was tried"
    return Finding("platform", "warning", f"{found}, {cores}", remedy, fault="platform")


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
    """The folder, or the closest above it that is there."""
    return next(folder for folder in (path, *path.absolute().parents) if folder.is_dir())


def _cuda() -> Finding:
    driver = shutil.which("nvidia-smi") is not None
    if torch.cuda.is_available():
        names = ", ".join(torch.cuda.get_device_name(number) for number in range(torch.cuda.device_count()))
        if optix_available():
            return Finding("CUDA", "good", f"{names}; networks and renderer can run there")
        text = f"{names}; the driver brings no OptiX (libnvoptix.so.1): the CPU will render"
        return Finding("CUDA", "warning", text, "Install the whole driver to render on the GPU", fault="OptiX")
    if driver:
        text = f"a driver is here, but torch {torch.__version__} cannot use it"
        return Finding("CUDA", "warning", text, "Install a CUDA build of torch", fault="CUDA")
    return Finding("CUDA", "good", "no GPU: everything runs on the CPU, as the laptop preset expects")


def _llvm() -> Finding:
    try:
        return Finding("libLLVM", "good", check_llvm())
    except CurioError as exc:
        return Finding("libLLVM", "bad", str(exc), fault="libLLVM")


def _trial(expression: str) -> tuple[float | None, str]:
    """A number that a function of :mod:`~curio_train.doctor.trials` gives, or None and what it said instead.

    In a process of its own: a libLLVM that Dr.Jit cannot use takes the process with it.
    """
    code = f"from curio_train.doctor import trials; print(trials.{expression}())"
    try:
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=_TRIAL_LIMIT_S
        )
    except subprocess.TimeoutExpired:
        return None, f"took longer than {_TRIAL_LIMIT_S} s"
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["without a word"])[-1]
        return None, f"failed with status {done.returncode}: {said}"
    return float(done.stdout), ""


def _rendering() -> Finding:
    fraction, problem = _trial("render_a_box")
    if fraction is None:
        remedy = "Try another libLLVM (DRJIT_LIBLLVM_PATH), version 17 or newer"
        return Finding("rendering", "bad", f"a test picture {problem}", remedy, fault="rendering")
    return Finding("rendering", "good", f"a box covers {fraction:.0%} of a test picture, as it should")


def _training_time() -> Finding:
    speed, problem = _trial("images_per_second")
    if speed is None:
        return Finding("training time", "bad", f"a trial of training {problem}", fault="training")
    text = f"about {speed:.0f} images a second of one object of 20,000 faces on the CPU, drawn again to be compared; "
    return Finding("training time", "good", f"{text}unless --minutes or --images say less: {_durations(speed)}")


def _durations(speed: float) -> str:
    """Durations of the laptop preset's budgets, with the worlds that have them."""
    worlds: dict[int, list[str]] = {}
    for name, kind in WORLDS.items():
        worlds.setdefault(preset_recipe("laptop", kind).budget_images, []).append(name)
    return "; ".join(
        f"{', '.join(names)}: {images:,} images in {images / speed / 60:.0f} minutes"
        for images, names in sorted(worlds.items())
    )
