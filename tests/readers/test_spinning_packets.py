"""Hesai's and RoboSense's packets: what is written is read, from captures of simulated ranges."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_writers import check_same, join, let_overtake, vlp16_packets, write_link, write_pcap
from hypothesis import given, settings
from hypothesis import strategies as st
from lidar_writers import MODELS, T0_S, Model, blocks_of, calibration, difop, expected, packets_of, ranges, unit_angles
from numpy.typing import NDArray
from test_captures import check_beside, check_told_apart, error_of

import twins.packets
from edgeperc import PointsError, read_timed_scans, sensor_of
from edgeperc.readers import spinning_packets

pytestmark = pytest.mark.usefixtures("in_this_process")


def us_of(text: str) -> NDArray[np.float64]:
    return np.array([float(us) for us in text.split()])


# When the channels of a block fire [us], by the makers' manuals; others are not stated, and count as one moment.
# Of the Ruby Plus: of each four channels of the 128, and of those of the 80 that are not 80V.
PLUS_US = us_of(
    "0 1.217 2.434 3.652 4.869 6.086 7.304 8.521 9.739 11.323 12.907 14.924 16.941 18.959 20.976 23.127 25.278 27.428 "
    "29.579 31.963 34.347 36.498 38.648 40.666 42.683 44.267 45.851 47.435 49.019 50.603 52.187 53.771"
)
PLUS_80_US = us_of(
    "0 0 0 0 1.217 1.217 1.217 1.217 2.434 2.434 3.652 3.652 3.652 4.869 4.869 6.086 6.086 7.304 7.304 8.521 8.521 "
    "9.739 9.739 11.323 11.323 12.907 12.907 14.924 14.924 16.941 16.941 16.941 16.941 18.959 18.959 18.959 18.959 "
    "20.976 20.976 20.976 20.976 23.127 23.127 23.127 23.127 25.278 25.278 25.278 25.278 27.428 27.428 27.428 27.428 "
    "29.579 29.579 29.579 29.579 31.963 31.963 31.963 31.963 34.347 34.347 34.347 34.347 36.498 36.498 36.498 36.498 "
    "38.648 38.648 40.666 40.666 42.683 50.603 52.187 52.187 52.187 53.771 53.771"
)
JT128_US = us_of(
    "95.18 23.24 98.22 20.2 101.26 17.16 104.3 14.12 77.28 92.14 74.24 89.1 71.2 86.06 68.16 83.02 50.26 11.08 47.22 "
    "8.04 44.18 5 41.14 1.96 65.12 105.82 62.08 102.78 59.04 99.74 56 96.7 38.1 24.76 35.06 21.72 32.02 18.68 28.98 "
    "15.64 78.8 93.66 75.76 90.62 72.72 87.58 69.68 84.54 51.78 12.6 48.74 9.56 45.7 6.52 42.66 3.48 66.64 103.54 "
    "63.6 100.5 60.56 97.46 57.52 94.42 39.62 22.48 36.58 19.44 33.54 16.4 30.5 13.36 76.52 91.38 73.48 88.34 70.44 "
    "85.3 67.4 82.26 49.5 10.32 46.46 7.28 43.42 4.24 40.38 1.2 64.36 105.06 61.32 102.02 58.28 98.98 55.24 95.94 "
    "37.34 24 34.3 20.96 31.26 17.92 28.22 14.88 78.04 92.9 75 89.86 71.96 86.82 68.92 83.78 51.02 11.84 47.98 8.8 "
    "44.94 5.76 41.9 2.72 65.88 62.84 59.8 56.76 38.86 35.82 32.78 29.74"
)
FIRES_US: dict[str, Any] = {
    "jt128": JT128_US,
    "ruby-plus-128": PLUS_US[np.arange(128) // 4],
    "ruby-plus-80": PLUS_80_US,
    "ruby-plus-80v": PLUS_US[np.arange(80) // 4],
    "ruby-plus-48": PLUS_US[np.arange(48) // 2],
    "pandarxt-32": 6 + 1.512 * np.arange(32),
    "pandarxt-16": 6 + 3.024 * np.arange(16),
    "pandarxt-32m": 6 + 2.888 * (np.arange(32) % 16),
    "rs-16": np.concatenate([2.8 * np.arange(16), 55.5 + 2.8 * np.arange(16)]),
    "helios-16": np.concatenate([1.73 * np.arange(16), 55.56 + 1.73 * np.arange(16)]),
    "rs-bpearl-4": 1.668 * np.arange(32),
    "helios-32": 1.73 * np.arange(32),
    "rs-ruby-128": 3.236 * (np.arange(128) // 4 % 16),
}
LENS_M = {
    "rs-16": (0.03977, 0.0), "rs-32": (0.04142, 0.0), "rs-bpearl": (0.01701, 0.09427),
    "rs-bpearl-4": (0.01829, 0.09571), "helios-32": (0.03806, 0.0), "helios-16": (0.03806, 0.0),
    "rs-airy": (0.01143, 0.06056), "rs-airy-48": (0.01143, 0.06056), "rs-ruby-80": (0.03995, 0.0),
    "rs-ruby-128": (0.03995, 0.0), **{f"ruby-plus-{series}": (0.03171, 0.0) for series in ("128", "80", "80v", "48")},
}  # fmt: skip


def fires_of(model: Model) -> NDArray[np.float64]:
    """(blocks, channels); of the models without a formula above, as the table has them."""
    given_us = np.asarray(FIRES_US.get(model.name, spinning_packets.FORMATS[model.name].fires_us))
    if model.second == "lasers":
        return np.stack([given_us[48 * (k % 2) :][:48] for k in range(model.blocks)])
    return np.broadcast_to(given_us, (model.blocks, model.channels))


def capture(folder: Path, model: Model, n_columns: int, **options: Any) -> tuple[Path, list[tuple[int, Any, Any]]]:
    """A capture with what says its angles, and the blocks in it."""
    angles = unit_angles(model)
    blocks = blocks_of(model, *ranges(model, n_columns), **options)
    packets = packets_of(model, blocks)
    path = folder / "drive.pcap"
    if model.layout == ">":
        packets.insert(len(packets) // 2, difop(model, angles))
    elif not model.name.startswith("pandarxt"):
        path.with_suffix(".csv").write_text(calibration(angles))
    return write_pcap(path, packets), blocks[: len(blocks) // model.blocks * model.blocks]


@pytest.mark.parametrize("model", MODELS.values(), ids=[*MODELS])
def test_what_is_written_is_read(tmp_path: Path, model: Model) -> None:
    """A quarter of a turn: each return, in order, with its range and reflectivity to the bit."""
    n = round(90 / model.step_deg) * (2 if model.second == "firing" else 1)
    path, blocks = capture(tmp_path, model, n)
    (scan,) = list(read_timed_scans(path))
    wanted = expected(model, blocks, unit_angles(model), fires_of(model), LENS_M.get(model.name, (0.0, 0.0)))
    assert scan.points.shape == wanted.shape
    np.testing.assert_array_equal(scan.points[:, 3], wanted[:, 3])
    np.testing.assert_allclose(scan.points, wanted, atol=2e-5)
    if model.name not in LENS_M:  # the range in units is a whole number again
        units = np.concatenate([units[units > 0] for _, units, _ in blocks])
        read = np.linalg.norm(scan.points[:, :3].astype(np.float64), axis=1) / model.unit_m
        np.testing.assert_array_equal(np.round(read).astype(np.int64), units)
    assert scan.stamp_s == scan.times_s.max()
    assert T0_S - 0.0021 < scan.times_s.min() < scan.times_s.max() < T0_S + 1.0
    sensor = sensor_of(path)
    assert sensor.name == model.name
    assert sensor.elevations_deg == tuple(sorted(unit_angles(model)[:, 0].tolist(), reverse=True))
    assert sensor.columns == round(360 / model.step_deg) * (2 if model.second == "firing" else 1)


@pytest.mark.parametrize("name", ["ruby-plus-48", "rs-ruby-128"])
def test_a_second_begins_with_a_millisecond_in_either_unit(tmp_path: Path, name: str) -> None:
    """Nanoseconds, and, of an RS-Ruby, microseconds."""
    model = MODELS[name]
    path, _ = capture(tmp_path, model, 450)
    (scan,) = read_timed_scans(path)
    assert scan.times_s is not None
    assert scan.times_s.max() - scan.times_s.min() < 0.1


def test_each_of_several_sensors_has_its_own_calibration(tmp_path: Path) -> None:
    """The angles of one were those of the other, too, whose packets are alike."""
    sent = {}
    for name, address in (("ot128", "192.168.1.201"), ("jt128", "192.168.1.202")):
        model = MODELS[name]
        packets = packets_of(model, blocks_of(model, *ranges(model, round(90 / model.step_deg))))
        sent[address] = write_link(tmp_path / f"{name}.pcap", 1, packets, one=address)
        (tmp_path / f"{name}.csv").write_text(calibration(unit_angles(model)))
    both = join(tmp_path / "both.pcap", sent.values())
    assert "as both_192.168.1.202.csv" in error_of(both, topic="192.168.1.202")
    (tmp_path / "both.csv").write_text(calibration(unit_angles(MODELS["jt128"])) + "d41d8cd98f00b204e9800998ecf8427e\n")
    for address in sent:
        said = error_of(both, topic=address)
        assert f"both.csv does not say of which sensor it is, {' or '.join(sent)}" in said
        assert f"as both_{address}.csv" in said
    for address, alone in sent.items():
        (tmp_path / f"both_{address}.csv").write_text(alone.with_suffix(".csv").read_text())
    check_told_apart(both, sent)
    (tmp_path / "both.csv").unlink()
    (tmp_path / "both_192.168.1.202.csv").unlink()
    assert "are not known" in error_of(both, topic="192.168.1.202")  # that of another one is not taken


@pytest.mark.parametrize("name", ["pandarxt-16", "pandar64", "rs-16", "rs-airy", "helios-32"])
def test_turns_begin_where_the_azimuth_does(tmp_path: Path, name: str) -> None:
    model = MODELS[name]
    per_turn = round(360 / model.step_deg) * (2 if model.second == "firing" else 1)
    path, blocks = capture(tmp_path, model, int(2.5 * per_turn), first_deg=90.0)
    scans = list(read_timed_scans(path))
    azimuths = np.array([azimuth for azimuth, _, _ in blocks])
    ends = [0, *(np.flatnonzero(np.diff(azimuths) < 0) + 1), len(blocks)]
    assert len(scans) == len(ends) - 1 == 3
    for scan, begin, end in zip(scans, ends[:-1], ends[1:], strict=True):
        assert len(scan.points) == sum(int((units > 0).sum()) for _, units, _ in blocks[begin:end])
    assert [scan.stamp_s for scan in scans] == sorted(scan.stamp_s for scan in scans)  # type: ignore[type-var]
    for first in (0, 1):
        assert len(late := [scan.points for scan in read_timed_scans(let_overtake(path, first))]) == 3
        assert sum(map(len, late)) == sum(len(scan.points) for scan in scans)


def test_times_go_on_within_a_packet(tmp_path: Path) -> None:
    """0.18 degrees at 10 turns a second are 50 us; the XT states the time of its last block, others of the first."""
    for name, index, late_us in (("pandarxt-32", -1, 6.0), ("helios-32", 0, 0.0), ("jt128", -1, 95.18 - 1888.0)):
        model = MODELS[name]
        units = np.full((model.blocks, model.lasers), 1000)
        folder = tmp_path / name
        folder.mkdir()
        said = [difop(model, unit_angles(model))] if model.layout == ">" else []
        (folder / "a.csv").write_text(calibration(unit_angles(model)))
        path = write_pcap(folder / "a.pcap", said + packets_of(model, blocks_of(model, units, units % 256)))
        (scan,) = list(read_timed_scans(path))
        firsts = scan.times_s.reshape(model.blocks, model.lasers)[:, 0]
        np.testing.assert_allclose(np.diff(firsts), model.step_deg / 3600, atol=1e-6)
        assert firsts[index] == pytest.approx(T0_S + 1e-6 * late_us, abs=1e-6)


@pytest.mark.parametrize("name", ["pandar64", "pandarxt-32", "rs-32", "helios-32"])
def test_a_second_return_is_left_out_where_it_is_the_first(tmp_path: Path, name: str) -> None:
    """As of a Velodyne: both returns, and one of two equal ones."""
    model = MODELS[name]
    units, remission = ranges(model, 60)
    other = np.where(np.arange(model.lasers) % 3 == 0, units, units // 2)
    single = blocks_of(model, units, remission)
    second = blocks_of(model, other, remission)
    blocks = [block for pair in zip(single, second, strict=True) for block in pair]
    path, _ = capture(tmp_path, model, model.blocks)
    packets = packets_of(model, blocks)
    write_pcap(path, [*packets, difop(model, unit_angles(model))] if model.layout == ">" else packets)
    (scan,) = list(read_timed_scans(path))
    used = len(packets) * model.blocks // 2
    wanted = (units[:used] > 0).sum() + ((other[:used] != units[:used]) & (other[:used] > 0)).sum()
    assert len(scan.points) == wanted


def test_the_returns_of_an_rs_16_are_in_one_block(tmp_path: Path) -> None:
    model = MODELS["rs-16"]
    units, remission = ranges(model, 240)
    units[1::2] = np.where(np.arange(16) % 2 == 0, units[::2], units[::2] // 2)
    blocks = blocks_of(model, units, remission)
    path = write_pcap(tmp_path / "a.pcap", [difop(model, unit_angles(model), is_dual=True), *packets_of(model, blocks)])
    (scan,) = list(read_timed_scans(path))
    firsts, seconds = units[::2], units[1::2]
    assert len(scan.points) == (firsts > 0).sum() + ((seconds != firsts) & (seconds > 0)).sum()


@pytest.mark.parametrize(
    ("name", "title"),
    [
        ("pandar40p", "Hesai Pandar40P"),
        ("pandarqt-64", "Hesai PandarQT-64"),
        ("jt128", "Hesai OT128 or Hesai JT128"),
        ("rs-16", "RoboSense RS-LiDAR-16"),
        ("helios-32", "RoboSense RS-Helios or RoboSense RS-Helios-16P"),
        ("rs-airy", "RoboSense Airy"),
    ],
)
def test_without_angles_it_says_what_is_missing(tmp_path: Path, name: str, title: str) -> None:
    model = MODELS[name]
    blocks = blocks_of(model, *ranges(model, 2 * model.blocks))
    path = write_pcap(tmp_path / "drive.pcap", packets_of(model, blocks))
    error = error_of(path)
    assert f"the angles of the lasers of this {title} are not known" in error
    assert "drive.csv" in error
    assert ("DIFOP" in error) == (model.layout == ">")
    (tmp_path / "drive_angles.csv").write_text(calibration(unit_angles(model)))
    assert len(list(read_timed_scans(path))) == 1
    (tmp_path / "drive_angles.csv").write_text(calibration(unit_angles(model)[1:]))
    assert f"has {model.lasers - 1} rows" in error_of(path)


def test_which_angles_are_used(tmp_path: Path) -> None:
    """RoboSense's own, whatever lies beside; of a PandarXT those of the file, if there is one."""
    path, _ = capture(tmp_path, MODELS["rs-32"], 24)
    own = [*read_timed_scans(path)]
    path.with_suffix(".csv").write_text("x,y,z\n1,2,3\n")
    check_same(read_timed_scans(path), own)
    model = MODELS["pandarxt-16"]
    path, _ = capture(tmp_path, model, 24)
    (tmp_path / "drive.csv").write_text(calibration(unit_angles(model) + np.array([0.25, 1.0])))
    sensor = sensor_of(path)
    assert sensor.elevations_deg[0] == 15.25
    for other in ("drive-2.csv", "drive+2.csv", "drive2.csv"):  # of other captures
        (tmp_path / other).write_text(calibration(unit_angles(model)))
    assert sensor_of(path) == sensor


