"""The papers' figures: frames whose figures are known by hand, drives kept apart, and what users see of it."""

from __future__ import annotations

import hashlib
import io
import json
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import hypothesis
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import scenes
from checkout import files
from cli_helpers import Shell
from edgeperc import cli
from edgeperc.cli import output
from edgeperc.cli.evaluation import scans as eval_scans
from edgeperc.cli.output import print_line
from edgeperc.datasets import kitti
from edgeperc.datasets.layout import ScanLayout
from edgeperc.datasets.scan_folder import ScanFrame
from edgeperc.errors import ModelError, PointsError, SplitError
from edgeperc.evaluation import evaluate
from edgeperc.evaluation.causes import count_causes
from edgeperc.evaluation.judge import Judge, Perceiving, renamed, training_scans_of
from edgeperc.evaluation.metrics import BoxEvaluator, Confusion
from edgeperc.evaluation.tables import BANDS, FEWEST_OBJECTS, Record, banded, figures
from edgeperc.evaluation.truth import folder_truth
from edgeperc.simulation.samples import FIRST_SEED, IGNORE
from edgeperc.simulation.scene import POINT_CLASSES
from edgeperc.types.card import InputSpec, ModelCard, OutputSpec
from edgeperc.types.mounting import MODEL_MOUNTING
from edgeperc.types.perception import Box, Perception, PointLabels, TopView
from edgeperc.types.sensor import get_sensor
from edgeperc.types.views import RangeImageGeometry, TopViewGeometry
from edgeperc.zoo import DEFAULT, shipped_models
from edgeperc_export.recipe import MODELS

VIEW = TopViewGeometry()
POINTS = ("background", "car", "pedestrian", "cyclist")
CELLS = ("background", "drivable", "car", "van", "truck")
# The camera stands at the sensor and looks along x; a quarter turn of the scan is in its image.
T_CAM_VELO = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], np.float64)
CAMERA = kitti.KittiCalibration(T_CAM_VELO, np.array([[621.0, 0, 621.0, 0], [0, 621.0, 187.0, 0], [0, 0, 1, 0]]))


def card(name: str, **given: Any) -> ModelCard:
    top = name != "pointseg"
    return ModelCard(
        **{
            "name": name,
            "version": "1.0.0",
            "view": VIEW if top else RangeImageGeometry((2.0, 0.0, -10.0), width=8),
            "input": InputSpec("image", ("remission",), (0.0,), (1.0,)),
            "outputs": (OutputSpec("logits", "class_logits"), *((OutputSpec("boxes", "box_dense"),) if top else ())),
            "classes": CELLS if top else POINTS,
            "box_classes": ("car", "van", "truck") if top else (),
            **given,
        }
    )


box = partial(scenes.box, size=(4.0, 2.0, 1.6), z=-1.0)
someone = partial(scenes.box, size=(0.8, 0.6, 1.7), z=-1.0)


class World:
    """Scripted models: the nth point's label is its remission, and everything else is said beforehand."""

    def __init__(self) -> None:
        self.cards = {name: card(name) for name in ("pointseg", "ssadnet", "lodnn")}
        self.cells = dict.fromkeys(self.cards, np.zeros((400, 200), np.uint8))
        self.observed = np.ones((400, 200), bool)
        self.probability = np.zeros((400, 200))
        self.boxes: tuple[Box, ...] = ()

    def perceiver(self, models: list[str], **_: Any) -> Callable[[np.ndarray], Perception]:
        def perceive(points: np.ndarray) -> Perception:
            kinds = {self.cards[name].view.kind: name for name in models}
            labels = PointLabels(points[:, 3].astype(np.uint8), np.isfinite(points).all(axis=1), POINTS)
            cells = self.cells[kinds.get("top_view", "lodnn")]
            view = TopView(cells, CELLS, 0.1, VIEW.x_range_m, VIEW.y_range_m, self.observed)
            return Perception(
                n_points=len(points),
                n_dropped=0,
                points=labels if "range_image" in kinds else None,
                top_view=view if "top_view" in kinds else None,
                boxes=self.boxes,
                stage_ms={},
                providers={},
                fitness=(),
                stamp_s=None,
            )

        perceive.cards = tuple(self.cards[name] for name in models)  # type: ignore[attr-defined]
        perceive.providers = {name: f"{name} fp32" for name in models}  # type: ignore[attr-defined]
        perceive.sessions = tuple(SimpleNamespace(card=card) for card in perceive.cards)  # type: ignore[attr-defined]
        return perceive

    def network(self, session: Any) -> Any:
        return SimpleNamespace(
            card=session.card,
            probability=lambda name: self.probability,
            point_labels=lambda points: np.zeros(len(points), np.uint8),
        )


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    made = World()
    monkeypatch.setattr("edgeperc.evaluation.judge.Perceiver", made.perceiver)
    monkeypatch.setattr("edgeperc.evaluation.judge.Network", made.network)
    return made


def frame(*boxes: Box, points: list[list[float]] | None = None, drive: str = "a", unlabeled: Any = ()) -> kitti.Frame:
    scan = np.array(points or [[0.0, 0.0, 0.0, 0.0]], np.float32)
    return kitti.Frame("000000", drive, "A", scan, boxes, np.array(unlabeled, np.float64).reshape(-1, 4), CAMERA)


def hits(at: Box, n: int, label: int = 1) -> list[list[float]]:
    """n points in a box, which the scripted model labels so."""
    return [[at.center[0] + 0.1 * k, at.center[1], at.center[2], label] for k in range(n)]


def evaluated(judge: Judge, *frames: kitti.Frame, n_resamples: int = 50) -> dict[str, Any]:
    return figures([judge.record(judge.kitti(each))[0] for each in frames], n_resamples)


def tally(rows: dict[str, Any], *names: str) -> dict[str, list[int]]:
    """Boxes to find, boxes that were found, and hits, by class."""
    return {name: [rows[name][k] for k in ("n_truth", "n_predicted", "n_hits")] for name in names or rows}


def road_scan(*labels: int) -> tuple[kitti.RoadFrame, np.ndarray]:
    """A row of labeled points 20 m ahead, and the columns of their cells."""
    y = 5.05 - np.arange(len(labels))
    points = np.array([(20.05, at, -1.7, 0.0) for at in y], np.float32)
    return kitti.RoadFrame("00/000000", "b", points, np.array(labels, np.uint8)), np.floor((10.0 - y) / 0.1).astype(int)


