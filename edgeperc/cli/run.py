"""``edgeperc run``: perceive scans, captures, live sources and images."""

from __future__ import annotations

import argparse
import math
import re
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

from ..errors import EdgepercError, ImageError, ModelError, PointsError
from ..records import PerceivedScan
from ..system.extras import require
from ..system.remote import Remote, location
from ..types.choices import AUTO_SENSOR, CAMERA
from .arguments import (
    Commands,
    add_capture,
    add_command,
    add_networks,
    check_inputs,
    chosen_models,
    file_options,
    keywords,
    options,
    positive,
    positive_number,
)
from .output import make_folder, make_places, print_line, progress
from .outputs import check_outputs, files_of
from .report import Outcome, Report
from .scan_times import is_of_kitti, kitti_trajectory, times_of, times_of_set, warn_of_rate
from .scans import (
    Scans,
    Sensors,
    check_pairs,
    check_scans,
    check_sensor,
    find_images,
    find_scans,
    is_folder,
    nothing_below,
    output_names,
    reading_options,
    scan_folders,
    scan_namer,
    stated_sensor,
    with_mounting,
)
from .side_by_side import (
    add_engine,
    check_engine,
    check_scan_files,
    has_workers,
    perceive_side_by_side,
    through_temporary,
)
from .sinks import Sinks, add_sinks, wanted_sinks

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from ..perceiver import Perceiver
    from ..preprocess.motion import Trajectory
    from ..tracking.tracks import Tracks
    from ..types.perception import Perception
    from ..types.points import Points
    from ..types.sensor import SensorProfile


_KINDS = ("png", "html", "labels", "ply")
_RATE_HZ = 10.0  # of files without times, unless --rate says another one
_BETWEEN_DRIVES_S = 100.0  # more than the 60 s over which a tracker remembers its tracks


