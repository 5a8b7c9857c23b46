"""An Ouster's packets by its metadata: the answers are ouster-sdk's, of every profile, whole or not."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_writers import check_same, join, pcap_head, records_of, vlp16_packets, write_link
from hypothesis import given, settings
from hypothesis import strategies as st
from lidar_writers import MODELS, blocks_of, livox_packets, packets_of, ranges
from test_captures import check_beside, error_of

import twins.packets
from edgeperc import PointsError, read_scans, read_timed_scans
from edgeperc.readers.ouster_packets import PROFILES, OusterStream, fill_turn, layout_of
from edgeperc.readers.times import TimedScan
from edgeperc.types.sensor import get_sensor

pytestmark = pytest.mark.usefixtures("in_this_process")

WIDEST = "RNG19_RFL8_SIG16_NIR16_RGB16_DUAL"
ANGLES = [float(9 - 3 * k) for k in range(8)]
METADATA: dict[str, Any] = {
    "calibration_status": {},
    "beam_intrinsics": {
        "beam_altitude_angles": ANGLES,
        "beam_azimuth_angles": [3.0, 1.0, -1.0, -3.0] * 2,
        "lidar_origin_to_beam_origin_mm": 15.806,
        "beam_to_lidar_transform": [1, 0, 0, 15.806, 0, 1, 0, 0, 0, 0, 1, 0.5, 0, 0, 0, 1],
    },
    "config_params": {"lidar_mode": "512x10", "udp_port_lidar": 7502, "udp_port_imu": 7503},
    "imu_intrinsics": {"imu_to_sensor_transform": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]},
    "lidar_data_format": {
        "column_window": [0, 511],
        "columns_per_frame": 512,
        "columns_per_packet": 16,
        "pixel_shift_by_row": [0] * 8,
        "pixels_per_column": 8,
        "udp_profile_imu": "LEGACY",
        "udp_profile_lidar": "RNG19_RFL8_SIG16_NIR16",
    },
    "lidar_intrinsics": {"lidar_to_sensor_transform": [0, -1, 0, 2, 1, 0, 0, 3, 0, 0, 1, 38.195, 0, 0, 0, 1]},
    "sensor_info": {"prod_sn": "122246000293", "prod_line": "OS-1-8", "initialization_id": 1629346},
}


def changed(**values: Any) -> dict[str, Any]:
    """The metadata with other values, whose names have the holder in front: ``lidar_data_format__fps=10``."""
    content: dict[str, Any] = json.loads(json.dumps(METADATA))
    for name, value in values.items():
        holder, _, field = name.partition("__")
        if not field:
            content[holder] = value
        elif value is None:
            content[holder].pop(field)
        else:
            content[holder][field] = value
    return content


def random_packets(content: Any, n_turns: int, seed: int) -> list[Any]:
    """Turns of random values as ouster-sdk writes them; a tenth of the columns is not valid."""
    core = pytest.importorskip("ouster.sdk.core")
    info = core.SensorInfo(json.dumps(content))
    rng = np.random.default_rng(seed)
    layout = core.PacketFormat(info)
    packets = []
    for k in range(n_turns):
        frame = core.LidarFrame(info)
        is_fusa = info.format.header_type.name == "FUSA"  # whose turns are counted in 32 bits
        frame.frame_id = (65534 + k) % (1 << 32 if is_fusa else 1 << 16)
        for name in frame.fields:
            field = frame.field(name)
            if field.shape == (info.format.pixels_per_column, info.format.columns_per_frame):
                field[:] = rng.integers(0, layout.field_value_mask(name) + 1, field.shape)
                if name == "RANGE":
                    field[:] *= rng.random(field.shape) < 0.8
        frame.timestamp[:] = np.arange(frame.w) * 97_656 + (5 + k) * 10**8
        frame.measurement_id[:] = np.arange(frame.w)
        frame.packet_timestamp[:] = 10**18 + k
        frame.status[:] = rng.random(frame.w) < 0.9
        packets.append([*core.frame_to_packets(frame, layout, info.init_id, info.sn)])
    return packets


def by_sdk(path: Path, metadata: Path, name: str) -> Iterator[TimedScan]:
    """The turns of a capture as ouster-sdk gives them, beam by beam."""
    core, pcap = pytest.importorskip("ouster.sdk.core"), pytest.importorskip("ouster.sdk.pcap")
    frames = pcap.PcapFrameSetSource(str(path), meta=[str(metadata)])
    to_xyz = core.XYZLut(frames.sensor_info[0], False)
    for (frame,) in frames:
        returned = frame.field("RANGE") > 0
        points = np.column_stack([to_xyz(frame)[returned], frame.field(name)[returned]]).astype(np.float32)
        times_s = frame.timestamp[np.nonzero(returned)[1]] * 1e-9
        yield TimedScan(float(frame.timestamp.max()) * 1e-9, points, times_s)


def assert_same(path: Path, metadata: Path, name: str = "REFLECTIVITY") -> list[TimedScan]:
    """Range and remission to the bit, so points to the rounding of float32, times to the bit; in the same order."""
    ours = [*read_timed_scans(path, remission_field=name)]
    theirs = [*by_sdk(path, metadata, name)]
    assert len(ours) == len(theirs)
    for one, other in zip(ours, theirs, strict=True):
        assert one.stamp_s == other.stamp_s
        np.testing.assert_array_equal(one.times_s, other.times_s)
        np.testing.assert_array_equal(one.points[:, 3], other.points[:, 3])
        np.testing.assert_allclose(one.points[:, :3], other.points[:, :3], rtol=2e-7, atol=1e-7)
    return ours


def record(folder: Path, content: Any, packets: list[Any]) -> Path:
    pcap = pytest.importorskip("ouster.sdk.pcap")
    path = folder / "capture.pcap"
    path.with_suffix(".json").write_text(json.dumps(content))
    for k, packet in enumerate(packets):
        packet.host_timestamp = 10**18 + 10**6 * k
    ports = content.get("config_params", {})
    pcap.record(packets, str(path), lidar_port=ports.get("udp_port_lidar", 7502))
    return path


@pytest.mark.parametrize("profile", PROFILES)
def test_every_profile_as_ouster_sdk(tmp_path: Path, profile: str) -> None:
    content = changed(lidar_data_format__udp_profile_lidar=profile)
    path = record(tmp_path, content, [p for turn in random_packets(content, 3, 1) for p in turn])
    for name in PROFILES[profile][1]:
        assert len(assert_same(path, path.with_suffix(".json"), name)) == 3


def test_fields_of_every_profile_are_ousters() -> None:
    core = pytest.importorskip("ouster.sdk.core")
    for profile, (_, fields) in PROFILES.items():
        content = changed(lidar_data_format__udp_profile_lidar=profile)
        info = core.SensorInfo(json.dumps(content))
        assert core.PacketFormat(info).lidar_packet_size == layout_of(content).packet_bytes
        assert {name for name in core.LidarFrame(info).fields if name in fields} >= {"RANGE", "REFLECTIVITY"}


@pytest.mark.parametrize("seed", range(6))
def test_lost_late_and_doubled_packets(tmp_path: Path, seed: int) -> None:
    """Packets may come one or two places late; a turn with lost ones ends when four of the next have come."""
    rng = np.random.default_rng(seed)
    packets = [p for turn in random_packets(METADATA, 6, seed) for p in turn]
    order = np.argsort(np.arange(len(packets)) + rng.integers(0, 3, len(packets)), kind="stable")
    kept = [packets[k] for k in order if rng.random() < 0.9 for _ in range(1 + (rng.random() < 0.05))]
    if seed % 2:
        kept += packets[-6:-3]
    path = record(tmp_path, METADATA, kept)
    assert_same(path, path.with_suffix(".json"))
    assert len(list(read_timed_scans(record(tmp_path, METADATA, packets * 2)))) == 12


def test_other_windows_and_headers(tmp_path: Path) -> None:
    for k, content in enumerate((
        changed(lidar_data_format__column_window=[100, 200]),
        changed(lidar_data_format__column_window=[400, 31]),
        changed(lidar_data_format__header_type="FUSA"),
        changed(lidar_data_format__columns_per_packet=8),
        changed(beam_intrinsics__beam_to_lidar_transform=None),
        changed(beam_intrinsics__beam_to_lidar_transform=None, beam_intrinsics__lidar_origin_to_beam_origin_mm=None),
        changed(sensor_info__initialization_id=None),
        changed(config_params__lidar_mode=None),
    )):  # fmt: skip
        folder = tmp_path / str(k)
        folder.mkdir()
        path = record(folder, content, [p for turn in random_packets(content, 2, k) for p in turn])
        assert len(assert_same(path, path.with_suffix(".json"))) == 2


def test_real_captures_and_metadata(data_root: Callable[[str], Path], tmp_path: Path) -> None:
    """To the bit; and of every real sensor's metadata, captures of random turns."""
    folder = data_root("other_sensors") / "ouster"
    for capture, metadata in (
        ("OS-0-128-U1_v2.3.0_1024x10", "OS-0-128-U1_v2.3.0_1024x10"),
        ("OS-1-64_1024x10_fw20", "OS-1-64_sensor_config_reduced"),
    ):
        path = tmp_path / f"{capture}.pcap"
        shutil.copy(folder / f"{capture}.pcap", path)
        shutil.copy(folder / f"{metadata}.json", path.with_suffix(".json"))
        (ours,), (theirs,) = (
            assert_same(path, path.with_suffix(".json")),
            [*by_sdk(path, path.with_suffix(".json"), "REFLECTIVITY")],
        )
        np.testing.assert_array_equal(ours.points, theirs.points)
    files = sorted((folder / "metadata").glob("*.json"))
    assert len(files) >= 4
    for k, file in enumerate(files):
        content = json.loads(file.read_text())
        (tmp_path / str(k)).mkdir()
        path = record(tmp_path / str(k), content, [p for turn in random_packets(content, 2, k) for p in turn])
        assert len(assert_same(path, path.with_suffix(".json"))) == 2
    for file in sorted((folder / "metadata_malformed").glob("*.json")):
        with pytest.raises(PointsError, match=r"lacks|same angle"):
            layout_of(json.loads(file.read_text()))


