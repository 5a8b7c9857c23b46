"""KUL-Seg: SqueezeSegV2 with a Fire 7_b between Fire 7 and Fire 8 (Kim et al., 2024, section 4).

This is the variant "single 7b (same)" of its Table 3: one more fire layer, with as many filters as Fire 7.
"""

from __future__ import annotations

from .pointseg import Fire, initialize
from .squeezesegv2 import SqueezeSegV2


class KULSeg(SqueezeSegV2):
    """Labels every pixel of a range image; parameters, input and output are those of `SqueezeSegV2`."""

    def __init__(self, *, n_channels: int = 5, n_classes: int = 4, dropout: float = 0.25) -> None:
        super().__init__(n_channels=n_channels, n_classes=n_classes, dropout=dropout)
        self.fire7b = Fire(384, 384, 48)
        initialize(self.fire7b)
