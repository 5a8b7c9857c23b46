"""Find the scans below the paths of a command line, and name the output files of each scan."""

from __future__ import annotations

import argparse
import os
import re
import tempfile
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ..errors import EdgepercError, ImageError, SensorError
from ..system.names import SCAN_SUFFIXES, by_number, stem_of
from ..system.printable import many
from ..system.remote import Remote
from ..types.choices import AUTO_SENSOR, DEFAULT_SENSOR
from .arguments import check_inputs, file_options

if TYPE_CHECKING:
    from ..preprocess.sensor_estimate import SensorEstimate
    from ..readers.identify import KnownSensor
    from ..types.points import Floats32
    from ..types.sensor import SensorProfile


# Folders of scans in data sets, from their roots and folders below.
_LAYOUTS = (
    # KITTI object and tracking; SemanticKITTI
    *("training/velodyne", "training/velodyne/*", "testing/velodyne", "testing/velodyne/*"),
    *("sequences/*/velodyne", "velodyne", "velodyne/*", "*/velodyne"),
    # KITTI raw drives: one, those of a day, those of several days; KITTI-360
    *("data", "velodyne_points/data", "*/velodyne_points/data", "*/*/velodyne_points/data"),
    "data_3d_raw/*/velodyne_points/data",
    # nuScenes' key frames, View of Delft, ONCE
    *("samples/LIDAR_TOP", "LIDAR_TOP", "lidar/training/velodyne", "lidar/testing/velodyne", "data/*/lidar_roof"),
)
# Folder names of these layouts that do not identify a scan.
_LAYOUT_FOLDERS = ("velodyne", "velodyne_points", "data")
TIME_IN_NAME = re.compile(r"[1-9]\d{9,}(\.\d+)?")  # a name that is a time since 1970, in s to ns


class Scans(NamedTuple):
    """Scans found at the paths of a command line."""

    paths: list[Path]  # scan files and captures, each once
    empty: list[Path]  # folders without scans
    of_data_set: bool  # a path is the root of a data set, whose sequences all number their scans from 0


def scan_folders(root: Path) -> list[Path]:
    """Folders with scans: ``root`` itself, or those of a data set below it (`_LAYOUTS`)."""
    from ..readers.captures import scan_files

    if scan_files(root):
        return [root]
    folders = dict.fromkeys(folder for layout in _LAYOUTS for folder in sorted(root.glob(layout)))
    return [folder for folder in folders if folder.is_dir() and scan_files(folder)]


# Public sets whose x is not ahead.
_TURNED = {"nuscenes": ("nuScenes'", "right", -90), "once": ("ONCE's", "left", 90)}
# Where PandaSet, Waymo and Argoverse 2 have scans, which are not read here.
_UNREAD = ("lidar", "*/lidar", "sensors/lidar", "*/sensors/lidar", "*/*/sensors/lidar")


def nothing_below(folder: Path | Remote) -> str:
    """What to say of a folder without scans, by what lies where a data set would have them."""
    from ..readers.captures import nothing_in

    if isinstance(folder, Remote):
        return f"{folder}: no scan in this folder; expected scans or captures"
    places = (place for layout in (*_LAYOUTS, *_UNREAD) for place in sorted(folder.glob(layout)) if place.is_dir())
    place = next(places, None)
    if place is not None:
        return nothing_in(place)
    return f"{nothing_in(folder)}. Nor is it the root of a data set that 'edgeperc run --help' lists"


def find_scans(paths: Sequence[Path]) -> Scans:
    """Scan files and captures in the order of ``paths``; those of a folder, data set or URL's folders are sorted."""
    from ..readers.captures import CAPTURE_SUFFIXES, scan_files

    scans: dict[str, Path] = {}
    empty, of_data_set = [], False
    for path in paths:
        files = [path]
        if isinstance(path, Remote):
            files = path.files(SCAN_SUFFIXES + CAPTURE_SUFFIXES)
            of_data_set |= any(scan.parent != path for scan in files if scan != path)
            empty += [] if files else [path]
        elif is_folder(path):
            folders = scan_folders(path)
            files = [scan for folder in folders for scan in scan_files(folder)]
            of_data_set |= folders not in ([], [path])
            if not files:
                empty.append(path)
        for scan in files:
            scans.setdefault(_absolute(scan), scan)
    return Scans(list(scans.values()), empty, of_data_set)


