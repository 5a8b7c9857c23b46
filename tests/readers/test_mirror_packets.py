"""Packets of Hesai's AT128: what is written is read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_writers import check_same, let_overtake, write_pcap
from hypothesis import given, settings
from hypothesis import strategies as st
from lidar_writers import T0_S, at128_correction, at128_packets
from test_packet_messages import Driver, mcap_of

from edgeperc import PointsError, read_timed_scans, sensor_of
from edgeperc.readers.mirror_packets import MirrorStream, read_mirrors
from edgeperc.readers.spinning_packets import FORMATS, format_of
from edgeperc.types.sensor import SENSORS

pytestmark = pytest.mark.usefixtures("in_this_process")

DEGREE = 25_600
BEGINS, ENDS = [30 * DEGREE, 150 * DEGREE, 270 * DEGREE + 7], [95 * DEGREE, 215 * DEGREE, 335 * DEGREE]
# When the lasers of the manual fire [us]: the first eight and the last two.
FIRST_US, LAST_US = (0.0, 0.0, 8.24, 4.112, 4.144, 8.24, 0.0, 0.0), (12.376, 8.264)


def unit(seed: int = 0) -> tuple[Any, Any]:
    """The lasers of a unit, and their corrections."""
    rng = np.random.default_rng(seed)
    lasers = np.stack([rng.integers(-5 * DEGREE, 5 * DEGREE, 128), np.linspace(-12, 12, 128).astype(np.int64) * DEGREE])
    return lasers, rng.integers(-128, 128, (2, 128, 180)).astype(np.int8)


def drawn(motor: list[int], seed: int = 1) -> tuple[Any, Any]:
    rng = np.random.default_rng(seed)
    units = rng.integers(200, 50_000, (len(motor), 128))
    units[rng.random(units.shape) < 0.3] = 0
    return units, rng.integers(0, 256, units.shape)


def expected(motor: list[int], units: Any, remission: Any, lasers: Any, off: Any) -> list[Any]:
    """x, y, z, reflectivity, mirror and block of each return, one after the other, as the maker's driver has them."""
    rows = []
    for b, angle in enumerate(motor):
        mirrors = [k for k in range(3) if BEGINS[k] <= angle <= ENDS[k]]
        for laser in range(128 if mirrors else 0):
            if units[b, laser] == 0:
                continue
            step, rest = divmod(angle, 2 * DEGREE)
            near, far = (256.0 * off[:, laser, (step + k) % 180] for k in (0, 1))
            moved = near + (far - near) * rest / (2 * DEGREE)
            azimuth = np.radians((2 * (angle - BEGINS[mirrors[0]]) - lasers[0, laser] + moved[0]) / DEGREE)
            elevation = np.radians((lasers[1, laser] + moved[1]) / DEGREE)
            meters = 0.004 * units[b, laser]
            x, y = meters * np.cos(elevation) * np.sin(azimuth), meters * np.cos(elevation) * np.cos(azimuth)
            rows.append((x, y, meters * np.sin(elevation), remission[b, laser], mirrors[0], b))
    return rows


def sweep(mirror: int, n: int = 40) -> list[int]:
    """The motor's angles while one mirror sweeps a part of what it sees."""
    return [BEGINS[mirror] + 12_345 * k for k in range(n)]


@pytest.mark.parametrize("numbered", [True, False])
def test_what_is_written_is_read(tmp_path: Path, numbered: bool) -> None:
    """A frame for each mirror; what is between them is left out; a bag's packets are those of a capture."""
    motor = [*sweep(0, 41), BEGINS[1] - 900, *sweep(1), *sweep(2), *sweep(0, 10)]
    (lasers, off), (units, remission) = unit(), drawn(motor)
    packets = at128_packets(motor, units, remission, numbered=numbered)
    path = write_pcap(tmp_path / "drive.pcap", packets)
    (tmp_path / "drive_correction.dat").write_bytes(b"\0junk" * 3 + at128_correction(BEGINS, ENDS, lasers, off))
    scans = [*read_timed_scans(path)]
    rows = expected(motor, units, remission, lasers, off)
    assert [len(scan.points) for scan in scans] == [
        sum(a <= row[5] < b for row in rows) for a, b in ((0, 41), (42, 82), (82, 122), (122, 132))
    ]
    np.testing.assert_allclose(np.concatenate([scan.points for scan in scans]), [row[:4] for row in rows], atol=3e-5)
    times_s = np.concatenate([scan.times_s for scan in scans])
    blocks = np.array([row[5] for row in rows])
    first = times_s[np.searchsorted(blocks, np.unique(blocks))]
    assert (np.abs(first - T0_S - 41.666e-6 * (np.unique(blocks) - 1) + 50.915e-6) < 17e-6).all()
    assert format_of(memoryview(packets[0])) is FORMATS["at128"]
    for us, given_us in ((FIRST_US, FORMATS["at128"].fires_us[:8]), (LAST_US, FORMATS["at128"].fires_us[-2:])):
        np.testing.assert_allclose(given_us, us)
    driver = Driver("hesai_ros_driver", 2)
    sent = [driver.message(packets[k : k + 9], k) for k in range(0, len(packets), 9)]
    bag = mcap_of(tmp_path / "drive.mcap", [("/packets", driver.kind, "cdr", sent)])
    assert check_same(read_timed_scans(bag), scans, clock=False) == 4
    for source in (path, bag):
        assert sensor_of(source) is SENSORS["at128"]
    assert len([*read_timed_scans(let_overtake(path, 0))]) == 4