def add_parser(commands: Commands) -> None:
    """Add ``run``."""
    parser = add_command(
        commands,
        "run",
        run_command,
        help="perceive scans or images: a line or a JSON object for each, and files",
        description="Perceive scans and print one line for each: drivable area [m2], boxes, points of each class and "
        "processing time [ms]; of a camera's images, the share of each class. If a scan fails, the error is printed, "
        "the other scans are processed, and the exit code is 1.",
        examples=[
            "edgeperc run 000123.bin",
            "edgeperc run velodyne/ --out out --png --labels",
            "edgeperc run KITTI/ --json > perceptions.jsonl",
            "edgeperc run drive.pcap --track --gif --out out",
            "edgeperc run scans/ --sensor os1-64",
            "edgeperc run velodyne/ --live --rate 10",
            "edgeperc run street.jpg --out out --png",
            "edgeperc run image_2/000123.png --scan velodyne/000123.bin --json",
            "edgeperc run 0.png --scan 0.bin --calib calib.txt --png --out pictures",
        ],
    )
    reading = options(parser, "input")
    reading(
        "paths PATH...",
        "scan files (.bin, .pcd, .ply, .npy, .npz); folders of them; the root of a KITTI object set, of "
        "SemanticKITTI, of KITTI raw drives, nuScenes (key frames), View of Delft or ONCE; captures: .pcap, .pcapng, "
        ".osf, .bag, .mcap, a ROS 2 bag's folder "
        "(extras 'velodyne', 'bags', and 'ouster' for .osf); ports to which a sensor sends its packets (udp:2368); or "
        "images (.jpg, .png, .webp, .bmp, .ppm) and folders of them (extra 'camera')",
        type=location,
    )
    reading(
        "--scan SCAN...",
        "the scan of each image, in their order: both are perceived in one call (default: images alone)",
        type=Path,
        default=[],
    )
    reading(
        "--calib FILE",
        "KITTI's calibration of LiDAR and left color camera: a file for all images, or a folder with NAME.txt of each "
        "scan; with --scan and --png, NAME_both.png shows the classes of the image on the points, and its road from "
        "above (default: no such picture)",
    )
    add_capture(reading)
    reading(
        "--deskew",
        "straighten scans by the times of their points and the motion of the sensor: that of --poses, or with "
        "--track the tracker's own estimate from the scans before",
    )
    reading(
        "--accumulate S",
        "time over which each scan of a capture is gathered, of a sensor that does not spin (mid-360, hap, avia) "
        "[s] (default: the sensor's)",
        type=positive_number,
    )
    reading(
        "--poses FILE",
        "poses of the sensor on the clock of the scans, for --deskew, --track and --sweeps: lines of time [s], x, y, z "
        "[m] and the quaternion x, y, z, w, TUM's format, or KITTI's, with the times of the scans and calib.txt beside "
        "(default: the tracker's estimate)",
    )
    reading(
        "--quaternion",
        "order of the quaternions in --poses (default: xyzw, unless the poses contradict it)",
        choices=("xyzw", "wxyz"),
    )
    reading(
        "--poses-from",
        "from where the poses in --poses map: sensor, to the world, or world, to the sensor (default: sensor, unless "
        "the poses contradict it)",
        choices=("sensor", "world"),
    )
    reading(
        "--on-mismatch",
        "if a scan differs from the scans that a model was trained on. refuse: fail the scan if the difference is "
        "gross (another unit, other axes, no remission, a room), print a warning otherwise; warn: print a warning; "
        "raise: fail the scan; ignore: do not check (default: %(default)s)",
        choices=("refuse", "warn", "raise", "ignore"),
        default="refuse",
    )
    reading(
        "--anyway",
        "perceive scans that differ grossly too, with a warning: --on-mismatch warn",
        dest="on_mismatch",
        action="store_const",
        const="warn",
    )
    add_networks(parser)
    output = options(parser, "output")
    output("--json", "print one JSON object for each scan, and nothing else, on stdout")
    output("--out DIR", "folder or URL for the files below, made if needed (default: no files)", type=location)
    output("--png", "write NAME.png, a picture (needs the extra 'view'); NAME_scan.png is that of an image's --scan")
    output("--html", "write NAME.html, the labeled points in 3-D for a browser")
    output("--labels", "write NAME.label, SemanticKITTI's layout: one uint32 for each point")
    output("--ply", "write NAME.ply, the points with labels and colors")
    add_sinks(parser)
    add_engine(parser)
    tracking = options(parser, "tracking")
    tracking(
        "--track",
        "track the boxes from scan to scan, in their order; each folder of scan files is a drive. Late scans have no "
        "tracks, and after a jump of the clock, or for another drive, tracking begins anew",
    )
    tracking(
        "--sweeps N",
        "find objects and the ground with the points of the last N scans, 2 to 20, on what stands still: for sensors "
        "of few beams. Needs --track. The sensor moves as --poses or --origin say, else as KISS-ICP finds (extra "
        "'slam') (default: each scan alone)",
        type=positive,
    )
    tracking("--gif", "write tracks.gif, the tracks drawn from above; needs --track, --out and the extra 'view'")
    live = options(parser, "live")
    live(
        "--live",
        "replay one PATH in real time; always take the newest scan and drop older ones that still wait (default for "
        "ports, without files of each scan, --gif, --deskew and --consistency)",
    )
    live(
        "--rate HZ",
        "scans per second of files without time stamps (default: 10)",
        type=positive_number,
        default=_RATE_HZ,
    )
    live(
        "--times FILE",
        "times of the scan files of one drive: a line of seconds, or of a date with a time, for each scan, or for each "
        "number in their names from 0 on, as KITTI's timestamps.txt and times.txt (default: with --track, of such a "
        "file beside their folder; else as --rate says)",
        type=Path,
    )


def make_perceiver(
    arguments: argparse.Namespace,
    *,
    sensor: str | SensorProfile,
    on_mismatch: Literal["refuse", "warn", "raise", "ignore"],
    adapt: Literal["both", "remission", "interpolation", "none"] = "both",
) -> Perceiver:
    """Make a perceiver with the options of the command line. ModelError for one that its models have no use for."""
    from ..perceiver import Perceiver

    perceive = Perceiver(
        chosen_models(arguments),
        sensor=sensor,
        n_threads=arguments.threads,
        on_mismatch=on_mismatch,
        adapt=adapt,
        agree=not arguments.no_agreement,
        **keywords(arguments, "provider", "precision", "score_threshold", "boxes_from", "full_turn", "trusted"),
    )
    kinds, of_turn = {card.view.kind for card in perceive.cards}, {"range_image", "objects", "pillars"}
    for is_given, needed, option in (
        (arguments.full_turn, of_turn, "--full-turn needs a model of all sides"),
        (arguments.boxes_from == "network", {"top_view", "pillars"}, "--boxes-from network needs a detector"),
    ):
        if is_given and not kinds & needed:
            raise ModelError(f"{option}, and {', '.join(card.name for card in perceive.cards)} is none; leave it out")
    return perceive


