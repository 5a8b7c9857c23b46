"""Where to train in bfloat16."""

from __future__ import annotations

import torch

from edgeperc.system.machine import cpu_features
from edgeperc.zoo import BF16_FEATURES

INSTRUCTIONS = BF16_FEATURES | {"bf16"}  # of x86, and of ARM
"""Any of these flags means that a processor multiplies bfloat16. Without them (AVX2, two threads), a training step of
pointseg, ssadnet, sceneseg and objects took 9.9, 9.2, 9.8 and 10.4 times as long in bfloat16 as in float32."""


def in_bfloat16(device: str) -> torch.autocast:
    """Compute in bfloat16 on a GPU and on processors that multiply it; in float32 on others."""
    has_it = device != "cpu" or not INSTRUCTIONS.isdisjoint(cpu_features())
    return torch.autocast(device, torch.bfloat16, enabled=has_it)
