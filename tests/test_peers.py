"""Who is measured beside edgeperc: counted by hand, agreeing with the runtime, and told of where it is absent."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("psutil")

from edgeperc import Perceiver
from edgeperc.perception import Box
from edgeperc.sensor import get_sensor
from edgeperc.session import Session, golden_input
from edgeperc.simulation.samples import FIRST_SEED, simulated_scan
from edgeperc.zoo import model_path
from edgeperc_bench import cli
from edgeperc_bench.accuracy import agreement
from edgeperc_bench.peers import contenders as peers
from edgeperc_bench.peers.arithmetic import PRODUCT_SIZE, cost, matrix_product, n_met
from edgeperc_bench.peers.engines import open_engine, torch_network
from edgeperc_bench.peers.networks import resized
from edgeperc_bench.peers.numpy_pipeline import Rival, overlap
from edgeperc_bench.peers.projection import measure
from edgeperc_bench.peers.tables import floor_table, latency_table
from edgeperc_bench.worker import Answer
from twins.decode import oriented_iou

NAMES = ("pointseg", "ssadnet")


@pytest.fixture(scope="module")
def scan() -> np.ndarray:
    return simulated_scan(FIRST_SEED, "hdl-64e").points


@pytest.fixture(scope="module")
def right(scan: np.ndarray) -> Answer:
    found = Perceiver(NAMES, provider="cpu", on_mismatch="ignore", boxes_from="network")(scan)
    return Answer(found.points, found.top_view, found.boxes)


def answer_of(engine: str, scan: np.ndarray) -> Answer:
    cards = [Session(model_path(name), "cpu").card for name in NAMES]
    return Rival(cards, [open_engine(engine, model_path(name), 1) for name in NAMES], get_sensor("hdl-64e"))(scan)


def assert_agrees(right: Answer, found: Answer) -> None:
    told = agreement([right], [found])
    assert told["points"]["equal"] > 0.99
    assert told["cells"]["equal"] > 0.99
    assert told["boxes"]["n_reference"] > 0
    assert told["boxes"]["f1"] > 0.9


# arithmetic


@pytest.mark.parametrize(
    ("n_here", "n_there", "kernel", "stride", "pad", "dilation", "expected"),
    [
        (5, 5, 3, 1, 1, 1, 13),  # both ends miss one tap
        (5, 5, 3, 1, 4, 4, 7),  # but for the middle tap only the outermost positions see each other
        (2, 5, 3, 2, 0, 1, 6),
        (2, 4, 4, 2, 1, 1, 6),  # a transposed convolution that doubles: its first and last taps are cut off
    ],
)
def test_taps_on_padding_are_told_apart(
    n_here: int, n_there: int, kernel: int, stride: int, pad: int, dilation: int, expected: int
) -> None:
    assert n_met(n_here, n_there, kernel, stride, pad, dilation) == expected


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
    graph = helper.make_graph(
        nodes,
        "by hand",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 2, 5, 6])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 7])],
        [numpy_helper.from_array(values, name) for name, values in weights.items()],
    )
    found = cost(helper.make_model(graph))
    assert found.macs == 2160 + 1440 + 1260
    # 13 of 15 and 16 of 18 pairs of the convolution meet, 22 of 24 of the other's.
    assert found.padding_macs == (2160 - 8 * 13 * 16) + (1440 - 12 * 5 * 22)
    assert found.weights == (72 + 4) + 48 + 1260
    assert found.activations == (60 + 120) + (120 + 180) + (180 + 7)
    onnx.checker.check_model(helper.make_model(graph))


def test_open_shapes_are_refused() -> None:
    pytest.importorskip("onnx")
    from onnx import TensorProto, helper

    from edgeperc.errors import ModelError

    matrices = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", "n"]) for name in "xyz"]
    node = helper.make_node("MatMul", ["x", "y"], ["z"])
    model = helper.make_model(helper.make_graph([node], "open", matrices[:2], matrices[2:]))
    with pytest.raises(ModelError, match="not known beforehand"):
        cost(model)


@pytest.mark.parametrize("engine", peers.PEAKS)
def test_every_library_multiplies_the_same_matrices(engine: str) -> None:
    library, _, precision = engine.partition(":")
    pytest.importorskip(library)
    made = matrix_product(library, precision, 1)()
    # OpenVINO answers by output; whole numbers are 32 times as large on either side, and rounded.
    made = next(iter(made.values())) if library == "openvino" else made  # type: ignore[attr-defined]
    product = made if isinstance(made, np.ndarray) else made.float().numpy()  # type: ignore[attr-defined]
    product = product / (1024.0 if precision == "int8" else 1.0)
    right = matrix_product("numpy", "fp32", 1)()
    assert product.shape == (PRODUCT_SIZE, PRODUCT_SIZE)
    assert np.corrcoef(product.reshape(-1), np.reshape(right, -1))[0, 1] > 0.999
    assert product.std() == pytest.approx(np.std(right), rel=0.05)


# rivals


def test_the_pipeline_in_numpy_agrees(scan: np.ndarray, right: Answer) -> None:
    pytest.importorskip("onnxruntime")
    assert_agrees(right, answer_of("onnxruntime", scan))


def test_torch_agrees(scan: np.ndarray, right: Answer) -> None:
    pytest.importorskip("torch")
    pytest.importorskip("onnx")
    assert_agrees(right, answer_of("torch:fp32", scan))


def test_openvino_agrees(scan: np.ndarray, right: Answer) -> None:
    pytest.importorskip("openvino")
    assert_agrees(right, answer_of("openvino:fp32", scan))


@pytest.mark.parametrize("name", [*NAMES, *(f"{name}-edge" for name in NAMES)])
def test_torch_has_the_very_network(name: str) -> None:
    torch = pytest.importorskip("torch")
    pytest.importorskip("onnx")
    network, shape, outputs = torch_network(model_path(name))
    session = Session(model_path(name), "cpu", 1)
    image = golden_input(0, shape)
    session.input[:] = image[0]
    with torch.inference_mode():
        answers = network(torch.from_numpy(image))
    for spec, answer in zip(session.card.outputs, answers, strict=True):
        want = session.run()[spec.kind]
        apart = np.abs(answer[0].numpy() - want)
        # Where two maxima are a rounding apart, unpooling may put either back, and the cells around differ.
        assert np.median(apart) < 1e-3 * want.std()
        assert np.quantile(apart, 0.9) < 1e-2 * want.std()
    assert outputs == [spec.name for spec in session.card.outputs]


def test_overlaps_are_those_of_the_reference() -> None:
    rng = np.random.default_rng(0)
    rows = np.column_stack((rng.uniform(-2, 2, (12, 2)), rng.uniform(0.5, 4, (12, 2)), rng.uniform(-3, 3, 12)))
    boxes = [Box("car", 1.0, (x, y, 0.0), (length, width, 1.5), yaw) for x, y, length, width, yaw in rows.tolist()]
    found = [[overlap(a, b) for b in boxes] for a in boxes]
    np.testing.assert_allclose(found, oriented_iou(rows, rows), atol=1e-9)


# tables


def found(name: str, kind: str, engine: str, ms: float, **more: object) -> peers.Found:
    contender = peers.Contender(name, kind, engine, (model_path("pointseg"),))
    return peers.Found(contender, [[ms] * 10] * 12 if ms else [], **more)  # type: ignore[arg-type]


def test_ratios_are_to_the_first_row() -> None:
    rows = [
        found("edgeperc, auto", "edgeperc", "auto", 10.0, rss_mb=100.0),
        found("numpy + torch", "rival", "torch:fp32", 80.0, rss_mb=500.0),
        found("OpenVINO API fp32, network alone", "network", "openvino:fp32", 8.0),
        found("numpy + openvino:bf16", "rival", "openvino:bf16", 0.0, why_not=peers.INSTALL),
        found("peak numpy:fp32", "peak", "numpy:fp32", 1.0),
    ]
    table = latency_table("Scan to answer: pointseg", rows, 2)
    column = dict(zip(table["head"], zip(*table["rows"], strict=True), strict=True))
    assert column["x edgeperc"] == ("1.00", "8.00", "0.80", "-")
    assert column["p50"] == ("10.00", "80.00", "8.00", "-")
    assert column["note"] == ("-", "-", "-", "not installed: pip install 'edgeperc[peers]'")
    assert "whole way / OpenVINO API fp32, network alone: edgeperc, auto 1.25" in table["sentences"]


def test_the_floor_is_arithmetic_over_peak() -> None:
    pytest.importorskip("onnx")
    needs = cost(model_path("pointseg"))
    rows = [
        found("onnxruntime CPU, network alone", "session", "cpu", 50.0),
        found("OpenVINO API bf16, network alone", "network", "openvino:bf16", 20.0),
        found("peak numpy:fp32", "peak", "numpy:fp32", 40.0),
        found("peak torch:fp32", "peak", "torch:fp32", 30.0),
        found("peak copy", "peak", "copy", 20.0),
    ]
    table = floor_table("Scan to answer: pointseg", rows)
    fp32, bf16, int8 = table["rows"]
    floor = (needs.macs - needs.padding_macs) * 30.0 / PRODUCT_SIZE**3
    assert fp32[2:4] == ["torch", f"{floor:.2f}"]
    assert fp32[-2:] == ["onnxruntime CPU, network alone", f"{2.0 * floor:.1f} %"]
    assert bf16[1:4] == ["-", "-", "-"]
    assert bf16[5] == "20.00"
    assert set(int8[1:]) == {"-"} | {int8[4]}  # traffic alone is known


# the command


def test_two_networks_give_the_answers_of_one(tmp_path: Path, scan: np.ndarray) -> None:
    for package in ("onnx", "onnxscript", "torch", "tqdm"):
        pytest.importorskip(package)
    np.save(tmp_path / "scan.npy", scan)
    told = peers.groups(["ssadnet"], "auto", tmp_path, tmp_path / "scan.npy", "hdl-64e")
    one, two, lean, *_ = told["One network or two: ssadnet"]
    assert one.image is not None
    answers = []
    for contender in (one, two, lean):
        answers.append([])
        for path in contender.paths:
            engine = open_engine(contender.engine, path, 1)
            engine.input[:] = np.load(one.image)
            answers[-1] += engine.run().values()
    for a, b in zip(answers[0], answers[1], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-3 * a.std())
    assert [a.shape for a in answers[2]] == [a.shape for a in answers[0]]


@pytest.mark.parametrize(("name", "shape"), [("pointseg", (64, 256)), ("ssadnet", (200, 200))])
def test_the_same_network_for_half_the_image(
    name: str, shape: tuple[int, int], tmp_path: Path, scan: np.ndarray
) -> None:
    for package in ("onnx", "onnxscript", "torch", "tqdm"):
        pytest.importorskip(package)
    made = resized(name, 0.5, tmp_path)
    macs, whole = (cost(path).macs for path in (made, model_path(name)))
    assert macs == pytest.approx(0.5 * whole, rel=0.01)
    perceive = Perceiver([made], provider="cpu", n_threads=1, on_mismatch="ignore")
    assert perceive.sessions[0].input.shape[1:] == shape
    perceive(scan)


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing beside onnxruntime and numpy."""
    monkeypatch.setattr(peers, "NEEDS", dict.fromkeys(("openvino", "torch", "torch.compile"), ("no_such_package",)))


