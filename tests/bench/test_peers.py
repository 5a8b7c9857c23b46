"""What is measured beside edgeperc: counted by hand, agreeing with the runtime, and reported where it is missing."""

from __future__ import annotations

import json
import multiprocessing
import os
import shlex
import sys
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import tiny_camera

from edgeperc import ModelCard, ModelError, Perceiver
from edgeperc.inference.session import Session, golden_input
from edgeperc.objects.cluster import find_clusters
from edgeperc.simulation.samples import FIRST_SEED, simulated_scan
from edgeperc.types.mounting import MODEL_MOUNTING
from edgeperc.types.perception import Box
from edgeperc.types.sensor import get_sensor
from edgeperc.zoo import model_path
from edgeperc_bench import cli
from edgeperc_bench.accuracy import agreement
from edgeperc_bench.peers import arithmetic, family, networks, turns
from edgeperc_bench.peers import contenders as peers
from edgeperc_bench.peers.arithmetic import PRODUCT_SIZE, cost, matrix_product, n_taps_inside
from edgeperc_bench.peers.camera import N_IMAGES, small_unet
from edgeperc_bench.peers.engines import open_engine, torch_network
from edgeperc_bench.peers.ground import DISTANCE_M, VOXEL_M, by_first_point, tree_clusters
from edgeperc_bench.peers.networks import OTHERS, POINTPILLARS, resized, write_others
from edgeperc_bench.peers.numpy_pipeline import NumpyPipeline, iou
from edgeperc_bench.peers.pillars import CELL_M, HIGHEST_M, LOWEST_M, fill_pillars, random_weights
from edgeperc_bench.peers.tables import floor_table, latency_table, methods_table
from edgeperc_bench.peers.turns import measure
from edgeperc_bench.worker import Prediction
from twins.decode import oriented_iou

NAMES = ("pointseg:fp32", "ssadnet:fp32")


@pytest.fixture(scope="module")
def scan() -> np.ndarray:
    return simulated_scan(FIRST_SEED, "hdl-64e").points


@pytest.fixture(scope="module")
def right(scan: np.ndarray) -> Prediction:
    found = Perceiver(
        NAMES, provider="cpu", mounting=MODEL_MOUNTING, on_mismatch="ignore", boxes_from="network", agree=False
    )(scan)
    return Prediction(found.points, found.top_view, found.boxes)


def need(packages: Iterable[str]) -> None:
    for package in packages:
        pytest.importorskip(package)


def predict(engine: str, precision: str, scan: np.ndarray) -> Prediction:
    paths = [model_path(name) for name in NAMES]
    engines = [open_engine(engine, precision, path, 1) for path in paths]
    return NumpyPipeline([ModelCard.read(path) for path in paths], engines, get_sensor("hdl-64e"))(scan)


@pytest.mark.parametrize("error", [BrokenPipeError, ConnectionResetError, EOFError])
def test_a_contender_ends_in_silence_after_its_parent(error: type[Exception], monkeypatch: pytest.MonkeyPatch) -> None:
    """Each interrupted comparison left a traceback."""
    pytest.importorskip("psutil")
    monkeypatch.setattr(turns.signal, "signal", Mock())
    gone = Mock(send=Mock(side_effect=error), recv=Mock(side_effect=EOFError))
    turns.serve(gone, peers.Contender("", "peak", "copy"), (), "hdl-64e", 1)
    gone.send.assert_called_once()


def assert_agrees(right: Prediction, found: Prediction) -> None:
    same = agreement([right], [found])
    assert same["points"]["equal"] > 0.99
    assert same["cells"]["equal"] > 0.99
    assert same["boxes"]["n_reference"] > 0
    assert same["boxes"]["f1"] > 0.9


# arithmetic


@pytest.mark.parametrize(
    ("n_here", "n_there", "kernel", "stride", "pad", "dilation", "expected"),
    [
        (5, 5, 3, 1, 1, 1, 13),  # both ends miss one tap
        (5, 5, 3, 1, 4, 4, 7),  # except for the middle tap, only the outermost positions meet
        (2, 5, 3, 2, 0, 1, 6),
        (2, 4, 4, 2, 1, 1, 6),  # a transposed convolution that doubles: its first and last taps are cut off
    ],
)
def test_taps_on_padding_are_counted_separately(
    n_here: int, n_there: int, kernel: int, stride: int, pad: int, dilation: int, expected: int
) -> None:
    assert n_taps_inside(n_here, n_there, kernel, stride, pad, dilation) == expected