@pytest.mark.parametrize(
    ("content", "error"),
    [
        ([], "expected an object, got list"),
        ({}, "beam_altitude_angles is None; expected a list of numbers"),
        ({**METADATA, "sensor_info": None}, "lacks sensor_info"),
        (changed(lidar_data_format__udp_profile_lidar="RNG99"), "'RNG99' is not decoded; known are LEGACY"),
        (changed(lidar_data_format__udp_profile_lidar=["LEGACY"]), "is not decoded"),
        (changed(lidar_data_format__columns_per_frame=None, config_params__lidar_mode=None), "one is needed"),
        (
            changed(lidar_data_format__columns_per_packet=512, lidar_data_format__udp_profile_lidar=WIDEST),
            "at most 65,507",
        ),
        (changed(beam_intrinsics__beam_altitude_angles=[0.0] * 8), "several beams have the same angle"),
        (changed(beam_intrinsics__beam_altitude_angles=[[0.0]] * 8), r"angles\[0\] is \[0.0\]; expected a number"),
        (changed(beam_intrinsics__beam_to_lidar_transform=[1, 2, 3]), "expected a list of 16 numbers"),
        (changed(lidar_intrinsics__lidar_to_sensor_transform=[float("nan")] * 16), r"transform\[0\] is nan"),
        (changed(beam_intrinsics__lidar_origin_to_beam_origin_mm="15"), "is '15'; expected a number"),
        (changed(sensor_info__initialization_id=[1]), r"initialization_id is \[1\]; expected a number"),
    ],
)  # fmt: skip
def test_metadata_that_says_nothing_possible(content: Any, error: str) -> None:
    with pytest.raises(PointsError, match=error):
        layout_of(content)


