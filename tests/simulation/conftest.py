"""Here, a scene and a scan of a seed are made again for each call."""

from __future__ import annotations

import pytest

from edgeperc.simulation import random_scene, samples, simulate


@pytest.fixture(autouse=True)
def drawn_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(samples, "random_scene", random_scene)
    monkeypatch.setattr(samples, "simulate", simulate)
