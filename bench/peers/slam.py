"""Measure KISS-ICP's trajectory and map with and without what moves, and the time of both.

This module is a command of its own: ``python -m edgeperc_bench.peers.slam [ROOT] [--drive DRIVE]``. It needs the extra
``slam``.

ROOT is a KITTI object set; its drives with at least ``--least`` scans are used, one after the other. Without ROOT,
streets with traffic are drawn from seeds; their poses and moving objects are known. Their ground is left out for
KISS-ICP: it is so smooth that the scan lines on it, which move with the sensor, hold the estimate back (in one street
11.2 m of 14.4 m; without the ground 14.4 m). ``--drive`` selects some drives or streets.

Each drive is perceived and tracked once, with a full turn of labels. KISS-ICP then gets all points, those that do not
move (`edgeperc.moving_points`), by the tracks as they are known in hindsight, too (`edgeperc.smooth_tracks`), and those
that could not move (`edgeperc.movable_points`). With ``--second-pass``, the
boxes are also tracked with KISS-ICP's poses of all points, in place of the tracker's own estimate. KISS-ICP runs
without motion compensation, in one thread. The table has, by drive and variant:

- error: root of the mean squared distance of the poses from the true ones, after the best rigid alignment; only of
  drawn streets
- closure: the drive is run forward and then backward; distance between the two poses of its second scan. The first
  scan does not count: KISS-ICP takes the sensor to stand then, and may miss the first step
- map: share of the map's cells of ``CELL_M`` that hold a point of an object that moves. Objects and their motion are
  known from drawn scenes; on real drives from labels, tracked with KISS-ICP's poses of all points. There only the
  camera's field of view counts, because other objects have no labels
- lost: share of the points that were left out although they are not on a moving object
- processor time of a scan, in all threads: perception, tracking and masks; KISS-ICP. Other busy processes lengthen it
  less than the wall time

A second table has the motion between scans, from the second scan on, as KISS-ICP (all points) and the tracker (from
objects alone) estimate it, which is what `edgeperc.deskew` needs: distance of the estimated place of the next scan from
the true one, median and 95th percentile. On real drives KISS-ICP stands in for the truth.
"""

from __future__ import annotations

import importlib.metadata
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from edgeperc import Box, Odometry, Perceiver, Perception, Tracker, Tracks, movable_points, moving_points, smooth_tracks
from edgeperc.datasets.kitti import KittiObjects
from edgeperc.errors import SplitError
from edgeperc.evaluation.judge import check_unseen, training_scans_of
from edgeperc.readers.files import read_points
from edgeperc.simulation.drawn import random_scene
from edgeperc.simulation.scene import simulate_sequence
from edgeperc.system.extras import require
from edgeperc.tracking.moving import moving_tracks
from edgeperc.types.geometry import inside
from edgeperc.types.points import Floats, Ints64, Mask, Points

from ..render import Section, number, share, text
from .rounds import parser_of, versions

RATE_HZ = 10.0
CELL_M = 0.2
FARTHEST_CELL = 2**20  # from the origin; 200 km
VARIANTS = ("all points", "without moving", "same, in hindsight", "same, second pass", "without movable")
ALL, MOVING, HINDSIGHT, SECOND, MOVABLE = VARIANTS
# Streets with traffic, and the speed of the sensor in them [m/s]. No model was trained on these seeds.
STREETS = (("urban", 2_100_000_001, 6.0), ("residential", 2_100_000_001, 5.0), ("junction", 2_100_000_002, 6.0))
MOVING_AROUND = 10  # scans around one in which an object moves for which it counts as moving too
GROUND_M = 0.2  # points so near to the bottom of a label may be of the ground

Poses = Floats
Localize = Callable[[Sequence[Points]], Poses]


@dataclass(frozen=True, eq=False)
class Drive:
    """Consecutive scans."""

    name: str
    scans: list[Points]
    poses: Poses | None  # (k, 4, 4), true poses of the sensor
    moving: list[Mask] | None  # points on objects that move; None: from ``labels``
    usable: list[Mask]  # points for KISS-ICP
    known: list[Mask]  # points of which it is known whether they move
    labels: list[list[Box]]  # true boxes of each scan, of all objects; empty if ``moving`` is known
    trained: bool = False  # a model was trained on one of the scans


