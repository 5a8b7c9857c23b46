"""Damaged packets of LiDARs, a hundred a case, through the kernels and streams that decode them, in this process."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from lidar_writers import (
    MODELS,
    at128_correction,
    at128_packets,
    blocks_of,
    calibration,
    difop,
    livox_packets,
    packets_of,
    ranges,
    unit_angles,
)
from numpy.typing import NDArray
from test_ouster_packets import ANGLES, changed

from edgeperc.errors import PointsError
from edgeperc.readers.livox_packets import LivoxStream, fill_points, points_of
from edgeperc.readers.mirror_packets import Mirrors, MirrorStream, read_mirrors
from edgeperc.readers.ouster_packets import PROFILES, OusterStream, fill_turn, layout_of
from edgeperc.readers.spinning_packets import (
    FORMATS,
    Angles,
    Format,
    SpinningStream,
    angles_of_difop,
    fill_returns,
    format_of,
    name_of,
    read_angles,
)

from .mutate import mutated_bytes, mutated_json
from .running import Case, check

LIMIT_S, LIMIT_MB = 5.0, 1500.0
N_PACKETS = 100
THROUGH_STREAM = 10  # of them
LIVOX = [(1, False), (2, False), (3, False), (0x11, False), (0, True), (1, True), (2, True), (3, True), (4, True)]
DECODERS = ["ouster", "livox", "at128", *MODELS]


def damaged(packet: bytes, rng: np.random.Generator, n: int = N_PACKETS) -> NDArray[np.uint8]:
    """Copies of a packet, each with another share of its bytes replaced: none to all."""
    noise, chance = np.frombuffer(rng.bytes(2 * n * len(packet)), np.uint8).reshape(2, n, -1)
    share = rng.choice(np.array([0, 1, 5, 80, 255], np.uint8), (n, 1))
    return np.where(chance < share, noise, np.frombuffer(packet, np.uint8))


class Packets:
    """The kind ``packets``."""

    name, limit_s, limit_mb = "packets", LIMIT_S, LIMIT_MB

    def __init__(self) -> None:
        self.ouster = []
        for profile in PROFILES:
            content = changed(lidar_data_format__udp_profile_lidar=profile)
            layout = layout_of(content)
            packet = bytearray(layout.packet_bytes)
            for k in range(16):
                at = layout.places[0] + k * layout.places[2]
                packet[at + 8], packet[at + layout.places[3]] = k, 1
            self.ouster.append((content, layout, bytes(packet)))
        points = np.tile([[10.0, -3.0, 1.0]], (200, 1))
        self.livox = [livox_packets(kind, points, np.arange(200), is_old)[0] for kind, is_old in LIVOX]
        self.spinning: dict[str, tuple[Format, Angles, bytes]] = {}
        for name, model in MODELS.items():
            packet = packets_of(model, blocks_of(model, *ranges(model, 2 * model.blocks)))[0]
            row = format_of(memoryview(packet))
            assert row is not None
            self.spinning[name] = (row if name == "ot128" else FORMATS[name], Angles(unit_angles(model)), packet)
        blocks = np.full((2, 128), 7)
        self.mirrors = at128_packets([0, 9 * 10**6], blocks, blocks)[0]
        for decoder in DECODERS:  # compiles
            self.decode(Case("packets", 0, 0, None, np.random.default_rng(0)), decoder)  # type: ignore[arg-type]

    def run(self, case: Case) -> str:
        if case.chance(0.02):
            return self.text(case)
        decoder = DECODERS[case.index % len(DECODERS)]
        return f"{decoder}: {'answer' if self.decode(case, decoder) else 'no point'}"

    def decode(self, case: Case, decoder: str) -> int:
        if decoder == "ouster":
            return self.of_ouster(case)
        if decoder == "at128":
            return self.of_mirrors(case)
        return self.of_livox(case) if decoder == "livox" else self.of_spinning(case, decoder)

    def of_mirrors(self, case: Case) -> int:
        """With a correction of any numbers that a file can hold."""
        words = case.rng.integers(-(2**31), 2**31, (2, 128 + 2))
        begins, ends = case.pick([words[:, :2], np.array([[0, 5 * 10**6], [5 * 10**6, 9 * 10**6]])])
        off = 255 * 256 * case.rng.integers(-128, 128, (2, 128, 180))
        stream = MirrorStream(FORMATS["at128"], Mirrors(begins.tolist(), ends.tolist(), words[:, 2:], off))
        table = [memoryview(each.tobytes()) for each in damaged(self.mirrors, case.rng)[:THROUGH_STREAM]]
        scans = [scan for each in table if format_of(each) is FORMATS["at128"] for scan in stream.add(each)]
        check_scans([*scans, *stream.end()])
        return sum(len(scan.points) for scan in scans)

    def of_ouster(self, case: Case) -> int:
        _, layout, packet = case.pick(self.ouster)
        table = damaged(packet, case.rng)
        width = int(case.pick([1, 16, 512, 65536]))
        values, stamps_ns = np.zeros((2, len(ANGLES), width), np.uint32), np.zeros(width, np.uint64)
        fields = np.array([layout.fields["RANGE"], layout.fields["REFLECTIVITY"]], np.int64)
        fill_turn(table, np.array(layout.places), fields, values, stamps_ns)
        check(values.max() < 1 << 20, "a value of more bits than its field has")
        stream = OusterStream(layout, case.pick([None, "reflectivity", "range"]))
        scans = [scan for row in table[:THROUGH_STREAM] for scan in stream.add(row.tobytes())]
        check_scans([*scans, *stream.end()])
        return int(values.any())

    def of_livox(self, case: Case) -> int:
        k = int(case.rng.integers(len(LIVOX)))
        table = damaged(self.livox[k], case.rng)
        stream, scans = LivoxStream(), list[Any]()
        for row in table[:THROUGH_STREAM]:
            packet = points_of(memoryview(row.tobytes()))
            scans += [] if packet is None else stream.add(packet)
        check_scans([*scans, *stream.end()])
        whole = points_of(memoryview(self.livox[k]))
        content = np.ascontiguousarray(table[:, -len(whole.content) :]).ravel()
        n = len(content) // whole.kind.stride
        points, which = np.empty((n, 4), np.float32), np.empty(n, np.int64)
        found = fill_points(content, whole.kind.stride, whole.kind.layout, points, which)
        check(np.isfinite(points[:found]).all() and (np.diff(which[:found]) > 0).all(), "points that are none")
        return found

    def of_spinning(self, case: Case, name: str) -> int:
        row, angles, packet = self.spinning[name]
        rng, table = case.rng, damaged(packet, case.rng)
        stream, scans = SpinningStream(row, angles), list[Any]()
        for each in table[:THROUGH_STREAM]:
            payload = memoryview(each.tobytes())
            name_of(payload)
            if format_of(payload) in (row, FORMATS["helios-32"] if name == "helios-16" else row):
                scans += stream.add(payload)
        check_scans([*scans, *stream.end()])
        blocks = rng.choice([0.0, 10.0, 10.2, 359.9, np.nan, np.inf, -1e9, 1e18], (len(table), row.n_blocks, 3))
        beams = rng.normal(size=(row.n_blocks, row.n_channels, 3))
        back = case.pick([(1, 0), (2, 0), (1, row.n_channels // 2)])
        places = (row.header, row.block_bytes, row.first, row.channel_bytes, int(rng.integers(2)), row.mask, *back)
        points = np.empty((blocks[..., 0].size * row.n_channels, 4), np.float32)
        times_s = np.empty(len(points))
        found = fill_returns(table, np.array(places), blocks, beams, rng.random(4), points, times_s)
        check(np.isfinite(points[:found]).all(), "points that are not finite")
        return found

    def text(self, case: Case) -> str:
        """What says how packets are read: metadata, calibrations, and RoboSense's other packets."""
        model = case.pick([*MODELS.values()])
        case.folder.joinpath("a.csv").write_bytes(mutated_bytes(calibration(unit_angles(model)).encode(), case, 6))
        correction = at128_correction([0], [10**6], np.zeros((2, 128), np.int64), np.zeros((2, 128, 180), np.int8))
        case.folder.joinpath("a.dat").write_bytes(mutated_bytes(correction, case, 6))
        content, *_ = case.pick(self.ouster)
        document = mutated_json(content, case)
        case.evidence["metadata.json"] = document
        said = angles_of_difop(
            FORMATS[model.name], memoryview(mutated_bytes(difop(model, unit_angles(model)), case, 8))
        )
        check(said is None or (np.abs(said.lasers_deg) <= 90.0).all(), "angles beyond 90 degrees")
        outcomes = []
        for read in (
            lambda: read_angles(case.folder / "a.csv", FORMATS[model.name]),
            lambda: read_mirrors(case.folder / "a.dat"),
            lambda: OusterStream(layout_of(json.loads(document)), None),
        ):
            try:
                read()
                outcomes.append("answer")
            except PointsError:
                outcomes.append("PointsError")
            except (ValueError, RecursionError):  # not JSON, which is found before
                outcomes.append("no JSON")
        return f"text: {', '.join(outcomes)}"


def check_scans(scans: list[Any]) -> None:
    """Raise `Failure` unless each is a scan."""
    for stamp_s, points, times_s in scans:
        check(isinstance(stamp_s, float) and np.isfinite(stamp_s), f"a stamp of {stamp_s!r}")
        check(points.dtype == np.float32 and points.shape == (len(times_s), 4), f"shape {points.shape}")
        check(np.isfinite(points).all() and np.isfinite(times_s).all(), "values that are not finite")


def make(seed: int) -> Packets:
    return Packets()
