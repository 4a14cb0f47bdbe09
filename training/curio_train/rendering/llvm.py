"""Finds the libLLVM that Dr.Jit will load, and refuses one that would abort the process.

Dr.Jit 1.5 aborts the whole process when it meets LLVM 15 or older ("Cannot select: fminimum"), so the library it is
going to load is looked at first. Nothing heavy is imported here: ``curio-doctor`` asks in each call.
"""

import ctypes.util
import glob
import os
import re

from curio_train.errors import RendererError

OLDEST_LLVM = 17
LIBRARY_FOLDERS = (
    "/usr/lib/x86_64-linux-gnu",
    "/lib/x86_64-linux-gnu",
    "/usr/lib64",
    "/usr/lib/llvm-*/lib",
    "/usr/local/lib",
    "/usr/lib",
)


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
