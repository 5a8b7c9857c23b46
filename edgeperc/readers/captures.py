"""Read the scans of recordings: folders of scan files, captures of LiDARs' packets, ROS 1 and 2 bags, MCAP."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Literal, NamedTuple

from ..errors import PointsError, SensorError
from ..system.names import SCAN_SUFFIXES, by_number
from ..types.points import Floats32
from ..types.sensor import SensorProfile
from .apart import decode_apart, describe_apart
from .bags import bag_files
from .files import FileOptions, read_points, read_timed_file
from .identify import KnownSensor, of_cloud, of_livox, of_metadata, of_model, of_packets, of_spinning, of_velodyne
from .packets import capture_kind
from .ports import is_port, release
from .times import TimedScan, accumulate
from .unknown import advice_for, missing

CAPTURE_SUFFIXES = (".bag", ".db3", ".lvx2", ".mcap", ".osf", ".pcap", ".pcapng")


def read_scans(
    source: str | os.PathLike[str],
    *,
    topic: str | None = None,
    remission_field: str | None = None,
    columns: int | Sequence[str] | None = None,
    origin_m: Sequence[float] | Literal["auto"] | None = None,
    accumulate_s: float | None = None,
) -> Iterator[tuple[float | None, Floats32]]:
    """Read the scans of a recording, one after another; `read_timed_scans` gives the times of their points too.

    Captures are decoded in a process of their own, because a damaged one can make the libraries that decode them end
    their process. It ends with the iterator: at the last scan, or when the iterator is closed or deleted. It may use
    2 GiB of memory (on Linux; other systems have no such limit) and 60 s for a scan.

    Parameters
    ----------
    source : str or path
        A scan file (`edgeperc.read_points`); a folder of scan files and captures, read in the order of their names,
        10.bin after 9.bin; a Velodyne ``.pcap``; an Ouster ``.osf``, or ``.pcap`` with its metadata next to it in a
        ``.json`` file whose name has the same beginning; a ``.pcap`` of Hesai's, RoboSense's or Livox' sensors, or an
        ``.lvx2``; each ``.pcap`` may be a ``.pcapng``; a ROS 1 ``.bag``, a ROS 2 bag's folder or one file of it, or an
        ``.mcap`` file. Bags are read for messages of type ``sensor_msgs/PointCloud2``, MCAP files for
        ``foxglove.PointCloud`` (protobuf), too; without such, for packets of a Velodyne,
        ``velodyne_msgs/VelodyneScan``, or an Ouster, ``PacketMsg``. The first bytes of a file decide its format, not
        its name. Or UDP ports of this computer, ``udp:2368``, ``udp:6699,7788`` or ``udp:ADDRESS:2368``, with the
        address of this computer or of a group: what a sensor sends there now, without an end, as a ``.pcap`` of it.
        Scans that are taken a second late or more are dropped.
    topic : str, optional
        What to read if there are several sensors: the topic of point clouds; ``TOPIC@FRAME`` for those of one frame;
        the serial number of an Ouster or in an ``.lvx2``; the IP address of another sensor, or ``ADDRESS:PORT``.
    remission_field : str, optional
        Name of the remission field, as in `edgeperc.read_points`; ``reflectivity`` by default for an Ouster capture.
    columns : int or sequence of str, optional
        What scan files without a header hold, as in `edgeperc.read_points`; not of recordings.
    origin_m : sequence of 3 float or "auto", optional
        Place of the sensor in the map of scan files, as in `edgeperc.read_points`.
    accumulate_s : float, optional
        Time over which each scan is gathered, of a sensor that does not spin [s] (`edgeperc.accumulate`, which takes
        its motion out, too). By default, scans are as they are stored.

    Yields
    ------
    stamp_s : float or None
        Time of the scan on the sensor's clock [s]: the end of the scan for packets, the header's stamp for a message;
        when the last packet came for a Velodyne's packets in messages. None for scan files.
    points : (n, 4) float32, C-contiguous
        x, y, z [m] in the sensor's frame, and the raw remission, which the `Perceiver` scales by its sensor's
        ``remission_range``: 0..255 for packets, with an Ouster's reflectivity, but 0..1 for an HDL-64E, as in KITTI's
        files. The first and the last turn of a packet capture may be incomplete.

    Raises
    ------
    PointsError
        The source does not exist, is damaged, holds no scan of a LiDAR, or takes more memory or time than the limits.
        The scans before the damage come first, and those of the other files of a bag.
    MissingExtraError
        The library that reads this kind of capture is not installed.

    Warns
    -----
    UserWarning
        Damaged packets of an Ouster capture were dropped; the message has their number.
    """
    options = _Options(topic, FileOptions(columns, remission_field, origin_m), times=accumulate_s is not None)
    scans = _scans(_path(source), options)
    gathered = scans if accumulate_s is None else accumulate(scans, accumulate_s)
    return ((stamp_s, points) for stamp_s, points, _ in gathered)


def read_timed_scans(
    source: str | os.PathLike[str],
    *,
    topic: str | None = None,
    remission_field: str | None = None,
    columns: int | Sequence[str] | None = None,
    origin_m: Sequence[float] | Literal["auto"] | None = None,
    accumulate_s: float | None = None,
) -> Iterator[TimedScan]:
    """Like `read_scans`, with the time of each point, where the source holds it, for `edgeperc.deskew`.

    Parameters
    ----------
    source, topic, remission_field, columns, origin_m, accumulate_s
        As in `read_scans`.

    Yields
    ------
    stamp_s : float or None
    points : (n, 4) float32
    times_s : (n,) float64 or None
        Time of each point [s]. An Ouster's packets have one for each column, others for each firing. Of point
        clouds, ``.pcd``, ``.ply`` and structured ``.npy`` files, it is the field t, time, timestamp, time_stamp,
        offset_time or time_offset, whose unit shows in the duration of the scan: 2 ms to 2 s. Values below 2 s count
        from ``stamp_s``. NaN where a time is damaged and lies far from all others. None without such a field, or if no
        unit gives such a duration.

    Raises
    ------
    PointsError, MissingExtraError
        As `read_scans`. PointsError also if the times contradict the stamps of the scans, or if the azimuths turn once
        in a time that no LiDAR takes for a turn: below 33 ms, or above 350 ms.
    """
    scans = _scans(_path(source), _Options(topic, FileOptions(columns, remission_field, origin_m), times=True))
    return scans if accumulate_s is None else accumulate(scans, accumulate_s)


def _path(source: object) -> Path:
    """The path of a recording. Raises PointsError."""
    if not isinstance(source, str | os.PathLike):
        raise PointsError(
            f"got a {type(source).__name__}; expected the path of one recording, folder or scan file. Call it for each "
            "of several paths; arrays of points are scans already"
        )
    return Path(source)


class _Options(NamedTuple):
    topic: str | None
    of_files: FileOptions
    times: bool


def _scans(path: Path, options: _Options) -> Iterator[TimedScan]:
    kind = _readable_kind(path)
    if kind == "folder":
        return _folder(path, options)
    if kind == "scan":
        if options.topic is not None:
            raise PointsError(
                f"{path}: a scan file, which has no topic {options.topic!r}: topic (--topic) chooses among the sensors "
                "of a recording; leave it out"
            )
        if options.times:
            return iter([read_timed_file(path, options.of_files)])
        return iter([TimedScan(None, read_points(path, **options.of_files._asdict()), None)])
    if options.of_files.origin_m is not None:
        raise PointsError(
            f"{path}: a recording, whose scans are in the sensor's frame; the origin is that of scan files"
        )
    if options.of_files.columns is not None:
        raise PointsError(
            f"{path}: a recording, which names its values; columns (--columns) are those of scan files without a "
            "header; leave them out"
        )
    return decode_apart(path, kind, options.topic, options.of_files.remission_field, options.times)


def is_capture(path: Path) -> bool:
    """Whether a path is a recording of many scans: a bag's folder, or a file with the first bytes of a capture; by its
    name if it cannot be read, which reading reports.
    """
    try:
        return is_port(path) or _kind(path) not in ("scan", "folder")
    except OSError:
        return path.suffix.lower() in CAPTURE_SUFFIXES


def sensor_of(source: str | os.PathLike[str], *, topic: str | None = None) -> SensorProfile | None:
    """Find out which sensor recorded a capture; pass the result to the `Perceiver`.

    An Ouster's metadata names it and has the beam angles of the unit. The packets of other makers name the model. The
    clouds of a bag name the maker by their fields, topic or frame, and the model by the elevations of their rings.

    Parameters
    ----------
    source : str or path
        As in `edgeperc.read_scans`.
    topic : str, optional
        As in `edgeperc.read_scans`.

    Returns
    -------
    SensorProfile or None
        None for scan files and folders of them: they do not name their sensor.

    Raises
    ------
    SensorError
        The capture does not say which sensor recorded it, or there is no profile of that one; the message lists the
        choices. Or the captures of a folder are of several sensors.
    PointsError, MissingExtraError
        As `edgeperc.read_scans`.
    """
    known = known_sensor(_path(source), topic)
    return None if known is None else known.profile


def known_sensor(path: Path, topic: str | None = None) -> KnownSensor | None:
    """Like `sensor_of`, with how it is known."""
    if is_port(path):
        try:
            return _known_sensor(path, ".pcap", topic)
        finally:
            release(path)  # another process reads the scans
    kind = _readable_kind(path)
    if kind == "folder":
        sensors = {file: known_sensor(file, topic) for file in scan_files(path) if file.exists()}
        profiles = {None if known is None else known.profile for known in sensors.values()}
        if len(profiles) > 1:
            names = sorted({"scan files" if profile is None else profile.name for profile in profiles})
            raise SensorError(
                f"{path}: the captures in this folder are of several sensors ({', '.join(names)}); read them one by one"
            )
        return next(iter(sensors.values()), None)
    return None if kind == "scan" else _known_sensor(path, kind, topic)


def _known_sensor(path: Path, kind: str, topic: str | None) -> KnownSensor:
    """That of one capture."""
    try:
        if kind == ".pcap":
            return of_packets(path, topic)
        if kind == ".lvx2":
            raise of_livox()
        description = describe_apart(path, kind, topic)
        if "metadata" in description:
            return of_metadata(json.loads(description["metadata"]), "the metadata")
        if "velodyne" in description:
            return of_velodyne(description["velodyne"])
        if "model" in description:
            return of_model(description["model"])
        if "spinning" in description:
            return of_spinning(description["spinning"], description["lasers_deg"], description["columns"])
        return of_cloud(description)
    except (PointsError, SensorError) as exc:
        raise type(exc)(f"{path}: {str(exc).removeprefix(f'{path}: ')}") from exc


def scan_files(folder: Path) -> list[Path]:
    """The scans and captures in a folder, by name and number, without hidden files; and links to what is not there,
    which reading reports: a scan that was not fetched is missing, too.
    """
    with _reading(folder):
        entries = (
            entry
            for entry in folder.iterdir()
            if entry.suffix.lower() in SCAN_SUFFIXES + CAPTURE_SUFFIXES
            and entry.name[0] != "."
            and (entry.is_file() or (entry.is_symlink() and not entry.exists()))
        )
        return sorted(entries, key=by_number)


def nothing_in(folder: Path) -> str:
    """What to say of a folder without scans, and of what there is in it instead."""
    nothing = (
        f"{folder}: no scan in this folder; expected {', '.join(SCAN_SUFFIXES + CAPTURE_SUFFIXES)}, or a ROS 2 bag's "
        "metadata.yaml"
    )
    files = sorted((entry for entry in folder.glob("[!._]*.*") if entry.is_file()), key=by_number)
    tables = next((file.suffix for file in files if file.suffix.lower() in _TABLE_SUFFIXES), None)
    if tables is not None:
        return f"{nothing}; pass tables of text by name: {folder}/*{tables}"
    for file in files[:_LOOKED_AT]:
        with _reading(file):
            advice = advice_for(_head(file), file.name)
        if advice is not None:
            return f"{nothing}; {file.name} is {advice}"
    return nothing


_TABLE_SUFFIXES = (
    ".csv",
    ".xyz",
    ".pts",
    ".txt",
)  # many others have these names, so that those of a folder are not read
_LOOKED_AT = 10


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Raise `PointsError` where the system refuses: a file or folder of others, or a name that is too long."""
    try:
        yield
    except OSError as exc:
        what = "folder" if os.path.isdir(path) else "file"  # noqa: PTH112 - Path.is_dir would raise again
        raise PointsError(f"{path}: the {what} cannot be read ({exc})") from exc


