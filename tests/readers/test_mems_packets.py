"""Packets of RoboSense's M1 and E1: what is written is read."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_writers import check_same, let_overtake, sized, write_pcap
from hypothesis import given
from hypothesis import strategies as st
from lidar_writers import T0_S, mems_packets
from test_packet_messages import mcap_of

from edgeperc import read_timed_scans, sensor_of
from edgeperc.readers.mems_packets import MemsStream, mems_format_of
from edgeperc.types.sensor import SENSORS

pytestmark = pytest.mark.usefixtures("in_this_process")

PER_PACKET = {"m1": 125, "e1": 96}


def drawn(name: str, n_packets: int, seed: int = 0) -> tuple[Any, Any, Any]:
    """Distances of 5 mm, places and reflectivities; a third has no return."""
    rng = np.random.default_rng(seed)
    n = PER_PACKET[name] * n_packets
    units, remission = rng.integers(50, 40_000, n), rng.integers(0, 256, n)
    units[rng.random(n) < 0.3] = 0
    if name == "m1":
        return units, np.stack([rng.integers(-1250, 1250, n), rng.integers(-6000, 6000, n)], 1), remission
    ahead = rng.normal(0.0, 1.0, (n, 3))
    return units, np.round(32767 * ahead / np.linalg.norm(ahead, axis=1)[:, None]).astype(np.int64), remission


def expected(name: str, units: Any, places: Any, remission: Any) -> Any:
    """x, y, z, reflectivity of each return."""
    meters = 0.005 * units[:, None]
    if name == "m1":
        pitch, yaw = np.radians(0.01 * places.T)
        xyz = meters * np.stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)], 1)
    else:
        xyz = meters * places / 32768
    return np.column_stack([xyz, remission])[units > 0]


@pytest.mark.parametrize("name", PER_PACKET)
def test_what_is_written_is_read(tmp_path: Path, name: str) -> None:
    """Two frames and a half; each return, in order, with its reflectivity to the bit, and when it was measured."""
    values = drawn(name, 50)
    packets = mems_packets(name, *values, per_frame=20)
    path = write_pcap(tmp_path / "drive.pcap", packets)
    scans = [*read_timed_scans(path)]
    assert len(scans) == 3
    whole = np.concatenate([scan.points for scan in scans])
    wanted = expected(name, *values)
    np.testing.assert_allclose(whole, wanted, atol=2e-5)
    np.testing.assert_array_equal(whole[:, 3], wanted[:, 3])
    n_of_frame = [int((values[0][PER_PACKET[name] * k : PER_PACKET[name] * (k + 20)] > 0).sum()) for k in (0, 20, 40)]
    assert [len(scan.points) for scan in scans] == n_of_frame
    step_s, per_block = (5e-6, 5) if name == "m1" else (8e-6, 1)
    blocks = np.repeat(np.tile(np.arange(PER_PACKET[name] // per_block), 50), per_block)
    times_s = T0_S + 9e-4 * np.repeat(np.arange(50), PER_PACKET[name]) + step_s * blocks
    np.testing.assert_allclose(np.concatenate([s.times_s for s in scans]), times_s[values[0] > 0], atol=1e-6)
    sent = [
        b"\0\1\0\0" + struct.pack("<iII", 1000, 10**6 * k, 3) + b"rs\0" + bytes(5) + sized(packet)
        for k, packet in enumerate(packets)
    ]
    bag = mcap_of(tmp_path / "a.mcap", [("/packets", "rslidar_msg/msg/RslidarPacket", "cdr", sent)], 900_000)
    assert check_same(read_timed_scans(bag), scans, clock=False) == 3
    for source in (path, bag):
        assert sensor_of(source) is SENSORS[f"rs-{name}"]
    assert sum(len(scan.points) for scan in [*read_timed_scans(let_overtake(path))][:3]) == len(whole)


@pytest.mark.parametrize("name", PER_PACKET)
@given(data=st.data())
def test_damaged_packets_give_points_or_none(name: str, data: st.DataObject) -> None:
    whole = mems_packets(name, *drawn(name, 1), per_frame=10)[0]
    damaged = bytearray(whole)
    for at in data.draw(st.lists(st.integers(0, len(whole) - 1), max_size=8)):
        damaged[at] = data.draw(st.integers(0, 255))
    cut = memoryview(bytes(damaged))[: data.draw(st.sampled_from([len(whole), len(whole) - 1, 3]))]
    row = mems_format_of(cut)
    if row is not None:
        stream = MemsStream(row)
        (scan,) = [*stream.add(cut), *stream.end()]
        assert len(scan.points) <= PER_PACKET[name]
        assert np.isfinite(scan.points).all()
        assert scan.times_s is not None
        assert len(scan.times_s) == len(scan.points)
    assert mems_format_of(memoryview(whole)[:-1]) is None
