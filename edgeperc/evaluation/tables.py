"""Compute the papers' figures from records of evaluated scans, with 95 % intervals.

A figure is computed from the summed counts of its scans. Its interval comes from a bootstrap over drives, not over
frames, because frames of one drive look similar.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import reduce
from operator import add
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..simulation.samples import IGNORE
from ..types.choices import STATIC, VEHICLES
from ..types.points import Bytes, Floats, Labels
from .causes import BUMPER, CAUSES, FLOOR
from .center_ap import CLASSES, center_scores
from .kitti_ap import average_precisions
from .metrics import BoxEvaluator, BoxScores, Confusion, Listed, ObjectKey, ProbabilitySweep, mean

# Groups of classes whose boxes are evaluated wherever the truth is known: their classes, and the smallest IoU of a
# match. A person's box is hardly larger than the spacing of the points on it, so it is matched at 0.25.
ALL_ROUND = {"vehicle": (VEHICLES, 0.5), "person": (("pedestrian", "cyclist"), 0.25)}

SITTING = "person_sitting"  # label of people who sit; their points count as pedestrians'
FEWEST_OBJECTS = 10  # figures of fewer distinct objects are marked: they say little

# Ranges of the horizontal distance [m] of points, cell centers and box centers.
BANDS = {"all": (0.0, math.inf), "0-15 m": (0.0, 15.0), "15-30 m": (15.0, 30.0), "30-46 m": (30.0, 46.0)}
Tallies = Mapping[tuple[str, ...], Any]


@dataclass(frozen=True)
class Record:
    """Counts of one evaluated scan by the keys of their figures, such as ``("points", "0-15 m")``; they add up."""

    name: str
    drive: str
    tallies: Tallies


def within(range_m: Any, within_m: tuple[float, float]) -> Any:
    """Whether distances lie in a band, with the lower and without the upper bound."""
    return (range_m >= within_m[0]) & (range_m < within_m[1])


def banded(
    table: tuple[str, ...], classes: tuple[str, ...], labels: Labels, right: Bytes, range_m: NDArray[Any]
) -> dict[tuple[str, ...], Confusion]:
    """A confusion matrix for each band of distance, by ``(*table, band)``; the true class `IGNORE` is not counted."""
    known = right != IGNORE
    labels, right, range_m = labels[known], right[known], range_m[known]
    confusions: dict[tuple[str, ...], Confusion] = {}
    for band, within_m in BANDS.items():
        in_range = within(range_m, within_m)
        confusion = Confusion(classes)
        confusion.update(labels[in_range], right[in_range])
        confusions |= {(*table, band): confusion}
    return confusions


def figures(records: Iterable[Record], n_resamples: int = 1000) -> dict[str, Any]:
    """Compute all figures of the records, and count their scans and drives.

    n_resamples : bootstrap resamples of the drives, for the 95 % intervals (``"iou_interval"`` for ``"iou"``), which
        are None if fewer than two drives have data for the figure.

    Numbers have four decimals, None for NaN. Rows of objects have their number of labels in all scans (``"n_boxes"`` or
    ``"n_truth"``), of distinct objects (``"n_objects"``, `metrics.object_key`) and of drives, and ``"few": True`` if
    there are fewer than `FEWEST_OBJECTS`.

    - ``"labeled"``: the labeled objects with at least three returns, by class.
    - ``"points"``, ``"pixels"``: by band and class. ``"iou_by_drive"``: the IoU if each drive counts as one scan,
      its mean scan, so that a long drive does not count for more than a single scan of another street.
    - ``"sure"``: as ``"points"``, without points of which boxes say little: the ground in the boxes of objects
      (`edgeperc.ground.planes.find_ground`), and people who sit, whom KITTI's own evaluation leaves out.
    - ``"boxes"``: by kind (``"upright"``, ``"oriented"``), band and class, of the classes and in the view that the
      models detect.
    - ``"all_round"``: by band and class, oriented boxes of vehicles (AP50) and people (AP25) wherever the truth is
      known, detected or not.
    - ``"kitti"``: by class, overlap and level or range: AP as KITTI's benchmark computes it (`kitti_ap`), in its
      image, or all round where all objects are labeled.
    - ``"centers"``: by class: AP by the distance of centers, and errors of matches (`center_ap`).
    - ``"heading"``: of the matched boxes of ``"boxes"`` and ``"all_round"``, by band and class, those whose heading
      is right within 45 degrees.
    - ``"errors"``: by error and cause (`causes.CAUSES`). ``"all"`` is a share of the true (missed) or predicted
      (false) points of the class, a cause a share of the error; ``"n_of"`` is the whole.
    - ``"bumper"``: points at the own bumper that are labeled car: all, and those on the ground. Where the truth is
      unknown they may be of a real car next to the ego vehicle.
    - ``"segmentation"``: by table and band. ``"road"``: by band.
    """
    by_drive: dict[str, list[Tallies]] = {}
    for record in records:
        by_drive.setdefault(record.drive, []).append(record.tallies)
    drives = [_one_drive(tallies) for tallies in by_drive.values()]
    whole = _figures(_summed(drives))
    draws = np.random.default_rng(0).integers(len(drives), size=(n_resamples if len(drives) > 1 else 0, len(drives)))
    # Few drives have few different resamples (three drives have ten), so each is computed once.
    different, times = np.unique(np.sort(draws, axis=1), axis=0, return_counts=True)
    samples = [_figures(_summed([drives[k] for k in draw])) for draw in different]
    _add_intervals(whole, [_figures(drive) for drive in drives], samples, times)
    return plain(whole) | {"n_frames": sum(map(len, by_drive.values())), "n_drives": len(drives)}


def _one_drive(scans: Sequence[Tallies]) -> Tallies:
    """Sum the counts of a drive's scans, and add the confusion of its mean scan."""
    tallies = _summed(scans)
    means: dict[tuple[str, ...], Any] = {}
    for key, tally in tallies.items():
        if key[0] == "points":
            means["mean_scan", key[1]] = Confusion(tally.classes, tally.counts / len(scans))
    return {**tallies, **means}


