"""Real scans as sparser sensors would have taken them: accuracy of points and boxes on KITTI's drives kept back.

Run as ``python -m edgeperc_export.release.thinned KITTI [--sensors vlp-16] [--models pointseg:int8 pointseg]``. Of the
HDL-64E's beams, those nearest to the sensor's remain, with its columns; its range, noise and remission stay, and none
looks up by more than 2 degrees. Prints a table of Markdown: of the network alone, and of the whole answer, with
its boxes.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from edgeperc.datasets.kitti import Frame, KittiObjects
from edgeperc.evaluation.judge import BY_DEFAULT, NETWORK_ALONE, Judge
from edgeperc.evaluation.tables import figures
from edgeperc.simulation.scene import POINT_CLASSES
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


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        "edgeperc_export.release.thinned", description=(__doc__ or "").partition("\n\n")[0]
    )
    parser.add_argument("kitti", metavar="KITTI", help="root of a KITTI object set")
    parser.add_argument("--sensors", nargs="*", default=[*SENSORS], metavar="NAME")
    parser.add_argument("--models", nargs="*", default=["pointseg:int8", "pointseg"], metavar="MODEL")
    given = parser.parse_args(arguments)
    print("| sensor | answer | network | IoU car / pedestrian / cyclist | AP of cars: bird's eye 0.5 / 0.7 / 3-D 0.7 |")
    print("|---|---|---|---|---|")
    for sensor in given.sensors:
        for whole in (False, True):
            for model in given.models:
                row = row_of(KittiObjects(given.kitti), model, sensor, whole)
                print(f"| {sensor} | {'whole' if whole else 'network alone'} | {row} |", flush=True)


if __name__ == "__main__":
    main()