@pytest.mark.parametrize("change", [{"sensor_info__prod_sn": "122246000294"}, {"sensor_info__initialization_id": 5}])
def test_metadata_of_another_sensor_is_said(tmp_path: Path, change: dict[str, Any]) -> None:
    path = record(tmp_path, METADATA, random_packets(METADATA, 1, 0)[0])
    path.with_suffix(".json").write_text(json.dumps(changed(**change)))
    assert "none of the 32 packets is; expected the metadata that was saved with the capture" in error_of(path)


def test_several_sensors_in_one_capture(tmp_path: Path) -> None:
    other = changed(sensor_info__prod_sn="992242000335", config_params__udp_port_lidar=7502)
    one, two = random_packets(METADATA, 2, 1), random_packets(other, 2, 2)
    packets = [p for pair in zip(one[0] + one[1], two[0] + two[1], strict=True) for p in pair]
    path = record(tmp_path, METADATA, packets)
    path.with_suffix(".json").rename(tmp_path / "capture_1.json")
    (tmp_path / "capture_2.json").write_text(json.dumps(other))
    assert "there are 122246000293, 992242000335; choose one" in error_of(path)
    for name, turns in (("122246000293", one), ("992242000335", two)):
        scans = [*read_timed_scans(path, topic=name)]
        stream = OusterStream(layout_of(other if turns is two else METADATA), None)
        wanted = [scan for turn in turns for packet in turn for scan in stream.add(bytes(packet.buf))]
        assert [len(scan.points) for scan in scans] == [len(scan.points) for scan in wanted]
        np.testing.assert_array_equal(scans[1].points, wanted[1].points)


