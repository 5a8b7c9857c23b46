"""Real scans as sparser sensors would have taken them: accuracy of points and boxes on KITTI's drives kept back.

Run as ``python -m edgeperc_export.release.thinned KITTI [--sensors vlp-16] [--models pointseg:int8 pointseg]``. Of the
HDL-64E's beams, those nearest to the sensor's remain, with its columns; its range, noise and remission stay, and none
looks up by more than 2 degrees. Prints a table of Markdown: of the network alone, and of the whole answer, with
its boxes. ``--drives 0001`` takes the labeled scans of drives instead, each alone and with the points of the last
``--sweeps`` scans (`edgeperc.SweepPerceiver`), at the poses that KISS-ICP finds in the thinned scans (extra ``slam``).
"""

from __future__ import annotations

import argparse
import itertools
import zlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from edgeperc import Odometry, Perceiver, SweepPerceiver, Tracker
from edgeperc.datasets.kitti import Frame, KittiObjects
from edgeperc.evaluation.judge import BY_DEFAULT, NETWORK_ALONE, Judge
from edgeperc.evaluation.kitti_ap import average_precisions, count_in_image
from edgeperc.evaluation.metrics import Confusion, Listed
from edgeperc.evaluation.tables import figures
from edgeperc.evaluation.truth import kitti_truth
from edgeperc.simulation.scene import POINT_CLASSES
from edgeperc.types.choices import DEFAULT_SENSOR
from edgeperc.types.mounting import MODEL_MOUNTING
from edgeperc.types.sensor import SensorProfile, get_sensor

from ..data.beams import taken_by
from ..data.scans import LabeledScan

SENSORS = ("vlp-16", "os0-32", "mid-360")


def profile_of(sensor: str) -> SensorProfile:
    """The profile of a thinned scan, whose remission is the training sensor's."""
    return replace(get_sensor(sensor), remission_range=(0.0, 1.0), remission=None, mounting=MODEL_MOUNTING)


def thinned(frame: Frame, sensor: SensorProfile) -> Frame:
    """A frame with the points that a sensor would have; the same for the same frame."""
    rng = np.random.default_rng(zlib.crc32(frame.name.encode()))
    return replace(frame, points=taken_by(sensor, LabeledScan.from_frame(frame), rng).points)


def row_of(kitti: KittiObjects, model: str, sensor: str, whole: bool) -> str:
    """What runs; IoU of the points of cars, pedestrians and cyclists; of the whole answer AP of cars, R40 [%]."""
    profile = profile_of(sensor)
    models, how = (["ssadnet", model, "objects"], BY_DEFAULT) if whole else ([model], NETWORK_ALONE)
    judge = Judge(models, how, sensor=profile)
    frames = (kitti.frame(name) for name in (*kitti.names("validation"), *kitti.names("test")))
    found = figures([judge.record(judge.kitti(thinned(frame, profile)))[0] for frame in frames], 0)
    (name,) = (card.name for card in judge.perceive.cards if card.view.kind == "range_image")
    points = " / ".join(f"{100 * found['points']['all'][label]['iou']:.1f}" for label in POINT_CLASSES[1:])
    measures = ("bird's eye 0.5", "bird's eye 0.7", "3-D 0.7") if whole else ()
    cars = [f"{100 * found['kitti']['car'][measure]['moderate']['ap_r40']:.1f}" for measure in measures]
    return f"{name} | {points} | {' / '.join(cars) or '-'}"


def row_of_drive(kitti: KittiObjects, drive: str, sensor: str, n: int) -> str:
    """AP of cars and cyclists in a drive, R40, and IoU of points [%], by the last ``n`` scans; ``hdl-64e`` is not
    thinned.
    """
    profile = get_sensor(sensor) if sensor == DEFAULT_SENSOR else profile_of(sensor)
    alone, counts, labels = Perceiver(sensor=profile, on_mismatch="ignore"), Listed(), Confusion(POINT_CLASSES)
    follow = SweepPerceiver(alone, Tracker(), Odometry(), n) if n > 1 else None
    for k, name in enumerate(name for name in kitti.grades if kitti.drives[name].endswith(drive)):
        frame, stamp_s = kitti.frame(name), 0.1 * k
        seen = frame if sensor == DEFAULT_SENSOR else thinned(frame, profile)
        if follow is None:
            perception = alone(seen.points, stamp_s)
        else:
            perception = follow(seen.points, stamp_s)
            follow.track(perception)
        labels.update(perception.require_points().labels, seen.point_labels())
        front = kitti_truth(frame, None).front
        if front is not None:
            counts += count_in_image(front, perception.boxes, drive)
    found = {rule: 100.0 * average_precisions(of)[0] for rule, of in counts.items()}
    of_cars = [(measure, "moderate") for measure in ("bird's eye 0.5", "bird's eye 0.7", "3-D 0.7")]
    cars = [f"{found['car', measure, part]:.1f}" for measure, part in (*of_cars, ("bird's eye 0.5", "30-45 m"))]
    of_points = " / ".join(f"{100.0 * iou:.1f}" for iou in labels.iou()[1:])
    return f"{n} | {' / '.join(cars)} | {found['cyclist', '3-D 0.5', 'moderate']:.1f} | {of_points}"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        "edgeperc_export.release.thinned", description=(__doc__ or "").partition("\n\n")[0]
    )
    parser.add_argument("kitti", metavar="KITTI", help="root of a KITTI object set")
    parser.add_argument("--sensors", nargs="*", default=[*SENSORS], metavar="NAME")
    parser.add_argument("--models", nargs="*", default=["pointseg:int8", "pointseg"], metavar="MODEL")
    parser.add_argument("--drives", nargs="*", default=[], metavar="DRIVE")
    parser.add_argument("--sweeps", nargs="*", type=int, default=[1, 5, 10], metavar="N")
    given = parser.parse_args(arguments)
    if given.drives:
        print(
            "| drive | sensor | scans | AP of cars: bird's eye 0.5 / 0.7 / 3-D 0.7 / 30-45 m | of cyclists: 3-D 0.5 "
            "| IoU of points of cars / pedestrians / cyclists |"
        )
        print("|---|---|---|---|---|---|")
        for drive, sensor, n in itertools.product(given.drives, given.sensors, given.sweeps):
            print(f"| {drive} | {sensor} | {row_of_drive(KittiObjects(given.kitti), drive, sensor, n)} |", flush=True)
        return
    print("| sensor | answer | network | IoU car / pedestrian / cyclist | AP of cars: bird's eye 0.5 / 0.7 / 3-D 0.7 |")
    print("|---|---|---|---|---|")
    for sensor in given.sensors:
        for whole in (False, True):
            for model in given.models:
                row = row_of(KittiObjects(given.kitti), model, sensor, whole)
                print(f"| {sensor} | {'whole' if whole else 'network alone'} | {row} |", flush=True)


if __name__ == "__main__":
    main()