def is_recording(scan: Path | Remote) -> bool:
    """Whether a path is a capture; what is at a URL is one by its name."""
    from ..readers.captures import CAPTURE_SUFFIXES, is_capture

    return scan.suffix.lower() in CAPTURE_SUFFIXES if isinstance(scan, Remote) else is_capture(scan)


def is_folder(path: Path) -> bool:
    """Whether a path is a folder of scans, not the one of a bag."""
    return path.is_dir() and not is_recording(path)


def check_scans(arguments: argparse.Namespace, scans: Sequence[Path | Remote], *, images: bool = False) -> None:
    """Check that each option of reading is for one of the scans; see `check_inputs`.

    images : the scans are those of images, which are scan files.
    """
    from ..readers.captures import scan_files

    kinds = set[str]()
    for scan in scans:
        if isinstance(scan, Path) and not scan.exists():  # reported when its turn comes
            return
        files = scan_files(scan) if isinstance(scan, Path) and is_folder(scan) else [scan]
        kinds.update("recording" if not images and is_recording(file) else "scan file" for file in files)
        if len(kinds) > 1:
            break
    check_inputs(arguments, kinds, scans[0])


def reading_options(path: Path, arguments: argparse.Namespace) -> dict[str, Any]:
    """Options of `edgeperc.read_scans` that are for this of several inputs, from those of `add_capture`."""
    from ..readers.captures import is_capture

    how = {"topic": arguments.topic, **file_options(arguments)}
    if is_capture(path):
        return how | {"columns": None}  # an origin is refused even if it is for others
    return how if path.is_dir() else how | {"topic": None}


def find_images(paths: Sequence[Path]) -> list[Path]:
    """Image files in the order of ``paths``, those of folders sorted; ImageError for a mixture with scans."""
    from ..readers.images import IMAGE_SUFFIXES

    images: dict[str, Path] = {}
    others = []
    for path in paths:
        files = [path] if path.suffix.lower() in IMAGE_SUFFIXES else []
        if files and isinstance(path, Remote):
            raise ImageError(f"{path}: images are read from this computer; copy it, and pass its path")
        if isinstance(path, Path) and is_folder(path) and not scan_folders(path):
            entries = (file for file in path.glob("[!.]*") if file.suffix.lower() in IMAGE_SUFFIXES)
            files = sorted(entries, key=by_number)
        images |= {_absolute(image): image for image in files}
        others += [] if files else [path]
    if images and others:
        raise ImageError(f"{others[0]} is not an image, and {next(iter(images.values()))} is; pass scans after --scan")
    return [*images.values()]


def check_pairs(arguments: argparse.Namespace, images: Sequence[Path], scans: Sequence[Path | Remote]) -> None:
    """Check that there are as many scans as images, and that no image gets the scan of another one."""

    if len(scans) != len(images):
        counts = f"{many(len(scans), 'scan')} for {many(len(images), 'image')}"
        arguments.usage_error(f"--scan: {counts}; expected as many, each once: run one camera at a time")
    own = {stem_of(scan.name)[0]: scan for scan in scans}
    pairs = [*zip(images, scans, strict=True)]
    # Images may be counted from 1 and scans from 0: then none has the name of its scan.
    if len(own) == len(scans) and any(own.get(image.stem) == scan for image, scan in pairs):
        for image, scan in pairs:
            if own.get(image.stem, scan) != scan:
                arguments.usage_error(
                    f"--scan: {image} would get {scan}, and {own[image.stem]} has its name; expected the scan of each "
                    "image in its place: is an image or a scan missing?"
                )
    _warn_of_times(pairs)


def _warn_of_times(pairs: Sequence[tuple[Path, Path | Remote]]) -> None:
    """Warn of an image whose scan is another one's by the times in their names; clocks may differ, so no error."""
    import numpy as np

    stems = [[stem_of(file.name)[0] for file in pair] for pair in pairs]
    if not all(TIME_IN_NAME.fullmatch(stem) for pair in stems for stem in pair):
        return
    times = np.array(stems, np.float64)
    for (image, scan), (at, taken) in zip(pairs, times, strict=True):
        apart = np.abs(times[:, 1] - at)
        # Half as far: the stamp of a scan may be of the begin, middle or end of its turn.
        if apart.min() < 0.5 * abs(taken - at):
            warnings.warn(
                f"--scan: {image} gets {scan}, and by the times in their names {pairs[int(apart.argmin())][1]} is "
                "nearer. Images and scans are paired in their order: is an image or a scan missing?",
                stacklevel=3,
            )
            return


