"""Slow twin of the input of a detector on pillars."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from edgeperc.types.detector import PillarGeometry


def pillars(
    points: np.ndarray, view: PillarGeometry, channels: Sequence[str], mean: np.ndarray, std: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Twin of `edgeperc.inference.pillars.Pillarizer.fill`: values, counts and places of the pillars, and the number of
    points without room.
    """
    bounds = np.array([view.x_range_m, view.y_range_m, view.z_range_m])
    size = np.float32([view.cell_m, view.cell_m, bounds[2, 1] - bounds[2, 0]])
    with np.errstate(invalid="ignore"):
        at = (points[:, :3] - bounds[:, 0].astype(np.float32)) / size  # float32
        inside = (
            np.isfinite(points).all(axis=1) & (at >= 0).all(axis=1) & (at < (view.width, view.height, 1)).all(axis=1)
        )
    cells: dict[tuple[int, int], list[np.ndarray]] = {}
    for point, (column, row, _) in zip(points[inside].astype(np.float64), at[inside].astype(int).tolist(), strict=True):
        cells.setdefault((row, column), []).append(point)
    kept = list(cells.items())[: view.max_pillars]
    n_left_out = sum(len(members) for members in [*cells.values()][view.max_pillars :])
    values = np.zeros((len(kept), view.max_points, len(channels)))
    for k, ((row, column), members) in enumerate(kept):
        some = np.array(members[: view.max_points])
        center = [bounds[0, 0] + (column + 0.5) * view.cell_m, bounds[1, 0] + (row + 0.5) * view.cell_m]
        center.append(bounds[2].mean())
        known = dict(zip(("x", "y", "z", "remission"), some.T, strict=True))
        known["time"] = np.zeros(len(some))
        known["range"] = np.sqrt((some[:, :3] ** 2).sum(axis=1))
        for axis, name in enumerate("xyz"):
            known[f"from_mean_{name}"] = some[:, axis] - some[:, axis].mean()
            known[f"from_center_{name}"] = some[:, axis] - center[axis]
        raw = np.stack([known[name] for name in channels], axis=1)
        values[k, : len(some)] = (raw - mean) / std
    counts = np.array([min(len(members), view.max_points) for _, members in kept], np.int32)
    places = np.array([(0, 0, row, column) for (row, column), _ in kept], np.int32).reshape(-1, 4)
    return values, counts, places, n_left_out
