"""Evaluate trackers on KITTI's tracking sequences, by AB3DMOT's protocol and as in KUL-Seg's Table 7.

There are two sets of rules (`RULES`). Every tracker that is compared is evaluated by the same set.
"""

from __future__ import annotations

import math
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..datasets.kitti import IMAGE_SIZE, KittiCalibration, KittiObjects, label_lines, wrong_in_label
from ..errors import TrackingError
from ..perceiver import Perceiver
from ..readers.files import read_points
from ..tracking.smoothing import smooth_tracks
from ..tracking.tracker import Tracker
from ..tracking.tracks import Tracks
from ..types.choices import VEHICLES
from ..types.perception import Box
from ..types.points import Floats, Ints64, Mask
from .ab3dmot import SETTINGS, Ab3dmot
from .headings import FRAME_S, count_headings, matches
from .judge import check_unseen, training_scans_of
from .metrics import box_rows
from .predictions import count_predictions
from .tracking_metrics import FrameTracks, FrameTruth, evaluate_tracks

__all__ = ["CLASSES", "KINDS", "RULES", "evaluate_kitti"]

CLASSES = ("car", "pedestrian", "cyclist")

# Labels of each evaluated class; KUL-Seg's Table 7 evaluates vehicles.
KINDS = {**{of: (of,) for of in CLASSES}, "vehicle": VEHICLES}

# From KITTI's evaluation: labels that may be confused with each class, and limits of objects to find.
NEIGHBORS = {"car": ("van",), "pedestrian": ("person", "person_sitting"), "cyclist": (), "vehicle": ("tram", "misc")}
MAX_OCCLUSION, MAX_TRUNCATION, MIN_HEIGHT_PX, MIN_UNLABELED = 2, 0, 25.0, 0.5

# "edgeperc": a track's image box is the projection of its 3-D box, and scores are compared exactly.
# "ab3dmot": as AB3DMOT's program. Boxes are upright in the camera's frame, whose y axis is up to 1 degree off the
# sensor's z axis. A track's image box is that of its last detection, sitting people are labeled as nothing, and scores
# are rounded (`edgeperc.evaluation.tracking_metrics.evaluate_tracks`).
RULES = ("edgeperc", "ab3dmot")


@dataclass(frozen=True, slots=True, eq=False)
class TrackingSequence:
    """One sequence: detections and truth, by frame."""

    name: str
    detections: tuple[tuple[Box, ...], ...]  # of all classes, in the sensor frame; scores are in 0..1
    image_boxes: tuple[Floats, ...]  # left, top, right, bottom [px] of each detection, (k, 4)
    truth: Mapping[str, tuple[FrameTruth, ...]]  # by class
    unlabeled: tuple[Floats, ...]  # left, top, right, bottom [px] of regions without labels, (k, 4)
    calibration: KittiCalibration


@dataclass(frozen=True, slots=True, eq=False)
class FrameResult:
    """What a tracker reports for one frame."""

    ids: Ints64  # (n,)
    labels: Sequence[str]
    boxes: Floats  # (n, 7), in the sensor frame
    scores: Floats  # log odds, or others: only their order and their mean over a track's frames matter
    sources: Ints64  # index of the detection of this frame; -1 for none

    @classmethod
    def of(cls, tracks: Tracks) -> FrameResult:
        """Convert the tracks of `edgeperc.Tracker`."""
        with np.errstate(divide="ignore"):  # log odds, because float64 probabilities near 1 cannot be distinguished
            scores = np.log(tracks.scores) - np.log1p(-tracks.scores)
        return cls(tracks.ids, tracks.labels, tracks.boxes, np.clip(scores, -36.0, 36.0), tracks.sources)


def sequence_names(root: Path | str) -> list[str]:
    """Names of the sequences below ``root``: of KITTI's tracking (``label_02/NAME.txt``), or drives of an object set
    with ``training/track_id``, an id for each label (`datasets.kitti.KittiObjects`). Raises TrackingError.
    """
    root = Path(root)
    names = sorted(path.stem for path in (root / "label_02").glob("*.txt"))
    if not names and (root / "training/track_id").is_dir():
        drives = KittiObjects(root).drives
        names = sorted({drives[path.stem] for path in (root / "training/track_id").glob("*.txt")})
    if not names:
        raise TrackingError(
            f"{root} has no label_02/*.txt and no training/track_id/*.txt; pass the root of KITTI's tracking "
            "sequences, or of an object set with track ids"
        )
    return names