def test_points_by_hand(world: World) -> None:
    near, far, rider, van = box(10, 0), box(40, 4), box(20, -3, "cyclist"), box(60, 0, "van")
    points = [
        *hits(near, 3),
        *hits(near, 1, label=0),
        *hits(rider, 2, label=3),
        *hits(rider, 2, label=1),
        *hits(far, 2),  # too few to be an object, and points all the same
        *hits(van, 3),
        [12.0, 5.0, -1.7, 1],  # ground, said to be a car
        [12.0, 6.0, -1.7, 0],
        [-12.0, 5.0, -1.7, 1],  # behind the camera
        [np.nan, 5.0, -1.7, 0],
    ]
    table = evaluated(Judge(["pointseg"]), frame(near, far, rider, van, points=points))["points"]
    assert set(table) == set(BANDS)
    car = table["all"]["car"]
    assert (car["n_points"], car["n_boxes"], car["n_objects"], car["n_drives"]) == (4 + 2 + 3, 2, 2, 1)
    assert car["few"] is True
    assert car["precision"] == pytest.approx(8 / 11, abs=1e-4)
    assert car["recall"] == pytest.approx(8 / 9, abs=1e-4)
    assert car["iou"] == pytest.approx(8 / 12, abs=1e-4)
    assert car["iou_interval"] is None  # one drive
    assert (table["0-15 m"]["car"]["n_points"], table["0-15 m"]["car"]["n_objects"]) == (4, 1)
    assert table["0-15 m"]["car"]["iou"] == pytest.approx(3 / 5)
    assert (table["30-46 m"]["car"]["n_points"], table["30-46 m"]["car"]["n_objects"]) == (2, 0)
    assert table["15-30 m"]["cyclist"]["recall"] == 0.5
    assert table["15-30 m"]["car"]["recall"] is None
    assert table["0-15 m"]["background"] == {
        "precision": 0.5,
        "recall": 0.5,
        "iou": pytest.approx(1 / 3, abs=1e-4),
        "iou_by_drive": pytest.approx(1 / 3, abs=1e-4),
        **dict.fromkeys(("precision_interval", "recall_interval", "iou_interval", "iou_by_drive_interval")),
        "n_points": 2,
    }
    assert table["all"]["pedestrian"]["iou"] is None


def test_boxes_by_hand(world: World) -> None:
    near, middle, far, hidden = box(10, 0), box(29, 0), box(40, 4, "van"), box(20, 5)
    beside, unseen = box(30, -13), box(9, -9.5)  # beside the view, and in it but out of the camera's sight
    points = [p for each in (near, middle, far, beside, unseen) for p in hits(each, 3)] + hits(hidden, 2)
    world.boxes = (
        box(10, 0, score=0.9),
        box(30.2, 0, score=0.8),  # 2.8 of 5.2 m: a hit, of a truth in the middle band
        box(40, 4, "car", score=0.7),  # a van, called a car
        box(20, 5, score=0.6),  # two returns: need not be found, and may be
        box(35, -5, score=0.5),  # nothing there
        box(9, -9.9, score=0.4),  # out of the camera's sight
    )
    table = evaluated(Judge(["ssadnet"]), frame(near, middle, far, hidden, beside, unseen, points=points))["boxes"]
    for kind in ("upright", "oriented"):
        every = table[kind]["all"]
        assert {key for key in every if not key.startswith("mean")} == {"car", "van", "vehicle"}
        assert tally(every, "vehicle", "car") == {"vehicle": [3, 4, 3], "car": [2, 4, 2]}
        assert every["vehicle"]["ap"] == 1.0
        assert every["vehicle"]["precision"] == 0.75
        assert every["vehicle"]["mean_iou_50"] == pytest.approx((1 + 2.8 / 5.2 + 1) / 3, abs=1e-4)
        assert every["vehicle"]["mean_iou_70"] == 1.0
        assert (every["van"]["ap"], every["van"]["precision"], every["van"]["ap_interval"]) == (0.0, None, None)
        assert every["mean_ap"] == 0.5
        counts = tally({band: rows["vehicle"] for band, rows in table[kind].items()})
        assert counts == {"all": [3, 4, 3], "0-15 m": [1, 1, 1], "15-30 m": [1, 1, 1], "30-46 m": [1, 2, 1]}


def test_labels_of_kitti_are_measured_by_levels_and_other_boxes_all_round(world: World) -> None:
    car = box(15, 0)
    world.boxes = (car, box(-15, 0))
    seen = frame(car, points=hits(car, 3))
    row = [0.0, 0.0, 0.0, 500.0, 150.0, 600.0, 250.0, 1.6, 2.0, 4.0, 0.0, 1.8, 15.0, -math.pi / 2]
    labeled = replace(seen, labels=kitti.KittiLabels(("car",), np.array([row])), drive="2011_09_28_drive_0001")
    all_round = evaluated(Judge(["ssadnet"]), seen)
    levels = evaluated(Judge(["ssadnet"]), labeled)
    assert set(all_round["kitti"]["car"]["3-D 0.7"]) == {"all round"}
    assert set(levels["kitti"]["car"]["3-D 0.7"]) == {"easy", "moderate", "hard"}
    for result in (all_round["kitti"]["car"]["3-D 0.7"]["all round"], levels["kitti"]["car"]["3-D 0.7"]["easy"]):
        assert (result["n_truth"], result["ap"], result["few"]) == (1, 1.0, True)
    assert levels["centers"]["car"]["ap"] == pytest.approx(1.0)


def test_boxes_of_clusters_by_hand(world: World) -> None:
    car, van, beside, far = box(10, 0), box(20, 4, "van"), box(30, -13), box(60, 0)
    person = someone(20, -5, "pedestrian")
    points = [p for each in (car, van, person, beside, far) for p in hits(each, 3)]
    frame_of_all = frame(car, van, person, beside, far, points=points)
    world.boxes = (box(10, 0, score=0.9), replace(person, score=0.8), box(30, -13, score=0.7), box(20, 4, score=0.6))
    # Boxes around clusters are named by their size: a van that is called a car is a false car and a missed van.
    table = evaluated(Judge(["pointseg"], Perceiving(boxes_from="clusters")), frame_of_all)["boxes"]["oriented"]["all"]
    counts = tally(table, "car", "van", "pedestrian", "vehicle")  # nobody on foot is a vehicle
    assert counts == {"car": [3, 3, 2], "van": [1, 0, 0], "pedestrian": [1, 1, 1], "vehicle": [4, 3, 3]}
    # Beside a top-view model, only what it can detect: vehicles in its view. The others count wherever they are known.
    result = evaluated(Judge(["pointseg", "ssadnet"]), frame_of_all)
    table = result["boxes"]["oriented"]["all"]
    assert tally(table, "car", "van", "vehicle") == {"car": [1, 2, 1], "van": [1, 0, 0], "vehicle": [2, 2, 2]}
    assert "pedestrian" not in table
    assert [result["all_round"]["all"][name]["n_hits"] for name in ("vehicle", "pedestrian")] == [3, 1]
    assert "boxes" not in evaluated(Judge(["pointseg"], Perceiving(boxes_from="network")), frame_of_all)