def test_multiplications_are_counted_by_hand() -> None:
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper, numpy_helper

    weights = {
        "half": np.zeros((4, 2, 3, 3), np.float16),  # on 5 x 6 outputs: 4 x 2 x 9 x 30
        "bias": np.zeros(4, np.float32),
        "up": np.zeros((4, 3, 1, 4), np.float32),  # from 5 x 6 inputs: 4 x 3 x 4 x 30
        "flat": np.array([1, 180], np.int64),
        "matrix": np.zeros((180, 7), np.float32),  # 180 x 7
    }
    nodes = [
        helper.make_node("Cast", ["half"], ["whole"], to=TensorProto.FLOAT),
        helper.make_node("Conv", ["x", "whole", "bias"], ["a"], pads=[1, 1, 1, 1]),
        helper.make_node("Relu", ["a"], ["b"]),
        helper.make_node("ConvTranspose", ["b", "up"], ["c"], strides=[1, 2], pads=[0, 1, 0, 1]),
        helper.make_node("Reshape", ["c", "flat"], ["d"]),
        helper.make_node("MatMul", ["d", "matrix"], ["y"]),
    ]
    initializers = [numpy_helper.from_array(values, name) for name, values in weights.items()]

    def of(*shape: int | str) -> onnx.ModelProto:
        x, y = (helper.make_tensor_value_info(*each) for each in (("x", 1, shape), ("y", 1, [1, 7])))
        return helper.make_model(helper.make_graph(nodes, "by hand", [x], [y], initializers))

    found = cost(of(1, 2, 5, 6))
    assert found.macs == 2160 + 1440 + 1260
    # 13 of 15 and 16 of 18 pairs of the convolution meet, 22 of 24 of the other's.
    assert found.padding_macs == (2160 - 8 * 13 * 16) + (1440 - 12 * 5 * 22)
    assert found.weights == (72 + 4) + 48 + 1260
    assert found.activations == (60 + 120) + (120 + 180) + (180 + 7)
    onnx.checker.check_model(of(1, 2, 5, 6))
    with pytest.raises(ModelError, match="not fixed"):
        cost(of(1, 2, 5, "n"))


