"""Small synthetic captures and scan files, made by code, which `captures` damages."""

from __future__ import annotations

import io
import os
import struct
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lidar_writers
import numpy as np
import test_apart as apart_tests
import test_captures as capture_tests
import test_clouds as cloud_tests
import test_packet_messages as message_tests
import test_packets as packet_tests
import test_pcap as pcap_tests

__all__ = ["Seed", "pcap_records", "real_seeds", "synthetic_seeds"]


@dataclass(frozen=True)
class Seed:
    """Files of a capture by name, and the one to read (empty: the folder itself)."""

    kind: str
    files: dict[str, bytes]
    entry: str


def pcap_records(content: bytes) -> list[bytes]:
    """The packets of a pcap file, each with its header of 16 bytes."""
    at, found = 24, []
    while at + 16 <= len(content):
        end = at + 16 + struct.unpack_from("<I", content, at + 8)[0]
        found.append(content[at:end])
        at = end
    return found


def synthetic_seeds(folder: Path) -> list[Seed]:
    """One or more seeds of every format, a few kilobytes each."""
    seeds = [_ouster(folder / "ouster"), _osf(folder / "ouster")]
    path = capture_tests.write_pcap(folder / "vlp16.pcap", capture_tests.vlp16_packets(0.12))
    seeds.append(Seed("velodyne", {"cap.pcap": path.read_bytes()}, "cap.pcap"))
    for link in (113, 276, 101):
        path = packet_tests.write_link(folder / "link.pcap", link, capture_tests.vlp16_packets(0.02))
        seeds.append(Seed("velodyne", {"cap.pcap": path.read_bytes()}, "cap.pcap"))
    seeds += _lidars(folder)
    seeds += [_pcapng(seed, k) for k, seed in enumerate(seeds) if seed.entry == "cap.pcap"]
    seeds += [Seed("bag1", {"cap.bag": capture_tests.write_bag1(folder / "one.bag").read_bytes()}, "cap.bag")]
    seeds += [Seed("bag1", {"cap.bag": _packed_bag(folder, m)}, "cap.bag") for m in ("BZ2", "LZ4")]
    bag2 = capture_tests.write_bag2(folder / "bag2")
    seeds.append(Seed("bag2", {f"cap/{f.name}": f.read_bytes() for f in sorted(bag2.iterdir())}, "cap"))
    mcap = capture_tests.write_mcap_folder(folder / "mcap")
    seeds.append(Seed("bag2", {f"cap/{f.name}": f.read_bytes() for f in sorted(mcap.iterdir())}, "cap"))
    alone = {f"cap/{f.name}": f.read_bytes() for f in bag2.glob("*.db3")}
    seeds.append(Seed("bag2", alone, "cap"))
    foxglove = cloud_tests.write_foxglove(folder / "foxglove.mcap").read_bytes()
    seeds += [Seed("mcap", {"cap.mcap": foxglove}, "cap.mcap")] * 3
    plain = capture_tests.write_mcap(folder / "plain.mcap").read_bytes()
    seeds += [Seed("mcap", {"cap.mcap": plain}, "cap.mcap")] * 3
    for kind, writer in (("bag1", "ROS 1"), ("mcap", "ROS 2"), ("mcap", "big-endian")):
        path = message_tests.WRITERS[writer](folder, capture_tests.vlp16_packets(0.12), 4)
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
        content = head[:24] + b"".join(pcap_records(head)[:n_packets])
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
        path = capture_tests.write_pcap(folder / f"{name}.pcap", [*packets[:1], *says, *packets[1:6]])
        files = {"cap.pcap": path.read_bytes()}
        if model.layout == "<":
            files["cap.csv"] = lidar_writers.calibration(angles).encode()
        seeds.append(Seed("lidar", files, "cap.pcap"))
    points = np.tile([[10.0, -3.0, 1.0], [0.0, 0.0, 0.0]], (300, 1))
    for kind, is_old in ((1, False), (2, False), (3, False), (0x11, False), (1, True), (4, True)):
        packets = lidar_writers.livox_packets(kind, points, np.arange(600) % 256, is_old)
        path = capture_tests.write_pcap(folder / "livox.pcap", packets)
        seeds.append(Seed("lidar", {"cap.pcap": path.read_bytes()}, "cap.pcap"))
        if not is_old:
            seeds.append(Seed("lvx2", {"cap.lvx2": lidar_writers.lvx2_file(packets, ("one",))}, "cap.lvx2"))
    return seeds


