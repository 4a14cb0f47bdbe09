"""Which numbers to multiply: bfloat16 only where the machine is quick with them.

A processor without such instructions emulates them: with AVX2 alone products of matrices take 25 to 60 times as long as
in float32, and the paper's network learns a fifteenth as fast (decision 67).
"""

import torch


def quick_bfloat16(device_type: str) -> bool:
    """Whether products in bfloat16 are quicker than in float32 on a device of a type ("cpu", "cuda")."""
    if device_type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    # What torch itself asks before it hands such a product to oneDNN; where the answer is no, its own loops do it.
    return torch.backends.mkldnn.is_available() and bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())


def autocast(precision: str, device_type: str) -> torch.autocast:
    """A context in which a recipe's convolutions have its precision; float32 where bfloat16 would be slower."""
    half = precision == "bfloat16" and quick_bfloat16(device_type)
    return torch.autocast(device_type, torch.bfloat16, enabled=half)