@pytest.mark.parametrize(("library", "precision"), peers.PEAKS)
def test_every_library_multiplies_the_same_matrices(
    library: str, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(library)
    monkeypatch.setattr(arithmetic, "PRODUCT_SIZE", 256)
    made = matrix_product(library, precision, 1)()
    # OpenVINO returns its outputs by name; int8 values are 32 times as large on either side, and rounded.
    made = next(iter(made.values())) if library == "openvino" else made  # type: ignore[attr-defined]
    product = made if isinstance(made, np.ndarray) else made.float().numpy()  # type: ignore[attr-defined]
    product = product / (1024.0 if precision == "int8" else 1.0)
    a, b = np.random.default_rng(0).standard_normal((2, 256, 256), np.float32)
    right = a.astype(np.float64) @ b
    assert product.shape == right.shape
    tolerance = {"fp32": 1e-4, "bf16": 0.02, "int8": 0.05}[precision]
    assert np.linalg.norm(product - right) < tolerance * np.linalg.norm(right)


# the pipeline in numpy


@pytest.mark.parametrize("engine", ["onnxruntime", "torch", "openvino", "mnn"])
def test_the_pipeline_in_numpy_agrees(engine: str, scan: np.ndarray, right: Prediction) -> None:
    need(peers.NEEDS.get(engine, (engine,)))
    assert_agrees(right, predict(engine, "fp32", scan))


@pytest.mark.skipif(sys.platform == "win32", reason="a command is a file with a mode")
def test_a_model_is_converted_to_mnn_without_installing_a_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    need(peers.NEEDS["mnn"])
    (tmp_path / "pip").write_text(f"#!/bin/sh\ntouch {shlex.quote(str(tmp_path / 'called'))}\n")
    (tmp_path / "pip").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    open_engine("mnn", "fp32", model_path("ssadnet"), 1)
    assert not (tmp_path / "called").exists()


@pytest.mark.parametrize("name", NAMES)
def test_ncnn_computes_the_network(name: str) -> None:
    need(peers.NEEDS["ncnn"])
    theirs, ours = (open_engine(engine, "fp32", model_path(name), 1) for engine in ("ncnn", "onnxruntime"))
    image = np.random.default_rng(0).normal(size=ours.input.shape)
    theirs.input[:] = ours.input[:] = image
    expected = ours.run()
    for each, output in theirs.run().items():
        np.testing.assert_allclose(output, expected[each], atol=1e-4 * np.abs(expected[each]).max())


def test_ncnn_says_what_it_cannot_run() -> None:
    need(peers.NEEDS["ncnn"])
    with pytest.raises(ModelError, match="ncnn cannot run kulseg"):
        open_engine("ncnn", "fp32", model_path("pointseg").parent / "research/kulseg.onnx", 1)


@pytest.mark.parametrize("name", NAMES)
def test_torch_has_the_very_network(name: str) -> None:
    torch = pytest.importorskip("torch")
    pytest.importorskip("onnx")
    network, shape, outputs = torch_network(model_path(name))
    session = Session(name, "cpu", n_threads=1)
    image = golden_input(0, shape)
    session.input[:] = image[0]
    with torch.inference_mode():
        computed = network(torch.from_numpy(image))
    for spec, output in zip(session.card.outputs, computed, strict=True):
        session.run()
        expected = session.raw[spec.kind]
        apart = np.abs(output[0].numpy() - expected)
        # Where two maxima differ by a rounding, unpooling may put either back, and the cells around differ.
        assert np.median(apart) < 1e-3 * expected.std()
        assert np.quantile(apart, 0.9) < 1e-2 * expected.std()
    assert outputs == [spec.name for spec in session.card.outputs]


def test_networks_of_several_sizes_are_timed_and_drawn() -> None:
    need(("openvino", "matplotlib"))
    paths = [model_path(name) for name in ("pointseg:fp32", "pointseg:int8", "ssadnet:int8")]
    # In a process of its own: after OpenVINO 2026.4 had two networks, a process dies by SIGSEGV at its next signal.
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        ms = pool.submit(family.times, paths, 2, 1).result()
    assert ms.keys() == {f"{engine} {k}" for engine in family.ENGINES for k in range(len(paths))}
    assert min(ms.values()) > 0.0
    svg = family.draw(paths, [0.5, 0.4, 0.9], ms)
    assert svg.startswith("<svg")
    assert svg.count('id="axes_') == 2  # points and boxes


def test_overlaps_are_those_of_the_reference() -> None:
    rng = np.random.default_rng(0)
    rows = np.column_stack((rng.uniform(-2, 2, (12, 2)), rng.uniform(0.5, 4, (12, 2)), rng.uniform(-3, 3, 12)))
    boxes = [Box("car", 1.0, (x, y, 0.0), (length, width, 1.5), yaw) for x, y, length, width, yaw in rows.tolist()]
    found = [[iou(a, b) for b in boxes] for a in boxes]
    np.testing.assert_allclose(found, oriented_iou(rows, rows), atol=1e-9)


# methods of others


def make_shallow(patch: pytest.MonkeyPatch) -> None:
    """No layer, block or head after one of its kind: torch traces a graph of a third of the nodes in a third of the
    time.
    """
    from torch import nn

    from edgeperc_export.networks import pointpillars, resnets, salsanext, squeezesegv2

    deep = resnets.stages
    patch.setattr(resnets, "stages", lambda c_in, widths, depths, act: deep(c_in, widths, [1] * len(depths), act))
    patch.setattr(resnets, "N_BOX_VALUES", dict([*resnets.N_BOX_VALUES.items()][:2]))
    patch.setattr(pointpillars, "BLOCKS", [(1, *block[1:]) for block in pointpillars.BLOCKS])

    def changing(make: type[nn.Module]) -> Callable[..., nn.Module]:
        return lambda c_in, c_out, *more: nn.Identity() if c_in == c_out else make(c_in, c_out, *more)

    for module, name in ((squeezesegv2, "Fire"), (salsanext, "Context"), (salsanext, "Encoder")):
        patch.setattr(module, name, changing(getattr(module, name)))


def test_outputs_of_networks_of_others_are_named() -> None:
    torch = pytest.importorskip("torch")
    for where, outputs, shape in OTHERS.values():
        module, _, made = where.partition(".")
        with torch.device("meta"):
            network = getattr(import_module(f"edgeperc_export.networks.{module}"), made)().eval()
            answer = network(torch.empty(1, *shape))
        assert outputs == ("logits",) if torch.is_tensor(answer) else len(outputs) == len(answer)
    assert OTHERS["SFA3D 608x608"][1] == tuple(import_module("edgeperc_export.networks.resnets").N_BOX_VALUES)


# FIDNet is CENet with other widths, and SalsaNext's activation.
@pytest.mark.parametrize(
    ("name", "shape", "expected"),
    [
        ("SqueezeSegV2 64x512", (5, 8, 32), {"logits": (4, 8, 32)}),
        ("SalsaNext 64x2048", (5, 16, 32), {"logits": (20, 16, 32)}),
        ("CENet 64x2048", (5, 8, 48), {"logits": (20, 8, 48)}),
        ("SFA3D 608x608", (3, 64, 96), {"heat": (3, 16, 24), "offset": (2, 16, 24)}),
    ],
)
def test_networks_of_others_are_written_in_fp32_and_int8(
    name: str,
    shape: tuple[int, int, int],
    expected: dict[str, tuple[int, ...]],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    need(("onnx", "onnxscript", "torch", "tqdm"))
    make_shallow(monkeypatch)
    monkeypatch.setattr(networks, "OTHERS", {name: (OTHERS[name][0], tuple(expected), shape)})
    write_others(tmp_path)
    assert_written(tmp_path, name, expected)


def assert_written(folder: Path, name: str, expected: dict[str, tuple[int, ...]]) -> None:
    """int8 answers nearly as fp32 does, in these shapes."""
    found = {}
    for kind in ("fp32", "int8"):
        engine = open_engine("onnxruntime", kind, folder / f"{name} {kind}.onnx", 1)
        engine.input[:] = np.load(folder / f"{name}.npy")
        found[kind] = engine.run()
    for output, size in expected.items():
        fp32, int8 = found["fp32"][output], found["int8"][output]
        assert fp32.shape == int8.shape == size
        apart = np.linalg.norm(int8 - fp32) / np.linalg.norm(fp32)
        assert 0.0 < apart < 0.2


def pillars_in_numpy(points: np.ndarray, weights: np.ndarray, image: np.ndarray) -> None:
    image[:] = 0.0
    _, n_rows, n_columns = image.shape
    across = np.add(np.floor(points[:, :2].astype(np.float64) / CELL_M), (0, n_rows // 2))
    inside = ((across >= 0) & (across < (n_columns, n_rows))).all(axis=1)
    inside &= (points[:, 2] >= LOWEST_M) & (points[:, 2] < HIGHEST_M)
    for cell in np.unique(across[inside], axis=0):
        own = points[inside & (across == cell).all(axis=1)]
        center = (cell - (0, n_rows // 2) + 0.5) * CELL_M
        values = np.hstack((own, own[:, :3] - own[:, :3].mean(axis=0), own[:, :2] - center))
        image[:, int(cell[1]), int(cell[0])] = np.maximum(values @ weights, 0.0).max(axis=0)


@pytest.mark.kernel
@pytest.mark.parametrize("n", [0, 1, 2, 500])
def test_pillars_agree_with_their_twin(n: int) -> None:
    rng = np.random.default_rng(n)
    points = rng.uniform((-0.5, -1.5, -4.0, 0.0), (4.0, 1.5, 2.0, 1.0), (n, 4)).astype(np.float32)
    points[::7, n % 3] = np.nan
    points[::11, 1] = np.inf
    weights, image = random_weights(), np.ones((64, 16, 24), np.float32)
    fill_pillars(points, weights, image)
    with np.errstate(invalid="ignore"):
        pillars_in_numpy(points, weights, expected := np.empty_like(image))
    np.testing.assert_allclose(image, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("n", [1, 2, 40, 600])
def test_what_stands_on_the_ground_has_the_clusters_of_points_within_half_a_metre(n: int) -> None:
    pytest.importorskip("scipy")
    rng = np.random.default_rng(n)
    voxels = np.unique(rng.integers(-12, 12, (n, 3)), axis=0)  # one point each
    points = rng.permutation(((voxels + 0.5) * VOXEL_M).astype(np.float32))
    expected = find_clusters(points, min_distance_m=DISTANCE_M, distance_per_m=0.0, max_range_m=200.0, min_points=1)
    np.testing.assert_array_equal(by_first_point(tree_clusters(points)), by_first_point(expected))
    twice = np.concatenate((points, points + np.float32(0.01)))
    found = tree_clusters(twice)
    np.testing.assert_array_equal(found[: len(points)], found[len(points) :])


def test_ground_and_clusters_of_others_are_timed(tmp_path: Path, scan: np.ndarray) -> None:
    need((*peers.NEEDS["patchwork"], "psutil"))
    np.save(tmp_path / "scan.npy", scan)
    clusters = peers.Contender("Patchwork++, k-d tree", "clusters", "patchwork")
    (found,) = measure([clusters], [tmp_path / "scan.npy"])
    assert not found.missing
    assert len(found.ms) == 1


def test_methods_of_others_are_rows_of_one_table(
    in_threads: None, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    need(("onnx", "onnxscript", "psutil", "torch", "tqdm"))
    for name in {*OTHERS} - {POINTPILLARS}:
        monkeypatch.delitem(OTHERS, name)
    monkeypatch.setitem(OTHERS, POINTPILLARS, (*OTHERS[POINTPILLARS][:2], (64, 16, 24)))
    make_shallow(monkeypatch)

    def some(folder: Path) -> list[peers.Contender]:
        """Each kind of contender once, in either precision."""
        rows = peers.methods(folder)
        shapes = {"scores": (2, 8, 12), "boxes": (14, 8, 12), "directions": (4, 8, 12)}
        assert_written(folder, POINTPILLARS, shapes)
        assert [row.kind for row in rows[:-1]] == [*peers.ANSWERS, *peers.ANSWERS, *("network", "pillars") * 2]
        return [rows[0], rows[3], rows[4], rows[7], rows[-1]]

    monkeypatch.setattr(turns, "methods", some)
    file = tmp_path / "peers.json"
    command = ["peers", "--tables", "methods", "--scans", "1", "--rounds", "2", "--threads", "1", "--json", str(file)]
    assert cli.main(command) == 0
    (title, rows), *others = json.loads(file.read_text("utf-8"))["peers"].items()
    assert (title, others) == (peers.METHODS, [])
    clusters = rows.pop()
    assert [row["kind"] for row in rows] == [*peers.ANSWERS, "network", "pillars"]
    for row in rows:
        assert not row["missing"], row
        assert [len(ms) for ms in row["rounds"]] == [1, 1]
        assert row["timed"]
    assert clusters["missing"] in ("", peers.INSTALL_GEOMETRY)
    printed = capsys.readouterr().out
    assert "weights of others are random" in printed
    assert "scan to pillars, network, boxes only" in printed


def test_methods_that_are_not_installed_name_their_line(alone: None, tmp_path: Path) -> None:
    rows = peers.methods(tmp_path)
    assert [peers.why_missing(row) for row in rows[:4]] == [""] * 4
    assert {peers.why_missing(row) for row in rows[4:-1]} == {peers.INSTALL}
    assert peers.why_missing(rows[-1]) == "not installed: pip install 'edgeperc[geometry]'"
    table = methods_table(peers.METHODS, [peers.Measured(row, missing=peers.why_missing(row)) for row in rows], 2)
    assert [row[-1] for row in table["rows"]] == [*["-"] * 4, *[peers.INSTALL] * 16, peers.INSTALL_GEOMETRY]
    answers = {"labels only": 10, "boxes only": 6, "ground and clusters only, one thread": 1}
    answers |= {"labels, cells and boxes": 4}
    assert {answer: sum(row.timed.endswith(answer) for row in rows) for answer in answers} == answers
    assert sum(answers.values()) == len(rows)


def test_quartiles_and_ratios_are_of_all_rounds() -> None:
    rows = [measured("edgeperc front", "front", "cpu", "auto", 10.0), measured("other", "network", "", "", 0.0)]
    rows[1].rounds = [[float(ms) for ms in range(1, 51)], [float(ms) for ms in range(51, 101)]]
    table = methods_table(peers.METHODS, rows, 2)
    assert [row[2:7] for row in table["rows"]] == [
        ["120", "10.00", "10.00", "10.00", "1.00"],
        ["100", "25.00", "50.00", "75.00", "5.00"],
    ]


# tables


def measured(name: str, kind: str, engine: str, precision: str, ms: float, **more: object) -> peers.Measured:
    contender = peers.Contender(name, kind, engine, precision, (model_path("pointseg"),))
    return peers.Measured(contender, [[ms] * 10] * 12 if ms else [], **more)  # type: ignore[arg-type]


def test_ratios_are_to_the_first_row() -> None:
    rows = [
        measured("edgeperc, auto", "edgeperc", "auto", "auto", 10.0, rss_mb=100.0),
        measured("numpy + torch fp32", "pipeline", "torch", "fp32", 80.0, rss_mb=500.0),
        measured("OpenVINO API fp32, network alone", "network", "openvino", "fp32", 8.0),
        measured("numpy + openvino bf16", "pipeline", "openvino", "bf16", 0.0, missing=peers.INSTALL),
        measured("peak numpy fp32", "peak", "numpy", "fp32", 1.0),
    ]
    table = latency_table("Scan to result: pointseg:fp32", rows, 2)
    column = dict(zip(table["head"], zip(*table["rows"], strict=True), strict=True))
    assert column["x edgeperc"] == ("1.00", "8.00", "0.80", "-")
    assert column["p50"] == ("10.00", "80.00", "8.00", "-")
    assert column["note"] == ("-", "-", "-", "not installed: pip install 'edgeperc[peers]'")
    assert "scan to result / OpenVINO API fp32, network alone: edgeperc, auto 1.25" in table["sentences"]


@pytest.mark.parametrize("variant", ["fp32", "int8"])
def test_the_floor_is_arithmetic_over_peak(variant: str) -> None:
    pytest.importorskip("onnx")
    path = model_path(f"pointseg:{variant}")
    work = cost(path)
    rows = [
        measured("onnxruntime cpu, network alone", "session", "cpu", "auto", 50.0),
        measured("OpenVINO API bf16, network alone", "network", "openvino", "bf16", 20.0),
        measured("peak numpy fp32", "peak", "numpy", "fp32", 40.0),
        measured("peak torch fp32", "peak", "torch", "fp32", 30.0),
        measured("peak copy", "peak", "copy", "", 20.0),
    ]
    for row in rows:
        row.contender = replace(row.contender, paths=(path,))
    table = floor_table(f"Scan to result: pointseg:{variant}", rows)
    assert table["title"] == f"Floor: pointseg:{variant}"
    fp32, bf16, int8 = table["rows"]
    floor = (work.macs - work.padding_macs) * 30.0 / PRODUCT_SIZE**3
    assert fp32[2:4] == ["torch", f"{floor:.2f}"]
    assert bf16[1:4] == int8[1:4] == ["-", "-", "-"]
    if variant == "int8":  # every engine runs the stored int8 weights
        assert fp32[-2:] == bf16[-2:] == ["-", "-"]
        assert int8[5:7] == ["20.00", "OpenVINO API bf16, network alone"]
        return
    assert fp32[-2:] == ["onnxruntime cpu, network alone", f"{2.0 * floor:.1f} %"]
    assert bf16[5] == "20.00"
    assert set(int8[1:]) == {"-"} | {int8[4]}  # only the traffic is known


# the command


@pytest.fixture
def in_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Contenders in threads of this process, which has imported everything."""

    def pipe() -> tuple[Any, Any]:
        here, there = multiprocessing.Pipe()  # a process has an end of its own, which its parent does not close
        return here, SimpleNamespace(send=there.send, recv=there.recv, close=lambda: None)

    threads = SimpleNamespace(Pipe=pipe, Process=threading.Thread)
    monkeypatch.setattr(turns, "multiprocessing", SimpleNamespace(get_context=lambda how: threads))
    monkeypatch.setattr(turns, "signal", SimpleNamespace(SIGINT=0, SIG_IGN=0, signal=lambda number, handler: None))


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing but onnxruntime's CPU provider and numpy, on any computer."""
    monkeypatch.setattr(peers, "NEEDS", dict.fromkeys(peers.NEEDS, ("no_such_package",)))
    monkeypatch.setattr(peers, "available_providers", lambda: ("cpu",))


def made(models: list[str], folder: Path, scan: np.ndarray, provider: str = "cpu") -> dict[str, list[peers.Contender]]:
    np.save(folder / "scan.npy", scan)
    return peers.groups(models, provider, "auto", folder, folder / "scan.npy", "hdl-64e")


def test_two_networks_give_the_results_of_one(tmp_path: Path, scan: np.ndarray) -> None:
    need(("onnx", "onnxscript", "torch", "tqdm"))
    one, two, lean, *_ = made(["ssadnet"], tmp_path, scan)["One network or two: ssadnet:fp32"]
    outputs = []
    for contender in (one, two, lean):
        outputs.append([])
        for path in contender.paths:
            engine = open_engine(contender.engine, contender.precision, path, 1)
            engine.input[:] = np.load(one.image)
            outputs[-1] += engine.run().values()
    for a, b in zip(outputs[0], outputs[1], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-3 * a.std())
    assert [a.shape for a in outputs[2]] == [a.shape for a in outputs[0]]


@pytest.mark.parametrize(("name", "shape"), [("pointseg", (64, 256)), ("ssadnet", (200, 200))])
def test_the_same_network_for_half_the_image(
    name: str, shape: tuple[int, int], tmp_path: Path, scan: np.ndarray
) -> None:
    need(("onnx", "onnxscript", "torch", "tqdm"))
    half = resized(name, 0.5, tmp_path)
    assert resized("objects", 0.5, tmp_path) == Path("objects")  # which has no image
    assert cost(half).macs == pytest.approx(0.5 * cost(model_path(name)).macs, rel=0.01)
    perceive = Perceiver([half], provider="cpu", n_threads=1, on_mismatch="ignore")
    assert perceive.sessions[0].input.shape[1:] == shape
    found = perceive(scan)
    assert found.points is not None or found.top_view is not None


def test_networks_are_measured_alone_and_in_pairs(alone: None, tmp_path: Path, scan: np.ndarray) -> None:
    tables = made(["ssadnet", "pointseg:int8"], tmp_path, scan)
    assert list(tables) == [
        "Scan to result: pointseg:int8",
        "Scan to result: ssadnet:fp32",
        "Scan to result: pointseg:int8 and ssadnet:fp32",
        "Projection: range image",
        "Projection: top view",
        "One network or two: ssadnet:fp32",
    ]
    both = tables["Scan to result: pointseg:int8 and ssadnet:fp32"]
    full = tuple(model_path("ssadnet").parent / f"research/{name}-full.onnx" for name in ("pointseg", "ssadnet"))
    assert {c.paths for c in both} - {full} == {(model_path("pointseg:int8"), model_path("ssadnet"))}
    at_once = "edgeperc, both at once, as by default"
    assert [c.name for c in both if not peers.why_missing(c)] == ["edgeperc, cpu", "numpy + onnxruntime", at_once]
    assert any(c.paths == full and c.engine == "torch" for c in both) == all(path.exists() for path in full)


def test_camera_models_are_measured_with_images(
    alone: None, in_threads: None, tmp_path: Path, scan: np.ndarray
) -> None:
    pytest.importorskip("psutil")
    path = tiny_camera.write_camera(tmp_path)
    ((title, contenders),) = made([str(path)], tmp_path, scan).items()
    assert title == "Image to result: tinycam:fp32"
    files = [tmp_path / "scan.npy"]
    measured = measure([c for c in contenders if not peers.why_missing(c) and c.kind != "peak"], files, n_rounds=1)
    assert [each.missing for each in measured] == [""] * 3
    names = ["edgeperc, cpu", "numpy + onnxruntime", "onnxruntime cpu, network alone"]
    assert [each.contender.name for each in measured] == names
    assert [len(each.ms) for each in measured[:2]] == [N_IMAGES, N_IMAGES]
    own, numpy_s, _ = (each.predictions for each in measured)
    assert len(own) == N_IMAGES
    assert agreement(own, numpy_s)["pixels"]["equal"] > 0.999
    table = latency_table(title, measured, 1)
    assert "images of simulated streets" in table["sentences"][1]
    assert table["rows"][1][7] != "-"


def test_the_small_unet_labels_images() -> None:
    pytest.importorskip("torch")
    card = tiny_camera.camera_card()
    image = np.random.default_rng(0).integers(0, 256, (24, 32, 3), dtype=np.uint8)
    for precision in ("fp32", "bf16"):
        labels = small_unet(card, precision, 1)(image)
        assert (labels.shape, labels.dtype, labels.max() < 3) == ((24, 32), np.uint8, True)


def test_edgeperc_runs_in_every_precision_of_a_provider(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, scan: np.ndarray
) -> None:
    monkeypatch.setattr(peers, "available_providers", lambda: ("openvino", "cpu"))
    of_fp32, of_int8 = (
        [
            c.name
            for c in made([name], tmp_path, scan, "auto")[f"Scan to result: {name}"]
            if c.kind == "edgeperc" and not peers.why_missing(c)
        ]
        for name in ("pointseg:fp32", "pointseg:int8")
    )
    assert of_fp32 == ["edgeperc, auto", "edgeperc, cpu", "edgeperc, openvino fp32", "edgeperc, openvino bf16"]
    assert of_int8 == ["edgeperc, auto", "edgeperc, cpu", "edgeperc, openvino"]


def test_what_is_missing_is_reported(
    alone: None, in_threads: None, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("psutil")

    def groups(*asked: object) -> dict[str, list[peers.Contender]]:
        """Each kind of contender once."""
        tables = peers.groups(*asked)  # type: ignore[arg-type]
        del tables["Projection: range image"]
        return {title: [c for c in table if c.engine != "copy"] for title, table in tables.items()}

    monkeypatch.setattr(turns, "groups", groups)
    file = tmp_path / "peers.json"
    asked = "peers --tables engines --model ssadnet:fp32 --provider cpu --scans 1 --rounds 1 --threads 1"
    assert cli.main([*asked.split(), "--json", str(file)]) == 0
    document = json.loads(file.read_text("utf-8"))
    assert document["complete"]
    for title, contenders in document["peers"].items():
        for contender in contenders:
            missing = contender["engine"].startswith(tuple(peers.NEEDS))
            if missing or (title.startswith("One") and contender["name"] != "one network"):
                assert contender["missing"]
                assert not contender["rounds"]
            else:
                assert not contender["missing"], contender
                assert min(contender["rounds"][0]) > 0.0
                assert contender["rss_mb"] > 10.0
    printed = capsys.readouterr().out
    assert printed.count(peers.INSTALL) > 10
    assert "Floor: ssadnet:fp32" in printed


def test_a_model_that_no_other_engine_runs_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("psutil")
    assert cli.main(["peers", "--tables", "engines", "--model", "objects", "--scans", "1"]) == 2
    assert "no other engine runs objects;" in capsys.readouterr().err


def test_a_contender_that_fails_does_not_stop_the_others(tmp_path: Path) -> None:
    pytest.importorskip("psutil")
    (tmp_path / "broken.onnx").write_bytes(b"no model")
    np.save(tmp_path / "scan.npy", np.zeros((2, 4), np.float32))
    paths, image = (tmp_path / "broken.onnx",), tmp_path / "scan.npy"
    broken = peers.Contender("broken", "session", "cpu", "auto", paths, image=image)
    peak = peers.Contender("peak", "peak", "numpy", "fp32")
    first, second = measure([broken, peak], [tmp_path / "scan.npy"], note=lambda name: None)
    assert first.missing.startswith("failed: ")
    assert len(second.ms) == 2
