"""``edgeperc info``: what a model is, what a scan looks like and which models it suits."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import EdgepercError, MissingExtraError, ModelFileError, SensorError
from .output import complain, one_line, print_rows

if TYPE_CHECKING:
    from ..session import Session

__all__ = ["info_command"]


# info


def info_command(arguments: argparse.Namespace) -> int:
    """``edgeperc info``: describe models and scans; 1 if some failed."""
    n_failed = n_told = 0
    for thing in arguments.things:
        try:
            if arguments.json:
                print(_card(thing))
                n_told += 1
                continue
            rows = _model_rows(thing) if _is_model(thing) else _scan_rows(Path(thing), arguments.sensor)
        except (SensorError, MissingExtraError):
            raise
        except EdgepercError as exc:
            n_failed += 1
            complain(exc)
            continue
        if n_told:
            print()
        print_rows(rows)
        n_told += 1
    return 1 if n_failed else 0


def _is_model(thing: str) -> bool:
    """A path that exists, or looks like one, is a scan unless it ends in .onnx; any other word is a model's name."""
    path = Path(thing)
    return path.suffix == ".onnx" or not (path.exists() or path.suffix or len(path.parts) > 1)


def _open(thing: str) -> Session:
    from ..session import Session

    return Session(thing, "cpu")


def _card(thing: str) -> str:
    if not _is_model(thing):
        raise ModelFileError(f"{thing} is a scan; only models have a card")
    return _open(thing).card.to_json()


def _model_rows(thing: str) -> list[tuple[str, str]]:
    from ..card import TopViewGeometry

    session = _open(thing)
    card = session.card
    channels, height, width = session.input.shape
    if isinstance(card.view, TopViewGeometry):
        (x_near, x_far), (y_right, y_left) = card.view.x_range_m, card.view.y_range_m
        seen = f"x {x_near:g}..{x_far:g} m, y {y_right:g}..{y_left:g} m, cells of {card.view.cell_m:g} m"
    else:
        up, down = card.view.row_elevations_deg[0], card.view.row_elevations_deg[-1]
        left, right = card.view.azimuth_left_deg, card.view.azimuth_right_deg
        seen = f"{height} beams from {up:g} to {down:g} deg, azimuths {left:g} to {right:g} deg"
    rows = [
        ("model", f"{card.name} {card.version}"),
        ("file", f"{session.path} ({session.path.stat().st_size / 1e6:.1f} MB)"),
        ("sha256", session.sha256),
        ("view", f"{card.view.kind}: {seen}"),
        ("input", f"{channels} x {height} x {width}: {', '.join(card.input.channels)}"),
        ("outputs", ", ".join(f"{output.name} ({output.kind})" for output in card.outputs)),
        ("classes", ", ".join(card.classes)),
    ]
    if card.box_classes:
        rows.append(("boxes", f"{', '.join(card.box_classes)}, score from {card.score_threshold:g}"))
    for name in ("training", "metrics", "parity"):
        rows += _nested(name, getattr(card, name))
    if not math.isnan(session.golden_deviation):
        rows.append(("here", f"answers within {session.golden_deviation:.2g} standard deviations of the exporter's"))
    return rows


def _nested(name: str, value: Any) -> list[tuple[str, str]]:
    """A card's free-form facts, an inner mapping's keys joined by dots; what is long by its length."""
    if isinstance(value, Mapping) and len(value) > 24:
        return [(name, f"{len(value)} entries")]
    if isinstance(value, Mapping):
        return [row for key, inner in value.items() for row in _nested(f"{name}.{key}", inner)]
    if isinstance(value, (list, tuple)) and (len(value) > 12 or any(isinstance(v, (list, Mapping)) for v in value)):
        return [(name, f"{len(value)} values")]
    if isinstance(value, (list, tuple)):
        return [(name, ", ".join(map(one_line, value)))]
    return [(name, f"{value:.4g}" if isinstance(value, float) else one_line(value))]


def _scan_rows(path: Path, sensor_name: str) -> list[tuple[str, str]]:
    import numpy as np

    from ..adapt import render
    from ..fitness import FitnessProfile, check_fitness
    from ..readers.captures import read_scans
    from ..sensor import get_sensor
    from ..session import Session
    from ..zoo import model_path, shipped_models

    sensor = get_sensor(sensor_name)
    _, points = next(read_scans(path))  # of several the first
    finite = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    rows = [("scan", str(path)), ("points", f"{len(points):,}, of which {len(points) - len(finite):,} are not finite")]
    if len(finite):
        flat = np.hypot(finite[:, 0], finite[:, 1])
        distance = np.hypot(flat, finite[:, 2])
        low, high = np.percentile(np.degrees(np.arctan2(finite[:, 2], flat)), [0.5, 99.5])
        for k, axis in enumerate(("x", "y", "z")):
            rows.append((axis, f"{finite[:, k].min():.1f} .. {finite[:, k].max():.1f} m"))
        rows.append(("range", "{:.1f} .. {:.1f} m, median {:.1f}".format(*np.percentile(distance, [0, 100, 50]))))
        rows.append(("elevation", f"{low:.1f} .. {high:.1f} deg (99 % of the points)"))
        quantiles = np.percentile(finite[:, 3], [0, 5, 50, 95, 100])
        rows.append(("remission", "least {:g}, 5 % {:g}, median {:g}, 95 % {:g}, most {:g}".format(*quantiles)))
    if sensor.remission is not None:
        points = render(points, sensor)
        rows.append(("", f"rendered as the {sensor.remission.to}'s by a {sensor.remission.kind}"))
    else:
        points = points.copy()
        points[:, 3] = (points[:, 3] + np.float32(sensor.remission_offset)) * np.float32(sensor.remission_scale)
    if not len(finite):
        return rows
    measured = FitnessProfile.from_scans([points])
    rows.append(("beams", f"about {measured.beams[0]:.0f} rows of points ({sensor.name}: {sensor.n_beams})"))
    rows.append(("ground", "not found" if measured.ground_m is None else f"at z = {measured.ground_m[0]:.1f} m"))
    for name in shipped_models():
        try:
            fitness = Session(model_path(name), "cpu").card.fitness
        except MissingExtraError as exc:
            rows.append((name, one_line(exc)))
            continue
        if fitness is None:
            rows.append((name, "its card does not say what its training scans looked like"))
            continue
        found = check_fitness(points, FitnessProfile.from_dict(fitness), sensor)
        rows += [(name, f"as a scan of {sensor.name}: {sentence}") for sentence in found]
        if not found:
            rows.append((name, f"suits this scan, taken as one of {sensor.name}"))
    return rows