def drawn_streets(n_scans: int, wanted: Sequence[str] = ()) -> Iterator[Drive]:
    """The streets of `STREETS`, with true poses and moving objects."""
    for place, seed, speed in STREETS:
        if wanted and place not in wanted:
            continue
        scene = random_scene(seed, place)
        moves = np.array([*(abs(thing.speed_mps) > 0.5 for thing in scene.objects), False])  # -1 is the background
        parts = list(simulate_sequence(scene, "hdl-64e", n_scans, RATE_HZ, speed, seed))
        scans, poses = [scan.points for *_, scan in parts], np.array([pose for _, pose, _ in parts])
        moving, usable = [moves[scan.objects] for *_, scan in parts], [scan.surfaces >= 0 for *_, scan in parts]
        known = [np.ones(len(points), np.bool_) for points in scans]
        yield Drive(f"drawn {place}, {speed:.0f} m/s", scans, poses, moving, usable, known, [])


def real_drives(
    root: Path, wanted: Sequence[str], least: int, most: int, trained_on: dict[str, set[str]]
) -> Iterator[Drive]:
    """The drives of a KITTI object set with enough scans, in the order of their names."""
    data = KittiObjects(root)
    for drive in sorted({*data.drives.values()}):
        names = [name for name, of in data.drives.items() if of == drive][:most]
        if len(names) < least or (wanted and not any(drive.endswith(ending) for ending in wanted)):
            continue
        scans, known, labels, trained = [], [], [], False
        for name in names:
            labeled = data.frame(name) if name in data.grades else None
            points = read_points(data.files(name)[0]) if labeled is None else labeled.points
            try:
                check_unseen(trained_on, name, drive, points)
            except SplitError:
                trained = True
            scans.append(points)
            known.append(np.zeros(len(points), np.bool_) if labeled is None else labeled.known)
            labels.append([] if labeled is None else [*labeled.boxes])
        usable = [np.asarray(np.isfinite(points).all(axis=1)) for points in scans]
        yield Drive(drive.removeprefix("2011_"), scans, None, None, usable, known, labels, trained)


def moving_boxes(labels: Sequence[Sequence[Box]], poses: Poses) -> list[list[Box]]:
    """The boxes of objects that move, by scan: labels tracked with known poses. An object moves in a scan if its track
    moves in this one or in one of `MOVING_AROUND` before or after it.
    """
    tracker = Tracker()
    numbers: list[dict[int, int]] = []  # index of a box -> its track
    moves: dict[int, list[int]] = {}  # track -> scans in which it moves
    for k, boxes in enumerate(labels):
        sure = [replace(box, score=0.99) for box in boxes]
        tracks = tracker.update(sure, k / RATE_HZ, poses[k])
        numbers.append({int(source): int(each) for source, each in zip(tracks.sources, tracks.ids, strict=True)})
        for track in moving_tracks(tracks):
            moves.setdefault(track.id, []).append(k)
    found = []
    for k, boxes in enumerate(labels):
        around = [moves.get(numbers[k].get(index, -1), []) for index in range(len(boxes))]
        moving = [any(abs(k - frame) <= MOVING_AROUND for frame in frames) for frames in around]
        found.append([box for box, moves_now in zip(boxes, moving, strict=True) if moves_now])
    return found


def trajectory_error(true: Poses, found: Poses) -> float:
    """Root of the mean squared distance of positions of poses (k, 4, 4) [m], after the best rigid alignment."""
    a, b = (poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0) for poses in (true, found))
    u, _, v = np.linalg.svd(b.T @ a)
    turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v
    return float(np.sqrt(((b @ turn - a) ** 2).sum(axis=1).mean()))


def step_errors(true: Poses, found: Poses) -> Floats:
    """How far the motion between consecutive poses (k, 4, 4) ends from the true motion's end [m], (k - 1,) float64."""
    steps = (np.linalg.inv(poses[:-1]) @ poses[1:] for poses in (true, found))
    a, b = (each[:, :3, 3] for each in steps)
    return np.asarray(np.linalg.norm(a - b, axis=1))


def closure(odometry: Localize, scans: Sequence[Points]) -> tuple[Poses, float]:
    """Poses of two scans or more, and how far from the pose of the second one it is after the way back [m]."""
    poses = odometry([*scans, *scans[-2::-1]])
    return poses[: len(scans)], float(math.dist(poses[1][:3, 3], poses[-2][:3, 3]))


def ghost_share(scans: Sequence[Points], kept: Sequence[Mask], moving: Sequence[Mask], poses: Poses) -> float:
    """Share of the map's cells that hold a kept point of a moving object, of scans at their poses (k, 4, 4)."""
    cells: list[list[Ints64]] = [[], []]
    for points, stays, moves, pose in zip(scans, kept, moving, poses, strict=True):
        places = np.floor((points[:, :3] @ pose[:3, :3].T + pose[:3, 3]) / CELL_M).astype(np.int64)
        numbers = (places + FARTHEST_CELL) @ [4 * FARTHEST_CELL**2, 2 * FARTHEST_CELL, 1]
        for k, mask in enumerate((stays, stays & moves)):
            cells[k].append(np.unique(numbers[mask]))
    whole, ghosts = (len(np.unique(np.concatenate(each))) for each in cells)
    return ghosts / max(whole, 1)


