"""An Ouster's packets become scans, by the layout that its metadata states."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import PointsError
from ..system.kernels import njit
from ..types.points import Bytes, Floats, Ints64
from .ouster import FIELDS, check_metadata, object_in
from .times import TimedScan


class Field(NamedTuple):
    """Bits of a pixel: the first, how many, and by how many the value is shifted up."""

    bit: int
    bits: int
    shift: int = 0


_NARROW = {"RANGE": Field(0, 15, 3), "FLAGS": Field(15, 1), "REFLECTIVITY": Field(16, 8), "NEAR_IR": Field(24, 8, 4)}
_RANGE = {"RANGE": Field(0, 19), "FLAGS": Field(19, 5)}
_SINGLE = {**_RANGE, "REFLECTIVITY": Field(32, 8), "SIGNAL": Field(48, 16), "NEAR_IR": Field(64, 16)}
_NARROW_DUAL = {**_NARROW, "RANGE2": Field(32, 15, 3), "FLAGS2": Field(47, 1), "REFLECTIVITY2": Field(48, 8)}
_DUAL = {
    **_RANGE, "REFLECTIVITY": Field(24, 8), "RANGE2": Field(32, 19), "FLAGS2": Field(51, 5),
    "REFLECTIVITY2": Field(56, 8), "SIGNAL": Field(64, 16), "SIGNAL2": Field(80, 16),
}  # fmt: skip
_COLORED = {**_RANGE, "REFLECTIVITY": Field(24, 8), "SIGNAL": Field(32, 16), "NEAR_IR": Field(48, 16)}
_LEGACY = {**_SINGLE, "RANGE": Field(0, 20), "FLAGS": Field(28, 4)}

# Bytes of a pixel and its fields, by udp_profile_lidar.
PROFILES: Mapping[str, tuple[int, Mapping[str, Field]]] = MappingProxyType(
    {
        "LEGACY": (12, _LEGACY),
        "RNG19_RFL8_SIG16_NIR16": (12, _SINGLE),
        "RNG19_RFL8_SIG16_NIR16_DUAL": (16, {**_DUAL, "NEAR_IR": Field(96, 16)}),
        "RNG15_RFL8_NIR8": (4, _NARROW),
        "RNG15_RFL8_NIR8_DUAL": (8, _NARROW_DUAL),
        "FUSA_RNG15_RFL8_NIR8_DUAL": (8, _NARROW_DUAL),
        "RNG15_RFL8_WIN8": (4, {name: field for name, field in _NARROW.items() if name != "NEAR_IR"}),
        "RNG15_RFL8_NIR8_ZONE16": (8, _NARROW),
        "RNG19_RFL8_SIG16_NIR16_ZONE16": (12, _SINGLE),
        "RNG19_RFL8_SIG16_ZONE16_DUAL": (16, _DUAL),
        "RNG19_RFL8_SIG16_NIR16_RGB16": (16, _COLORED),
        "RNG19_RFL8_SIG16_NIR16_RGB16_DUAL": (20, {**_DUAL, "NEAR_IR": Field(96, 16)}),
    }
)

# From the axis to the beams' origin [mm], where the metadata of early firmware does not say so; and of the first OS1.
_TO_BEAM_MM, _TO_BEAM_OF_FIRST_MM = {"0": 27.67, "1": 15.806, "2": 13.762}, 12.163
_LIDAR_TO_SENSOR = (-1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 36.18, 0.0, 0.0, 0.0, 1.0)
_LATER = ("config_params", "lidar_data_format", "lidar_intrinsics", "sensor_info")  # beside beam_intrinsics
_METER = 1e-3
_MOST_PACKET_BYTES = 65_507  # of a UDP datagram

# So many packets of later turns are kept while a packet of this turn may still come.
_MOST_AHEAD = 4


class Layout(NamedTuple):
    """What the metadata says of packets and beams."""

    name: str  # the serial number, as the metadata has it; "0" if it has none
    # that packets carry; 0 where they do not, or the metadata does not say
    serial: int
    init_id: int
    port: int  # that packets are sent to; 0 if the metadata does not say
    fields: Mapping[str, Field]
    packet_bytes: int
    other_bytes: frozenset[int]  # sizes of the packets with motion and zones
    frame_id: tuple[int, int]  # first byte and number of bytes of a packet's turn
    is_fusa: bool
    # header, columns of a packet, bytes of a column, its status, its first pixel, bytes of a pixel
    places: tuple[int, ...]
    shape: tuple[int, int]  # beams, columns of a turn
    packets_of_turn: int  # fewer if the sensor looks to one side only
    # of each beam [rad]
    altitude: Floats
    azimuth: Floats
    # (4, 4) from the beams' origin to the axis, and from there to the sensor [mm]
    to_lidar: Floats
    to_sensor: Floats


def layout_of(content: Any) -> Layout:
    """The layout of the packets of a sensor, of any firmware; PointsError if something is missing or impossible."""
    check_metadata(content)
    if "beam_intrinsics" in content and (missing := [name for name in _LATER if not object_in(content, name)]):
        raise PointsError(f"it lacks {', '.join(missing)}, which come with beam_intrinsics")
    form = object_in(content, "lidar_data_format") or object_in(content, "data_format")
    info, config = (object_in(content, name) or content for name in ("sensor_info", "config_params"))
    beams = object_in(content, "beam_intrinsics") or content
    altitude, azimuth = (_angles(beams, f"beam_{name}_angles") for name in ("altitude", "azimuth"))
    mode = re.match(r"(\d{3,4})x\d", str(config.get("lidar_mode", content.get("lidar_mode"))))
    n_columns = form.get("columns_per_frame") or (int(mode[1]) if mode else 0)
    n_beams, per_packet = len(altitude), form.get("columns_per_packet", 16)
    if not n_columns:
        raise PointsError("columns_per_frame and lidar_mode: one is needed, to say how many columns a turn has")
    if len(azimuth) != n_beams or form.get("pixels_per_column", n_beams) != n_beams:
        raise PointsError(f"beam_altitude_angles: {n_beams} of them, and {len(azimuth)} azimuth angles")
    profile = str(form.get("udp_profile_lidar", "LEGACY"))
    if profile not in PROFILES:
        raise PointsError(f"udp_profile_lidar: {profile!r:.60} is not decoded; known are {', '.join(PROFILES)}")
    pixel_bytes, fields = PROFILES[profile]
    is_legacy = profile == "LEGACY"
    is_fusa = not is_legacy and form.get("header_type", profile[:4]) == "FUSA"
    header, first = (0, 16) if is_legacy else (32, 12)
    column_bytes = first + n_beams * pixel_bytes + 4 * is_legacy
    status = column_bytes - 4 if is_legacy else 10
    begin, end = (column // per_packet for column in form.get("column_window", [0, n_columns - 1]))
    n_packets = -(-n_columns // per_packet)
    line = re.match(r"OS-?([012])(?!\d)", str(info.get("prod_line", "")))
    in_beam = _TO_BEAM_MM[line[1]] if line else _TO_BEAM_OF_FIRST_MM
    to_beam = np.eye(4)
    to_beam[0, 3] = _number(beams, "lidar_origin_to_beam_origin_mm", in_beam)
    lidar = object_in(content, "lidar_intrinsics") or content
    packet_bytes = 2 * header + per_packet * column_bytes
    if packet_bytes > _MOST_PACKET_BYTES:
        raise PointsError(f"packets of {packet_bytes:,} bytes; expected at most {_MOST_PACKET_BYTES:,}")
    name = str(info.get("prod_sn") or 0)
    n_motions = int(_number(object_in(content, "imu_data_format"), "imu_measurements_per_packet", 8))
    return Layout(
        name=name,
        serial=0 if is_legacy or not re.fullmatch(r"\d{1,18}", name) else int(name),
        init_id=0 if is_legacy else int(_number(info, "initialization_id", 0)),
        port=int(_number(config, "udp_port_lidar", 0)),
        fields=fields,
        packet_bytes=packet_bytes,
        other_bytes=frozenset((48, 2 * header + 616, 2 * header + 100 + 36 * n_motions)),
        frame_id=(10, 2) if is_legacy else (4, 4) if is_fusa else (2, 2),
        is_fusa=is_fusa,
        places=(header, per_packet, column_bytes, status, first, pixel_bytes),
        shape=(n_beams, n_columns),
        packets_of_turn=min((end - begin) % n_packets + 1, n_packets),
        altitude=altitude,
        azimuth=azimuth,
        to_lidar=_transform(beams, "beam_to_lidar_transform", to_beam),
        to_sensor=_transform(lidar, "lidar_to_sensor_transform", np.reshape(_LIDAR_TO_SENSOR, (4, 4))),
    )


def _number(content: Mapping[str, Any], name: str, default: float) -> float:
    value = content.get(name)
    return default if value is None else FIELDS.number(name, value, -1e9, 1e9)


def _angles(content: Mapping[str, Any], name: str) -> Floats:
    values = FIELDS.numbers(name, content.get(name))
    if name == "beam_altitude_angles" and len({*values}) < len(values):
        raise PointsError(f"{name}: several beams have the same angle")
    return np.radians(np.array(values))


def _transform(content: Mapping[str, Any], name: str, default: Floats) -> Floats:
    values = content.get(name)
    return default if values is None else np.reshape(FIELDS.numbers(name, values, 16, -1e6, 1e6), (4, 4))


@njit(cache=True, nogil=True)
def fill_turn(
    packets: Bytes, places: Ints64, fields: Ints64, values: NDArray[np.uint32], stamps_ns: NDArray[np.uint64]
) -> None:
    """Put the valid columns of packets where they belong in a turn; later ones replace earlier ones. ``fields`` (k, 3)
    are bit, bits and shift of each, places as `Layout.places`.
    """
    header, per_packet, column_bytes, status, first, pixel_bytes = places
    for packet in range(packets.shape[0]):
        for k in range(per_packet):
            at = header + k * column_bytes
            column = np.int64(packets[packet, at + 8]) | np.int64(packets[packet, at + 9]) << 8
            if not packets[packet, at + status] & 1 or column >= values.shape[2]:
                continue
            stamp = np.uint64(0)
            for byte in range(8):
                stamp |= np.uint64(packets[packet, at + byte]) << np.uint64(8 * byte)
            stamps_ns[column] = stamp
            for j in range(fields.shape[0]):
                bit, bits, shift = fields[j, 0], fields[j, 1], fields[j, 2]
                n_bytes = (bit % 8 + bits + 7) // 8
                mask = (np.int64(1) << bits) - 1
                for beam in range(values.shape[1]):
                    pixel = at + first + beam * pixel_bytes + bit // 8
                    value = np.int64(0)
                    for byte in range(n_bytes):
                        value |= np.int64(packets[packet, pixel + byte]) << (8 * byte)
                    values[j, beam, column] = (value >> (bit % 8) & mask) << shift


class OusterStream:
    """Turns from an Ouster's packets, with the reflectivity or the given field; a packet may come a little late."""

    def __init__(self, layout: Layout, remission_field: str | None) -> None:
        name = (remission_field or "reflectivity").upper()
        if name not in layout.fields:
            raise PointsError(f"there is no field {name!r} for the remission, only {', '.join(sorted(layout.fields))}")
        self._layout, self._rays = layout, _rays(layout)
        self._fields = np.array([layout.fields["RANGE"], layout.fields[name]], np.int64)
        self._ids = 1 << 8 * layout.frame_id[1]
        self._now: int | None = None  # the turn that packets are collected of
        self._done: int | None = None  # the one before it
        self._packets: list[bytes] = []  # of the turn
        self._there: set[int] = set()  # their places in it
        self._ahead: list[tuple[int, bytes]] = []  # of later turns

    def numbers_of(self, packet: bytes | memoryview) -> tuple[int, int]:
        """Serial number and initialization_id that a packet of the right size carries."""
        serial_at, init_at = (11, 1) if self._layout.is_fusa else (7, 4)
        serial = int.from_bytes(packet[serial_at : serial_at + 5], "little")
        return serial, int.from_bytes(packet[init_at : init_at + 3], "little")

    def is_of_sensor(self, packet: bytes | memoryview) -> bool:
        """Whether these are the numbers that the metadata says, where both have them."""
        serial, init_id = self.numbers_of(packet)
        return self._layout.serial in (0, serial) and self._layout.init_id in (0, init_id)

    def add(self, packet: bytes) -> Iterator[TimedScan]:
        """The turn that is whole with this packet, or whose missing packets are no longer awaited."""
        at, size = self._layout.frame_id
        turn = int.from_bytes(packet[at : at + size], "little")
        if self._now is not None or self._done is None or self._later(turn, self._done) > 0:
            self._ahead.append((turn, packet))
            yield from self._use(_MOST_AHEAD)

    def end(self) -> Iterator[TimedScan]:
        """The last turns, which may be parts."""
        while self._now is not None or self._ahead:
            yield from self._use(0)

    def _use(self, most: int) -> Iterator[TimedScan]:
        """Collect the packets of the turn; it is over if it is whole, or ``most`` others wait."""
        if self._now is None:
            first = self._ahead[0][0]
            self._now = min((turn for turn, _ in self._ahead), key=lambda turn: self._later(turn, first))
        header, per_packet = self._layout.places[:2]
        for turn, packet in self._ahead:
            if turn == self._now:
                self._packets.append(packet)
                self._there.add(int.from_bytes(packet[header + 8 : header + 10], "little") // per_packet)
        self._ahead = [entry for entry in self._ahead if self._later(entry[0], self._now) > 0]
        if len(self._there) >= self._layout.packets_of_turn or len(self._ahead) >= most:
            yield self._finished()

    def _later(self, turn: int, other: int) -> int:
        """How many turns the one comes after the other; they are counted in 16 or 32 bits, and anew by a sensor that
        starts: what seems to come much too late is new.
        """
        return (turn - other + _MOST_AHEAD) % self._ids - _MOST_AHEAD

    def _finished(self) -> TimedScan:
        table = np.frombuffer(b"".join(self._packets), np.uint8).reshape(len(self._packets), -1)
        self._done, self._now, self._packets, self._there = self._now, None, [], set()
        values = np.zeros((2, *self._layout.shape), np.uint32)
        stamps_ns = np.zeros(self._layout.shape[1], np.uint64)
        fill_turn(table, np.array(self._layout.places), self._fields, values, stamps_ns)
        return _scan_of(values[0].ravel(), values[1].ravel(), stamps_ns, self._rays)


def _rays(layout: Layout) -> tuple[Floats, Floats]:
    """Of each pixel, beam by beam (n, 3): direction [m/mm] and begin [m] of its ray, from which ranges count, as
    Ouster's manuals state them: columns turn clockwise from behind.
    """
    encoder = -2.0 * np.pi / layout.shape[1] * np.arange(layout.shape[1])
    heading, altitude = encoder - layout.azimuth[:, None], np.broadcast_to(layout.altitude[:, None], layout.shape)
    x, z = layout.to_lidar[0, 3], layout.to_lidar[2, 3]
    flat = np.cos(altitude)
    directions = np.stack([flat * np.cos(heading), flat * np.sin(heading), np.sin(altitude)], axis=-1)
    axis = np.stack([x * np.cos(encoder), x * np.sin(encoder), np.full(len(encoder), z)], axis=-1)
    begins = axis - (np.hypot(x, z) if z else x) * directions
    turn, place = layout.to_sensor[:3, :3].T, layout.to_sensor[:3, 3]
    return (_METER * directions @ turn).reshape(-1, 3), (_METER * (begins @ turn + place)).reshape(-1, 3)


def _scan_of(
    range_mm: NDArray[np.uint32],
    remission: NDArray[np.uint32],
    stamps_ns: NDArray[np.uint64],
    rays: tuple[Floats, Floats],
) -> TimedScan:
    """The returns of a turn, beam by beam."""
    returned = np.flatnonzero(range_mm)
    directions, begins = (np.take(of_pixels, returned, axis=0) for of_pixels in rays)
    scan = np.empty((len(returned), 4), np.float32)
    scan[:, :3] = range_mm[returned, None] * directions + begins
    scan[:, 3] = remission[returned]
    times_s = stamps_ns.astype(np.float64) * 1e-9
    return TimedScan(float(times_s.max()), scan, times_s[returned % len(times_s)])
