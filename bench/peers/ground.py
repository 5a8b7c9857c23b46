"""How long it takes to tell the ground and to cluster what stands on it, beside other libraries, and how well.

Run as ``python -m edgeperc_bench.peers.ground [SCAN]``.

Every round handles the same scan once with each of these, in an
order drawn anew, so that whatever else keeps the computer busy treats them all alike:

- `find_ground`, and its single plane; Open3D's ``segment_plane`` (100 iterations, 0.15 m) and Patchwork++
- on the points that `find_ground` left, `find_clusters` with the distance that grows with the range, and with 0.5 m
  throughout; scikit-learn's and Open3D's DBSCAN with 0.5 m and one sample, which is the same question. Before anything
  is timed, their clusters are compared with ours, point by point

Whatever is not installed is left out and named, with the line that installs it. ``OMP_NUM_THREADS=1`` holds Open3D to
one core, as ours always is.

Of every way to find the ground the recall and precision are given for the scan, by the labels beside it where it is one
of SemanticKITTI's (``sequences/00/velodyne/000000.bin``), and by the simulator where none is given. Vegetation and
what is unlabelled do not count. ``--accuracy`` takes more scans, over which the means are given, too.
"""

from __future__ import annotations

import argparse
import platform
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import numba
import numpy as np
from numpy.typing import NDArray

from edgeperc.cluster import find_clusters
from edgeperc.ground import find_ground
from edgeperc.readers.files import read_points
from edgeperc.sensor import get_sensor
from edgeperc.simulation.drawn import random_scene
from edgeperc.simulation.scene import simulate

from .projection import measure

__all__ = ["main"]

SENSOR = get_sensor("hdl-64e")
DISTANCE_M = 0.5

# SemanticKITTI: road, parking, pavement, other ground, lane marking, terrain; unlabelled, outlier, vegetation.
GROUND_IDS, UNJUDGED_IDS = (40, 44, 48, 49, 60, 72), (0, 1, 70)

# Nearer to the simulator's ground than this is ground, [m].
ON_GROUND_M = 0.06
PEERS = {"open3d": "open3d", "pypatchworkpp": "pypatchworkpp", "sklearn": "scikit-learn"}
Truth = tuple[NDArray[np.bool_], NDArray[np.bool_]]
Calls = dict[str, Callable[[], NDArray]]


def installed_peers() -> dict[str, ModuleType]:
    """The rivals that can be imported; says how to install the others."""
    peers = {}
    for module, package in PEERS.items():
        if find_spec(module) is None:
            print(f"{package} is not installed. Run: pip install 'edgeperc[geometry]'")
            continue
        try:
            peers[module] = import_module(module)
        except ImportError as exc:  # Open3D wants libraries of the system, too
            print(f"{package} is left out: {exc}. On Debian: apt-get install libgl1 libgomp1 libusb-1.0-0")
    return peers


def ground_finders(peers: dict[str, ModuleType]) -> dict[str, Callable[[NDArray[np.float32]], Callable[[], NDArray]]]:
    """By name, what turns a scan into a call that finds its ground, (n,) bool. What only prepares is done before."""

    def ours(regions: bool):
        return lambda points: lambda: find_ground(points, mount_height_m=SENSOR.mount_height_m, regions=regions).mask

    def by_rows(n: int, rows) -> NDArray[np.bool_]:
        mask = np.zeros(n, bool)
        mask[np.asarray(rows, dtype=np.int64).ravel()] = True
        return mask

    def open3d(points):
        cloud = peers["open3d"].geometry.PointCloud(peers["open3d"].utility.Vector3dVector(points[:, :3].astype(float)))
        peers["open3d"].utility.random.seed(0)
        return lambda: by_rows(len(points), cloud.segment_plane(0.15, 3, 100)[1])

    def patchwork(points):
        parameters = peers["pypatchworkpp"].Parameters()
        parameters.verbose = False
        parameters.sensor_height = SENSOR.mount_height_m
        # It learns thresholds from scan to scan; every scan that is judged gets one that has seen no other.
        finder = peers["pypatchworkpp"].patchworkpp(parameters)

        def call():
            finder.estimateGround(points)
            return by_rows(len(points), finder.getGroundIndices())

        return call

    finders = {"find_ground": ours(True), "find_ground, one plane": ours(False)}
    if "open3d" in peers:
        finders["Open3D segment_plane"] = open3d
    if "pypatchworkpp" in peers:
        finders["Patchwork++"] = patchwork
    return finders


