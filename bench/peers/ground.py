"""Compare ground detection and clustering with other libraries: time, and accuracy of the ground.

This module is a command of its own: ``python -m edgeperc_bench.peers.ground [SCAN]``.

Every round handles the same scan once with each of these, in a new random order:

- `find_ground`, and its single plane; Open3D's ``segment_plane`` (100 iterations, 0.15 m) and Patchwork++
- on the points that `find_ground` leaves: `find_clusters` with the distance that grows with the range, and with 0.5 m
  everywhere; scikit-learn's and Open3D's DBSCAN with 0.5 m and one sample, which is the same problem. Their clusters
  are first compared with ours, point by point

What is not installed is listed with the line that installs it, and left out. ``OMP_NUM_THREADS=1`` restricts Open3D to
one core, as edgeperc always is.

For every ground finder the command prints recall and precision, from the labels next to a SemanticKITTI scan
(``sequences/00/velodyne/000000.bin``), or from the simulator if no scan is given. Vegetation and unlabeled points do
not count. ``--accuracy`` takes more scans and prints the means.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgeperc.ground.planes import find_ground
from edgeperc.objects.cluster import find_clusters
from edgeperc.readers.files import read_points
from edgeperc.simulation.drawn import random_scene
from edgeperc.simulation.scene import simulate
from edgeperc.types.points import Floats, Floats32, Ints64, Mask
from edgeperc.types.sensor import SensorProfile, get_sensor

from ..render import Section, number, share, text
from .rounds import measure, parser_of, versions

SENSOR = get_sensor("hdl-64e")
DISTANCE_M = 0.5
# Points of a voxel count as one for a k-d tree: without it, 48,000 points have 10 million pairs within 0.5 m.
VOXEL_M = 0.2
# SemanticKITTI: road, parking, pavement, other ground, lane marking, terrain; unlabeled, outlier, vegetation.
GROUND_IDS, IGNORED_IDS = (40, 44, 48, 49, 60, 72), (0, 1, 70)
# Points nearer than this to the simulator's ground are ground [m].
ON_GROUND_M = 0.06
PEERS = {"open3d": "open3d", "pypatchworkpp": "pypatchworkpp", "sklearn": "scikit-learn"}
Scan = Floats32
Truth = tuple[Mask, Mask]  # which points are ground, which points count
Finder = Callable[[Scan], Callable[[], Mask]]
Clusterer = Callable[[], NDArray[np.signedinteger[Any]]]


def installed_peers() -> dict[str, Any]:
    """The other libraries that can be imported; prints how to install the rest."""
    peers = {}
    for module, package in PEERS.items():
        if find_spec(module) is None:
            print(f"{package} is not installed. Run: pip install 'edgeperc[geometry]'")
            continue
        try:
            peers[module] = import_module(module)
        except ImportError as exc:  # Open3D needs libraries of the system, too
            print(f"{package} is left out: {exc}. On Debian: apt-get install libgl1 libgomp1 libusb-1.0-0")
    return peers


def ground_finders(peers: Mapping[str, Any], sensor: SensorProfile = SENSOR) -> dict[str, Finder]:
    """By name: functions that prepare a scan and return a call that finds its ground, (n,) bool; only it is timed."""

    def edgeperc(regions: bool) -> Finder:
        return lambda points: lambda: find_ground(points, mount_height_m=sensor.mount_height_m, regions=regions).mask

    def by_rows(n: int, rows: Any) -> Mask:
        mask = np.zeros(n, bool)
        mask[np.asarray(rows, dtype=np.int64).ravel()] = True
        return mask

    def open3d(points: Scan) -> Callable[[], Mask]:
        cloud = peers["open3d"].geometry.PointCloud(peers["open3d"].utility.Vector3dVector(points[:, :3].astype(float)))
        peers["open3d"].utility.random.seed(0)
        return lambda: by_rows(len(points), cloud.segment_plane(0.15, 3, 100)[1])

    def patchwork(points: Scan) -> Callable[[], Mask]:
        parameters = peers["pypatchworkpp"].Parameters()
        parameters.verbose = False
        parameters.sensor_height = sensor.mount_height_m
        # It adapts its thresholds from scan to scan, so every evaluated scan gets a new instance.
        finder = peers["pypatchworkpp"].patchworkpp(parameters)

        def call() -> Mask:
            finder.estimateGround(points)
            return by_rows(len(points), finder.getGroundIndices())

        return call

    finders = {"find_ground": edgeperc(True), "find_ground, one plane": edgeperc(False)}
    if "open3d" in peers:
        finders["Open3D segment_plane"] = open3d
    if "pypatchworkpp" in peers:
        finders["Patchwork++"] = patchwork
    return finders


def clusterers(points: Scan, peers: Mapping[str, Any]) -> dict[str, Clusterer]:
    """By name: calls that cluster the points, (n,) int; AssertionError if DBSCAN's differ from `find_clusters`'."""
    calls: dict[str, Clusterer] = {
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
    expected = by_first_point(calls["find_clusters, 0.5 m"]())
    for name in ("scikit-learn DBSCAN", "Open3D DBSCAN"):
        if name in calls and not np.array_equal(by_first_point(calls[name]()), expected):
            raise AssertionError(f"{name} finds other clusters than find_clusters")
    return calls


def tree_clusters(points: Scan) -> NDArray[np.signedinteger[Any]]:
    """Clusters by a k-d tree, (n,) int: voxels with no gap above `DISTANCE_M`, as PCL's Euclidean ones mostly are."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    x, y, z = (np.floor(points[:, :3] / np.float32(VOXEL_M)).astype(np.int64) + (1 << 20)).T
    _, first, voxel = np.unique(x << 42 | y << 21 | z, return_index=True, return_inverse=True)
    tree = KDTree(points[first, :3], balanced_tree=False, compact_nodes=False)
    pairs = tree.query_pairs(DISTANCE_M, output_type="ndarray")
    edges = coo_array((np.ones(len(pairs), bool), pairs.T), shape=(len(first), len(first)))
    return connected_components(edges, directed=False)[1][voxel]


