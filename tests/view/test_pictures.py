from __future__ import annotations

import base64
import io
import itertools
import json
import math
import re
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from checkout import printed
from edgeperc import Tracker, view
from edgeperc.errors import MissingExtraError, OptionError, PointsError, TrackingError
from edgeperc.evaluation.mistakes import Mistakes, draw_mistakes
from edgeperc.ground.planes import fit_ground
from edgeperc.readers.files import read_points
from edgeperc.types.frame import ModelFrame
from edgeperc.types.mounting import MODEL_MOUNTING, Mounting
from edgeperc.types.perception import Box, Perception, PointLabels, TopView
from edgeperc.view import canvas, draw_tracks, flatten_scan, write_html, write_labels, write_ply
from edgeperc.view.canvas import Label, add_axes, free_place, new_figure, place_labels, shorten, wrap
from edgeperc.view.colors import CLASS_COLORS, FALSE, FOUND, INK, MISSED, PANEL
from edgeperc.view.content import ground_plane, paint_points, paint_vehicles

POINT_CLASSES = ("background", "car", "pedestrian", "cyclist")
TOP_CLASSES = ("background", "drivable", "car", "van", "truck")
CAR = Box("car", 0.9, (20.0, 3.0, -0.9), (4.2, 1.8, 1.6), 0.3)
VAN = Box("van", 0.6, (30.0, -4.0, -0.7), (5.1, 2.0, 2.2), -2.9)


def a_scan() -> np.ndarray:
    """Ground all around, a block of returns in each box, a pole-like pedestrian, and a row that is not finite."""
    rng = np.random.default_rng(0)
    azimuth, distance = rng.uniform(-np.pi, np.pi, 6000), rng.uniform(3.0, 50.0, 6000)
    ground = np.column_stack([distance * np.cos(azimuth), distance * np.sin(azimuth), np.full(6000, -1.73)])
    blocks = [rng.uniform(-0.5, 0.5, (300, 3)) * [3.5, 1.5, 1.4] + box.center for box in (CAR, VAN)]
    walker = rng.uniform(-0.5, 0.5, (100, 3)) * [0.4, 0.4, 1.7] + [12.0, -3.0, -0.9]
    xyz = np.concatenate([ground, *blocks, walker, [[np.nan, 0.0, 0.0]]])
    return np.column_stack([xyz, rng.uniform(0.0, 1.0, len(xyz))]).astype(np.float32)


def a_perception(points: np.ndarray) -> Perception:
    labels = np.zeros(len(points), dtype=np.uint8)
    labels[6000:6600], labels[6600:6700] = 1, 2
    cells = np.zeros((400, 200), dtype=np.uint8)
    cells[150:400, 60:140] = 1
    cells[250:290, 60:80] = 2
    return Perception(
        n_points=len(points),
        n_dropped=1,
        points=PointLabels(labels, np.isfinite(points).all(axis=1) & (points[:, 0] > 0), POINT_CLASSES),
        top_view=TopView(cells, TOP_CLASSES, 0.1, (6.0, 46.0), (-10.0, 10.0), np.ones_like(cells, bool)),
        boxes=(CAR, VAN),
        stage_ms={"project": 1.0, "infer": 30.0},
        providers={"ssadnet": "CPUExecutionProvider (fp32)"},
        fitness=("the scan has 32 beams, the training scans had 64",),
        stamp_s=None,
    )


@pytest.fixture
def scan() -> np.ndarray:
    return a_scan()


@pytest.fixture
def perception(scan: np.ndarray) -> Perception:
    return a_perception(scan)


def pixels(png: bytes) -> np.ndarray:
    from PIL import Image  # comes with matplotlib

    with Image.open(io.BytesIO(png)) as opened:
        assert opened.format == "PNG"
        return np.asarray(opened.convert("RGB")).astype(np.int16)


def near(picture: np.ndarray, color: str) -> np.ndarray:
    """Pixels of about a color, or of that of a class."""
    color = CLASS_COLORS.get(color, color)
    wanted = [int(color[k : k + 2], 16) for k in (1, 3, 5)]
    return (np.abs(picture - wanted) <= 12).all(axis=2)


def scene_of(path: Path) -> dict[str, Any]:
    """The data of a page."""
    (data,) = re.findall('type="application/json">(.*?)</script>', path.read_text(encoding="utf-8"), re.DOTALL)
    scene: dict[str, Any] = json.loads(data)
    return scene


def unpacked(shown: dict[str, Any], kind: str = "<i2") -> tuple[np.ndarray, np.ndarray]:
    """Points of a scan on a page, in steps of its scale, and their labels."""
    xyz = np.frombuffer(base64.b64decode(shown["xyz"]), kind).reshape(-1, 3)
    return xyz * shown.get("scale", 1), np.frombuffer(base64.b64decode(shown["label"]), np.uint8)


