"""``edgeperc info``: what a model is; what a scan or an image looks like and which models suit it."""

from __future__ import annotations

import argparse
import hashlib
import json
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import EdgepercError, MissingExtraError, MountingError, PointsError
from ..system.atomic import write_atomic
from ..system.printable import many
from ..types.choices import DEFAULT_MODELS
from .arguments import Commands, add_capture, add_command, check_inputs, options
from .output import in_options, print_error, print_line, print_rows
from .scans import (
    Sensors,
    check_profile_place,
    check_scans,
    check_sensor,
    is_folder,
    nothing_below,
    reading_options,
    scan_folders,
)

if TYPE_CHECKING:
    from ..ground.leveling import MountingEstimator
    from ..types.frame import ModelFrame
    from ..types.perception import DroppedPoints
    from ..types.points import Floats32, Points
    from ..types.sensor import SensorProfile
    from ..zoo import Variant


_WIDTH = 100  # characters of a line, with its name
_MOST_SCANS = 300  # to look for the own vehicle in
_LINES = 2  # lines of a row about a model; --json prints everything


def add_parser(commands: Commands) -> None:
    """Add ``info``."""
    parser = add_command(
        commands,
        "info",
        info_command,
        help="what a model is; what a scan or an image looks like and which models suit it",
        description="Describe models by their cards: view, classes, training data, licence and accuracy. Describe "
        "scans: extent [m], elevations [deg], remission, beams, the mounting that the ground shows, and for each "
        "installed model whether the scan resembles its training scans. Describe images: size, and how camera models "
        "scale it. No model is run.",
        examples=[
            "edgeperc info pointseg",
            "edgeperc info 000123.bin",
            "edgeperc info drive.pcap",
            "edgeperc info velodyne/*.bin --write my-sensor.json",
            "edgeperc info drive.pcap --suggest-ego-box",
            "edgeperc info pointseg:int8 --json",
            "edgeperc info street.jpg",
        ],
    )
    reading = options(parser, "input")
    reading(
        "things MODEL|SCAN|IMAGE...",
        "a name from 'edgeperc models', an .onnx file, a scan, a capture (its first scan; its mounting by the "
        "first five), a folder of scans or a data set's root, as for 'run', or an image",
    )
    add_capture(reading)
    reading(
        "--suggest-ego-box",
        f"suggest --ego-box: returns near the sensor that never move in up to {_MOST_SCANS} scans of a drive, "
        "while the street does; look at it before you use it (default: no)",
    )
    output = options(parser, "output")
    output("--json", "print one JSON object for each thing: a model's whole card, a scan's measurements")
    output(
        "--write FILE",
        "write the sensor's profile with the mounting that a run of the scans takes, a .json file for --sensor "
        "(default: none)",
    )


def info_command(arguments: argparse.Namespace) -> int:
    """Describe models, scans and images; 1 if some failed, or ``edgeperc run`` refuses a scan."""
    from ..readers.images import IMAGE_SUFFIXES
    from ..zoo import resolve

    check_sensor(arguments)
    folders = {thing: scan_folders(Path(thing)) for thing in filter(_is_scan_folder, arguments.things)}
    arguments.things = [below for thing in arguments.things for below in map(str, folders.get(thing) or [thing])]
    if arguments.write is not None and arguments.write.suffix != ".json":
        arguments.usage_error(f"--write {arguments.write}: expected a name that ends in .json")
    if arguments.write is not None:
        check_profile_place(arguments.write)
    read = [Path(thing) for thing in arguments.things if not _is_model(thing)]
    read = [path for path in read if path.suffix.lower() not in IMAGE_SUFFIXES]
    if read:
        check_scans(arguments, read)
    else:
        check_inputs(arguments, (), arguments.things[0])
    estimators: dict[SensorProfile, MountingEstimator] = {}
    sensors = Sensors(arguments, [Path(thing) for thing in arguments.things])
    scans: list[Path] = []
    n_failed = n_printed = 0
    for thing in arguments.things:
        try:
            if _is_model(thing):
                variants = resolve(thing)
                rows, document = _model_rows(variants), json.loads(variants[0].card.to_json())
            elif Path(thing).suffix.lower() in IMAGE_SUFFIXES:
                rows, document = _image_rows(Path(thing))
            elif folders.get(thing) == []:
                raise PointsError(nothing_below(Path(thing)))
            else:
                rows, document = _scan_rows(Path(thing), arguments, sensors, estimators)
                scans.append(Path(thing))
                n_failed += document["refused"]
        except MissingExtraError:
            raise
        except EdgepercError as exc:
            n_failed += 1
            print_error(in_options(str(exc)))
            continue
        if arguments.json:
            print_line(json.dumps(document, allow_nan=False))
        else:
            if n_printed:
                print_line("")
            print_rows(_folded(rows, _LINES if _is_model(thing) else None))
        n_printed += 1
    n_failed += _mounting_of_all(arguments, estimators)
    if arguments.suggest_ego_box:
        n_failed += _suggest_ego_box(arguments, scans, estimators)
    return 1 if n_failed else 0