def sequence_scans(root: Path | str, name: str) -> dict[int, Path]:
    """Files of the scans of a sequence, by frame: ``velodyne/NAME/FRAME.bin``, or those of the drive; maybe none."""
    root = Path(root)
    if (root / "label_02").is_dir():
        files = sorted((root / "velodyne" / name).glob("*.bin"))
        if odd := [file for file in files if not file.stem.isdecimal()]:
            raise TrackingError(f"{odd[0]}: expected the number of a frame as its name, such as 000012.bin; rename it")
        return {int(path.stem): path for path in files}
    training = root / "training"
    names = [of for of, drive in KittiObjects(root).drives.items() if drive == name]
    with_ids = (of for of in names if (training / "track_id" / f"{of}.txt").exists())
    return {frame: training / "velodyne" / f"{of}.bin" for frame, of in enumerate(with_ids)}


def _labels(root: Path, name: str) -> tuple[Path, list[list[str]], KittiCalibration]:
    """Read the labels of a sequence: their path, KITTI's 17 columns of each label as text, and the calibration."""
    if name not in (known := sequence_names(root)):
        raise TrackingError(f"{root} has no sequence {name!r:.60}; expected one of {', '.join(known):.80}")
    path = root / "label_02" / f"{name}.txt"
    if path.parent.is_dir():
        lines = [line.split() for _, line in label_lines(path)]
        return path, lines, KittiCalibration.read(root / "calib" / f"{name}.txt")
    path, lines, stem = root / "training/label_2", [], ""
    for frame, scan in sequence_scans(root, name).items():
        stem = scan.stem
        labels, ids = (label_lines(folder / f"{stem}.txt") for folder in (path, root / "training/track_id"))
        if len(ids) != len(labels):
            raise TrackingError(
                f"{path}/{stem}.txt has {len(labels)} labels, and {len(ids)} track ids; expected as many"
            )
        lines += [[str(frame), one, *label.split()] for (_, one), (_, label) in zip(ids, labels, strict=True)]
    return path, lines, KittiCalibration.read(root / "training/calib" / f"{stem}.txt")


def _values(labels: Sequence[Sequence[str]], path: Path) -> Floats:
    """The numbers of labels: frame, track, and the 14 of an object."""
    try:
        values = np.array([[*columns[:2], *columns[3:17]] for columns in labels], np.float64).reshape(-1, 16)
    except ValueError as exc:
        raise TrackingError(f"{path} is not a file of KITTI tracking labels; expected 17 columns") from exc
    for number, (columns, numbers) in enumerate(zip(labels, values.tolist(), strict=True), start=1):
        wrong = wrong_in_label(columns[2], numbers[2:])
        if not _is_frame(numbers[0]) or not (numbers[1].is_integer() and abs(numbers[1]) < 2**53):
            wrong = f"expected the numbers of a frame and of a track, got {columns[0]}, {columns[1]}"
        if wrong:
            raise TrackingError(f"{path}, label {number}: {wrong}")
    objects = [(*columns[:2],) for columns in labels if columns[2].lower() != "dontcare"]
    if len({*objects}) < len(objects):
        frame, track = Counter(objects).most_common(1)[0][0]
        raise TrackingError(f"{path} has track {track} twice in frame {frame}; expected a label of each object")
    return values


def _is_frame(number: float) -> bool:
    return 0.0 <= number <= 1e6 and number.is_integer()