def scan_namer(path: Path) -> Callable[[int], Path]:
    """Make a function from the index of a scan in a source to a name: its file, or the capture and the index."""
    from ..readers.captures import is_capture, scan_files

    if is_folder(path):
        files = scan_files(path)
        if not any(map(is_capture, files)):
            return files.__getitem__
    elif not is_capture(path):
        return lambda k: path
    return lambda k: path / f"{k:06d}"


def check_profile_place(file: Path) -> None:
    """Check that a sensor profile to write replaces nothing but another one. Raises SensorError."""
    from ..types.sensor import get_sensor

    try:
        if file.exists():
            get_sensor(file)
    except SensorError as exc:
        raise SensorError(
            f"{file} is there, and is no sensor profile; an Ouster's metadata, without which its capture cannot be "
            "read, may have such a name. Choose another one, or remove it"
        ) from exc


_UNITS_DEG = 2.0  # between the beams of two units of a model
# Files that are read for three scans with points.
_LOOKED_AT = 10


def stated_sensor(arguments: argparse.Namespace) -> str:
    """``--sensor``, or the default where it is to be found."""
    return DEFAULT_SENSOR if arguments.sensor in (None, AUTO_SENSOR) else arguments.sensor


def find_sensor(paths: Iterable[Path], arguments: argparse.Namespace) -> SensorEstimate | None:
    """The sensor of the first scans; None without enough points. Raises SensorError, and the error of a capture."""
    from ..preprocess.sensor_estimate import MOST_SCANS, has_enough_points
    from ..readers.captures import is_capture, read_scans

    scans: list[Floats32] = []
    damage: Exception | None = None
    for path in islice(paths, _LOOKED_AT):
        try:
            how = reading_options(path, arguments) | ({"origin_m": None} if is_capture(path) else {})
            read = islice(read_scans(path, **how), MOST_SCANS)
            scans.extend(points for _, points in read if has_enough_points(points))
        except (EdgepercError, OSError) as exc:  # of a scan file, reported when its turn comes
            damage = exc if is_capture(path) else damage
        if len(scans) >= MOST_SCANS:
            break
    if damage is not None and not scans:
        raise damage
    return sensor_in(scans[:MOST_SCANS]) if scans else None


def sensor_in(scans: Sequence[Floats32]) -> SensorEstimate:
    """The sensor of a few scans with enough points, which some of them may not tell. Raises SensorError."""
    from ..preprocess.sensor_estimate import estimate_sensor

    found: list[SensorEstimate] = []
    unknown: list[SensorError] = []
    # One of them may not tell, and hide what the others tell.
    for some in (scans, *([scan] for scan in scans if len(scans) > 1)):
        try:
            found.append(estimate_sensor(some))
        except SensorError as exc:
            unknown.append(exc)
        if some is scans and found and not found[0].doubt:
            return found[0]
    sure = [each for each in found if not each.doubt]
    names = sorted({each.profile.name for each in sure})
    if len(names) > 1:
        raise SensorError(
            f"the first scans are of several sensors: {', '.join(names)}; read those of each on their own"
        )
    if not found:
        raise unknown[0]
    return (sure or found)[0]