def test_boxes_all_round_by_hand(world: World) -> None:
    car, van, beside, hidden = box(10, 0), box(20, 4, "van"), box(30, -13), box(36, 0)
    person, rider = someone(20, -5, "pedestrian"), someone(20, -9, "cyclist")
    seated = replace(person, label="person_sitting", center=(24.0, -5.0, -1.0))
    every = (car, van, beside, person, rider, seated)
    one = frame(*every, hidden, points=[p for each in every for p in hits(each, 3)] + hits(hidden, 2))
    world.boxes = (
        replace(box(10, 0, score=0.9), yaw=math.pi),  # front for rear
        box(20, 4, "car", score=0.8),  # a van, called a car
        box(30, -13, score=0.7),  # beside the view of the network
        box(36, 0, score=0.7),  # two returns: may be found
        replace(person, score=0.6, center=(20.3, -5.0, -1.0), yaw=0.2),  # IoU 0.4
        replace(rider, score=0.5, label="pedestrian"),  # another class: wrong
        replace(seated, score=0.4, label="pedestrian"),  # may be found
        replace(person, score=0.3, center=(9.0, -20.0, -1.0)),  # out of the camera's sight
    )
    for models in (["ssadnet"], ["pointseg", "ssadnet"]):
        result = evaluated(Judge(models), one)
        rows = result["all_round"]["all"]
        assert tally(rows) == {
            "car": [2, 3, 2],
            "van": [1, 0, 0],
            "vehicle": [3, 3, 3],
            "pedestrian": [1, 2, 1],
            "cyclist": [1, 0, 0],
            "person": [2, 2, 2],
        }
        assert rows["vehicle"]["ap"] == rows["pedestrian"]["ap"] == 1.0
        assert (rows["cyclist"]["ap"], rows["cyclist"]["precision"], rows["cyclist"]["few"]) == (0.0, None, True)
        assert "mean_ap" not in rows
        heading = result["heading"]["all_round"]["all"]
        assert heading["vehicle"] == {
            **{"heading": pytest.approx(2 / 3, abs=1e-4), "heading_interval": None, "axis": 1.0, "axis_interval": None},
            **{"front_known": 0.0, "front_known_interval": None},
            **{"n_hits": 3, "n_objects": 2, "few": True},  # the cars have one size
        }
        assert heading["pedestrian"]["heading"] == 1.0
        assert heading["cyclist"]["heading"] is None
        assert result["heading"]["all_round"]["0-15 m"]["car"]["heading"] == 0.0
        # Labels are counted with those of other classes.
        assert result["labeled"]["car"] == {"n_boxes": 2, "n_objects": 1, "n_drives": 1, "few": True}
        assert set(result["labeled"]) == {"car", "van", "pedestrian", "cyclist", "person_sitting"}
    assert not {"all_round", "heading"} & {*evaluated(Judge(["pointseg"], Perceiving(boxes_from="network")), one)}


def test_the_ground_in_boxes_and_people_who_sit_are_left_out_of_a_second_figure(world: World) -> None:
    car = box(10, 0)
    person, seated = someone(20, -5, "pedestrian"), someone(20, 5, "person_sitting")
    lot = [[x, y, -1.73, 0.0] for x in np.arange(-20.0, 40.0, 0.5) for y in np.arange(-15.0, 15.0, 0.5)]
    below = [[10.0 + 0.1 * k, 0.0, -1.73, 1.0 if k < 4 else 0.0] for k in range(6)]
    given = hits(person, 3, 2) + hits(person, 1, label=0) + hits(seated, 1, 2) + hits(seated, 5, label=0)
    one = frame(replace(car, size=(4.0, 2.0, 2.0)), person, seated, points=[*lot, *below, *given, *hits(car, 3)])
    result = evaluated(Judge(["pointseg"]), one)
    row, sure = (result[kind]["all"]["pedestrian"] for kind in ("points", "sure"))
    assert (row["iou"], row["n_points"], row["n_objects"]) == (pytest.approx(1 / 3, abs=1e-4), 12, 2)
    assert (sure["iou"], sure["n_points"], sure["n_objects"]) == (0.75, 4, 1)
    row, sure = (result[kind]["all"]["car"] for kind in ("points", "sure"))
    assert row["recall"] < 0.5 < sure["recall"] == 1.0
    assert (row["n_points"] > 9, sure["n_points"]) == (True, 3)
    assert result["sure"]["15-30 m"]["pedestrian"]["recall"] == 0.75


def test_finer_classes_count_as_those_of_the_labels() -> None:
    """A network of one's own may tell vans and trucks from cars; KITTI's labels of points do not."""
    names = ("background", "van", "truck", "car", "digger", "person_sitting", "cyclist", "drivable", "building")
    labels = np.array([*range(len(names)), IGNORE], np.uint8)
    assert renamed(labels, names, POINT_CLASSES).tolist() == [0, 1, 1, 1, 0, 2, 3, 0, 0, IGNORE]
    assert renamed(labels, names, ("other", "road", "vehicle")).tolist() == [0, 2, 2, 2, 0, 0, 0, 1, 0, IGNORE]
    assert renamed(labels, names, ("background", "car", "van")).tolist() == [0, 2, 1, 1, 0, 0, 0, 0, 0, IGNORE]


def test_classes_that_a_set_does_not_label_are_no_mistakes(world: World) -> None:
    """Of cars alone, as one class with vans: people on foot and vans that are found there may well be right."""
    car, van = box(20, 0), box(30, 5, "van")
    person = someone(20, -5, "pedestrian")
    points = np.array([*hits(car, 3), *hits(van, 3), *hits(person, 4, 2), [12.0, 6.0, -1.7, 0]], np.float32)
    world.boxes = (car, van, person)
    world.cells["ssadnet"] = np.zeros((400, 200), np.uint8)
    world.cells["ssadnet"][240:280, 90:110], world.cells["ssadnet"][140:180, 40:60] = 2, 3
    layout = ScanLayout("cars", get_sensor("hdl-64e"), boxes={"car": "car"}, points={})
    labeled = ScanFrame("1", "a", layout, points, (car, replace(van, label="car")), None, None)
    judge = Judge(["pointseg", "ssadnet"])
    record, mistakes = judge.compare(folder_truth(labeled, MODEL_MOUNTING, VIEW), judge.perceive(points))
    assert mistakes.n_errors == 0
    result = figures([record])
    cells = result["segmentation"]["vehicles from 3-D boxes"]["all"]["iou"]
    assert cells == {"background": 1.0, "car": 1.0, "vehicle": 1.0}
    rows = result["points"]["all"]
    assert {name: row["iou"] for name, row in rows.items()} == {"background": 1.0, "car": 1.0}
    assert {error: rows["all"]["n_points"] for error, rows in result["errors"].items() if rows["all"]["n_points"]} == {}
    every = {**result["boxes"]["oriented"]["all"], **result["all_round"]["all"]}
    counts = {name: row["n_predicted"] for name, row in every.items() if isinstance(row, dict)}
    assert counts == {"car": 2, "vehicle": 2, "person": 0}


def test_boxes_at_unknown_places_do_not_count(world: World) -> None:
    seen, dont_care = box(10, 0), box(20, 0)
    points = [p for each in (seen, dont_care) for p in hits(each, 3)]
    world.boxes = (seen, dont_care)
    # The center of the second is at column 621, row 187 + 621 / 20 of the image.
    one = frame(seen, dont_care, points=points, unlabeled=[[600, 210, 640, 225]])
    found = evaluated(Judge(["ssadnet"]), one)
    for rows in (found["all_round"]["all"], found["boxes"]["oriented"]["all"]):
        assert tally(rows, "car") == {"car": [1, 1, 1]}


def test_few_objects_are_marked() -> None:
    boxes = [replace(box(10 + 5 * k, 0), size=(4.0 + 0.1 * k, 2.0, 1.6)) for k in range(FEWEST_OBJECTS)]
    for n in (0, 1, FEWEST_OBJECTS - 1, FEWEST_OBJECTS):
        evaluator = BoxEvaluator(together=("car",))
        evaluator.update(boxes[:n], boxes[:n], drive="a")
        evaluator.update(boxes[:n], boxes[:n], drive="a")
        rows = figures([Record("", "a", {("all_round", "vehicle"): evaluator})])
        assert rows["all_round"]["all"]["vehicle"].get("few", False) is (n < FEWEST_OBJECTS)
        assert rows["heading"]["all_round"]["all"]["vehicle"].get("few", False) is (n < FEWEST_OBJECTS)
        lines = [line for line in eval_scans.box_lines(rows) if line.startswith("  all")]  # car, before vehicle
        assert [f"car{output.FEW}" in line for line in lines] == [n < FEWEST_OBJECTS] * (2 if n else 0)
    assert f"n<{FEWEST_OBJECTS}" in output.FEW