def read_sequence(
    root: Path | str,
    name: str,
    classes: Sequence[str] = CLASSES,
    boxes: Sequence[Sequence[Box]] | None = None,
    *,
    rules: str = RULES[0],
) -> TrackingSequence:
    """Read labels, calibration and detections (``detections/DETECTOR_CLASS/NAME.txt``, or ``boxes`` by frame) of a
    sequence (`sequence_names`) of the classes of `KINDS`, by one of the `RULES`. Raises EdgepercError, OSError.
    """
    root = Path(root)
    label_path, labels, calibration = _labels(root, name)
    values = _values(labels, label_path)
    kinds = np.array([columns[2].lower() for columns in labels], np.str_)
    n_frames = 1 + int(values[:, 0].max(initial=-1.0))
    if boxes is None:
        detections, image_boxes = _read_detections(root, name, classes, calibration, n_frames)
    elif len(boxes) < n_frames:
        raise TrackingError(
            f"got boxes of {len(boxes)} frames for {n_frames} of {label_path}; pass one line for each frame"
        )
    else:
        detections = [list(of_frame) for of_frame in boxes]
        image_boxes = [calibration.image_rectangles(box_rows(of_frame)) for of_frame in detections]
    n_frames = len(detections)
    placed = calibration.sensor_boxes(values[:, 9:16])
    ignored = (values[:, 2] > MAX_TRUNCATION) | (values[:, 3] > MAX_OCCLUSION)
    truth: dict[str, tuple[FrameTruth, ...]] = {}
    for label in classes:
        neighbors = [kind for kind in NEIGHBORS[label] if (rules, kind) != ("ab3dmot", "person")]
        mine = np.isin(kinds, [*KINDS[label], *neighbors])
        excused = ignored | ~np.isin(kinds, KINDS[label])
        in_frame = [np.flatnonzero(mine & (values[:, 0] == k)) for k in range(n_frames)]
        truth[label] = tuple(
            FrameTruth(values[rows, 1].astype(np.int64), placed[rows], excused[rows]) for rows in in_frame
        )
    unlabeled = kinds == "dontcare"
    return TrackingSequence(
        name=name,
        detections=tuple(tuple(of_frame) for of_frame in detections),
        image_boxes=tuple(image_boxes),
        truth=truth,
        unlabeled=tuple(values[unlabeled & (values[:, 0] == k), 5:9] for k in range(n_frames)),
        calibration=calibration,
    )


def _read_detections(
    root: Path, name: str, classes: Sequence[str], calibration: KittiCalibration, n_frames: int
) -> tuple[list[list[Box]], list[Floats]]:
    """Detections and image rectangles by frame: frame, type, rectangle, logit, h, w, l, x, y, z, turn, alpha."""
    found = defaultdict[float, list[tuple[Box, Floats]]](list)
    for label in classes:
        folders = sorted((root / "detections").glob(f"*_{label.capitalize()}"))
        if len(folders) != 1:
            names = ", ".join(folder.name for folder in folders) or "none"
            raise TrackingError(f"{root}/detections: expected one folder *_{label.capitalize()}, got {names}")
        path = folders[0] / f"{name}.txt"
        lines = [line.split(",") for _, line in label_lines(path)]
        try:
            rows = np.array(lines, np.float64).reshape(-1, 15)
        except ValueError as exc:
            raise TrackingError(f"{path} is not a file of detections; expected 15 comma-separated columns") from exc
        if odd := [number for number in rows[:, 0].tolist() if not _is_frame(number)]:
            raise TrackingError(f"{path}: expected the numbers of frames, from 0, in the first column, got {odd[0]:g}")
        scores = 1.0 / (1.0 + np.exp(-rows[:, 6]))
        placed = calibration.sensor_boxes(rows[:, 7:14])
        for frame, score, seen, row in zip(rows[:, 0], scores.tolist(), rows[:, 2:6], placed.tolist(), strict=True):
            found[frame].append((Box(label, score, (row[0], row[1], row[2]), (row[3], row[4], row[5]), row[6]), seen))
    in_order = [found[k] for k in range(max(n_frames, 1 + int(max(found, default=-1))))]
    image_boxes = [np.array([seen for _, seen in of_frame]).reshape(-1, 4) for of_frame in in_order]
    return [[box for box, _ in of_frame] for of_frame in in_order], image_boxes


def track_sequence(sequence: TrackingSequence, *, smooth: bool = False) -> tuple[list[Tracks], float]:
    """Run a new `edgeperc.Tracker` over a sequence, without poses: the tracks by frame, smoothed when it is over if
    asked, and the seconds it took.
    """
    # Labels and detections cover the field of view of the left color camera.
    (fx, _, cx), width_px = sequence.calibration.P2[0, :3], IMAGE_SIZE[0]
    edges = math.degrees(math.atan(cx / fx)), -math.degrees(math.atan((width_px - cx) / fx))
    tracker = Tracker(field_of_view_deg=edges)  # its construction compiles the kernels
    tracks = []
    start = time.perf_counter()
    for k, boxes in enumerate(sequence.detections):
        tracks.append(tracker.update(boxes, k * FRAME_S))
    seconds = time.perf_counter() - start
    return smooth_tracks(tracks) if smooth else tracks, seconds


