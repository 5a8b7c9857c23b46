"""The top-view database: its contents, equal results of all ways to build it, and drawing of roads."""

from __future__ import annotations

import csv
import hashlib
import random
import shutil
import signal
import subprocess
import sys
import time
import tracemalloc
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

Image = pytest.importorskip("PIL.Image")
coco_mask = pytest.importorskip("faster_coco_eval.core.mask")
for package in ("filelock", "tqdm", "onnx", "onnxruntime"):
    pytest.importorskip(package)
shapely = pytest.importorskip("shapely")

from database_helpers import INPUT, TRAPEZIUM, drawn, plan_of, road_network
from shapely import Polygon

import twins.database
from cli_helpers import Shell
from edgeperc.datasets.kitti import KittiObjects, scan_hash
from edgeperc.errors import CardMismatchError
from edgeperc.inference.projection import make_projector
from edgeperc.simulation.samples import IGNORE
from edgeperc.system.atomic import write_atomic
from edgeperc.types.card import ModelCard
from edgeperc.types.perception import Box
from edgeperc.types.views import TopViewGeometry
from edgeperc_export.cli import main
from edgeperc_export.data.roads import CLASSES, VIEW, DatabaseError, mask_of, read_coco, write_coco
from edgeperc_export.database import build as build_module
from edgeperc_export.database import scenes as scenes_module
from edgeperc_export.database.build import build, folds
from edgeperc_export.database.coco import draft, varied
from edgeperc_export.database.files import (
    TopViewDatabase,
    picture,
    read_labels,
    road_and_vehicles,
    vehicles,
    write_labels,
)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(road_network(tmp_path_factory.mktemp("model") / "low.onnx", TopViewGeometry()))


