"""Times of scan files that have none: of a file of times, and whether their names contradict ``--rate``."""

from __future__ import annotations

import argparse
import math
import re
import sys
import warnings
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import EdgepercError, StampError, TrackingError
from ..system.names import stem_of
from ..system.printable import many
from ..system.remote import Remote
from .output import print_line
from .scans import TIME_IN_NAME, is_recording, reading_options

if TYPE_CHECKING:
    from ..preprocess.motion import Trajectory
    from ..types.points import Floats

_MOST_BYTES = 1 << 26


def times_of(file: Path, scans: Sequence[Path | Remote]) -> dict[Path | Remote, float]:
    """The times of scan files of one drive, by the lines of a file: a line for each, or for each number in their names,
    from 0 on, as KITTI's. Raises StampError, OSError.
    """

    times_s = _read_times(file)
    if len({scan.parent for scan in scans}) > 1 or any(map(is_recording, scans)):
        raise StampError(f"--times {file} is of the scan files of one folder; run each drive by itself")
    if len(times_s) == len(scans):
        return dict(zip(scans, times_s, strict=True))
    ends = [re.search(r"\d+$", stem_of(scan.name)[0]) for scan in scans]
    numbers = [int(end[0]) for end in ends if end is not None]
    if len({*numbers}) < len(scans) or max(numbers, default=0) >= len(times_s):
        raise StampError(
            f"--times {file} has {many(len(times_s), 'time')} for {many(len(scans), 'scan')}; expected one for each, "
            "or, of scans with numbers as names, a line for each number from 0 on"
        )
    return {scan: times_s[number] for scan, number in zip(scans, numbers, strict=True)}


def times_of_set(scans: Sequence[Path | Remote]) -> dict[Path | Remote, float]:
    """The times of scan files that lie as in KITTI's raw and odometry data or in KITTI-360: of the file of times beside
    their folder, which is told. A warning says why a file is not taken.
    """
    folders: dict[Path | Remote, list[Path | Remote]] = {}
    for scan in scans:
        folders.setdefault(scan.parent, []).append(scan)
    times_s: dict[Path | Remote, float] = {}
    for folder, files in folders.items():
        name = _TIMES_BESIDE.get(folder.name)
        if name is not None and isinstance(folder, Path) and (beside := folder.absolute().parent / name).is_file():
            try:
                times_s |= times_of(beside, files)
                print_line(f"scans of {folder} have the times of {beside}", sys.stderr)
            except (OSError, StampError) as exc:
                warnings.warn(f"--track: {folder}: the times beside the scans are not taken: {exc}", stacklevel=2)
    return times_s


def is_of_kitti(poses: Path) -> bool:
    """Whether a file of poses has the twelve numbers of KITTI's format in its first line."""
    head = b""
    with suppress(OSError), poses.open("rb") as file:  # what reads the file tells that it cannot be read
        head = file.read(_MOST_HEAD)
    lines = (line.partition(b"#")[0].split() for line in head.splitlines())
    return len(next(filter(None, lines), ())) == _N_KITTI


def kitti_trajectory(poses: Path, times: Path | None) -> Trajectory:
    """Poses in KITTI's format: those of the camera of a ``calib.txt`` beside them or their times, else the sensor's.
    Raises TrackingError, StampError, CalibrationError, OSError.
    """
    from ..camera.calibration import read_kitti_calibration
    from ..preprocess.motion import Trajectory

    folders = [poses.parent, poses.parent.parent / "sequences" / poses.stem]
    times = times or next((path for path in (folder / "times.txt" for folder in folders) if path.is_file()), None)
    if times is None:
        raise StampError(
            f"--poses {poses}: poses in KITTI's format have no times; pass those of the scans: --times FILE"
        )
    times_s = _read_times(times)
    places: list[tuple[str, Floats | None]] = []
    beside = (folder / "calib.txt" for folder in (times.parent, *folders))
    if (calibration := next(filter(Path.is_file, beside), None)) is not None:
        places.append((f"the camera of {calibration}", read_kitti_calibration(calibration)[0]))
    errors = []
    for whose, place in (*places, ("the sensor", None)):
        try:
            found = Trajectory.from_kitti(poses, times_s, T_camera_sensor=place)
        except TrackingError as exc:  # by their way, they may be those of the other
            errors.append(exc)
        else:
            print_line(f"poses of {poses} are those of {whose}, at the times of {times}", sys.stderr)
            return found
    raise errors[0]


_N_KITTI, _MOST_HEAD = 12, 1 << 16
_TIMES_BESIDE = {"data": "timestamps.txt", "velodyne": "times.txt"}  # by the name of the scans' folder