def test_networks_are_measured_alone_and_in_pairs(alone: None, tmp_path: Path, scan: np.ndarray) -> None:
    np.save(tmp_path / "scan.npy", scan)
    told = peers.groups(["ssadnet", "pointseg"], "cpu", tmp_path, tmp_path / "scan.npy", "hdl-64e")
    assert list(told) == [
        "Scan to answer: pointseg",
        "Scan to answer: ssadnet",
        "Scan to answer: pointseg and ssadnet",
        "Projection: range image",
        "Projection: top view",
        "One network or two: ssadnet",
    ]
    both = told["Scan to answer: pointseg and ssadnet"]
    assert {c.paths for c in both} == {(model_path("pointseg"), model_path("ssadnet"))}
    assert [c.name for c in both if not peers.absent(c)] == ["edgeperc, cpu", "numpy + onnxruntime"]


def test_what_is_absent_is_told(alone: None, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    file = tmp_path / "peers.json"
    command = ["peers", "--model", "ssadnet", "--scans", "1", "--rounds", "1", "--threads", "1", "--json", str(file)]
    assert cli.main(command) == 0
    document = json.loads(file.read_text("utf-8"))
    assert document["complete"]
    for title, contenders in document["peers"].items():
        for contender in contenders:
            rival = contender["engine"].startswith(("torch", "openvino"))
            if rival or (title.startswith("One") and contender["name"] != "one network"):
                assert contender["why_not"]
                assert not contender["rounds"]
            else:
                assert not contender["why_not"], contender
                assert min(contender["rounds"][0]) > 0.0
                assert contender["rss_mb"] > 10.0
    printed = capsys.readouterr().out
    assert printed.count(peers.INSTALL) > 10
    assert "Floor: ssadnet" in printed


def test_a_contender_that_fails_does_not_stop_the_others(tmp_path: Path) -> None:
    (tmp_path / "broken.onnx").write_bytes(b"no model")
    np.save(tmp_path / "scan.npy", np.zeros((2, 4), np.float32))
    broken = peers.Contender("broken", "session", "cpu", (tmp_path / "broken.onnx",), image=tmp_path / "scan.npy")
    peak = peers.Contender("peak", "peak", "numpy:fp32")
    first, second = measure([broken, peak], [tmp_path / "scan.npy"], say=lambda words: None)
    assert first.why_not.startswith("failed: ")
    assert len(second.ms) == 2
