"""Model files of unknown origin: refused with an error that says why, or opened; nothing hangs, nothing is printed."""

from __future__ import annotations

import contextlib
import copy
import json
import logging
import os
import struct
import tempfile
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_card import TOP_VIEW_CARD, write
from tiny_model import (
    CONVOLUTION,
    INITIALIZER,
    SHAPE,
    WEIGHTS,
    field,
    graph,
    model,
    node,
    number,
    shaped,
    tensor,
    tiny_card,
    varint,
)

import edgeperc.inference.session as session_module
import edgeperc.types.onnx_file as onnx_file
from checkout import files
from edgeperc import Perceiver
from edgeperc.errors import CardError, CardMismatchError, InferenceError, ModelError, ModelFileError
from edgeperc.inference.session import Session
from edgeperc.types.card import Golden, ModelCard
from edgeperc.types.onnx_file import check_graph, read_model
from edgeperc.zoo import digest, model_path, resolve

TINY = model(graph(CONVOLUTION, INITIALIZER))


def test_a_plain_model_is_opened(tmp_path: Path) -> None:
    session = Session(write(tmp_path, TINY), "cpu")
    assert session.golden_deviation < 1e-5
    assert Perceiver(session.path, provider="cpu").cards == (tiny_card(),)


def test_what_is_no_regular_file_is_refused_at_once(tmp_path: Path) -> None:
    pipe, folder = tmp_path / "pipe.onnx", tmp_path / "folder.onnx"
    folder.mkdir()
    paths = [folder]
    if hasattr(os, "mkfifo"):
        os.mkfifo(pipe)
        (tmp_path / "zero.onnx").symlink_to("/dev/zero")
        paths += [pipe, tmp_path / "zero.onnx"]
    card = tiny_card()
    for path in paths:
        for use in (ModelCard.read, resolve, Session, read_model, lambda path: digest([replace_path(path, card)])):
            with pytest.raises(ModelFileError, match=rf"{path.name} cannot be read"):
                use(path)


def replace_path(path: Path, card: ModelCard) -> Any:
    return replace(resolve("lodnn")[0], path=path, card=card)


def test_a_path_with_a_null_byte_is_refused() -> None:
    with pytest.raises(ModelFileError, match="without a null character"):
        Session("model\0.onnx")


def test_a_huge_file_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "huge.onnx"
    with path.open("wb") as file:
        file.truncate(2 * 10**9 + 1)  # takes no space
    with pytest.raises(ModelFileError, match="has 2000000001 bytes; expected at most 2000000000"):
        Session(path)


LOCATION = field(1, b"location") + field(2, b"/etc/passwd")
REVERSED = field(2, b"/etc/passwd") + field(1, b"location")
EXTERNAL = number(14, 1)
OUTSIDE = [
    EXTERNAL,
    field(13, LOCATION),
    field(13, REVERSED),
    field(13, b""),
    field(13, field(1, b"offset") + field(2, b"0") + LOCATION) + EXTERNAL,
    bytes([14 << 3 | 0x80, 0x00]) + varint(1),  # the number of the field written in more bytes than it needs
    number(14, 0) + EXTERNAL,
    EXTERNAL + number(14, 0),
]


def places(outside: bytes) -> dict[str, bytes]:
    """Models with such a tensor, wherever one may stand."""
    bad = tensor("v", (1,), bytes(4), more=outside)
    inner = field(5, bad)
    attribute = {
        "t": field(5, bad),
        "g": field(6, inner),
        "tensors": field(10, bad),
        "graphs": field(11, inner),
        "sparse_tensor": field(22, field(1, bad)),
        "sparse_tensors": field(23, field(2, bad)),
    }
    nodes = {name: node("Constant", "", "c", field(5, field(1, b"value") + each)) for name, each in attribute.items()}
    good = graph(CONVOLUTION, INITIALIZER)
    return {
        "initializer": model(graph(inner, CONVOLUTION, INITIALIZER)),
        "sparse_initializer": model(graph(field(15, field(1, bad)), CONVOLUTION, INITIALIZER)),
        "second graph": model(good, field(7, inner)),
        "training": model(good, field(20, field(1, inner))),
        "training algorithm": model(good, field(20, field(2, inner))),
        "function": model(good, field(25, field(7, field(5, field(5, bad))))),
        "function's attribute": model(good, field(25, field(11, field(5, bad)))),
        "subgraph of a subgraph": model(graph(node("If", "", "c", field(5, field(6, nodes["g"]))), CONVOLUTION)),
        **{name: model(graph(each, CONVOLUTION, INITIALIZER)) for name, each in nodes.items()},
    }