def street() -> np.ndarray:
    """A floor 1.73 m below the sensor."""
    x, y = np.meshgrid(np.arange(-20.0, 40.0, 0.25), np.arange(-15.0, 15.0, 0.25))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, -1.73), np.zeros(x.size)], axis=1).astype(np.float32)


def counted(objects: list[tuple[list[float], int, int]], boxes: tuple[Box, ...] = ()) -> dict[str, Any]:
    """Causes of objects of (x, y, z), predicted class, true class on a street."""
    places = np.array([[*place, 0.0] for place, _, _ in objects], np.float32).reshape(-1, 4)
    points = np.concatenate([places, street()])
    labels, right = np.zeros((2, len(points)), np.uint8)
    labels[: len(objects)], right[: len(objects)] = [o[1] for o in objects], [o[2] for o in objects]
    tallies = count_causes(points, labels, right, right != IGNORE, np.ones(len(points), bool), boxes, "a")
    result = figures([Record("", "a", tallies)], 0)
    return {**{what: {c: row["n_points"] for c, row in rows.items()} for what, rows in result["errors"].items()}} | {
        "bumper": result["bumper"]["all"]["n_points"],
        "bumper_ground": result["bumper"]["on the ground"]["n_points"],
        "rows": result["errors"],
    }


def test_causes_of_missed_points_by_hand() -> None:
    car, far, truck = box(10, 0), box(35, 0), replace(box(34, 6, "truck"), size=(9.0, 2.6, 3.0))
    rider = replace(box(12, -6, "cyclist"), size=(1.8, 0.6, 1.7))
    objects = [([10.0, 0.1 * k, -1.0], 0, 1) for k in range(3)] + [([11.0, 0, -1.0], 1, 1)] * 2
    objects += [([35.0, 0.1 * k, -1.0], 0, 1) for k in range(4)]
    objects += [([33.0, 6.0, -1.0 + 0.1 * k], 2, 1) for k in range(5)] + [([28.0, 6.0, -1.0], 0, 1)]
    objects += [([12.0, -6.0, -1.0], 2, 3)] * 2 + [([12.0, -6.1, -1.0], 0, 3)]
    objects += [([10.0, 0.1 * k, -1.73], 0, 1) for k in range(2)]  # the road below the car
    found = counted(objects, (car, far, truck, rider))
    assert found["missed car"] == {
        **{"all": 3 + 4 + 5 + 1 + 2, "in vans and trucks": 5, "beyond 30 m": 4 + 5, "on the ground": 2}
    }
    assert found["missed cyclist"] == {"all": 3, "of other objects": 2, "beyond 30 m": 0}
    assert found["missed pedestrian"] == {"all": 0, "of other objects": 0, "beyond 30 m": 0}
    rows = found["rows"]
    of_all = rows["missed car"]["all"]
    assert (of_all["share"], of_all["n_of"]) == (pytest.approx(15 / 17, abs=1e-4), 17)
    assert rows["missed car"]["beyond 30 m"]["share"] == pytest.approx(9 / 15, abs=1e-4)
    # Both cars have one size, so they are one object; the truck is another.
    assert [rows["missed car"][c]["n_objects"] for c in ("all", "in vans and trucks", "beyond 30 m")] == [2, 1, 2]
    assert rows["missed pedestrian"]["all"]["share"] is None
    # What is called a pedestrian and is none, is false.
    assert found["false pedestrian"] == {
        **{"all": 7, "of other objects": 7, "within 0.4 m of an object": 0, "on poles": 0}
    }


def test_causes_of_false_points_by_hand() -> None:
    car = box(10, 0)
    wall = [([15.0 + 0.2 * k, 8.0, -1.0], 1, 0) for k in range(46)]  # 9 m
    hedge = [([15.0 + 0.2 * k, -8.0, -1.0], 1, 0) for k in range(36)]  # 7 m
    mast = [([25.0, 0.0, -1.5 + 0.2 * k], 1, 0) for k in range(25)]  # 4.8 m
    beside = [([12.3, 0.0, -1.0], 1, 0), ([12.5, 0.0, -1.0], 1, 0)]  # 0.3 and 0.5 m off
    found = counted([*wall, *hedge, *mast, *beside, ([20.0, 5.0, -1.73], 1, 0), ([22.0, 3.0, -1.0], 1, 2)], (car,))
    assert found["false car"] == {
        "all": 46 + 36 + 25 + 2 + 1 + 1,
        "of other objects": 1,
        "within 0.4 m of an object": 1,
        "on large structures": 46 + 25,
        "on the ground": 1,
    }
    person = [([20.0, 4.0, z], 2, 0) for z in (-1.0, -0.5, 0.0)]
    sign = [([20.0, -4.0, z], 2, 0) for z in (-1.0, -0.5, 0.0)]
    sign += [([20.2, -4.1, 0.6], 0, 0)]  # 0.22 m aside, 2.3 m high
    crown = [([24.0, -4.0, -1.0], 3, 0), ([24.4, -4.0, 2.0], 0, 0)]  # 0.4 m aside
    found = counted([*person, *sign, *crown])
    assert found["false pedestrian"]["all"] == 6
    assert found["false pedestrian"]["on poles"] == 3
    assert (found["false cyclist"]["all"], found["false cyclist"]["on poles"]) == (1, 0)


def test_points_at_the_bumper_by_hand() -> None:
    at = [3.0, 1.0, -1.65]
    wheel = [3.0, 1.0, -1.52]  # 0.21 m above the ground
    found = counted([(at, 1, 0), (at, 1, IGNORE), ([-3.0, 2.9, -1.65], 1, IGNORE), (wheel, 1, IGNORE)])
    assert (found["bumper"], found["bumper_ground"]) == (4, 3)
    beyond = [[4.6, 1.0, -1.6], [3.0, 3.1, -1.6], [3.0, -3.1, -1.6], [3.0, 1.0, -1.4]]
    assert counted([(place, 1, 0) for place in beyond])["bumper"] == 0
    assert counted([(at, 2, 0), (at, 0, 0), (at, 1, 1), (at, 1, 3)])["bumper"] == 0  # no car; an object


def test_bumper_has_an_interval_of_points(world: World) -> None:
    at = [3.0, 1.0, -1.6, 1.0]
    result = evaluated(Judge(["pointseg"]), frame(points=[at] * 4), frame(points=[[9.0, 0, 0, 0]], drive="b"))
    assert result["bumper"]["all"] == {"n_points": 4, "n_scans": 1, "n_drives": 1, "n_points_interval": [0, 8]}
    assert set(result["bumper"]) == {"all", "on the ground"}
    assert ["car", "at", "the", "own", "bumper", "all", "-", "-", "4", "0-8", "-", "1", "-", "1"] in [
        line.split() for line in eval_scans.error_lines(result)
    ]


