"""How long it takes to turn a scan into the networks' inputs.

Run as ``python -m edgeperc_bench.peers.projection [SCAN]``.

Every round handles the same scan once with each of these, in an
order drawn anew, so that caches, and whatever else keeps the computer busy, treat them all alike:

- a compiled loop that copies the points, (n, 4) into (n, 4), for scale
- `TopViewProjector.fill`, and `RangeImageProjector.fill` for the front quarter (64 x 512) and the full turn
  (64 x 2048), their arguments checked, into buffers that exist already: what `Perceiver` does
- the same top view and front quarter in vectorised numpy; before anything is timed, their answers are compared with the
  kernels', bit by bit

The kernels compile before the first round that counts. The table shows minimum and median in milliseconds, both as
multiples of the copy loop's, and how many times numpy's time they are below. On a busy computer the minima are the ones
to compare.
"""

from __future__ import annotations

import argparse
import platform
from collections.abc import Callable
from pathlib import Path
from time import perf_counter_ns

import numba
import numpy as np
from numba import njit
from numpy.typing import NDArray

from edgeperc.card import InputSpec, RangeImageGeometry, TopViewGeometry
from edgeperc.projection import RangeImageProjector, TopViewProjector, column_edges, row_edges, tabulate
from edgeperc.readers.files import read_points
from edgeperc.sensor import get_sensor
from edgeperc.simulation.drawn import random_scene
from edgeperc.simulation.scene import simulate

__all__ = ["NumpyRangeImage", "NumpyTopView", "main", "measure"]

SENSOR = "hdl-64e"
N_WARM_UP = 3
TOP_VIEW = TopViewGeometry()
RANGE_IMAGE = RangeImageGeometry(get_sensor(SENSOR).elevations_deg)
FULL_TURN = RangeImageGeometry(get_sensor(SENSOR).elevations_deg, 2048, 180.0, -180.0)
TOP_VIEW_INPUT = InputSpec("top_view", ("distance", "remission", "height"), (0.0, 0.0, -2.5), (47.07, 1.0, 5.0))
RANGE_IMAGE_INPUT = InputSpec(
    "range_image", ("x", "y", "z", "remission", "range"), (13.0, 0.0, -1.3, 0.23, 14.5), (11.4, 7.9, 0.8, 0.15, 12.3)
)


@njit(cache=True, nogil=True)
def fill_copy(points, copy):
    """Copy the points, number by number.

    Parameters
    ----------
    points : (n, 4) float32, C-contiguous
    copy : (n, 4) float32, overwritten
    """
    for i in range(points.shape[0]):
        for k in range(4):
            copy[i, k] = points[i, k]


class NumpyTopView:
    """`TopViewProjector` in numpy: the same decisions, in float32, on all points at once."""

    def __init__(self, view: TopViewGeometry, input: InputSpec) -> None:
        self.shape = (len(input.channels), view.height, view.width)
        self.low, self.high = np.float32([view.x_range_m, view.y_range_m, view.z_range_m]).T
        self.cells_per_m = np.float32(1.0 / view.cell_m)
        self.mean, self.std = np.float32(input.mean)[:, None], np.float32(input.std)[:, None]

    def fill(
        self,
        points: NDArray[np.float32],
        image: NDArray[np.float32],
        index: NDArray[np.int32],
        pixel: NDArray[np.int32],
    ) -> None:
        _, height, width = self.shape
        x, y, z, remission = points.T
        rows = np.flatnonzero((x >= self.low[0]) & (x < self.high[0]) & (y >= self.low[1]) & (y < self.high[1]))
        x, y, z, remission = points[rows].T
        inside = (z >= self.low[2]) & (z <= self.high[2]) & np.isfinite(remission)
        rows, x, y, z = rows[inside], x[inside], y[inside], z[inside]
        ahead = np.minimum(((x - self.low[0]) * self.cells_per_m).astype(np.int32), height - 1)
        left = np.minimum(((y - self.low[1]) * self.cells_per_m).astype(np.int32), width - 1)
        flat = (height - 1 - ahead) * width + (width - 1 - left)
        pixel[:] = -1
        pixel[rows] = flat
        seen, winner = winners(flat, -z, index.reshape(-1), rows)
        x, y, z, remission = points[winner].T
        image[:] = 0.0
        planes = np.stack((np.sqrt(x * x + y * y), remission, z))
        image.reshape(len(image), -1)[:, seen] = (planes - self.mean) / self.std


class NumpyRangeImage:
    """`RangeImageProjector` in numpy: the same decisions, in float32, on all points of the front quarter at once."""

    def __init__(self, view: RangeImageGeometry, input: InputSpec) -> None:
        self.shape = (len(input.channels), view.height, view.width)
        self.rows, self.cols = tabulate(row_edges(view), "rows"), tabulate(column_edges(view), "columns")
        self.mean, self.std = np.float32(input.mean)[:, None], np.float32(input.std)[:, None]

    def fill(
        self,
        points: NDArray[np.float32],
        image: NDArray[np.float32],
        index: NDArray[np.int32],
        pixel: NDArray[np.int32],
    ) -> None:
        width = self.shape[2]
        rows = np.flatnonzero((points[:, 0] > 0.0) & (np.abs(points[:, 1]) <= points[:, 0]))
        x, y, z, remission = points[rows].T
        squared_distance = x * x + y * y
        squared_range = squared_distance + z * z
        elevation, azimuth = z / (np.sqrt(squared_distance) + np.abs(z)), y / (x + np.abs(y))
        (top, bottom, _), (left, right, _) = self.rows[0], self.cols[0]
        inside = (elevation <= top) & (elevation > bottom) & (azimuth <= left) & (azimuth > right)
        inside &= np.isfinite(squared_range) & np.isfinite(remission)
        rows, squared_range = rows[inside], squared_range[inside]
        flat = look_up(elevation[inside], self.rows) * width + look_up(azimuth[inside], self.cols)
        pixel[:] = -1
        pixel[rows] = flat
        seen, winner = winners(flat, squared_range, index.reshape(-1), rows)
        x, y, z, remission = points[winner].T
        image[:] = 0.0
        planes = np.stack((x, y, z, remission, np.sqrt(x * x + y * y + z * z)))
        image.reshape(len(image), -1)[:, seen] = (planes - self.mean) / self.std


