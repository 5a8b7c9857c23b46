"""Point cloud messages, from bytes to points."""

from __future__ import annotations

import contextlib
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_writers import mcap_channel, mcap_message, write_records
from hypothesis import given, settings
from hypothesis import strategies as st
from test_captures import FLOATS, POINTS, cloud, messages
from tiny_model import varint

from edgeperc.errors import PointsError
from edgeperc.readers.captures import read_scans
from edgeperc.readers.clouds import CLOUD_READERS, cloud_points

CDR, ROS1 = ("sensor_msgs/msg/PointCloud2", "cdr"), ("sensor_msgs/PointCloud2", "ros1")
FOXGLOVE = ("foxglove.PointCloud", "protobuf")


@pytest.mark.parametrize("row_step", [0, 2, 1, 31])
@pytest.mark.parametrize("padding", [0, 4])
def test_rows_without_padding_whatever_row_step_says(row_step: int, padding: int) -> None:
    """Drivers write 0 or the number of points of a row; the length of the data says that rows are not padded."""
    message = cloud(POINTS, FLOATS, padding=padding, height=2)
    message.row_step = row_step
    np.testing.assert_array_equal(cloud_points(message), POINTS)


@pytest.mark.parametrize(("row_step", "n_bytes"), [(0, 63), (0, 65), (8, 60), (2, 72), (64, 64)])
def test_rows_of_which_nothing_agrees_are_refused(row_step: int, n_bytes: int) -> None:
    message = cloud(POINTS, FLOATS, height=2)
    message.row_step, message.data = row_step, bytes(n_bytes)
    with pytest.raises(PointsError, match=f"in rows of {row_step}, and holds {n_bytes} bytes"):
        cloud_points(message)


def values(message: Any) -> tuple[Any, ...]:
    fields = [(f.name, f.offset, f.datatype, f.count) for f in message.fields]
    stamp = message.header.stamp
    head = (stamp.sec, stamp.nanosec, message.header.frame_id, message.height, message.width, fields)
    return (*head, message.is_bigendian, message.point_step, message.row_step, bytes(message.data))


@given(data=st.data())
@settings(max_examples=60)
@pytest.mark.parametrize("ros", [1, 2])
def test_messages_of_ros_as_rosbags_reads_them(ros: int, data: st.DataObject) -> None:
    store, _ = messages(pytest.importorskip("rosbags.typesys"), ros)
    types, text, number = store.types, st.text(max_size=9).filter(lambda t: "\0" not in t), st.integers(0, 2**32 - 1)
    stamp = types["builtin_interfaces/msg/Time"](data.draw(st.integers(0, 2**31 - 1)), data.draw(number))
    header = types["std_msgs/msg/Header"](*([3] if ros == 1 else []), stamp, data.draw(text))
    field = st.builds(types["sensor_msgs/msg/PointField"], text, number, st.integers(0, 255), number)
    message = types["sensor_msgs/msg/PointCloud2"](
        header, data.draw(number), data.draw(number), data.draw(st.lists(field, max_size=4)), data.draw(st.booleans()),
        data.draw(number), data.draw(number), np.frombuffer(data.draw(st.binary(max_size=40)), np.uint8), True,
    )  # fmt: skip
    if ros == 1:
        raw = bytes(store.serialize_ros1(message, CDR[0]))
        assert values(CLOUD_READERS[ROS1](memoryview(raw))) == values(message)
    else:
        for little in (True, False):
            raw = bytes(store.serialize_cdr(message, CDR[0], little_endian=little))
            assert values(CLOUD_READERS[CDR](memoryview(raw))) == values(message)
    for end in range(len(raw) - (1 if ros == 1 else 4)):
        with pytest.raises(PointsError, match="a message is damaged"):
            CLOUD_READERS[ROS1 if ros == 1 else CDR](memoryview(raw[:end]))


@given(content=st.binary(max_size=300))
@settings(max_examples=300)
@pytest.mark.parametrize("kind", [CDR, ROS1, FOXGLOVE])
def test_any_bytes_are_a_cloud_or_a_typed_error(kind: tuple[str, str], content: bytes) -> None:
    with contextlib.suppress(PointsError):
        cloud_points(CLOUD_READERS[kind](memoryview(content)))


# --- Foxglove --------------------------------------------------------------------------------------------------------


def part(number: int, value: int | bytes) -> bytes:
    """A field of protobuf."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    return varint(number << 3 | 2) + varint(len(value)) + value


def foxglove(points: np.ndarray, stamp: tuple[int, int] = (5, 7)) -> bytes:
    data = np.rec.fromarrays(points.T, "<f4, <f4, <f4, <f8").tobytes()
    fields = [part(1, name.encode()) + part(2, 4 * k) + part(3, 7) for k, name in enumerate("xyz")]
    fields.append(part(1, b"intensity") + part(2, 12) + part(3, 8))
    pose = part(1, b"") + part(2, part(4, b""))
    head = part(1, part(1, stamp[0]) + part(2, stamp[1])) + part(2, b"lidar") + part(3, pose)
    fixed = varint(4 << 3 | 5) + struct.pack("<I", 20)
    return head + fixed + b"".join(part(5, field) for field in fields) + part(6, data)


def write_foxglove(path: Path) -> Path:
    content = mcap_channel(4, "/points", *FOXGLOVE, schema=9)
    for k in range(3):
        content += mcap_message(4, k, k, foxglove(POINTS + np.float32(k), (100 + k, 5 * 10**8)))
    return write_records(path, content)


def test_clouds_of_foxglove(tmp_path: Path) -> None:
    scans = list(read_scans(write_foxglove(tmp_path / "own.mcap")))
    assert [stamp for stamp, _ in scans] == pytest.approx([100.5, 101.5, 102.5])
    for k, (_, points) in enumerate(scans):
        np.testing.assert_array_equal(points, POINTS + np.float32(k))


def test_cut_clouds_of_foxglove_are_refused() -> None:
    content = foxglove(POINTS)
    for end in range(len(content)):
        try:
            n = len(cloud_points(CLOUD_READERS[FOXGLOVE](memoryview(content[:end]))))
        except PointsError:
            continue
        assert n == 0  # the data is the last field


@pytest.mark.parametrize("number", [1, 2, 5, 6])
@pytest.mark.parametrize("value", [0, 5, 2**62])
def test_a_number_in_place_of_a_text(number: int, value: int) -> None:
    with pytest.raises(PointsError, match=r"it is not a foxglove\.PointCloud"):
        CLOUD_READERS[FOXGLOVE](memoryview(foxglove(POINTS) + part(number, value)))
