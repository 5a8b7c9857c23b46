"""How much of the road on all sides is found: by the top view, by points with a class of their own for it, by both.

Run as ``python -m edgeperc_bench.surroundings [SET ...]`` with labeled sets such as ``PANDASET:pandaset``; without one,
simulated streets are measured. Cells of 0.2 m within 40 m that a ray observed and whose true class is known are
counted. Prints a table of Markdown.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

import numpy as np

from edgeperc import Perceiver, occupancy_grid
from edgeperc.cli.program import run_program
from edgeperc.datasets.scan_folder import ScanFolder
from edgeperc.datasets.splits import names_of
from edgeperc.evaluation.metrics import Confusion
from edgeperc.evaluation.truth import road_cells
from edgeperc.road.grid import ALL_AROUND
from edgeperc.simulation.samples import FIRST_SEED, IGNORE, simulated_scan
from edgeperc.types.choices import DEFAULT_SENSOR
from edgeperc.types.points import Bytes, Points
from edgeperc.types.sensor import SensorProfile, get_sensor
from edgeperc.types.views import TopViewGeometry

from .render import number

VIEW = TopViewGeometry(ALL_AROUND.x_range_m, ALL_AROUND.y_range_m, cell_m=0.2)
EXTENT: dict[str, Any] = {"x_range_m": VIEW.x_range_m, "y_range_m": VIEW.y_range_m, "cell_m": VIEW.cell_m}
MODELS = {
    "top view": ("ssadnet", "objects"),
    "points": ("sceneseg", "objects"),
    "both": ("ssadnet", "sceneseg", "objects"),
}
N_STREETS = 15


def streets() -> Iterator[tuple[Points, Bytes]]:
    """Simulated scans with the true class of each cell: 1 for road."""
    for seed in range(FIRST_SEED, FIRST_SEED + N_STREETS):
        scan = simulated_scan(seed)
        yield scan.points, scan.top_view_labels(VIEW)


def labeled(folder: ScanFolder) -> Iterator[tuple[Points, Bytes]]:
    """Scans of the test drives of a set."""
    perceive = Perceiver("sceneseg", sensor=folder.layout.sensor, on_mismatch="ignore")
    for name in names_of(folder, "test"):
        frame = folder.frame(name)
        cells = road_cells(frame, perceive(frame.points).mounting, VIEW)
        if cells is not None:
            yield frame.points, cells


def print_set(name: str, sensor: SensorProfile, scans: list[tuple[Points, Bytes]]) -> None:
    """Rows of a set: share of what is found that is road, of the road that is found, and their IoU."""
    x, y = np.broadcast_arrays(*VIEW.cell_centers())
    ahead = (x > 6.0) & (np.abs(y) < 10.0)
    places = {"ahead": ahead, "elsewhere": ~ahead}
    for models, chosen in MODELS.items():
        perceive = Perceiver(chosen, sensor=sensor, full_turn=True, on_mismatch="ignore")
        confusions = {place: Confusion(("other", "road")) for place in places}
        for points, cells in scans:
            grid = occupancy_grid(perceive(points), points, sensor=sensor, **EXTENT)
            for place, where in places.items():
                counted = where & grid.observed & (cells != IGNORE)
                confusions[place].update(grid.drivable[counted], cells[counted] == 1)
        for place, of in confusions.items():
            shares = (number(100.0 * each[1], 1) for each in (of.precision(), of.recall(), of.iou()))
            print(f"| {name} | {models} | {place} | " + " | ".join(shares) + " |")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", 1)[0])
    parser.add_argument("sets", nargs="*", metavar="SET")
    sets = [*map(ScanFolder.parse, parser.parse_args().sets)]
    print("| set | road by | where | precision | recall | IoU |\n|---|---|---|---|---|---|")
    if not sets:
        print_set(f"{N_STREETS} simulated streets", get_sensor(DEFAULT_SENSOR), [*streets()])
    for folder in sets:
        scans = [*labeled(folder)]
        print_set(f"{folder.layout.name}, {len(scans)} scans", folder.layout.sensor, scans)


if __name__ == "__main__":
    raise SystemExit(run_program("edgeperc_bench.surroundings", main))
