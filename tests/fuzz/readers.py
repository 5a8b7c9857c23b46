"""Damaged scan files, recordings and text files, each through its reader, in this process.

``readers.pcd`` and so on have the cases of one reader alone, of 0.2 ms and more: what fits a million cases.
"""

from __future__ import annotations

import resource
import tempfile
import warnings
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import test_captures as capture_tests
import test_clouds as cloud_tests
import test_files as file_tests

from edgeperc import Trajectory
from edgeperc.camera.calibration import read_kitti_calibration
from edgeperc.datasets.kitti import read_labels
from edgeperc.errors import PointsError
from edgeperc.readers.captures import is_capture
from edgeperc.readers.clouds import CLOUD_READERS, cloud_points, cloud_table, describe_cloud
from edgeperc.readers.decoders import decode, describe
from edgeperc.readers.files import FileOptions, parse_points, read_timed_file
from edgeperc.readers.tables import MAX_BYTES
from edgeperc.readers.times import point_times
from edgeperc.types.points import table_columns

from .captures import DAMAGES, MOST_SCANS, check_scan
from .mutate import mutated_bytes, mutated_words, noise
from .running import Case, check
from .seeds import Seed, scan_files, synthetic_seeds

LIMIT_S, LIMIT_MB = 20.0, 2700.0
CAPTURES = {
    "bag1": ("bag1",), "bag2": ("bag2",), "mcap": ("mcap", "chunked"), "velodyne": ("velodyne",), "lidar": ("lidar",),
    "lvx2": ("lvx2",), "ouster": ("ouster",), "pcapng": ("pcapng",),
}  # fmt: skip
"""Kinds of the seeds of each reader of captures; without OSF, whose library ends processes."""
READERS = ("pcd", "ply", "raw", "npy", "text", "others", "clouds", "calibration", "labels", "poses", *CAPTURES)
CUT_SHARE, WHOLE_SHARE, ON_DISK_SHARE = 0.1, 0.01, 0.02
# Of which a cut does not show, or not between packets.
UNMARKED = ("raw", "text", "others", "velodyne", "lidar", "ouster", "pcapng")

TEXTS: dict[str, tuple[Callable[[Path], object], list[bytes]]] = {
    "calibration": (
        read_kitti_calibration,
        [
            b"P0: 1 0 0 0 0 1 0 0 0 0 1 0\nP2: 720 0 610 45 0 720 173 0.2 0 0 1 0.003\nR0_rect: 1 0 0 0 1 0 0 0 1\n"
            b"Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n",
            b"P2: 720 0 610 45 0 720 173 0.2 0 0 1 0.003\nTr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n",
        ],
    ),
    "labels": (
        read_labels,
        [b"Car 0 0 0 500 150 700 300 1.5 1.6 3.9 1.0 1.7 12.0 1.57\nDontCare -1 -1 -10 5 5 9 9 -1 -1 -1 9 9 9 -10\n"],
    ),
    "poses": (
        Trajectory.from_tum,
        [b"# t x y z q\n" + b"".join(b"%d.5 %d %d 0 0 0 0.6 0.8\n" % (k, k, 3 * k) for k in range(6))],
    ),
}
"""What reads a text file, and whole ones."""

MAGIC = [
    b"LASF", b"ASTM-E57", b"ARROW1\0\0", b"PAR1", b"\x89HDF\r\n\x1a\n", b"version https://git-lfs.github.com/spec/v1\n",
    b"\x80\x04", b"PK\x05\x06", b"\x1f\x8b\x08", b"BZh9", b"\0\0\0\x20ftypisom", b"<?xml ", b"{", b"%PDF", b"MZ", b"",
    b"2\n1\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n1 2 3 0.5\n4 5 6 0.5\n",  # PTX
]  # fmt: skip
"""First bytes of files of other formats."""
NAMES = ["a.bin", "a.pcd.bin", "a.pcd", "a.ply", "a.npy", "a.npz", "a.las", "a.csv", "a.pts", "a.feather", "a"]


