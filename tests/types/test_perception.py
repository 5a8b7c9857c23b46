"""Results and their JSON: what is written is read back, and every wrong record has its own error."""

from __future__ import annotations

import copy
import json
import math
import pickle
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edgeperc import (
    Box,
    ModelError,
    OptionError,
    Perception,
    PointLabels,
    PointsError,
    TopView,
    Tracker,
    TrackingError,
    Tracks,
    Zone,
)
from edgeperc.records import SCAN_KEYS, read_boxes, scan_record
from edgeperc.simulation.camera import forward_camera

CAR = Box("car", 0.87654321, (12.34567, -1.5, -0.9), (4.1, 1.7, 1.5), 0.1234567)
VIEW = (0.1, (0.0, 40.0), (-10.0, 10.0))


def perception_of(*boxes: Box, stamp_s: float | None = None, labels: bool = True) -> Perception:
    road = np.zeros((400, 200), np.uint8)
    road[:, 60:140] = 1
    seen = PointLabels(np.array([0, 1, 1, 0], np.uint8), np.array([True, True, True, False]), ("background", "car"))
    return Perception(
        n_points=4,
        n_dropped=1,
        points=seen if labels else None,
        top_view=TopView(road, ("background", "drivable"), *VIEW, np.ones_like(road, bool)) if labels else None,
        boxes=boxes,
        stage_ms={"infer": 1.23456},
        providers={"network": "network fp32, CPUExecutionProvider"},
        fitness=("The ground is missing.",),
        stamp_s=stamp_s,
    )


def test_a_box_is_read_back_as_it_was_written() -> None:
    again = Box.from_dict(json.loads(json.dumps(CAR.to_dict())))
    assert again == Box("car", 0.8765, (12.3457, -1.5, -0.9), (4.1, 1.7, 1.5), 0.12346)
    assert Box.from_dict(again.to_dict()) == again
    facing = replace(again, front=0.9)
    assert Box.from_dict(json.loads(json.dumps(facing.to_dict()))) == facing
    earlier = CAR.to_dict()
    del earlier["front"]
    assert Box.from_dict(earlier) == again


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"label": None}, "box.label is None; expected a text"),
        ({"score": "high"}, "high"),
        ({"center": [1.0, 2.0]}, "expected a list of 3 numbers"),
        ({"center": 3.0}, "center is 3.0"),
        ({"size": [1.0, 2.0, 3.0, 4.0]}, "expected a list of 3 numbers"),
        ({"yaw": None}, "yaw is None; expected a number"),
        ({"front": "rear"}, "rear"),
        ({"front": []}, r"front is \[\]; expected a number"),
    ],
)
def test_a_wrong_box_is_refused(change: dict[str, Any], message: str) -> None:
    document = CAR.to_dict() | change
    with pytest.raises(PointsError, match=message):
        Box.from_dict(document)
    for key in {*change} - {"front"}:  # which alone may be missing
        del document[key]
        with pytest.raises(PointsError, match=key):
            Box.from_dict(document)


@given(
    st.dictionaries(
        st.sampled_from(["label", "score", "center", "size", "yaw", "front"]), st.text() | st.floats() | st.none()
    )
)
def test_any_document_is_a_box_or_a_points_error(change: dict[str, Any]) -> None:
    try:
        box = Box.from_dict(CAR.to_dict() | change)
    except PointsError:
        return
    assert isinstance(box.label, str)


def test_perception_as_json_counts_points_by_class() -> None:
    document = perception_of(CAR, stamp_s=12.5).to_dict()
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert document["stamp_s"] == 12.5
    assert document["point_counts"] == {"background": 1, "car": 2}
    assert document["n_in_view"] == sum(document["point_counts"].values()) == 3
    assert document["drivable_area_m2"] == 320.0
    assert document["boxes"] == [CAR.to_dict()]
    assert perception_of(CAR, stamp_s=float("nan")).to_dict()["stamp_s"] is None  # JSON has no such number
    assert document["stage_ms"] == {"infer": 1.235}
    empty = perception_of(labels=False).to_dict()
    assert empty.keys() == document.keys()
    assert empty["point_counts"] is empty["n_in_view"] is empty["drivable_area_m2"] is empty["stamp_s"] is None


COPIES: dict[str, Callable[[Any], Any]] = {
    "pickle": lambda thing: pickle.loads(pickle.dumps(thing)),
    "old pickle": lambda thing: pickle.loads(pickle.dumps(thing, 0)),
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "replace": replace,
    "as a dict": lambda thing: replace(thing, stage_ms=asdict(thing)["stage_ms"]),
}