def run_command(arguments: argparse.Namespace) -> int:
    """Perceive scans; return 1 if some failed."""
    from ..readers.ports import is_port, named

    kinds = [kind for kind in _KINDS if getattr(arguments, kind)]
    # What comes at a port is a live source, unless every scan is wanted.
    wants_all = kinds or arguments.gif or arguments.deskew or arguments.consistency is not None
    arguments.live |= any(map(is_port, arguments.paths)) and not wants_all
    _check_usage(arguments, kinds)
    images = _images(arguments, kinds)
    given = [*images] or ([_live_source(arguments)] if arguments.live else [])
    found = Scans(given, [], False) if given else find_scans(arguments.paths)
    scans = found.paths
    of_lidar = [*filter(None, images.values())] if images else scans
    if of_lidar:
        check_scans(arguments, of_lidar, images=bool(images))
    elif images:
        check_inputs(arguments, (), scans[0])
    check_scan_files(arguments, scans)
    times = {} if arguments.times is None else times_of(arguments.times, scans)
    if arguments.track and not (images or arguments.live or arguments.deskew or times):
        times = times_of_set(scans) if arguments.rate == _RATE_HZ else {}
        warn_of_rate([scan for scan in scans if scan not in times], arguments)
    names = output_names([*map(named, scans)], keep_folder=found.of_data_set) if kinds else []
    targets = [arguments.out / name for name in names] if kinds else [Path()] * len(scans)
    check_outputs(arguments, kinds, images, scans, targets)
    perceivers = _Perceivers(arguments, of_lidar)
    perceivers.check(of_images=bool(images))
    written = [*{target.parent for target in targets if kinds}, *[arguments.out] * (arguments.labels_for is not None)]
    for folder in (folder for folder in written if isinstance(folder, Path)):
        make_folder(folder, f"--out {arguments.out}")
    if arguments.static is not None:
        make_folder(arguments.static, "--static")
    gif = arguments.out / "tracks.gif" if arguments.gif else None
    make_places(arguments.mcap, arguments.rrd, arguments.play, arguments.consistency, gif)
    report = Report(arguments, images)
    for folder in found.empty:
        report.add(Outcome(folder, PointsError(nothing_below(folder))))
    started = time.perf_counter()
    of_ports, ended = any(map(is_port, scans)), None
    sinks = Sinks(arguments, of_ports=of_ports)
    try:
        with progress("file") as show, sinks:
            run = _Run(arguments, perceivers, kinds, sinks, times)
            if has_workers(arguments):
                perceive_side_by_side(arguments, _alone, perceivers, scans, targets, report, show)
            for done, (scan, target) in enumerate(() if has_workers(arguments) else zip(scans, targets, strict=True)):
                show(done, len(scans))
                if images:
                    outcomes = run.image(scan, images[scan], target)
                else:
                    outcomes = run.live(scan) if arguments.live else run.scans(scan, target)
                for outcome in outcomes:
                    report.add(outcome)
    except (KeyboardInterrupt, SystemExit) as exc:  # how what is live ends: its animation comes, too
        if not (arguments.live or of_ports):
            raise
        ended = exc
    n_perceived = report.n - len(found.empty)
    if n_perceived > 1:
        each_ms = 1e3 * (time.perf_counter() - started) / n_perceived
        things = "answers" if arguments.live else "images" if images else "scans"
        print_line(f"{report.n} {things}, {report.n_failed} failed, {each_ms:.0f} ms each with files", sys.stderr)
    if ended is not None:
        raise ended
    return 1 if report.n_failed + sinks.n_failed else 0