def _mounting_of_all(arguments: argparse.Namespace, estimators: Mapping[SensorProfile, MountingEstimator]) -> bool:
    """Print the mounting by all scans of a sensor, if there are several, and write ``--write``; whether it failed."""
    for sensor, estimator in estimators.items():
        if estimator.n_scans > 1 and not arguments.json:
            print_line("")
            print_rows([("mounting", f"{_mounting_text(estimator)}; {sensor.name}, by {estimator.n_scans} scans")])
    if arguments.write is None:
        return False
    if len(estimators) != 1:
        print_error(f"--write: the scans are of {len(estimators)} sensors; expected scans of one")
        return True
    ((sensor, estimator),) = estimators.items()
    try:
        estimator.estimate()
        unsure: dict[str, Any] = dict.fromkeys(estimator.doubtful())  # is found from later scans
        profile = replace(sensor, mounting=replace(estimator.mounting(), **unsure))  # as a run of these scans takes it
    except MountingError as exc:
        print_error(f"--write: {exc}")
        return True
    write_atomic(arguments.write, (profile.to_json() + "\n").encode())
    if not arguments.json:
        print_rows([("written", f"{arguments.write}: pass it as --sensor")])
    return False


def _suggest_ego_box(
    arguments: argparse.Namespace, paths: Sequence[Path], estimators: Mapping[SensorProfile, MountingEstimator]
) -> bool:
    """Print a box of the own vehicle for ``--ego-box``; whether the scans do not show one."""
    from ..preprocess.ego import suggest_ego_box
    from ..readers.captures import read_scans

    if len(estimators) != 1:
        print_error(f"--suggest-ego-box: the scans are of {len(estimators)} sensors; expected scans of one")
        return True
    ((sensor, estimator),) = estimators.items()
    scans = (points for path in paths for _, points in read_scans(path, **reading_options(path, arguments)))
    try:
        suggestion = suggest_ego_box(islice(scans, _MOST_SCANS), sensor, estimator.mounting())
    except EdgepercError as exc:
        print_error(f"--suggest-ego-box: {exc}")
        return True
    if arguments.json:
        found = {"sensor": sensor.name, "suggested_ego_box": suggestion.box, "n_places": suggestion.n_places}
        print_line(json.dumps(found))
    elif suggestion.box is None:
        print_rows([("own vehicle", f"in {suggestion.n_places} places, no return near the sensor stays where it is")])
    else:
        option = " ".join(f"{value:g}" for axis in suggestion.box for value in axis)
        seen = f"returns in {suggestion.n_directions} directions stay in {suggestion.n_places} places: if the box"
        then = f"holds the own vehicle and nothing else, pass --ego-box {option}"
        print_rows([("own vehicle", seen), ("", then)])
    return False


def _is_model(thing: str) -> bool:
    """A path that exists, or looks like one, is a scan unless it ends in .onnx; anything else is a model's name."""
    from ..readers.ports import is_port

    path = Path(thing)
    is_scan = path.exists() or path.suffix or len(path.parts) > 1 or is_port(path)
    return path.suffix == ".onnx" or not is_scan


def _is_scan_folder(thing: str) -> bool:
    return not _is_model(thing) and is_folder(Path(thing))


def _folded(rows: Sequence[tuple[str, str]], max_lines: int | None) -> list[tuple[str, str]]:
    """Rows with long values wrapped to `_WIDTH`, or cut off after so many lines."""
    width = _WIDTH - max(len(name) for name, _ in rows) - 2
    folded = []
    for name, value in rows:
        lines = textwrap.wrap(value, width, max_lines=max_lines, placeholder=" ...") or [""]
        folded += [(name if k == 0 else "", line) for k, line in enumerate(lines)]
    return folded