def by_first_point(clusters: NDArray[np.signedinteger[Any]]) -> Ints64:
    """Clusters numbered by their first points, so that two numberings can be compared."""
    _, first, inverse = np.unique(clusters, return_index=True, return_inverse=True)
    return first[inverse]


def read_truth(scan: Path, n: int) -> Truth | None:
    """The ground truth of a SemanticKITTI scan, from the labels next to it; None if there are none."""
    path = scan.parent.parent / "labels" / f"{scan.stem}.label"
    if not path.is_file():
        return None
    labels = np.fromfile(path, np.uint32) & 0xFFFF
    if len(labels) != n:
        raise SystemExit(f"{path} holds {len(labels)} labels for a scan of {n} points")
    return np.isin(labels, GROUND_IDS), ~np.isin(labels, IGNORED_IDS)


def simulated() -> tuple[Scan, Truth]:
    """A simulated scan and its ground truth."""
    scan = simulate(random_scene(3), SENSOR, 0)
    world = scan.points[:, :3] @ scan.T_world_sensor[:3, :3].T + scan.T_world_sensor[:3, 3]
    above = world[:, 2] - [scan.scene.ground_height(x, y) for x, y in world[:, :2]]
    return scan.points, ((np.abs(above) < ON_GROUND_M) & (scan.objects < 0), np.ones(len(above), bool))


def recall_and_precision(mask: Mask, truth: Truth) -> tuple[float, float]:
    """Recall and precision of a ground mask over the points that count."""
    ground, counts = truth
    right, n_ground, n_found = (int(np.count_nonzero(mask_of & counts)) for mask_of in (mask & ground, ground, mask))
    return right / max(n_ground, 1), right / max(n_found, 1)


def table(title: str, ms: Mapping[str, Floats], reference: str) -> Section:
    """Minimum and median of each call, and their ratios to the reference's."""
    rows = [["", "minimum, ms", "median, ms", "minimum x edgeperc", "median x edgeperc"]]
    for name, of_call in ms.items():
        figures = [(float(statistic(of_call)), float(statistic(ms[reference]))) for statistic in (np.min, np.median)]
        ratios = (number(ours / theirs, 1) for ours, theirs in figures)
        rows.append([name, *(number(ours) for ours, _ in figures), *ratios])
    return Section(title, (), rows)


def main() -> None:
    parser, add = parser_of("ground", __doc__)
    add("scan", "a scan file (default: a simulated scan)", nargs="?", type=Path)
    add("--rounds N", "how often each is measured (default: %(default)s)", type=int, default=20)
    wanted = "more SemanticKITTI scans with labels, for recall and precision"
    add("--accuracy SCAN", wanted, nargs="*", type=Path, default=[])
    arguments = parser.parse_args()
    peers = installed_peers()
    truth: Truth | None
    if arguments.scan is None:
        name, (points, truth) = "a simulated scan", simulated()
    else:
        name, points = str(arguments.scan), read_points(arguments.scan)
        truth = read_truth(arguments.scan, len(points))
    scans = [(points, truth)] if truth is not None else []
    for path in arguments.accuracy:
        more = read_points(path)
        if (known := read_truth(path, len(more))) is None:
            raise SystemExit(f"{path} has no labels next to it: expected ../labels/{path.stem}.label")
        scans.append((more, known))

    finders = ground_finders(peers)
    ground_ms = measure({label: prepare(points) for label, prepare in finders.items()}, arguments.rounds)
    standing = points[~find_ground(points, mount_height_m=SENSOR.mount_height_m).mask]
    cluster_ms = measure(clusterers(standing, peers), arguments.rounds)
    print(f"{len(points):,} points of {name}, {len(standing):,} of them not ground; {arguments.rounds} rounds")
    print(versions(**{PEERS[module]: peer.__version__ for module, peer in peers.items()}))
    parts = [
        table("Ground", ground_ms, "find_ground"),
        table("Clusters (DBSCAN's are those of find_clusters, 0.5 m)", cluster_ms, "find_clusters, 0.5 m"),
    ]
    if scans:
        rows = [["", "recall", "precision"]]
        for label, prepare in finders.items():
            figures = [recall_and_precision(prepare(scan)(), truth) for scan, truth in scans]
            rows.append([label, *(share(float(mean)) for mean in np.mean(figures, axis=0))])
        parts.append(Section(f"Ground, means over {len(scans)} scans", (), rows))
    print(text(parts))


if __name__ == "__main__":
    main()