def _check_usage(arguments: argparse.Namespace, kinds: Sequence[str]) -> None:
    """Check for contradictory options and missing extras before any work."""
    check_engine(arguments, wanted_sinks(arguments))
    if arguments.live and len(arguments.paths) > 1:
        shown = ", ".join(map(str, arguments.paths[:3]))
        arguments.usage_error(f"--live replays one path, got {len(arguments.paths)}: {shown}")
    if arguments.live and (kinds or arguments.gif):
        arguments.usage_error(f"--live writes no files; leave out --{[*kinds, 'gif'][0]}")
    files = [*kinds, *["gif"] * arguments.gif, *["labels-for"] * (arguments.labels_for is not None)]
    if files and arguments.out is None:
        arguments.usage_error(f"--{files[0]} needs --out DIR")
    if arguments.out is not None and not files:
        arguments.usage_error(
            "--out DIR has nothing to write; add --png, --html, --labels, --ply, --gif or --labels-for"
        )
    if arguments.static is not None and not (arguments.track or arguments.movable):
        arguments.usage_error("--static needs --track, or --movable to leave out all that could move")
    if arguments.movable and arguments.static is None:
        arguments.usage_error("--movable needs --static DIR")
    if arguments.bag is None and (arguments.bag_storage or arguments.bag_frame) is not None:
        arguments.usage_error("--bag-storage and --bag-frame need --bag DIR")
    if arguments.gif and not arguments.track:
        arguments.usage_error("--gif needs --track")
    if arguments.consistency is not None and (arguments.live or not arguments.track):
        arguments.usage_error("--consistency needs --track, and no --live: it is of a whole drive")
    if arguments.sweeps is not None:
        if arguments.scan or not arguments.track:
            arguments.usage_error("--sweeps needs --track, and no --scan")
        if not 2 <= arguments.sweeps <= 20:
            arguments.usage_error(f"--sweeps is {arguments.sweeps}; expected 2 to 20 scans")
        if _needs_odometry(arguments):
            require("kiss_icp", "slam", "--sweeps without --poses", package="kiss-icp")
    if arguments.deskew and (arguments.live or not (arguments.track or arguments.poses)):
        arguments.usage_error("--deskew needs --poses FILE or --track, and no --live")
    if arguments.poses is not None and not (arguments.deskew or (arguments.track and not arguments.live)):
        arguments.usage_error("--poses needs --deskew or --track, and no --live")
    if arguments.times is not None and (arguments.live or has_workers(arguments)):
        arguments.usage_error("--times needs no --live and no worker processes")
    if arguments.accumulate is not None and arguments.sensor in (None, AUTO_SENSOR):
        arguments.usage_error("--accumulate needs --sensor with the name of one that does not spin, such as mid-360")
    if arguments.live and any(value is not None for value in file_options(arguments).values()):
        arguments.usage_error("--columns, --remission-field and --origin need no --live")
    if (arguments.quaternion or arguments.poses_from) is not None and arguments.poses is None:
        arguments.usage_error("--quaternion and --poses-from need --poses FILE")
    check_sensor(arguments)
    if arguments.png:
        require("matplotlib", "view", "Drawing a picture")
    if arguments.gif:
        require("PIL", "view", "Drawing an animation", package="pillow")