def _summed(parts: Sequence[Tallies]) -> Tallies:
    keys = dict.fromkeys(key for part in parts for key in part)
    return {key: reduce(add, [part[key] for part in parts if key in part]) for key in keys}


def _figures(tallies: Tallies) -> dict[str, Any]:
    figures: dict[str, Any] = {}
    for key, tally in tallies.items():
        group, band = key[0], key[-1]
        if group == "labeled":
            figures[group] = _labeled_rows(tally)
        elif group in ("points", "pixels"):
            figures.setdefault(group, {})[band] = _point_rows(tally, tallies["objects", band])
        elif group == "sure":
            objects = tallies["objects", band]
            others = Counter({key: n for key, n in objects.items() if key[1][1] != SITTING})
            figures.setdefault(group, {})[band] = _point_rows(tally, others)
        elif group == "mean_scan":
            for name, iou in zip(tally.classes, tally.iou().tolist(), strict=True):
                figures["points"][band][name]["iou_by_drive"] = iou
        elif group == "boxes":
            bands = {name: _of_all(tally, within_m, "vehicle") for name, within_m in BANDS.items()}
            figures.setdefault(group, {})[key[1]] = {name: _with_mean(scores) for name, scores in bands.items()}
            if key[1] == "oriented":
                figures.setdefault("heading", {})[group] = {
                    name: _heading_rows(scores) for name, scores in bands.items()
                }
        elif group == "all_round":
            for name, within_m in BANDS.items():
                scores = _of_all(tally, within_m, key[1])
                figures.setdefault(group, {}).setdefault(name, {}).update(_box_rows(scores))
                headings = figures.setdefault("heading", {}).setdefault(group, {})
                headings.setdefault(name, {}).update(_heading_rows(scores))
        elif group == "kitti":
            figures[group] = _kitti_rows(tally)
        elif group == "centers":
            figures[group] = _center_rows(tally)
        elif key == ("errors", "points"):
            scans, objects = tallies["errors", "scans"], tallies["errors", "objects"]
            figures["errors"] = {error: _error_rows(error, tally, scans, objects) for error in CAUSES}
            figures["bumper"] = {cause: _error_row(BUMPER, cause, tally, scans) for cause in ("all", FLOOR)}
        elif group == "segmentation":
            figures.setdefault(group, {}).setdefault(key[1], {})[band] = _map_row(tally)
        elif group == "road":
            figures.setdefault(group, {})[band] = _road_row(tally, tallies["decision", band], tallies["drivable", band])
    return figures


def _labeled_rows(labeled: Counter[ObjectKey]) -> dict[str, Any]:
    n_boxes = Counter(key[1] for key in labeled.elements())
    return {
        name: {"n_boxes": n} | _distinct(key for key in labeled if key[1] == name) for name, n in n_boxes.most_common()
    }


def _distinct(keys: Iterable[ObjectKey]) -> dict[str, Any]:
    """Number of distinct objects, and of their drives."""
    objects = {*keys}
    return {"n_objects": len(objects), "n_drives": len({drive for drive, *_ in objects})} | _few(len(objects))


def _few(n_objects: int) -> dict[str, bool]:
    return {"few": True} if n_objects < FEWEST_OBJECTS else {}


