"""Which sensor recorded a capture: read from packets, metadata and the fields of point clouds, without native code."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import PointsError, SensorError
from ..types.sensor import SAY_PATTERN, SENSORS, SensorProfile
from .clouds import is_ouster_cloud
from .ouster import check_metadata, metadata_beside, object_in, read_metadata, reading
from .packets import SNIFFED_PACKETS, velodyne_name, velodyne_packets
from .senders import Senders

_CHOICES = f"Pass its name, sensor= or --sensor: {', '.join(SENSORS)}; or a profile of your own, a .json file."

# Vertical field of view [deg] of Ouster's families: lowest and highest of their units; a first-generation OS1 has 33.
_OUSTER_SPANS = {"os2": (18.0, 27.0), "os1": (30.0, 48.0), "os0": (75.0, 100.0)}

# Words in the topic or frame of a point cloud.
_MAKERS = {
    "velodyne": r"velodyne|vlp|vls|hdl|puck",
    "ouster": r"ouster|os_?(sensor|lidar|cloud)|(?<![a-z])os[012]",
    "hesai": r"hesai|pandar",
    "robosense": r"rslidar|robosense",
}
# First letters of the profiles of each maker.
_PREFIXES = {
    "velodyne": ("hdl", "vl"),
    "ouster": ("os",),
    "hesai": ("pandar", "at", "ot", "jt"),
    "robosense": ("rs-", "helios", "ruby"),
}

# Between the median elevation of the rings of a scan and those of the profile of their sensor [deg]. Units differ by up
# to 1.4 from the profile, models with the same number of beams by 2.6 and more.
_RING_ERROR_DEG = 1.0


class KnownSensor(NamedTuple):
    """The sensor of a capture, and how it is known."""

    profile: SensorProfile
    because: str


def contradicts(given: SensorProfile, recorded_by: SensorProfile) -> bool:
    """Whether a profile is of another sensor than that of a capture; one of your own may have any name."""
    return given.n_beams != recorded_by.n_beams or (given.name in SENSORS and given.name != recorded_by.name)


def of_packets(path: Path, topic: str | None = None) -> KnownSensor:
    """The sensor of a pcap file.

    topic : the serial number, if there is metadata of several Ouster sensors; the address of a Velodyne.
    """
    senders = None if topic is None else Senders(path, lambda: None)
    sender = topic if senders is not None and topic in senders.velodynes else None
    names = {velodyne_name(packet) for packet in velodyne_packets(path, sender)}
    is_other = not names or (topic is not None and sender is None)
    by_serial = False
    with suppress(PointsError):
        by_serial = topic is not None and topic in [_serial(read_metadata(file)) for file in metadata_beside(path)]
    senders = senders or Senders(path, lambda: None, SNIFFED_PACKETS) if is_other and not by_serial else None
    known = None if senders is None else _of_lidar(path, senders, topic, beside=bool(names))
    if known is not None:
        return known
    if names and not by_serial:
        return of_velodyne(names)
    contents = [(file.name, read_metadata(file)) for file in metadata_beside(path)]
    chosen = [entry for entry in contents if topic is None or _serial(entry[1]) == topic] or contents
    sensors = [of_metadata(content, f"the metadata {name}") for name, content in chosen]
    if len({entry.profile for entry in sensors}) > 1:
        raise SensorError(
            f"there is metadata of several sensors: {', '.join(name for name, _ in contents)}; choose one by topic "
            "(--topic)"
        )
    return sensors[0]


class NotSpinningError(SensorError):
    """The sensor makes no turns, and must be named: its scans are gathered over time."""


def of_livox() -> NotSpinningError:
    """What to say of Livox' sensors."""
    return NotSpinningError(
        f"the points are of a Livox sensor, which does not spin, and do not say of which model. {SAY_PATTERN}"
    )


def _of_lidar(path: Path, senders: Senders, topic: str | None, *, beside: bool) -> KnownSensor | None:
    """The sensor of Hesai's or RoboSense's packets, with the angles of the unit; None if they are not theirs, or if it
    is ``beside`` a Velodyne and the topic does not name it.
    """
    lidar = senders.lidar(topic)
    if lidar is None or (beside and topic not in lidar.senders):
        return None
    if lidar.row is None:
        raise of_livox()
    from .lidars import columns_of, open_spinning, payloads_of, unit_at  # numba
    from .spinning_packets import Format

    if not isinstance(lidar.row, Format) or not lidar.row.spins:
        return of_model(lidar.row.name)

    sender = topic if topic in lidar.senders and len(lidar.senders) > 1 else None
    unit = unit_at(path, sender or lidar.first)
    payloads = payloads_of(path, sender, lambda: None)
    row, angles = open_spinning(path, lidar.row, payloads, lidar.whose(sender), unit)
    return of_spinning(row.name, angles.lasers_deg.tolist(), columns_of(row, payloads_of(path, sender, lambda: None)))