def kiss_icp(scans: Sequence[Points]) -> Poses:
    """Poses (k, 4, 4) of KISS-ICP, the first one at the origin."""
    odometry, poses = Odometry(), []
    for k, points in enumerate(scans):
        odometry(points, k / RATE_HZ)
        poses.append(odometry.T_world_sensor)
    return np.array(poses)


@dataclass(frozen=True)
class Seen:
    """What is left out of the scans of a drive, and the median processor time of a scan."""

    kept: dict[str, list[Mask]]  # by variant in their order, without the second pass
    perceptions: list[Perception]
    poses: Poses  # (k, 4, 4), of the sensor, as the tracker estimates them
    ms: float


def look(perceive: Callable[..., Any], drive: Drive) -> Seen:
    """Perceive and track a drive, without its poses."""
    tracker, perceptions, online, ms = Tracker(), list[Perception](), list[Tracks](), []
    masks: dict[str, list[Mask]] = {ALL: [np.ones(len(points), np.bool_) for points in drive.scans]}
    masks |= {MOVING: [], MOVABLE: []}
    for k, points in enumerate(drive.scans):
        started = time.process_time()
        perceptions.append(perceive(points, k / RATE_HZ))
        online.append(tracker(perceptions[-1]))
        moving = moving_points(online[-1], points)
        masks[MOVING].append(~moving)
        masks[MOVABLE].append(~(moving | movable_points(perceptions[-1], points)))
        ms.append(1e3 * (time.process_time() - started))
    known = zip(masks[MOVING], smooth_tracks(online), drive.scans, strict=True)
    masks[HINDSIGHT] = [staying & ~moving_points(tracks, points) for staying, tracks, points in known]
    poses = np.array([tracks.T_world_sensor for tracks in online])
    return Seen(masks, perceptions, poses, float(np.median(ms)))


def compared(
    drive: Drive, seen: Seen, odometry: Localize, *, second_pass: bool = False
) -> tuple[list[list[str]], list[str]]:
    """The rows of a drive in the table, one for each variant; the row of its motion in the second table."""
    rows, moving, first = [], drive.moving, None
    for name in VARIANTS:
        if name == SECOND and not second_pass:
            continue
        staying = seen.kept.get(name, [])
        if first is not None and name == SECOND:
            tracker, answers = Tracker(), zip(drive.scans, seen.perceptions, first, strict=True)
            staying = [~moving_points(tracker(perception, pose), points) for points, perception, pose in answers]
        scans = chosen(drive, staying)
        started = time.process_time()
        poses, gap = closure(odometry, scans)
        ms = 1e3 * (time.process_time() - started) / (2 * len(scans) - 1)
        first = poses if first is None else first  # of all points
        if moving is None:
            moving = [on_objects(*each) for each in zip(drive.scans, moving_boxes(drive.labels, poses), strict=True)]
        counted = [np.logical_and.reduce(masks) for masks in zip(staying, drive.known, drive.usable, strict=True)]
        still = [known & ~moves for known, moves in zip(drive.known, moving, strict=True)]
        n_still = int(np.count_nonzero(np.concatenate(still)))
        n_lost = int(np.count_nonzero(np.concatenate(still) & ~np.concatenate(staying)))
        way_m = float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
        known = any(mask.any() for mask in drive.known)
        rows.append(
            [
                f"{drive.name}{' (trained on)' if drive.trained else ''}" if name == ALL else "",
                name,
                f"{len(scans)}, {way_m:.0f} m",
                "-" if drive.poses is None else f"{trajectory_error(drive.poses, poses):.3f} m",
                f"{gap:.3f} m",
                share(ghost_share(drive.scans, counted, moving, poses), 2) if known else "-",
                share(n_lost / max(n_still, 1), 2) if known else "-",
                "-" if name == ALL else number(seen.ms, 0),
                number(ms, 0),
            ]
        )
    assert first is not None
    true = first if drive.poses is None else drive.poses
    motion = [drive.name, "KISS-ICP" if drive.poses is None else "truth"]
    for found in (first, seen.poses):
        errors = step_errors(true[1:], found[1:])
        motion += ["-" if found is true else f"{np.quantile(errors, q):.3f} m" for q in (0.5, 0.95)]
    return rows, motion