def _read_times(file: Path) -> list[float]:
    """Times [s] of a file with a line for each: seconds, or dates with times."""
    lines = file.read_bytes()[:_MOST_BYTES].decode("utf-8-sig", "replace").splitlines()
    times_s = list[float]()
    for k, line in enumerate(line.strip() for line in lines if line.strip() and not line.startswith("#")):
        try:
            time_s = float(line) if "-" not in line.lstrip("-") or "e-" in line.lower() else _seconds(line)
        except ValueError:
            time_s = math.nan
        if not math.isfinite(time_s) or (times_s and time_s <= times_s[-1]):
            raise StampError(
                f"--times {file}: time {k + 1} is {line:.40}; expected seconds or dates such as 2011-09-26 "
                "13:02:25.59, one a line, later ones below"
            )
        times_s.append(time_s)
    return times_s


def _seconds(date: str) -> float:
    import numpy as np

    return float(np.datetime64(date, "ns").astype(np.int64)) * 1e-9


_SPUN_S = (0.01, 30.0)  # between two scans; what is outside is no time, as a date written in digits
_GAP = 1.5  # times the usual step between two scans, from which on some are missing


def warn_of_rate(scans: Iterable[Path | Remote], arguments: argparse.Namespace) -> None:
    """Warn of scan files that are not ``1 / --rate`` apart by their names or their points: speeds of tracks
    would be wrong, and tracks would go on from one scene to the next. Names may count anything, so nothing is taken
    from them.
    """
    folders: dict[Path | Remote, list[Path | Remote]] = {}
    for scan in scans:
        if not is_recording(scan):
            folders.setdefault(scan.parent, []).append(scan)
    for folder, files in folders.items():
        told = _contradiction([file.name for file in files], arguments.rate)
        first = [file for file in files[:_TIMED] if isinstance(file, Path)]
        if told := told or _other_rate(_stamps(first, arguments), arguments.rate, "the times of their points"):
            warnings.warn(f"--track: {folder}: {told}", stacklevel=2)


_TIMED = 4  # files that are read for their times


def _stamps(files: Iterable[Path], arguments: argparse.Namespace) -> list[float]:
    """The times of scan files by those of their points, where these are on a clock."""
    from ..readers.captures import read_timed_scans

    stamps_s = []
    for file in files:
        # What is wrong with one is told when its turn comes.
        with warnings.catch_warnings(), suppress(EdgepercError, OSError):
            warnings.simplefilter("ignore")
            scans = read_timed_scans(file, **reading_options(file, arguments) | {"origin_m": None})
            stamps_s += [scan.stamp_s for scan in scans if scan.stamp_s is not None]
    return stamps_s


def _other_rate(times_s: Sequence[float] | Floats, rate_hz: float, by: str) -> str:
    """At which rate scans with these times came, if it is another one; empty if not."""
    import numpy as np

    usual_s = float(np.median(np.diff(times_s))) if len(times_s) > 2 else 0.0
    if not _SPUN_S[0] < usual_s < _SPUN_S[1] or 0.8 < usual_s * rate_hz < 1.25:
        return ""
    return (
        f"by {by}, scans are {usual_s:.3g} s apart, and taken as {1.0 / rate_hz:g} s apart, so that speeds would be "
        f"wrong; pass --rate {1.0 / usual_s:.3g}, or --times FILE"
    )


def _contradiction(names: Sequence[str], rate_hz: float) -> str:
    """How names contradict that scans follow one another at a rate, and what to do; empty if they do not."""
    import numpy as np

    ends = [re.search(r"\d+(\.\d+)?$", stem_of(name)[0]) for name in names]
    words = [end[0] for end in ends if end is not None]
    if len(words) < max(3, len(names)):
        return ""
    values, are_times = np.array(words, np.float64), all(map(TIME_IN_NAME.fullmatch, words))
    if are_times:  # ms, us and ns have three digits more each
        values *= [10.0 ** (-3 * (max(len(word.partition(".")[0]) - 8, 0) // 3)) for word in words]
    elif any("." in word for word in words):
        return ""
    steps = np.diff(values)
    usual = float(np.median(steps))
    if are_times and (told := _other_rate(values, rate_hz, "the times in their names")):
        return told
    is_gap = (steps > _GAP * usual) | (steps < 0.0)
    if usual <= 0.0 or (are_times and usual < _SPUN_S[0]) or not is_gap.any():
        return ""
    k, n_more = int(is_gap.argmax()), int(is_gap.sum()) - 1
    gap = f"{steps[k]:.3g} s pass" if are_times else f"{steps[k] / usual - 1.0:,.0f} scans are missing"
    gap = f"{'times' if are_times else 'numbers'} go back" if steps[k] < 0.0 else gap
    more = f" (and {n_more:,} more such gaps)" if n_more else ""
    return (
        f"by their names, {gap} between {names[k]} and {names[k + 1]}{more}. The two are taken as "
        f"{1.0 / rate_hz:g} s apart, so that speeds would be wrong, "
        "and tracks go on; pass --times FILE, or put the scans before and behind the gap into folders of their own"
    )
