"""Measure the tracker's scans per second, and those of Stone Soup's JPDA on the same boxes.

This module is a command of its own: ``python -m edgeperc_bench.peers.tracking [ROOT] [--sequence SEQ]``.

ROOT holds KITTI's tracking sequences with detections (``label_02``, ``calib``, ``detections/DETECTOR_CLASS``); without
it, a street of parked and moving cars is drawn from a seed. Only `Tracker.update` is measured, in one thread, boxes in
and tracks out, over whole sequences:

- each class alone, and all classes together. Trackers are made before the clocks start, and their construction
  compiles the kernels
- one sequence of cars (``--sequence``) by the tracker and by Stone Soup, with the same boxes, those with a score above
  ``--score``. Stone Soup runs a JPDA over unscented filters with one motion model, constant velocity, in x and y, for
  at most ``--seconds``; the scans that it did by then count
- ``--crossing N``: N scans of 200 targets (``--targets``) that cross and occlude each other among half as many false
  alarms, the longest time of a scan, and whether memory grows
- ``--every-second-beam OUT`` measures nothing: from ROOT, here an object set with track ids, it writes the same drives
  as a coarser sensor with another remission would record them, for ``edgeperc fit-sensor`` and ``edgeperc
  eval-tracking --adapt``

The table shows wall time and processor time; other busy processes lengthen the processor time less.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import math
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path

import numpy as np

from edgeperc import Box, Tracker
from edgeperc.evaluation.headings import FRAME_S
from edgeperc.evaluation.tracking import CLASSES, read_sequence, sequence_names, sequence_scans
from edgeperc.types.points import Floats
from edgeperc.types.sensor import get_sensor

from ..render import Section, number, text
from ..samples import elapsed_ms
from .rounds import parser_of, versions

Scans = Sequence[Sequence[Box]]


def drawn_street(n_scans: int = 400) -> list[list[Box]]:
    """Boxes of 30 parked and 6 driving cars around a sensor that drives at 10 m/s, with false alarms."""
    rng = np.random.default_rng(0)
    parked = np.column_stack([rng.uniform(0.0, 450.0, 90), rng.choice([-6.0, 6.0, 9.0], 90)])
    driving, speed = rng.uniform(0.0, 200.0, 6), rng.uniform(5.0, 14.0, 6)
    scans = []
    for k in range(n_scans):
        ahead = np.column_stack([driving + FRAME_S * k * speed, np.full(6, -2.0)])
        here = np.array([k * FRAME_S * 10.0, 0.0])
        there = np.vstack([parked - here, ahead - here, rng.uniform(-50.0, 50.0, (2, 2))])
        there += rng.normal(0.0, 0.1, there.shape)
        seen = (np.abs(there[:, 0]) < 50.0) & (rng.random(len(there)) < 0.93)
        scans.append([Box("car", 0.99, (x, y, -0.9), (4.2, 1.8, 1.5), 0.0) for x, y in there[seen].tolist()])
    return scans


def crossing(
    n_scans: int, n_targets: int = 200, n_false: int = 100, seed: int = 0
) -> Iterator[tuple[list[Box], Floats]]:
    """Boxes, and true places (n_targets, 2), of cars that cross in 120 m by 120 m and turn around at its edges; every
    other one is missed in three scans of ten, and false alarms lie anywhere.
    """
    rng = np.random.default_rng(seed)
    places, heading = rng.uniform(-60.0, 60.0, (n_targets, 2)), rng.uniform(-math.pi, math.pi, n_targets)
    speed, shown = rng.uniform(3.0, 12.0, n_targets), np.where(np.arange(n_targets) % 2, 0.7, 0.97)
    for _ in range(n_scans):
        places += FRAME_S * speed[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
        out = (np.abs(places) > 60.0).any(axis=1)
        heading[out] = np.arctan2(-places[out, 1], -places[out, 0]) + rng.uniform(-0.7, 0.7, np.count_nonzero(out))
        seen = rng.random(n_targets) < shown
        rows = [*np.column_stack([places + rng.normal(0.0, 0.08, places.shape), heading])[seen].tolist()]
        boxes = [Box("car", 0.95, (x, y, -0.9), (4.2, 1.8, 1.5), yaw) for x, y, yaw in rows]
        for x, y, yaw in rng.uniform([-90.0, -90.0, -3.0], [90.0, 90.0, 3.0], (n_false, 3)).tolist():
            boxes.append(Box("car", 0.55, (x, y, -0.9), (4.2, 1.8, 1.5), yaw))
        yield boxes, places.copy()


def every_second_beam(root: Path, out: Path) -> None:
    """Write an object set with track ids as of a sensor with half the beams and the remission squared, as a byte."""
    for folder in ("label_2", "track_id", "calib"):
        shutil.copytree(root / "training" / folder, out / "training" / folder)
    shutil.copy(root / "frames.csv", out)
    (out / "training/velodyne").mkdir()
    for path in [path for name in sequence_names(root) for path in sequence_scans(root, name).values()]:
        points = np.fromfile(path, np.float32).reshape(-1, 4)
        azimuth = np.arctan2(points[:, 1], points[:, 0]) % (2.0 * np.pi)
        beam = np.concatenate([[0], np.cumsum(np.diff(azimuth) < -np.pi)])
        sparse = points[beam % 2 == 0]
        sparse[:, 3] = 255.0 * sparse[:, 3] ** 2
        sparse.tofile(out / "training/velodyne" / path.name)
    full = get_sensor("hdl-64e")
    half = replace(full, name="every second beam", elevations_deg=full.elevations_deg[::2])
    half = replace(half, remission_range=(0.0, 255.0), remission=None)
    (out / "sensor.json").write_text(half.to_json(), encoding="utf-8")


def endurance(n_scans: int, n_targets: int) -> str:
    """The time of a scan of crossing targets, and the growth of memory after a tenth of the scans."""
    from ..context import rss_mb  # needs the extra 'bench'

    tracker, ms, early_mb = Tracker(), np.empty(n_scans), 0.0  # its construction compiles the kernels
    for k, (boxes, _) in enumerate(crossing(n_scans, n_targets, n_targets // 2)):
        ms[k] = elapsed_ms(partial(tracker.update, boxes, k * FRAME_S, np.eye(4)))
        if k == n_scans // 10:
            early_mb = rss_mb()
    median, late, worst = np.quantile(ms, [0.5, 0.99, 1.0])
    return (
        f"{n_scans:,} scans of {n_targets} crossing targets and {n_targets // 2} false alarms: median {median:.2f} ms, "
        f"99 % {late:.2f} ms, worst {worst:.2f} ms; "
        f"memory {early_mb:.1f} MB after {n_scans // 10:,} scans, {rss_mb():.1f} MB at the end"
    )


def follow(sequences: Sequence[Scans], trackers: Iterator[Tracker]) -> int:
    """Track every sequence from its beginning, each with a tracker of its own; return the number of scans."""
    for scans, tracker in zip(sequences, trackers, strict=False):
        for k, boxes in enumerate(scans):
            tracker.update(boxes, k * FRAME_S)
    return sum(map(len, sequences))


def timed(run: Callable[[], int]) -> tuple[int, float, float]:
    """Number of scans of a run, its wall time and its processor time [s]."""
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    done = run()
    return done, time.perf_counter() - wall_s, time.process_time() - cpu_s


def time_tracker(sequences: Sequence[Scans]) -> tuple[int, float, float]:
    """As `timed`, for `follow`. The trackers are made, and the kernels compiled, before the clocks start."""
    trackers = [Tracker() for _ in sequences]
    follow([drawn_street(3)], iter([Tracker()]))
    return timed(partial(follow, sequences, iter(trackers)))


def stone_soup(scans: Scans, seconds: float) -> int:
    """Track with Stone Soup for at most ``seconds``; return the number of scans."""
    from stonesoup.dataassociator.neighbour import NearestNeighbour
    from stonesoup.dataassociator.probability import JPDA
    from stonesoup.deleter.time import UpdateTimeStepsDeleter
    from stonesoup.hypothesiser.distance import DistanceHypothesiser
    from stonesoup.hypothesiser.probability import PDAHypothesiser
    from stonesoup.initiator.simple import MultiMeasurementInitiator
    from stonesoup.measures import Mahalanobis
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.predictor.kalman import UnscentedKalmanPredictor
    from stonesoup.tracker.simple import MultiTargetMixtureTracker
    from stonesoup.types.detection import Detection
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import UnscentedKalmanUpdater

    sensor = LinearGaussian(4, (0, 2), np.diag([0.2, 0.2]) ** 2)
    begin = datetime(2000, 1, 1)
    stop = time.perf_counter() + seconds

    def detections() -> Iterator[tuple[datetime, set[Detection]]]:
        for k, boxes in enumerate(scans):
            if time.perf_counter() > stop:
                return
            at = begin + timedelta(seconds=k * FRAME_S)
            places = [np.array([box.center[:2]]).T for box in boxes]
            yield at, {Detection(place, timestamp=at, measurement_model=sensor) for place in places}

    predictor = UnscentedKalmanPredictor(CombinedLinearGaussianTransitionModel([ConstantVelocity(1.0)] * 2))
    updater = UnscentedKalmanUpdater(sensor)
    associator = JPDA(PDAHypothesiser(predictor, updater, 1e-3, prob_detect=0.9, prob_gate=0.95))
    nearest = NearestNeighbour(DistanceHypothesiser(predictor, updater, Mahalanobis(), missed_distance=3.0))
    prior = GaussianState(np.zeros((4, 1)), np.diag([0.04, 64.0, 0.04, 64.0]), timestamp=begin)
    deleter = UpdateTimeStepsDeleter(5)
    initiator = MultiMeasurementInitiator(prior, deleter, nearest, updater, sensor, min_points=2)
    tracker = MultiTargetMixtureTracker(initiator, deleter, detections(), associator, updater)
    return sum(1 for _ in tracker)


def main() -> None:
    parser, add = parser_of("tracking", __doc__)
    add("root", "KITTI's tracking sequences (default: a drawn street)", nargs="?", type=Path)
    add("--sequence SEQ", "measured with both (default: %(default)s)", default="0004")
    higher = "both get the boxes of --sequence with a higher score (default: %(default)s)"
    add("--score X", higher, type=float, default=0.5)
    add("--seconds S", "run Stone Soup this long (default: %(default)s)", type=float, default=60.0)
    add("--crossing N", "measure only N scans of crossing targets", type=int)
    add("--targets N", "the number of crossing targets (default: %(default)s)", type=int, default=200)
    add("--every-second-beam OUT", "only write the drives of ROOT as of a coarser sensor", type=Path)
    arguments = parser.parse_args()
    if arguments.crossing:
        print(endurance(arguments.crossing, arguments.targets))
        return
    if arguments.every_second_beam:
        if arguments.root is None:
            parser.error("--every-second-beam needs ROOT, an object set with track ids")
        every_second_beam(arguments.root, arguments.every_second_beam)
        return

    of_class: dict[str, Sequence[Scans]]
    if arguments.root is None:
        street = drawn_street()
        of_class, cars = {"car (drawn)": [street]}, street
    else:
        names = [path.stem for path in sorted((arguments.root / "label_02").glob("*.txt"))]
        read = {name: read_sequence(arguments.root, name).detections for name in names}
        of_class = {
            label: [[[box for box in scan if box.label == label] for scan in scans] for scans in read.values()]
            for label in CLASSES
        }
        of_class["all together"] = list(read.values())
        cars = [[box for box in scan if box.label == "car"] for scan in read[arguments.sequence]]
    shared = [[box for box in scan if box.score > arguments.score] for scan in cars]

    rows = [["", "scans", "boxes/scan", "scans/s", "by processor time"]]

    def add_row(name: str, measured: tuple[int, float, float], boxes_per_scan: float) -> float:
        """Add a row; return the processor time of a scan [s]."""
        done, wall_s, cpu_s = measured
        rows.append([name, f"{done:,}", number(boxes_per_scan, 1), number(done / wall_s, 0), number(done / cpu_s, 0)])
        return cpu_s / max(done, 1)

    for name, sequences in of_class.items():
        n_boxes, n_scans = sum(len(scan) for scans in sequences for scan in scans), sum(map(len, sequences))
        add_row(name, time_tracker(sequences), n_boxes / n_scans)
    each = sum(map(len, shared)) / len(shared)
    own_s = add_row(f"one sequence, score > {arguments.score}", time_tracker([shared] * 5), each)
    sentences = [f"one thread; {versions()}"]
    if importlib.util.find_spec("stonesoup"):
        name = f"Stone Soup {importlib.metadata.version('stonesoup')} JPDA"
        theirs_s = add_row(name, timed(partial(stone_soup, shared, arguments.seconds)), each)
        sentences.append(f"Stone Soup takes {theirs_s / own_s:,.0f} times as long for a scan")
    else:
        sentences.append("Stone Soup's JPDA is not installed. Run: pip install 'edgeperc[peers]'")
    print(text([Section("Tracking", sentences, rows)]))


if __name__ == "__main__":
    main()
