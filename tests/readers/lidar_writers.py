"""Packets of Hesai's, RoboSense's and Livox' sensors, written from ranges by what the makers' manuals say of them.

No real captures of these sensors are among the tests' data.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from edgeperc.simulation.samples import simulated_scan

T0_S = 1_750_000_000
Sender = Callable[[Sequence[bytes]], object]
"""Sends packets to a port again and again."""


@dataclass(frozen=True)
class Model:
    """A format in the writer's own words: the sizes and offsets are the manuals', not those of the reader.

    lasers, blocks, channels : of the sensor, of a packet, of a block.
    second : what a block's channels from the 17th or 49th on are: the lasers' second firing, or others.
    """

    name: str
    lasers: int
    blocks: int
    channels: int
    unit_m: float
    step_deg: float = 0.2
    layout: Literal["<", ">"] = ">"
    second: Literal["", "firing", "lasers"] = ""


MODELS = {
    model.name: model
    for model in (
        Model("pandar40p", 40, 10, 40, 0.004, layout="<"),
        Model("pandar64", 64, 6, 64, 0.004, layout="<"),
        Model("pandarxt-32", 32, 8, 32, 0.004, 0.18, layout="<"),
        Model("pandarxt-16", 16, 8, 16, 0.004, 0.18, layout="<"),
        Model("pandarxt-32m", 32, 6, 32, 0.004, 0.18, layout="<"),
        Model("qt128", 128, 2, 128, 0.004, 0.4, layout="<"),
        Model("pandarqt-64", 64, 4, 64, 0.004, 0.6, layout="<"),
        Model("ot128", 128, 2, 128, 0.004, 0.2, layout="<"),
        Model("jt128", 128, 2, 128, 0.004, 0.4, layout="<"),
        Model("rs-16", 16, 12, 32, 0.005, 0.4, second="firing"),
        Model("rs-32", 32, 12, 32, 0.005),
        Model("rs-bpearl", 32, 12, 32, 0.005),
        Model("rs-bpearl-4", 32, 12, 32, 0.0025),
        Model("helios-32", 32, 12, 32, 0.0025),
        Model("helios-16", 16, 12, 32, 0.0025, 0.4, second="firing"),
        Model("rs-airy", 96, 8, 48, 0.005, 0.4, second="lasers"),
        Model("rs-airy-48", 48, 8, 48, 0.005, 0.4),
        Model("rs-ruby-80", 80, 4, 80, 0.005),
        Model("rs-ruby-128", 128, 3, 128, 0.005),
        Model("ruby-plus-128", 128, 3, 128, 0.005),
        Model("ruby-plus-80", 80, 4, 80, 0.005),
        Model("ruby-plus-80v", 80, 4, 80, 0.005),
        Model("ruby-plus-48", 48, 8, 48, 0.005),
    )
}
DATE = bytes((25, 6, 15, 15, 6, 40))  # T0_S


def unit_angles(model: Model, seed: int = 5) -> NDArray[np.float64]:
    """Elevation and azimuth of each laser of a unit, in hundredths of a degree, in an order of its own."""
    rng = np.random.default_rng(seed)
    if model.name == "pandarxt-32m":
        return np.round(np.stack([19.5 - 1.3 * np.arange(32), np.zeros(32)], 1), 1)
    if model.name.startswith("pandarxt"):
        return np.stack([np.linspace(15, -16 if model.lasers == 32 else -15, model.lasers), np.zeros(model.lasers)], 1)
    upward = ("rs-airy", "rs-airy-48", "rs-bpearl", "rs-bpearl-4", "jt128")
    top, bottom = (89.0, 0.5) if model.name in upward else (15.0, -25.0)
    elevation = np.linspace(top, bottom, model.lasers) + rng.uniform(-0.02, 0.02, model.lasers)
    if model.name == "rs-16":  # whose first eight are below
        return np.stack([np.concatenate([-np.arange(15.0, -1.0, -2.0), np.arange(15.0, -1.0, -2.0)]), np.zeros(16)], 1)
    azimuth = rng.uniform(-5.0, 5.0, model.lasers)
    return np.round(np.stack([rng.permutation(elevation), azimuth], axis=1), 2)


def ranges(model: Model, n_columns: int, seed: int = 1) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Distances in units and reflectivities, (columns, lasers), from a simulated scan; a third has no return."""
    rng = np.random.default_rng(seed)
    points = simulated_scan(seed, "vlp-16").points
    meters = np.linalg.norm(points[:, :3], axis=1)
    meters = meters[np.isfinite(meters) & (meters > 0.5)]
    units = np.round(rng.choice(meters, (n_columns, model.lasers)) / model.unit_m).astype(np.int64)
    units[rng.random(units.shape) < 0.3] = 0
    return np.minimum(units, 0x3FFF if "airy" in model.name else 0xFFFF), rng.integers(0, 256, units.shape)