@pytest.fixture(scope="module")
def polygons(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Roads of a training scene and of a test scene."""
    path = tmp_path_factory.mktemp("drawn") / "road.json"
    path.write_text(write_coco({"000001": [TRAPEZIUM], "000007": [TRAPEZIUM]}))
    return path


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory, kitti: Path, model: str, polygons: Path) -> Path:
    folder = tmp_path_factory.mktemp("database") / "out"
    report = build(plan_of(kitti, folder, model), polygons=[polygons], workers=1)
    assert (report.scenes, report.made, report.kept, report.skipped) == (8, 8, 0, {})
    return folder


def contents(root: Path) -> dict[str, str]:
    """Every file below a folder, and the hash of its content."""
    files = (path for path in sorted(root.rglob("*")) if path.is_file())
    return {str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def with_edges(rng: np.random.Generator, n: int) -> np.ndarray:
    points = rng.uniform([4, -12, -3, -0.2], [48, 12, 3, 1.2], (n, 4)).astype(np.float32)
    points[: n // 2, :2] = np.round(points[: n // 2, :2] * 20) / 20  # on the cells' middles and edges
    points[n // 3 : n // 2, 2] = np.round(points[n // 3 : n // 2, 2])  # equally high
    return points


@pytest.mark.parametrize("n", [0, 1, 5000])
def test_a_picture_equals_its_twin(n: int) -> None:
    points = with_edges(np.random.default_rng(n), n)
    np.testing.assert_array_equal(picture(points), twins.database.picture(points))


@settings(max_examples=30)
@given(hnp.arrays(np.float32, st.tuples(st.integers(0, 6), st.just(4)), elements=st.floats(width=32)))
def test_a_picture_of_any_points_equals_its_twin(points: np.ndarray) -> None:
    np.testing.assert_array_equal(picture(points), twins.database.picture(points))


def test_meters_are_rounded_and_clamped() -> None:
    """Section 3.1: round to the nearest pixel, then clamp to 0..399 and 0..199."""
    for (x, y), (row, col) in {
        (6.04, 0.0): (399, 99), (6.06, 0.0): (398, 99), (45.94, 0.0): (0, 99), (46.0, 0.0): (0, 99),
        (20.0, 10.0): (259, 0), (20.0, 9.94): (259, 0), (20.0, -10.0): (259, 199), (20.0, -9.94): (259, 198),
    }.items():  # fmt: skip
        image = picture(np.array([[x, y, 0.0, 0.5]], np.float32))
        assert np.argwhere(image[..., 0]).tolist() == [[row, col]], (x, y)
        assert image[row, col].tolist() == [round(255 * np.hypot(x, y) / np.hypot(46, 10)), 128, 128]
    assert not picture(
        np.array([[5.99, 0, 0, 1], [46.01, 0, 0, 1], [20, 0, 2.6, 1], [20, 10.1, 0, 1]], np.float32)
    ).any()


def test_the_highest_point_wins_and_the_first_of_equals() -> None:
    points = np.array([[20, 0, -1, 0.1], [20, 0, 1, 0.2], [20, 0, 1, 0.3], [20, 0, 0, 0.4]], np.float32)
    assert picture(points)[259, 99, 2] == round(255 * 0.2)


def test_a_card_with_the_databases_view_has_its_cells() -> None:
    points = with_edges(np.random.default_rng(1), 20_000)[:10_000]
    points = points[(points[:, 0] >= 6.0) & (points[:, 0] < 45.9) & (np.abs(points[:, 1]) < 9.9)]
    points[:, 2], points[:, 3] = np.clip(points[:, 2], -2.5, 2.5), np.clip(points[:, 3], 0, 1)
    points[:, :2] += np.float32(0.013)  # off the edges, where float32 and float64 may differ
    seen = make_projector(VIEW, INPUT).project(points)
    image = picture(points)
    np.testing.assert_array_equal(image[..., 0] > 0, seen.index >= 0)
    np.testing.assert_allclose(image[..., 0] / 255, seen.image[0], atol=0.6 / 255)


def footprints(kitti: Path, name: str) -> list[tuple[str, Polygon]]:
    """Vehicles' footprints in pixels of the map, computed differently, from KITTI's files: 3-D corners to polygons."""
    lines = (kitti / "training/calib" / f"{name}.txt").read_text().splitlines()
    numbers = {key: np.array(rest.split(), float) for key, _, rest in (line.partition(":") for line in lines if line)}
    R, T = numbers["R0_rect"].reshape(3, 3), numbers["Tr_velo_to_cam"].reshape(3, 4)
    found = []
    for line in (kitti / "training/label_2" / f"{name}.txt").read_text().splitlines():
        kind, *values = line.split()
        if kind not in ("Car", "Van", "Truck"):
            continue
        h, w, l, x, y, z, ry = (float(v) for v in values[7:14])  # noqa: E741
        c, s = np.cos(ry), np.sin(ry)
        local = np.array([[l, -l, -l, l], [-h, -h, -h, -h], [w, w, -w, -w]]) / 2
        camera = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ local + np.array([[x], [y], [z]])
        velo = T[:, :3].T @ (R.T @ camera - T[:, 3:])
        # The center of pixel (row, col) is x = 6.0 + 0.1 (399 - row), y = -10.0 + 0.1 (199 - col).
        col, row = 199.5 - (velo[1] + 10.0) / 0.1, 399.5 - (velo[0] - 6.0) / 0.1
        found.append((kind.lower(), Polygon(np.stack([col, row], 1))))
    return found


def disagreements(kitti: Path, name: str, labels: np.ndarray) -> tuple[int, int]:
    """Cells that are wrong, and vehicle cells compared: all cells that no outline crosses."""
    whole, touched = np.zeros((5, 400, 200), bool), np.zeros((400, 200), bool)
    rows, cols = np.mgrid[:400, :200]
    for kind, polygon in footprints(kitti, name):
        left, top, right, bottom = polygon.bounds
        window = np.s_[max(int(top) - 1, 0) : max(int(bottom) + 2, 0), max(int(left) - 1, 0) : max(int(right) + 2, 0)]
        shapely.prepare(polygon)
        cells = shapely.box(cols[window], rows[window], cols[window] + 1, rows[window] + 1)
        inside = shapely.contains_properly(polygon, cells)
        whole[CLASSES.index(kind)][window] |= inside
        touched[window] |= shapely.intersects(polygon, cells) & ~inside
    # Where two vehicles overlap, either may be drawn; the outline of one inside the other is not compared either.
    right = np.take_along_axis(whole, labels[None].astype(np.int64), 0)[0]
    wrong = np.where(whole.any(0), ~right, labels >= 2) & ~touched
    return int(np.count_nonzero(wrong)), int(np.count_nonzero(whole.any(0) & ~touched))


def test_maps_show_the_boxes(kitti: Path, out: Path) -> None:
    compared = 0
    for scene in TopViewDatabase(out):
        wrong, cells = disagreements(kitti, scene.name, scene.map)
        assert wrong == 0, scene.name
        compared += cells
    assert compared > 10_000


def test_maps_of_real_scans_show_the_boxes(kitti_root: Path) -> None:
    """Vehicles only: the roads come from a model."""
    objects, compared = KittiObjects(kitti_root), 0
    names = [*objects.grades][::4]
    for name in names:
        boxes = vehicles(objects.frame(name).boxes)
        wrong, cells = disagreements(kitti_root, name, road_and_vehicles(np.zeros((400, 200)), boxes))
        assert wrong == 0, name
        compared += cells
    assert len(names) >= 57
    assert compared > 25_000


def test_labels_match_the_map(out: Path) -> None:
    kinds: Counter[str] = Counter()
    for scene in TopViewDatabase(out):
        text = (out / "labels" / f"{scene.name}.txt").read_text()
        assert write_labels(scene.boxes) == text
        assert vehicles(scene.boxes) == scene.boxes  # all of them reach into the view
        redrawn = road_and_vehicles(scene.map == 1, scene.boxes)
        np.testing.assert_array_equal(redrawn, scene.map)
        assert scene.rectangles.shape == (len(scene.boxes), 5)
        kinds.update(box.label for box in scene.boxes)
    assert {*kinds} == {"car", "van", "truck"}


@pytest.mark.parametrize("size", [(0.0, 2.0, 1.0), (4.0, float("nan"), 1.0), (4.0, 1e9, 1.0)])
def test_an_impossible_vehicle_is_named(size: tuple[float, float, float]) -> None:
    with pytest.raises(DatabaseError, match="a van is"):
        vehicles([Box("van", 1.0, (20.0, 0.0, 0.0), size, 0.0)])


def test_pedestrians_and_vehicles_out_of_view_are_left_out() -> None:
    seen = Box("car", 1.0, (20.0, 0.0, -1.0), (4.0, 1.8, 1.5), 0.3)
    boxes = [seen, replace(seen, label="pedestrian"), replace(seen, center=(80.0, 0.0, 0.0))]
    assert [b.label for b in vehicles(boxes)] == ["car"]


def test_three_folders_with_equal_names_and_an_index(out: Path, kitti: Path) -> None:
    names = [f"{k:06d}" for k in range(8)]
    for folder in ("images", "labels", "maps"):
        assert sorted(path.stem for path in (out / folder).iterdir()) == names
    database = TopViewDatabase(out)
    assert database.names == names
    assert not database.damaged()
    manifest = database.manifest
    assert manifest["scenes"] == 8
    assert manifest["counts"]["train"] == 7
    assert [model["name"] for model in manifest["road_models"]] == ["low"]
    for scene, row in zip(database, database.rows, strict=True):
        counts = np.bincount(scene.map.ravel(), minlength=5)
        assert [int(row[f"{name}_cells"]) for name in CLASSES[1:]] == counts[1:].tolist()
        assert int(row["points"]) * 16 == (kitti / "training/velodyne" / f"{scene.name}.bin").stat().st_size
        assert int(row["cells_returned"]) == np.count_nonzero(scene.image.any(axis=2)) > 1000
        assert row["road"] == ("polygons" if scene.name in ("000001", "000007") else "model")


def test_drives_are_not_divided_and_test_drives_are_separate(out: Path) -> None:
    whole = TopViewDatabase(out)
    assert [row["scene"] for row in whole.rows if row["split"] == "test"] == ["000007"]
    assert {row["fold"] for row in whole.rows} == {"", "0", "1", "2", "3", "4"}
    for fold in range(5):
        parts = [
            {row["drive"] for row in TopViewDatabase(out, split, fold).rows}
            for split in ("train", "validation", "test")
        ]
        assert all(parts)
        assert not parts[0] & parts[1] | parts[0] & parts[2] | parts[1] & parts[2]
    assert len(TopViewDatabase(out, "train")) == 7
    assert len(TopViewDatabase(out, "validation")) == 0
    sizes = Counter(folds([f"d{k}" for k in range(23)] * 4).values())
    assert {*sizes.values()} == {4, 5}


def test_the_road_model_has_the_databases_cells(out: Path, kitti: Path) -> None:
    """Points above the network's threshold are no road, in the same cells as in the image."""
    for scene in TopViewDatabase(out):
        if scene.name in ("000001", "000007"):
            continue
        ground = scene.map < 2
        low = scene.image[..., 1] / 255 * 5 - 2.5
        differs = (scene.map == 1) != ((0.7 - 3 * (low + 2.5) / 5 > 0) | (scene.image[..., 0] == 0))
        near = np.abs(0.7 - 3 * (low + 2.5) / 5) < 0.02  # a byte is no float
        # Coordinates on the edge of a cell are rounded in float32 by the model and in float64 by the database.
        assert np.count_nonzero(differs & ground & ~near) < 20, scene.name


def test_drawn_roads_are_used_and_varied(out: Path) -> None:
    drawn = mask_of([[np.ravel(TRAPEZIUM).tolist()]])
    for name, n in {"000001": 4, "000007": 1}.items():  # only training scenes have variations
        scene = TopViewDatabase(out).scene(name)
        ground = scene.map < 2
        np.testing.assert_array_equal(scene.map[ground], drawn[ground])
        assert [path.stem for path in sorted((out / "road/masks").glob(f"{name}-*"))] == [
            f"{name}-{k:02d}" for k in range(n)
        ]
        np.testing.assert_array_equal(np.asarray(Image.open(out / f"road/masks/{name}-00.png")), drawn)
        np.testing.assert_array_equal(np.asarray(Image.open(out / f"road/images/{name}-00.png")), scene.image)
    with (out / "road/index.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows] == ["000001-00", "000001-01", "000001-02", "000001-03", "000007-00"]
    assert len({row["mask_sha256"] for row in rows[1:4]}) == 3


def test_a_variation_moves_image_and_mask_together() -> None:
    mask = mask_of([[np.ravel(TRAPEZIUM).tolist()]])
    distance = picture(with_edges(np.random.default_rng(0), 40_000))[..., 0]
    image = np.stack([distance, mask * 200, mask], axis=2)
    for k in range(6):
        moved, moved_mask, turn_deg, _ = varied(image, mask, "scene", k)
        np.testing.assert_array_equal(moved, varied(image, mask, "scene", k)[0])
        known = moved_mask != IGNORE
        np.testing.assert_array_equal(moved[known, 2], moved_mask[known])
        assert not moved[~known].any()
        # The image is turned about the sensor, so the first channel is still the distance of the cell.
        row, col = np.nonzero(moved[..., 0])
        x, y = 6.0 + 0.1 * (399 - row), -10.0 + 0.1 * (199 - col)
        wrong = np.abs(moved[row, col, 0] / 255 * np.hypot(46, 10) - np.hypot(x, y))
        assert wrong.max() < 0.3
        assert (k == 0) == (turn_deg == 0.0)
    assert {varied(image, mask, "scene", k)[3] for k in range(6)} == {False, True}


def test_torch_reads_it(out: Path) -> None:
    torch = pytest.importorskip("torch")
    from edgeperc_export.database.torch import TopViewDataset

    samples = TopViewDataset(out, "train", 0)
    images, maps = next(iter(torch.utils.data.DataLoader(samples, batch_size=2)))
    assert images.shape == (2, 3, 400, 200)
    assert images.dtype == torch.float32
    assert 0.0 <= images.min() < images.max() <= 1.0
    np.testing.assert_array_equal(maps[1].numpy(), samples.database[1].map)


def test_coco_reads_it(out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["database-coco", str(out), str(tmp_path / "all.json")]) == 0
    from faster_coco_eval import COCO

    coco = COCO(tmp_path / "all.json")
    database = TopViewDatabase(out)
    assert sorted(c["name"] for c in coco.loadCats(coco.getCatIds())) == sorted(CLASSES[1:])
    for image in coco.loadImgs(coco.getImgIds()):
        scene = database.scene(Path(image["file_name"]).stem)
        annotations = coco.loadAnns(coco.getAnnIds(imgIds=image["id"]))
        assert len(annotations) == len(scene.boxes) + (scene.map == 1).any()
        drawn = np.zeros((400, 200), np.uint8)
        for a in annotations:
            mask = coco.annToMask(a) != 0
            assert np.count_nonzero(mask) == a["area"]
            drawn[mask & (drawn == 0)] = a["category_id"]
        np.testing.assert_array_equal(drawn > 0, scene.map > 0)


def test_wrong_usage_of_the_reader_is_explained(out: Path, tmp_path: Path) -> None:
    with pytest.raises(DatabaseError, match="run edgeperc-export database-build"):
        TopViewDatabase(tmp_path)
    with pytest.raises(ValueError, match="fold is 5"):
        TopViewDatabase(out, "train", 5)
    with pytest.raises(ValueError, match="split is 'dev'"):
        TopViewDatabase(out, "dev")
    with pytest.raises(DatabaseError, match="none of the 8 scenes is called '9'"):
        TopViewDatabase(out).scene("9")
    (tmp_path / "label.txt").write_text("car 1 2 3\n")
    with pytest.raises(DatabaseError, match="class x y length width yaw"):
        read_labels(tmp_path / "label.txt")
    shutil.copytree(out, tmp_path / "copy")
    (tmp_path / "copy/maps/000002.png").write_bytes(b"no image")
    (tmp_path / "copy/labels/000003.txt").unlink()
    for road in (f"road/masks/{min((out / 'road/masks').iterdir()).name}", "road/index.csv"):
        (tmp_path / "copy" / road).write_bytes(b"cut short")
        assert TopViewDatabase(tmp_path / "copy").damaged() == ["maps/000002.png", "labels/000003.txt", road]
    assert main(["database-check", str(tmp_path / "copy")]) == 1
    with pytest.raises(DatabaseError, match="is not an image"):
        TopViewDatabase(tmp_path / "copy").scene("000002")
    (tmp_path / "copy/index.csv").write_text("scene\n")
    with pytest.raises(DatabaseError, match="does not match the manifest"):
        TopViewDatabase(tmp_path / "copy")
    for text, message in {
        '{"format": 99, "sha256": {"index.csv": ""}}': "has format 99",
        "[]": "not the manifest",
    }.items():
        (tmp_path / "copy/manifest.json").write_text(text)
        with pytest.raises(DatabaseError, match=message):
            TopViewDatabase(tmp_path / "copy")


def test_processes_make_the_same_files(out: Path, kitti: Path, model: str, polygons: Path, tmp_path: Path) -> None:
    build(plan_of(kitti, tmp_path / "out", model), polygons=[polygons], workers=2)
    assert contents(tmp_path / "out") == contents(out)


def test_ray_makes_the_same_files(out: Path, kitti: Path, model: str, polygons: Path, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    command = [sys.executable, "-m", "edgeperc_export.cli", "database-build", str(kitti), str(tmp_path / "out")]
    command += ["--engine", "ray", "--workers", "2", "--road-by", model]
    command += ["--variations", "3", "--polygons", str(polygons)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert contents(tmp_path / "out") == contents(out)


def test_the_road_model_of_a_fold_is_not_trained_on_it(kitti: Path, tmp_path: Path) -> None:
    """Roads of scenes 0, 3 and 7 are drawn. A model's card has the names of its training scenes."""
    torch = pytest.importorskip("torch")
    from edgeperc_export.recipe import Recipe

    torch.set_num_threads(1)
    recipe = Recipe("ssadnet", edge=True, width=0.25, steps=1, batch=1, augment=False, n_pasted=0.0, weather=0.0)
    path = tmp_path / "road.json"
    path.write_text(write_coco({"000000": [TRAPEZIUM], "000003": [TRAPEZIUM], "000007": [TRAPEZIUM]}))
    plan = plan_of(kitti, tmp_path / "out", "train", variations=0)
    report = build(plan, polygons=[path], recipe=recipe, workers=1)
    assert {*report.scores} == {"train", "test"}
    assert all(0.0 <= value <= 1.0 for value in report.scores["test"].values() if value is not None)
    fold_of = {row["scene"]: row["fold"] for row in TopViewDatabase(plan.out).rows}
    assert fold_of["000000"] != fold_of["000003"]
    for fold in range(5):
        card = ModelCard.read(plan.out / f"road/models/fold-{fold}.onnx")
        assert card.name == f"ssadnet-fold-{fold}"
        assert {*card.training["frames"]} == {n for n in ("000000", "000003") if fold_of[n] != str(fold)}
    first = contents(plan.out)
    again = build(plan, polygons=[path], recipe=recipe, workers=1)
    assert (again.made, again.kept, contents(plan.out)) == (0, 8, first)

    path.write_text(write_coco({"000000": [TRAPEZIUM], "000007": [TRAPEZIUM]}))
    with pytest.raises(DatabaseError, match=r"1 drawn scenes are in 1 of 5 folds, .*; draw roads in more drives"):
        build(plan, polygons=[path], recipe=recipe, workers=1)
    assert contents(plan.out) == first  # nothing was trained before


class PowerFailure(BaseException):
    """A simulated power failure."""


def test_a_build_stopped_at_every_write_and_resumed_is_the_same(
    out: Path, kitti: Path, model: str, polygons: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Power fails at every file: before it is written, in the middle, or before it is renamed, in turn."""
    plan, stops = plan_of(kitti, tmp_path / "out", model), 0

    def failing(path: Path, content: bytes) -> None:
        nonlocal left
        if left == 0:
            aside = path.with_name(f".{path.name}.{1000 + stops}.part")
            if stops % 3:
                aside.write_bytes(content[: len(content) // (1 + stops % 2)])
            raise PowerFailure
        left -= 1
        write_atomic(path, content)

    for module in (build_module, scenes_module):
        monkeypatch.setattr(module, "write_atomic", failing)
    while True:
        left = 3 + 7 * stops % 13  # a scene writes four files, a drawn one up to twelve
        try:
            build(plan, polygons=[polygons], workers=1)
            break
        except PowerFailure:
            stops += 1
            with pytest.raises(DatabaseError, match="unfinished"):
                TopViewDatabase(plan.out)
            for path in plan.out.rglob("*.png"):
                if path.suffix != ".part":
                    Image.open(path).verify()
            assert stops < 60
    assert stops >= 7
    assert contents(plan.out) == contents(out)


KILLED = """
import sys
from pathlib import Path
from edgeperc.system.atomic import write_atomic
from edgeperc_export.database import build as build_module, scenes

def announced(path, content):
    print(path.name, flush=True)
    write_atomic(path, content)

build_module.write_atomic = scenes.write_atomic = announced
kitti, out, model, polygons = sys.argv[1:]
print("ready", flush=True)
plan = scenes.Plan(Path(kitti), Path(out), model, provider="cpu", variations=3)
build_module.build(plan, polygons=[Path(polygons)], workers=1)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no such signal on this platform")
def test_a_build_killed_twice_and_resumed_is_the_same(
    out: Path, kitti: Path, model: str, polygons: Path, tmp_path: Path
) -> None:
    """At random moments: while the model is loaded, or after a random number of writes and a short delay."""
    target, rng = tmp_path / "out", random.Random()
    command = [sys.executable, "-c", KILLED, *map(str, (kitti, target, model, polygons))]
    kills, finished = 0, []
    while kills < 2:
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
            for _ in range(rng.randint(1, 9)):  # at most eight writes of more than forty
                assert process.stdout.readline()
            time.sleep(rng.uniform(0.0, 0.005))
            process.kill()
            kills += process.wait() == -signal.SIGKILL
        finished.append(len([*target.glob(".build/records/*.json")]))
        for path in target.rglob("*.png"):
            Image.open(path).verify()
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert finished == sorted(finished), "a scene was lost"
    assert contents(target) == contents(out)


def test_the_workers_of_a_killed_build_stop(kitti: Path, model: str, tmp_path: Path) -> None:
    """A surviving worker would write into a database that is being resumed."""
    if not Path("/proc/self/stat").exists():
        pytest.skip("needs /proc to see processes")
    command = [sys.executable, "-m", "edgeperc_export.cli", "database-build", str(kitti), str(tmp_path / "out")]
    command += ["--workers", "2", "--road-by", model]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL) as process:
        children: list[int] = []
        while process.poll() is None and len(children) < 2:
            pids = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
            children = [int(pid) for pid in pids if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]
        process.kill()
    assert children
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline and any(map(alive, children)):
        time.sleep(0.05)
    assert not any(map(alive, children))


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_a_broken_scene_is_left_out_and_reported(
    out: Path, kitti: Path, model: str, polygons: Path, tmp_path: Path, shell: Shell
) -> None:
    broken = tmp_path / "kitti"
    shutil.copytree(kitti, broken)
    scan, label = broken / "training/velodyne/000002.bin", broken / "training/label_2/000003.txt"
    calib = broken / "training/calib/000004.txt"
    whole = {path: path.read_bytes() for path in (scan, label, calib)}
    scan.write_bytes(whole[scan][:-7])
    label.write_text("Car 0 0 nonsense\n")
    calib.unlink()
    arguments = ["database-build", str(broken), str(tmp_path / "out"), "--road-by", model]
    arguments += ["--variations", "3", "--polygons", str(polygons), "--workers", "1"]
    shown = shell.both(*arguments, code=1)
    assert "5 scenes, 5 made, 0 kept, 3 left out" in shown.out
    for name in ("000002", "000003", "000004"):
        assert f"left out {name}: " in shown.err
    assert {*TopViewDatabase(tmp_path / "out").manifest["skipped"]} == {"000002", "000003", "000004"}
    assert len(TopViewDatabase(tmp_path / "out")) == 5

    for path, content in whole.items():
        path.write_bytes(content)
    assert "8 scenes, 3 made, 5 kept, 0 left out" in shell.out(*arguments)
    assert contents(tmp_path / "out") == contents(out)


def test_changed_scenes_are_made_again_and_removed_ones_deleted(
    out: Path, kitti: Path, model: str, polygons: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "kitti"
    shutil.copytree(kitti, root)
    plan = plan_of(root, tmp_path / "out", model)
    shutil.copytree(out, plan.out)
    assert build(plan, polygons=[polygons], workers=1).made == 0
    assert contents(plan.out) == contents(out)

    label = root / "training/label_2/000005.txt"
    label.write_text("\n".join(label.read_text().splitlines()[:1]) + "\n")
    (root / "training/label_2/000006.txt").unlink()
    (plan.out / "maps/000000.png").unlink()
    scan = root / "training/velodyne/000007.bin"
    scan.write_bytes(np.fromfile(scan, np.float32).reshape(-1, 4)[::-1].tobytes())  # of the same size
    report = build(plan, polygons=[polygons], workers=1)
    assert (report.scenes, report.made) == (7, 3)
    database = TopViewDatabase(plan.out)
    assert not database.scene("000005").boxes
    assert not [*plan.out.rglob("*000006*")]
    assert not database.damaged()

    assert build(plan, workers=1).made == 2  # no polygons: these scenes take the road of the model
    assert not [*(plan.out / "road/masks").iterdir()]
    other = road_network(tmp_path / "other.onnx", VIEW)
    assert build(replace(plan, road_by=str(other)), workers=1).made == 7
    monkeypatch.setattr(scenes_module, "__version__", "0")
    assert build(replace(plan, road_by=str(other)), workers=1).made == 7


def test_memory_does_not_grow_with_the_number_of_scenes(kitti: Path, model: str, tmp_path: Path) -> None:
    peaks = {}
    for n in (4, 16):
        root = tmp_path / f"kitti-{n}"
        for part, suffix in {"velodyne": "bin", "label_2": "txt", "calib": "txt"}.items():
            (root / "training" / part).mkdir(parents=True)
            for k in range(n):
                whole = kitti / "training" / part / f"{k % 8:06d}.{suffix}"
                (root / "training" / part / f"{k:06d}.{suffix}").write_bytes(whole.read_bytes())
        tracemalloc.start()
        assert build(plan_of(root, tmp_path / f"out-{n}", model), workers=1).made == n
        peaks[n] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    # If the 12 more images stayed in memory, they would take 2.9 MB.
    assert peaks[16] - peaks[4] < 1e6


def test_unusable_input_is_refused(kitti: Path, model: str, out: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.txt").write_text("precious")
    with pytest.raises(DatabaseError, match="holds other files"):
        build(plan_of(kitti, tmp_path / "mine", model))
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.txt"]
    with pytest.raises(DatabaseError, match="no scene is of drive x"):
        build(plan_of(kitti, tmp_path / "out", model), test_drives=["x"])
    from filelock import FileLock

    with FileLock(out / ".build/lock"), pytest.raises(DatabaseError, match="another build"):
        build(plan_of(kitti, out, model))
    far = road_network(tmp_path / "far.onnx", TopViewGeometry((10.0, 50.0)))
    deaf = road_network(tmp_path / "deaf.onnx", TopViewGeometry(), ("background", "grass"))
    for path, message in {
        str(far): "to within one cell",
        str(deaf): "class drivable",
        "pointseg": "range_image",
    }.items():
        with pytest.raises(CardMismatchError, match=message):
            build(plan_of(kitti, tmp_path / "out", path))
    nothing = ["database-build", str(tmp_path), str(tmp_path / "out")]
    assert main(nothing) == main([nothing[0], str(kitti), nothing[2], "--workers", "0"]) == 2


def test_notes_report_what_a_data_set_lacks(kitti: Path, model: str, polygons: Path, tmp_path: Path) -> None:
    root = tmp_path / "kitti"
    shutil.copytree(kitti, root)
    (root / "frames.csv").unlink()
    for k in range(3, 8):
        (root / f"training/label_2/{k:06d}.txt").unlink()
    report = build(plan_of(root, tmp_path / "out", model), polygons=[polygons], test_drives=["000002"], workers=1)
    assert len(report.notes) == 2
    assert "000007" in report.notes[0]
    assert "no frames.csv" in report.notes[1]
    assert TopViewDatabase(tmp_path / "out", "test").names == ["000002"]
    (root / "frames.csv").write_text("name,drive\n000000,one\n000001,other\n")
    report = build(plan_of(root, tmp_path / "two", model), workers=1)
    assert report.notes == (f"{root} has 1 labeled scans without a row in frames*.csv, which are left out",)
    assert report.scenes == 2


def test_roads_of_other_scans_are_refused(kitti: Path, model: str, tmp_path: Path) -> None:
    scans = {"000001": scan_hash(KittiObjects(kitti).frame("000001").points), "000007": "0" * 16}
    (tmp_path / "road.json").write_text(write_coco({name: [TRAPEZIUM] for name in scans}, scans))
    with pytest.raises(DatabaseError, match="drawn over other scans than those of these names here: 000007;"):
        build(plan_of(kitti, tmp_path / "out", model), polygons=[tmp_path / "road.json"], workers=1)
    assert not (tmp_path / "out").exists()


def test_polygons_and_run_lengths_become_masks(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(drawn())
    mask = mask_of(read_coco([tmp_path / "a.json"])["000001"])
    np.testing.assert_array_equal(np.argwhere(mask)[[0, -1]], [[20, 10], [59, 29]])
    assert mask.sum() == 20 * 40
    runs = coco_mask.encode(np.asfortranarray(mask))
    compressed = {"size": [400, 200], "counts": runs["counts"].decode()}
    flat = mask.T.ravel()
    edges = np.nonzero(np.diff(flat))[0] + 1
    counts = np.diff([0, *edges, flat.size]).tolist()
    for segmentation in (compressed, {"size": [400, 200], "counts": counts}):
        (tmp_path / "b.json").write_text(drawn(annotation={"segmentation": segmentation}))
        np.testing.assert_array_equal(mask_of(read_coco([tmp_path / "b.json"])["000001"]), mask)
    (tmp_path / "c.json").write_text(drawn(annotation={"category_id": 1}))
    assert read_coco([tmp_path / "c.json"]) == {"000001": []}  # annotated, but not as road
    with pytest.raises(DatabaseError, match="another file both draw"):
        read_coco([tmp_path / "a.json", tmp_path / "b.json"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nonsense", "not a COCO file"),
        ("[]", "not a COCO file"),
        ("{}", "not a COCO file"),
        (drawn(categories=[]), "no category called road"),
        (drawn(image={"width": 640}), "is 640 x 400; expected the database's images, 200 x 400"),
        (drawn(annotation={"image_id": 7}), "annotates image 7"),
        (drawn(annotation={"segmentation": [[1, 2, 3, 4]]}), "three corners"),
        (drawn(annotation={"segmentation": [[1, 2, 3, 4, 5, 6, 7]]}), "three corners"),
        (drawn(annotation={"segmentation": [[1, 2, 3, 4, 5, float("nan")]]}), "three corners"),
        (drawn(annotation={"segmentation": [[1, 2, 3, 4, 5, "x"]]}), "three corners"),
        (drawn(annotation={"segmentation": []}), "three corners"),
        (drawn(annotation={"segmentation": None}), "three corners"),
        (drawn(annotation={"segmentation": {"size": [9, 9], "counts": [81]}}), "run lengths"),
        (drawn(annotation={"segmentation": {"size": [400, 200], "counts": [81]}}), "run lengths"),
    ],
)
def test_an_invalid_drawing_is_reported(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "bad.json").write_text(text)
    with pytest.raises(DatabaseError, match=message):
        read_coco([tmp_path / "bad.json"])


def test_a_draft_matches_the_road() -> None:
    labels = mask_of([[np.ravel(TRAPEZIUM).tolist()]])
    labels[200:230, 90:110] = 2  # a car on the road leaves no hole
    labels[5:8, 5:8] = 1  # too small to draw
    (outline,) = draft(labels)
    assert len(outline) < 20
    covered = mask_of([[np.ravel(outline).tolist()]]) != 0
    truth = mask_of([[np.ravel(TRAPEZIUM).tolist()]]) != 0
    assert np.count_nonzero(covered & truth) / np.count_nonzero(covered | truth) > 0.98
    assert draft(np.zeros((400, 200), np.uint8)) == []