@pytest.mark.parametrize("outside", OUTSIDE)
@pytest.mark.parametrize("place", [*places(b"")])
def test_weights_in_other_files_are_refused(place: str, outside: bytes) -> None:
    """Also of trusted files; ``data_location`` is refused where it says what any part of a parser could take for it."""
    blob = places(outside)[place]
    with pytest.raises(ModelFileError, match="weights in other files"):
        check_graph(blob, "model.onnx", trusted=True)
    with pytest.raises(ModelFileError):
        check_graph(blob, "model.onnx")
    check_graph(places(b"")[place], "model.onnx", trusted=True)


@pytest.mark.parametrize(
    ("blob", "message"),
    [
        (TINY[:-1], "ends within the field"),
        (TINY + b"\x80", "ends within a number"),
        (field(7, field(1, b"\x0b")), "no field begins"),  # a group
        (field(7, field(5, b"\xff" * 11)), "more than ten bytes"),
        (varint((7 << 3 | 2) + 2**32) + varint(0), "no field begins"),
        (field(7, varint(1 << 3 | 2) + varint(9) + b"1234") + TINY, "ends within the field"),
        (field(7, field(1, field(5, varint(5 << 3 | 2)))), "ends within a number"),
        (field(7, b"\x10\x00" * 1001), "too many fields"),
    ],
)
def test_a_damaged_graph_is_refused(blob: bytes, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(onnx_file, "MAX_FIELDS", 1000)
    for trusted in (False, True):
        with pytest.raises(ModelFileError, match=rf"model\.onnx is not a complete \.onnx file \(.*{message}"):
            check_graph(blob, "model.onnx", trusted=trusted)


def test_onnxruntimes_own_format_is_refused() -> None:
    blob = b"\x12\x50\x00\x00ORTM" + bytes(200)
    with pytest.raises(ModelFileError, match="onnxruntime's own format"):
        check_graph(blob, "model.onnx", trusted=True)


def nested(depth: int) -> bytes:
    inner = b""
    for _ in range(depth):
        inner = node("If", "", "c", field(5, field(6, inner)))
    return model(graph(inner))


def test_a_deep_graph_is_refused() -> None:
    check_graph(nested(20), "model.onnx", trusted=True)
    with pytest.raises(ModelFileError, match="more than 32 deep"):
        check_graph(nested(2000), "model.onnx", trusted=True)


BIG = field(5, tensor("big", (512, 512), bytes(512 * 512 * 4)))
UNUSUAL_GRAPHS = {
    "has a node 'Loop'": graph(node("Loop", "x", "y")),
    "has a node 'If'": graph(node("If", "x", "y")),
    "has a node 'Scan'": graph(node("Scan", "x", "y")),
    "has a node 'SequenceMap'": graph(node("SequenceMap", "x", "y")),
    "has a node 'RandomNormal'": graph(node("RandomNormal", "", "y")),
    r"has a node 'com\.microsoft\.Conv'": graph(node("Conv", "x w", "y", field(7, b"com.microsoft")), INITIALIZER),
    "has a node that holds a graph": graph(node("Conv", "x w", "y", field(5, field(6, b""))), INITIALIZER),
    "holds a sparse tensor": graph(CONVOLUTION, field(15, b"")),
    "has a 'Conv' without its kernel_shape": graph(node("Conv", "x w", "y"), INITIALIZER),
    "has a 'QLinearConv' without its kernel_shape": graph(node("QLinearConv", "x a b w a b a b", "y"), INITIALIZER),
    "'MatMul' that computes with constants alone": graph(BIG, node("MatMul", "big big", "y")),
    "'Expand' that computes with constants alone": graph(BIG, node("Expand", "big big", "y")),
    "'Mul' that computes with constants alone": graph(node("Mul", "c c", "y"), node("Identity", "big", "c"), BIG),
    "'Tanh' that computes with constants alone": graph(node("Tanh", "", "y")),
    "more than 268435456 values from constants alone": graph(
        BIG, *(node("Cast", "big", f"c{i}") for i in range(1100)), CONVOLUTION
    ),
    "more than 20000 nodes": graph(*[node("Relu", "x", "y")] * 20_001),
}
UNUSUAL = {
    "defines functions of its own": model(graph(CONVOLUTION, INITIALIZER), field(25, b"")),
    "holds graphs for training": model(graph(CONVOLUTION, INITIALIZER), field(20, b"")),
    **{message: model(each) for message, each in UNUSUAL_GRAPHS.items()},
}


SMALL_SHAPE = field(5, tensor("shape", (2,), np.array([2**20, 2**20]).astype("<i8").tobytes(), 7))


@pytest.mark.parametrize("operator", ["ConstantOfShape", "Range", "Expand", "Tile", "NonZero"])
def test_sizes_by_constants_wait_for_a_run(operator: str) -> None:
    """Whatever they are, nothing is computed while the file is opened: neither they nor what follows from them."""
    later = graph(SMALL_SHAPE, node(operator, "shape", "z"), node("Tanh", "z", "y"))
    assert not check_graph(model(later), "model.onnx")
    by_input = graph(SMALL_SHAPE, node(operator, "x", "z"), node("Tanh", "z", "y"))
    assert check_graph(model(by_input), "model.onnx")
    assert check_graph(model(graph(CONVOLUTION, INITIALIZER)), "model.onnx")


@pytest.mark.parametrize("message", UNUSUAL)
def test_an_unusual_graph_is_opened_only_if_it_is_trusted(message: str) -> None:
    with pytest.raises(ModelFileError, match=rf"model\.onnx .*{message}.*pass trusted=True"):
        check_graph(UNUSUAL[message], "model.onnx")
    check_graph(UNUSUAL[message], "model.onnx", trusted=True)


def test_weights_have_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(onnx_file, "MAX_WEIGHT_BYTES", 1000)
    blob = model(graph(CONVOLUTION, INITIALIZER, BIG))
    with pytest.raises(ModelFileError, match="more than 1000 bytes of weights"):
        check_graph(blob, "model.onnx")
    check_graph(blob, "model.onnx", trusted=True)


@pytest.mark.parametrize("kind", [0, 29, 2**31, -(2**31)])
def test_a_tensor_has_a_type_that_onnx_knows(kind: int) -> None:
    blob = model(graph(CONVOLUTION, field(5, tensor("w", (2, 2, 1, 1), bytes(16), kind))))
    for trusted in (False, True):
        with pytest.raises(ModelFileError, match=r"tensor of the type \d+, unknown to ONNX; export it again"):
            check_graph(blob, "model.onnx", trusted=trusted)


@pytest.mark.parametrize("shape", [(2**40,), (2**20, 2**20), (2**64 - 1,), (1,) * 65])
def test_a_tensor_has_the_content_of_its_shape(shape: tuple[int, ...]) -> None:
    packed = field(1, b"".join(map(varint, shape))) + number(2, 1) + field(8, b"v") + field(9, bytes(8))
    for content in (tensor("v", shape, bytes(8)), packed):
        with pytest.raises(ModelFileError, match=r"has a tensor of .* in \d+ bytes"):
            check_graph(model(graph(field(5, content), CONVOLUTION, INITIALIZER)), "model.onnx")


@pytest.mark.parametrize("path", files(".onnx", "models"), ids=lambda path: path.stem)
def test_every_model_of_this_project_passes(path: Path) -> None:
    check_graph(path.read_bytes(), path)


def test_a_trusted_model_runs(tmp_path: Path) -> None:
    """A network with a subgraph, which onnxruntime can run."""
    inner = graph(CONVOLUTION.replace(b"\x12\x01y", b"\x12\x01z"), INITIALIZER).replace(
        field(11, shaped("x", SHAPE)) + field(12, shaped("y", SHAPE)), field(12, shaped("z", SHAPE))
    )
    branches = b"".join(
        field(5, field(1, name) + field(6, inner) + number(20, 5)) for name in (b"then_branch", b"else_branch")
    )
    condition = field(5, tensor("b", (), b"\x01", kind=9))
    path = write(tmp_path, model(graph(condition, node("If", "b", "y", branches))))
    with pytest.raises(ModelFileError, match="pass trusted=True"):
        Perceiver(path, provider="cpu")
    assert Perceiver(path, provider="cpu", trusted=True).sessions[0].golden_deviation < 1e-5


def test_onnxruntime_prints_nothing_and_its_message_is_kept(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path, model(graph(CONVOLUTION)))  # without its weights
    with pytest.raises(ModelFileError, match=r"cannot open it: .*\bw\b"):
        Session(path, "cpu")
    assert capfd.readouterr() == ("", "")


def test_a_graph_of_another_shape_than_the_cards(tmp_path: Path) -> None:
    card = replace(tiny_card(), classes=("background", "drivable", "car"))
    path = write(tmp_path, model(graph(CONVOLUTION, INITIALIZER), card=card))
    with pytest.raises(CardMismatchError, match=r"its card declares tensor\(float\) of shape \(1, 3, 16, 16\)"):
        Session(path, "cpu")


def test_a_first_run_without_end_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    path = write(tmp_path, TINY)
    enter = session_module.terminated

    def late(ort: Any, after_s: float | None) -> Any:
        assert after_s == session_module.MAX_FIRST_RUN_S
        return enter(ort, 1e-9)

    with session_module.terminated(onnxruntime, 1e-9) as options:
        while not options.terminate:  # the timer's thread sets it
            time.sleep(0.001)
    for after_s in (None, 60.0):
        with session_module.terminated(onnxruntime, after_s) as options:
            assert not options.terminate
    session = Session(path, "cpu")
    options.terminate = True
    with pytest.raises(InferenceError, match=r"(?i)terminat"):
        session.run_bound(1, options)
    session.run()

    def run_late() -> None:
        with session_module.terminated(onnxruntime, 1e-9) as options:
            while not options.terminate:
                time.sleep(0.001)
            session.run_bound(1, options)

    with pytest.raises(InferenceError, match=r"may take 1e-09 s\); try again on an idle computer, or pass trusted"):
        run_late()
    with pytest.raises(InferenceError, match=r"^another$"), session_module.terminated(onnxruntime, 60.0):
        raise InferenceError("another")
    monkeypatch.setattr(session_module, "terminated", late)
    with contextlib.suppress(InferenceError):  # the timer may come too late for so small a network
        Session(path, "cpu")


def test_a_model_without_a_golden_record_is_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write(tmp_path, model(graph(CONVOLUTION, INITIALIZER), card=replace(tiny_card(), golden=None)))
    with caplog.at_level(logging.WARNING):
        assert np.isnan(Session(path, "cpu").golden_deviation)
    assert "model.onnx has no golden record" in caplog.text


def changed(path: str, value: object) -> str:
    """The tiny card's JSON with another value at a path of keys."""
    document = json.loads(tiny_card().to_json())
    *above, key = path.split(".")
    place = document
    for each in above:
        place = place[int(each) if each.isdigit() else each]
    place[int(key) if key.isdigit() else key] = value
    return json.dumps(document)


NAN, INF = float("nan"), float("inf")
ROWS = {"kind": "range_image", "azimuth_left_deg": 45.0, "azimuth_right_deg": -45.0, "width": 1} | {
    "row_elevations_deg": [1.0, 0.0]
}


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("view.cell_m", 5e-324, r"view\.cell_m is 5e-324; expected a number from 0.001 to 100"),
        ("view.cell_m", 0.001, "16000 rows and 16000 columns; expected 1 to 4096"),
        ("view.cell_m", 90.0, "0 rows"),
        ("view.cell_m", "1", "cell_m is '1'; expected a number"),
        ("view.cell_m", True, "cell_m is True; expected a number"),
        ("view.x_range_m", [0.0, 1e200], r"view\.x_range_m\[1\] is 1e\+200; expected a number from -10000 to 10000"),
        ("view.x_range_m", [0.0, 1e308], "the number 1e.308"),
        ("view.x_range_m", [0.0, NAN], "the number nan"),
        ("view.x_range_m", [0.0, 5000.0], "5000 rows"),
        ("view.x_range_m", None, "x_range_m is None; expected a list"),
        ("view", {"kind": "range_image"}, "row_elevations_deg"),
        ("view", ROWS | {"row_elevations_deg": [9.0 - i / 500 for i in range(4097)]}, "4097 rows and 1 columns"),
        ("view", ROWS | {"width": 65_537}, "2 rows and 65537 columns"),
        (
            "view",
            ROWS | {"row_elevations_deg": [1.0 - i / 1000 for i in range(300)], "width": 60_000},
            "at most 16000000",
        ),
        ("view", ROWS | {"width": 10**300}, "10000.*columns"),
        ("view", ROWS | {"width": 2.5}, "view.width is 2.5; expected a whole number"),
        ("view", ROWS | {"width": 0}, "0 columns; expected 1 to 4096 rows"),
        ("input.mean.0", 1e9, r"input\.mean\[0\] is 1000000000.0; expected a number from -1e\+06"),
        ("input.std.1", 1e-9, r"input\.std\[1\] is 1e-09"),
        ("input.channels", ["height"] * 17, "17 channels, 2 means"),
        ("input.name", "", "input.name ''; expected 1 to 200"),
        ("name", "x" * 201, "name 'x.*expected 1 to 200 printable"),
        ("name", "\x1b[31mred", "printable characters"),
        ("name", None, "name is None; expected a text"),
        ("version", "\ud800", "not valid Unicode"),
        ("classes", [str(i) for i in range(300)], "2 to 255"),
        ("classes", "ab", "classes is 'ab'; expected a list"),
        ("box_size_priors", {"drivable": [1e9, 1, 1]}, r"box_size_priors\['drivable'\]\[0\] is 1000000000.0"),
        ("mount_height_m", 1e6, "mount_height_m is 1000000.0; expected a number from -100 to 100"),
        ("score_threshold", 10**400, "the number 1000"),
        ("precisions", {"int8": {"loss": "none"}}, "precisions.int8.loss is 'none'"),
        ("precisions", {"int8": {"loss": -1}}, "precisions.int8.loss is -1"),
        ("training", {"text": "x" * 100_001}, "text of 100001 characters"),
        ("training", {"deep": json.loads("[" * 40 + "]" * 40)}, "nested more than 32 deep"),
        ("metrics", {"iou": INF}, "the number inf"),
        ("golden.seed", -1, "golden.seed is -1; expected a whole number from 0"),
        ("golden.seed", 2**64, "golden.seed is 18446744073709551616; expected"),
        ("golden.seed", 0.5, "golden.seed is 0.5; expected a whole number"),
        ("golden.outputs", {}, "number of golden.outputs is 0"),
        ("golden.outputs", {"y": {}}, "lacks positions, std, values"),
        ("golden.outputs.y.std", NAN, "the number nan"),
        ("golden.outputs.y.std", -1.0, "std is -1.0; expected a number from 0"),
        ("golden.outputs.y.values", [], "not lists of one length"),
        ("golden.outputs.y.values", 3, "not lists of one length"),
        ("golden.outputs.y.values.3", None, r"values\[3\] is None; expected a number"),
        ("golden.outputs.y.values.3", 1e31, r"values\[3\] is 1e\+31"),
        ("golden.outputs.y.positions.3", -1, r"positions\[3\] is -1; expected a whole number from 0"),
        ("golden.outputs.y.positions.3", 1.5, r"positions\[3\] is 1.5; expected a whole number"),
        ("golden.outputs.y.positions.3", 512, "has position 512; the output has 512 values"),
        ("golden.outputs.y.positions", [1] * 32, "has 1 different positions; expected 16 or more"),
        ("golden.outputs.y", {"std": 1, "positions": [], "values": []}, "number of .*values is 0"),
        ("golden.outputs.y", {"std": 1, "positions": [1], "values": [1]}, "has 1 different positions"),
    ],
)
def test_a_number_out_of_its_bounds_is_named(path: str, value: object, message: str) -> None:
    with pytest.raises(CardError, match=message) as caught:
        ModelCard.from_json(changed(path, value))
    assert len(str(caught.value)) < 400