@pytest.mark.parametrize("n", [0, 1, 2])
def test_causes_of_a_scan_without_ground(n: int) -> None:
    points = np.full((n, 4), np.nan, np.float32)
    nothing = np.zeros(n, np.uint8)
    tallies = count_causes(points, nothing, nothing, nothing > 0, nothing > 0, (), "a")
    result = figures([Record("", "a", tallies)], 0)
    assert result["bumper"]["all"]["n_points"] == result["bumper"]["on the ground"]["n_points"] == 0
    assert all(
        row["n_points"] == 0 and row["share"] is None for rows in result["errors"].values() for row in rows.values()
    )


POINT = st.tuples(
    *(st.sampled_from([v / 10 for v in range(-12, 13)]) for _ in range(2)), st.sampled_from([-1.0, 0.0, 1.0])
)


@settings(max_examples=40)
@given(st.lists(st.tuples(POINT, st.sampled_from([0, 2])), max_size=12))
def test_poles_are_columns(objects: list[Any]) -> None:
    objects = [([20.0 + x, y, z], label, 0) for (x, y, z), label in objects]
    expected = 0
    for (x, y, _), label, _ in objects:
        tops = [math.dist((x, y), top[:2]) for top, *_ in objects if top[2] + 1.73 > 2.0]
        expected += label == 2 and min(tops, default=1.0) <= 0.3 + 1e-4
        hypothesis.assume(all(abs(d - 0.3) > 1e-4 for d in tops))  # float32 of the scan
    assert counted(objects)["false pedestrian"]["on poles"] == expected


def test_cells_under_boxes(world: World) -> None:
    world.cells["ssadnet"] = np.ones((400, 200), np.uint8)  # drivable counts as background here
    world.cells["ssadnet"][240:280, 90:110] = 2  # x 18..22, y -1..1: the car to the cell
    world.cells["ssadnet"][100:110, 100:110] = 4
    result = evaluated(Judge(["ssadnet"]), frame(box(20, 0), box(40, 5, "van"), box(30, 5, "tram")))["segmentation"]
    assert set(result) == {"vehicles from 3-D boxes"}
    row = result["vehicles from 3-D boxes"]["all"]
    vehicles = {"car": 800, "van": 800, "truck": 0, "vehicle": 1600}
    assert row["n_cells_of"] == {"background": row["n_cells"] - 1600, **vehicles}
    assert 65_000 < row["n_cells"] < 80_000 - 800  # the camera does not see the nearest corners; trams are not counted
    assert row["iou"]["car"] == 1.0
    assert row["iou"]["van"] == row["iou"]["truck"] == 0.0
    assert row["iou"]["vehicle"] == pytest.approx(800 / (1600 + 100), abs=1e-4)
    assert row["accuracy"] == pytest.approx((row["n_cells"] - 900) / row["n_cells"], abs=1e-4)
    rest = row["n_cells"] - 1600 - 100
    assert row["iou"]["background"] == pytest.approx(rest / (rest + 100 + 800), abs=1e-4)
    assert row["mean_iou"] == pytest.approx((row["iou"]["background"] + 1.0) / 4, abs=1e-4)
    # Vans were never predicted: what has no precision takes no part in the weighted mean.
    weights = (row["n_cells"] - 1600, 800)
    assert row["mean_ap"] == pytest.approx((weights[0] * rest / (rest + 800) + weights[1]) / sum(weights), abs=1e-4)
    bands = result["vehicles from 3-D boxes"]
    assert [bands[b]["n_cells_of"]["car"] for b in BANDS] == [800, 0, 800, 0]
    assert sum(bands[b]["n_cells"] for b in list(BANDS)[1:]) < row["n_cells"]  # some corners lie beyond 46 m


def test_nothing_is_known_of_cells_nobody_labeled(world: World) -> None:
    judge = Judge(["ssadnet"])
    whole = judge.kitti(frame()).cells["vehicles from 3-D boxes"][1]
    half = judge.kitti(frame(unlabeled=[[0, 0, 621, 375]])).cells["vehicles from 3-D boxes"][1]
    assert (half[:, :99] == IGNORE).all()
    np.testing.assert_array_equal(half[:, 101:], whole[:, 101:])


def test_road_drawn_by_another_model(world: World) -> None:
    world.cells["lodnn"] = np.zeros((400, 200), np.uint8)
    world.cells["lodnn"][:, 50:150] = 1
    world.cells["ssadnet"] = world.cells["lodnn"].copy()
    world.cells["ssadnet"][240:280, 90:110] = 2
    result = evaluated(Judge(["ssadnet"], road_by="lodnn"), frame(box(20, 0)))["segmentation"]
    assert list(result) == ["vehicles from 3-D boxes", "road drawn by lodnn 1.0.0"]
    row = result["road drawn by lodnn 1.0.0"]["all"]
    assert set(row["iou"]) == {*CELLS, "vehicle"}
    assert row["accuracy"] == row["iou"]["drivable"] == row["iou"]["car"] == row["mean_iou"] == 1.0
    assert row["iou"]["van"] is None
    with pytest.raises(ModelError, match="cannot draw its own truth"):
        Judge(["ssadnet"], road_by="ssadnet")
    with pytest.raises(ModelError, match="pointseg does not draw the road"):
        Judge(["ssadnet"], road_by="pointseg")


def test_road_by_hand(world: World) -> None:
    # A row of cells 20 m ahead: four of road, a car, three of something else, and one that nobody labeled.
    scan, cols = road_scan(1, 1, 1, 1, 2, 0, 0, 0, IGNORE)
    said = np.zeros((400, 200), np.uint8)
    said[259, cols[[0, 1, 5, 8]]] = 1
    said[259, cols[[4, 6]]] = 3
    world.cells["ssadnet"] = said
    world.observed[259, cols[[1, 3]]] = False
    world.probability = np.full((400, 200), 0.9)
    world.probability[259, cols[:8]] = [1.0, 0.8, 0.4, 0.3, 0.0, 0.6, 0.0, 0.0]
    judge = Judge(["ssadnet"])
    record, mistakes = judge.record(judge.semantickitti(scan))
    assert mistakes is None
    result = figures([record])
    assert result["n_frames"] == result["n_drives"] == 1
    road = result["road"]["all"]
    assert road == result["road"]["15-30 m"]
    assert result["road"]["0-15 m"]["iou"] is None
    assert (road["n_cells"], road["n_road"]) == (8, 4)
    assert [road[k] for k in ("precision", "recall", "iou", "f1")] == pytest.approx(
        [2 / 3, 2 / 4, 2 / 5, 4 / 7], abs=1e-4
    )
    assert road["accuracy"] == pytest.approx(5 / 8)
    assert (road["drivable_precision"], road["drivable_recall"]) == (1 / 2, 1 / 4)  # the second cell is not observed
    assert road["confusion"] == [[3 / 8, 1 / 8], [2 / 8, 2 / 8]]  # shares of all, rows the truth
    # By falling probability: road, road, other, road, road. With all four taken: 4 of 5 right.
    assert road["max_f1"] == pytest.approx(8 / 9, abs=1e-4)
    assert road["ap"] == pytest.approx((6 * 1.0 + 5 * 4 / 5) / 11, abs=1e-4)
    cells = result["segmentation"]["observed cells"]["all"]
    assert cells["iou"] == {"other": pytest.approx(1 / 5), "road": 0.4, "vehicle": 0.5}
    assert cells["n_cells_of"] == {"other": 3, "road": 4, "vehicle": 1}


