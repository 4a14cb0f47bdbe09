"""What this machine can do: its processor and GPU, whether a picture comes out, and how long training takes."""

import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator

import torch

from curio_train.config import preset_recipe
from curio_train.doctor.finding import Finding
from curio_train.rendering.variant import optix_available
from curio_train.worlds import WORLDS

_TRIAL_LIMIT_S = 180
_TIMED = {"linemod": "capture and linemod --two-stage", "circles": "circles, the quickest of the generated worlds"}
"""Worlds whose training is timed, and what the result stands for."""


def tried() -> Iterator[Finding]:
    """Trials of the renderer and, if a picture comes out, of training."""
    rendering = _rendering()
    yield rendering
    if rendering.state == "good":
        for world, names in _TIMED.items():
            yield _training_time(world, names)


def platform_found() -> Finding:
    """System, Python, cores and torch."""
    found = f"{platform.system()} {platform.machine()}, Python {platform.python_version()}"
    cores = f"{len(os.sched_getaffinity(0))} cores for this process, torch {torch.__version__}"
    supported = (platform.system(), platform.machine()) == ("Linux", "x86_64")
    if supported:
        return Finding("platform", "good", f"{found}, {cores}")
    remedy = "Supported is Linux on x86-64; elsewhere nothing was tried"
    return Finding("platform", "warning", f"{found}, {cores}", remedy, fault="platform")


def cuda_found() -> Finding:
    """Whether a GPU is here that torch and the renderer can use."""
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


def _trial(call: str) -> tuple[float | None, str]:
    """A number that a call of :mod:`~curio_train.doctor.trials` gives, or None and what it said instead.

    In a process of its own: a libLLVM that Dr.Jit cannot use takes the process with it.
    """
    code = f"from curio_train.doctor import trials; print(trials.{call})"
    try:
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=_TRIAL_LIMIT_S
        )
    except subprocess.TimeoutExpired:
        return None, f"took longer than {_TRIAL_LIMIT_S} s"
    if done.returncode:
        text = (done.stderr.strip().splitlines() or ["without a word"])[-1]
        return None, f"failed with status {done.returncode}: {text}"
    return float(done.stdout), ""


def _rendering() -> Finding:
    fraction, problem = _trial("render_a_box()")
    if fraction is None:
        remedy = "Try another libLLVM (DRJIT_LIBLLVM_PATH), version 17 or newer"
        return Finding("rendering", "bad", f"a test picture {problem}", remedy, fault="rendering")
    return Finding("rendering", "good", f"a box covers {fraction:.0%} of a test picture, as it should")


def _training_time(world: str, names: str) -> Finding:
    subject = f"training time of {names}"
    speed, problem = _trial(f"images_per_second({world!r})")
    if speed is None:
        return Finding(subject, "bad", f"a trial of training {problem}", fault="training")
    kind = WORLDS[world]
    images = preset_recipe("laptop", kind).budget_images
    found = f"about {speed:.0f} images a second with --method {kind.default_method} on the CPU"
    usual = f"{images:,} images, unless --minutes or --images say otherwise, take {images / speed / 60:.0f} minutes"
    return Finding(subject, "good", f"{found}: {usual}")