def _images(arguments: argparse.Namespace, kinds: Sequence[str]) -> dict[Path, Path | None]:
    """The images, each with its scan of ``--scan`` if that is passed; empty if the paths are scans."""
    images = find_images(arguments.paths)
    scans = find_scans(arguments.scan).paths
    if arguments.scan:
        check_pairs(arguments, images, scans)
    if arguments.calib is not None and arguments.labels_for != "kitti":
        from ..camera.calibration import read_kitti_calibration
        from ..sinks.prelabels import calibration_of

        if not (images and scans and arguments.png):
            arguments.usage_error("--calib needs images with --scan and --png")
        read_kitti_calibration(calibration_of(arguments.calib, scans[0].name))  # errors come before the first image
    for image in images if arguments.calib is not None else ():
        if re.search(r"/image_0?[013]/(data/)?[^/]+$", image.absolute().as_posix()):
            what = f"left color camera, and {image} is of another one by its folder; pass images of image_2 or image_02"
            arguments.usage_error(f"--calib is for KITTI's {what}, or paint those of others in Python")
    if not images:
        return {}
    of_scans_alone = ("live", "deskew", "poses", "times")
    if option := next((f"--{name}" for name in of_scans_alone if getattr(arguments, name)), None):
        arguments.usage_error(f"{option} needs scans, and {next(iter(images))} is an image; leave it out")
    of_scans = [kind for kind in (*kinds, *(["track"] if arguments.track else [])) if kind != "png"]
    of_scans += [name.replace("_", "-") for name in wanted_sinks(arguments)]
    if of_scans and not scans:
        arguments.usage_error(f"--{of_scans[0]} needs --scan for images; add it, or leave --{of_scans[0]} out")
    require("PIL.Image", "camera", "Reading an image", package="pillow")
    if arguments.model is None:
        if arguments.weights == "open":
            arguments.usage_error(f"--weights open has no model of images; leave it out for the terms of {CAMERA}")
        arguments.model = [*chosen_models(arguments), CAMERA] if scans else [CAMERA]
    return {image: scans[k] if scans else None for k, image in enumerate(images)}


def _live_source(arguments: argparse.Namespace) -> Path:
    """The path to replay: a scan, a capture, or one folder of scans."""
    path: Path = arguments.paths[0]
    folders = scan_folders(path) if is_folder(path) else []
    if len(folders) > 1:
        arguments.usage_error(f"--live replays one folder of scans; {path} has {len(folders)}, such as {folders[0]}")
    return folders[0] if folders else path


# Perceivers kept for the sensors of captures; each has its own networks in memory.
_MOST_PERCEIVERS = 4


def _needs_no_camera(scans: Sequence[Path | Remote]) -> str:
    """What to say of scans with a camera model: what the first one is, if it is a film, an image or another format."""
    from ..readers.unknown import advice_for

    for scan in scans[:1]:
        # The values of a .bin may begin with any bytes.
        if isinstance(scan, Path) and scan.suffix.lower() != ".bin" and scan.is_file():
            with suppress(OSError), scan.open("rb") as file:
                if advice := advice_for(file.read(300)):
                    return f"{scan}: this is {advice}"
    return "scans without images need no camera model; leave it out, or pass images, with their --scan"


class _Perceivers:
    """A perceiver for each sensor, made when its first scan comes."""

    def __init__(self, arguments: argparse.Namespace, scans: Sequence[Path | Remote] = ()) -> None:
        self._arguments, self._scans = arguments, scans
        self._sensors = Sensors(arguments, scans)
        self.of = lru_cache(maxsize=_MOST_PERCEIVERS)(self._make)

    def check(self, *, of_images: bool) -> None:
        """Make the first perceiver, so that errors of options and models come before any file is written."""
        arguments, scans = self._arguments, [scan for scan in self._scans if isinstance(scan, Path)]
        for scan in scans:
            try:
                self.sensor_of(scan)
            except (EdgepercError, OSError):  # reported when the scan's turn comes
                continue
            break
        else:
            if scans:
                return
        cards = self.of(self.sensor_of(scan) if scans else stated_sensor(arguments)).cards
        kinds = {c.view.kind for c in cards}
        if (arguments.labels or arguments.ply) and "range_image" not in kinds:
            raise ModelError(
                "--labels and --ply need a class for every point; add a range-image model: --model pointseg"
            )
        if ("camera" in kinds) != of_images:
            raise ModelError(
                f"images need a camera model; add --model {CAMERA}" if of_images else _needs_no_camera(scans)
            )
        if of_images and not scans and kinds != {"camera"}:
            raise ModelError("images alone need a camera model alone; leave out the others, or add --scan")

    def sensor_of(self, path: Path | Remote, url: Remote | None = None) -> str | SensorProfile:
        """The sensor of ``--sensor``, of the capture, or the one that is found in the points."""
        return self._sensors.of(path, url)[0]

    def _make(self, sensor: str | SensorProfile) -> Perceiver:
        arguments = self._arguments
        return make_perceiver(arguments, sensor=sensor, on_mismatch=arguments.on_mismatch, adapt=arguments.adapt)