def _model_rows(variants: Sequence[Variant]) -> list[tuple[str, str]]:
    """Rows that describe a model; accuracy and geometry come from the card of its first variant."""
    from ..inference.listing import purpose
    from ..types.detector import PillarGeometry
    from ..types.views import CameraGeometry, ObjectGeometry, TopViewGeometry

    path, card = variants[0].path, variants[0].card
    size = ", ".join(f"{variant.precision} {variant.path.stat().st_size / 1e6:.1f} MB" for variant in variants)
    rows = [
        ("model", f"{card.name} {card.version}: {purpose(card)}"),
        ("file", str(path)),
        ("variants", size),
        ("sha256", hashlib.sha256(path.read_bytes()).hexdigest()),
    ]
    if isinstance(card.view, TopViewGeometry | PillarGeometry):
        (x_near, x_far), (y_right, y_left) = card.view.x_range_m, card.view.y_range_m
        seen = f"x {x_near:g}..{x_far:g} m, y {y_right:g}..{y_left:g} m, cells of {card.view.cell_m:g} m"
        if isinstance(card.view, PillarGeometry):
            low, high = card.view.z_range_m
            seen += f", z {low:g}..{high:g} m, frame {card.mount_height_m:g} m above the road"
            seen += f", {card.view.max_pillars} pillars of {card.view.max_points} points"
    elif isinstance(card.view, CameraGeometry):
        seen = f"{card.view.width} x {card.view.height} pixels, images are {card.view.fit}ed to it"
    elif isinstance(card.view, ObjectGeometry):
        low, high = card.view.height_range_m
        seen = f"{card.view.n_points} points within {card.view.margin_m:g} m, {low:g} to {high:g} m above the ground"
    else:
        up, down = card.view.row_elevations_deg[0], card.view.row_elevations_deg[-1]
        left, right = card.view.azimuth_left_deg, card.view.azimuth_right_deg
        seen = f"{card.view.height} beams from {up:g} to {down:g} deg, azimuths {left:g} to {right:g} deg"
    rows += [
        ("view", f"{card.view.kind}: {seen}"),
        ("input", f"{' x '.join(map(str, card.input_shape[1:]))}: {', '.join(card.input.channels)}"),
        ("outputs", ", ".join(f"{output.name} ({output.kind})" for output in card.outputs)),
        ("classes", ", ".join(card.classes)),
    ]
    if card.head is not None:
        names = zip(card.head.classes, card.box_classes, strict=True)
        rows.append(("head", f"{card.head.kind}: {', '.join(f'{own} as {name}' for own, name in names)}"))
    if card.box_classes:
        rows.append(("boxes", f"{', '.join(card.box_classes)}, score from {card.score_threshold:g}"))
    rows += [(key, str(card.training[key])) for key in ("data", "licence") if key in card.training]
    try:
        rows += _accuracy_rows(card.metrics)
    except (AttributeError, KeyError, TypeError, ValueError):  # a card may hold any JSON
        rows.append(("figures", "not as edgeperc eval --json writes them; --json prints them"))
    for precision, agreement in (item for variant in variants for item in variant.card.precisions.items()):
        loss, same = agreement.get("loss"), agreement.get("label_agreement")
        if precision != "fp32" and isinstance(same, float):
            lost = f", {loss:.2g} points lost" if isinstance(loss, float) else ""
            rows.append((precision, f"{100.0 * same:.2f} % of the labels as in fp32{lost}"))
    return rows