def test_a_model_without_vehicles_is_evaluated_on_road_only(world: World) -> None:
    scan, cols = road_scan(1, 1, 2, 0, IGNORE)
    world.cards["lodnn"] = card("lodnn", classes=CELLS[:2], box_classes=(), outputs=card("pointseg").outputs)
    world.cells["lodnn"][259, cols[[0, 2]]] = 1
    judge = Judge(["lodnn"])
    record, _ = judge.record(judge.semantickitti(scan))
    result = figures([record])
    cells = result["segmentation"]["observed cells"]["all"]
    assert cells["iou"] == {"other": pytest.approx(1 / 3, abs=1e-4), "road": pytest.approx(1 / 3, abs=1e-4)}
    assert result["road"]["all"]["confusion"] == [[0.25, 0.25], [0.25, 0.25]]
    record, mistakes = judge.record(judge.kitti(frame(box(10, 0), points=hits(box(10, 0), 10))))
    assert record.tallies == {}  # boxes say nothing of the road
    assert mistakes is not None
    record, _ = judge.record(judge.simulated(FIRST_SEED))
    assert [*figures([record])["segmentation"]["every cell"]["all"]["iou"]] == ["background", "drivable"]


def test_intervals_are_over_drives(world: World) -> None:
    right = frame(box(10, 0), box(20, 3, "cyclist"), points=hits(box(10, 0), 10) + hits(box(20, 3), 3, 3), drive="b")
    half = frame(box(10, 0), points=hits(box(10, 0), 5) + hits(box(10, 0), 5, label=0))
    result = evaluated(Judge(["pointseg"]), half, half, right, n_resamples=1000)
    assert (result["n_frames"], result["n_drives"]) == (3, 2)
    car, cyclist = result["points"]["all"]["car"], result["points"]["all"]["cyclist"]
    assert car["iou"] == pytest.approx(20 / 30, abs=1e-4)
    # A quarter of the draws takes the one drive twice, a quarter the other.
    assert car["iou_interval"] == [0.5, 1.0]
    assert cyclist["iou"] == 1.0
    assert cyclist["iou_interval"] is None  # in one drive only
    # With equal weights the first drive has 5 of 10 points, the second 10 of 10.
    assert car["iou_by_drive"] == 0.75
    assert car["iou_by_drive_interval"] == [0.5, 1.0]
    assert "iou_by_drive" not in result["pixels"]["all"]["car"]
    one, other = (evaluated(Judge(["pointseg"]), half, right, n_resamples=1000) for _ in range(2))
    assert one == other


def test_a_mean_over_classes_needs_them_all_in_two_drives(world: World) -> None:
    world.cells["ssadnet"][240:280, 90:110] = 2
    judge = Judge(["ssadnet"])
    car, other = frame(box(20, 0)), frame(box(20, 0), drive="b")
    row = evaluated(judge, car, other)["segmentation"]["vehicles from 3-D boxes"]["all"]
    assert row["mean_iou_interval"] == [1.0, 1.0]
    van = frame(box(20, 0), box(30, 3, "van"), drive="b")
    row = evaluated(judge, car, van)["segmentation"]["vehicles from 3-D boxes"]["all"]
    assert row["mean_iou_interval"] is None
    assert row["iou_interval"]["van"] is None
    assert row["iou_interval"]["car"] == [1.0, 1.0]
    assert row["iou_interval"]["vehicle"] == [0.5, 1.0]


def test_a_drive_may_lack_the_labels_of_a_table() -> None:
    counts = banded(("segmentation", "t"), POINTS, *np.array([[0, 1, 1], [0, 1, 0]], np.uint8), np.array([1.0] * 3))
    row = figures([Record("", drive, tallies) for drive, tallies in zip("abc", (counts, {}, counts), strict=True)])
    of_all = row["segmentation"]["t"]["all"]
    assert (of_all["n_cells"], of_all["iou"]["car"], of_all["iou_interval"]["car"]) == (6, 0.5, [0.5, 0.5])


LABELS = st.lists(st.tuples(st.integers(0, 3), st.sampled_from([0, 1, 2, 3, 255]), st.floats(0, 60)), max_size=12)
BOXES = st.lists(st.tuples(st.integers(6, 45), st.integers(-9, 9), st.sampled_from(["car", "van"])), max_size=3)


@settings(max_examples=25)
@given(st.lists(st.tuples(LABELS, BOXES, BOXES, st.sampled_from("ab")), min_size=1, max_size=5))
def test_records_put_together_say_what_one_pass_says(scans: list[Any]) -> None:
    records, together = [], Confusion(POINTS)
    evaluator = BoxEvaluator()
    for k, (labels, predicted, truth, drive) in enumerate(scans):
        said, right, range_m = np.array(labels, np.float64).reshape(-1, 3).T
        tallies: dict[tuple[str, ...], Any] = banded(
            ("segmentation", "t"), POINTS, said.astype(np.uint8), right.astype(np.uint8), range_m
        )
        own = BoxEvaluator()
        guesses = [box(x, y, label, score=0.9 - 0.1 * k - 0.01 * i) for i, (x, y, label) in enumerate(predicted)]
        rights = [box(*each) for each in truth]
        own.update(guesses, rights)
        evaluator.update(guesses, rights)
        together.update(said, right)
        records.append(Record(str(k), drive, tallies | {("boxes", "oriented"): own}))
    result = figures(records, n_resamples=5)
    one = figures([Record("", "", {("segmentation", "t", "all"): together, ("boxes", "oriented"): evaluator})])

    def without_intervals(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: without_intervals(inner) for key, inner in value.items() if not key.endswith("_interval")}
        return value

    assert without_intervals(result["boxes"]) == without_intervals(one["boxes"])
    assert without_intervals(result["segmentation"]["t"]["all"]) == without_intervals(one["segmentation"]["t"]["all"])


def kitti_set(root: Path, drives: dict[str, str] | None = None) -> Path:
    """A KITTI object set with a point and a car a scan."""
    for part in ("velodyne", "label_2", "calib"):
        (root / "training" / part).mkdir(parents=True)
    for k, name in enumerate(drives or {"000000": "", "000001": ""}):
        np.array([[10.0 + k, 0, -1, 1]] * 3, np.float32).tofile(root / "training/velodyne" / f"{name}.bin")
        (root / "training/label_2" / f"{name}.txt").write_text("Car 0 0 0 0 0 9 9 1.6 2.0 4.0 0 1.8 10 -1.5708\n")
        (root / "training/calib" / f"{name}.txt").write_text(
            "P2: 621 0 621 0 0 621 187 0 0 0 1 0\n"
            "R0_rect: 1 0 0 0 1 0 0 0 1\n"
            "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
        )
    if drives:
        rows = "".join(f"{name},{drive}\n" for name, drive in drives.items())
        (root / "frames.csv").write_text("name,drive\n" + rows)
    return root