def _point_rows(confusion: Confusion, objects: Counter[tuple[str, ObjectKey]]) -> dict[str, Any]:
    rates = {"precision": confusion.precision(), "recall": confusion.recall(), "iou": confusion.iou()}
    rows = {}
    for k, name in enumerate(confusion.classes):
        row = {rate: float(values[k]) for rate, values in rates.items()}
        row["n_points"] = int(confusion.counts[k].sum())
        if k > 0 and name not in STATIC:
            row["n_boxes"] = sum(n for (label, _), n in objects.items() if label == name)
            row |= _distinct(key for label, key in objects if label == name)
        rows[name] = row
    return rows


def _of_all(evaluator: BoxEvaluator, within_m: tuple[float, float], together: str) -> dict[str, BoxScores]:
    """Scores of each class, and of the evaluator's group of classes under the name ``together``."""
    return {**evaluator.per_class(within_m), together: evaluator.overall(within_m)}


def _with_mean(scores_of: Mapping[str, BoxScores]) -> dict[str, Any]:
    return {"mean_ap": mean([row.ap for name, row in scores_of.items() if name != "vehicle"])} | _box_rows(scores_of)


def _box_rows(scores_of: Mapping[str, BoxScores]) -> dict[str, Any]:
    names = [score.name for score in fields(BoxScores) if score.name not in _HEADING]
    return {
        label: {name: getattr(scores, name) for name in names} | _few(scores.n_objects)
        for label, scores in scores_of.items()
    }


def _kitti_rows(table: Listed) -> dict[str, Any]:
    """By class, overlap and level or range."""
    rows: dict[str, Any] = {}
    for (label, overlap, level), counts in table.items():
        objects = [key for count in counts for key in count.objects]
        scores = dict(zip(("ap_r40", "ap_r11", "ap"), average_precisions(counts), strict=True))
        row = scores | {"n_truth": len(objects)} | _distinct(objects)
        rows.setdefault(label, {}).setdefault(overlap, {})[level] = row
    return rows


def _center_rows(table: Listed) -> dict[str, Any]:
    rows: dict[str, Any] = {}
    for label in CLASSES:
        objects = table.get(label, ())
        rows[label] = center_scores(table, label) | {"n_truth": len(objects)} | _distinct(objects)
    return {"mean_ap": mean([row["ap"] for row in rows.values()])} | rows


_HEADING = ("heading", "axis", "front_known", "n_found")


def _heading_rows(scores_of: Mapping[str, BoxScores]) -> dict[str, Any]:
    """Of the boxes that were matched: the share whose heading is right, over the full turn and modulo half a turn."""
    rows = {}
    for name, scores in scores_of.items():
        shares = {"heading": scores.heading, "axis": scores.axis, "front_known": scores.front_known}
        rows[name] = shares | {"n_hits": scores.n_hits, "n_objects": scores.n_found} | _few(scores.n_found)
    return rows


def _error_rows(
    error: str, points: Counter[Any], scans: Counter[Any], objects: Counter[Any]
) -> dict[str, dict[str, Any]]:
    rows = {}
    for cause in ("all", *CAUSES[error]):
        n, whole = points[error, cause], points[error, "of" if cause == "all" else "all"]
        row = {"share": n / whole if whole else math.nan, "n_of": whole} | _error_row(error, cause, points, scans)
        if error.startswith("missed"):
            row |= _distinct(key for *kind, key in objects if kind == [error, cause])
        rows[cause] = row
    return rows


def _error_row(error: str, cause: str, points: Counter[Any], scans: Counter[Any]) -> dict[str, Any]:
    n_scans = [n for (*kind, _), n in scans.items() if kind == [error, cause]]
    return {"n_points": points[error, cause], "n_scans": sum(n_scans), "n_drives": len(n_scans)}


def _map_row(confusion: Confusion) -> dict[str, Any]:
    """Accuracy, mAP as SSADNet's table 3 defines it, mIoU; ``"vehicle"`` joins car, van and truck."""
    classes = confusion.classes
    iou = dict(zip(classes, confusion.iou().tolist(), strict=True))
    n_cells = dict(zip(classes, confusion.counts.sum(axis=1).tolist(), strict=True))
    if vehicles := [name for name in classes if name in VEHICLES]:
        rest = [name for name in classes if name not in VEHICLES]
        vehicle = confusion.merged({"rest": rest, "vehicle": vehicles})
        iou["vehicle"], n_cells["vehicle"] = float(vehicle.iou()[1]), int(vehicle.counts[1].sum())
    return {
        "accuracy": confusion.accuracy(),
        "mean_ap": confusion.weighted_precision(),
        "mean_iou": confusion.mean_iou(),
        "n_cells": int(confusion.counts.sum()),
        "iou": iou,
        "n_cells_of": n_cells,
    }


