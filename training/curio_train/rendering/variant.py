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
from types import ModuleType
from typing import Literal

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
        ctypes.CDLL("libcuda.so.1")
        ctypes.CDLL("libnvoptix.so.1")
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
    """CUDA where asked for and possible, else LLVM."""
    if prefer_cuda and optix_available():
        return "cuda_ad_rgb"
    if prefer_cuda:
        _say_fallback_once()
    return "llvm_ad_rgb"


def load_mitsuba(variant: Variant = "llvm_ad_rgb") -> ModuleType:
    """Import Mitsuba with that variant active in the calling thread.

    Raises:
        RendererError: libLLVM is missing or too old, or another variant is already in use.
    """
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