def _readable_kind(path: Path) -> str:
    """`_kind`, if `read_scans` reads it; PointsError otherwise."""
    if is_port(path):
        return ".pcap"
    with _reading(path):
        if not path.exists():
            expected = "a scan, a folder of scans, a .pcap, .osf, .bag or .mcap"
            raise PointsError(f"{path}: {missing(path, 'file or folder', expected)}")
        kind = _kind(path)
        if kind in CAPTURE_SUFFIXES and capture_kind(head := _head(path)) is None and (advice := advice_for(head)):
            raise PointsError(f"{path}: this is {advice}")
        return kind


def _kind(path: Path) -> str:
    """``"scan"``, ``"folder"``, ``"ros2"`` or one of `CAPTURE_SUFFIXES` but ``.pcapng``, by content or else by name."""
    if path.is_dir():
        is_bag = (path / "metadata.yaml").is_file() or any(path.glob("*.db3"))
        return "ros2" if is_bag and bag_files(path) else "folder"
    if not path.is_file():  # opening a pipe would block
        return "scan"
    by_name = path.suffix.lower() if path.suffix.lower() in CAPTURE_SUFFIXES else "scan"
    return capture_kind(_head(path)) or by_name.replace("pcapng", "pcap")


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(300)


def _folder(folder: Path, options: _Options) -> Iterator[TimedScan]:
    files = scan_files(folder)
    if not files:
        raise PointsError(nothing_in(folder))
    for file in files:
        yield from _scans(file, options)
