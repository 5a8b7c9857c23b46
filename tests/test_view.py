from __future__ import annotations

import base64
import io
import json
import re
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest

from edgeperc.errors import MissingExtraError, PointsError
from edgeperc.evaluation.mistakes import Mistakes
from edgeperc.perception import Box, Perception, PointLabels, TopView
from edgeperc.simulation.shapes import _paint
from edgeperc.view import picture as view
from edgeperc.view.colours import CLASS_COLOURS, FALSE, FOUND, MISSED
from edgeperc.view.files import write_labels, write_ply
from edgeperc.view.mistakes import draw_mistakes
from edgeperc.view.page import write_html

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
        top_view=TopView(cells, TOP_CLASSES, 0.1, (6.0, 46.0), (-10.0, 10.0)),
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


def near(picture: np.ndarray, name: str, tolerance: int = 12) -> np.ndarray:
    wanted = [int(CLASS_COLOURS[name][k : k + 2], 16) for k in (1, 3, 5)]
    return (np.abs(picture - wanted) <= tolerance).all(axis=2)


@pytest.mark.usefixtures("matplotlib")
def test_picture_shows_classes_where_they_are(scan: np.ndarray, perception: Perception) -> None:
    picture = pixels(view.draw(scan, perception, title="a scan"))
    assert picture.shape == (1000, 1600, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 500
    # The top view spans 40 m by 20 m from pixel column 66 and row 78 on, 21.3 pixels a metre.
    for box in (CAR, VAN):
        row, col = 78 + (46.0 - box.center[0]) * 21.3, 66 + (10.0 - box.center[1]) * 21.3
        around = near(picture[int(row) - 60 : int(row) + 60, int(col) - 60 : int(col) + 60], box.label)
        assert around.sum() > 100, box.label
        empty = picture[80:200, 380:480]
        assert not near(empty, box.label).any()
    # The range image lies above, the view from behind below: a pedestrian shows in both, right of the middle.
    right_half = near(picture, "pedestrian")[:, 1050:]
    assert right_half[78:304].sum() > 20
    assert right_half[318:838].sum() > 20
    # Legend squares.
    assert all(near(picture[850:910], name).sum() > 60 for name in {*POINT_CLASSES, *TOP_CLASSES})


@pytest.mark.usefixtures("matplotlib")
def test_picture_of_one_view(scan: np.ndarray, perception: Perception) -> None:
    points_alone = pixels(view.draw(scan, replace(perception, top_view=None, boxes=())))
    assert near(points_alone, "pedestrian").sum() > 100
    assert not near(points_alone, "drivable").any()
    top_alone = pixels(view.draw(scan, replace(perception, points=None)))
    assert near(top_alone, "van").sum() > 100
    assert not near(top_alone, "pedestrian").any()
    assert (points_alone[100:800, 30:480] != top_alone[100:800, 30:480]).any()


@pytest.mark.usefixtures("matplotlib")
def test_picture_is_the_same_again_and_in_other_threads(scan: np.ndarray, perception: Perception) -> None:
    wanted = view.draw(scan, perception)
    got: list[bytes] = []
    threads = [threading.Thread(target=lambda: got.append(view.draw(scan, perception))) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [png == wanted for png in got] == [True, True, True]


@pytest.mark.parametrize("n", [0, 1])
@pytest.mark.usefixtures("matplotlib")
def test_tiny_scans(n: int, tmp_path, scan: np.ndarray) -> None:
    whole = a_perception(scan)
    for points in (scan[:n], np.full((n, 4), np.nan, dtype=np.float32)):
        labels = PointLabels(np.zeros(n, np.uint8), np.zeros(n, bool), POINT_CLASSES)
        perception = replace(whole, n_points=n, points=labels, stage_ms={}, providers={}, fitness=())
        assert pixels(view.draw(points, perception)).shape == (1000, 1600, 3)
        write_html(points, perception, tmp_path / "page.html")
        write_ply(points, perception, tmp_path / "points.ply")
        write_labels(perception, tmp_path / "points.label")
        assert (tmp_path / "points.label").stat().st_size == 4 * n


@pytest.mark.usefixtures("matplotlib")
def test_strange_titles_and_classes(scan: np.ndarray, perception: Perception, tmp_path) -> None:
    strange = "$\\frac{ <script>alert(1)</script> 走 \n \udcff @@SCENE@@" + "x" * 200
    classes = (*POINT_CLASSES[:3], "</script> & tram\nelement vertex 3")
    perception = replace(perception, points=replace(perception.points, classes=classes))
    assert pixels(view.draw(scan, perception, title=strange)).shape == (1000, 1600, 3)
    write_html(scan, perception, tmp_path / "page.html", title=strange)
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert text.count("<script") == 2
    assert text.count("</script>") == 2
    assert "&lt;script&gt;alert(1)" in text
    write_ply(scan, perception, tmp_path / "points.ply")
    header = (tmp_path / "points.ply").read_bytes().split(b"end_header\n")[0].decode().splitlines()
    assert [line for line in header if line.startswith("element")] == [f"element vertex {len(scan)}"]


@pytest.mark.usefixtures("matplotlib")
def test_file_is_replaced_whole(scan: np.ndarray, perception: Perception, tmp_path) -> None:
    target = tmp_path / "scan.png"
    target.write_bytes(b"old")
    png = view.draw(scan, perception, target)
    assert target.read_bytes() == png
    with pytest.raises(OSError, match="absent"):
        view.draw(scan, perception, tmp_path / "absent" / "scan.png")
    folder = tmp_path / "scan.label"
    folder.mkdir()
    with pytest.raises(OSError, match=r"scan\.label"):
        write_labels(perception, folder)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["scan.label", "scan.png"]


def test_html_holds_every_finite_point_and_no_address(scan: np.ndarray, perception: Perception, tmp_path) -> None:
    bright = scan * np.array([1, 1, 1, 200], dtype=np.float32)
    write_html(bright, perception, tmp_path / "page.html", title="a scan")
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert not re.search(r"https?:|src=|@@", text)
    scene = json.loads(re.search(r'type="application/json">(.*?)</script>', text, re.DOTALL).group(1))
    xyz = np.frombuffer(base64.b64decode(scene["xyz"]), dtype="<f4").reshape(-1, 3)
    label = np.frombuffer(base64.b64decode(scene["label"]), dtype=np.uint8)
    remission = np.frombuffer(base64.b64decode(scene["remission"]), dtype=np.uint8)
    np.testing.assert_array_equal(xyz, scan[:-1, :3])
    assert len(remission) == len(label) == len(xyz)
    assert remission.max() == 255
    names = [one["name"] for one in scene["classes"]]
    assert names == [*POINT_CLASSES, "drivable", "van", "truck"]
    assert (label[6000:6600] == names.index("car")).all()
    road = label == names.index("drivable")
    assert road.sum() > 100
    assert (np.abs(xyz[road, 1]) <= 4.01).all()
    assert scene["ground"] == pytest.approx(-1.73, abs=0.01)
    words = {one["name"]: one["words"] for one in scene["classes"]}
    assert words["drivable"] == f"{perception.top_view.drivable_area_m2:.0f} m²"
    assert words["car"] == "600 points, 1 box"
    assert words["van"] == "1 box"
    corners = np.array(scene["boxes"][0]["corners"])
    np.testing.assert_allclose(corners.mean(axis=0), CAR.center, atol=2e-3)
    assert np.ptp(corners[:, 2]) == pytest.approx(CAR.size[2], abs=2e-3)


def test_leaves_above_the_road_are_not_road(perception: Perception) -> None:
    points = np.array([[20.0, 0.0, -1.7, 0.1]] * 60 + [[20.0, 0.0, 2.0, 0.1]], dtype=np.float32)
    bare = PointLabels(np.zeros(61, np.uint8), np.ones(61, bool), POINT_CLASSES)
    names, painted = _paint(points, replace(perception, n_points=61, points=bare))
    assert (painted[:60] == names.index("drivable")).all()
    assert painted[60] == 0


def test_ply_reads_back(scan: np.ndarray, perception: Perception, tmp_path) -> None:
    write_ply(scan, perception, tmp_path / "points.ply")
    header, body = (tmp_path / "points.ply").read_bytes().split(b"end_header\n", 1)
    kinds = {"float": "<f4", "uchar": "u1"}
    properties = re.findall(r"property (\w+) (\w+)", header.decode("ascii"))
    rows = np.frombuffer(body, dtype=[(name, kinds[kind]) for kind, name in properties])
    assert rows.dtype.names == ("x", "y", "z", "remission", "label", "red", "green", "blue")
    assert len(rows) == len(scan)
    for k, name in enumerate(("x", "y", "z", "remission")):
        np.testing.assert_array_equal(rows[name], scan[:, k])
    np.testing.assert_array_equal(rows["label"], perception.points.labels)
    car = rows[rows["label"] == 1][0]
    assert "#{:02x}{:02x}{:02x}".format(*(car[c] for c in ("red", "green", "blue"))) == CLASS_COLOURS["car"]


def test_labels_are_semantickitti_ids(scan: np.ndarray, perception: Perception, tmp_path) -> None:
    labels = np.arange(len(scan), dtype=np.uint8) % 4
    named = replace(perception.points, labels=labels, classes=("background", "car", "cyclist", "tram"))
    write_labels(replace(perception, points=named), tmp_path / "scan.label")
    raw = np.fromfile(tmp_path / "scan.label", dtype="<u4")
    np.testing.assert_array_equal(raw, np.array([0, 10, 31, 99])[labels])


def test_refusals(scan: np.ndarray, perception: Perception, tmp_path) -> None:
    top_alone = replace(perception, points=None)
    with pytest.raises(PointsError, match="pointseg"):
        write_labels(top_alone, tmp_path / "a.label")
    with pytest.raises(PointsError, match="pointseg"):
        write_ply(scan, top_alone, tmp_path / "a.ply")
    for writer in (write_html, write_ply, view.draw):
        with pytest.raises(PointsError, match="expected the scan that was perceived"):
            writer(scan[1:], perception, tmp_path / "a")
        with pytest.raises(PointsError, match=r"\(n, 4\)"):
            writer(scan[:, :3], perception, tmp_path / "a")
    assert not list(tmp_path.iterdir())


def test_missing_matplotlib_names_the_line(scan: np.ndarray, perception: Perception, monkeypatch) -> None:
    for name in ("matplotlib", "matplotlib.figure", "matplotlib.backends.backend_agg"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingExtraError, match=r"pip install 'edgeperc\[view\]'"):
        view.draw(scan, perception)


def test_import_loads_no_matplotlib() -> None:
    code = "import edgeperc.view.picture, sys; sys.exit(any(m.startswith(('matplotlib', 'PIL')) for m in sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.usefixtures("matplotlib")
def test_drawing_uses_no_pyplot(scan: np.ndarray, perception: Perception) -> None:
    before = "matplotlib.pyplot" in sys.modules
    view.draw(scan, perception)
    assert ("matplotlib.pyplot" in sys.modules) == before


def some_mistakes(points: np.ndarray, **given) -> Mistakes:
    return Mistakes("000123", "drive_0011", points, np.zeros(len(points), np.uint8), **given)


def amount(picture: np.ndarray, colour: str) -> int:
    wanted = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
    return int((np.abs(picture - wanted) <= 12).all(axis=2).sum())


def test_mistakes_in_words(scan: np.ndarray) -> None:
    told = some_mistakes(scan, missed=((CAR, 300), (VAN, 1040), (CAR, 5)), false=(VAN,), wrong_share=0.25)
    assert told.words == "missed: 2 car, 1 van (1,345 points); false: 1 van"
    assert told.n_errors == 4.25
    assert some_mistakes(scan, found=(CAR,)).words == "no box missed or false"
    assert some_mistakes(scan, false=(CAR,)).words == "false: 1 car"


@pytest.mark.usefixtures("matplotlib")
def test_mistakes_are_drawn(scan: np.ndarray, tmp_path) -> None:
    right = some_mistakes(scan, found=(CAR, VAN))
    missed = some_mistakes(scan, found=(CAR,), missed=((VAN, 300),))
    false = some_mistakes(scan, found=(CAR, VAN), false=(replace(CAR, center=(40.0, -12.0, -1.0)),))
    points = replace(right, wrong=np.where(np.arange(len(scan)) < 3000, 1, 0).astype(np.uint8))
    png = draw_mistakes([right, missed, false, points], tmp_path / "worst.png", title="a title", columns=2)
    assert (tmp_path / "worst.png").read_bytes() == png
    picture = pixels(png)
    assert picture.shape == (80 + 2 * 520, 2 * 470, 3)
    panels = [picture[80 + 520 * k : 600 + 520 * k, 470 * m : 470 * m + 470] for k in (0, 1) for m in (0, 1)]
    red, orange = ([amount(panel, colour) for panel in panels] for colour in (MISSED, FALSE))
    assert red[0] == red[2] == 0
    assert red[1] > 50
    blended = panels[3][..., 0] - panels[3][..., 1] > 100  # points are smaller than pixels
    assert np.count_nonzero(blended) > 500
    assert orange[0] == orange[1] == orange[3] == 0
    assert orange[2] > 50
    assert all(amount(panel, FOUND) > 50 for panel in panels)


@pytest.mark.usefixtures("matplotlib")
def test_no_mistakes_to_draw(scan: np.ndarray) -> None:
    assert pixels(draw_mistakes([], title="none")).ndim == 3
    assert pixels(draw_mistakes([some_mistakes(scan[:0])])).ndim == 3


def test_mistakes_need_matplotlib(monkeypatch: pytest.MonkeyPatch, scan: np.ndarray) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    monkeypatch.setitem(sys.modules, "matplotlib.backends.backend_agg", None)
    with pytest.raises(MissingExtraError, match=r"edgeperc\[view\]"):
        draw_mistakes([some_mistakes(scan)])
