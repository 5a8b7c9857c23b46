"""Packets of Hesai's and RoboSense's spinning sensors become turns, by one table of their formats.

A packet has blocks, each with an azimuth, and a distance and a reflectivity of each channel. The angles of the channels
are those of the unit: in a calibration file beside the capture, or in RoboSense's other packets (DIFOP).
"""

from __future__ import annotations

import calendar
import struct
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from ..errors import PointsError
from ..system.kernels import njit
from ..types.points import Bytes, Floats, Ints64, Points
from .packets import DIFOP, Newest
from .times import TimedScan
from .units import Told


class Clock(NamedTuple):
    """Where a packet has its time: the date, or the seconds; Hesai's the microseconds and the speed, too. The rest of
    the seconds is in microseconds unless the kind says otherwise.
    """

    kind: Literal["hesai", "date", "seconds", "nanoseconds"]
    at: int
    micros_at: int = 0
    speed_at: int = 0


class Format(NamedTuple):
    """One row of the table."""

    name: str  # the model, as its profile is called
    title: str  # the model, as its maker calls it
    # of a packet
    header: int
    n_blocks: int
    n_channels: int
    channel_bytes: int
    sizes: tuple[int, ...]  # bytes that a packet may have
    flag: bytes  # the bytes that a block begins with
    first: int  # from there to the first channel; the azimuth is in the two bytes in front of it
    fires_us: tuple[float, ...]  # when each channel fires, after its block
    clock: Clock  # how and where the time is written
    reference: int = 0  # the block that the time is of, 0 or -1
    late_us: float = 0.0  # how much later the block fires
    # of a distance
    unit_m: float = 0.004
    mask: int = 0xFFFF
    mm_at: int = 0  # the byte of a packet that says how many mm the unit is; 0: none does
    lens_m: tuple[float, float] = (0.0, 0.0)  # distance of the lasers from the axis, and height
    rpm: float = 1.0  # of a Hesai's motor: the unit of its speed
    lasers: int = 0  # 16: channels beyond are a second firing or return; 96: every second block has those beyond 48
    elevations_deg: tuple[float, ...] = ()  # of every unit; empty: each unit has its own angles
    spins: bool = True  # or its mirrors do alone

    @property
    def is_hesai(self) -> bool:
        """Whether the maker is Hesai: numbers are little-endian, and azimuth 0 is along y, as its driver has it."""
        return self.clock.kind == "hesai"

    @property
    def n_lasers(self) -> int:
        """Rows of a calibration."""
        return self.lasers or self.n_channels

    def shares_files(self, other: Format) -> bool:
        """Whether a calibration of one can be read as that of the other."""
        return (self.is_hesai, self.spins, self.n_lasers) == (other.is_hesai, other.spins, other.n_lasers)

    def fits(self, payload: memoryview) -> bool:
        """Whether it is a packet of this format."""
        found = format_of(payload)
        return found is not None and (found == self or self.name == ALIKE.get(found.name))

    @property
    def block_bytes(self) -> int:
        """From one block to the next."""
        return self.first + self.n_channels * self.channel_bytes

    @property
    def blocks_at(self) -> range:
        """Where the blocks of a packet begin."""
        return range(self.header, self.header + self.n_blocks * self.block_bytes, self.block_bytes)


class Angles(NamedTuple):
    """What is known of a unit: (lasers, 2) elevation and azimuth of each laser [deg], its speed, and returns."""

    lasers_deg: Floats
    rpm: float = 600.0
    is_dual: bool = False


def _tail(body: int, date: int, micros: int, speed: int) -> Clock:
    """Hesai's, which is behind the body."""
    return Clock("hesai", body + date, body + micros, body + speed)