def test_scans_of_a_split(world: World, tmp_path: Path) -> None:
    root = kitti_set(
        tmp_path,
        {
            "000000": "2011_09_26_drive_0011",
            "000001": "2011_09_26_drive_0005",
            "000002": "2011_09_26_drive_0059",
            "000003": "2011_09_26_drive_0001",
        },
    )
    for asked, n_frames in (
        ({}, 1),
        ({"split": "test"}, 1),
        ({"fold": 0}, 1),
        ({"fold": 2}, 1),
        ({"fold": 0, "split": "train"}, 1),
        ({"split": "train"}, 2),
        ({"split": "all"}, 4),
        ({"split": "validation"}, 1),
        ({"split": "held-back"}, 2),
    ):
        done: list[int] = []
        result, worst = evaluate.evaluate(
            [root], ["pointseg"], **asked, on_scan=lambda *counts, to=done: to.extend(counts)
        )
        assert result["real"]["n_frames"] == len(worst) == n_frames
        assert result["split"] == asked.get("split", "validation" if "fold" in asked else "test")
        assert done == [count for k in range(n_frames) for count in (k + 1, n_frames)]
    with pytest.raises(PointsError, match=r"no scans of the validation drives \(fold: 1\)"):
        evaluate.evaluate([root], ["pointseg"], fold=1)


def test_scans_of_drives_listed_nowhere_are_evaluated(world: World, tmp_path: Path) -> None:
    root = kitti_set(tmp_path)
    with pytest.warns(UserWarning, match=r"no frames\.csv, so each scan counts as a drive"):
        result, _ = evaluate.evaluate([root], ["pointseg"])
    assert result["real"]["n_drives"] == 2
    (root / "frames.csv").write_text("name,drive\n000000,mine\n")
    with pytest.warns(UserWarning, match=r"1 labeled scans without a row in frames\*\.csv, which are left out"):
        assert evaluate.evaluate([root], ["pointseg"])[0]["real"]["n_frames"] == 1
    (root / "frames.csv").unlink()
    (root / "training/calib/000001.txt").unlink()
    with (
        pytest.warns(UserWarning, match="no frames"),
        pytest.raises(PointsError, match=r"of 2 labeled scans 1 lack a file, such as .*calib.000001\.txt"),
    ):
        evaluate.evaluate([root], ["pointseg"])


@pytest.mark.parametrize("guilty", ["pointseg", "lodnn"])
def test_training_scans_are_refused_unless_asked_for(world: World, tmp_path: Path, guilty: str) -> None:
    root = kitti_set(tmp_path, {"000000": "2011_09_26_drive_0011", "000001": "2011_09_26_drive_0005"})
    seen = hashlib.sha256(kitti.KittiObjects(root).frame("000001").points.tobytes()).hexdigest()[:16]
    models = ["pointseg", "ssadnet"]
    # Whatever the scan was called when it was trained on.
    world.cards[guilty] = card(guilty, training={"frames": {"renamed": seen}})
    result, _ = evaluate.evaluate([root], models, road_by="lodnn")
    assert result["real"]["n_frames"] == 1
    for asked in ({"split": "all"}, {"fold": 0}):
        with pytest.raises(SplitError, match=rf"{guilty} 1\.0\.0 was trained on scan 000001 of drive .*_0005.*'train'"):
            evaluate.evaluate([root], models, road_by="lodnn", **asked)
    assert evaluate.evaluate([root], models, road_by="lodnn", split="train")[0]["real"]["n_frames"] == 1
    world.cards[guilty] = card(guilty)
    assert evaluate.evaluate([root], models, road_by="lodnn", split="all")[0]["real"]["n_frames"] == 2


def test_scans_count_once(world: World, tmp_path: Path) -> None:
    root = kitti_set(tmp_path / "set")
    for datasets in ((root, tmp_path / "set" / ".." / "set"), ("simulation:1", "simulation:2"), (root, str(root))):
        with pytest.raises(PointsError, match="have the same scans, which would count twice"):
            evaluate.evaluate(datasets, ["pointseg"])


@pytest.mark.parametrize("dataset", ["nowhere", "simulation:0", "simulation:-1", "simulation:many"])
def test_what_is_no_dataset(world: World, dataset: str) -> None:
    with pytest.raises(PointsError, match="expected"):
        evaluate.evaluate([dataset], ["pointseg"])


def test_mistakes_are_named(world: World) -> None:
    car, van, rider, walker = box(10, 0), box(20, 3, "van"), box(15, -3, "cyclist"), box(12, 3, "pedestrian")
    beside, beyond = box(20, 14), box(50, 0)
    points = hits(car, 4) + hits(van, 5, 0) + hits(rider, 6, 0) + hits(walker, 4, 2)
    points += hits(beside, 7, 0) + hits(beyond, 7, 0) + [[8.0, -3.0, -1.7, 2]]
    world.boxes = (box(10, 0), box(35, 0, "truck"))
    judge = Judge(["pointseg", "ssadnet"])
    _, mistakes = judge.record(judge.kitti(frame(car, van, rider, walker, beside, beyond, points=points)))
    assert set(mistakes.found) == {car, walker}
    assert dict(mistakes.missed) == {van: 5, rider: 6, beside: 7}  # no box was to be predicted beside the view
    assert mistakes.false == (box(35, 0, "truck"),)
    assert mistakes.summary == "missed: 1 van, 1 cyclist, 1 car (18 points); false: 1 truck; 26 points wrong"
    assert np.bincount(mistakes.wrong).tolist() == [8, 25, 1]
    assert mistakes.wrong_share == pytest.approx(26 / 34)
    assert mistakes.n_errors == pytest.approx(4 + 26 / 34)


def test_what_a_box_beside_the_view_finds_is_no_mistake(world: World) -> None:
    beside = box(20, 14)
    world.boxes = (beside,)
    judge = Judge(["pointseg", "ssadnet"])
    _, mistakes = judge.record(judge.kitti(frame(beside, points=hits(beside, 7, 0))))
    assert (mistakes.found, mistakes.missed, mistakes.false) == ((beside,), (), ())