def scan_sensor(
    path: Path | Remote, arguments: argparse.Namespace, beside: Iterable[Path] = ()
) -> tuple[str | SensorProfile, str]:
    """The sensor of a scan or capture, and how it is known: by ``--sensor`` (which warns if the capture contradicts),
    by the capture, or by the points of it and the files ``beside``. Raises SensorError, PointsError, MissingExtraError.
    """
    from ..readers.captures import is_capture, known_sensor, scan_files
    from ..readers.identify import KnownSensor, NotSpinningError, contradicts
    from ..types.sensor import PUBLIC_SENSORS, get_sensor

    known: KnownSensor | None = None
    if arguments.sensor in (None, AUTO_SENSOR):
        unnamed: EdgepercError | None = None
        files = beside
        if isinstance(path, Path):  # what is at a URL is a scan file, which names no sensor
            try:
                known = known_sensor(path, arguments.topic)
            except NotSpinningError:
                raise
            except SensorError as exc:
                unnamed = exc
            if known is not None:
                return with_mounting(known.profile, arguments), known.because
            files = scan_files(path) if is_folder(path) else beside or [path]
        try:
            found = find_sensor(files, arguments)
            if found is None and (unnamed is not None or arguments.sensor == AUTO_SENSOR):
                raise SensorError("the sensor cannot be told: no scan has enough points; pass --sensor NAME")
        except (EdgepercError, OSError) as exc:
            raise exc if unnamed is None else SensorError(f"{unnamed} Nor do the points tell: {exc}") from exc
        if found is None:  # so few points are refused, or warned of, when they are perceived
            return with_mounting(DEFAULT_SENSOR, arguments), "the default: too few points to tell"
        found.tell_doubt(getattr(arguments, "on_mismatch", None), f"{path}: ")
        return with_mounting(found.profile, arguments), str(found)
    given = get_sensor(arguments.sensor)
    try:
        known = known_sensor(path, arguments.topic) if isinstance(path, Path) else None
    except EdgepercError:  # it need not name its sensor, and reading it tells of damage
        known = None
    what, is_other = "the capture", known is not None and contradicts(given, known.profile)
    is_own = given.name not in PUBLIC_SENSORS and given.pattern is None
    if known is None and is_own and isinstance(path, Path) and not is_capture(path):
        with suppress(SensorError):
            found = find_sensor([next(iter(beside), path)], arguments)
            if found is not None and found.is_built_in:
                known, what = KnownSensor(found.profile, str(found)), "the points"
                pairs = zip(given.elevations_deg, found.profile.elevations_deg, strict=False)
                off_deg = max(abs(one - other) for one, other in pairs)
                is_other = given.n_beams != found.profile.n_beams or off_deg > _UNITS_DEG
    if known is not None and is_other:
        warnings.warn(
            f"{path}: --sensor says {given.name}, {what} {known.profile.name} ({known.because}); it is read as "
            f"{given.name}",
            stacklevel=2,
        )
    return with_mounting(arguments.sensor, arguments), "as --sensor says"


class Sensors:
    """The sensors of the scans and captures of a command line: that of scan files is found once for each folder.

    Scans at URLs are fetched for that.
    """

    def __init__(self, arguments: argparse.Namespace, scans: Sequence[Path | Remote] = ()) -> None:
        self._arguments, self._scans = arguments, scans
        self._found: dict[Path | Remote, tuple[str | SensorProfile, str] | SensorError] = {}

    def of(self, path: Path | Remote, url: Remote | None = None) -> tuple[str | SensorProfile, str]:
        """See `scan_sensor`; ``url``: from where the path was fetched."""
        from ..readers.captures import is_capture

        is_file = isinstance(path, Remote) or not (is_capture(path) or path.is_dir())
        key = (url or path).parent if is_file else path
        if key not in self._found:
            beside = [scan for scan in self._scans if is_file and scan.parent == key]
            try:
                self._found[key] = self._of(path, beside)
            except SensorError as exc:
                self._found[key] = exc
        found = self._found[key]
        if isinstance(found, SensorError):
            raise SensorError(f"{path}: {str(found).removeprefix(f'{path}: ')}")
        return found

    def _of(self, path: Path | Remote, beside: Sequence[Path | Remote]) -> tuple[str | SensorProfile, str]:
        urls = [scan for scan in beside if isinstance(scan, Remote) and not is_recording(scan)]
        if not urls or self._arguments.sensor not in (None, AUTO_SENSOR):
            files = [scan for scan in beside if isinstance(scan, Path) and not is_recording(scan)]
            return scan_sensor(path, self._arguments, files)
        with tempfile.TemporaryDirectory(prefix="edgeperc-") as folder:
            return scan_sensor(path, self._arguments, _fetched(urls, Path(folder)))


def _fetched(urls: Iterable[Remote], folder: Path) -> Iterator[Path]:
    """The files at URLs, each fetched when it is asked for; one that cannot be is reported when its turn comes."""
    for url in urls:
        with suppress(EdgepercError, OSError):
            yield url.fetch(folder)


