"""Scans: hostile arrays through a `Perceiver`, with made-up or real networks, and through all that uses the answer."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray

import edgeperc.perceiver as perceiver_module
from edgeperc import Box, Perceiver, Perception, SensorProfile, Tracker, Tracks, road_ahead
from edgeperc.errors import EdgepercError, FitnessError
from edgeperc.records import scan_record
from edgeperc.types.card import InputSpec, ModelCard, OutputSpec
from edgeperc.types.frame import ModelFrame
from edgeperc.types.geometry import draw_footprints
from edgeperc.types.mounting import MODEL_MOUNTING, Mounting
from edgeperc.types.points import as_points
from edgeperc.types.sensor import SENSORS
from edgeperc.types.views import RangeImageGeometry, TopViewGeometry
from edgeperc.view import draw, write_html, write_labels, write_ply
from edgeperc.zoo import resolve

from .arrays import hostile_scan, save
from .running import Case, check

LIMIT_S, LIMIT_MB = 10.0, 1500.0
BLOCK = 100  # cases with one perceiver
HONEST_EVERY, HONEST_CASES = 50, 10  # in every 50th block, ten cases have real networks, which are slow
AFTER = 0.3  # share of the cases whose road and tracks are computed
DRAWN, PAGES, FILES = 0.0005, 0.01, 0.02  # shares of the cases that are drawn, written as a page, written as files

VIEWS = {"top_view": ("distance", "remission", "height"), "range_image": ("x", "y", "z", "remission", "range")}
VEHICLES = {"car": (4.0, 1.8, 1.6), "van": (5.0, 2.0, 2.2)}


def card_of(view: TopViewGeometry | RangeImageGeometry, *outputs: OutputSpec, above: bool = False) -> ModelCard:
    """A card; ``above``: with the height above the ground and the curvature as input channels."""
    top = isinstance(view, TopViewGeometry)
    channels = (*VIEWS[view.kind], *(["height_above_ground", "curvature"] if above else []))
    return ModelCard(
        name=f"made-up-{view.kind}",
        version="1",
        view=view,
        input=InputSpec("x", channels, (0.0,) * len(channels), (10.0,) * len(channels)),
        outputs=outputs,
        classes=("background", "drivable", "car", "van") if top else ("background", "car", "pedestrian", "cyclist"),
        box_classes=("car", "van") if top else (),
        box_size_priors=VEHICLES if top else {},
        fitness=resolve("lodnn" if top else "pointseg")[0].card.fitness,
    )


DENSE = OutputSpec("d", "box_dense"), OutputSpec("c", "class_logits")
FRONT = OutputSpec("d", "box_dense", front=True), DENSE[1]
SLOTS = OutputSpec("c", "class_probabilities"), OutputSpec("s", "box_slots")
ELEVATIONS = tuple(2.0 - 1.7 * k for k in range(16))


def cards() -> list[tuple[ModelCard, ...]]:
    """Small views, which are quick, and those of the shipped models."""
    ahead = TopViewGeometry((6.0, 46.0), (-10.0, 10.0), (-2.5, 2.5), 0.4)
    dense, slots, plain = card_of(ahead, *DENSE), card_of(ahead, *SLOTS), card_of(ahead, DENSE[1])
    image = card_of(RangeImageGeometry(ELEVATIONS, 64), DENSE[1])
    turn = card_of(RangeImageGeometry(ELEVATIONS, 128, 180.0, -180.0), DENSE[1])
    narrow = card_of(RangeImageGeometry((1.0, -1.0), 3, 10.0, -10.0), SLOTS[0])
    front = card_of(ahead, *FRONT)
    above = card_of(image.view, DENSE[1], above=True)
    above_turn = card_of(turn.view, DENSE[1], above=True)
    shipped = [resolve(name)[0].card for name in ("ssadnet", "pointseg", "lodnn")]
    small = [
        (dense, image),
        (front, above),
        (front, above_turn),
        (slots, image),
        (plain, turn),
        (dense, turn),
        (image,),
        (slots,),
        (narrow,),
    ]
    return [*small * 3, (shipped[0], shipped[1]), (shipped[2],)]


class MadeUp:
    """In place of `edgeperc.inference.session.Session`: outputs as the case wants them, none of them from a network."""

    def __init__(self, card: ModelCard) -> None:
        self.card = card
        view, n = card.view, len(card.classes)
        self.input = np.zeros((len(card.input.channels), view.height, view.width), np.float32)
        shapes: dict[str, tuple[int, ...]] = {
            "camera_logits": (n, view.height // 4, view.width // 4),
            "box_dense": card.output_shape("box_dense")[1:], "box_slots": (20, 4),
            **dict.fromkeys(("class_logits", "class_probabilities"), (n, view.height, view.width)),
        }  # fmt: skip
        self.outputs = {o.kind: np.zeros(shapes[o.kind], np.float32) for o in card.outputs}
        self.description = f"{card.name} made-up"
        self.shares_cores = False  # one after the other: both draw from the case
        self.case: Case | None = None
        self.hostile = False

    def run(self) -> dict[str, NDArray[np.float32]]:
        if self.case is not None:
            for kind, values in self.outputs.items():
                self.fill(kind, values, self.case)
        return self.outputs

    def fill(self, kind: str, values: NDArray[np.float32], case: Case) -> None:
        rng = case.rng
        way = int(rng.integers(20)) if self.hostile else 0
        if way <= 11:  # sensible numbers, which reach the stages behind
            rng.standard_normal(out=values, dtype=np.float32)
            values *= np.float32(3.0)
            if kind == "box_dense":
                values[0] -= np.float32(rng.uniform(-5.0, 8.0))
                values[1:] *= np.float32(0.3)
            elif kind not in ("class_logits", "camera_logits"):
                np.clip(np.abs(values, out=values), 0.0, 1.2 if kind == "box_slots" else 1.0, out=values)
        elif way <= 13:
            values.fill(case.pick([0.0, 1.0, -1.0, 20.0, 1e9, 3.4e38, -3.4e38, 1e-45]))
        elif way <= 15:  # one class, or every box
            values.fill(-10.0)
            values[int(rng.integers(len(values)))] = 10.0
        elif way == 16:
            values.fill(0.0)
            values.ravel()[rng.integers(0, values.size, int(rng.integers(1, 20)))] = case.pick(
                [np.nan, np.inf, -np.inf]
            )
        elif way == 17:
            values.fill(case.pick([np.nan, np.inf, -np.inf]))
        elif way == 18:
            values.ravel()[:] = rng.choice(np.float32([0.0, 1e38, -1e38, 1e-38, 88.0, -88.0, 709.0, 1.0]), values.size)
        else:  # any bits
            values.ravel()[:] = np.frombuffer(rng.bytes(4 * values.size), np.float32)


def perceiver_of(*sessions: MadeUp, **options: Any) -> Perceiver:
    """A perceiver whose networks are made up."""
    with mock.patch.object(perceiver_module, "Session", side_effect=sessions):
        return Perceiver([each.card.name for each in sessions], **options)


def any_sensor(case: Case) -> SensorProfile | str:
    """A built-in profile, or one that is only just possible."""
    rng = case.rng
    if rng.random() < 0.6:
        return str(case.pick([*SENSORS]))
    ends = np.sort(rng.uniform(-89.0, 89.0, 2))[::-1]
    low = float(case.pick([0.0, -1e30, 1.0, 1e-300]))
    try:
        return SensorProfile.uniform(
            "any", int(rng.choice([1, 2, 16, 128, 4096])), float(ends[0]), float(ends[1]),
            columns=int(rng.choice([1, 2, 360, 2048, 100_000])),
            remission_range=(low, low + float(case.pick([1.0, 255.0, 1e-300, 1e300, 65535.0]))),
            min_range_m=float(case.pick([0.0, 1e-30, 0.9])),
            max_range_m=float(case.pick([1.0, 120.0, 1e30, 1e300])),
        )  # fmt: skip
    except EdgepercError:
        return "vlp-16"


def any_mounting(case: Case) -> Mounting:
    """A possible mounting, of which some values are to be estimated."""
    rng = case.rng
    limits = {"height_m": 20.0, "roll_deg": 90.0, "pitch_deg": 90.0, "yaw_deg": 360.0}
    values = {name: case.pick([None, 0.0, limit, -limit, rng.uniform(-limit, limit)]) for name, limit in limits.items()}
    return Mounting(**values, origin_m=case.pick([(0.0, 0.0), (1e5, -1e5), (1.5, 0.0)]))


class Scans:
    """The kind ``scans``."""

    name, limit_s, limit_mb = "scans", LIMIT_S, LIMIT_MB

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.cards = cards()
        self.made: tuple[int, bool] | None = None
        self.perceive: Any = None
        self.made_up: list[MadeUp] = []
        Perceiver(provider="cpu", n_threads=1)  # compiles the kernels, which no case should count
        Tracker()

    def perceiver(self, case: Case) -> tuple[Perceiver, list[MadeUp]]:
        block = case.index // BLOCK
        is_honest = block % HONEST_EVERY == 3 and case.index % BLOCK < HONEST_CASES
        if self.made == (block, is_honest):
            return self.perceive, self.made_up
        rng = np.random.default_rng([self.seed, 1, block])
        made = Case(case.kind, case.seed, case.index, case.folder, rng)
        # Half of the blocks look at the first scans only to warn, the others refuse what is unlike the training.
        options: dict[str, Any] = {
            "sensor": any_sensor(made),
            "on_mismatch": made.pick(["ignore", "ignore", "warn", "raise", "refuse"]),
            "adapt": made.pick(["both", "none", "remission", "interpolation"]),
            "score_threshold": made.pick([None, None, 0.0, 1.0, 0.5]),
            "full_turn": bool(rng.random() < 0.1),
            "mounting": made.pick([MODEL_MOUNTING, MODEL_MOUNTING, any_mounting(made), Mounting()]),
            "agree": bool(rng.random() < 0.9),
        }
        if is_honest:
            self.made_up = []
            self.perceive = Perceiver(provider="cpu", n_threads=1, **options)
        else:
            self.made_up = [MadeUp(card) for card in made.pick(self.cards)]
            views = {m.card.view.kind for m in self.made_up}
            options["boxes_from"] = made.pick(["both", "network", *(["clusters"] if "range_image" in views else [])])
            self.perceive = perceiver_of(*self.made_up, **options)
        self.made = block, is_honest
        return self.perceive, self.made_up

    def run(self, case: Case) -> str:
        scan = hostile_scan(case)
        case.evidence["scan.npy"] = lambda: save(case.folder / "evidence.npy", scan)
        perceive, made_up = self.perceiver(case)
        hostile = case.chance(0.2)
        for each in made_up:
            each.case, each.hostile = case, hostile
        # The first scans are checked and show the mounting. The state of a perceiver is not part of a case, so every
        # scan is checked, or none, and every scan is the first to show the mounting.
        if perceive.on_mismatch != "ignore":
            perceive.start_from(perceive.learned._replace(to_check=int(case.index % 3 == 0)))
        perceive.reset_mounting()
        # The padding of a longdouble is not copied reliably.
        is_plain = isinstance(scan, np.ndarray) and not isinstance(scan, np.ma.MaskedArray) and scan.dtype.char != "g"
        before = scan.tobytes() if is_plain and scan.nbytes < 1 << 20 else None
        try:
            return self.use(case, perceive, scan)
        finally:
            if before is not None and scan.tobytes() != before:
                check(False, "the scan was modified")

    def use(self, case: Case, perceive: Perceiver, scan: Any) -> str:
        stamp_s = case.pick([None, 0.0, -1.0, 1e9, 1e300, 12.5])
        points = as_points(scan)
        try:
            perception = perceive(scan, stamp_s)
        except FitnessError:
            perceive.start_from(perceive.learned._replace(to_check=0))
            perception = perceive(scan, stamp_s)
        check_perception(perception, points)
        if perceive.agree:
            check_agreement(perception)
        if perception.top_view is not None and case.chance(AFTER):
            road = road_ahead(perception.top_view, perception.boxes)
            check(np.isfinite(road.outline).all(), "a corner of the road is not finite")
            high = perception.top_view.x_range_m[1]  # a box may stand before the view
            check(((road.free_m >= 0.0) & (road.free_m <= high + 1e-6)).all(), "free distance out of the view")
        if case.chance(AFTER):
            tracker = Tracker()
            for k in range(2):
                tracks = tracker.update(perception.boxes, 0.1 * k)
                check_tracks(tracks)
            json.dumps(scan_record(perception, tracks), allow_nan=False)
        if case.chance(FILES) and perception.points is not None:
            write_labels(perception, case.folder / "scan.label")
            write_ply(perception, points, case.folder / "scan.ply")
            check((case.folder / "scan.label").stat().st_size == 4 * len(points), "size of the label file")
        if case.chance(PAGES):
            write_html(perception, points, case.folder / "scan.html", title="</script>\ud800")
        if case.chance(DRAWN):
            check(draw(perception, points)[:4] == b"\x89PNG", "not a picture")
        return (
            "answer" if any("made-up" in each for each in perception.providers.values()) else "answer of real networks"
        )


def check_perception(p: Perception, points: NDArray[np.float32]) -> None:
    """Raise `Failure` unless an answer is valid."""
    n = len(points)
    finite = np.isfinite(points[:, :3]).all(axis=1)
    check(p.n_points == n, f"n_points is {p.n_points} of {n}")
    check(n - np.count_nonzero(finite) <= p.n_dropped <= n, "n_dropped")
    if p.points is not None:
        labels, in_view = p.points.labels, p.points.in_view
        check(labels.shape == (n,) and labels.dtype == np.uint8 and in_view.shape == (n,), "shape of the labels")
        check(labels.max(initial=0) < len(p.points.classes), "a label out of range")
        check(not labels[~in_view].any(), "a label out of view")
        check(not in_view[~finite].any(), "a point that is not finite is in view")
    names = {"car", "pedestrian", "cyclist", "van", "truck"}
    if p.top_view is not None:
        view = p.top_view
        check(view.labels.shape == (view.geometry.height, view.geometry.width), "shape of the top view")
        check(view.labels.max(initial=0) < len(view.classes), "a cell's label out of range")
        if "drivable" in view.classes:
            road = view.labels == view.classes.index("drivable")
            check(not (view.drivable & ~road).any(), "a drivable cell without the label")
        check(view.observed.shape == view.labels.shape, "shape of observed")
        check(math.isfinite(view.drivable_area_m2), "area")
    for box in p.boxes:
        check_box(box)
        check(box.label in names, f"a box of class {box.label}")
    scores = [box.score for box in p.boxes]
    check(scores == sorted(scores, reverse=True), "boxes are not in the order of their scores")
    check(all(math.isfinite(ms) and ms >= 0.0 for ms in p.stage_ms.values()), "stage_ms")
    json.dumps(p.to_dict(), allow_nan=False)


def check_agreement(p: Perception) -> None:
    """Raise `Failure` if a cell below a box is drivable. A tilt changes footprints when boxes are moved."""
    tilts = p.mounting.roll_deg or 0.0, p.mounting.pitch_deg or 0.0
    if p.top_view is None or max(map(abs, tilts)) > 3.0:
        return
    names = tuple({box.label for box in p.boxes})
    boxes = [replace(b, size=(0.9 * b.size[0], 0.9 * b.size[1], b.size[2])) for b in p.boxes]  # moved, with rounding
    covered = np.full(p.top_view.labels.shape, 255, np.uint8)
    draw_footprints(covered, ModelFrame(p.mounting).move_boxes(boxes), p.top_view.geometry, names)
    check(not (p.top_view.road & (covered < 255)).any(), "a drivable cell below a box")


def check_box(box: Box) -> None:
    numbers = (*box.center, *box.size, box.yaw, box.score)
    check(all(math.isfinite(v) for v in numbers), f"a box is not finite: {box}")
    check(min(box.size) > 0.0, f"a box without extent: {box}")
    check(0.0 <= box.score <= 1.0, f"a score of {box.score}")
    check(abs(box.yaw) <= math.pi + 1e-6, f"a yaw of {box.yaw}")
    check(box.front is None or 0.0 <= box.front <= 1.0, f"a front of {box.front}")


def check_tracks(tracks: Tracks) -> None:
    """Raise `Failure` unless tracks are valid."""
    ids = tracks.ids.tolist()
    check(len({*ids}) == len(ids) and min(ids, default=1) >= 1, "ids of tracks")
    check(np.isfinite(tracks.boxes).all() and np.isfinite(tracks.T_world_sensor).all(), "a track's box is not finite")
    check(((tracks.scores >= 0.0) & (tracks.scores <= 1.0)).all(), "a track's score")
    for track in tracks[:50]:
        check_box(track.box)
        check_box(track.world_box)
        check(np.isfinite(track.state).all(), "a track's state is not finite")
        check(np.isfinite(track.covariance).all(), "a track's covariance is not finite")
        check((np.diag(track.covariance) >= 0.0).all(), "a negative variance")
        check(np.isfinite(track.velocity).all(), "a velocity is not finite")
        shares = [*track.modes.values()]
        check(all(0.0 <= s <= 1.0 + 1e-9 for s in shares) and abs(sum(shares) - 1.0) < 1e-6, f"modes {track.modes}")
        json.dumps(track.to_dict(), allow_nan=False)


def make(seed: int) -> Scans:
    return Scans(seed)
