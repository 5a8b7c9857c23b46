"""Bags of ROS 1 and 2: every part that is whole is read, whatever else is damaged, missing or unknown."""

from __future__ import annotations

import os
import re
import shutil
import sqlite3
import struct
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_writers import mcap_channel, write_records
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_apart import chunked_mcap
from test_captures import BAGS, LIDAR, OTHER, POINTS, error_of, write_bag1, write_bag2, write_mcap

import edgeperc
from cli_helpers import Shell
from edgeperc.errors import MissingExtraError, PointsError
from edgeperc.readers.bags import bag_files
from edgeperc.readers.captures import read_scans
from edgeperc.readers.decoders import decode

pytestmark = pytest.mark.usefixtures("in_this_process")

STAMPS_S = [100.5, 101.5, 202.0]


def decoded(path: Path) -> Iterator[Any]:
    return decode(path, "ros2" if path.is_dir() else path.suffix, None, None, lambda text: None, lambda: None)


def whole_scans(path: Path) -> tuple[int, str]:
    """How many scans come, each equal to the one that was written, and the error behind them."""
    n = 0
    try:
        for scan in decoded(path):
            assert scan.stamp_s == pytest.approx(STAMPS_S[n])
            np.testing.assert_array_equal(scan.points, POINTS + np.float32(n))
            n += 1
    except PointsError as exc:
        assert str(path) in str(exc)  # noqa: PT017 - scans may come first
        return n, str(exc)
    return n, ""


