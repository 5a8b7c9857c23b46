"""Trackers: drives of boxes that no detector would give, at times that no clock would."""

from __future__ import annotations

from typing import Any

import numpy as np

from edgeperc import Box, Tracker
from edgeperc.errors import TrackingError

from .running import Case
from .scans import check_tracks

LIMIT_S, LIMIT_MB = 20.0, 1500.0
FAR = [0.0, 1e-300, 1e-9, 1.0, 50.0, 1e3, 1e6, 1e9, 1e15, 1e30, 1e100, 1e154, 1e155, 1e200, 1e300, 1.7e308]
BAD = [float("nan"), float("inf"), -float("inf"), 10**400, None, "1", True, 1j]
SIZES = [0.0, -1.0, 1e-300, 1e-9, 0.1, 1.0, 4.0, 40.0, 1e6, 1e30, 1e200, 1e308]
STEPS_S = [1e-300, 1e-12, 1e-6, 0.05, 0.1, 0.1, 0.1, 1.0, 60.0, 1e6, 1e12, 1e100, 1e300]
LABELS = ["car", "car", "pedestrian", "cyclist", "van", "truck", "background", "", "x" * 300, "\ud800", "a\0b"]


class Trackers:
    """The kind ``trackers``: a case is a drive of up to twelve scans."""

    name, limit_s, limit_mb = "trackers", LIMIT_S, LIMIT_MB

    def __init__(self) -> None:
        warm = Tracker()  # compiles the kernels, which no case should count
        for k in range(3):
            warm.update([Box("car", 0.9, (10.0 + k, 0.0, 0.0), (4.0, 2.0, 1.5), 0.0)], 0.1 * k)

    def run(self, case: Case) -> str:
        rng = case.rng
        tracker = Tracker(
            field_of_view_deg=case.pick([(180.0, -180.0), (45.0, -45.0), (1e-9, 0.0), (270.0, 90.0)]),
            max_tracks=int(case.pick([1024, 1024, 1, 0, 10])),
        )
        posed = bool(rng.random() < 0.3)
        wild = float(rng.choice([0.0, 0.02, 0.2, 1.0]))
        stamp_s, answers = float(case.pick([0.0, -1.0, 1e9, 1.7e9, 5e-324, -1e6, 1e11, case.pick(FAR)])), 0
        n = int(rng.choice([0, 1, 3, 10, 40])) if rng.random() < 0.998 else int(rng.choice([1000, 10_000]))
        n_scans = 3 if n > 100 else int(rng.integers(1, 12))
        starts = rng.uniform((0, -20, -2), (60, 20, 0), (n, 3))
        speeds = rng.normal(0.0, 5.0, (n, 2))
        outcome = "answer"
        for k in range(n_scans):
            boxes = [self.box(case, starts[i], speeds[i] * 0.1 * k, wild) for i in range(n)]
            if boxes and rng.random() < 0.1:
                boxes += boxes[: int(rng.integers(len(boxes))) + 1]  # twice
            try:
                tracks = tracker.update(boxes, stamp_s, self.pose(case, wild) if posed else None)
            except TrackingError as exc:
                outcome = type(exc).__name__
            else:
                answers += 1
                check_tracks(tracks)
            stamp_s += case.pick(STEPS_S) if rng.random() < wild else 0.1
            if rng.random() < 0.02:
                stamp_s = case.pick([float("nan"), float("inf"), -1e9, stamp_s])
        return "answer" if answers == n_scans else f"{outcome}, partly" if answers else outcome

    def number(self, case: Case, usual: float, values: list[float], wild: float) -> Any:
        if case.rng.random() >= 0.3 * wild:
            return usual
        if case.rng.random() < 0.1:
            return case.pick(BAD)
        return case.pick(values) * case.pick([1, 1, -1])

    def box(self, case: Case, at: Any, moved: Any, wild: float) -> Any:
        if wild and case.rng.random() < 0.002:
            return case.pick([None, "box", 5, ()])
        far = [self.number(case, float(v), FAR, wild) for v in (at[0] + moved[0], at[1] + moved[1], at[2])]
        size = [self.number(case, v, SIZES, wild) for v in (4.2, 1.8, 1.5)]
        yaw = self.number(case, float(case.rng.uniform(-3, 3)), FAR, wild)
        score = self.number(case, float(case.rng.uniform(0.3, 1.0)), [0.0, 1.0, 2.0, -1.0, 1e-300], wild)
        label: Any = case.pick(LABELS) if case.rng.random() < 0.2 else "car"
        if case.rng.random() < 0.01 * wild:
            label = case.pick([None, 5, ("car",)])
        return Box(label, score, tuple(far), tuple(size), yaw)  # type: ignore[arg-type]

    def pose(self, case: Case, wild: float) -> Any:
        pose = np.eye(4)
        angle = float(case.rng.uniform(-0.1, 0.1))
        pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        pose[:3, 3] = case.rng.uniform(-100, 100, 3)
        if case.rng.random() < 0.3 * wild:
            pose[int(case.rng.integers(4)), int(case.rng.integers(4))] = case.pick([*FAR, float("nan"), float("inf")])
        if case.rng.random() < 0.02 * wild:
            return case.pick([None, [1, 2], "pose", np.eye(3), np.zeros((4, 4)), np.full((4, 4), "x")])
        return pose


def make(seed: int) -> Trackers:
    return Trackers()