@pytest.mark.parametrize("other", ["velodyne", "pandarxt-16", "pandarxt-32"])
def test_an_ouster_beside_another_makers_sensor_is_told_apart(tmp_path: Path, other: str) -> None:
    payloads = vlp16_packets(2.0)[:110] if other == "velodyne" else other_packets(other)
    ousters = [bytes(packet.buf) for turn in random_packets(METADATA, 2, 1) for packet in turn]
    sent = {"10.0.0.9": ("10.0.0.9", payloads), "122246000293": ("10.0.0.1:7502", ousters)}
    check_beside(tmp_path, sent, json.dumps(METADATA))


@pytest.mark.parametrize("share", [0.1, 0.5, 2.0])
@pytest.mark.parametrize("name", ["pandarxt-16", "pandarxt-32", "livox"])
def test_a_sensor_beside_an_ouster_is_named_however_few_its_packets_are(
    tmp_path: Path, name: str, share: float
) -> None:
    ousters = [bytes(packet.buf) for turn in random_packets(METADATA, 8, 1) for packet in turn]
    few = other_packets(name)[: int(share * len(ousters))]
    path = joined(tmp_path, [(ousters, "10.0.0.1:7502"), (few, "10.0.0.9")])
    assert "expected one LiDAR, there are 10.0.0.9, 122246000293; choose one" in error_of(path)
    assert "no LiDAR '10.0.0.77'" in error_of(path, topic="10.0.0.77")
    assert len(list(read_timed_scans(path, topic="122246000293"))) == 8
    assert len(list(read_timed_scans(path, topic="10.0.0.9"))) > 0


@pytest.mark.parametrize("name", ["pandarxt-16", "pandarxt-32", "livox", "Hesai ATX"])
def test_a_sensor_that_begins_late_beside_an_ouster_is_warned_of(tmp_path: Path, name: str) -> None:
    ousters = [bytes(packet.buf) for turn in random_packets(METADATA, 64, 1) for packet in turn]
    path = joined(tmp_path, [(ousters, "10.0.0.1:7502"), (other_packets(name), "10.0.0.9")])
    with pytest.warns(UserWarning, match=r"of the first sensor alone; .* several, 10\.0\.0\.9, Ouster: .*--topic"):
        assert len(list(read_timed_scans(path))) == 64


@pytest.mark.parametrize(("at", "number"), [(4, b"\1\2\3"), (7, b"\1\2\3\4\5"), (4, b"\0\0\1")])
def test_an_ouster_that_starts_anew_or_another_one_is_warned_of(tmp_path: Path, at: int, number: bytes) -> None:
    ousters = [bytes(packet.buf) for turn in random_packets(METADATA, 2, 1) for packet in turn]
    others = [packet[:at] + number + packet[at + len(number) :] for packet in ousters]
    path = joined(tmp_path, [(ousters, "10.0.0.1"), (others, "10.0.0.1")])
    with pytest.warns(UserWarning, match=rf"left out {len(others)} packets of another Ouster, or of this one after"):
        assert len(list(read_timed_scans(path))) == 2


@pytest.mark.parametrize("n", [1, 3, 15])
def test_damaged_numbers_are_no_other_ouster(tmp_path: Path, n: int) -> None:
    ousters = [bytes(packet.buf) for turn in random_packets(METADATA, 2, 1) for packet in turn]
    damaged = [packet[:7] + bytes([k + 1]) + packet[8:] if k < n else packet for k, packet in enumerate(ousters)]
    path = joined(tmp_path, [(damaged, "10.0.0.1")])
    with pytest.warns(UserWarning, match=f"dropped {n} damaged packets") as said:
        list(read_timed_scans(path))
    assert not any("another Ouster" in str(each.message) for each in said)


def other_packets(name: str) -> list[bytes]:
    """Of a sensor of another maker."""
    if name == "Hesai ATX":
        return [bytes.fromhex("eeff0407000080020004017f") + bytes([k]) + bytes(1105) for k in range(80)]
    if name == "livox":
        return livox_packets(1, np.full((96 * 300, 3), 7.5), np.arange(96 * 300) % 256, is_old=False)
    model = MODELS[name]
    return packets_of(model, blocks_of(model, *ranges(model, 1024)))


def joined(folder: Path, parts: Sequence[tuple[Sequence[bytes], str]]) -> Path:
    """A capture of packets and their sender, one after the other, with an Ouster's metadata beside it."""
    names = (folder / f"part{k}" for k in range(len(parts)))
    written = [write_link(name, 1, packets, one=sender) for name, (packets, sender) in zip(names, parts, strict=True)]
    path = join(folder / "both.pcap", written)
    path.with_suffix(".json").write_text(json.dumps(METADATA))
    return path