@pytest.mark.parametrize(
    ("text", "n"),
    [("", 0), ("a,b\n", 0), ("Channel,Elevation,Azimuth\n1,2\n", 1), ("1,nan,0\n" * 40, 40), ("\0\xff" * 99, 0)],
)
def test_calibrations_that_are_none(tmp_path: Path, text: str, n: int) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(PointsError, match=rf"a\.csv has {n} rows .*expected 40"):
        spinning_packets.read_angles(path, spinning_packets.FORMATS["pandar40p"])


@pytest.mark.parametrize("name", ["pandarxt-16", "pandarxt-32", "rs-16", "helios-32"])
def test_a_velodyne_beside_another_sensor_is_told_apart(tmp_path: Path, name: str) -> None:
    model, angles = MODELS[name], unit_angles(MODELS[name])
    packets = packets_of(model, blocks_of(model, *ranges(model, 128)))
    if not name.startswith("pandar"):
        packets = [difop(model, angles), *packets]
    check_beside(tmp_path, {"10.0.0.9": ("10.0.0.9", vlp16_packets(2.0)[:110]), "10.0.0.1": ("10.0.0.1", packets)})


@pytest.mark.parametrize(("name", "other"), [("pandarxt-16", "10.0.0.2"), ("pandarxt-32", "10.0.0.1:2369")])
def test_a_sensor_that_begins_late_is_left_out_with_a_warning(tmp_path: Path, name: str, other: str) -> None:
    model = MODELS[name]
    packets = packets_of(model, blocks_of(model, *ranges(model, 64))) * 300
    path = write_link(tmp_path / "two.pcap", 1, packets, begin=2100, one="10.0.0.1:2368", two=other)
    with pytest.warns(UserWarning, match=r"those of the first sensor alone; .* several, 10.*, 10.*--topic"):
        scans = list(read_timed_scans(path))
    check_same(scans, read_timed_scans(write_link(tmp_path / "one.pcap", 1, packets)), clock=False)