@pytest.fixture(scope="module", params=["ros1.bag", "packed.bag", "one.mcap", "chunks.mcap", "ros2.db3"])
def recording(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, name = tmp_path_factory.mktemp("bag"), request.param
    if name == "ros2.db3":
        write_bag2(folder / "bag")
        return next((folder / "bag").glob("*.db3")).rename(folder / name)
    if name == "chunks.mcap":
        return chunked_mcap(folder / name, "lz4")
    return write_bag1(folder / name, compression="BZ2") if name == "packed.bag" else BAGS[name](folder / name)


def test_cuts_at_every_byte(recording: Path, tmp_path: Path) -> None:
    """Later cuts leave no fewer scans, and nothing is said of a file that is whole."""
    content, path = recording.read_bytes(), tmp_path / recording.name
    assert whole_scans(recording) == (3, "")
    step = 1 if len(content) < 6000 else 37
    ends = {*range(0, 64), *range(64, len(content), step), len(content) - 1}
    for text in re.finditer(rb"[\n -~]{200,}", content):  # the definition of a message, which is one field
        ends -= {*range(text.start() + 1, text.end())} - {*range(text.start(), text.end(), 37)}
    most = 0
    for end in sorted(ends):
        path.unlink(missing_ok=True)  # to write over a file waits for the disk
        path.write_bytes(content[:end])
        n, error = whole_scans(path)
        assert error or n == 3  # the index behind all messages is not needed
        assert n >= most or recording.suffix == ".db3"  # pages of a database do not stand in their order
        most = max(most, n)
        if end < 16:
            assert "damaged or cut short" in error
    assert most == 3 or recording.suffix == ".db3"


def test_a_long_search_for_the_next_message_is_no_standstill(recording: Path) -> None:
    """The process that reads a bag without an index, or of other topics, says now and then that it is alive."""
    said: list[bool] = []
    list(decode(recording, recording.suffix, None, None, lambda text: None, lambda: said.append(True)))
    assert said or recording.suffix == ".db3"  # a small database takes too few steps


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(place=st.floats(0.0, 1.0), damage=st.binary(min_size=1, max_size=40))
def test_damaged_bytes_are_typed_errors(recording: Path, tmp_path: Path, place: float, damage: bytes) -> None:
    content = bytearray(recording.read_bytes())
    start = int(place * (len(content) - 1))
    content[start : start + len(damage)] = damage
    path = tmp_path / recording.name
    path.unlink(missing_ok=True)
    path.write_bytes(content)
    try:
        for scan in decoded(path):
            assert scan.points.dtype == np.float32
    except PointsError as exc:
        assert str(path) in str(exc)  # noqa: PT017 - scans may come first


@pytest.mark.parametrize("metadata", [None, "", "rosbag2_bagfile_information: [", "version: 9", "\xff\0"])
def test_metadata_is_not_needed(tmp_path: Path, metadata: str | None) -> None:
    """A recorder writes it last, and its version changes with every release of ROS."""
    folder = write_bag2(tmp_path / "bag")
    text = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").unlink()
    if metadata == "version: 9":
        metadata = text.replace("version: 8", "version: 9").replace(
            "offered_qos_profiles: ''", "offered_qos_profiles: []"
        )
    if metadata is not None:
        (folder / "metadata.yaml").write_text(metadata, encoding="utf-8")
    assert edgeperc.readers.captures.is_capture(folder)
    assert whole_scans(folder) == (3, "")


@pytest.mark.parametrize("listed", ["\n    - bag_0.db3\n    - 'bag_1.db3'\n  x: 1", "[bag_0.db3, bag_1.db3]"])
def test_a_missing_part_is_said_after_the_others(tmp_path: Path, listed: str) -> None:
    folder = write_bag2(tmp_path / "bag")
    next(folder.glob("*.db3")).rename(folder / "bag_0.db3")
    (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths: {listed}\n")
    n, error = whole_scans(folder)
    assert n == 3
    assert error.endswith("after 3 scans the bag is not whole: bag_1.db3 of its metadata.yaml is missing")


@pytest.mark.parametrize("damaged", [0, 1, 2])
def test_a_damaged_part_costs_no_other(tmp_path: Path, damaged: int) -> None:
    folder = tmp_path / "drive 10_2"
    folder.mkdir()
    for k in range(3):
        write_mcap(folder / f"part_{9 + k}.mcap")
    file = folder / f"part_{9 + damaged}.mcap"
    file.write_bytes(file.read_bytes()[:30])
    (folder / "metadata.yaml").write_text("relative_file_paths: []")
    scans = []
    with pytest.raises(PointsError, match=rf"after 6 scans {file.name}: the file is damaged or cut short"):
        scans.extend(decoded(folder))
    assert len(scans) == 6


def test_parts_are_sorted_by_number(tmp_path: Path) -> None:
    names = ["x_1.db3", "x_2.db3", "x_10.db3", "x_10.db3.zstd", "x².mcap"]
    for name in [*reversed(names), "metadata.yaml", "x_3.db3-wal", "notes.txt", "._x_1.db3", "y.zstd"]:
        (tmp_path / name).touch()
    assert [file.name for file in bag_files(tmp_path)] == names


def test_a_database_beside_its_log(tmp_path: Path) -> None:
    """What a recorder that lost power had not copied from its log is read."""
    folder = write_bag2(tmp_path / "bag")
    (database,) = folder.glob("*.db3")
    writer = sqlite3.connect(database)
    writer.execute("PRAGMA journal_mode=WAL")
    writer.execute("UPDATE messages SET timestamp = timestamp + 1")
    writer.commit()
    crashed = tmp_path / "crashed"
    shutil.copytree(folder, crashed)
    writer.close()
    assert {file.name for file in crashed.iterdir()} > {database.name + "-wal"}
    assert whole_scans(crashed) == (3, "")
    assert [scan.stamp_s for scan in decoded(crashed)] == pytest.approx([100.5, 101.5, 202.000000001], abs=1e-9)


@pytest.mark.parametrize("share", [0.5, 0.7, 0.95])
def test_zeros_in_place_of_the_end(recording: Path, tmp_path: Path, share: float) -> None:
    """As a file system leaves a file when power is lost."""
    content, path = recording.read_bytes(), tmp_path / recording.name
    start = int(share * len(content))
    path.write_bytes(content[:start] + bytes(len(content) - start))
    n, error = whole_scans(path)
    assert error or n == 3


@pytest.mark.parametrize("name", ["ros1.bag", "packed.bag", "one.mcap"])
def test_zeros_behind_the_messages(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    content = (write_bag1(path, compression="BZ2") if name == "packed.bag" else BAGS[name](path)).read_bytes()
    if path.suffix == ".bag":
        (end,) = struct.unpack_from("<Q", content, content.index(b"index_pos=") + len(b"index_pos="))
    else:
        end = content.rindex(b"\x0f" + struct.pack("<Q", 4))  # what ends the data
    path.write_bytes(content[:end] + bytes(1 << 16))
    n, error = whole_scans(path)
    assert n == 3
    assert f"there is no record at byte {end:,}" in error or f"zeros in place of a record at {end:,}" in error


@pytest.mark.parametrize("compression", [None, "BZ2"])
@pytest.mark.parametrize("index", [0, 1 << 20, 1 << 63])
def test_a_bag_of_ros_1_that_ends_before_its_index(tmp_path: Path, compression: str | None, index: int) -> None:
    """Cut between two chunks, or of a recorder that broke off: what is there comes, and that more may be missing."""
    path = write_bag1(tmp_path / "drive.bag", compression=compression)
    content = path.read_bytes()
    at = content.index(b"index_pos=") + len(b"index_pos=")
    path.write_bytes(content[:at] + struct.pack("<Q", index) + content[at + 8 :])
    n, error = whole_scans(path)
    assert n == 3
    assert "after 3 scans the file is damaged or cut short: it ends before its index" in error


@pytest.mark.parametrize("version", ["1.2", "1.3", "3.0"])
def test_ros_1_of_another_version(tmp_path: Path, version: str) -> None:
    path = tmp_path / "old.bag"
    path.write_bytes(f"#ROSBAG V{version}\n".encode() + bytes(50))
    assert f"a bag of version '{version}'; expected 2.0. Run: rosbag migrate" in error_of(path)


def test_no_other_library_is_needed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [write(tmp_path / name) for name, write in BAGS.items()]
    packed = write_bag1(tmp_path / "lz4.bag", compression="LZ4")
    assert whole_scans(packed) == (3, "")
    for module in ("rosbags", "ruamel.yaml", "lz4", "lz4.frame", "zstandard"):
        monkeypatch.setitem(sys.modules, module, None)
    for path in paths:
        assert whole_scans(path) == (3, "")
    with pytest.raises(MissingExtraError, match=r"pip install 'edgeperc\[bags\]'"):
        next(decoded(packed))


# --- MCAP ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("profile", [b"", b"ros2", b"protobuf", b"ros1", b"my recorder", b"\xff\xfe"])
def test_the_profile_of_an_mcap_file_does_not_matter(tmp_path: Path, profile: bytes) -> None:
    assert whole_scans(write_mcap(tmp_path / "drive.mcap", profile)) == (3, "")


@pytest.mark.parametrize("method", ["", "zstd"])
@pytest.mark.parametrize("damage", ["schema", "place", "record", "checksum"])
def test_a_summary_may_be_damaged_and_need_not_repeat_the_schemas(tmp_path: Path, method: str, damage: str) -> None:
    """It lacks them as of a recorder of ROS 2 with noRepeatedSchemas."""
    path = chunked_mcap(tmp_path / "drive.mcap", method)
    content = bytearray(path.read_bytes())
    (summary,) = struct.unpack_from("<Q", content, len(content) - 28)
    if damage == "schema":
        (length,) = struct.unpack_from("<Q", content, summary + 1)
        del content[summary : summary + 9 + length]
    elif damage == "place":
        struct.pack_into("<Q", content, len(content) - 28, 1 << 40)
    elif damage == "record":
        content[summary] = 0
    else:
        struct.pack_into("<I", content, len(content) - 12, 1)
        content[content.index(LIDAR.encode(), summary)] ^= 2  # another topic
    path.write_bytes(content)
    assert whole_scans(path) == (3, "")


@pytest.mark.skipif(sys.platform != "linux", reason="other systems name files in UTF-8 alone")
def test_a_folder_may_have_a_name_that_is_no_text(tmp_path: Path) -> None:
    folder = write_bag2(tmp_path / "bag").rename(tmp_path / os.fsdecode(b"drive \xe9"))
    assert whole_scans(folder) == (3, "")


@pytest.mark.parametrize(
    ("kind", "encoding"),
    [("sensor_msgs/msg/PointCloud2", "json"), ("sensor_msgs/PointCloud2", "cdr"), ("foxglove.PointCloud", "json")],
)
def test_other_encodings_are_listed(tmp_path: Path, kind: str, encoding: str) -> None:
    path = write_records(tmp_path / "drive.mcap", mcap_channel(1, "/points", kind, encoding))
    assert f"of other types /points ({kind})" in error_of(path)


# --- several sensors in one recording --------------------------------------------------------------------------------


def write_frames(path: Path, frames: Sequence[str]) -> Path:
    """A database with a cloud of each frame on one topic."""
    folder = write_bag2(path)
    (database,) = folder.glob("*.db3")
    writer = sqlite3.connect(database)
    query = "SELECT id, data FROM messages WHERE topic_id = (SELECT id FROM topics WHERE name = ?) ORDER BY id"
    for (number, data), frame in zip(writer.execute(query, (LIDAR,)).fetchall(), frames, strict=True):
        assert bytes(data).count(b"lidar\0") == 1
        writer.execute(
            "UPDATE messages SET data = ? WHERE id = ?",
            (bytes(data).replace(b"lidar\0", frame.encode() + b"\0"), number),
        )
    writer.commit()
    writer.close()
    return folder


@pytest.mark.parametrize(
    "frames", [["front", "right", "front"], ["front", "front", "right"], ["right", "front", "lower"]]
)
def test_frames_of_one_topic_are_several_sensors(tmp_path: Path, frames: Sequence[str]) -> None:
    folder = write_frames(tmp_path / "bag", frames)
    with pytest.raises(
        PointsError,
        match=r"after (1 scan|2 scans): .* of several sensors, with the frames .*; choose one",
    ) as caught:
        list(decoded(folder))
    assert f"'{LIDAR}@{frames[0]}'" in str(caught.value)
    for frame in {*frames}:
        stamps = [stamp for stamp, _ in read_scans(folder, topic=f"{LIDAR}@{frame}")]
        assert stamps == pytest.approx([STAMPS_S[k] for k in range(3) if frames[k] == frame])
    assert f"has no message with frame 'rear', only {', '.join(dict.fromkeys(frames))}" in error_of(
        folder, topic=f"{LIDAR}@rear"
    )
    assert f"no topic of type sensor_msgs/PointCloud2 '{OTHER}'" in error_of(folder, topic=f"{OTHER}@front")


@pytest.mark.parametrize("case", [("xyz", 0, "enough points"), ("xyz", 5000, "be told from"), ("ab", 9, "z among a")])
def test_of_a_bag_that_names_no_sensor_it_is_said_what_is_wrong_with_its_points(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shell: Shell, case: tuple[str, int, str]
) -> None:
    monkeypatch.setattr("test_captures.LAYOUT", [(axis, "f4") for axis in (*case[0], "intensity")])
    monkeypatch.setattr("test_captures.POINTS", np.random.default_rng(0).uniform(-20, 20, (case[1], 4)).astype("f4"))
    assert case[2] in shell.err("info", write_bag2(tmp_path / "bag"), code=1)


@pytest.mark.parametrize("name", [*BAGS])
@pytest.mark.parametrize("place", [(512345.25, 5412345.5, 113.0, 0.0), (4.1e6, 6e5, 4.8e6, 0.0), (0.0, -3e5, 0.0, 0.0)])
def test_clouds_with_coordinates_of_a_map_are_not_sent_to_an_option_that_refuses_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, place: Sequence[float]
) -> None:
    monkeypatch.setattr("test_captures.LAYOUT", [(axis, "f8") for axis in ("x", "y", "z", "ring")])
    monkeypatch.setattr("test_captures.POINTS", POINTS.astype("f8") + np.array(place) + 0.123)
    bag = BAGS[name](tmp_path / name)
    with pytest.raises(PointsError) as of_rings:
        edgeperc.sensor_of(bag)
    for error in (error_of(bag), str(of_rings.value)):
        assert "the clouds have coordinates of a map (frame 'lidar')" in error
        assert "take those of the sensor, before they are moved, or save each as a .npy" in error