_MOUNTING = {"height_m": "mount_height", "roll_deg": "roll", "pitch_deg": "pitch", "yaw_deg": "turn"}
_ROUNDED = 0.05  # m or degrees, between an option and a file that say the same


def _given(arguments: argparse.Namespace) -> dict[str, float | None]:
    """Values of a `Mounting` that options give; None: to be found."""
    values = {name: getattr(arguments, option, None) for name, option in _MOUNTING.items()}
    return {name: None if value == "street" else value for name, value in values.items() if value is not None}


def check_sensor(arguments: argparse.Namespace) -> None:
    """Check ``--sensor`` and options of its mounting before the first scan; say what of ``--extrinsic`` is not taken.

    Raises SensorError.
    """
    from ..types.mounting import Mounting
    from ..types.sensor import get_sensor

    get_sensor(with_mounting(stated_sensor(arguments), arguments))
    file, given = getattr(arguments, "extrinsic", None), _given(arguments)
    if arguments.sensor in _TURNED and file is None and getattr(arguments, "turn", None) is None:
        published, side, turn = _TURNED[arguments.sensor]
        warnings.warn(
            f"--sensor {arguments.sensor}: as published, x of {published} scans points to the {side}, and x is taken "
            f"for ahead; pass --turn {turn}, or --turn 0 for scans that were turned",
            stacklevel=2,
        )
    if file is None or not given:
        return
    said = Mounting.from_file(file)
    for name, value in given.items():
        of_file = getattr(said, name)
        if value is None or abs((value - of_file + 180.0) % 360.0 - 180.0) > _ROUNDED:
            option, taken = _MOUNTING[name].replace("_", "-"), "street" if value is None else f"{value:g}"
            warnings.warn(
                f"{file} says {name} = {of_file + 0.0:.2f}, and --{option} {taken}, which is taken", stacklevel=2
            )


def with_mounting(sensor: str | SensorProfile, arguments: argparse.Namespace) -> str | SensorProfile:
    """The sensor with ``--extrinsic``, options of single values, ``--accumulate`` and others. Raises SensorError."""
    from ..types.mounting import Mounting
    from ..types.sensor import get_sensor

    values: dict[str, Any] = _given(arguments)
    others = [getattr(arguments, name, None) for name in ("extrinsic", "ego_box", "remission_range", "accumulate")]
    if not values and others == [None] * 4:
        return sensor
    file, ego, remission, accumulate_s = others
    if sensor == AUTO_SENSOR:
        raise SensorError(
            "--sensor auto and a mounting, --ego-box or --remission-range: write the sensor that is found, "
            "edgeperc info SCAN --write FILE, and pass --sensor FILE"
        )
    profile = get_sensor(sensor)
    if accumulate_s is not None:
        profile = profile.accumulated(accumulate_s)
    if remission is not None:
        profile = replace(profile, remission_range=tuple(remission))
    if ego is not None:
        profile = replace(profile, ego_box=((ego[0], ego[1]), (ego[2], ego[3]), (ego[4], ego[5])))
    return replace(profile, mounting=replace(profile.mounting if file is None else Mounting.from_file(file), **values))


def output_names(scans: Sequence[Path], *, keep_folder: bool = False) -> list[Path]:
    """Names of the scans' output files, after as few folders (``keep_folder``: at least one) as make all differ."""
    whole = [Path(_absolute(scan)).parts[1:] for scan in scans]
    short = [(*(p for p in parts[:-1] if p not in _LAYOUT_FOLDERS), parts[-1]) for parts in whole]
    deepest = max(map(len, whole), default=0)
    depths = range(min(2 if keep_folder else 1, deepest), deepest + 1)
    candidates = ([Path(*parts[-depth:]) for parts in kind] for kind in (short, whole) for depth in depths)
    names = next(filter(_all_differ, candidates), [Path(*parts) for parts in whole])
    bare = [name.with_name(re.sub(r"(?i)([^.])((\.pcd)?\.[^.]+)$", r"\1", name.name)) for name in names]
    return bare if _all_differ(bare) else names


def _absolute(path: Path) -> str:
    if isinstance(path, Remote):
        return path.place
    return os.path.abspath(path)  # noqa: PTH100 - resolve() would follow links; a link keeps its name


def _all_differ(names: Sequence[Path]) -> bool:
    # Some file systems do not distinguish A from a.
    return len({str(name).casefold() for name in names}) == len(names)