OTHERS = [
    ("Hesai JT16", bytes.fromhex("eeff01080000") + bytes(800)),
    ("Hesai ATX", bytes.fromhex("eeff0407000080020004017f") + bytes(1106)),
    ("Hesai QT128", bytes.fromhex("eeff03020000800300040107") + bytes(1115)),
    ("Hesai XT", bytes.fromhex("eeff06010000200500040101") + bytes(808)),
    ("Hesai Pandar20", b"\xee\xff\x14\x14\0\x04" + bytes(1264)),
    ("Hesai sensor of 99 lasers (version 9.9", bytes.fromhex("eeff09090000630200040101") + bytes(808)),
    ("RoboSense RS-Ruby", bytes.fromhex("55aa050a5aa550a0") + bytes(22) + b"\x04" + bytes(1217)),
    ("RoboSense sensor", bytes.fromhex("55aa055a") + bytes(27) + b"\x05\x09" + bytes(47)
     + b"\xfe".ljust(388, b"\0") * 3 + bytes(4)),
    ("RoboSense sensor", bytes.fromhex("55aa050a5aa550a0") + bytes(1240)),  # MSOP of the RS-16 and RS-32
    ("RoboSense sensor", bytes.fromhex("55aa055a") + bytes(1206)),
    ("Livox sensor", bytes(1380)),
    ("Livox sensor", b"\0" + struct.pack("<H", 1380) + bytes(1377)),  # 96 points of 14 bytes behind 36
    ("Livox sensor", b"\0" + struct.pack("<H", 804) + bytes(801)),  # 96 points of 8 bytes
    ("Livox sensor", b"\0" + struct.pack("<H", 1380) + bytes(7) + b"\x09" + bytes(1369)),  # of another type
]  # fmt: skip