def test_the_worst_come_first(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = [f"{k:06d}" for k in range(30)]
    root = kitti_set(tmp_path, dict.fromkeys(names, "2011_09_26_drive_0011"))
    wrong = {"000007": 2, "000023": 3}
    read = kitti.KittiObjects.frame

    def spoilt(objects: kitti.KittiObjects, name: str) -> kitti.Frame:
        one = read(objects, name)
        extra = tuple(box(15.0 + 5 * k, 0) for k in range(wrong.get(name, 0)))
        return replace(one, boxes=extra, points=np.array([p for b in extra for p in hits(b, 3, 0)] or one.points))

    monkeypatch.setattr(kitti.KittiObjects, "frame", spoilt)
    _, worst = evaluate.evaluate([root], ["pointseg"])
    assert [each.name for each in worst[:2]] == ["000023", "000007"]
    assert len(worst) == 20


def test_a_network_agrees_with_the_perceiver() -> None:
    judge = Judge(
        ["ssadnet", "pointseg"], Perceiving(rules=())
    )  # the agreement removes cells that the network calls drivable
    truth = judge.simulated(FIRST_SEED)
    found = judge.perceive(truth.points)
    drivable = judge.from_above.probability("drivable")
    assert drivable.min() >= 0.0
    assert drivable.max() <= 1.0
    assert (found.require_top_view().labels[drivable > 0.5] > 0).all()  # drivable, or under a box
    assert (drivable[found.require_top_view().drivable] > 1 / 5 - 1e-6).all()
    pixels = judge.from_sensor.point_labels(truth.points)
    assert (pixels[~found.require_points().in_view] == 0).all()
    assert np.mean(pixels == found.require_points().labels) > 0.97


def test_the_command_on_simulated_scans(tmp_path: Path, shell: Shell) -> None:
    pytest.importorskip("matplotlib")
    out, picture = tmp_path / "deeper" / "figures.json", tmp_path / "worst.png"
    printed = shell.both("eval", "simulation:2", "--json", out, "--worst", picture)
    assert printed.err == ""
    for words in (
        "== simulated scans: 2 scans, 2 drives ==",
        "boxes where they can be detected, oriented",
        "top view, every cell",
        "MaxF",
    ):
        assert words in printed.out
    result = json.loads(out.read_text())
    assert result["command"].startswith("edgeperc eval simulation:2 --json ")
    assert set(result["models"]) == {*DEFAULT}
    assert (result["split"], result["fold"]) == ("test", None)
    simulated = result["simulated"]
    of_points, of_boxes = {"points", "sure", "pixels", "errors", "bumper"}, {"boxes", "all_round", "kitti", "centers"}
    others = {"labeled", "heading", "segmentation", "road", "n_frames", "n_drives"}
    assert set(simulated) == of_points | of_boxes | others
    assert simulated["all_round"]["all"]["car"]["n_truth"] >= simulated["boxes"]["oriented"]["all"]["car"]["n_truth"]
    assert simulated["segmentation"]["every cell"]["all"]["n_cells"] == 160_000
    assert 0.5 < simulated["points"]["all"]["car"]["iou"] <= 1.0
    assert 0.5 < simulated["road"]["all"]["f1"] <= simulated["road"]["all"]["max_f1"] + 0.05
    low, high = simulated["road"]["all"]["f1_interval"]
    assert low <= simulated["road"]["all"]["f1"] <= high
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert f"{100 * simulated['road']['all']['ap']:.1f}" in printed.out


def test_figures_are_written_though_nobody_reads_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """``edgeperc eval --json figures.json | head -1`` closes stdout after hours of work."""
    pytest.importorskip("matplotlib")
    figures = {"models": {}, "providers": {}, "split": "test", "fold": None}
    monkeypatch.setattr("edgeperc.evaluation.evaluate.evaluate", lambda *_, **__: (figures, []))
    monkeypatch.setattr(output, "print_line", Mock(side_effect=OSError("nobody reads")))
    out, picture = tmp_path / "figures.json", tmp_path / "worst.png"
    with pytest.raises(OSError, match="nobody reads"):
        cli.main(["eval", "simulation:1", "--json", str(out), "--worst", str(picture)])
    assert json.loads(out.read_text())["split"] == "test"
    assert picture.exists()


def test_where_figures_cannot_be_written_is_said_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shell: Shell
) -> None:
    monkeypatch.setattr("edgeperc.evaluation.evaluate.evaluate", Mock(side_effect=AssertionError("hours of work")))
    said = shell.err("eval", "simulation:1", "--json", tmp_path)
    assert f"{tmp_path} is a folder; expected the name of a file" in said
    (scan := tmp_path / "scan.bin").touch()
    for options in (("--json", scan), ("--json", tmp_path / "a", "--worst", tmp_path / "a")):
        assert "would be overwritten" in shell.err("eval", "simulation:1", *options)
    monkeypatch.setattr("os.access", lambda *_: False)
    assert "its folder is read-only" in shell.err("eval-painting", "--json", tmp_path / "a.json")


def test_figures_of_few_objects_are_gray_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)
    for stream, gray, expected in (
        (scenes.Terminal(), True, "\x1b[90mcar \\u001b[0m\x1b[0m\n"),  # what the text holds itself is shown, not obeyed
        (scenes.Terminal(), False, "car \\u001b[0m\n"),
        (io.StringIO(), True, "car \\u001b[0m\n"),
    ):
        print_line("car \x1b[0m", stream, gray=gray)
        assert stream.getvalue() == expected
    monkeypatch.setenv("NO_COLOR", "1")
    plain = scenes.Terminal()
    print_line("car", plain, gray=True)
    assert plain.getvalue() == "car\n"


def test_the_command_on_nothing(tmp_path: Path, shell: Shell) -> None:
    assert "expected the root of a KITTI object set" in shell.err("eval", tmp_path)
    assert shell.err("eval", "simulation:1", "--fold", "3")


def test_no_shipped_model_was_trained_on_a_test_scan(kitti_root: Path, semantickitti_root: Path) -> None:
    objects, sequences = kitti.KittiObjects(kitti_root), kitti.SemanticKitti(semantickitti_root)
    held_back = [*objects.names("test", grades="AB"), *objects.names("validation", grades="AB")]
    scans = [kitti_root / f"training/velodyne/{name}.bin" for name in held_back]
    scans += [semantickitti_root / f"sequences/00/velodyne/{name[3:]}.bin" for name in sequences.names("test")]
    assert len(scans) > 35 + 100
    hashes = {kitti.scan_hash(np.fromfile(scan, np.float32)) for scan in scans}
    assert kitti.scan_hash(objects.frame(held_back[0]).points) in hashes
    models = files(".onnx", "models")
    assert len(models) >= len(shipped_models())
    for path in models:
        card = ModelCard.read(path)
        (trained_on,) = training_scans_of([card]).values()
        only_simulated = card.training["recipe"]["simulated_share"] == 1.0
        is_open = MODELS[path.stem.removesuffix("-int8")].is_open
        least = 27 if is_open else 100
        assert len(trained_on) > least or only_simulated, f"{path} does not say what it was trained on"
        assert path.stem.endswith("-sim") == only_simulated == (not trained_on)
        assert not hashes & trained_on


def test_shipped_models_refuse_their_training_scans(kitti_root: Path) -> None:
    with pytest.raises(SplitError, match="was trained on scan 000000 of drive 2011_09_26_drive_0005"):
        evaluate.evaluate([kitti_root], split="all")


def test_real_scans(kitti_root: Path, semantickitti_root: Path) -> None:
    judge = Judge(["ssadnet", "pointseg"])
    objects, sequences = kitti.KittiObjects(kitti_root), kitti.SemanticKitti(semantickitti_root)
    result = figures([judge.record(judge.kitti(objects.frame(name)))[0] for name in objects.names("test")[::7]], 100)
    assert result["points"]["all"]["car"]["iou"] > 0.5
    low, high = result["points"]["all"]["car"]["iou_interval"]
    assert low <= result["points"]["all"]["car"]["iou"] <= high
    assert result["boxes"]["oriented"]["all"]["vehicle"]["ap"] > 0.5
    assert result["points"]["all"]["car"]["n_points"] > 1000
    cells = result["segmentation"]["vehicles from 3-D boxes"]["all"]
    assert cells["accuracy"] > 0.9
    assert 70_000 < cells["n_cells"] / result["n_frames"] < 80_000
    road = figures([judge.record(judge.semantickitti(sequences.frame(sequences.names("test")[0])))[0]])["road"]["all"]
    assert road["f1"] > 0.7
    assert road["max_f1"] >= road["f1"] - 0.01
    assert not math.isnan(road["ap"])