def test_of_two_returns_both_are_points_unless_they_are_equal(tmp_path: Path) -> None:
    motor = [angle for angle in sweep(1) for _ in (0, 1)]
    (lasers, off), (units, remission) = unit(), drawn(motor)
    units[1::2, ::3] = units[::2, ::3]
    path = write_pcap(tmp_path / "drive.pcap", at128_packets(motor, units, remission))
    (tmp_path / "drive.dat").write_bytes(at128_correction(BEGINS, ENDS, lasers, off))
    (scan,) = read_timed_scans(path)
    units[1::2][units[1::2] == units[::2]] = 0
    rows = expected(motor, units, remission, lasers, off)
    np.testing.assert_allclose(scan.points, [row[:4] for row in rows], atol=3e-5)
    assert scan.times_s is not None
    packet = np.array([row[5] // 2 for row in rows])
    late_us = 1e6 * (scan.times_s - T0_S) - 83.332 * packet  # both returns are of one pulse
    assert -53.0 < late_us.min() < late_us.max() < -34.0  # the clock counts microseconds


def test_a_resolution_scales_the_angles(tmp_path: Path) -> None:
    lasers, off = unit()
    read = []
    for resolution in (1, 3):
        path = tmp_path / f"{resolution}.dat"
        path.write_bytes(
            at128_correction([each // 3 * 3 // resolution for each in BEGINS], ENDS, lasers, off, resolution)
        )
        read.append(read_mirrors(path))
    np.testing.assert_array_equal(read[0].begins, read[1].begins)
    for one, three in ((read[0].lasers, read[1].lasers), (read[0].off, read[1].off), (read[0].ends, read[1].ends)):
        np.testing.assert_array_equal(3 * np.array(one), three)


WHOLE = at128_correction(BEGINS, ENDS, *unit())


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, r"where the lasers of this Hesai AT128 look is not known. Put .* beside it, as drive\.dat"),
        (b"", "not a correction file of a Hesai AT128: it begins with 00 00"),
        (b"Laser id,Elevation,Azimuth\n1,2,3\n", "not a correction file of a Hesai AT128: it begins with 4c 61 73"),
        (WHOLE[:3] + b"\3" + WHOLE[4:], "it begins with ee ff 01 03 80 03 03 .* expected ee ff 01 05 80"),
        (WHOLE[:15] + b"\0" + WHOLE[16:], "1 to 8 mirrors and a resolution"),
        (WHOLE[:6] + b"\x09" + WHOLE[7:], "1 to 8 mirrors and a resolution"),
        (WHOLE[:-1], r"drive\.dat has 47,143 bytes of 47,144; it is cut short"),
    ],
)
def test_what_is_missing_for_a_unit_is_said(tmp_path: Path, content: bytes | None, message: str) -> None:
    motor = sweep(0, 4)
    path = write_pcap(tmp_path / "drive.pcap", at128_packets(motor, *drawn(motor)) * 20)
    if content is not None:
        (tmp_path / "drive.dat").write_bytes(content)
    with pytest.raises(PointsError, match=message):
        next(read_timed_scans(path))


@settings(max_examples=50)
@given(data=st.data())
def test_damaged_packets_and_corrections_give_points_or_none(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    def damaged(whole: bytes, first: int) -> bytes:
        content = bytearray(whole)
        for at in data.draw(st.lists(st.integers(first, len(whole) - 1), max_size=8)):
            content[at] = data.draw(st.integers(0, 255))
        return bytes(content)

    motor = [*sweep(0, 4), *sweep(2, 3), 359 * DEGREE]
    path = tmp_path_factory.mktemp("unit") / "a.dat"
    path.write_bytes(damaged(WHOLE, 15))
    try:
        stream = MirrorStream(FORMATS["at128"], read_mirrors(path))
    except PointsError:
        return
    scans = []
    for packet in at128_packets(motor, *drawn(motor)):
        scans += stream.add(memoryview(damaged(packet, 0)))
    scans += stream.end()
    for scan in scans:
        assert scan.times_s is not None
        assert len(scan.times_s) == len(scan.points) <= 128 * len(motor)
        assert np.isfinite(scan.points).all()
        assert np.isfinite(scan.times_s).all()
