"""Which numbers to multiply: bfloat16 only where the machine is quick with them.

With AVX2 alone, making matrices orthogonal took 12 to 64 times as long as in float32, and circles were learned from an
eighteenth of the images a second (decision 67).
"""

import torch


def quick_bfloat16(device_type: str) -> bool:
    """Whether a device of a type ("cpu", "cuda") has what it takes for products in bfloat16."""
    if device_type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    # What torch itself asks before it hands such a product to oneDNN; where the answer is no, its own loops do it.
    return torch.backends.mkldnn.is_available() and bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())


def autocast(precision: str, device_type: str) -> torch.autocast:
    """A context in which a recipe's convolutions have its precision; float32 where bfloat16 would be slower."""
    half = precision == "bfloat16" and quick_bfloat16(device_type)
    return torch.autocast(device_type, torch.bfloat16, enabled=half)