def _files() -> dict[str, list[tuple[str, bytes]]]:
    """Names and contents of whole scan files, by their reader."""
    found: dict[str, list[tuple[str, bytes]]] = {name: [] for name in ("pcd", "ply", "raw", "npy", "text", "others")}
    of_suffix = {".npy": "npy", ".npz": "npy", ".pcd": "pcd", ".ply": "ply", ".xyz": "text", ".csv": "text"}
    for name, content in [*file_tests.FILES.items(), *scan_files().items()]:
        reader = "npy" if content.startswith(b"\x93NUMPY") else of_suffix.get(Path(name).suffix, "raw")
        found[reader].append((name, content))
    street = file_tests.street(0, 1500)
    others = np.c_[np.arange(len(street)) % 32, np.linspace(0.0, 0.1, len(street)), np.full((len(street), 2), -1.0)]
    found["raw"] *= 5  # small ones take less time
    for n in (3, 4, 5, 6, 8):
        found["raw"].append(("street.bin", np.c_[street, others][:, :n].astype("<f4").tobytes()))
    found["text"].append(("a.pts", b"2\n1 2 3 12\n4 5 6 13\n"))
    found["others"] = [(name, magic + bytes(60)) for magic in MAGIC for name in NAMES]
    return found


class Readers:
    """The kind ``readers``: readers by turns, or the one behind the dot."""

    limit_s, limit_mb = LIMIT_S, LIMIT_MB

    def __init__(self, only: str) -> None:
        self.name = f"readers.{only}" if only else "readers"
        self.readers = [only] if only else [*READERS]
        self.files, self.seeds = _files(), dict[str, list[Seed]]()
        self.sizes: dict[tuple[str, int], int] = {}  # points of whole files
        for library in ("lz4.frame", "zstandard", "sqlite3", "velodyne_decoder"):
            import_module(library)
        self.clouds = self._clouds()
        with tempfile.TemporaryDirectory() as folder:
            made = synthetic_seeds(Path(folder)) if {*self.readers} & {*CAPTURES} else []
            for reader, kinds in CAPTURES.items():
                self.seeds[reader] = [seed for seed in made if seed.kind in kinds]
            for reader in self.readers:  # compiles the kernels
                for k, seed in enumerate(self.seeds.get(reader, ())):
                    path = Path(tempfile.mkdtemp(dir=folder))
                    self.sizes[reader, k] = sum(len(points) for points in _decoded(_written(seed.files, path, seed)))
        for reader, files in self.files.items():
            for k, (name, content) in enumerate(files):
                if reader != "others":
                    self.sizes[reader, k] = len(parse_points(content, name))
        # As for the process that decodes captures.
        _, most = resource.getrlimit(resource.RLIMIT_DATA)
        resource.setrlimit(resource.RLIMIT_DATA, (MAX_BYTES if most < 0 else min(MAX_BYTES, most), most))

    @staticmethod
    def _clouds() -> list[tuple[tuple[str, str], bytes]]:
        """Point clouds as messages, with the keys of what reads them."""
        found = [(("foxglove.PointCloud", "protobuf"), cloud_tests.foxglove(capture_tests.POINTS))]
        typesys = import_module("rosbags.typesys")
        for ros, encoding in ((1, "ros1"), (2, "cdr")):
            store, sent = capture_tests.messages(typesys, ros)
            write = store.serialize_ros1 if ros == 1 else store.serialize_cdr
            key = ("sensor_msgs/PointCloud2" if ros == 1 else "sensor_msgs/msg/PointCloud2", encoding)
            found += [(key, bytes(write(message, kind))) for _, kind, _, message in sent if "PointCloud2" in kind]
        return found

    def run(self, case: Case) -> str:
        reader = self.readers[case.index % len(self.readers)]
        if reader in TEXTS:
            outcome = self.text(case, reader)
        elif reader == "clouds":
            outcome = self.cloud(case)
        else:
            outcome = self.capture(case, reader) if reader in CAPTURES else self.file(case, reader)
        return f"{reader}: {outcome}"

    def damaged(self, case: Case, content: bytes) -> tuple[bytes, str]:
        """A content changed in one of several ways, and the way."""
        draw = case.rng.random()
        if draw < CUT_SHARE:
            return content[: int(case.rng.integers(len(content)))], "cut"
        if draw < CUT_SHARE + WHOLE_SHARE:
            return content, "whole"
        if draw < CUT_SHARE + 2 * WHOLE_SHARE:
            return noise(case), "noise"
        if draw < 0.5:
            return mutated_words(content, case), "words"
        return mutated_bytes(content, case, 6, near=case.pick([0, 30, 250])), "bytes"

    def expect(self, case: Case, key: tuple[str, int], way: str, n: int) -> None:
        """A whole file gives all of its points; of a cut one, a part is no answer."""
        if way == "whole" or (way == "cut" and key[0] not in UNMARKED):
            check(n == self.sizes[key], f"{n} of {self.sizes[key]} points, and no error, of a file that is {way}")

    def file(self, case: Case, reader: str) -> str:
        k = int(case.rng.integers(len(self.files[reader])))
        name, whole = self.files[reader][k]
        content, way = self.damaged(case, whole)
        case.evidence[name] = content
        if case.rng.random() < ON_DISK_SHARE:
            path = case.folder / name
            path.write_bytes(content)
            columns = case.pick([None, 3, 4, 5, 8, 65, 0, ("x", "y", "z"), ("x", "y", "z", "intensity", "t"), ("a",)])
            field, origin = (
                case.pick([None, None, "intensity", "ring", ""]),
                case.pick([*[None] * 8, "auto", (1, 2, 3)]),
            )
            check_scan(None, read_timed_file(path, FileOptions(columns, field, origin)).points)
            return "scan with options"
        points = parse_points(content, name)
        check_scan(None, points)
        if reader != "others":
            self.expect(case, (reader, k), way, len(points))
        return "scan"

    def text(self, case: Case, reader: str) -> str:
        read, contents = TEXTS[reader]
        content, _ = self.damaged(case, case.pick(contents))
        case.evidence["a.txt"] = content
        path = case.folder / "a.txt"
        path.write_bytes(content)
        read(path)
        return "answer"

    def cloud(self, case: Case) -> str:
        key, whole = case.pick(self.clouds)
        content, way = self.damaged(case, whole)
        case.evidence["message"] = content
        message = CLOUD_READERS[key](memoryview(content))
        points = cloud_points(message, remission_field=case.pick([None, None, "reflectivity", "x"]))
        check_scan(None, points)
        check(way != "cut" or len(points) in (0, len(capture_tests.POINTS)), "a part of a cloud")
        point_times(table_columns(cloud_table(message)), points, 1.7e9)
        describe_cloud("/points", message)
        return "scan"

    def capture(self, case: Case, reader: str) -> str:
        k = int(case.rng.integers(len(self.seeds[reader])))
        seed = self.seeds[reader][k]
        files, way = dict(seed.files), "changed"
        draw = case.rng.random()
        if draw < CUT_SHARE and len(files) == 1:
            (name,) = files
            files, way = {name: files[name][: int(case.rng.integers(len(files[name])))]}, "cut"
        elif draw > WHOLE_SHARE:
            files = DAMAGES[seed.kind](files, case, seed)
        else:
            way = "whole"
        case.evidence |= {name.replace("/", "_"): content for name, content in files.items()}
        path = _written(files, case.folder, seed)
        topic = case.pick(["/lidar/points", "991", "", "x" * 1000, "/imu/text@x"]) if case.chance(0.05) else None
        n = n_scans = 0
        try:
            with mock.patch.object(tempfile, "tempdir", str(case.folder)):  # copies of captures go with the case
                for points in _decoded(path, topic):
                    n, n_scans = n + len(points), n_scans + 1
        except PointsError as exc:
            cause = type(exc.__cause__).__name__
            of = "" if cause in ("PointsError", "NoneType") else f" ({cause})"
            return f"{'scans, then ' if n_scans else ''}PointsError{of}"
        if topic is None:
            self.expect(case, (reader, k), way, n)
        return "scans"


def _written(files: dict[str, bytes], folder: Path, seed: Seed) -> Path:
    """Write the files of a capture; the path to read."""
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
    return folder / seed.entry


def _decoded(path: Path, topic: str | None = None) -> Any:
    """The points of each scan of a capture, at most `MOST_SCANS`; what describes its sensor runs, too."""
    kind = "ros2" if path.is_dir() else path.suffix
    check(path.is_dir() or is_capture(path), "not a capture by its name")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # as in the process that decodes captures
        for k, (stamp_s, points, times_s) in enumerate(decode(path, kind, topic, None, lambda _: None, lambda: None)):
            check_scan(stamp_s, points)
            check(times_s is None or len(times_s) == len(points), "times of other points")
            if k == 0 and kind not in (".pcap", ".lvx2"):
                describe(path, kind, topic, lambda: None)
            yield points
            if k + 1 >= MOST_SCANS:
                break


def make(seed: int, only: str = "") -> Readers:
    return Readers(only)