def ab3dmot_sequence(sequence: TrackingSequence, classes: Sequence[str] = CLASSES) -> list[FrameResult]:
    """Run AB3DMOT's method (`edgeperc.evaluation.ab3dmot`) over a sequence, with one tracker for each class that it has
    settings for; the others have no tracks.
    """
    trackers = {label: Ab3dmot(SETTINGS[label]) for label in classes if label in SETTINGS}
    results = []
    for boxes in sequence.detections:
        parts, labels = [], []
        for number, (label, tracker) in enumerate(trackers.items()):
            mine = [k for k, box in enumerate(boxes) if box.label == label]
            scores = np.clip([boxes[k].score for k in mine], 1e-15, 1.0 - 1e-15)
            ids, rows, logits, at = tracker.update(
                [boxes[k] for k in mine], (np.log(scores) - np.log1p(-scores)).tolist()
            )
            sources = np.where(at >= 0, np.append(mine, -1).astype(np.int64)[at], -1)
            parts.append((len(trackers) * ids + number, rows, logits, sources))
            labels += [label] * len(ids)
        ids, rows, logits, sources = (np.concatenate(part) for part in zip(*parts, strict=True))
        results.append(FrameResult(ids, labels, rows, logits, sources))
    return results


def _frame_tracks(sequence: TrackingSequence, results: Sequence[FrameResult], of: str, rules: str) -> list[FrameTracks]:
    """Convert the tracks of one class for the metrics, by frame."""
    frames = []
    last: dict[int, Floats] = {}
    for result, seen, unlabeled in zip(results, sequence.image_boxes, sequence.unlabeled, strict=True):
        mine = np.flatnonzero([label in KINDS[of] for label in result.labels])
        ids, boxes = result.ids[mine], result.boxes[mine]
        shown = sequence.calibration.image_rectangles(boxes)
        if rules == "ab3dmot":
            for k, (one, source) in enumerate(zip(ids.tolist(), result.sources[mine].tolist(), strict=True)):
                if source >= 0:
                    last[one] = seen[source]
                shown[k] = last.get(one, shown[k])
            boxes = sequence.calibration.in_camera(boxes)
        frames.append(FrameTracks(ids, boxes, result.scores[mine], _excused(shown, unlabeled)))
    return frames


def _excused(shown: Floats, unlabeled: Floats) -> Mask:
    """Which image rectangles (n, 4) are at most 25 pixels high, or have over half of their area in DontCare."""
    low, high = shown[:, :2], shown[:, 2:]
    size = high - low
    hidden = (size[:, 1] <= MIN_HEIGHT_PX) | (size[:, 0] <= 0.0)
    for left, top, right, bottom in unlabeled:
        shared = np.minimum(high, [right, bottom]) - np.maximum(low, [left, top])
        overlap = np.where((shared > 0.0).all(axis=1), shared.prod(axis=1), 0.0)
        hidden |= overlap > MIN_UNLABELED * np.maximum(size.prod(axis=1), 1e-9)
    return np.asarray(hidden)


