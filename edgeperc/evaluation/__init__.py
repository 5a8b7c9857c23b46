"""Accuracy of models and of the tracker, as the papers measure it. Nothing here runs in a vehicle.

`evaluate` runs models over labeled datasets: `datasets` reads scans and labels, `splits` says which drives are for
training and testing, `truth` prepares the truth of a scan, `judge` compares one scan's perception with it, and `tables`
computes the figures of all scans, with intervals. `metrics` counts labels and matches boxes. `unseen` refuses scans
that a model was trained on, and `mistakes` keeps the scans to draw. `transfer` evaluates a model on other sensors.
`tracking` evaluates the tracker on KITTI's sequences, by `tracking_metrics`.
"""

from __future__ import annotations

__all__: list[str] = []