def look_up(
    values: NDArray[np.float32], table: tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.float32]]
) -> NDArray[np.int32]:
    """Intervals of the values, by `tabulate`'s table: a third of the time that searchsorted takes."""
    (first, _, cells_per_unit), base, split = table
    cells = ((first - values) * cells_per_unit).astype(np.int32)
    return base[cells] + (values <= split[cells])


def winners(
    flat: NDArray[np.int32], rank: NDArray[np.float32], index: NDArray[np.int32], rows: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.int32]]:
    """Write the row of the smallest rank, or the earlier of two, into ``index``: pixels seen and the rows there."""
    best = np.full(len(index), np.inf, np.float32)
    np.minimum.at(best, flat, rank)
    # Of several values assigned to one pixel numpy keeps the last.
    winning = np.flatnonzero(rank == best[flat])[::-1]
    index[:] = -1
    index[flat[winning]] = rows[winning]
    seen = np.flatnonzero(index >= 0)
    return seen, index[seen]


def contenders(points: NDArray[np.float32]) -> dict[str, Callable[[], object]]:
    """What is measured, by the names in the table, each with buffers of its own."""
    copy = np.empty_like(points)
    calls: dict[str, Callable[[], object]] = {"copy loop": lambda: fill_copy(points, copy)}

    def add(
        name: str, kernels: TopViewProjector | RangeImageProjector, by_numpy: NumpyTopView | NumpyRangeImage | None
    ):
        answers = []
        for _ in range(2):
            image, index = np.empty(kernels.shape, np.float32), np.empty(kernels.shape[1:], np.int32)
            answers.append((image, index, np.empty(len(points), np.int32)))
        calls[name] = lambda: kernels.fill(points, *answers[0])
        if by_numpy is None:
            return
        calls[f"{name}, numpy"] = lambda: by_numpy.fill(points, *answers[1])
        calls[name]()
        calls[f"{name}, numpy"]()
        if not all(np.array_equal(a, b) for a, b in zip(*answers, strict=True)):
            raise AssertionError(f"{name}: numpy answers other pixels than the kernels")

    add("top view", TopViewProjector(TOP_VIEW, TOP_VIEW_INPUT), NumpyTopView(TOP_VIEW, TOP_VIEW_INPUT))
    range_image = RangeImageProjector(RANGE_IMAGE, RANGE_IMAGE_INPUT)
    add("range image", range_image, NumpyRangeImage(RANGE_IMAGE, RANGE_IMAGE_INPUT))
    add("range image 360", RangeImageProjector(FULL_TURN, RANGE_IMAGE_INPUT), None)
    return calls


def measure(calls: dict[str, Callable[[], object]], n_rounds: int) -> dict[str, NDArray[np.float64]]:
    """Milliseconds of each call in each round."""
    took = {name: np.empty(N_WARM_UP + n_rounds) for name in calls}
    rng = np.random.default_rng(0)
    for k in range(N_WARM_UP + n_rounds):
        for name in rng.permutation(list(calls)):
            start = perf_counter_ns()
            calls[name]()
            took[name][k] = (perf_counter_ns() - start) / 1e6
    return {name: ms[N_WARM_UP:] for name, ms in took.items()}


def table(took: dict[str, NDArray[np.float64]]) -> str:
    blocks = ("minimum", np.min), ("median", np.median)
    head = " " * 22 + "".join(f"{name:>8}, ms{'x copy':>8}{'numpy /':>9}" for name, _ in blocks)
    lines = [head]
    for name, ms in took.items():
        line = f"{name:<22}"
        for _, of in blocks:
            line += f"{of(ms):12.3f}{of(ms) / of(took['copy loop']):8.2f}"
            by_numpy = took.get(f"{name}, numpy")
            line += " " * 9 if by_numpy is None else f"{of(by_numpy) / of(ms):9.1f}"
        lines.append(line.rstrip())
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m edgeperc_bench.peers.projection", description=__doc__.splitlines()[0]
    )
    parser.add_argument("scan", nargs="?", type=Path, help="a file that read_points reads; default: a simulated scan")
    parser.add_argument("--rounds", type=int, default=300, help="how often each is timed (default: %(default)s)")
    arguments = parser.parse_args()
    if arguments.scan is None:
        name, points = "a simulated scan", simulate(random_scene(3), SENSOR, 0).points
    else:
        name, points = str(arguments.scan), read_points(arguments.scan)
    took = measure(contenders(points), arguments.rounds)
    print(f"{len(points):,} points of {name}; {arguments.rounds} rounds")
    print(
        f"numpy {np.__version__}, numba {numba.__version__}, Python {platform.python_version()}, {platform.machine()}"
    )
    print(table(took))


if __name__ == "__main__":
    main()
