"""Tables of the accuracy of boxes: KITTI's average precision, and that by the distance of centers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..output import FEW, table_lines

CAPPED = " (R40 capped)"
"""Next to rows with fewer objects than recall positions: KITTI's tool then leaves positions empty."""


def interval_columns(*rates: tuple[str, str]) -> tuple[tuple[str, str], ...]:
    """Headings and keys of columns, each with that of its interval."""
    return tuple(column for title, key in rates for column in ((title, key), ("95 %", f"{key}_interval")))


_COUNTS = (("true", "n_truth"), ("objects", "n_objects"), ("drives", "n_drives"))
_KITTI_COLUMNS = (*interval_columns(("R40", "ap_r40"), ("R11", "ap_r11"), ("whole curve", "ap")), *_COUNTS)
_CENTER_COLUMNS = (
    *interval_columns(("AP", "ap")),
    *((f"{distance} m", f"ap_{distance}") for distance in ("0.5", "1", "2", "4")),
    *interval_columns(("ATE, m", "ate"), ("ASE", "ase"), ("AOE, rad", "aoe")),
    *_COUNTS,
)


def box_table_lines(figures: Mapping[str, Any]) -> list[str]:
    """Lines of the tables, for figures of `edgeperc.evaluation.tables.figures` that have them."""
    rows = []
    for label, overlaps in figures.get("kitti", {}).items():
        for overlap, levels in overlaps.items():
            for level, row in levels.items():
                if row["n_truth"]:
                    marks = FEW * row.get("few", False) + CAPPED * (row["n_truth"] <= 40)
                    rows.append(((label, f"{overlap} {level}{marks}"), row))
    lines = table_lines("boxes as KITTI's benchmark measures them: AP at the IoU that is named", _KITTI_COLUMNS, rows)
    if "kitti" in figures and not rows:
        lines = ["", "no car, pedestrian or cyclist is to find: with enough points, and within KITTI's image limits"]
    centers = figures.get("centers", {})
    rows = [
        ((f"{label}{FEW * row.get('few', False)}", ""), {**row, **_plain_errors(row)})
        for label, row in centers.items()
        if isinstance(row, Mapping) and row["n_truth"]
    ]
    if rows:
        rows.append((("mean", ""), {"ap": centers["mean_ap"], "ap_interval": centers.get("mean_ap_interval")}))
    title = "boxes as nuScenes measures them: AP by the distance of centers; errors of matches within 2 m"
    return [*lines, *table_lines(title, _CENTER_COLUMNS, rows)]


def _plain_errors(row: Mapping[str, Any]) -> dict[str, str | None]:
    """Errors in their units, not in per cent."""
    shown: dict[str, str | None] = {}
    for name in ("ate", "ase", "aoe"):
        bounds = row.get(f"{name}_interval")
        shown[name] = None if row[name] is None else f"{row[name]:.2f}"
        shown[f"{name}_interval"] = bounds and "-".join(f"{bound:.2f}" for bound in bounds)
    return shown