def of_spinning(name: str, lasers_deg: Sequence[Sequence[float]], columns: int) -> KnownSensor:
    """The sensor of Hesai's or RoboSense's packets, by the name of their format and the angles of the unit."""
    from .spinning_packets import FORMATS  # numba

    title, elevations = FORMATS[name].title, _distinct([elevation for elevation, _ in lasers_deg])
    if not elevations:
        raise SensorError(f"the packets are of a {title}, whose lasers have several times the same angle. {_CHOICES}")
    profile = SENSORS.get(name, SensorProfile(name, elevations, 1800, (0.0, 255.0)))
    because = f"the packets are a {title}'s, with the angles of the unit"
    return KnownSensor(replace(profile, elevations_deg=elevations, columns=columns or profile.columns), because)


def of_model(name: str) -> KnownSensor:
    """The sensor of packets that name the model of a built-in profile."""
    return KnownSensor(SENSORS[name], "named by the packets")


def of_velodyne(names: Collection[str | None]) -> KnownSensor:
    """The sensor of a Velodyne's packets, by the names in them (`packets.velodyne_name`)."""
    name = ", ".join(sorted(map(str, names)))
    if name in SENSORS:
        return of_model(name)
    if {*names} == {None}:
        raise SensorError(f"the packets are a Velodyne's but do not name the model. {_CHOICES}")
    raise SensorError(f"the packets are of a Velodyne {name}, of which no profile is built in. {_CHOICES}")


def of_metadata(content: Any, source: str) -> KnownSensor:
    """The sensor that an Ouster's metadata, as `json.loads` returns it, describes, with its own beam angles and
    columns; errors name the ``source``.
    """
    with reading(source):
        check_metadata(content)
    layout = object_in(content, "lidar_data_format") or object_in(content, "data_format")
    angles = object_in(content, "beam_intrinsics").get("beam_altitude_angles", content.get("beam_altitude_angles"))
    elevations = _distinct(angles)
    line = str(object_in(content, "sensor_info").get("prod_line", content.get("prod_line", "")))
    family = re.match(r"OS-?([012])(?!\d)", line)
    if family:
        model, because = f"os{family[1]}", f"{source} (prod_line {line})"
    elif line or not elevations:
        named = f"a sensor {line!r}, of which no profile is built in" if line else "no sensor"
        raise SensorError(f"{source} names {named}. {_CHOICES}")
    else:
        model, because = _family(elevations[0] - elevations[-1], source), f"the beam angles in {source}"
    in_line = re.search(r"-(16|32|64|128)(?!\d)", line)
    n_beams = len(elevations) or layout.get("pixels_per_column") or (int(in_line[1]) if in_line else 0)
    name = f"{model}-{n_beams}"
    profile = SENSORS.get(name)
    if elevations:
        profile = replace(profile or SENSORS[f"{model}-32"], name=name, elevations_deg=elevations)
        because += ", with its beam angles" if family else ""
    elif profile is None:
        raise SensorError(f"{source} names a sensor {line!r} and no usable beam angles. {_CHOICES}")
    mode = re.match(
        r"(\d{3,4})x", str(content.get("lidar_mode", object_in(content, "config_params").get("lidar_mode")))
    )
    columns = layout.get("columns_per_frame") or (int(mode[1]) if mode else profile.columns)
    return KnownSensor(replace(profile, columns=columns), because)


