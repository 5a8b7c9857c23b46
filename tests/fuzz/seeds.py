"""Small synthetic captures and scan files, made by code, which `captures` damages."""

from __future__ import annotations

import io
import os
import zipfile
from dataclasses import dataclass
from pathlib import Path

import capture_writers
import lidar_writers
import numpy as np
import test_apart as apart_tests
import test_captures as capture_tests
import test_clouds as cloud_tests
import test_files as file_tests
import test_packet_messages as message_tests
import test_pcap as pcap_tests


@dataclass(frozen=True)
class Seed:
    """Files of a capture by name, and the one to read (empty: the folder itself)."""

    kind: str
    files: dict[str, bytes]
    entry: str


def synthetic_seeds(folder: Path) -> list[Seed]:
    """One or more seeds of every format, a few kilobytes each."""
    seeds = [_ouster(folder / "ouster", "ouster", ".pcap"), _ouster(folder / "osf", "osf", ".osf")]
    path = capture_writers.write_pcap(folder / "vlp16.pcap", capture_writers.vlp16_packets(0.12))
    seeds.append(Seed("velodyne", {"cap.pcap": path.read_bytes()}, "cap.pcap"))
    for link in (113, 276, 101):
        path = capture_writers.write_link(folder / "link.pcap", link, capture_writers.vlp16_packets(0.02))
        seeds.append(Seed("velodyne", {"cap.pcap": path.read_bytes()}, "cap.pcap"))
    seeds += _lidars(folder)
    seeds += [_pcapng(seed, k) for k, seed in enumerate(seeds) if seed.entry == "cap.pcap"]
    seeds += [Seed("bag1", {"cap.bag": capture_tests.write_bag1(folder / "one.bag").read_bytes()}, "cap.bag")]
    seeds += [Seed("bag1", {"cap.bag": _packed_bag(folder, m)}, "cap.bag") for m in ("BZ2", "LZ4")]
    bag2 = capture_tests.write_bag2(folder / "bag2")
    mcap = capture_tests.write_mcap_folder(folder / "mcap")
    for files in (sorted(bag2.iterdir()), sorted(mcap.iterdir()), bag2.glob("*.db3")):
        seeds.append(Seed("bag2", {f"cap/{f.name}": f.read_bytes() for f in files}, "cap"))
    for path in (cloud_tests.write_foxglove(folder / "foxglove.mcap"), capture_tests.write_mcap(folder / "plain.mcap")):
        seeds += [Seed("mcap", {"cap.mcap": path.read_bytes()}, "cap.mcap")] * 3
    for kind, writer in (("bag1", "ROS 1"), ("mcap", "ROS 2"), ("mcap", "big-endian")):
        path = message_tests.WRITERS[writer](folder, capture_writers.vlp16_packets(0.12), 4)
        seeds.append(Seed(kind, {f"cap{path.suffix}": path.read_bytes()}, f"cap{path.suffix}"))
    for method in ("", "lz4", "zstd"):
        for summary in (True, False):
            packed = apart_tests.chunked_mcap(folder / "packed.mcap", method, summary=summary)
            seeds.append(Seed("chunked", {"cap.mcap": packed.read_bytes()}, "cap.mcap"))
    return seeds


def _pcapng(seed: Seed, k: int) -> Seed:
    """The same packets as pcapng."""
    packets = pcap_tests.packets_in(seed.files["cap.pcap"])
    kind, resolution = (pcap_tests.OLD if k % 5 == 4 else pcap_tests.ENHANCED), (None, 9, 0x80 | 20)[k % 3]
    content = pcap_tests.as_pcapng(packets, resolution=resolution, offset_s=k % 2, kind=kind)
    return Seed("pcapng", {**seed.files, "cap.pcap": content}, seed.entry)


def real_seeds(root: Path, n_packets: int = 40) -> list[Seed]:
    """The first packets of the real captures of a folder, if there are any; never written to the repository."""
    seeds = []
    for file in sorted(root.glob("**/*.pcap")):
        with file.open("rb") as opened:
            head = opened.read(1 << 21)
        content = head[:24] + b"".join(capture_writers.records_of(head)[:n_packets])
        metadata = file.with_suffix(".json")
        files = {"cap.pcap": content} | ({"cap.json": metadata.read_bytes()} if metadata.is_file() else {})
        seeds.append(Seed("ouster" if metadata.is_file() else "velodyne", files, "cap.pcap"))
    return seeds


