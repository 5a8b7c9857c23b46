"""Find the scans below the paths of a command line, and name the output files of each scan."""

from __future__ import annotations

import argparse
import os
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ..errors import EdgepercError, ImageError
from ..system.remote import Remote
from ..types.choices import DEFAULT_SENSOR

if TYPE_CHECKING:
    from ..readers.identify import KnownSensor
    from ..types.sensor import SensorProfile


# Folders of scans in data sets: KITTI object and tracking, SemanticKITTI, a KITTI raw drive, a day of raw drives.
_LAYOUTS = (
    *("training/velodyne", "training/velodyne/*", "testing/velodyne", "testing/velodyne/*", "sequences/*/velodyne"),
    *("velodyne", "velodyne/*", "velodyne_points/data", "*/velodyne_points/data"),
)
# Folder names of these layouts that do not identify a scan.
_LAYOUT_FOLDERS = ("velodyne", "velodyne_points", "data")


class Scans(NamedTuple):
    """Scans found at the paths of a command line.

    paths : scan files and captures, each once.
    empty : folders without scans.
    of_data_set : whether a path is the root of a data set. Its sequences all number their scans from 0.
    """

    paths: list[Path]
    empty: list[Path]
    of_data_set: bool


def scan_folders(root: Path) -> list[Path]:
    """Folders with scans: ``root`` itself, or the folders of a data set below it.

    Data sets are KITTI's object and tracking sets, SemanticKITTI and KITTI's raw drives.
    """
    from ..readers.captures import scan_files

    if scan_files(root):
        return [root]
    folders = (folder for layout in _LAYOUTS for folder in sorted(root.glob(layout)))
    return [folder for folder in folders if folder.is_dir() and scan_files(folder)]


def find_scans(paths: Sequence[Path]) -> Scans:
    """Find scan files and captures, in the order of ``paths``; the scans of a folder or data set are sorted.

    Those at a URL may lie in any folder below it.
    """
    from ..readers.captures import CAPTURE_SUFFIXES, SCAN_SUFFIXES, is_capture, scan_files

    scans: dict[str, Path] = {}
    empty, of_data_set = [], False
    for path in paths:
        files = [path]
        if isinstance(path, Remote):
            files = path.files(SCAN_SUFFIXES + CAPTURE_SUFFIXES)
            of_data_set |= any(scan.parent != path for scan in files if scan != path)
            empty += [] if files else [path]
        elif path.is_dir() and not is_capture(path):
            folders = scan_folders(path)
            files = [scan for folder in folders for scan in scan_files(folder)]
            of_data_set |= folders not in ([], [path])
            if not files:
                empty.append(path)
        for scan in files:
            scans.setdefault(_absolute(scan), scan)
    return Scans(list(scans.values()), empty, of_data_set)


def find_images(paths: Sequence[Path]) -> list[Path]:
    """Find image files, in the order of ``paths``; those of a folder without scans are sorted. Empty if there are none.

    Raises ImageError.
    """
    from ..readers.captures import is_capture
    from ..readers.images import IMAGE_SUFFIXES

    images: dict[str, Path] = {}
    others = []
    for path in paths:
        files = [path] if path.suffix.lower() in IMAGE_SUFFIXES else []
        if isinstance(path, Remote):
            if files:
                raise ImageError(f"{path}: images are read from this computer; copy it, and pass its path")
            others.append(path)
            continue
        if path.is_dir() and not is_capture(path) and not scan_folders(path):
            files = sorted(file for file in path.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES)
        images |= {_absolute(image): image for image in files}
        others += [] if files else [path]
    if images and others:
        raise ImageError(f"{others[0]} is not an image, and {next(iter(images.values()))} is; pass scans after --scan")
    return [*images.values()]


def scan_namer(path: Path) -> Callable[[int], Path]:
    """Make a function from the index of a scan in a source to a name: its file, or the capture and the index."""
    from ..readers.captures import is_capture, scan_files

    if path.is_dir() and not is_capture(path):
        files = scan_files(path)
        if not any(map(is_capture, files)):
            return files.__getitem__
    elif not is_capture(path):
        return lambda k: path
    return lambda k: path / f"{k:06d}"


def scan_sensor(path: Path, arguments: argparse.Namespace) -> tuple[str | SensorProfile, str]:
    """The sensor of a scan or capture, and how it is known: by ``--sensor``, by the capture, or as the default.

    arguments : argparse.Namespace; with ``sensor`` and ``topic``.
    Raises SensorError, PointsError, MissingExtraError.
    Warns UserWarning: ``--sensor`` contradicts the capture.
    """
    from ..readers.captures import known_sensor
    from ..readers.identify import contradicts
    from ..types.sensor import get_sensor

    known: KnownSensor | None
    if arguments.sensor is None:
        known = known_sensor(path, arguments.topic)
        sensor, because = (DEFAULT_SENSOR, "the default for scan files") if known is None else known
        return with_mounting(sensor, arguments), because
    given = get_sensor(arguments.sensor)
    try:
        known = known_sensor(path, arguments.topic)
    except EdgepercError:  # it need not name its sensor, and reading it tells of damage
        known = None
    if known is not None and contradicts(given, known.profile):
        warnings.warn(
            f"{path}: --sensor says {given.name}, the capture {known.profile.name} ({known.because}); it is read as "
            f"{given.name}",
            stacklevel=2,
        )
    return with_mounting(arguments.sensor, arguments), "as --sensor says"


def with_mounting(sensor: str | SensorProfile, arguments: argparse.Namespace) -> str | SensorProfile:
    """The sensor with what ``--extrinsic``, the options of single values and ``--ego-box`` give.

    Raises SensorError.
    """
    from ..types.mounting import Mounting
    from ..types.sensor import get_sensor

    options = {"height_m": "mount_height", "roll_deg": "roll", "pitch_deg": "pitch", "yaw_deg": "turn"}
    given = {name: getattr(arguments, option, None) for name, option in options.items()}
    values: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    if values.get("yaw_deg") == "street":
        values["yaw_deg"] = None
    file, ego = getattr(arguments, "extrinsic", None), getattr(arguments, "ego_box", None)
    if not values and file is None and ego is None:
        return sensor
    profile = get_sensor(sensor)
    if ego is not None:
        profile = replace(profile, ego_box=((ego[0], ego[1]), (ego[2], ego[3]), (ego[4], ego[5])))
    return replace(profile, mounting=replace(profile.mounting if file is None else Mounting.from_file(file), **values))


def output_names(scans: Sequence[Path], *, keep_folder: bool = False) -> list[Path]:
    """Name the output files of each scan: its own name, after as few folder names as make all names different.

    keep_folder : include at least one folder, such as the sequence of a data set.
    """
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