def of_cloud(cloud: Mapping[str, Any]) -> KnownSensor:
    """The sensor of a point cloud of ROS: its maker by fields, frame and topic, its model by the angles of its rings.

    cloud : ``topic``, ``frame``, ``fields`` and ``elevations_deg``, from `decoders.describe`.
    """
    topic, frame, fields = str(cloud["topic"]), str(cloud["frame"]), [str(name) for name in cloud["fields"]]
    rings = [np.nan if angle is None else float(angle) for angle in cloud["elevations_deg"]]
    if np.isnan(rings).all():
        rings = []
    words = f"{topic} {frame}".lower()
    if {"tag", "line"} <= {*fields}:  # of Livox' drivers alone
        raise of_livox()
    source = f"topic {topic}, frame {frame!r}, fields {', '.join(fields)}"
    of_makers = {
        maker: [profile for name, profile in SENSORS.items() if name.startswith(names)]
        for maker, names in _PREFIXES.items()
    }
    makers = {
        maker
        for maker, profiles in of_makers.items()
        if re.search("|".join([_MAKERS[maker], *(_pattern(profile.name) for profile in profiles)]), words)
    }
    if is_ouster_cloud(fields):
        makers.add("ouster")
    elif not makers and {"intensity", "ring", "time"} <= set(fields):  # converters of other sensors write these too
        makers.add("velodyne")
    if len(makers) != 1:
        raise SensorError(f"the point clouds do not name their sensor ({source}). {_CHOICES}")
    (maker,) = makers
    of_maker = of_makers[maker]
    named = [profile for profile in of_maker if re.search(_pattern(profile.name), words)]
    if rings:
        fitting = _ouster_by_rings(rings, of_maker) if maker == "ouster" else _by_rings(rings, of_maker)
        named = [profile for profile in fitting if not named or profile in named]
    if len(named) != 1:
        angles = f"; {len(rings)} rings from {np.nanmin(rings):.1f} to {np.nanmax(rings):.1f} deg" if rings else ""
        raise SensorError(
            f"the point clouds are of a sensor by {maker.capitalize()}, but its model is unknown ({source}{angles}). "
            f"{_CHOICES}"
        )
    profile = named[0]
    if profile.name == "hdl-64e":  # its driver keeps remission in 0..255, KITTI's files divide by 255
        profile = replace(profile, remission_range=(0.0, 255.0))
    return KnownSensor(profile, f"{source}{'; the elevations of its rings' if rings else ''}")


def _by_rings(rings: Sequence[float], profiles: Sequence[SensorProfile]) -> list[SensorProfile]:
    """Profiles whose beams, from the top or from the bottom, have the elevations of the rings."""
    fitting = []
    for profile in profiles:
        if not profile.n_beams / 2 < len(rings) <= profile.n_beams:
            continue
        beams = np.array(profile.elevations_deg)
        errors = [np.nanmedian(np.abs(order[: len(rings)] - rings)) for order in (beams, beams[::-1])]
        if min(errors) < _RING_ERROR_DEG:
            fitting.append(profile)
    return fitting


def _ouster_by_rings(rings: Sequence[float], profiles: Sequence[SensorProfile]) -> list[SensorProfile]:
    """The profile with so many beams over such a field of view; the beams of units differ from their profile."""
    steps = np.abs(np.diff(rings))
    if np.isnan(steps).all():
        return []
    span = float(np.nanmedian(steps)) * (len(rings) - 1)
    families = [family for family, (low, high) in _OUSTER_SPANS.items() if low <= span <= high]
    return [profile for profile in profiles if profile.name in {f"{family}-{len(rings)}" for family in families}]


def _pattern(name: str) -> str:
    """Matches ways to write a model: os1-64, os1_64, OS1 64; the letter behind hdl-64 may be absent."""
    return r"(?<![a-z0-9])" + name.replace("-", "[-_ ]?").replace("e", "e?") + r"(?![a-z0-9])"


def _family(span_deg: float, source: str) -> str:
    for family, (low, high) in _OUSTER_SPANS.items():
        if low <= span_deg <= high:
            return family
    raise SensorError(f"{source} names no sensor, and its beams span {span_deg:.1f} deg, as no Ouster's. {_CHOICES}")


def _distinct(angles: Any) -> tuple[float, ...]:
    """Beam angles from the top down; empty if there are none, or not one for each beam."""
    if not isinstance(angles, list) or not all(isinstance(angle, int | float) for angle in angles):
        return ()
    distinct = sorted({float(angle) for angle in angles}, reverse=True)
    usable = len(distinct) == len(angles) > 1 and -90.0 < distinct[-1] <= distinct[0] < 90.0
    return tuple(distinct) if usable else ()


def _serial(content: Mapping[str, Any]) -> str:
    return str(object_in(content, "sensor_info").get("prod_sn", content.get("prod_sn", "")))