def test_a_golden_record_of_a_small_output_may_be_short() -> None:
    golden = Golden(0, "", {"y": {"std": 1.0, "positions": [0, 1, 2], "values": [0.0] * 3}})
    golden.check_output("y", 3)
    with pytest.raises(CardError, match="3 different positions; expected 4 or more"):
        golden.check_output("y", 4)


def opened_or_refused(blob: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = write(Path(folder), blob)
        try:
            Session(path, "cpu", n_threads=1).run()
        except (ModelError, InferenceError) as exc:
            message = str(exc)
        else:
            return
    assert "model.onnx" in message


def mutated(data: st.DataObject, blob: bytes) -> bytes:
    """Bytes set, cut out, doubled or put in; now and then two stretches swapped."""
    content = bytearray(blob)
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, max(len(content) - 1, 0)))
        length = data.draw(st.integers(1, 64))
        kind = data.draw(st.sampled_from(["set", "flip", "cut", "end", "double", "insert", "swap"]))
        stretch = bytes(content[at : at + length])
        if kind == "set" and content:
            content[at] = data.draw(st.integers(0, 255))
        elif kind == "flip" and content:
            content[at] ^= 1 << data.draw(st.integers(0, 7))
        elif kind == "cut":
            del content[at : at + length]
        elif kind == "end":
            del content[at:]
        elif kind == "double":
            content[at:at] = stretch
        elif kind == "insert":
            content[at:at] = data.draw(st.binary(max_size=16))
        elif kind == "swap":
            other = bytes(content[at + length : at + 2 * length])
            content[at : at + 2 * length] = other + stretch
    return bytes(content)