def evaluate_kitti(
    root: Path | str,
    *,
    sequences: Sequence[str] | None = None,
    classes: Sequence[str] = CLASSES,
    boxes: Mapping[str, Sequence[Sequence[Box]]] | None = None,
    iou_threshold: float = 0.25,
    rules: str = RULES[0],
    smooth: bool = False,
    rival: bool = False,
    on_sequence: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Run the tracker over KITTI's sequences and evaluate the tracks.

    One tracker tracks all classes together, without ego poses.

    Parameters
    ----------
    root : str or Path
        As in `sequence_names`, with ``detections`` unless ``boxes`` are passed.
    sequences : sequence of str, optional
        Default: all labeled sequences.
    classes : sequence of str
    boxes : mapping of str to sequence of sequence of Box, optional
        Detections by sequence and frame, instead of the files.
    iou_threshold : float
        Smallest 3-D IoU of a match.
    rules : str
        Of `RULES`.
    smooth : bool
        Whether to smooth the tracks of each sequence when it is over (`edgeperc.smooth_tracks`).
    rival : bool
        Whether to evaluate AB3DMOT's method too, with the same boxes and rules.
    on_sequence : callable, optional
        Called with the number of sequences done and the number of all sequences.

    Returns
    -------
    dict
        For JSON: ``sequences``, ``iou_threshold``, ``rules``, ``smooth``, ``frames_per_s``; in ``classes`` the
        `TrackingScores` of each; in ``headings`` and ``predictions`` the counts of `edgeperc.evaluation.headings` and
        `edgeperc.evaluation.predictions` of each; with ``rival``, in ``rival`` the `TrackingScores` of AB3DMOT's
        method.

    Raises
    ------
    TrackingError
        There is no such data, or a file is malformed, or there are no such rules, or ``iou_threshold`` is not in 0..1.
    PointsError
        A file of labels or detections cannot be read, or is no text.
    """
    if rules not in RULES:
        raise TrackingError(f"got rules {rules!r}; expected one of {', '.join(RULES)}")
    if not 0.0 < iou_threshold <= 1.0:
        raise TrackingError(f"got an iou_threshold of {iou_threshold}; expected a number above 0 and up to 1")
    # What is named twice counts once.
    root, classes = Path(root), [*dict.fromkeys(classes)]
    names = [*dict.fromkeys(sequences or sequence_names(root))]
    # By tracker and class, of each sequence.
    pairs: dict[tuple[str, str], list[tuple[Sequence[FrameTruth], Sequence[FrameTracks]]]] = {}
    headings: dict[str, dict[str, Counter[str]]] = {label: {} for label in classes}
    predictions: dict[str, dict[str, Counter[str]]] = {label: {} for label in classes}
    n_frames, seconds = 0, 0.0
    for done, name in enumerate(names, start=1):
        sequence = read_sequence(root, name, classes, (boxes or {}).get(name), rules=rules)
        tracks, took = track_sequence(sequence, smooth=smooth)
        n_frames, seconds = n_frames + len(tracks), seconds + took
        results = {"edgeperc": [FrameResult.of(in_frame) for in_frame in tracks]}
        if rival:
            results["ab3dmot"] = ab3dmot_sequence(sequence, classes)
        for label in classes:
            true: Sequence[FrameTruth] = sequence.truth[label]
            if rules == "ab3dmot":
                true = [replace(frame, boxes=sequence.calibration.in_camera(frame.boxes)) for frame in true]
            for method, reported in results.items():
                pair = true, _frame_tracks(sequence, reported, label, rules)
                pairs.setdefault((method, label), []).append(pair)
            matched = [*matches(sequence.truth[label], tracks, KINDS[label], iou_threshold)]
            counted = [(headings, count_headings)]
            if not smooth:  # what is known in hindsight predicts nothing
                counted.append((predictions, count_predictions))
            for counters, count in counted:
                for name_of, counts in count(sequence.truth[label], tracks, matched).items():
                    counters[label].setdefault(name_of, Counter()).update(counts)
        if on_sequence is not None:
            on_sequence(done, len(names))
    scores: dict[str, dict[str, Any]] = {"edgeperc": {}, "ab3dmot": {}}
    for (method, label), frames in pairs.items():
        scores[method][label] = asdict(evaluate_tracks(frames, iou_threshold, as_ab3dmot=rules == "ab3dmot"))
    return {
        "sequences": names,
        "iou_threshold": iou_threshold,
        "rules": rules,
        "smooth": smooth,
        "frames_per_s": n_frames / seconds,
        "classes": scores["edgeperc"],
        "headings": headings,
        "predictions": predictions,
        **({"rival": scores["ab3dmot"]} if rival else {}),
    }


def perceive_drive(
    perceive: Perceiver, scans: Mapping[int, Path], drive: str, on_scan: Callable[[], None] = lambda: None
) -> list[list[Box]]:
    """Detect the boxes in the scans of a drive, by frame; one without a scan has none. ``on_scan`` is called after each
    scan. Raises SplitError, PointsError.
    """
    trained_on = training_scans_of(perceive.cards)
    boxes: list[list[Box]] = [[] for _ in range(1 + max(scans, default=-1))]
    for frame, path in scans.items():
        points = read_points(path)
        check_unseen(trained_on, path.stem, drive, points)
        boxes[frame] = list(perceive(points).boxes)
        on_scan()
    return boxes
