"""How good a model is: the papers' figures on labelled scans, on other sensors and over tracking sequences.

`evaluate` compares models with the labels of whole datasets, `transfer` does so on other sensors, and `tracking` judges
a tracker. Nothing here runs in a vehicle.
"""

from __future__ import annotations

__all__: list[str] = []