@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("made", [perception_of(CAR, stamp_s=12.5), perception_of(), perception_of(labels=False)])
def test_a_perception_is_pickled_and_copied(how: str, made: Perception) -> None:
    made = replace(made, stage_ms={"infer": 1.5}, providers={"a": "b"})
    copied = COPIES[how](made)
    assert copied.to_dict() == made.to_dict()
    assert (copied.stage_ms, copied.boxes, copied.fitness) == (made.stage_ms, made.boxes, made.fitness)
    if made.points is not None:
        np.testing.assert_array_equal(copied.points.labels, made.points.labels)
    if made.top_view is not None:
        np.testing.assert_array_equal(copied.top_view.observed, made.top_view.observed)


def test_only_observed_road_is_in_the_json() -> None:
    found = perception_of()
    found.top_view.observed[:100] = False  # farther than 30 m
    assert found.to_dict()["drivable_area_m2"] == 240.0
    road = scan_record(found)["road"]
    assert (road["free_ahead_m"], road["free_ahead_end"], road["unknown_ahead_m"]) == (30.0, "unknown", 30.0)
    assert (road["obstacle_ahead_m"], road["edge_ahead_m"], road["view_ahead_m"]) == (None, None, 40.0)
    assert np.count_nonzero(found.top_view.road) == 400 * 80
    found.top_view.observed[:] = False
    nothing = scan_record(found)
    assert nothing["drivable_area_m2"] == 0.0
    assert nothing["road"]["outline"] == []


def followed(*again: int) -> Tracks:
    """The track of a car that stands, and where the scans of some numbers come ``again``, after the last of them."""
    tracker = Tracker()
    return [tracker.update([CAR], 0.1 * k, np.eye(4)) for k in (*range(5), *again)][-1]


def test_a_record_adds_road_and_tracks() -> None:
    tracks = followed()
    record = scan_record(perception_of(CAR), tracks)
    assert tuple(record) == SCAN_KEYS
    assert record["road"]["free_ahead_m"] == pytest.approx(10.34, abs=0.5)  # up to the car's rear
    assert record["road"]["free_ahead_end"] == "obstacle"
    assert len(record["road"]["holes"]) == 1  # the car is not in the outline
    (track,) = tracks
    assert record["tracks"] == [track.to_dict()]
    with pytest.warns(UserWarning, match="a late or doubled scan has no tracks"):
        late, unknown = scan_record(perception_of(CAR), followed(3)), scan_record(perception_of(CAR))
    assert (late["tracks"], [each["tracks_late"] for each in (record, late, unknown)]) == ([], [False, True, None])
    assert Box.from_dict(track.to_dict()) == Box.from_dict(track.box.to_dict())
    without = scan_record(perception_of(labels=False))
    assert tuple(without) == SCAN_KEYS
    assert without["road"] is None
    assert without["tracks"] == []


def test_a_track_is_used_like_a_box() -> None:
    (track,) = followed()
    for name in ("label", "score", "center", "size", "yaw"):
        assert getattr(track, name) == getattr(track.box, name)
    assert math.hypot(track.center[0] - CAR.center[0], track.center[1] - CAR.center[1]) < 0.1


def test_boxes_are_read_from_what_was_written(tmp_path: Path) -> None:
    path = tmp_path / "drive.jsonl"
    scans = [perception_of(CAR), perception_of(), perception_of(CAR, CAR)]
    path.write_text("".join(json.dumps(scan_record(scan)) + "\n" for scan in scans), encoding="utf-8")
    once = Box.from_dict(CAR.to_dict())
    assert read_boxes(path) == [[once], [], [once, once]]


def test_boxes_are_of_the_frames_that_their_scans_name(tmp_path: Path) -> None:
    path = tmp_path / "drive.jsonl"

    def read(*scans: str, frames: dict[str, int] | None = None) -> list[int]:
        lines = [{"scan": scan, **scan_record(perception_of(*[CAR] * k))} for k, scan in enumerate(scans, start=1)]
        path.write_text("\n".join(map(json.dumps, lines)), encoding="utf-8")
        return [*map(len, read_boxes(path, frames))]

    assert read("0000/000001.bin", "0000/000000.pcd.bin", "drive.pcap/000002") == [2, 1, 3]
    assert read("a.bin", "1533151603547590.bin") == [1, 2]  # times are no frames
    assert read("77.bin", "12.bin", frames={"12": 0, "77": 1}) == [2, 1]
    with pytest.warns(UserWarning, match="no line with boxes for 1 of 3 frames, such as 1"):
        assert read("0.bin", "2.bin") == [1, 0, 2]
    path.write_text(path.read_text() + '\n{"scan": "3.bin", "error": "the file is empty"}')  # of a scan that failed
    with pytest.warns(UserWarning, match="for 2 of 4 frames, such as 1"):
        assert [*map(len, read_boxes(path))] == [1, 0, 2, 0]
    with pytest.raises(TrackingError, match=r"b/0\.bin has the frame of a/0\.bin, 0"):
        read("a/0.bin", "b/0.bin")
    with pytest.raises(TrackingError, match=r"7\.bin is none of the sequence"):
        read("7.bin", frames={"8": 0})