def _accuracy_rows(metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The main figures on each evaluated kind of scans: split, scans and drives, and of each class the objects."""
    rows, split = [], metrics.get("split")
    blocks = {"KITTI": "real", "SemanticKITTI": "semantickitti", "simulation": "simulated"}
    own = {data: metrics.get(block, {}) for data, block in blocks.items()}
    for data, figures in (*own.items(), *metrics.get("folders", {}).items()):
        points = figures.get("points", {}).get("all", {})
        parts = [_figure("IoU", name, row, "iou", "n_objects") for name, row in points.items() if row.get("n_objects")]
        boxes = figures.get("boxes", {}).get("oriented", {}).get("all", {})
        parts += [
            _figure("AP", name, row, "ap", "n_truth")
            for name, row in boxes.items()
            if isinstance(row, Mapping) and row.get("n_truth")
        ]
        road = figures.get("road", {}).get("all", {})
        parts += [f"road F1 {_percent(road['f1'])}"] if road.get("f1") is not None else []
        for name, measures in figures.get("kitti", {}).items():
            row = measures.get("bird's eye 0.5", {}).get("moderate", {})
            parts += [_figure("bird's eye AP at 0.5", name, row, "ap", "n_truth")] if row.get("n_truth") else []
        if parts:
            n, n_drives = figures.get("n_frames", "?"), figures.get("n_drives")
            of_drives = f" of {many(n_drives, 'drive')}" if n_drives and data != "simulation" else ""
            of_drives += f", {split} split" if split and data != "simulation" else ""
            rows.append((f"on {data}", f"{n} scans{of_drives}, %: {', '.join(parts)}"))
    images = metrics.get("images", {})
    if images.get("all", {}).get("mean_iou") is not None:
        n = max((row.get("n_images", 0) for row in images.get("classes", {}).values()), default=0)
        of_split = f" of the {split} split" if split else ""
        rows.append(("on images", f"{n}{of_split}, %: mean IoU {_percent(images['all']['mean_iou'])}"))
    return rows


def _figure(measure: str, name: str, row: Mapping[str, Any], key: str, count: str) -> str:
    return f"{measure} {name} {_percent(row.get(key))} (n={row[count]})"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100.0 * share:.1f}"


def _estimated(
    estimator: MountingEstimator, scans: Sequence[Floats32]
) -> tuple[MountingEstimator, MountingError | None]:
    """The estimator after these scans, and why one was left out: a `Perceiver` too skips those without ground."""
    reason = None
    for scan in scans:
        try:
            estimator = estimator.add(scan)
        except MountingError as exc:
            reason = exc
    return estimator, reason


def _image_rows(path: Path) -> tuple[list[tuple[str, str]], dict[str, Any]]:
    """Size and brightness of an image, and how the camera models scale it: rows to print, and the same for JSON."""
    from ..readers.images import read_image
    from ..zoo import listed

    image = read_image(path)
    height, width, _ = image.shape
    mean = [round(float(value), 1) for value in image.mean(axis=(0, 1))]
    rows = [
        ("image", str(path)),
        ("size", f"{width} x {height} pixels, upright as its EXIF orientation says"),
        ("mean", "red {:g}, green {:g}, blue {:g} of 255".format(*mean)),
    ]
    models = {}
    for card in {variant.name: variant.card for variant in listed()}.values():
        if card.view.kind == "camera":
            *_, high, wide = card.input_shape
            scales = round(card.view.width / width, 4), round(card.view.height / height, 4)
            models[card.name] = {"scale_x": scales[0], "scale_y": scales[1]}
            rows.append((card.name, "scales it to {} x {}: by {:g} across, {:g} down".format(wide, high, *scales)))
    return rows, {"image": str(path), "width": width, "height": height, "mean": mean, "models": models}


def _dropped_text(dropped: DroppedPoints, sensor: SensorProfile) -> str:
    parts = [f"{dropped.not_finite:,} are not finite"]
    if dropped.too_near:
        parts.append(f"{dropped.too_near:,} at most {sensor.min_range_m:g} m from the sensor, not returns")
    if sensor.ego_box is not None:
        parts.append(f"{dropped.ego:,} inside the box of the own vehicle")
    return ", ".join(parts)


def _scan_rows(
    path: Path, arguments: argparse.Namespace, sensors: Sensors, estimators: dict[SensorProfile, MountingEstimator]
) -> tuple[list[tuple[str, str]], dict[str, Any]]:
    """Measure a scan and check which models suit it: rows to print, and the same measurements for JSON."""
    from ..preprocess.findings import check_beams, check_dropped
    from ..preprocess.fitness import FitnessProfile
    from ..preprocess.returns import returns
    from ..types.frame import ModelFrame
    from ..types.sensor import get_sensor

    named, because = sensors.of(path)
    sensor = get_sensor(named)
    scans, damage = _first_scans(path, reading_options(path, arguments))
    cleaned, (dropped, *_) = zip(*(returns(scan, sensor) for scan in scans), strict=True)
    document: dict[str, Any] = {
        "scan": str(path),
        "n_points": len(scans[0]),
        "n_not_finite": dropped.not_finite,
        "n_too_near": dropped.too_near,
        "n_ego": dropped.ego,
        "sensor": sensor.name,
        "sensor_from": because,
    }
    rows = [
        ("scan", str(path)),
        ("points", f"{len(scans[0]):,}, of which {_dropped_text(dropped, sensor)}"),
        ("sensor", f"{sensor.name}: {because}"),
    ]
    if damage:
        rows.append(("damage", f"after {many(len(scans), 'scan')}: {damage}"))
    unit = check_dropped(scans[0], dropped, sensor)
    rows += [("unit", sentence) for sentence in unit]
    extent_rows, extents = _extent_rows(cleaned[0])
    document["refused"] = _is_refused(unit) or (len(scans[0]) > 0 and not extents)
    if not extents:
        return [*rows, *_refusal(document["refused"])], document
    used, reported, remission_rows = _matched_remission(cleaned, sensor)
    conditioned, estimator, mounting_rows, mounting = _mounting_rows(cleaned, sensor, used, estimators)
    frame = ModelFrame(estimator.mounting())
    scan = frame.move(conditioned[0])
    n_beams, _ = FitnessProfile.from_scans([scan]).beams
    beams = ("beams", f"about {n_beams:.0f} rows of points ({sensor.name}: {sensor.n_beams})")
    turned = check_beams(conditioned[0], used) if sensor.mounting.roll_deg is None else ()
    model_rows, findings = _suiting_models(scan, scans[0], used, frame, [*unit, *turned], reported)
    document["refused"] |= any(_is_refused(findings.get(name) or ()) for name in DEFAULT_MODELS)
    document |= {**extents, "mounting": mounting, "beams": round(float(n_beams)), "models": findings}
    refusal = _refusal(document["refused"])
    return [*rows, *extent_rows, *remission_rows, *mounting_rows, beams, *model_rows, *refusal], document


def _is_refused(sentences: Sequence[str]) -> bool:
    """Whether `edgeperc run` refuses a scan of which these are said."""
    return any(getattr(sentence, "gross", False) for sentence in sentences)


def _refusal(is_refused: bool) -> list[tuple[str, str]]:
    return [("refused", "edgeperc run refuses this scan; with --anyway it warns")] if is_refused else []


def _first_scans(path: Path, options: Mapping[str, Any]) -> tuple[list[Floats32], str]:
    """The scans that decide a mounting, and what damage comes after them."""
    from ..ground.leveling import FROZEN_AFTER
    from ..readers.captures import read_scans

    scans: list[Floats32] = []
    try:
        scans.extend(points for _, points in islice(read_scans(path, **options), FROZEN_AFTER))
    except PointsError as exc:
        if not scans:
            raise
        return scans, str(exc)
    return scans, ""


def _extent_rows(points: Points) -> tuple[list[tuple[str, str]], dict[str, list[float]]]:
    """Extent, range, elevation and remission of the finite points; empty without any."""
    import numpy as np

    finite = points[~np.isnan(points[:, 0])].astype(np.float64)
    if not len(finite):
        return [], {}
    flat = np.hypot(finite[:, 0], finite[:, 1])
    measured = {
        **{f"{axis}_m": np.percentile(finite[:, k], [0, 100]) for k, axis in enumerate("xyz")},
        "range_m": np.percentile(np.hypot(flat, finite[:, 2]), [0, 50, 100]),
        "elevation_deg": np.percentile(np.degrees(np.arctan2(finite[:, 2], flat)), [0.5, 99.5]),
        "remission": np.percentile(finite[:, 3], [0, 5, 50, 95, 100]),
    }
    extents = [f"{axis} {low:.1f} .. {high:.1f}" for axis in "xyz" for low, high in [measured[f"{axis}_m"]]]
    rows = [
        ("extent", f"{', '.join(extents)} m"),
        ("range", "{:.1f} .. {:.1f} m, median {:.1f} m".format(*measured["range_m"][[0, 2, 1]])),
        ("elevation", "{:.1f} .. {:.1f} deg (99 % of the points)".format(*measured["elevation_deg"])),
        ("remission", "min {:g}, 5 % {:g}, median {:g}, 95 % {:g}, max {:g}".format(*measured["remission"])),
    ]
    return rows, {name: [round(float(v), 4) for v in values] for name, values in measured.items()}


def _matched_remission(
    scans: Sequence[Floats32], sensor: SensorProfile
) -> tuple[SensorProfile, list[str], list[tuple[str, str]]]:
    """The profile with the remission function that the scans need, and what was reported on the way."""
    from ..preprocess.remission import RemissionMatcher

    matcher, used, reported = RemissionMatcher(sensor), sensor, list[str]()
    for scan in scans:
        matcher, used, sentences = matcher.add(scan)
        reported += sentences
    if used.remission is None:
        return used, reported, []
    how = "" if used is sensor else f", {used.remission.source}"
    return used, reported, [("", f"mapped to that of the {used.remission.to} by a {used.remission.kind}{how}")]


def _mounting_rows(
    scans: Sequence[Floats32],
    sensor: SensorProfile,
    used: SensorProfile,
    estimators: dict[SensorProfile, MountingEstimator],
) -> tuple[list[Floats32], MountingEstimator, list[tuple[str, str]], dict[str, Any] | None]:
    """Scaled scans and the mounting that they show; the sensor's estimator in ``estimators`` learns from them, too."""
    from ..ground.leveling import MountingEstimator
    from ..preprocess.condition import scale

    conditioned = [scale(scan, used)[0] for scan in scans]
    estimator, reason = _estimated(MountingEstimator(sensor.mounting), conditioned)
    estimators[sensor] = _estimated(estimators[sensor], conditioned)[0] if sensor in estimators else estimator
    try:
        estimate = estimator.estimate()
    except MountingError:
        return conditioned, estimator, [("mounting", f"cannot be estimated: {reason}")], None
    return conditioned, estimator, [("mounting", _mounting_text(estimator))], estimate.to_dict()


def _mounting_text(estimator: MountingEstimator) -> str:
    """The estimate, and what of it is not used."""
    found, used = estimator.estimate(), estimator.mounting()
    unsure = [name.removesuffix("_deg") for name in estimator.doubtful()]
    if unsure:
        return f"{found}; the ground is too uneven to be sure of {' and '.join(unsure)}: taken as level"
    if used == found.mounting:
        return str(found)
    taken = (
        f"height {used.height_m:.2f} m" * (found.height_sd_m > 0.0),  # else it was given
        f"roll {used.roll_deg:.1f} deg" * (found.roll_sd_deg > 0.0),
        f"pitch {used.pitch_deg:.1f} deg" * (found.pitch_sd_deg > 0.0),
    )
    return f"{found}; within what streets differ by: taken as the training vehicle's, {', '.join(filter(None, taken))}"


def _suiting_models(
    scan: Points,
    recorded: Points,
    sensor: SensorProfile,
    frame: ModelFrame,
    unit: Sequence[str],
    reported: Sequence[str],
) -> tuple[list[tuple[str, str]], dict[str, list[str] | None]]:
    """For each model of scans, what speaks against it; None without a description of its training scans."""
    from ..preprocess.findings import check_fitness, with_raw_remission
    from ..preprocess.fitness import FitnessProfile
    from ..zoo import listed

    said: dict[str, list[str]] = {}  # of which models
    findings: dict[str, list[str] | None] = {}
    for card in {variant.name: variant.card for variant in listed()}.values():
        if card.view.kind in ("camera", "objects"):  # objects are of any scan
            continue
        sentences, texts = None, ["its card does not describe its training scans"]
        if card.fitness is not None:
            profile = FitnessProfile.from_dict(card.fitness)
            fitness = check_fitness(scan, profile, sensor.upright(sensor.mounting), frame)
            sentences = [*unit, *with_raw_remission(fitness, recorded, sensor), *reported]
            texts = [f"as a scan of {sensor.name}: {sentence}" for sentence in sentences]
        findings[card.name] = sentences
        for text in texts or [f"for scans such as this one, taken as one of {sensor.name}"]:
            said.setdefault(text, []).append(card.name)
    rows = [("models", f"{', '.join(names)}: {text}") for text, names in said.items()]
    return rows, findings
