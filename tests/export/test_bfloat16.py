"""Training computes in bfloat16 only where the processor multiplies it."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch")

from edgeperc_export.training import bfloat16


@pytest.mark.parametrize(
    ("flags", "has_it"),
    [
        ("avx2 fma", False),
        ("avx512f avx512_vnni", False),
        ("", False),  # a system that does not list them
        ("avx512_bf16", True),
        ("amx_tile amx_bf16", True),
        ("asimd bf16", True),
    ],
)
def test_processors_without_bfloat16_compute_in_float32(
    flags: str, has_it: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bfloat16, "cpu_features", lambda: frozenset(flags.split()))
    with bfloat16.in_bfloat16("cpu"):
        product = torch.ones(2, 3) @ torch.ones(3, 2)
    assert product.dtype == (torch.bfloat16 if has_it else torch.float32)
