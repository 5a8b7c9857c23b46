"""Decoding of captures, some by native libraries; `worker` runs it in a process of its own."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from ..errors import MissingExtraError, PointsError
from ..system.clock import Stamp
from ..system.extras import require
from ..system.printable import many
from ..types.points import is_remission_name, table_columns
from .alternation import told_apart
from .bags import open_bag
from .clouds import CLOUD_READERS, Cloud, cloud_points, cloud_table, describe_cloud
from .mcap import BagFile, Channel
from .ouster import check_osf
from .packet_messages import (
    PACKET_READERS,
    ROBOSENSE,
    LidarMessages,
    LidarPackets,
    OusterMessages,
    OusterPacket,
    Packets,
    VelodyneScan,
    VelodyneStream,
    has_points,
    is_metadata_of,
    is_of_unit,
    packets_of_others,
    read_text,
    unit_in,
)
from .packets import (
    SNIFFED_PACKETS,
    Datagrams,
    sender_names,
    velodyne_captured,
    velodyne_name,
    velodyne_packets,
)
from .ports import is_port, listen
from .senders import ALONE, Senders, Whose, layouts_beside
from .tables import MAX_BYTES
from .times import TimedScan, of_plausible_duration, point_times

_Item = TypeVar("_Item")
_DESCRIBED = 200  # packets that show how far apart the columns of a turn are
_OTHERS_AT_PORT = 500  # packets of other Ousters, half a second and more, before one that the metadata is of
_FEWEST_ALIKE = 16  # packets of another Ouster; damaged ones are each unlike
_READERS: Mapping[tuple[str, str], Callable[[memoryview], Cloud | Packets]] = {**CLOUD_READERS, **PACKET_READERS}


def decode(
    path: Path,
    kind: str,
    topic: str | None,
    remission_field: str | None,
    warn: Callable[[str], None],
    alive: Callable[[], None],
    *,
    times: bool = True,
) -> Iterator[TimedScan]:
    """The scans of a capture, decoded in this process; ``warn`` gets a sentence about what was left out, ``alive`` is
    called now and then while a large file is checked.
    """
    job = _Job(path, topic, remission_field, lambda text: warn(f"{path}: {text}"), alive)
    if kind in (".lvx2", ".osf", ".pcap"):
        scans = _packet_scans(kind, job)
    else:
        scans = told_apart(of_plausible_duration(_bag_scans(job, times)), job.say)
    for stamp_s, points, times_s in _with_typed_errors(path, scans):
        yield TimedScan(stamp_s, points, times_s if times else None)


class _Job(NamedTuple):
    """What is decoded, with the options and callbacks of `decode`."""

    path: Path
    topic: str | None
    remission_field: str | None
    say: Callable[[str], None]  # ``warn``, with the path in front
    alive: Callable[[], None]


def describe(path: Path, kind: str, topic: str | None, alive: Callable[[], None]) -> dict[str, Any]:
    """What a capture says about its sensor, as JSON types; `identify` draws the conclusion.

    Returns: ``metadata`` of an Ouster, as text; ``velodyne``, the names in its packets; ``spinning``, the format of
        Hesai's or RoboSense's packets, ``lasers_deg`` and ``columns``; ``model``, that of one whose mirrors
        sweep; or ``topic``, ``frame``, ``fields`` and ``elevations_deg`` of a point cloud: the median elevation of each
        ring or, without rings, of each row of an organized cloud [deg], None where a ring has no return; empty without
        both.
    """

    def found() -> Iterator[dict[str, Any]]:
        if kind == ".osf":
            frames, chosen = _open_osf(path, topic)
            yield {"metadata": frames.sensor_info[chosen].to_json_string()}
        else:
            payloads, unit, whose = list[memoryview](), None, ALONE
            for name, message, _ in _clouds(path, topic, alive):
                if isinstance(message, VelodyneScan):
                    names = {velodyne_name(packet) for _, packet in message.packets}
                    yield {"velodyne": sorted(names, key=str)}
                elif isinstance(message, LidarPackets):
                    payloads += [packet for _, packet in message.packets]
                    unit, whose = message.unit, message.whose
                    if len(payloads) >= _DESCRIBED:
                        break
                elif isinstance(message, OusterPacket):
                    yield {"metadata": message.metadata}
                else:
                    yield describe_cloud(name, message)
            if payloads:
                from .lidars import describe_packets  # numba

                yield describe_packets(path, payloads, unit, whose)

    return next(_with_typed_errors(path, found()))


def _with_typed_errors(path: Path, items: Iterator[_Item]) -> Iterator[_Item]:
    n_scans = 0
    try:
        for item in items:
            n_scans += 1
            yield item
    except MissingExtraError:
        raise
    except PointsError as exc:
        raise PointsError(f"{path}: {exc}") from exc
    except MemoryError as exc:
        after = f"after {many(n_scans, 'scan')} " if n_scans else ""
        raise PointsError(f"{path}: {after}decoding the capture takes more than {MAX_BYTES:,} bytes of memory") from exc
    except Exception as exc:  # of libraries, and of numpy, struct and sqlite on damaged files
        after = f"after {many(n_scans, 'scan')} " if n_scans else ""
        reason = " ".join(str(exc).split()) or type(exc).__name__
        raise PointsError(f"{path}: {after}the capture cannot be read ({reason}); it is damaged or cut short") from exc
    if not n_scans:
        raise PointsError(
            f"{path}: the capture holds no scan; expected a capture of a LiDAR, an Ouster's with its metadata"
        )


def _choose(what: str, names: Sequence[str], wanted: str | None, others: str = "") -> int:
    """Index of the wanted name, or of the only name; otherwise a `PointsError` lists the names."""
    if wanted in names:
        return names.index(str(wanted))
    there = f"there are {', '.join(names)}" if names else "there is none"
    if wanted is not None:
        raise PointsError(f"no {what} {wanted!r}; {there}{others}")
    if len(names) != 1:
        raise PointsError(f"expected one {what}, {there}{others}{'; choose one by topic (--topic)' if names else ''}")
    return 0


# --- packets ---------------------------------------------------------------------------------------------------------


def _packet_scans(kind: str, job: _Job) -> Iterator[TimedScan]:
    if kind == ".osf":
        yield from _osf_scans(job)
    elif kind == ".lvx2":
        from .livox_packets import lvx2_scans, lvx2_sensors  # numba, which bags do without

        _check_unnamed(job.remission_field)
        yield from lvx2_scans(job.path, _choose("LiDAR", lvx2_sensors(job.path), job.topic), job.alive)
    else:
        yield from _pcap_scans(job)
        is_told = False
        while is_port(job.path):
            try:
                yield from _pcap_scans(job)
                is_told = False
            except PointsError as exc:  # of a sensor that starts, or of another program
                listen(job.path).forget()
                if not is_told:
                    job.say(f"no scans for now, and edgeperc waits: {exc}")
                is_told = True


def _pcap_scans(job: _Job) -> Iterator[TimedScan]:
    """The scans of the sensor that a topic names, or of the only one.

    Packets are counted to the end of the file before the first scan if a topic is given, or if there are a Velodyne's,
    whose library would mix sensors; otherwise behind the last scan.
    """
    listener = listen(job.path) if is_port(job.path) else None
    if listener is not None:
        listener.first(job.alive)  # those who look at them wait without a sign of life
    is_velodyne = next(velodyne_packets(job.path), None) is not None
    is_whole = is_velodyne or job.topic is not None
    senders = Senders(job.path, job.alive, None if is_whole else SNIFFED_PACKETS)
    n_scans = 0
    for scan in _chosen_reader(job, senders, is_velodyne):
        n_scans += 1
        if listener is None or (n_scans > 1 and listener.begun):  # others are parts of a turn
            yield scan
    if listener is not None:  # the next run of its packets may be another sensor's
        return
    senders = senders if is_whole else Senders(job.path, job.alive)
    if senders.cut is not None:  # the decoders end there without a word
        raise senders.cut
    if not n_scans:
        raise PointsError(
            f"the capture has {senders.n_packets} packets, none from a supported LiDAR; expected a capture of a LiDAR, "
            "an Ouster's with its metadata"
        )
    if job.topic is None and len(senders.names) > 1:
        job.say(
            "the scans are those of the first sensor alone; there are packets of several, "
            f"{', '.join(senders.names)}: choose one by topic (--topic)"
        )


def _chosen_reader(job: _Job, senders: Senders, is_velodyne: bool) -> Iterator[TimedScan]:
    """The scans of the sensor that a topic names, or of the only one among those that sent packets."""
    topic = job.topic
    readers: list[tuple[Sequence[str], Callable[[str | None], Iterator[TimedScan]]]] = []
    if is_velodyne:
        readers.append((senders.velodynes, lambda sender: _velodyne_turns(job, sender)))
    if lidar := senders.lidar(topic):
        from .lidars import turns_of  # numba

        readers.append((lidar.senders, lambda sender: turns_of(job.path, lidar, sender, job.alive)))
    ousters = senders.ousters if readers else []
    readers.append((ousters, lambda sender: _ouster_turns(job._replace(topic=sender or topic))))
    known = [name for names, _ in readers for name in names]
    chosen = known[_choose("LiDAR", known, topic)] if len(known) > 1 or (known and topic is not None) else None
    read = readers[0][1] if len(known) < 2 else next(read for names, read in reversed(readers) if chosen in names)
    if read is not readers[-1][1]:
        _check_unnamed(job.remission_field)
    # Of a file with one sensor, packets with a damaged address are its own, too; at a port, another one may begin.
    return read(chosen if len(known) > 1 else known[0] if known and is_port(job.path) else None)


def _check_unnamed(remission_field: str | None) -> None:
    """Refuse a name of the remission that packets without names of their own do not hold."""
    if remission_field is not None and not is_remission_name(remission_field):
        raise PointsError(
            f"there is no field {remission_field!r} for the remission: the packets of this LiDAR hold one remission, "
            "without a name; leave out remission_field (--remission-field)"
        )


def _open_osf(path: Path, topic: str | None) -> tuple[Any, int]:
    """The turns of all sensors in an .osf file, and which of the sensors a topic names."""
    osf = require("ouster.sdk.osf", "ouster", "Reading an Ouster capture", package="ouster-sdk")
    check_osf(path)
    frames = osf.OsfFrameSetSource(str(path))
    return frames, _choose("LiDAR", [str(info.sn) for info in frames.sensor_info], topic)


def _velodyne_turns(job: _Job, sender: str | None) -> Iterator[TimedScan]:
    """The turns of a Velodyne, on its own clock."""
    stream = VelodyneStream("device", "Reading a Velodyne capture")
    if velodyne_name(next(velodyne_packets(job.path, sender))) == "hdl-64e":
        stream.calibrate(packet for _, packet in velodyne_captured(job.path, job.alive, sender))
    for stamp_s, packet in velodyne_captured(job.path, job.alive, sender, endless=True):
        yield from stream.add(stamp_s, packet)
    yield from stream.end()


def _ouster_turns(job: _Job) -> Iterator[TimedScan]:
    """The turns of an Ouster; damaged packets are left out, and at the end said."""
    from .ouster_packets import OusterStream

    layouts = layouts_beside(job.path)
    chosen = layouts[_choose("LiDAR", [layout.name for layout in layouts], job.topic)]
    stream = OusterStream(chosen, job.remission_field)
    sizes = {size for layout in layouts for size in (layout.packet_bytes, *layout.other_bytes)}
    ports, n_other_sizes, n_used, others = set[int](), Counter[int](), 0, Counter[tuple[int, int]]()
    senders = Counter[tuple[str, int]]()
    datagrams = Datagrams(job.path, job.alive, endless=True)
    for datagram in datagrams:
        size = len(datagram.payload)
        if size not in sizes:
            n_other_sizes[datagram.port] += 1
            continue
        ports.add(datagram.port)
        if size != chosen.packet_bytes:
            continue
        if not stream.is_of_sensor(datagram.payload) or (len(layouts) > 1 and chosen.port not in (0, datagram.port)):
            others[stream.numbers_of(datagram.payload)] += 1
            if is_port(job.path) and not n_used and others.total() == _OTHERS_AT_PORT:
                break
            continue
        if not (chosen.serial or chosen.init_id):  # the packets of old firmware do not say whose they are
            senders[datagram.sender, datagram.port] += 1
            if next(iter(senders)) != (datagram.sender, datagram.port):
                continue
        n_used += 1
        yield from stream.add(bytes(datagram.payload))
    yield from stream.end()
    if others and not n_used:
        raise PointsError(
            f"the metadata is of the sensor {chosen.name} (initialization_id {chosen.init_id}), and none of the "
            f"{others.total():,} packets is; expected the metadata that was saved with the capture"
        )
    n_others = sum(n for n in others.values() if n >= _FEWEST_ALIKE or len(layouts) > 1)
    if n_others and job.topic is None and len(layouts) == 1:
        job.say(
            f"left out {n_others:,} packets of another Ouster, or of this one after it had started anew: their "
            "serial number or initialization_id is not that of the metadata. Put that of each beside the capture"
        )
    names = sender_names(senders)
    if len(names) > 1:
        job.say(
            f"the scans are those of the first of several sensors, {', '.join(names)}, whose packets carry no "
            "serial number: save those of each in a file of its own, with its metadata"
        )
    n_bad = datagrams.n_bad + sum(n_other_sizes[port] for port in ports) + others.total() - n_others
    if n_bad and n_used:
        job.say(
            f"dropped {n_bad} damaged packets of the capture: empty, incomplete, or of another length or "
            "number than the metadata says"
        )


def _osf_scans(job: _Job) -> Iterator[TimedScan]:
    core = require("ouster.sdk.core", "ouster", "Reading an Ouster capture", package="ouster-sdk")
    frames, chosen = _open_osf(job.path, job.topic)
    to_xyz = core.XYZLut(frames.sensor_info[chosen], False)  # in the sensor's frame, not the vehicle's
    name = (job.remission_field or "reflectivity").upper()
    for frame_set in frames:
        frame = frame_set[chosen]
        if frame is None:  # no packet of this sensor in this turn
            continue
        if name not in frame.fields:
            raise PointsError(f"there is no field {name!r} for the remission, only {', '.join(frame.fields)}")
        returned = frame.field("RANGE") > 0
        scan = np.empty((np.count_nonzero(returned), 4), np.float32)
        scan[:, :3] = to_xyz(frame)[returned]
        scan[:, 3] = frame.field(name)[returned]
        column = np.nonzero(returned)[1]
        yield TimedScan(float(frame.timestamp.max()) * 1e-9, scan, frame.timestamp[column] * 1e-9)


# --- bags ------------------------------------------------------------------------------------------------------------


def _bag_scans(job: _Job, times: bool) -> Iterator[TimedScan]:
    turns: VelodyneStream | OusterMessages | LidarMessages | None = None
    try:
        for _, message, stamp_s in _clouds(job.path, job.topic, job.alive):
            if isinstance(message, VelodyneScan):
                _check_unnamed(job.remission_field)
                turns = turns if isinstance(turns, VelodyneStream) else VelodyneStream()
                yield from turns.add_message(message)
                continue
            if isinstance(message, OusterPacket):
                if not isinstance(turns, OusterMessages):
                    turns = OusterMessages(message.metadata, job.remission_field)
                yield from turns.add(message, stamp_s)
                continue
            if isinstance(message, LidarPackets):
                _check_unnamed(job.remission_field)
                turns = turns if isinstance(turns, LidarMessages) else LidarMessages(job.path)
                yield from turns.add(message, stamp_s)
                continue
            points = cloud_points(message, remission_field=job.remission_field)
            times_s = point_times(table_columns(cloud_table(message)), points, stamp_s) if times else None
            yield TimedScan(stamp_s, points, times_s)
    except PointsError:  # the end of the file, which is damaged
        if turns is not None:
            yield from turns.end()
        raise
    if turns is not None:
        yield from turns.end()


def _clouds(path: Path, topic: str | None, alive: Callable[[], None]) -> Iterator[tuple[str, Cloud | Packets, float]]:
    """Topic, message and stamp [s] of each point cloud, or of each message of packets in a bag without clouds.

    What is damaged in one file of a bag is reported after the clouds of all.
    """
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        files, damage = open_bag(path, Path(folder), alive)
        topics = {channel for file in files for channel in file.topics()}
        clouds = {channel for channel in topics if channel[1:] in CLOUD_READERS}
        packets = {channel for channel in topics if has_points(channel)}
        if not clouds or (topic or "").partition("@")[0] in {channel.topic for channel in packets}:
            clouds = packets or clouds
        if damage is not None and not clouds:
            raise damage
        others = sorted({f"{channel.topic} ({channel.msgtype})" for channel in topics - clouds})
        names = sorted({channel.topic for channel in clouds})
        more = f"; of other types {', '.join(others)}" if others else ""
        wanted = {channel for channel in topics if channel.topic == topic} if clouds else topics
        if said := packets_of_others(wanted):
            raise PointsError("; ".join(said))
        name, _, frame = (topic, "", "") if topic in names else (topic or "").partition("@")
        chosen = names[_choose("topic of type sensor_msgs/PointCloud2", names, name or None, more)]
        n_scans, frames = 0, dict[str, None]()
        metadata: str | None = None
        unit: tuple[memoryview | None] | None = None
        for message, recorded_ns in _messages(files, clouds, chosen, damage):
            frames.setdefault(message.header.frame_id)
            if frame and message.header.frame_id != frame:
                continue
            if len(frames) > 1 and not frame:
                raise PointsError(
                    f"after {many(n_scans, 'scan')}: the clouds of topic {chosen} are of several sensors, "
                    f"with the frames {', '.join(frames)}; choose one, e.g. topic '{chosen}@{next(iter(frames))}' "
                    "(--topic), or read each and put them together with edgeperc.merge"
                )
            n_scans += 1
            if isinstance(message, OusterPacket):
                metadata = _ouster_metadata(files, topics, chosen) if metadata is None else metadata
                message = message._replace(metadata=metadata)
            elif isinstance(message, LidarPackets):
                if unit is None and any(bytes(packet[:4]) in ROBOSENSE for _, packet in message.packets):
                    unit = (_unit(files, topics, chosen),)
                kinds = {channel.msgtype for channel in clouds if channel.topic == chosen}
                alike = sorted({channel.topic for channel in clouds if channel.msgtype in kinds})
                message = message._replace(unit=unit and unit[0], whose=Whose(chosen, names, alike))
            stamp = message.header.stamp
            stamp_s, stamp_ns = stamp.sec + 1e-9 * stamp.nanosec, 10**9 * stamp.sec + stamp.nanosec
            yield chosen, message, Stamp(stamp_s, stamp_ns) if stamp_ns else Stamp(1e-9 * recorded_ns, recorded_ns)
        if not n_scans:
            seen = f" with frame {frame!r}, only {', '.join(frames)}" if frames else ""
            raise PointsError(f"topic {chosen} has no message{seen}; expected point clouds")


def _ouster_metadata(files: Sequence[BagFile], topics: Set[Channel], topic: str) -> str:
    """The text that an Ouster's driver wrote about the sensor."""
    for channel in sorted(channel for channel in topics if is_metadata_of(channel, topic)):
        for file in files:
            for _, raw in file.messages_of(channel) if channel in file.topics() else ():
                return read_text(channel, raw)
    raise PointsError(
        f"topic {topic} holds packets of an Ouster, and the bag has no metadata of the sensor; expected it as a text, "
        f"topic {topic.rpartition('/')[0]}/metadata. Play the bag through Ouster's driver (ouster-ros) with its "
        "metadata, and record its sensor_msgs/PointCloud2"
    )