def _ouster_frame(folder: Path) -> tuple[Any, list[Any], Any]:
    from ouster.sdk import core

    folder.mkdir(exist_ok=True)
    info = core.SensorInfo.from_default(core.LidarMode._512x10)
    info.sn = 991
    info.format.udp_profile_lidar = core.UDPProfileLidar.RNG19_RFL8_SIG16_NIR16
    info.config.udp_port_lidar, info.config.udp_port_imu = 7502, 7503
    frame = core.LidarFrame(info)
    frame.frame_id = 1
    frame.field("RANGE")[:, 1::2] = 10_000
    frame.field("REFLECTIVITY")[:] = 40
    frame.timestamp[:] = np.arange(512) * 195_312 + 5 * 10**9
    frame.measurement_id[:] = np.arange(512)
    frame.packet_timestamp[:] = 10**18
    frame.status[:] = 1
    return core, [frame], info


def _ouster(folder: Path) -> Seed:
    from ouster.sdk import pcap

    core, frames, info = _ouster_frame(folder)
    layout = core.PacketFormat(info)
    packets = [p for frame in frames for p in core.frame_to_packets(frame, layout, info.init_id, info.sn)][:6]
    pcap.record(packets, str(folder / "cap.pcap"))
    files = {"cap.pcap": (folder / "cap.pcap").read_bytes(), "cap.json": info.to_json_string().encode()}
    return Seed("ouster", files, "cap.pcap")


def _osf(folder: Path) -> Seed:
    from ouster.sdk import osf

    _, frames, info = _ouster_frame(folder)
    with osf.Writer(str(folder / "cap.osf"), info) as writer:
        for frame in frames:
            writer.save(0, frame)
    return Seed("osf", {"cap.osf": (folder / "cap.osf").read_bytes()}, "cap.osf")


def _packed_bag(folder: Path, method: str) -> bytes:
    return capture_tests.write_bag1(folder / f"{method}.bag", compression=method).read_bytes()


def scan_files() -> dict[str, bytes]:
    """Scans of five points in every format of `edgeperc.read_points`, by file name."""
    points = np.arange(20, dtype=np.float32).reshape(5, 4) * np.float32(1.37)
    npy, npz, deflated = io.BytesIO(), io.BytesIO(), io.BytesIO()
    np.save(npy, points)
    np.savez(npz, points=points)
    with zipfile.ZipFile(deflated, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", npy.getvalue())
    text = "\n".join(" ".join(f"{v:.3f}" for v in row) for row in points) + "\n"
    pcd = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 5\n"
    pcd += "HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 5\nDATA "
    columns = points.T.tobytes()
    literal = b"".join(bytes([len(columns[k : k + 32]) - 1]) + columns[k : k + 32] for k in range(0, len(columns), 32))
    compressed = struct.pack("<II", len(literal), len(columns)) + literal
    ply = "ply\nformat {} 1.0\nelement vertex 5\n"
    ply += "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity")) + "end_header\n"
    structured = io.BytesIO()
    np.save(structured, np.rec.fromarrays(points.T, names="x,y,z,intensity"))
    return {
        "a.npy": npy.getvalue(), "b.npy": structured.getvalue(), "a.npz": npz.getvalue(), "b.npz": deflated.getvalue(),
        "a.bin": points.tobytes(), "a.pcd.bin": np.resize(points, (4, 5)).tobytes(),
        "a.pcd": (pcd + "ascii\n" + text).encode(), "b.pcd": (pcd + "binary\n").encode() + points.tobytes(),
        "c.pcd": (pcd + "binary_compressed\n").encode() + compressed,
        "a.ply": (ply.format("ascii") + text).encode(),
        "a.xyz": text.encode(), "a.csv": b"x,y,z,intensity\n" + text.replace(" ", ",").encode(),
        "b.ply": ply.format("binary_little_endian").encode() + points.tobytes(),
        "c.ply": ply.format("binary_big_endian").encode() + points.astype(">f4").tobytes(),
    }  # fmt: skip


def data_root() -> Path | None:
    """The folder of real captures of other sensors, if it is unpacked or named."""
    given = os.environ.get("EDGEPERC_TEST_DATA")
    root = Path(given) / "other_sensors" if given else None
    return root if root is not None and root.is_dir() else None
