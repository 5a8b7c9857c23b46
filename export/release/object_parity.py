"""An exported object network compared with its torch network, and with the truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from edgeperc.evaluation.evaluate import Perceiving, evaluate
from edgeperc.ground.planes import find_ground
from edgeperc.ground.scan import Scan
from edgeperc.inference.session import MAX_ROWS, Session
from edgeperc.objects.candidate_boxes import LABEL, SCORE, decode_objects
from edgeperc.objects.candidates import find_candidates, sort_into_cells
from edgeperc.objects.crops import crop_candidates, fill_features, with_points
from edgeperc.types.card import ModelCard
from edgeperc.types.points import Floats, Floats32, Points, read_only
from edgeperc.types.views import ObjectGeometry

from ..networks.objects import ObjectNet

TOP_VIEW = "ssadnet"
"""Model whose boxes are candidates of the object network."""


def candidate_inputs(card: ModelCard, points: Points) -> tuple[Floats32, Floats, Floats]:
    """The network's input for the clusters of a scan, their rectangles, and z of the ground at each [m]."""
    view = card.view
    assert isinstance(view, ObjectGeometry)
    scan = Scan.of(read_only(points), find_ground(points))
    found = find_candidates(scan, sort_into_cells(scan, view.height_range_m))
    (places, _), crops = with_points(found, crop_candidates(scan, found, view.n_points, view.margin_m))
    features = np.empty((len(places), view.n_points, len(card.input.channels)), np.float32)
    fill_features(crops.points, crops.counts, places, np.array([card.input.mean, card.input.std], np.float32), features)
    return features, places, crops.level


def objects_of(session: Session, inputs: Floats32) -> Floats32:
    """Outputs of the network for candidates, at most `MAX_ROWS`."""
    n = min(len(inputs), MAX_ROWS)
    session.input[:n] = inputs[:n]
    return session.run(n)["objects"][:n]


def object_figures(kitti: Path, path: Path, name: str, fold: int | None = None) -> tuple[dict[str, Any], str]:
    """What a card holds of a KITTI set's boxes, with those of the top view as candidates, and the command for it."""
    figures, _ = evaluate([kitti], [TOP_VIEW, path], Perceiving(rules=()), fold=fold)
    figures["real"] = {key: figures["real"][key] for key in ("n_frames", "n_drives", "kitti")}
    of_fold = f" --fold {fold}" if fold is not None else ""
    return figures, f"edgeperc eval KITTI --model {TOP_VIEW} --model {name} --no-agreement{of_fold}"


def compare_objects(network: ObjectNet, session: Session, scans: Sequence[NDArray[Any]]) -> tuple[float, float, float]:
    """Differences between torch and onnxruntime on the clusters of scans, as `to_onnx.verify` says: of classes among
    candidates with a score of 0.1 or more, of places and sizes [m].
    """
    card, worst, agreement, box_deviation = session.card, 0.0, 1.0, 0.0
    for scan in scans:
        features, places, level = candidate_inputs(card, np.asarray(scan, np.float32))
        features, places, level = features[:MAX_ROWS], places[:MAX_ROWS], level[:MAX_ROWS]
        if not len(features):
            continue
        with torch.no_grad():
            expected = network.eval().detect(torch.from_numpy(features)).numpy()
        actual = objects_of(session, features)
        worst = max(worst, float(np.quantile(np.abs(actual - expected), 0.999)) / max(float(expected.std()), 1e-6))
        boxes, right = (decode_objects(card, outputs, places, level) for outputs in (actual, expected))
        likely = right[:, SCORE] >= 0.1
        alike = likely & (boxes[:, LABEL] == right[:, LABEL])
        if likely.any():
            agreement = min(agreement, float(alike.sum() / likely.sum()))
        if alike.any():
            box_deviation = max(box_deviation, float(np.abs(boxes - right)[alike, :6].max()))
    return worst, agreement, box_deviation
