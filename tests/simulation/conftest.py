"""Here, a scene and a scan of a seed are made again for each call."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def drawn_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    # Kernels that are imported with this file would be compiled before `--every-kernel` can count their calls.
    from edgeperc.simulation import random_scene, samples, simulate

    monkeypatch.setattr(samples, "random_scene", random_scene)
    monkeypatch.setattr(samples, "simulate", simulate)