def _xt(name: str, elevations: Sequence[float], fires_us: Iterable[float], n_blocks: int = 8) -> Format:
    n = len(elevations)
    body = 12 + n_blocks * (2 + 4 * n)
    title = f"Hesai {name.replace('p', 'P', 1).replace('xt', 'XT').replace('m', 'M')}"
    return Format(
        name, title, 12, n_blocks, n, 4, (body + 28,), b"", 2, tuple(fires_us),
        _tail(body, 13, 19, 11), reference=-1, mm_at=9, elevations_deg=tuple(elevations),
    )  # fmt: skip


def _plus(name: str, series: str, n_blocks: int, fires_us: Iterable[float], size: int = 1248) -> Format:
    fires = tuple(fires_us)
    return Format(
        name, f"RoboSense RS-Ruby Plus{series}", 80, n_blocks, len(fires), 3, (size,), b"\xfe", 4, fires,
        Clock("seconds", 10), unit_m=0.005, lens_m=(0.03171, 0.0),
    )  # fmt: skip


_NO_FIRES = (0.0,) * 128
_AT_NS = (0, 848, 2504, 4112, 4144, 4976, 6616, 8240, 8264, 9112, 10768, 12376, 12424, 13280, 14928)
_AT_LASERS = (
    "00734700c438bb8c00374004c83bbc812566921add59eea21659612da5de9aed"
    "19d2512eaae56691dd95221aeea65963c0400c0834778bbc3400000c87487bb8"
)
_OLD, _DATE, _SECONDS = b"\xff\xee", Clock("date", 20), Clock("seconds", 20)
# The first two of each eight channels, whose odd and even ones fire 3.04 us apart; of the last eight, of each half.
_JT_FIRST_US = (
    95.18, 23.24, 77.28, 92.14, 50.26, 11.08, 65.12, 105.82, 38.1, 24.76, 78.8, 93.66, 51.78, 12.6, 66.64, 103.54,
    39.62, 22.48, 76.52, 91.38, 49.5, 10.32, 64.36, 105.06, 37.34, 24.0, 78.04, 92.9, 51.02, 11.84, 65.88, 38.86,
)  # fmt: skip
_JT_US = (
    *(95.18 + 3.04 * (k // 2) if k % 2 == 0 else 23.24 - 3.04 * (k // 2) for k in range(8)),
    *(_JT_FIRST_US[k // 8 * 2 + k % 2] - 3.04 * (k % 8 // 2) for k in range(8, 120)),
    *(_JT_FIRST_US[30 + k // 4] - 3.04 * (k % 4) for k in range(8)),
)
# Of four channels each; how many channels of the 80 fire then.
_PLUS_US = (
    0.0, 1.217, 2.434, 3.652, 4.869, 6.086, 7.304, 8.521, 9.739, 11.323, 12.907, 14.924, 16.941, 18.959, 20.976, 23.127,
    25.278, 27.428, 29.579, 31.963, 34.347, 36.498, 38.648, 40.666, 42.683, 44.267, 45.851, 47.435, 49.019, 50.603,
    52.187, 53.771,
)  # fmt: skip
_PLUS_80 = "44232222222244444444442210000132"
_RUBY = "000112222333444555666778899aabbccddeefff000111222334444556667778899aabbbccdeefff"  # firings of 80 channels
# Of eight channels each, of 96.
_AIRY_US = (0.0, 7.616, 16.184, 24.752, 33.32, 42.84, 52.36, 61.88, 71.4, 79.968, 88.536, 97.104)
_FORMATS = (
    Format("pandar40p", "Hesai Pandar40P", 0, 10, 40, 3, (1262, 1266), _OLD, 4, _NO_FIRES[:40],
           _tail(1240, 16, 10, 8), reference=-1, late_us=-28.58),
    Format("pandar64", "Hesai Pandar64", 8, 6, 64, 3, (1194, 1198), b"", 2, _NO_FIRES[:64],
           _tail(1172, 16, 10, 8), reference=-1, late_us=-42.58, mm_at=5),
    _xt("pandarxt-32", range(15, -17, -1), (6.0 + 1.512 * k for k in range(32))),
    _xt("pandarxt-16", range(15, -17, -2), (6.0 + 3.024 * k for k in range(16))),
    # Two lasers at a time.
    _xt("pandarxt-32m", [round(19.5 - 1.3 * k, 1) for k in range(32)], (6.0 + 2.888 * (k % 16) for k in range(32)), 6),
    Format("pandarqt-64", "Hesai PandarQT-64", 12, 4, 64, 4, (1068, 1072), b"", 2, _NO_FIRES[:64],
           _tail(1044, 18, 12, 10), late_us=25.71, mm_at=9),
    # Whether there are bytes of confidence and of functional safety is in the packet.
    Format("ot128", "Hesai OT128", 12, 2, 128, 3, (), b"", 2, _NO_FIRES,
           _tail(788, 15, 21, 13), reference=-1, mm_at=9),
    # Its packets are an OT128's, but for the unit of the speed; the driver's file of firing times is of every unit.
    Format("jt128", "Hesai JT128", 12, 2, 128, 3, (), b"", 2, _JT_US,
           _tail(788, 15, 21, 13), reference=-1, late_us=-1888.0, mm_at=9, rpm=0.1),
    Format("qt128", "Hesai QT128C2X", 12, 2, 128, 3, (), b"", 2, _NO_FIRES,
           _tail(788, 15, 21, 13), reference=-1, late_us=9.0, mm_at=9),
    # Its `mirror_packets`; 4 bytes more for a number of the packet, 32 for a signature.
    Format("at128", "Hesai AT128", 12, 2, 128, 4, (1082, 1086, 1114, 1118), b"", 3,
           tuple(1e-3 * _AT_NS[int(each, 16)] for each in _AT_LASERS), _tail(1046, 26, 20, 18), mm_at=9, spins=False),
    Format("rs-16", "RoboSense RS-LiDAR-16", 42, 12, 32, 3, (1248,), _OLD, 4,
           tuple(2.8 * (k % 16) + 55.5 * (k // 16) for k in range(32)), _DATE, unit_m=0.005, lens_m=(0.03977, 0.0),
           lasers=16),
    Format("rs-32", "RoboSense RS-LiDAR-32", 42, 12, 32, 3, (1248,), _OLD, 4,
           tuple(2.88 * (k % 16) + 1.44 * (k // 16 + k % 16 // 15) for k in range(32)), _DATE, unit_m=0.005,
           lens_m=(0.04142, 0.0)),
    Format("rs-bpearl", "RoboSense RS-Bpearl", 42, 12, 32, 3, (1248,), _OLD, 4,
           tuple(2.56 * (k % 8) + 25.68 * (k // 8 % 2) + 1.28 * (k // 16) for k in range(32)), _DATE, unit_m=0.005,
           lens_m=(0.01701, 0.09427)),
    Format("rs-bpearl-4", "RoboSense RS-Bpearl", 42, 12, 32, 3, (1248,), _OLD, 4,
           tuple(1.668 * k for k in range(32)), _SECONDS, unit_m=0.0025, lens_m=(0.01829, 0.09571)),
    Format("helios-32", "RoboSense RS-Helios", 42, 12, 32, 3, (1248,), _OLD, 4,
           tuple(1.73 * k for k in range(32)), _SECONDS, unit_m=0.0025, lens_m=(0.03806, 0.0)),
    Format("helios-16", "RoboSense RS-Helios-16P", 42, 12, 32, 3, (1248,), _OLD, 4,
           tuple(1.73 * (k % 16) + 55.56 * (k // 16) for k in range(32)), _SECONDS, unit_m=0.0025,
           lens_m=(0.03806, 0.0), lasers=16),
    Format("rs-airy", "RoboSense Airy", 42, 8, 48, 3, (1248,), _OLD, 4, tuple(_AIRY_US[k // 8] for k in range(96)),
           _SECONDS, unit_m=0.005, mask=0x3FFF, lens_m=(0.01143, 0.06056), lasers=96),
    Format("rs-airy-48", "RoboSense Airy of 48 lasers", 42, 8, 48, 3, (1248,), _OLD, 4,
           tuple(_AIRY_US[k // 4] for k in range(48)), _SECONDS, unit_m=0.005, mask=0x3FFF, lens_m=(0.01143, 0.06056)),
    Format("rs-ruby-80", "RoboSense RS-Ruby Lite", 80, 4, 80, 3, (1248,), b"\xfe", 4,
           tuple(3.236 * int(firing, 16) for firing in _RUBY), Clock("seconds", 10),
           unit_m=0.005, lens_m=(0.03995, 0.0)),
    Format("rs-ruby-128", "RoboSense RS-Ruby", 80, 3, 128, 3, (1248,), b"\xfe", 4,
           tuple(3.236 * (k // 4 % 16) for k in range(128)), Clock("seconds", 10), unit_m=0.005, lens_m=(0.03995, 0.0)),
    _plus("ruby-plus-128", "", 3, (_PLUS_US[k // 4] for k in range(128))),
    _plus("ruby-plus-80", " 80", 4, (us for us, n in zip(_PLUS_US, _PLUS_80, strict=True) for _ in range(int(n)))),
    _plus("ruby-plus-80v", " 80V", 4, (_PLUS_US[k // 4] for k in range(80))),
    _plus("ruby-plus-48", " 48", 8, (_PLUS_US[k // 2] for k in range(48)), 1268),
)  # fmt: skip
FORMATS = {row.name: row for row in _FORMATS}
"""The formats that are decoded, by name."""

# Models with the same packets, which the angles of the unit tell apart; each is taken for the first.
ALIKE = {"ot128": "jt128", "helios-32": "helios-16"}

_MSOP, _MSOP_NEW = bytes.fromhex("55aa050a5aa550a0"), bytes.fromhex("55aa055a")

_OLD_MODELS = {1: "rs-16", 2: "rs-32", 3: "rs-bpearl"}
_OTHER_MODELS = {4: "RS-Ruby", 5: "RS-Ruby Lite"}
# The series of the Ruby Plus, and its models; later manuals name none.
_PLUS = 5
_PLUS_MODELS = {0: "ruby-plus-128", 1: "ruby-plus-128", 2: "ruby-plus-80", 3: "ruby-plus-80v", 4: "ruby-plus-48"}
# By the kind of data, 0 for points, and the model.
_AIRY_MODELS = {(0, 1): "rs-airy-48", (0, 2): "rs-airy"}
# Of Hesai's later sensors: version of the packets, channels and blocks.
_HESAI = {
    (6, 1, 32, 8): "pandarxt-32",
    (6, 1, 16, 8): "pandarxt-16",
    (6, 1, 32, 6): "pandarxt-32m",
    (3, 1, 64, 4): "pandarqt-64",
    (1, 4, 128, 2): "ot128",
    (3, 2, 128, 2): "qt128",
    (4, 3, 128, 2): "at128",
}
_HESAI_NAMES = {
    (4, 3): "AT128",
    (3, 2): "QT128",
    (6, 1): "XT",
    (1, 8): "JT16",
    (2, 5): "ET25",
    (4, 7): "ATX",
    (7, 2): "FT120",
}

# A turn of the fastest settings has a twentieth of it.
_MOST_PACKETS = 20_000
_UPWARD_DEG = 45.0
_HALF_TURN_DEG, _SPEEDS = 180.0, (60.0, 3000.0)


def format_of(payload: memoryview) -> Format | None:
    """The format of a packet with points; None if it has none, or is not decoded."""
    size, head = len(payload), bytes(payload[:12])
    row = None
    if size in FORMATS["pandar40p"].sizes and head[:2] == _OLD:
        row = FORMATS["pandar40p"]
    elif head[:2] == b"\xee\xff" and size > 12:
        name = "pandar64" if head[2:4] == b"\x40\x06" else _HESAI.get((head[2], head[3], head[6], head[7]), "")
        row = FORMATS.get(name)
        if name in ("ot128", "qt128"):
            row = _with_options(FORMATS[name], head[11], size)
    elif head[:8] == _MSOP and size > 32:
        is_new = bytes(payload[31:33]) == b"\x03\x04"
        row = FORMATS.get("rs-bpearl-4" if is_new else _OLD_MODELS.get(payload[30], ""))
    elif head[:4] == _MSOP_NEW and size in (1248, 1268):
        named = (FORMATS[name] for name in ("helios-32", "rs-airy", "rs-ruby-128", "rs-ruby-80", "ruby-plus-48"))
        row = next((each for each in named if _has_flags(payload, each)), None)
        if row is not None and row.header == 80 and (row.name == "ruby-plus-48" or payload[31] == _PLUS):
            row = FORMATS.get(_PLUS_MODELS.get(payload[32], "") if payload[31] == _PLUS else "")
        elif row is not None and row.lasers == 96:
            row = FORMATS.get(_AIRY_MODELS.get((payload[16], payload[32]), ""))
    return row if row is not None and size in row.sizes and _has_flags(payload, row) else None


def name_of(payload: memoryview) -> str | None:
    """What sends such a packet, e.g. ``"Hesai AT128"``; None if it is neither Hesai's nor RoboSense's."""
    row, head = format_of(payload), bytes(payload[:8])
    if row is not None:
        return row.title
    if head[:8] == _MSOP and len(payload) > 30:
        return f"RoboSense {_OTHER_MODELS.get(payload[30], 'sensor')}"
    if head[:4] == _MSOP_NEW or head[:3] == b"\xaa\x55\x05":
        return "RoboSense sensor"
    if head[:2] != b"\xee\xff" or len(payload) < 12:
        return None
    if head[2:4] == b"\x14\x14":
        return "Hesai Pandar20"
    model = _HESAI_NAMES.get((head[2], head[3]))
    return (
        f"Hesai {model}" if model else f"Hesai sensor of {head[6]} lasers (version {head[2]}.{head[3]} of the packets)"
    )


def _with_options(row: Format, options: int, size: int) -> Format:
    """A row for packets with these bytes of confidence and functional safety."""
    wide, safe = options >> 4 & 1, options >> 2 & 1
    moved = 256 * wide + 17 * safe
    clock = Clock("hesai", *(at + moved for at in row.clock[1:]))
    sizes = (max(size, clock.micros_at + 5),)
    return row._replace(channel_bytes=row.channel_bytes + wide, clock=clock, sizes=sizes)


def _has_flags(payload: memoryview, row: Format) -> bool:
    return not row.flag or all(bytes(payload[at : at + len(row.flag)]) == row.flag for at in row.blocks_at)


def angles_of_difop(row: Format, payload: memoryview) -> Angles | None:
    """What a RoboSense's other packet says of the unit; None if it is none, or says nothing."""
    if row.is_hesai or len(payload) != 1248 or bytes(payload[:8]) != DIFOP:
        return None
    content = np.frombuffer(payload, np.uint8)
    if row.name == "rs-16":
        triples = content[1165:1213].reshape(16, 3).astype(np.float64)
        elevation = 1e-4 * (triples @ [65536.0, 256.0, 1.0])
        elevation[:8] *= -1.0
        lasers = np.stack([elevation, np.zeros(16)], axis=1)
        is_set = not np.isin(content[1165:1169], (0, 255)).all()
    else:
        n = row.n_lasers
        per_list = 128 if row.header == 80 else 32 if n <= 32 else 96
        triples = content[468 : 468 + 6 * per_list].reshape(2, per_list, 3)[:, :n].astype(np.float64)
        lasers = (0.01 * (triples[..., 1:] @ [256.0, 1.0]) * np.where(triples[..., 0] > 0, -1.0, 1.0)).T
        is_set = not (triples[0, :, 0] == 255).any() and len(np.unique(lasers[:, 0])) == n
    if not is_set or not (np.abs(lasers) <= 90.0).all():
        return None
    return Angles(
        np.round(lasers, 4).astype(np.float64), float(int.from_bytes(payload[8:10], "big")), payload[300] == 0
    )


def told_apart(row: Format, angles: Angles) -> Format:
    """An OT128, or the JT128 that has the same packets and looks up."""
    if row.name != "ot128" or angles.lasers_deg[:, 0].max() < _UPWARD_DEG:
        return row
    return FORMATS["jt128"]._replace(channel_bytes=row.channel_bytes, clock=row.clock, sizes=row.sizes)


def has_16_lasers(payload: memoryview) -> bool:
    """Whether a DIFOP of a Helios has the angles of 16 lasers alone."""
    others = np.frombuffer(payload, np.uint8)[468 + 48 : 468 + 96].reshape(16, 3)
    return bool((others[:, 0] == 255).all() or not others.any())


def read_angles(path: Path | Told, row: Format) -> Angles:
    """The angles of a calibration file: ``channel,elevation,azimuth`` as Hesai's, or, without channel, RoboSense's."""
    n = row.n_lasers
    rows = []
    for line in path.read_bytes()[: 1 << 20].decode("utf-8-sig", "replace").splitlines():
        try:
            rows.append([float(value) for value in line.split(",")])
        except ValueError:
            continue  # a heading
    lasers = np.array([each[-2:] for each in rows if len(each) in (2, 3)]).reshape(-1, 2)
    if len(lasers) != n or not (np.abs(lasers) <= (90.0, 360.0)).all():
        raise PointsError(
            f"the calibration {path.name} has {len(lasers)} rows of an elevation and an azimuth [deg]; expected {n}, "
            f"one for each laser of a {row.title}"
        )
    return Angles(lasers)


@njit(cache=True, nogil=True)
def fill_returns(
    packets: Bytes, places: Ints64, blocks: Floats, beams: Floats, lens: Floats, points: Points, times_s: Floats
) -> int:
    """Put the returns of packets into points, without second ones at the distance of the first; returns how many.

    places : header, bytes of a block, its first channel, bytes of a channel, whether numbers are big-endian, mask of a
        distance, and from a second return back to the first: blocks (of the same azimuth) or channels.
    blocks : (n, blocks, 3) azimuth [deg], time [s] and speed [deg/s]; not finite: left out.
    beams : (blocks, channels, 3) elevation [rad], azimuth [deg] and time [us] of each channel.
    lens : unit [m], direction of azimuth 0 [deg], distance of the lasers from the axis, height [m].
    """
    header, block_bytes, first, channel_bytes, is_big, mask, back_blocks, back_channels = places
    # Of the elevations and azimuths, once: sines took half of the time.
    up, side = beams[..., 0], np.radians(beams[..., 1])
    cos_up, sin_up, cos_side, sin_side = np.cos(up), np.sin(up), np.cos(side), np.sin(side)
    n = 0
    for p in range(blocks.shape[0]):
        for b in range(blocks.shape[1]):
            azimuth, time_s, speed = blocks[p, b]
            if not np.isfinite(azimuth + time_s + speed):
                continue
            is_pair = back_channels == 0 and b >= back_blocks and blocks[p, b - back_blocks, 0] == azimuth
            for c in range(beams.shape[1]):
                at = header + b * block_bytes + first + c * channel_bytes
                high, low = (at, at + 1) if is_big else (at + 1, at)
                distance = (np.int64(packets[p, high]) << 8 | np.int64(packets[p, low])) & mask
                if distance == 0:
                    continue
                back = 0
                if is_pair:
                    back = back_blocks * block_bytes
                elif 0 < back_channels <= c:
                    back = back_channels * channel_bytes
                if back > 0:
                    other = np.int64(packets[p, high - back]) << 8 | np.int64(packets[p, low - back])
                    if other & mask == distance:
                        continue
                fired = 1e-6 * beams[b, c, 2]
                axis = np.radians(lens[1] - azimuth - speed * fired)
                x, y, range_m = np.cos(axis), np.sin(axis), lens[0] * distance
                flat = range_m * cos_up[b, c]
                points[n, 0] = flat * (x * cos_side[b, c] + y * sin_side[b, c]) + lens[2] * x
                points[n, 1] = flat * (y * cos_side[b, c] - x * sin_side[b, c]) + lens[2] * y
                points[n, 2] = range_m * sin_up[b, c] + lens[3]
                points[n, 3] = packets[p, at + 2]
                times_s[n] = time_s + fired
                n += 1
    return n


class _Packet(NamedTuple):
    content: bytes
    time_s: float
    rpm: float
    azimuths: Floats  # of the blocks; NaN where one is left out


class SpinningStream:
    """Turns from the packets of a sensor, by their format and the angles of the unit."""

    def __init__(self, row: Format, angles: Angles) -> None:
        self.row, self._angles, self._clock = row, angles, row.clock
        self._order: Literal["<", ">"] = "<" if row.is_hesai else ">"
        self._packets: list[_Packet] = []
        self._last_deg, self._size, self._newest = np.nan, 0, Newest()

    def add(self, payload: memoryview) -> Iterator[TimedScan]:
        """The turns that end in a packet of the format: where the azimuth begins anew. All have the size of the first;
        others are left out. One that comes late is of the turn that it comes in.
        """
        self._size = self._size or len(payload)
        if len(payload) != self._size:
            return
        packet = self._packet(payload)
        begin, is_late = 0, self._newest.has_overtaken(packet.time_s)
        for k, azimuth in enumerate(packet.azimuths.tolist()):
            if is_late or azimuth != azimuth:
                continue
            if abs(azimuth - self._last_deg) > _HALF_TURN_DEG:
                yield from self._turn(packet, begin, k)
                begin = k
            self._last_deg = azimuth
        self._packets.append(_part(packet, begin, len(packet.azimuths)))
        if len(self._packets) > _MOST_PACKETS:
            yield from self.end()

    def end(self) -> Iterator[TimedScan]:
        """The last turn, which may be a part."""
        if self._packets:
            yield from self._turn(self._packets[-1], 0, 0)

    def azimuths_of(self, payload: memoryview) -> list[float]:
        """The azimuths of a packet's blocks [deg]; NaN where one is impossible."""
        row = self.row
        hundredths = [struct.unpack_from(f"{self._order}H", payload, at + row.first - 2)[0] for at in row.blocks_at]
        return [0.01 * each if each < 36_000 else np.nan for each in hundredths]

    def _packet(self, payload: memoryview) -> _Packet:
        row, at = self.row, self._clock.at
        # A Ruby counts microseconds by its manual, and nanoseconds by its maker's driver.
        if row.header == 80 and int.from_bytes(payload[at + 6 : at + 10], "big") >= 10**6:
            self._clock = clock = Clock("nanoseconds", at)
            # In the first millisecond of a second, both look alike.
            self._packets = [each._replace(time_s=time_of(clock, memoryview(each.content))) for each in self._packets]
        azimuths = np.array(self.azimuths_of(payload))
        speed_at = row.clock.speed_at
        rpm = row.rpm * struct.unpack_from("<H", payload, speed_at)[0] if speed_at else self._angles.rpm
        is_likely = _SPEEDS[0] <= rpm <= _SPEEDS[1]
        return _Packet(bytes(payload), time_of(self._clock, payload), rpm if is_likely else 600.0, azimuths)

    def _turn(self, packet: _Packet, begin: int, end: int) -> Iterator[TimedScan]:
        """The packets so far and some blocks of another one; nothing, if there is no block among them."""
        packets = [*self._packets, _part(packet, begin, end)]
        self._packets = []
        azimuths = np.array([each.azimuths for each in packets])
        if np.isnan(azimuths).all():
            return
        row = self.row
        unit_m = 1e-3 * packets[0].content[row.mm_at] if row.mm_at else row.unit_m
        content = np.frombuffer(b"".join(each.content for each in packets), np.uint8).reshape(len(packets), -1)
        is_dual = row.lasers == 16 and self._angles.is_dual
        places = (
            row.header, row.block_bytes, row.first, row.channel_bytes, not row.is_hesai, row.mask,
            2 if row.lasers == 96 else 1, 16 if is_dual else 0,
        )  # fmt: skip
        beams = _beams(row, self._angles, is_dual)
        points = np.empty((azimuths.size * row.n_channels, 4), np.float32)
        times_s = np.empty(len(points))
        lens = np.array([unit_m, 90.0 if row.is_hesai else 0.0, *row.lens_m])
        n = fill_returns(content, np.array(places, np.int64), _blocks(row, packets), beams, lens, points, times_s)
        last_s = float(times_s[:n].max()) if n else packets[0].time_s
        yield TimedScan(last_s, points[:n].copy(), times_s[:n].copy())


def _part(packet: _Packet, begin: int, end: int) -> _Packet:
    """A packet with some of its blocks."""
    azimuths = np.full(len(packet.azimuths), np.nan)
    azimuths[begin:end] = packet.azimuths[begin:end]
    return packet._replace(azimuths=azimuths)


def _blocks(row: Format, packets: Sequence[_Packet]) -> Floats:
    """Azimuth, time and speed of each block: the blocks of a packet are as far apart in time as the sensor turns."""
    azimuths = np.array([packet.azimuths for packet in packets])
    speeds = 6.0 * np.array([packet.rpm for packet in packets])
    order = "<" if row.is_hesai else ">"
    at = row.blocks_at[row.reference] + row.first - 2
    references = 0.01 * np.array([struct.unpack_from(f"{order}H", packet.content, at)[0] for packet in packets])
    ahead_deg = (azimuths - references[:, None] + _HALF_TURN_DEG) % 360.0 - _HALF_TURN_DEG
    times_s = np.array([packet.time_s for packet in packets])[:, None] + 1e-6 * row.late_us
    return np.stack(
        [azimuths, times_s + ahead_deg / speeds[:, None], np.broadcast_to(speeds[:, None], azimuths.shape)], -1
    )


def _beams(row: Format, angles: Angles, is_dual: bool) -> Floats:
    """Elevation [rad], azimuth [deg] and time [us] of each channel of each block."""
    block, channel = np.mgrid[: row.n_blocks, : row.n_channels]
    laser = channel % 16 if row.lasers == 16 else channel + 48 * (block % 2) if row.lasers == 96 else channel
    elevation, azimuth = np.moveaxis(angles.lasers_deg[laser], -1, 0)
    fires_us = np.array(row.fires_us)[laser if is_dual or row.lasers == 96 else channel]
    return np.stack([np.radians(elevation), azimuth, fires_us], axis=-1)


def time_of(clock: Clock, payload: memoryview) -> float:
    """The time that a packet states [s]."""
    kind, at, micros_at, _ = clock
    if kind in ("seconds", "nanoseconds"):
        high, low, rest = struct.unpack_from(">HII", payload, at)
        return float((high << 32 | low) + (1e-6 if kind == "seconds" else 1e-9) * rest)
    date = bytes(payload[at : at + 6])
    if kind == "hesai":
        micros = int.from_bytes(payload[micros_at : micros_at + 4], "little")
        seconds = int.from_bytes(date[2:], "big") if date[0] == 0 else _seconds(date[0] % 100, date)
        return seconds + 1e-6 * micros
    millis, micros = struct.unpack_from(">HH", payload, at + 6)
    return _seconds(date[0], date) + 1e-3 * millis + 1e-6 * micros


def _seconds(year: int, date: bytes) -> int:
    """Of a date since 2000; a month that a clock was not set to is the first."""
    return calendar.timegm((2000 + year, date[1] if 1 <= date[1] <= 12 else 1, *date[2:]))