def _road_row(sweep: ProbabilitySweep, decision: Confusion, drivable: Confusion) -> dict[str, Any]:
    """Figures of the model's own decision, of `TopView.drivable` ("drivable_..."), which leaves out road that the scan
    did not observe, and over thresholds of its probability; "confusion" are shares of all cells (Figure 21).
    """
    (_, false), (missed, hits) = decision.counts.tolist()
    return {
        "iou": float(decision.iou()[1]),
        "precision": float(decision.precision()[1]),
        "recall": float(decision.recall()[1]),
        "f1": 2 * hits / (2 * hits + false + missed) if hits + missed else math.nan,
        "drivable_precision": float(drivable.precision()[1]),
        "drivable_recall": float(drivable.recall()[1]),
        "accuracy": decision.accuracy(),
        "max_f1": sweep.max_f1(),
        "ap": sweep.average_precision(),
        "confusion": (decision.counts / max(int(decision.counts.sum()), 1)).tolist(),
        "n_cells": int(decision.counts.sum()),
        "n_road": hits + missed,
    }


# The number of a row that says whether a drive has data for its figures.
_COUNTS = ("n_of", "n_points", "n_truth", "n_hits", "n_road", "n_cells")


def _add_intervals(
    whole: dict[str, Any], drives: Sequence[dict[str, Any]], samples: Sequence[dict[str, Any]], times: NDArray[Any]
) -> None:
    """Add the interval of each figure to ``whole``; ``drives`` holds the figures of single drives."""
    count = next((name for name in _COUNTS if name in whole), None)
    for key, value in list(whole.items()):
        of_drives, of_samples = [record.get(key, {}) for record in drives], [record.get(key, {}) for record in samples]
        if key == "iou" and isinstance(value, dict):
            # A drive without the labels of a table has no row of it.
            cells = [record.get("n_cells_of", {}) for record in drives]
            whole["iou_interval"] = {
                name: _interval(
                    [n_cells.get(name, 0) for n_cells in cells], [row.get(name, math.nan) for row in of_samples], times
                )
                for name in value
            }
        elif isinstance(value, dict):
            _add_intervals(value, of_drives, of_samples, times)
        elif count and isinstance(value, float):
            values = [record.get(key, math.nan) for record in samples]
            whole[f"{key}_interval"] = _interval([record.get(count, 0) for record in drives], values, times)
        for cause in value if key == "bumper" else ():
            n_points = [record[cause]["n_points"] if record else 0 for record in of_samples]
            bounds = _interval([1] * len(drives), n_points, times)
            value[cause]["n_points_interval"] = bounds and [round(bound) for bound in bounds]
    for mean_of in ("mean_iou", "mean_ap"):
        # Means over different classes are not comparable, so only drives and resamples with all classes count.
        meant = [name for name, (value, _) in _parts(whole, mean_of).items() if not math.isnan(value)]
        if meant:
            parts = [
                [_parts(record, mean_of).get(name, (math.nan, 0)) for name in meant] for record in (*drives, *samples)
            ]
            fewest = [min(n for _, n in record) for record in parts[: len(drives)]]
            complete = [not any(math.isnan(value) for value, _ in record) for record in parts[len(drives) :]]
            values = [record[mean_of] if same else math.nan for record, same in zip(samples, complete, strict=True)]
            whole[f"{mean_of}_interval"] = _interval(fewest, values, times)


def _parts(row: Mapping[str, Any], mean_of: str) -> dict[str, tuple[float, int]]:
    """For a mean over classes: value of each class, and its number of cells or boxes."""
    if mean_of == "mean_iou" and "iou" in row and "n_cells_of" in row:
        return {name: (value, row["n_cells_of"][name]) for name, value in row["iou"].items() if name != "vehicle"}
    if mean_of == "mean_ap" and mean_of in row:
        rows = {name: figures for name, figures in row.items() if isinstance(figures, dict) and "ap" in figures}
        return {name: (figures["ap"], figures["n_truth"]) for name, figures in rows.items() if name != "vehicle"}
    return {}


def _interval(counts: Sequence[int], values: Sequence[float], times: NDArray[Any]) -> list[float] | None:
    """2.5 and 97.5 % quantiles of the resampled values; None with data from fewer than two drives."""
    if sum(n > 0 for n in counts) < 2:
        return None
    return interval(np.repeat(np.asarray(values, np.float64), times))


def interval(values: Floats) -> list[float] | None:
    """2.5 and 97.5 % quantiles of the values that are not NaN; None if there are none."""
    known = values[~np.isnan(values)]
    return [float(v) for v in np.percentile(known, [2.5, 97.5])] if known.size else None


def plain(value: Any) -> Any:
    """Prepare for JSON: four decimals, None for NaN."""
    if isinstance(value, dict):
        return {key: plain(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [plain(inner) for inner in value]
    return (None if math.isnan(value) else round(value, 4)) if isinstance(value, float) else value