def blocks_of(
    model: Model, units: NDArray[np.int64], remission: NDArray[np.int64], first_deg: float = 0.0
) -> list[tuple[int, NDArray[np.int64], NDArray[np.int64]]]:
    """Azimuth in hundredths of a degree, distances and reflectivities of each block."""
    found = []
    per_block = 2 if model.second == "firing" else 1
    for k in range(0, len(units) - per_block + 1, per_block):
        azimuth = round(100 * (first_deg + k // per_block * model.step_deg)) % 36000
        if model.second == "lasers":
            found += [(azimuth, units[k, half], remission[k, half]) for half in (slice(48), slice(48, 96))]
        else:
            found.append((azimuth, units[k : k + per_block].ravel(), remission[k : k + per_block].ravel()))
    return found


def packets_of(
    model: Model, blocks: Sequence[tuple[int, Any, Any]], rpm: int = 600, t0_us: int = 0, every_us: float = 600.0
) -> list[bytes]:
    """Packets of whole numbers of blocks; the first one's time is T0_S and ``t0_us``."""
    packets = []
    for k in range(0, len(blocks) - model.blocks + 1, model.blocks):
        micros = t0_us + round(every_us * (k // model.blocks))
        packets.append(_packet(model, blocks[k : k + model.blocks], rpm, micros))
    return packets


def _packet(model: Model, blocks: Sequence[tuple[int, Any, Any]], rpm: int, micros: int) -> bytes:
    name = model.name
    wide = name.startswith(("pandarxt", "pandarqt", "ot128", "jt128", "qt128"))
    flag = b"\xff\xee" if name == "pandar40p" or (model.layout == ">" and "ruby" not in name) else b""
    flag = b"\xfe\x00" if "ruby" in name else flag
    body = b""
    for azimuth, units, remission in blocks:
        body += flag + struct.pack(model.layout + "H", azimuth)
        for unit, byte in zip(units.tolist(), remission.tolist(), strict=True):
            body += struct.pack(model.layout + "HB", unit, byte) + (b"\x64" if wide else b"")
    if model.layout == "<":
        return _hesai_packet(model, body, rpm, micros)
    seconds, micros = T0_S + micros // 10**6, micros % 10**6
    utc = seconds.to_bytes(6, "big") + micros.to_bytes(4, "big")
    date = DATE[:5] + bytes([DATE[5] + seconds - T0_S]) + struct.pack(">HH", micros // 1000, micros % 1000)
    old = bytes.fromhex("55aa050a5aa550a0") + bytes(12)
    if name in ("rs-16", "rs-32", "rs-bpearl"):
        head = old + date + bytes([{"rs-16": 1, "rs-32": 2, "rs-bpearl": 3}[name]]) + bytes(11)
    elif name == "rs-bpearl-4":
        head = old + utc + b"\x03\x03\x04" + bytes(9)
    elif "airy" in name:
        head = bytes.fromhex("55aa055a") + bytes(16) + utc + bytes([0, 9, 1 if name == "rs-airy-48" else 2]) + bytes(9)
    elif name.startswith("helios"):
        head = bytes.fromhex("55aa055a") + bytes(16) + utc + bytes(12)
    elif name.startswith("ruby-plus"):
        utc = seconds.to_bytes(6, "big") + (1000 * micros).to_bytes(4, "big")
        number = 1 + ["ruby-plus-128", "ruby-plus-80", "ruby-plus-80v", "ruby-plus-48"].index(name)
        head = bytes.fromhex("55aa055a") + bytes(6) + utc + bytes(11) + bytes([5, number]) + bytes(47)
    else:
        head = bytes.fromhex("55aa055a") + bytes(6) + utc + bytes(60)
    return (head + body).ljust(1268 if name == "ruby-plus-48" else 1248, b"\0")


def _hesai_packet(model: Model, body: bytes, rpm: int, micros: int) -> bytes:
    date = bytes([DATE[0], *DATE[1:5], DATE[5] + micros // 10**6])
    micros %= 10**6
    speed, stamp = struct.pack("<H", 10 * rpm if model.name == "jt128" else rpm), struct.pack("<I", micros)
    if model.name in ("pandar40p", "pandar64"):
        head = b"" if model.name == "pandar40p" else bytes((0xEE, 0xFF, 64, 6, 0, 4, 1, 0))
        return head + body + bytes(8) + speed + stamp + b"\x37\x42" + date
    versions = {"pandarxt": (6, 1), "pandarqt": (3, 1), "ot128": (1, 4), "jt128": (1, 4), "qt128": (3, 2)}
    version = versions[model.name.partition("-")[0]]
    options = 0x15 if model.lasers == 128 else 1  # confidence, functional safety, numbered
    head = bytes((0xEE, 0xFF, *version, 0, 0, model.lasers, model.blocks, 0, 4, 1, options))
    if model.lasers == 128:
        tail = bytes(4 + 17 + 12) + b"\x37" + speed + date + stamp + b"\x42" + bytes(4 + 4)
    elif model.name.startswith("pandarxt"):
        tail = bytes(10) + b"\x37" + speed + date + stamp + b"\x42" + bytes(4)
    else:
        tail = bytes(10) + speed + stamp + b"\x37\x42" + date + bytes(4)
    return head + body + tail


def difop(model: Model, angles: NDArray[np.float64], rpm: int = 600, is_dual: bool = False) -> bytes:
    """RoboSense's packet about the sensor."""
    content = bytearray(bytes.fromhex("a5ff005a11115555") + rpm.to_bytes(2, "big")).ljust(1248, b"\0")
    content[300] = 0 if is_dual else 1
    if model.name == "rs-16":
        content[1165:1213] = b"".join(round(abs(10_000 * e)).to_bytes(3, "big") for e in angles[:, 0].tolist())
        return bytes(content)
    per_list = 128 if "ruby" in model.name else 96 if "airy" in model.name else 32
    for column, at in ((0, 468), (1, 468 + 3 * per_list)):
        written = [bytes([v < 0]) + round(abs(100 * v)).to_bytes(2, "big") for v in angles[:, column].tolist()]
        content[at : at + 3 * per_list] = b"".join(written).ljust(3 * per_list, b"\xff" if column == 0 else b"\0")
    return bytes(content)


def calibration(angles: NDArray[np.float64]) -> str:
    """Hesai's file."""
    rows = "".join(f"{k},{e},{a}\n" for k, (e, a) in enumerate(angles.tolist(), start=1))
    return "Channel,Elevation,Azimuth\n" + rows


def expected(
    model: Model, blocks: Sequence[tuple[int, Any, Any]], angles: NDArray[np.float64], fires_us: NDArray[np.float64],
    lens_m: tuple[float, float], rpm: int = 600,
) -> NDArray[np.float64]:  # fmt: skip
    """x, y, z, reflectivity of each return, in the order of packets, blocks and channels."""
    found = []
    for k, (azimuth, units, remission) in enumerate(blocks):
        for c, (unit, byte) in enumerate(zip(units.tolist(), remission.tolist(), strict=True)):
            if unit:
                laser = c % 16 if model.second == "firing" else c + 48 * (k % 2) if model.second == "lasers" else c
                turned = azimuth / 100 + 6 * rpm * fires_us[k % model.blocks, c] * 1e-6
                elevation, offset = np.radians(angles[laser])
                axis = np.radians((90.0 if model.layout == "<" else 0.0) - turned)
                flat = model.unit_m * unit * np.cos(elevation)
                found.append([
                    flat * np.cos(axis - offset) + lens_m[0] * np.cos(axis),
                    flat * np.sin(axis - offset) + lens_m[0] * np.sin(axis),
                    model.unit_m * unit * np.sin(elevation) + lens_m[1],
                    byte,
                ])  # fmt: skip
    return np.array(found).reshape(-1, 4)


def livox_packets(kind: int, xyz_m: NDArray[np.float64], remission: NDArray[np.int64], is_old: bool) -> list[bytes]:
    """Packets of the new or the old protocol, 96 or 100 points each, one every 0.48 ms."""
    stride = ({0: 13, 1: 9, 2: 14, 3: 10, 4: 14} if is_old else {1: 14, 2: 8, 3: 10, 0x11: 14})[kind]
    returns = 2 if kind == (4 if is_old else 0x11) else 1
    n = 100 if is_old and kind < 2 else 96
    packets = []
    for number, k in enumerate(range(0, len(xyz_m) - n + 1, n)):
        body = b""
        for (x, y, z), byte in zip(xyz_m[k : k + n].tolist(), remission[k : k + n].tolist(), strict=True):
            if (is_old and kind in (1, 3)) or (not is_old and kind == 3):
                r = float(np.linalg.norm((x, y, z)))
                zenith = np.degrees(np.arccos(z / r)) if r else 0.0
                place = struct.pack(
                    "<IHH", round(1e3 * r), round(100 * zenith), round(100 * np.degrees(np.arctan2(y, x)) % 36000)
                )
            elif not is_old and kind == 2:
                place = struct.pack("<hhh", *(round(100 * v) for v in (x, y, z)))
            else:
                place = struct.pack("<iii", *(round(1000 * v) for v in (x, y, z)))
            body += (place + bytes([byte])).ljust(stride, b"\0")
        stamp_ns = T0_S * 10**9 + 480_000 * number
        if is_old:
            packets.append(bytes((5, 1, 1, 0, 0, 0, 0, 0, 1, kind)) + stamp_ns.to_bytes(8, "little") + body)
        else:
            head = struct.pack("<BHHHHBBB", 0, 36 + len(body), 4800, n // returns, number % 65536, 0, kind, 1)
            packets.append(head + bytes(12 + 4) + stamp_ns.to_bytes(8, "little") + body)
    return packets


def mems_packets(
    name: str, units: NDArray[np.int64], places: NDArray[np.int64], remission: NDArray[np.int64], per_frame: int
) -> list[bytes]:
    """Of a RoboSense M1 (distance, pitch and yaw in hundredths of a degree) or E1 (distance, and a direction of 2**15).

    A packet comes every 0.9 ms; packets are counted anew after ``per_frame`` of them.
    """
    size, n_blocks, per_block, lidar = (1210, 25, 5, 0x10) if name == "m1" else (1200, 96, 1, 0x22)
    packets, n = [], n_blocks * per_block
    for k in range(len(units) // n):
        micros = 900 * k
        head = bytes.fromhex("55aa5aa5") + struct.pack(">HHBB", k % per_frame + 1, 0x0100, 4, 0)
        head += (T0_S + micros // 10**6).to_bytes(6, "big") + struct.pack(">I", micros % 10**6) + bytes(10)
        body = b""
        for b in range(n_blocks):
            body += bytes([5 * b, 1]) if name == "m1" else struct.pack(">H", 8 * b)
            for i in range(n * k + per_block * b, n * k + per_block * (b + 1)):
                body += struct.pack(">H", units[i])
                values = places[i].tolist()
                body += (
                    struct.pack(">HH", *(v + 32768 for v in values)) if name == "m1" else struct.pack(">hhh", *values)
                )
                body += bytes([remission[i], 0]) + (b"\0" if name == "m1" else b"")
        packets.append((head + bytes([lidar, 100]) + body).ljust(size, b"\0"))
    return packets


def at128_correction(
    begins: Sequence[int], ends: Sequence[int], lasers: NDArray[np.int64], off: NDArray[np.int8], resolution: int = 1
) -> bytes:
    """Version 1.5: (2, 128) azimuths and elevations in 25,600ths of a degree, (2, 128, 180) hundredths off them."""
    content = bytes((0xEE, 0xFF, 1, 5, 128, len(begins), len(begins))) + bytes(8) + bytes([resolution])
    return (
        content + struct.pack(f"<{2 * len(begins)}I", *begins, *ends) + lasers.astype("<i4").tobytes() + off.tobytes()
    )


def at128_packets(
    motor: Sequence[int], units: NDArray[np.int64], remission: NDArray[np.int64], *, numbered: bool = True
) -> list[bytes]:
    """Of Hesai's AT128: two blocks a packet, each with the angle of the motor [1/25600 deg]; one every 83.332 us."""
    packets = []
    for k in range(0, len(motor) - 1, 2):
        content = bytes((0xEE, 0xFF, 4, 3, 0, 0, 128, 2, 0, 4, 1, 0x10 | numbered))
        for b in (k, k + 1):
            content += struct.pack("<HB", *divmod(motor[b], 256))
            content += b"".join(
                struct.pack("<HBB", *each, 9) for each in zip(units[b].tolist(), remission[b].tolist(), strict=True)
            )
        nanos = 41_666 * k
        content += bytes(4) + bytes(18) + struct.pack("<hIBB", 200, nanos // 1000, 0x37, 0x42)
        content += bytes(2) + T0_S.to_bytes(4, "big") + bytes(8 if numbered else 4)
        packets.append(content)
    return packets


def lvx2_file(packets: Sequence[bytes], serials: Sequence[str] = ("47MDL01",)) -> bytes:
    """The packets of the new protocol in frames of 50 ms; each sensor has all of them."""
    content = b"livox_tech".ljust(16, b"\0") + bytes((2, 0, 0, 0)) + struct.pack("<IIB", 0xAC0EA767, 50, len(serials))
    for k, serial in enumerate(serials):
        content += serial.encode().ljust(32, b"\0") + struct.pack("<IBBB6f", k + 7, 247, 9, 0, *[0.0] * 6)
    for number, k in enumerate(range(0, len(packets), 104)):
        frame = b""
        for packet in packets[k : k + 104]:
            for sensor in range(len(serials)):
                frame += struct.pack("<BIBB", 0, sensor + 7, 8, 1) + packet[28:36] + packet[7:9] + packet[10:11]
                frame += struct.pack("<IB", len(packet) - 36, 0) + bytes(4) + packet[36:]
        content += struct.pack("<QQQ", len(content), len(content) + 24 + len(frame), number) + frame
    return content