@pytest.mark.parametrize(("name", "packet"), OTHERS)
def test_models_that_are_not_decoded_are_named(tmp_path: Path, name: str, packet: bytes) -> None:
    path = write_pcap(tmp_path / "other.pcap", [b"gps".ljust(512), *[packet] * 20])
    for read in (sensor_of, lambda file: next(read_timed_scans(file))):
        with pytest.raises(PointsError, match=rf"other\.pcap: a capture of a {re.escape(name)}") as caught:
            read(path)
        assert ", which cannot be decoded" in str(caught.value)
        assert f"Convert it with {name.split()[0]}'s driver" in str(caught.value)


@pytest.mark.parametrize("model", MODELS.values(), ids=[*MODELS])
def test_formats_are_told_apart(model: Model) -> None:
    (packet, *_) = packets_of(model, blocks_of(model, *ranges(model, 2 * model.blocks)))
    row = spinning_packets.format_of(memoryview(packet))
    # Which the angles tell apart.
    same = {"helios-16": "helios-32", "jt128": "ot128"}.get(model.name, model.name)
    assert row.name == same
    assert spinning_packets.name_of(memoryview(packet)) == spinning_packets.FORMATS[same].title
    for cut in (0, 5, 30, len(packet) // 2, len(packet) - 30):
        assert spinning_packets.format_of(memoryview(packet[:cut])) is None


@settings(max_examples=60)
@given(st.sampled_from([*MODELS]), st.integers(0, 4), st.integers(0, 2**31))
def test_the_kernel_as_its_slow_twin(name: str, n_packets: int, seed: int) -> None:
    """On any bytes, and blocks that are not finite."""
    row, rng = spinning_packets.FORMATS[name], np.random.default_rng(seed)
    size = row.header + row.n_blocks * row.block_bytes
    packets = rng.integers(0, 4, (n_packets, size)).astype(np.uint8)
    blocks = rng.choice([0.0, 10.0, 10.2, 359.0, np.nan, np.inf, 1e9], (n_packets, row.n_blocks, 3))
    beams = rng.normal(size=(row.n_blocks, row.n_channels, 3))
    lens = np.array([0.004, rng.choice([0.0, 90.0]), 0.04, 0.09])
    back = [(1, 0), (2, 0), (1, row.n_channels // 2)][int(rng.integers(3))]
    places = (row.header, row.block_bytes, row.first, row.channel_bytes, int(rng.integers(2)), row.mask, *back)
    points = np.full((n_packets * row.n_blocks * row.n_channels, 4), 7.0, np.float32)
    times_s = np.full(len(points), 7.0)
    n = spinning_packets.fill_returns(packets, np.array(places), blocks, beams, lens, points, times_s)
    wanted, wanted_s = twins.packets.spinning_returns(packets, places, blocks, beams, lens)
    assert n == len(wanted)
    np.testing.assert_allclose(points[:n], wanted, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(times_s[:n], wanted_s, rtol=1e-12, atol=1e-9)
    assert (points[n:] == 7.0).all()


@settings(max_examples=80)
@given(st.sampled_from([*MODELS]), st.integers(0, 2**31), st.lists(st.integers(0, 1247), max_size=30))
def test_damaged_packets_give_finite_points(name: str, seed: int, places: list[int]) -> None:
    model, rng = MODELS[name], np.random.default_rng(seed)
    stream = spinning_packets.SpinningStream(
        spinning_packets.FORMATS[name], spinning_packets.Angles(unit_angles(model))
    )
    packets = packets_of(model, blocks_of(model, *ranges(model, 6 * model.blocks)))
    scans = []
    for packet in packets:
        damaged = bytearray(packet)
        for at in places:
            damaged[at % len(damaged)] = int(rng.integers(256))
        row = spinning_packets.format_of(memoryview(damaged))
        if (
            row is not None
            and len(damaged) == len(packet)
            and (name not in ("ot128", "jt128") or row.channel_bytes == 4)
        ):
            if name in ("ot128", "jt128") and not scans:
                stream = spinning_packets.SpinningStream(row, spinning_packets.Angles(unit_angles(model)))
            scans += stream.add(memoryview(damaged))
    scans += stream.end()
    for scan in scans:
        assert np.isfinite(scan.points).all()
        assert np.isfinite(scan.times_s).all()


@given(st.sampled_from([name for name, model in MODELS.items() if model.layout == ">"]), st.binary(max_size=300))
def test_difop_of_any_bytes(name: str, content: bytes) -> None:
    model = MODELS[name]
    whole = difop(model, unit_angles(model))
    angles = spinning_packets.angles_of_difop(spinning_packets.FORMATS[name], memoryview(whole))
    np.testing.assert_allclose(angles.lasers_deg, unit_angles(model), atol=1e-9)
    assert spinning_packets.angles_of_difop(spinning_packets.FORMATS[name], memoryview(whole[:8] + bytes(1240))) is None
    assert (
        spinning_packets.angles_of_difop(spinning_packets.FORMATS[name], memoryview(whole[:8] + b"\xff" * 1240)) is None
    )
    damaged = whole[:465] + content + whole[465 + len(content) :]
    found = spinning_packets.angles_of_difop(spinning_packets.FORMATS[name], memoryview(damaged))
    assert found is None or (np.abs(found.lasers_deg) <= 90.0).all()


def test_clocks_that_were_not_set(tmp_path: Path) -> None:
    """Hesai's date may be all zeros, or seconds by PTP; a month may be 0."""
    model = MODELS["pandarxt-16"]
    (packet, *_) = packets_of(model, blocks_of(model, np.full((8, 16), 500), np.zeros((8, 16), np.int64)))
    for date, seconds in (
        (bytes(6), 0),
        (b"\0\0" + struct.pack(">I", 1234567), 1234567),
        (b"\x19\0\1\0\0\0", 1735689600),
    ):
        path = write_pcap(tmp_path / "a.pcap", [packet[:553] + date + packet[559:]])
        (scan,) = list(read_timed_scans(path))
        assert scan.stamp_s == pytest.approx(seconds, abs=1e-3)