@pytest.mark.parametrize("line", ["{}", "[]", "null", '{"boxes": 3}', '{"boxes": [{}]}', "no JSON", '{"error": "x"}'])
def test_malformed_record_is_a_tracking_error(tmp_path: Path, line: str) -> None:
    path = tmp_path / "drive.jsonl"
    path.write_text(line, encoding="utf-8")
    with pytest.raises(TrackingError, match=r"drive\.jsonl holds no boxes"):
        read_boxes(path)


def test_cell_centers_of_a_top_view() -> None:
    labels, observed = np.zeros((400, 200), np.uint8), np.ones((400, 200), bool)
    view = TopView(labels, ("background", "drivable"), *VIEW, observed)
    assert (view.geometry.height, view.geometry.width) == view.labels.shape
    for cell in ((0, 0), (399, 199), (17, 101)):
        row, col, in_view = view.geometry.cells(*view.to_meters(*cell))
        assert ((int(row), int(col)), bool(in_view)) == (cell, True)


@pytest.mark.parametrize("origin", [(512345.25, 5412345.5, 113.0), (-1e7 + 0.1, 1e-3, -4000.0), (0.0, 0.0, 0.0)])
def test_boxes_and_points_are_placed_in_the_map(origin: tuple[float, float, float]) -> None:
    perception = replace(perception_of(CAR, replace(CAR, score=0.5)), origin_m=origin)
    for box, placed in zip(perception.boxes, perception.map_boxes, strict=True):
        assert placed == replace(box, center=tuple(c + o for c, o in zip(box.center, origin, strict=True)))
    points = np.random.default_rng(0).normal(0.0, 30.0, (50, 4)).astype(np.float32)
    in_map = perception.to_map(points)
    assert in_map.dtype == np.float64
    with pytest.raises(OptionError, match=r"boxes\[0\] is 3; expected a Box"):
        perception.in_map([3])  # type: ignore[list-item]
    np.testing.assert_array_equal(in_map, points[:, :3].astype(np.float64) + np.array(origin))
    np.testing.assert_array_equal((in_map - np.array(origin)).astype(np.float32)[:, 1:2], points[:, 1:2])
    record = json.loads(json.dumps(scan_record(perception)))
    assert record["origin_m"] == list(origin)
    assert [Box.from_dict(box) for box in record["map_boxes"]] == [
        Box.from_dict(box.to_dict()) for box in perception.map_boxes
    ]


@pytest.mark.parametrize("frame", ["pandas", "array"])
def test_points_of_a_table_are_taken_by_the_names_of_its_columns(frame: str) -> None:
    """By position, they would be other axes."""
    x, y, z, remission = points = np.random.default_rng(0).normal(0.0, 30.0, (4, 50)).astype(np.float32)
    table = np.rec.fromarrays([remission, z, y, x], names="intensity,z,y,x")
    zone, placed = Zone([(-20, -20), (30, -20), (30, 20)]), replace(perception_of(CAR), origin_m=(1.0, 2.0, 3.0))
    given = pytest.importorskip("pandas").DataFrame(table) if frame == "pandas" else table
    for take in (placed.to_map, zone.mark, forward_camera().project):
        np.testing.assert_array_equal(take(given), take(points.T))
        for wrong in (given[["z", "x"]], np.ma.array(points.T), points[0], points.T.astype(str), "points"):
            with pytest.raises(PointsError):
                take(wrong)  # type: ignore[arg-type]


def test_without_an_origin_nothing_is_in_a_map() -> None:
    perception = perception_of(CAR)
    record = perception.to_dict()
    assert (record["origin_m"], record["map_boxes"], scan_record(perception)["map_tracks"]) == (None, None, None)
    with pytest.raises(PointsError, match="origin_m="):
        _ = perception.map_boxes
    with pytest.raises(PointsError, match="place of the scan in a map is not known"):
        perception.to_map(np.zeros((3, 4), np.float32))


PARTS = {"points": "pointseg", "top_view": "ssadnet", "image": "camseg", "ground": "pointseg"}


@pytest.mark.parametrize(("name", "model"), PARTS.items())
def test_a_part_is_required_as_it_is_or_names_the_model_to_add(name: str, model: str) -> None:
    part = object()
    there, without = (replace(perception_of(), **{name: each}) for each in (part, None))  # type: ignore[arg-type]
    assert getattr(there, f"require_{name}")() is part
    with pytest.raises(ModelError, match=f"add '{model}' to the models"):
        getattr(without, f"require_{name}")()