def _unit(files: Sequence[BagFile], topics: Set[Channel], topic: str) -> memoryview | None:
    """What a RoboSense says of itself: in its topic, in one whose name begins so, or any of a bag with one sensor."""
    n_sensors = len({channel.topic for channel in topics if has_points(channel)})
    for channel in sorted(topics, key=lambda channel: (channel.topic != topic, channel)):
        if channel.topic.startswith(topic) or (is_of_unit(channel) and n_sensors == 1):
            for file in files:
                for _, raw in file.messages_of(channel) if channel in file.topics() else ():
                    if (unit := unit_in(raw)) is not None:
                        return memoryview(bytes(unit))
    return None


def _messages(
    files: Sequence[BagFile], clouds: Set[Channel], topic: str, damage: PointsError | None
) -> Iterator[tuple[Cloud | Packets, int]]:
    """Clouds of a topic and when they were recorded [ns]; damage, or that of a file, is raised after those of all."""
    n = 0
    for file in files:
        try:
            for channel in sorted(channel for channel in file.topics() & clouds if channel.topic == topic):
                for recorded_ns, raw in file.messages_of(channel):
                    message = _READERS[channel.msgtype, channel.encoding](raw)
                    n += 1
                    yield message, recorded_ns
        except PointsError as exc:
            damage = damage or exc
    if damage is not None:
        raise PointsError(f"after {many(n, 'scan')} {damage}" if n else str(damage)) from damage