def _lidars(folder: Path) -> list[Seed]:
    seeds = []
    for name, model in lidar_writers.MODELS.items():
        angles = lidar_writers.unit_angles(model)
        packets = lidar_writers.packets_of(
            model, lidar_writers.blocks_of(model, *lidar_writers.ranges(model, 4 * model.blocks), first_deg=359.5)
        )
        says = [lidar_writers.difop(model, angles)] if model.layout == ">" else []
        path = capture_writers.write_pcap(folder / f"{name}.pcap", [*packets[:1], *says, *packets[1:6]])
        files = {"cap.pcap": path.read_bytes()}
        if model.layout == "<":
            files["cap.csv"] = lidar_writers.calibration(angles).encode()
        seeds.append(Seed("lidar", files, "cap.pcap"))
    points = np.tile([[10.0, -3.0, 1.0], [0.0, 0.0, 0.0]], (300, 1))
    for kind, is_old in ((1, False), (2, False), (3, False), (0x11, False), (1, True), (4, True)):
        packets = lidar_writers.livox_packets(kind, points, np.arange(600) % 256, is_old)
        path = capture_writers.write_pcap(folder / "livox.pcap", packets)
        seeds.append(Seed("lidar", {"cap.pcap": path.read_bytes()}, "cap.pcap"))
        if not is_old:
            seeds.append(Seed("lvx2", {"cap.lvx2": lidar_writers.lvx2_file(packets, ("one",))}, "cap.lvx2"))
    return seeds


def _ouster(folder: Path, kind: str, suffix: str) -> Seed:
    folder.mkdir()
    info = capture_writers.ouster_info()
    capture_writers.write_ouster(folder / f"cap{suffix}", info, [capture_writers.ouster_frame(info)], 6)
    return Seed(kind, {file.name: file.read_bytes() for file in folder.iterdir()}, f"cap{suffix}")


def _packed_bag(folder: Path, method: str) -> bytes:
    return capture_tests.write_bag1(folder / f"{method}.bag", compression=method).read_bytes()


def scan_files() -> dict[str, bytes]:
    """Scans of five points in every format of `edgeperc.read_points`, by file name."""
    points = np.arange(20, dtype=np.float32).reshape(5, 4) * np.float32(1.37)
    npy, deflated = file_tests.npy(points), io.BytesIO()
    with zipfile.ZipFile(deflated, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", npy)
    text = "\n".join(" ".join(f"{v:.3f}" for v in row) for row in points) + "\n"
    fields = ("x y z intensity", "F F F F", "4 4 4 4", "1 1 1 1", len(points))
    return {
        "a.npy": npy, "b.npy": file_tests.npy(np.rec.fromarrays(points.T, names="x,y,z,intensity")),
        "a.npz": file_tests.npz(compressed=False, points=points), "b.npz": deflated.getvalue(),
        "a.bin": points.tobytes(), "a.pcd.bin": np.resize(points, (4, 5)).tobytes(),
        "a.pcd": file_tests.pcd(*fields, "ascii", text.encode()),
        "b.pcd": file_tests.pcd(*fields, "binary", points.tobytes()),
        "c.pcd": file_tests.packed_pcd(points),
        "a.ply": file_tests.ply("ascii", text.encode(), n=len(points)),
        "a.xyz": text.encode(), "a.csv": b"x,y,z,intensity\n" + text.replace(" ", ",").encode(),
        "b.ply": file_tests.ply("binary_little_endian", points.tobytes(), n=len(points)),
        "c.ply": file_tests.ply("binary_big_endian", points.astype(">f4").tobytes(), n=len(points)),
    }  # fmt: skip


def data_root() -> Path | None:
    """The folder of real captures of other sensors, if it is unpacked or named."""
    given = os.environ.get("EDGEPERC_TEST_DATA")
    root = Path(given) / "other_sensors" if given else None
    return root if root is not None and root.is_dir() else None