def chosen(drive: Drive, kept: Sequence[Mask]) -> list[Points]:
    """The kept points of each scan that KISS-ICP can use."""
    return [points[mask & usable] for points, mask, usable in zip(drive.scans, kept, drive.usable, strict=True)]


def on_objects(points: Points, boxes: Sequence[Box]) -> Mask:
    """The points (n, 4) inside boxes, above the ground, (n,) bool."""
    is_object = np.zeros(len(points), np.bool_)
    for box in boxes:
        bottom = box.center[2] - box.size[2] / 2.0
        is_object |= inside(box, points, 0.1) & (points[:, 2] > bottom + GROUND_M)
    return is_object


def draw_maps(drive: Drive, seen: Seen, odometry: Localize, path: Path) -> None:
    """Draw the maps from above; points of objects that truly move are red."""
    pyplot = require("matplotlib.pyplot", "view", "Drawing a picture")
    figure, axes = pyplot.subplots(3, 1, figsize=(9.0, 8.2), dpi=100, sharex=True, sharey=True)
    assert drive.moving is not None
    for axis, name in zip(axes, (ALL, MOVING, MOVABLE), strict=True):
        mask = seen.kept[name]
        poses = odometry(chosen(drive, mask))
        still, ghosts = [], []
        for points, stays, moves, pose in zip(drive.scans, mask, drive.moving, poses, strict=True):
            placed = points[:, :3] @ pose[:3, :3].T + pose[:3, 3]
            standing = stays & (points[:, 2] > -1.4)
            still.append(placed[standing & ~moves][::7])
            ghosts.append(placed[standing & moves][::3])
        for parts, color in ((still, "#44505c"), (ghosts, "#e03131")):
            x, y, _ = np.concatenate(parts).T
            axis.scatter(x, y, s=0.12, c=color, linewidths=0, rasterized=True)
        axis.set_title(f"Map {'of ' if name == ALL else ''}{name}", loc="left", fontsize=10)
        axis.set_aspect("equal")
        axis.set_xlim(-30.0, 75.0)
        axis.set_ylim(-16.0, 16.0)
        axis.set_ylabel("m")
    axes[-1].set_xlabel("m")
    figure.tight_layout()
    figure.savefig(path)
    pyplot.close(figure)


def main() -> None:
    parser, add = parser_of("slam", __doc__)
    add("root", "a KITTI object set (default: drawn streets)", nargs="?", type=Path)
    add("--drive DRIVE...", "only drives that end so, such as 0001 or urban", default=[])
    add("--least N", "drives with at least N scans (default: %(default)s)", type=int, default=20)
    add("--scans N", "the first N scans of each drive (default: all; drawn: 60)", type=int, default=0)
    add("--second-pass", "also track with KISS-ICP's poses")
    add("--picture FILE", "draw the maps of the first drawn street")
    arguments = parser.parse_args()
    require("kiss_icp", "slam", "The comparison with KISS-ICP", package="kiss-icp")
    if arguments.picture and arguments.root is not None:
        parser.error("--picture shows a drawn street; leave ROOT out")
    perceive = Perceiver(sensor="hdl-64e", full_turn=True)
    if arguments.root is None:
        drives = drawn_streets(arguments.scans or 60, arguments.drive)
    else:
        counts, trained_on = (arguments.least, arguments.scans or 10**9), training_scans_of(perceive.cards)
        drives = real_drives(arguments.root, arguments.drive, *counts, trained_on)
    rows = [["drive", "map of", "scans", "error", "closure", "map", "lost", "edgeperc, ms", "KISS-ICP, ms"]]
    motions = [["drive", "against", "KISS-ICP, median", "95 %", "tracker, median", "95 %"]]
    for k, drive in enumerate(drives):
        seen = look(perceive, drive)
        more, motion = compared(drive, seen, kiss_icp, second_pass=arguments.second_pass)
        rows += more
        motions.append(motion)
        if arguments.picture and k == 0:
            draw_maps(drive, seen, kiss_icp, arguments.picture)
    if len(rows) == 1:
        parser.error(f"{arguments.root or 'drawn streets'}: no such drive of {arguments.least} scans or more")
    software = versions(**{"KISS-ICP": importlib.metadata.version("kiss-icp")})
    part = Section("KISS-ICP", [f"KISS-ICP in one thread; processor times; {software}"], rows)
    print(text([part, Section("Motion between scans", ["Distance from where the next scan truly is."], motions)]))


if __name__ == "__main__":
    main()