@pytest.fixture(scope="module")
def drawn(matplotlib: None, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The picture of the scan, which replaces a file."""
    target = tmp_path_factory.mktemp("drawn") / "scan.png"
    target.write_bytes(b"old")
    png = view.draw(a_perception(a_scan()), a_scan(), target, title="a scan")
    assert [*target.parent.iterdir()] == [target]
    assert target.read_bytes() == png
    return png


def test_picture_shows_classes_where_they_are(drawn: bytes) -> None:
    picture = pixels(drawn)
    assert picture.shape == (1120, 1600, 3)
    assert len(np.unique(picture @ [1 << 16, 1 << 8, 1])) > 500
    # The panel from above begins at pixel column 90 and row 128 with x = 48 and y = 14, 14.65 pixels a meter.
    for box in (CAR, VAN):
        row, col = 128 + (48.0 - box.center[0]) * 14.65, 90 + (14.0 - box.center[1]) * 14.65
        around = near(picture[int(row) - 45 : int(row) + 45, int(col) - 45 : int(col) + 45], box.label)
        assert around.sum() > 100, box.label
        empty = picture[600:860, 95:200]
        assert not near(empty, box.label).any()
    # A pedestrian shows from behind and as the sensor sees it, right of the middle.
    right_half = near(picture, "pedestrian")[:, 1050:]
    assert right_half[128:648].sum() > 20
    assert right_half[700:868].sum() > 20
    # Legend squares.
    assert all(near(picture[910:1010], name).sum() > 60 for name in {*POINT_CLASSES, *TOP_CLASSES})


@pytest.mark.usefixtures("matplotlib")
@pytest.mark.parametrize(("behind_m", "has_top_view"), [(15.0, True), (44.0, True), (15.0, False)])
def test_a_full_turn_is_drawn_whole(
    behind_m: float, has_top_view: bool, scan: np.ndarray, perception: Perception
) -> None:
    """A box behind the sensor shows from above, and points behind it in the range image, at its ends."""
    labels, in_view = perception.require_points().labels.copy(), perception.require_points().in_view.copy()
    scan[-80:, 0], scan[-80:, 1], scan[-80:, 2] = -behind_m, np.linspace(-1.0, 1.0, 80), -0.5
    labels[-80:], in_view[-80:] = POINT_CLASSES.index("cyclist"), True
    rear = replace(CAR, label="cyclist", center=(-behind_m, 0.0, -0.8))
    turn = replace(perception, boxes=(rear,), points=PointLabels(labels, in_view, POINT_CLASSES))
    turn = turn if has_top_view else replace(turn, top_view=None)
    found = near(pixels(view.draw(turn, scan)), "cyclist")
    row, col = 128 + int((48.0 + behind_m) * 740 / 96.0), 90 + int(36.0 * 740 / 96.0)
    assert found[row - 30 : row + 30, col - 60 : col + 60].sum() > 60
    assert found[700:868, 680:760].any()
    assert found[700:868, 1492:1572].any()


@pytest.mark.parametrize("label", ["van", "truck", "car"])
def test_points_of_a_vehicle_have_the_color_of_its_box(label: str, scan: np.ndarray, perception: Perception) -> None:
    box = replace(CAR, label=label, yaw=0.6)
    cos, sin = np.cos(box.yaw), np.sin(box.yaw)
    for k, (along, across) in enumerate([(1.8, 0.7), (-1.8, -0.7), (2.6, 0.0), (0.0, 1.4)]):
        x, y = box.center[0] + cos * along - sin * across, box.center[1] + sin * along + cos * across
        scan[k, :3] = x, y, box.center[2]
    labels = np.zeros(len(scan), np.uint8)
    labels[:4] = POINT_CLASSES.index("car")
    seen = replace(perception, points=replace(perception.require_points(), labels=labels), top_view=None, boxes=(box,))
    names, painted = paint_points(scan, seen)
    paint_vehicles(names, painted, scan, seen.boxes)
    assert [names[k] for k in painted[:4]] == [label, label, "car", "car"]


@pytest.mark.usefixtures("matplotlib")
def test_a_turn_of_few_beams_has_no_stripes_and_boxes_outside_are_counted(
    perception: Perception, monkeypatch: pytest.MonkeyPatch
) -> None:
    headings: list[str] = []
    monkeypatch.setattr(canvas, "write_heading", lambda figure, left, top, heading, more: headings.append(more))
    azimuth, elevation = np.meshgrid(np.linspace(-np.pi, np.pi, 1800), np.radians(np.linspace(-20.0, 10.0, 40)))
    x, y = 20.0 * np.cos(azimuth), 20.0 * np.sin(azimuth)
    scan = np.stack([x, y, 20.0 * np.tan(elevation), np.zeros_like(x)], axis=-1).reshape(-1, 4).astype(np.float32)
    points = PointLabels(np.zeros(len(scan), np.uint8), np.ones(len(scan), bool), POINT_CLASSES)
    far = replace(CAR, center=(-70.0, 0.0, -0.8))
    turn = replace(perception, n_points=len(scan), points=points, boxes=(CAR, far))
    picture = pixels(view.draw(turn, scan))
    assert not near(picture[720:850, 760:1560], PANEL).any()
    assert headings[0] == "1 farther; gray: not observed"


@pytest.mark.parametrize("is_free", [False, True])
def test_what_no_other_panel_says_is_placed_first(
    is_free: bool, scan: np.ndarray, perception: Perception, monkeypatch: pytest.MonkeyPatch, matplotlib: None
) -> None:
    view_above = perception.require_top_view()
    labels = np.full_like(view_above.labels, int(is_free))
    placed: list[list[str]] = []
    monkeypatch.setattr(canvas, "place_labels", lambda _, labels, *__: placed.append([x.text for x in labels]) or 0)
    view.draw(replace(perception, top_view=replace(view_above, labels=labels)), scan)
    assert placed[0][-1 if is_free else 0] == ("free ahead: at least 46 m" if is_free else "not free 6 m ahead")


@pytest.mark.usefixtures("matplotlib")
def test_picture_grows_with_its_warnings(scan: np.ndarray, perception: Perception) -> None:
    many = pixels(view.draw(replace(perception, fitness=("a warning", "words " * 100)), scan))
    assert many.shape[0] > 1080 + 3 * 26
    amber = (np.abs(many - [0xFF, 0xC4, 0x6B]) <= 12).all(axis=2)
    assert not amber[1080 - 60 :, 1572:].any()
    rows = [amber[at : at + 26].any() for at in range(1080 - 20, many.shape[0] - 26, 26)]
    assert sum(rows) >= 3


@pytest.mark.usefixtures("matplotlib")
def test_picture_of_one_view(scan: np.ndarray, perception: Perception, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("edgeperc.view.canvas.write_heading", headings := Mock())
    points_alone = pixels(view.draw(replace(perception, top_view=None, boxes=()), scan))
    assert near(points_alone, "pedestrian").sum() > 100
    assert not near(points_alone, "drivable").any()
    top_alone = pixels(view.draw(replace(perception, points=None), scan))
    assert near(top_alone, "van").sum() > 100
    assert not near(top_alone, "pedestrian").any()
    assert points_alone.shape[1] == top_alone.shape[1] == 1600
    said = [call.args[4] for call in headings.call_args_list if call.args[3] == "as the sensor sees it"]
    assert said == ["90° ahead, a class for every point", "90° ahead"]


@pytest.mark.usefixtures("matplotlib")
def test_road_that_was_not_observed_is_gray(scan: np.ndarray, perception: Perception) -> None:
    bare = replace(perception, n_points=0, points=None, boxes=())
    observed = np.ones((400, 200), bool)
    observed[:250] = False  # from 21 m on
    half = replace(bare, top_view=replace(perception.require_top_view(), observed=observed))
    gray, green = (pixels(view.draw(each, scan[:0])) for each in (half, bare))
    # The panel from above: 2 to 3.5 m left of the sensor, 28 to 24 m and 18 to 10 m ahead. Beside the arrow.
    far, close = (slice(421, 480), slice(245, 266)), (slice(568, 684), slice(245, 266))
    for picture, place, is_green in ((green, far, True), (green, close, True), (gray, close, True), (gray, far, False)):
        red, more, _ = picture[place].mean(axis=(0, 1))
        assert (more > red + 30) == is_green
    assert gray[far].mean() > 30  # gray, not black like observed background
    # From behind, the road is green only where it was observed.
    strong = [(p[128:648, 540:, 1] > p[128:648, 540:, 0] + 30).sum() for p in (gray, green)]
    assert 0 < strong[0] < 0.95 * strong[1]


def test_picture_is_the_same_again_and_in_other_threads(drawn: bytes, scan: np.ndarray, perception: Perception) -> None:
    """From named columns in any order, and with any matplotlibrc. And pyplot, of which there is one, draws none."""
    matplotlib = pytest.importorskip("matplotlib")
    before = "matplotlib.pyplot" in sys.modules
    named = np.rec.fromarrays(scan.T[::-1], names="intensity,z,y,x")
    theirs = {"image.origin": "lower", "scatter.marker": "x", "text.usetex": True}
    with matplotlib.rc_context(theirs), ThreadPoolExecutor(2) as pool:
        got = [*pool.map(lambda title: view.draw(perception, named, title=title), 2 * ["a scan"])]
    assert [png == drawn for png in got] == [True, True]
    assert ("matplotlib.pyplot" in sys.modules) == before


@pytest.mark.usefixtures("matplotlib")
def test_tiny_scans(tmp_path: Path, scan: np.ndarray) -> None:
    whole = a_perception(scan)
    for points in (scan[:0], scan[:1], np.full((1, 4), np.nan, dtype=np.float32)):
        n = len(points)
        labels = PointLabels(np.zeros(n, np.uint8), np.zeros(n, bool), POINT_CLASSES)
        perception = replace(whole, n_points=n, points=labels, stage_ms={}, providers={}, fitness=())
        assert pixels(view.draw(perception, points)).shape == (1094, 1600, 3)
        write_html(perception, points, tmp_path / "page.html")
        write_ply(perception, points, tmp_path / "points.ply")
        write_labels(perception, tmp_path / "points.label")
        assert (tmp_path / "points.label").stat().st_size == 4 * n


@pytest.mark.usefixtures("matplotlib")
def test_points_of_unknown_remission_are_drawn(scan: np.ndarray, perception: Perception, tmp_path: Path) -> None:
    known, unknown = scan.copy(), scan.copy()
    known[:, 3], unknown[:, 3] = 0.0, np.nan
    pages = []
    for points in (known, unknown):
        write_html(perception, points, tmp_path / "page.html")
        pages.append((tmp_path / "page.html").read_bytes())
    assert pages[0] == pages[1]
    assert view.draw(perception, known) == view.draw(perception, unknown)
    assert flatten_scan(known, perception) == flatten_scan(unknown, perception)


@pytest.mark.usefixtures("matplotlib")
def test_strange_titles_and_classes(scan: np.ndarray, perception: Perception, tmp_path: Path) -> None:
    strange = "$\\frac{ <script>alert(1)</script> 走 \n \udcff @@SCENE@@" + "x" * 200
    classes = (*POINT_CLASSES[:3], "</script> & tram\nelement vertex 3")
    perception = replace(perception, points=replace(perception.points, classes=classes))
    assert pixels(view.draw(perception, scan, title=strange)).shape[1] == 1600
    write_html(perception, scan, tmp_path / "page.html", title=strange)
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert text.count("<script") == 2
    assert text.count("</script>") == 2
    assert "&lt;script&gt;alert(1)" in text
    write_ply(perception, scan, tmp_path / "points.ply")
    header = (tmp_path / "points.ply").read_bytes().split(b"end_header\n")[0].decode().splitlines()
    assert [line for line in header if line.startswith("element")] == [f"element vertex {len(scan)}"]


@pytest.mark.usefixtures("matplotlib")
def test_a_file_that_cannot_be_written_is_an_error(perception: Perception, tmp_path: Path) -> None:
    with pytest.raises(OSError, match="absent"):
        draw_mistakes([], tmp_path / "absent" / "scan.png")
    folder = tmp_path / "scan.label"
    folder.mkdir()
    with pytest.raises(OSError, match=r"scan\.label"):
        write_labels(perception, folder)
    assert [entry.name for entry in tmp_path.iterdir()] == ["scan.label"]


def test_html_holds_every_finite_point_and_no_address(scan: np.ndarray, perception: Perception, tmp_path: Path) -> None:
    bright = scan * np.array([1, 1, 1, 200], dtype=np.float32)
    write_html(perception, bright, tmp_path / "page.html", title="a scan")
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert not re.search(r"https?:|src=|@@", text)
    scene = scene_of(tmp_path / "page.html")
    (shown,) = scene["scans"]
    xyz, label = unpacked(shown, "<f4")
    remission = np.frombuffer(base64.b64decode(shown["remission"]), dtype=np.uint8)
    np.testing.assert_array_equal(xyz, scan[:-1, :3])
    assert len(remission) == len(label) == len(xyz)
    assert remission.max() == 255
    names = [one["name"] for one in scene["classes"]]
    assert names == [*POINT_CLASSES, "drivable", "van", "truck"]
    assert (label[6000:6600] == names.index("car")).all()
    road = label == names.index("drivable")
    assert road.sum() > 100
    assert (np.abs(xyz[road, 1]) <= 4.01).all()
    assert shown["ground"] == pytest.approx([-1.73, 0.0, 0.0], abs=0.01)
    facts = {names[int(k)]: texts for k, texts in shown["facts"].items()}
    assert facts["drivable"] == [f"{perception.top_view.drivable_area_m2:.0f} m²"]
    assert facts["car"] == ["1 box", "600 points"]
    assert facts["van"] == ["1 box"]
    road_cells = np.zeros_like(perception.top_view.drivable)
    for row, first, last in shown["road"]["strips"]:
        road_cells[row, first:last] = True
    np.testing.assert_array_equal(road_cells, perception.top_view.drivable)
    corners = np.array(shown["boxes"][0]["corners"])
    np.testing.assert_allclose(corners.mean(axis=0), CAR.center, atol=2e-3)
    assert np.ptp(corners[:, 2]) == pytest.approx(CAR.size[2], abs=2e-3)


def test_leaves_above_the_road_are_not_road(perception: Perception) -> None:
    points = np.array([[20.0, 0.0, -1.7, 0.1]] * 60 + [[20.0, 0.0, 2.0, 0.1]], dtype=np.float32)
    bare = PointLabels(np.zeros(61, np.uint8), np.ones(61, bool), POINT_CLASSES)
    names, painted = paint_points(points, replace(perception, n_points=61, points=bare))
    assert (painted[:60] == names.index("drivable")).all()
    assert painted[60] == 0


@pytest.mark.parametrize("origin", [None, (512345.25, 5412345.5, 113.0)])
def test_ply_reads_back(scan: np.ndarray, perception: Perception, tmp_path: Path, origin: Any) -> None:
    """The file of a scan in a map has its coordinates, as doubles."""
    path = tmp_path / "points.ply"
    write_ply(replace(perception, origin_m=origin), scan, path)
    header, body = path.read_bytes().split(b"end_header\n", 1)
    kinds = {"float": "<f4", "double": "<f8", "uchar": "u1"}
    properties = re.findall(r"property (\w+) (\w+)", header.decode("ascii"))
    rows = np.frombuffer(body, dtype=[(name, kinds[kind]) for kind, name in properties])
    assert rows.dtype.names == ("x", "y", "z", "remission", "label", "red", "green", "blue")
    assert len(rows) == len(scan)
    for k, name in enumerate("xyz"):
        expected = scan[:, k] if origin is None else scan[:, k].astype(np.float64) + origin[k]
        assert rows.dtype[name] == expected.dtype
        np.testing.assert_array_equal(rows[name], expected)
    np.testing.assert_array_equal(rows["remission"], scan[:, 3])
    np.testing.assert_array_equal(rows["label"], perception.points.labels)
    car = rows[rows["label"] == 1][0]
    assert "#{:02x}{:02x}{:02x}".format(*(car[c] for c in ("red", "green", "blue"))) == CLASS_COLORS["car"]
    np.testing.assert_allclose(read_points(path, origin_m=origin), scan, atol=1e-8)


def test_labels_are_semantickitti_ids(scan: np.ndarray, perception: Perception, tmp_path: Path) -> None:
    """Of networks with its own names of classes, too: a person was 99, "other-object"."""
    labels = np.arange(len(scan), dtype=np.uint8) % 4
    for first, other, number in (("background", "cyclist", 31), ("unlabeled", "person", 30), ("noise", "trunk", 71)):
        named = replace(perception.points, labels=labels, classes=(first, "car", other, "tram"))
        write_labels(replace(perception, points=named), tmp_path / "scan.label")
        raw = np.fromfile(tmp_path / "scan.label", dtype="<u4")
        np.testing.assert_array_equal(raw, np.array([0, 10, number, 99])[labels])
    write_labels(perception, tmp_path / "scan.label")  # of the same scan, by another network
    for there in (raw[1:], raw | 7 << 16, raw + 1):  # another drive's, with instances, and with classes of the truth
        there.tofile(tmp_path / "scan.label")
        with pytest.raises(OptionError, match="perhaps the truth"):
            write_labels(perception, tmp_path / "scan.label")


def test_refusals(scan: np.ndarray, perception: Perception, tmp_path: Path) -> None:
    top_alone = replace(perception, points=None)
    with pytest.raises(PointsError, match="pointseg"):
        write_labels(top_alone, tmp_path / "a.label")
    with pytest.raises(PointsError, match="pointseg"):
        write_ply(top_alone, scan, tmp_path / "a.ply")
    for writer in (write_html, write_ply, view.draw):
        with pytest.raises(PointsError, match="expected the scan that was perceived"):
            writer(perception, scan[1:], tmp_path / "a")
        with pytest.raises(PointsError, match=r"\(n, 4\)"):
            writer(perception, scan[:, :2], tmp_path / "a")
    assert not list(tmp_path.iterdir())


def test_missing_matplotlib_names_the_line(
    scan: np.ndarray, perception: Perception, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("matplotlib", "matplotlib.figure", "matplotlib.backends.backend_agg"):
        monkeypatch.setitem(sys.modules, name, None)
    for drawing in (lambda: view.draw(perception, scan), lambda: draw_mistakes([some_mistakes(scan)])):
        with pytest.raises(MissingExtraError, match=r"pip install 'edgeperc\[view\]'"):
            drawing()


def test_import_loads_no_matplotlib() -> None:
    printed("import edgeperc.view, sys; sys.exit(any(m.startswith(('matplotlib', 'PIL')) for m in sys.modules))")


def some_mistakes(points: np.ndarray, **given: Any) -> Mistakes:
    return Mistakes("000123", "drive_0011", points, np.zeros(len(points), np.uint8), **given)


def test_mistakes_are_summed_up(scan: np.ndarray) -> None:
    mistakes = some_mistakes(scan, missed=((CAR, 300), (VAN, 1040), (CAR, 5)), false=(VAN,), wrong_share=0.25)
    assert mistakes.summary == "missed: 2 car, 1 van (1,345 points); false: 1 van"
    assert mistakes.n_errors == 4.25
    assert some_mistakes(scan, found=(CAR,)).summary == "no mistake"
    assert some_mistakes(scan, found=(CAR,)).n_errors == 0.0
    for point, farther in ((6000, ""), (int(scan[:6000, 0].argmin()), ", 1 of them farther")):
        wrong = replace(some_mistakes(scan), wrong=np.where(np.arange(len(scan)) == point, 2, 0).astype(np.uint8))
        assert wrong.summary == f"1 point wrong{farther}"
    # What is summed up lies in the panel, which keeps its shape.
    for x, y in ((-30.0, 5.0), (20.0, -40.0), (70.0, 3.0), (3.0, -90.0)):
        mistakes = some_mistakes(scan, false=(replace(CAR, center=(x, y, -1.0)),))
        behind, ahead, beside = mistakes.reach_m
        assert -behind < x < ahead
        assert abs(y) < beside
        assert (behind + ahead) / beside == pytest.approx(55.0 / 27.0)
        assert mistakes.shown.sum() == len(scan) - 1  # all that are finite
    assert (wrong.reach_m, wrong.shown.sum() < 0.5 * len(scan)) == ((3.0, 52.0, 27.0), True)


@pytest.mark.usefixtures("matplotlib")
def test_mistakes_alone_are_drawn(scan: np.ndarray, tmp_path: Path) -> None:
    right = some_mistakes(scan, found=(CAR, VAN))
    missed = some_mistakes(scan, found=(CAR,), missed=((VAN, 300),))
    false = some_mistakes(scan, found=(CAR, VAN), false=(replace(CAR, center=(-40.0, -12.0, -1.0)),))
    points = replace(
        right, wrong=np.where(np.arange(len(scan)) < 3000, 1, 0).astype(np.uint8), found=(), wrong_share=0.1
    )
    png = draw_mistakes([right, missed, false, points], tmp_path / "worst.png", title="a title", columns=2)
    assert (tmp_path / "worst.png").read_bytes() == png
    with pytest.raises(OptionError, match=r"worst.jpg would hold a picture in .png"):
        draw_mistakes([missed], tmp_path / "worst.jpg")
    picture = pixels(png)
    # Three panels: the first scan has no mistake. Two are 762 pixels wide and 776 high, below 168 of legend.
    assert picture.shape == (168 + 2 * (776 + 84 + 20), 1600, 3)
    panels = [
        picture[248 + 880 * k : 248 + 880 * k + 776, 28 + 782 * m : 28 + 782 * m + 762] for k in (0, 1) for m in (0, 1)
    ]
    red, yellow, faint = ([near(panel, color).sum() for panel in panels] for color in (MISSED, FALSE, FOUND))
    assert red[0] > 100
    assert red[1] == red[3] == 0
    blended = panels[2][..., 0] - panels[2][..., 1] > 100  # points are about as large as pixels
    assert np.count_nonzero(blended) > 1000
    assert yellow[0] == yellow[2] == yellow[3] == 0
    assert yellow[1] > 50
    assert faint[0] > 20
    assert faint[1] > 40
    assert faint[2] + faint[3] < 10  # a few of the ground's edges


@pytest.mark.usefixtures("matplotlib")
def test_no_mistakes_to_draw(scan: np.ndarray) -> None:
    right = some_mistakes(scan, found=(CAR, VAN))
    for scans in ([], [right], [some_mistakes(scan[:0])]):
        picture = pixels(draw_mistakes(scans, title="none"))
        assert picture.shape == (258, 1600, 3)
        assert (picture[180:230] > 200).any()  # the sentence that says so


wild = st.floats(allow_nan=True, allow_infinity=True) | st.sampled_from([0.0, -0.0, 1e30, -1e308, 1e-300, 5.0, 20.0])
wild_boxes = st.builds(
    Box,
    st.sampled_from(["car", "van", "tram", "$x", "", "\udcff"]),
    wild,
    st.tuples(wild, wild, wild),
    st.tuples(wild, wild, wild),
    wild,
)
wild_points = st.lists(
    st.tuples(*[st.floats(width=32) | st.sampled_from([0.0, 8.0, -3.0, 1e30])] * 4), max_size=60
).map(lambda rows: np.array(rows, dtype=np.float32).reshape(-1, 4))


@pytest.mark.usefixtures("matplotlib")
@settings(max_examples=6)
@given(wild_points, st.lists(wild_boxes, max_size=8))
def test_anything_is_drawn(tmp_path_factory: pytest.TempPathFactory, points: np.ndarray, boxes: list[Box]) -> None:
    folder = tmp_path_factory.mktemp("drawn")
    n = len(points)
    labels = PointLabels((np.arange(n) % 4).astype(np.uint8), np.ones(n, bool), POINT_CLASSES)
    perception = replace(a_perception(a_scan()), n_points=n, points=labels, boxes=tuple(boxes))
    assert pixels(view.draw(perception, points)).shape[1] == 1600
    write_html(perception, points, folder / "page.html")
    write_ply(perception, points, folder / "points.ply")
    assert flatten_scan(points, perception)
    mistakes = some_mistakes(points, found=tuple(boxes), missed=tuple((box, 3) for box in boxes), false=tuple(boxes))
    assert pixels(draw_mistakes([mistakes])).shape[1] == 1600


def test_boxes_reach_behind_the_camera(scan: np.ndarray, perception: Perception) -> None:
    pytest.importorskip("matplotlib")
    long = Box("truck", 0.5, (0.0, 0.0, 0.0), (60.0, 3.0, 3.0), 0.0)
    picture = pixels(view.draw(replace(perception, boxes=(long,)), scan))
    assert near(picture[128:648, 560:], "truck").sum() > 200


@pytest.mark.usefixtures("matplotlib")
@settings(max_examples=30)
@given(st.text(max_size=120), st.floats(60.0, 900.0))
def test_wrapped_text_is_whole_and_fits(text: str, width: float) -> None:
    figure = new_figure(1000, 100)
    lines = wrap(figure, text, width, fontsize=13.0)
    assert "".join("".join(lines).split()) == "".join(text.split())
    assert len(lines) <= len(text)
    for line in lines:
        assert shorten(figure, line, width, fontsize=13.0) == line
    assert not figure.texts


rectangles = st.tuples(st.floats(0, 950), st.floats(0, 550), st.floats(0.5, 300), st.floats(0.5, 300)).map(
    lambda r: (r[0], r[1], min(r[0] + r[2], 1000.0), min(r[1] + r[3], 600.0))
)


@given(rectangles, st.lists(rectangles, max_size=12), st.floats(5, 120), st.floats(5, 20))
def test_free_place_is_free(area: Any, others: Any, width: float, height: float) -> None:
    half, taken = np.array([width, height]), np.array([area, *others])
    found = free_place(area, half, taken, (0.0, 0.0, 1000.0, 600.0))
    if found is None:
        return
    middle, apart = found
    low, high = middle - half, middle + half
    assert (low >= 0.0).all()
    assert (high <= [1000.0, 600.0]).all()
    assert not ((taken[:, :2] < high).all(axis=1) & (taken[:, 2:] > low).all(axis=1)).any()
    assert apart == pytest.approx(np.hypot(*np.maximum(0.0, np.maximum(taken[0, :2] - high, low - taken[0, 2:]))))


def test_free_place_is_the_nearest() -> None:
    area, half = (400.0, 300.0, 440.0, 320.0), np.array([30.0, 8.0])
    _, apart = free_place(area, half, np.array([area]), (0.0, 0.0, 1000.0, 600.0))
    assert apart < 6.0
    wall = [(0.0, 200.0, 1000.0, 420.0)]  # above and below are taken, as far as a label may be
    assert free_place(area, half, np.array([area, *wall]), (0.0, 0.0, 1000.0, 600.0))[1] > 80.0
    assert free_place(area, half, np.array([(0.0, 0.0, 1000.0, 600.0)]), (0.0, 0.0, 1000.0, 600.0)) is None


@pytest.mark.usefixtures("matplotlib")
def test_labels_lie_on_nothing() -> None:
    rng = np.random.default_rng(3)
    figure = new_figure(900, 700)
    axes = add_axes(figure, 20, 20, 860, 660)
    corner = rng.uniform(30, 600, (30, 2))
    areas = np.hstack([corner, corner + rng.uniform(10, 60, (30, 2))])
    n_omitted = place_labels(axes, [Label(tuple(area), f"car {k}", "#ffffff") for k, area in enumerate(areas)])
    texts = [text.get_window_extent() for text in figure.texts]
    assert len(texts) + n_omitted == 30
    assert len(texts) >= 15
    for a, b in itertools.combinations(texts, 2):
        assert not a.overlaps(b)
    for text in texts:
        assert not any(text.x0 < x1 and x0 < text.x1 and text.y0 < y1 and y0 < text.y1 for x0, y0, x1, y1 in areas)


def test_classes_differ_for_color_blind_readers() -> None:
    """Distances in CIELAB after the simulation of Machado, Oliveira and Fernandes (2009), severity 1."""
    seen_by = {
        "all": np.eye(3),
        "deuteranopes": [[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]],
        "protanopes": [[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]],
        "tritanopes": [[1.256, -0.077, -0.179], [-0.078, 0.931, 0.148], [0.005, 0.691, 0.304]],
    }
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    srgb = np.array([[int(color[k : k + 2], 16) / 255 for k in (1, 3, 5)] for color in CLASS_COLORS.values()])
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    for who, matrix in seen_by.items():
        xyz = (linear @ np.array(matrix).T).clip(0, 1) @ to_xyz.T / [0.9505, 1.0, 1.089]
        f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
        lab = np.column_stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])])
        for (a, one), (b, other) in itertools.combinations(zip(CLASS_COLORS, lab, strict=True), 2):
            assert np.linalg.norm(one - other) > 20.0, (who, a, b)


def test_pictures_are_drawn_on_the_ground_of_the_perception() -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform((-15.0, -15.0), (15.0, 15.0), (3000, 2))
    points = np.column_stack([xy, -1.7 + 0.03 * xy[:, 0] - 0.01 * xy[:, 1], np.zeros(3000)]).astype(np.float32)
    seen = Perception(3000, 0, None, None, (), {}, {}, (), None, ground=fit_ground(points).surface())
    assert ground_plane(seen, points[:0]) == pytest.approx((-1.7, 0.03, -0.01), abs=0.01)
    unknown = replace(seen, ground=None)
    assert ground_plane(unknown, points) == ground_plane(seen, points)
    assert ground_plane(unknown, points[:0]) == (-1.73, 0.0, 0.0)


def opened(browser: Any, path: Path, **how: Any) -> tuple[Any, list[str]]:
    """A page, and what went wrong on it: errors, messages, and requests for anything but the page."""
    wrong: list[str] = []
    page = browser.new_page(**how)
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("console", lambda message: wrong.append(message.text))
    page.on("request", lambda request: request.url == path.as_uri() or wrong.append(request.url))
    page.goto(path.as_uri())
    page.wait_for_timeout(100)
    return page, wrong


def has_webgl(page: Any) -> bool:
    """Whether the browser draws the scan."""
    return bool(page.evaluate("!!document.createElement('canvas').getContext('webgl')"))


def opened_in_webgl(browser: Any, path: Path, **how: Any) -> tuple[Any, list[str]]:
    """As `opened`, where the browser draws the scan."""
    page, wrong = opened(browser, path, **how)
    if not has_webgl(page):
        pytest.skip("this browser has no WebGL")
    return page, wrong


def test_page_shows_and_hides(scan: np.ndarray, perception: Perception, browser: Any, tmp_path: Path) -> None:
    write_html(perception, scan, tmp_path / "page.html", title="a <b>scan</b>")
    page, wrong = opened_in_webgl(browser, tmp_path / "page.html", viewport={"width": 1000, "height": 700})
    assert page.inner_text("h1") == "a <b>scan</b>"

    def shown(name: str) -> int:
        page.wait_for_timeout(300)
        return int(near(pixels(page.screenshot()), name)[:, 340:].sum())

    assert shown("pedestrian") > 20
    page.get_by_label(re.compile("^pedestrian")).uncheck()
    assert shown("pedestrian") == 0
    assert shown("van") > 20
    page.keyboard.press("b")
    assert shown("van") == 0
    assert not page.get_by_label("boxes", exact=True).is_checked()
    page.get_by_label("road surface").uncheck()
    page.keyboard.press("a")
    page.get_by_role("button", name="height").click()
    assert shown("drivable") == 0
    page.close()
    assert not wrong


@pytest.mark.usefixtures("matplotlib")
def test_every_class_has_its_color_in_an_animation(scan: np.ndarray, perception: Perception) -> None:
    image, tracker = pytest.importorskip("PIL.Image"), Tracker()
    found = replace(perception.require_points(), classes=("background", "car", "Building"))
    flat = flatten_scan(scan, replace(perception, points=found))
    tracks = [tracker.update([replace(CAR, label="Car"), replace(VAN, label="bus")], 0.1 * k) for k in range(4)]
    with image.open(io.BytesIO(draw_tracks(tracks, under=[flat] * 4))) as animation:
        animation.seek(3)
        picture = np.asarray(animation.convert("RGB")).astype(np.int16)
    walker = picture[334:374, 330:350]  # at x = 12, y = -3
    assert near(walker, "#7b6152").sum() > 5  # brown, as the picture and the page have it, on a dark panel
    assert not near(walker, "#dadbdc").any()
    assert [near(picture[604:, :400], color).sum() > 80 for color in ("car", "#ffffff", "van")] == [True, True, False]


@pytest.mark.parametrize("mounting", [MODEL_MOUNTING, Mounting(2.1, 180.0, 3.0, -90.0)])
def test_tracks_lie_on_the_scan(
    scan: np.ndarray, perception: Perception, tmp_path: Path, mounting: Mounting, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = pytest.importorskip("PIL.Image")
    tracker, frame = Tracker(), ModelFrame(mounting)
    cars = frame.boxes_back(replace(CAR, center=(20.0 + 0.8 * k, 3.0, -0.9), yaw=0.0) for k in range(6))
    tracks = [tracker.update([car], 0.1 * (k + 1), mounting=mounting) for k, car in enumerate(cars)]
    flat, mountings = flatten_scan(frame.move_back(scan), replace(perception, mounting=mounting)), [mounting] * 6
    path = tmp_path / "tracks.gif"
    content = draw_tracks(tracks, path, under=[flat] * 6, mountings=mountings, title="a drive \udcff")
    bare = draw_tracks(tracks, mountings=mountings, title="a drive")
    with pytest.raises(OptionError, match=r"drive.mp4 would hold a picture in .gif"):
        draw_tracks(tracks, path.with_name("drive.mp4"))
    assert path.read_bytes() == content

    def last(gif: bytes) -> np.ndarray:
        with image.open(io.BytesIO(gif)) as animation:
            assert (animation.size, animation.n_frames) == ((960, 642), 6)
            animation.seek(5)
            return np.asarray(animation.convert("RGB")).astype(np.int16)

    with_scan, alone = last(content), last(bare)
    monkeypatch.setattr("edgeperc.view.tracks.AT_ONCE", 4)  # a long drive is written in parts
    np.testing.assert_array_equal(last(draw_tracks(tracks, mountings=mountings, title="a drive")), alone)
    assert near(alone, "car").sum() > 150  # the box, at x = 24, y = 3: pixel 460, 294
    assert near(alone[270:318, 420:500], "car").sum() > 100
    road = np.abs(with_scan - alone).sum(axis=2)[44:604] > 30
    assert road[240:320, 285:600].mean() > 0.5  # 6 to 46 m ahead, 4 m to each side
    assert not road[:100].all()
    with pytest.raises(TrackingError, match="one for each"):
        draw_tracks(tracks, under=[flat])


@pytest.mark.parametrize("mounting", [MODEL_MOUNTING, Mounting(2.1, 180.0, 3.0, -90.0)])
def test_an_arrow_ends_where_its_track_will_be(mounting: Mounting) -> None:
    image = pytest.importorskip("PIL.Image")
    tracker, frame, pose = Tracker(), ModelFrame(mounting), np.eye(4)
    pose[:3, :3] = frame.R
    turns = [0.05 * k for k in range(20)]  # a circle with a radius of 16 m, at 8 m/s
    cars = [replace(CAR, center=(20.0 + 16.0 * math.sin(a), -16.0 * math.cos(a), -0.9), yaw=a) for a in turns]
    tracks = [tracker.update(frame.boxes_back([car]), 0.1 * k, pose) for k, car in enumerate(cars)]
    with image.open(io.BytesIO(draw_tracks(tracks, mountings=[mounting] * 20))) as animation:
        animation.seek(19)
        picture = np.asarray(animation.convert("RGB")).astype(np.int16)
    (track,) = tracks[-1]
    (now, ahead) = frame.move_boxes([track.box, track.predicted(0.95)])
    straight = np.add(now.center, [7.6 * math.cos(now.yaw), 7.6 * math.sin(now.yaw), 0.0])
    assert math.dist(ahead.center, straight) > 1.5
    for (x, y, _), is_there in ((ahead.center, True), (straight, False)):
        row, column = round(44 + 10 * (28 - y)), round(10 * (x + 22))
        assert near(picture[row - 2 : row + 3, column - 2 : column + 3], INK).any() == is_there
