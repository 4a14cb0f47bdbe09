"""Choose Mitsuba's variant at run time."""

import ctypes
import functools
import logging
import os
import sys
from types import ModuleType
from typing import Literal, get_args

import torch

from curio_train.errors import RendererError
from curio_train.rendering.llvm import check_llvm

Variant = Literal["llvm_ad_rgb", "cuda_ad_rgb"]
CUDA_LIBRARIES = ("libcuda.so.1", "libnvoptix.so.1")
"""What the driver must bring for ``cuda_ad_rgb``: CUDA and OptiX."""

FORCED = "CURIO_VARIANT"
"""Environment variable that names the variant, whatever the machine has."""

_log = logging.getLogger(__name__)


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