QUIET = settings(derandomize=True, database=None)


@settings(QUIET, max_examples=200)
@given(st.data())
def test_a_changed_tiny_model_is_opened_or_refused(data: st.DataObject) -> None:
    opened_or_refused(mutated(data, TINY))


@settings(QUIET, max_examples=200)
@given(st.data())
def test_a_changed_tiny_graph_is_opened_or_refused(data: st.DataObject) -> None:
    """The card stays whole, so that more of the changed graphs come to onnxruntime."""
    opened_or_refused(model(mutated(data, graph(CONVOLUTION, INITIALIZER))))


@settings(QUIET, max_examples=100)
@given(st.data())
def test_a_changed_shipped_model_is_opened_or_refused(data: st.DataObject) -> None:
    opened_or_refused(mutated(data, model_path("lodnn:int8").read_bytes()))


def paths_of(value: object, above: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    inner: list[tuple[Any, Any]] = []
    if isinstance(value, dict):
        inner = [*value.items()]
    elif isinstance(value, list):
        inner = [*enumerate(value)]
    return [above, *(path for key, each in inner for path in paths_of(each, (*above, key)))]


NUMBERS = [NAN, INF, -INF, 1e308, -1e308, 5e-324, -1, 0, 2**31, 2**63, -(2**63), 10**400]
OTHERS = [None, True, "", "x", "\ud800", [], {}, [[[[]]]], {"a": {"a": None}}, "x" * 10**5, [0] * 1000, [NAN, NAN]]
STRANGE = st.sampled_from(NUMBERS + OTHERS)


@settings(QUIET, max_examples=300)
@given(st.data())
def test_a_changed_card_is_read_or_refused(data: st.DataObject) -> None:
    source = tiny_card() if data.draw(st.booleans()) else TOP_VIEW_CARD
    document = json.loads(source.to_json())
    for _ in range(data.draw(st.integers(1, 2))):
        *above, key = data.draw(st.sampled_from(paths_of(document)[1:]))
        place = document
        for each in above:
            place = place[each]
        place[key] = copy.deepcopy(data.draw(STRANGE))
    text = json.dumps(document)
    try:
        card = ModelCard.from_json(text)
    except CardError:
        return
    assert ModelCard.from_json(card.to_json()) == card
    opened_or_refused(model(graph(CONVOLUTION, INITIALIZER), card=text.encode()))


def test_a_shape_is_read_packed_or_not() -> None:
    packed = field(1, varint(2) + varint(2) + varint(1) + varint(1))
    content = packed + number(2, 1) + field(8, b"w") + field(4, struct.pack("<4f", *WEIGHTS.ravel()))
    check_graph(model(graph(CONVOLUTION, field(5, content))), "model.onnx")


def test_reading_a_model_asks_for_its_size_alone(tmp_path: Path) -> None:
    """A buffer of the largest size would be asked for otherwise, which a limit of the memory refuses."""
    path = tmp_path / "small.onnx"
    path.write_bytes(b"x" * 1000)
    tracemalloc.start()
    try:
        assert onnx_file.read_model(path) == b"x" * 1000
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()
