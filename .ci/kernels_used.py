"""What users do with the package, so that `.ci/kernels` knows which kernels are called and for which types."""

from __future__ import annotations

import itertools

import numpy as np

import edgeperc
from edgeperc.camera.calibration import Calibration
from edgeperc.simulation.samples import simulated_scan


def run() -> None:
    """Perceive, track and draw simulated scans in every usual set-up."""
    scans = {name: [simulated_scan(seed, name).points for seed in (1, 2)] for name in ("hdl-64e",)}
    set_ups = [
        {},
        {"full_turn": True},
    ]
    for name, set_up in itertools.product(scans, set_ups):
        print(name, set_up, flush=True)
        perceive, tracker = edgeperc.Perceiver(sensor=name, on_mismatch="ignore", **set_up), edgeperc.Tracker()
        empty = np.zeros((0, 4), np.float32)
        for k, points in enumerate((*scans[name], *scans[name], empty)):
            given = points * np.float32([1, 1, 1, 255]) if name == "vlp-16" else points
            perception = perceive(given)
            tracker.update(perception.boxes, 0.1 * k)
            edgeperc.occupancy_grid(perception, given, sensor=name)
            if perception.top_view is not None:
                edgeperc.road_ahead(perception.top_view, perception.boxes)