def test_a_sensor_profile_beside_a_capture_is_no_metadata(tmp_path: Path) -> None:
    """As edgeperc info drive.pcap --write drive-mine.json puts it there."""
    payloads = [bytes(packet.buf) for turn in random_packets(METADATA, 2, 1) for packet in turn]
    capture = write_link(tmp_path / "drive.pcap", 1, payloads)
    (tmp_path / "drive_metadata.json").write_text(json.dumps(METADATA))
    alone = list(read_scans(capture))
    for name in ("drive-mine.json", "drive.pcap.json", "drive.json"):
        (tmp_path / name).write_text(get_sensor("os1-64").to_json())
    check_same(read_scans(capture), alone)
    (tmp_path / "drive_metadata.json").unlink()
    assert "there is no metadata next to it" in error_of(capture)


@pytest.mark.parametrize("other", ["10.0.0.2", "10.0.0.1:7503", "10.0.0.9:7502"])
def test_a_second_sensor_of_old_firmware_is_left_out_with_a_warning(tmp_path: Path, other: str) -> None:
    """Its packets carry neither a serial number nor an initialization_id."""
    content = changed(lidar_data_format__udp_profile_lidar="LEGACY")
    records = []
    for seed, sender in ((1, "10.0.0.1:7502"), (2, other)):
        payloads = [bytes(packet.buf) for turn in random_packets(content, 2, seed) for packet in turn]
        records.append(records_of(write_link(tmp_path / f"{seed}.pcap", 1, payloads, one=sender).read_bytes()))
    both = tmp_path / "both.pcap"
    both.write_bytes(pcap_head() + b"".join(one + two for one, two in zip(*records, strict=True)))
    for name in ("1", "both"):
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    with pytest.warns(UserWarning, match=r"the first of several sensors, 10\.0\.0\..*whose packets carry no serial"):
        found = [*read_timed_scans(both)]
    assert check_same(found, read_timed_scans(tmp_path / "1.pcap"), clock=False) == 2


@settings(max_examples=60)
@given(
    st.sampled_from([*PROFILES]), st.integers(0, 5), st.integers(1, 5), st.sampled_from([1, 4, 16]), st.integers(0, 9)
)
def test_the_kernel_as_its_slow_twin(profile: str, n_packets: int, n_beams: int, per_packet: int, seed: int) -> None:
    """On any bytes."""
    content = changed(
        lidar_data_format__udp_profile_lidar=profile, lidar_data_format__columns_per_packet=per_packet,
        lidar_data_format__pixels_per_column=n_beams, lidar_data_format__pixel_shift_by_row=[0] * n_beams,
        beam_intrinsics__beam_altitude_angles=ANGLES[:n_beams], beam_intrinsics__beam_azimuth_angles=[0.0] * n_beams,
    )  # fmt: skip
    layout = layout_of(content)
    rng = np.random.default_rng(seed)
    packets = rng.integers(0, 256, (n_packets, layout.packet_bytes), np.uint8)
    header, _, column_bytes = layout.places[:3]
    for k in range(per_packet):
        packets[:, header + k * column_bytes + 9] %= np.uint8(rng.choice([1, 4]))
    fields = [layout.fields["RANGE"], layout.fields["REFLECTIVITY"]]
    values, stamps_ns = np.zeros((2, n_beams, 300), np.uint32), np.zeros(300, np.uint64)
    fill_turn(packets, np.array(layout.places), np.array(fields, np.int64), values, stamps_ns)
    wanted, wanted_ns = twins.packets.ouster_turn(
        [row.tobytes() for row in packets], layout.places, [tuple(field) for field in fields], values.shape[1:]
    )
    np.testing.assert_array_equal(values, wanted)
    np.testing.assert_array_equal(stamps_ns, wanted_ns)


@settings(max_examples=40)
@given(st.lists(st.integers(0, 7), max_size=40), st.integers(0, 9))
def test_any_order_of_turns_ends(turns: list[int], seed: int) -> None:
    """Packets of random bytes, in any order; each returns in one turn at most."""
    layout = layout_of(changed(lidar_data_format__columns_per_packet=1))
    stream, rng = OusterStream(layout, "signal"), np.random.default_rng(seed)
    scans: list[TimedScan] = []
    for turn in turns:
        packet = bytearray(rng.bytes(layout.packet_bytes))
        packet[2:4] = (65533 + turn).to_bytes(4, "little")[:2]
        packet[41] %= 2
        scans += stream.add(bytes(packet))
    scans += stream.end()
    assert len(scans) <= len(turns)
    assert (len(scans) > 0) == (len(turns) > 0)
    assert sum(len(scan.points) for scan in scans) <= 8 * len(turns)
