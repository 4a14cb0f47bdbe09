"""Choose Mitsuba's variant at run time, and find out what would abort the process before it can.

Dr.Jit 1.5 aborts the whole process when it meets LLVM 15 or older ("Cannot select: fminimum"), so the library it is
going to load is looked at first.
"""

import ctypes
import ctypes.util
import functools
import glob
import logging
import os
import re
import sys
from types import ModuleType
from typing import Literal, get_args

import torch

from curio_train.errors import RendererError

Variant = Literal["llvm_ad_rgb", "cuda_ad_rgb"]
OLDEST_LLVM = 17
LIBRARY_FOLDERS = (
    "/usr/lib/x86_64-linux-gnu",
    "/lib/x86_64-linux-gnu",
    "/usr/lib64",
    "/usr/lib/llvm-*/lib",
    "/usr/local/lib",
    "/usr/lib",
)
CUDA_LIBRARIES = ("libcuda.so.1", "libnvoptix.so.1")
"""What the driver must bring for ``cuda_ad_rgb``: CUDA and OptiX."""

FORCED = "CURIO_VARIANT"
"""Environment variable that names the variant, whatever the machine has."""

_log = logging.getLogger(__name__)


def llvm_version(path: str) -> int | None:
    """Major version of a libLLVM by the name of its file; None: unknown."""
    match = re.search(r"libLLVM[-.](?:so\.)?(\d+)", os.path.basename(os.path.realpath(path)))
    return int(match.group(1)) if match else None


def find_llvm() -> str | None:
    """Path of the newest libLLVM on this machine, or None."""
    found = {path for folder in LIBRARY_FOLDERS for path in glob.glob(f"{folder}/libLLVM*.so*")}
    known = [(version, path) for path in found if (version := llvm_version(path)) is not None]
    return max(known)[1] if known else None


def check_llvm() -> str:
    """Make sure that Dr.Jit will load a libLLVM it can use, and say which.

    Raises:
        RendererError: None is installed, or the one that would be loaded is too old.
    """
    chosen = os.environ.get("DRJIT_LIBLLVM_PATH")
    path = chosen or find_llvm()
    remedy = (
        "Install it (Debian, Ubuntu: `apt-get install libllvm19`) or point DRJIT_LIBLLVM_PATH to a newer libLLVM.so."
    )
    if path is None or not (os.path.exists(path) or ctypes.util.find_library(path)):
        raise RendererError(
            f"No libLLVM was found ({path or 'looked in ' + ', '.join(LIBRARY_FOLDERS)}); rendering on the CPU needs "
            f"version {OLDEST_LLVM} or newer. {remedy}"
        )
    version = llvm_version(path)
    if version is not None and version < OLDEST_LLVM:
        raise RendererError(
            f"{path} is LLVM {version}; rendering needs {OLDEST_LLVM} or newer (older ones abort the process). {remedy}"
        )
    return path


def optix_available() -> bool:
    """Whether the driver brings CUDA and OptiX, which ``cuda_ad_rgb`` needs."""
    try:
        for name in CUDA_LIBRARIES:
            ctypes.CDLL(name)
    except OSError:
        return False
    return True


@functools.cache
def _say_fallback_once() -> None:
    _log.warning(
        "CUDA is here, but the driver's OptiX library (libnvoptix.so.1) is not: images are rendered on the CPU, "
        "networks stay on the GPU."
    )


def choose_variant(prefer_cuda: bool) -> Variant:
    """The environment's choice; else CUDA where asked for and possible, else LLVM.

    Raises:
        RendererError: The environment names another variant.
    """
    forced = os.environ.get(FORCED)
    if forced:
        known: dict[str, Variant] = {name: name for name in get_args(Variant)}
        if forced not in known:
            raise RendererError(f"{FORCED} is {forced!r}, expected one of {', '.join(known)}, or unset it")
        return known[forced]
    if prefer_cuda and optix_available():
        return "cuda_ad_rgb"
    if prefer_cuda:
        _say_fallback_once()
    return "llvm_ad_rgb"


def load_mitsuba(variant: Variant | None = None) -> ModuleType:
    """Import Mitsuba with that variant active in the calling thread.

    Args:
        variant: None: the one that is in use in this process already, else CUDA where torch computes there and the
            driver brings OptiX, else LLVM.

    Raises:
        RendererError: libLLVM is missing or too old, or another variant is already in use.
    """
    loaded = sys.modules.get("mitsuba")
    variant = variant or (loaded and loaded.variant()) or choose_variant(torch.cuda.is_available())
    if variant == "llvm_ad_rgb":
        os.environ["DRJIT_LIBLLVM_PATH"] = check_llvm()
    import mitsuba

    if mitsuba.variant() not in (None, variant):
        raise RendererError(
            f"Mitsuba already runs as {mitsuba.variant()} in this process and cannot also run as {variant}: render "
            "with one variant a process."
        )
    mitsuba.set_variant(variant)
    return mitsuba