class _Run:
    """What a run does with every scan: perceive it, track its boxes, write its files and its part of the run's."""

    def __init__(
        self,
        arguments: argparse.Namespace,
        perceivers: _Perceivers,
        kinds: Sequence[str],
        sinks: Sinks,
        times: Mapping[Path | Remote, float] = MappingProxyType({}),
    ) -> None:
        from ..tracking.tracker import Tracker
        from .straighten import Straightener

        self._arguments, self._perceivers, self._kinds, self._sinks = arguments, perceivers, kinds, sinks
        self._times = times
        self._tracker = Tracker() if arguments.track else None
        self._straightener = Straightener(_trajectory(arguments), deskews=arguments.deskew)
        self._sweeps = self._odometry = None
        if arguments.sweeps is not None:
            from ..readers.scan_odometry import Odometry
            from ..road.sweeps import Sweeps

            self._sweeps = None if arguments.live else Sweeps(arguments.sweeps)
            self._odometry = Odometry() if _needs_odometry(arguments) else None
        self._n = 0
        self._folder: Path | Remote | None = None
        self._n_before = 0  # scans, where the folder began
        self._first_place: tuple[float, float, float] | None = None

    def scans(self, path: Path, target: Path, shown: Path | None = None) -> Iterator[Outcome]:
        """Perceive each scan of a file or capture; ``shown`` is printed in place of its path."""
        from ..readers.captures import is_capture, read_scans, read_timed_scans

        if isinstance(path, Remote) or isinstance(target, Remote):
            n_after = self._n + 1  # one that cannot be fetched takes its time, too
            yield from through_temporary(self.scans, path, target)
            self._n = max(self._n, n_after)
            return
        arguments, shown, numbered = self._arguments, shown or path, is_capture(path)
        try:
            sensor = self._perceivers.sensor_of(path, shown if isinstance(shown, Remote) else None)
            perceive = self._perceivers.of(sensor)
            read: Callable[..., Iterator[tuple[Any, ...]]] = read_timed_scans if arguments.deskew else read_scans
            how = reading_options(path, arguments) | {"accumulate_s": _gathered_s(path, sensor)}
            if how["accumulate_s"] is not None and not arguments.deskew:
                warnings.warn(
                    f"{shown}: the points of the last {how['accumulate_s']:g} s are taken as seen from one place; "
                    "if the sensor moves, pass --deskew with --poses FILE or --track",
                    stacklevel=2,
                )
            if not numbered:
                self._enter(shown.parent)
                how["origin_m"] = self._origin(path)
            for k, (stamp_s, points, *times_s) in enumerate(read(path, **how)):
                name, file = (shown / f"{k:06d}", target / f"{k:06d}") if numbered else (shown, target)
                stamp_s = self._times.get(shown, stamp_s)
                at_s = self._at_s(stamp_s)
                try:
                    points = self._straightener.straighten(stamp_s, points, *times_s, sensor=perceive.sensor)
                    pose, earlier = self._pose(points, at_s, how["origin_m"]), None
                    if self._sweeps is not None:
                        earlier = self._sweeps.earlier(points, at_s, pose)
                    perception = perceive(points, stamp_s, origin_m=how["origin_m"], earlier=earlier)
                    if self._kinds and numbered:
                        target.mkdir(exist_ok=True)
                    wanted = files_of(arguments, file, self._kinds, False)
                    yield self._answered(name, points, perception, perceive.sensor, wanted, at_s, pose)
                except (EdgepercError, OSError) as exc:
                    yield Outcome(name, exc)
                except MemoryError:
                    yield Outcome(name, PointsError(f"{len(points):,} points take more memory than there is"))
        except (EdgepercError, OSError) as exc:
            self._n += not numbered  # a scan that cannot be read takes its time, too
            yield Outcome(shown, exc)

    def _enter(self, folder: Path | Remote) -> None:
        """Tell drives apart: in files without times, the next folder's scans would continue the tracks of the last. A
        folder of one scan is none: some sets have a folder for each scan.
        """
        if folder == self._folder:
            return
        if self._tracker is not None and self._folder is not None and self._n > self._n_before + 1:
            warnings.warn(
                f"--track: {folder} is taken for another drive than {self._folder}: its scans count as "
                f"{_BETWEEN_DRIVES_S:g} s later, and tracking begins anew, with new ids; put scans of one drive into "
                "one folder",
                stacklevel=2,
            )
            self._n += math.ceil(_BETWEEN_DRIVES_S * self._arguments.rate)
            if self._odometry is not None:
                self._odometry.reset()
        self._folder, self._n_before = folder, self._n

    def _origin(self, scan: Path) -> Sequence[float] | None:
        """Place of the sensor in the map of a scan file, as ``--origin`` says."""
        from ..readers.files import find_origin

        origin: Sequence[float] | str | None = file_options(self._arguments)["origin_m"]
        return find_origin(scan, columns=self._arguments.columns) if isinstance(origin, str) else origin

    def image(self, path: Path, scan: Path | None, target: Path) -> Iterator[Outcome]:
        from .. import view
        from ..camera.calibration import Calibration
        from ..readers.files import read_points
        from ..readers.images import read_image
        from ..sinks.prelabels import calibration_of

        arguments, perceivers = self._arguments, self._perceivers
        self._enter((scan or path).parent)
        at_s = self._at_s(None)
        try:
            image = read_image(path)
            perceive = perceivers.of(perceivers.sensor_of(scan) if scan else stated_sensor(arguments))
            origin = None if scan is None else self._origin(scan)
            points = None if scan is None else read_points(scan, **file_options(arguments) | {"origin_m": origin})
            perception = perceive(points, image=image, origin_m=origin)
            wanted = files_of(arguments, target, self._kinds, True)
            if "image" in wanted:
                view.draw_image(perception, image, wanted.pop("image"), title=path.name)
            if points is None:
                yield Outcome(path, perception)
                return
            if "both" in wanted:
                calib = calibration_of(arguments.calib, str(scan))
                calibration = Calibration.from_kitti(calib, image.shape[1], image.shape[0])
                view.draw_painted(perception, image, points, calibration, wanted.pop("both"), title=path.name)
            pose = self._pose(points, at_s, origin)
            yield self._answered(path, points, perception, perceive.sensor, wanted, at_s, pose, scan)
        except (EdgepercError, OSError) as exc:
            yield Outcome(path, exc)
        except MemoryError:
            yield Outcome(path, ImageError("the image takes more memory than there is"))

    def live(self, path: Path) -> Iterator[Outcome]:
        """Perceive the newest scan, as a stream delivers them."""
        from ..live import stream

        name_of = scan_namer(path)
        sensor = self._perceivers.sensor_of(path)
        perceiver = self._perceivers.of(sensor)
        perceive: Callable[..., Perception] = perceiver.__call__  # without a sensor, of which `stream` would warn again
        track: Callable[..., Tracks | None] | None = self._tracker
        if self._tracker is not None and self._odometry is not None:
            from ..road.sweeps import SweepPerceiver

            swept = SweepPerceiver(perceive, self._tracker, self._odometry, self._arguments.sweeps)
            perceive, track = swept, swept.track
        rate_hz, topic = self._arguments.rate, self._arguments.topic
        gathered_s = _gathered_s(path, sensor)
        with stream(path, perceive, track, rate_hz=rate_hz, topic=topic, accumulate_s=gathered_s) as answers:
            while True:
                try:
                    answer = answers.take()
                except StopIteration:
                    return
                except (EdgepercError, OSError) as exc:
                    yield Outcome(path, exc)  # newer scans may have arrived, so the failed scan's number is unknown
                    continue
                assert answer is not None
                name, of_scan = name_of(answer.n_scans - 1), (answer.points, answer.perception, answer.tracks)
                scan = PerceivedScan(str(name), answer.stamp_s, *of_scan, perceiver.sensor, answer.health)
                try:
                    self._sinks.write(scan)
                except (EdgepercError, OSError) as exc:  # a full disk costs nobody who listens the answer
                    self._sinks.failed(f"{name}: ", exc)
                yield Outcome(name, answer, answer.tracks)

    def _answered(
        self,
        name: Path,
        points: Points,
        perception: Perception,
        sensor: SensorProfile,
        wanted: Mapping[str, Path],
        stamp_s: float,
        pose: ArrayLike | None,
        scan: Path | None = None,
    ) -> Outcome:
        """Track the boxes and write everything about a scan; ``scan`` is its file if ``name`` is its image."""
        from .. import view

        source = str(scan or name)
        tracks = None
        if self._tracker is not None and not (self._odometry is not None and pose is None):
            tracks = self._tracker.update(perception.boxes, stamp_s, pose, mounting=perception.mounting)
        if tracks is not None:
            self._straightener.follow(tracks)
        if self._sweeps is not None and tracks is not None:
            self._sweeps.add(points, perception, tracks)
        try:
            if "png" in wanted:
                view.draw(perception, points, wanted["png"], title=source)
            if "html" in wanted:
                view.write_html(perception, points, wanted["html"], title=source)
            if "labels" in wanted:
                view.write_labels(perception, wanted["labels"])
            if "ply" in wanted:
                view.write_ply(perception, points, wanted["ply"])
        finally:  # a picture that cannot be written costs no sink its scan
            self._sinks.write(PerceivedScan(source, stamp_s, points, perception, tracks, sensor))
        return Outcome(name, perception, tracks)

    def _pose(self, points: Points, stamp_s: float, origin_m: Sequence[float] | None) -> ArrayLike | None:
        """Pose of the sensor, seen from that of the first scan: by ``--poses``, where its place in a map is known,
        whose axes are then its own, or for ``--sweeps`` by an odometry.
        """
        if self._straightener.pose is not None:
            return self._straightener.pose
        if origin_m is None:
            return None if self._odometry is None else self._odometry(points, stamp_s)
        self._first_place = self._first_place or (origin_m[0], origin_m[1], origin_m[2])
        x, y, z = (a - b for a, b in zip(origin_m, self._first_place, strict=True))
        return [[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, y], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]]

    def _at_s(self, stamp_s: float | None) -> float:
        """Time of the next scan; scans without time stamps are 1 / ``--rate`` apart, whether or not they fail."""
        self._n += 1
        return self._n / self._arguments.rate if stamp_s is None else stamp_s