def clusterers(points: NDArray[np.float32], peers: dict[str, ModuleType]) -> Calls:
    """By name, what clusters points, (n,) int."""
    calls: Calls = {
        "find_clusters": lambda: find_clusters(points),
        "find_clusters, 0.5 m": lambda: find_clusters(
            points, min_distance_m=DISTANCE_M, distance_per_m=0.0, max_range_m=200.0, min_points=1
        ),
    }
    xyz = points[:, :3].astype(np.float64)
    if "sklearn" in peers:
        dbscan = import_module("sklearn.cluster").DBSCAN(eps=DISTANCE_M, min_samples=1, n_jobs=1)
        calls["scikit-learn DBSCAN"] = lambda: dbscan.fit(xyz).labels_
    if "open3d" in peers:
        cloud = peers["open3d"].geometry.PointCloud(peers["open3d"].utility.Vector3dVector(xyz))
        calls["Open3D DBSCAN"] = lambda: np.asarray(cloud.cluster_dbscan(DISTANCE_M, 1))
    expected = canonical(calls["find_clusters, 0.5 m"]())
    for name in ("scikit-learn DBSCAN", "Open3D DBSCAN"):
        if name in calls and not np.array_equal(canonical(calls[name]()), expected):
            raise AssertionError(f"{name} finds other clusters than find_clusters")
    return calls


def canonical(clusters: NDArray) -> NDArray[np.int64]:
    """Clusters by their first points, so that numbering does not matter."""
    _, first, inverse = np.unique(clusters, return_index=True, return_inverse=True)
    return first[inverse]


def read_truth(scan: Path, n: int) -> Truth | None:
    """Which points are ground and which are judged, from the labels beside a SemanticKITTI scan."""
    path = scan.parent.parent / "labels" / f"{scan.stem}.label"
    if not path.is_file():
        return None
    labels = np.fromfile(path, np.uint32) & 0xFFFF
    if len(labels) != n:
        raise SystemExit(f"{path} holds {len(labels)} labels for a scan of {n} points")
    return np.isin(labels, GROUND_IDS), ~np.isin(labels, UNJUDGED_IDS)


def simulated() -> tuple[NDArray[np.float32], Truth]:
    scan = simulate(random_scene(3), SENSOR, 0)
    world = scan.points[:, :3] @ scan.T_world_sensor[:3, :3].T + scan.T_world_sensor[:3, 3]
    above = world[:, 2] - [scan.scene.ground_height(x, y) for x, y in world[:, :2]]
    return scan.points, ((np.abs(above) < ON_GROUND_M) & (scan.objects < 0), np.ones(len(above), bool))


def recall_and_precision(mask: NDArray[np.bool_], truth: Truth) -> tuple[float, float]:
    ground, judged = truth
    right = np.count_nonzero(mask & ground & judged)
    return right / max(np.count_nonzero(ground & judged), 1), right / max(np.count_nonzero(mask & judged), 1)


def table(took: dict[str, NDArray[np.float64]], ours: str) -> str:
    lines = [f"{'':<24}{'minimum, ms':>12}{'median':>10}{'minimum x ours':>16}{'median':>8}"]
    for name, ms in took.items():
        least, middle = np.min(ms), np.median(ms)
        times = f"{least / np.min(took[ours]):16.1f}{middle / np.median(took[ours]):8.1f}"
        lines.append(f"{name:<24}{least:12.2f}{middle:10.2f}{times}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m edgeperc_bench.peers.ground", description=__doc__.splitlines()[0])
    parser.add_argument("scan", nargs="?", type=Path, help="a file that read_points reads; default: a simulated scan")
    parser.add_argument("--rounds", type=int, default=20, help="how often each is timed (default: %(default)s)")
    parser.add_argument("--accuracy", nargs="*", type=Path, default=[], help="more scans with labels beside them")
    arguments = parser.parse_args()
    peers = installed_peers()
    if arguments.scan is None:
        name, (points, truth) = "a simulated scan", simulated()
    else:
        name, points = str(arguments.scan), read_points(arguments.scan)
        truth = read_truth(arguments.scan, len(points))

    finders = ground_finders(peers)
    took = measure({each: prepare(points) for each, prepare in finders.items()}, arguments.rounds)
    standing = points[~find_ground(points, mount_height_m=SENSOR.mount_height_m).mask]
    took_clusters = measure(clusterers(standing, peers), arguments.rounds)
    print(f"{len(points):,} points of {name}, {len(standing):,} of them not ground; {arguments.rounds} rounds")
    print(
        f"numpy {np.__version__}, numba {numba.__version__}, Python {platform.python_version()}, {platform.machine()}",
        *(f", {PEERS[module]} {peer.__version__}" for module, peer in peers.items()),
        sep="",
    )
    print("\nground\n" + table(took, "find_ground"))
    print("\nclusters; DBSCAN's are those of find_clusters, 0.5 m\n" + table(took_clusters, "find_clusters, 0.5 m"))

    scans = [] if truth is None else [(points, truth)]
    for path in arguments.accuracy:
        more = read_points(path)
        if (known := read_truth(path, len(more))) is None:
            raise SystemExit(f"{path} has no labels beside it: expected ../labels/{path.stem}.label")
        scans.append((more, known))
    if scans:
        print(f"\nground, means over {len(scans)} scans" + f"\n{'':<24}{'recall':>8}{'precision':>11}")
        for each, prepare in finders.items():
            figures = [recall_and_precision(prepare(scan)(), known) for scan, known in scans]
            recall, precision = np.mean(figures, axis=0)
            print(f"{each:<24}{recall:8.4f}{precision:11.4f}")


if __name__ == "__main__":
    main()