def _needs_odometry(arguments: argparse.Namespace) -> bool:
    """Whether ``--sweeps`` has neither poses nor places of the scans in a map."""
    return arguments.poses is None and arguments.origin is None


def _trajectory(arguments: argparse.Namespace) -> Trajectory | None:
    """The poses of ``--poses``, of a sensor that is mounted as the options say."""
    from ..preprocess.motion import Trajectory
    from ..types.sensor import get_sensor

    if arguments.poses is None:
        return None
    how = {"quaternion": arguments.quaternion, "maps_from": arguments.poses_from}
    if not any(how.values()) and is_of_kitti(poses := Path(arguments.poses)):
        return kitti_trajectory(poses, arguments.times)
    mounting = get_sensor(with_mounting(stated_sensor(arguments), arguments)).mounting
    return Trajectory.from_tum(arguments.poses, **how, mounting=mounting)


def _alone(
    arguments: argparse.Namespace, perceivers: _Perceivers | None = None
) -> tuple[Perceiver, Callable[..., Iterator[Outcome]], Callable[[Path], list[Path]]]:
    """For `perceive_side_by_side`: a perceiver, what perceives a scan file and writes its files, and these files."""
    kinds = [kind for kind in _KINDS if getattr(arguments, kind)]
    perceivers = perceivers or _Perceivers(arguments)
    perceive = perceivers.of(with_mounting(stated_sensor(arguments), arguments))
    run = _Run(arguments, perceivers, kinds, Sinks(arguments))
    return perceive, run.scans, lambda target: [*files_of(arguments, target, kinds, False).values()]


def _gathered_s(path: Path, sensor: str | SensorProfile) -> float | None:
    """Time over which the scans of a capture are gathered; None for a sensor that spins, and for scan files."""
    from ..readers.captures import is_capture, scan_files
    from ..types.sensor import get_sensor

    pattern = get_sensor(sensor).pattern
    if pattern is None:
        return None
    is_recorded = all(map(is_capture, scan_files(path) if is_folder(path) else [path]))
    return pattern.accumulate_s if is_recorded else None
