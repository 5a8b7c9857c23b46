"""Cards: what is written is read back, and every corruption has its own error."""

from __future__ import annotations

import contextlib
import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tiny_model import entry, field, varint

from checkout import files
from edgeperc.errors import CardError, ModelFileError
from edgeperc.types.card import CARD_KEY, Golden, InputSpec, ModelCard, OutputSpec
from edgeperc.types.views import CameraGeometry, RangeImageGeometry, TopViewGeometry
from strategies import JSON

TOP_VIEW_CARD = ModelCard(
    name="network",
    version="1.2.3",
    view=TopViewGeometry(),
    input=InputSpec("x", ("distance", "height"), (0.0, -2.5), (47.0, 5.0)),
    outputs=(OutputSpec("map", "class_logits"), OutputSpec("boxes", "box_dense")),
    classes=("background", "drivable", "car"),
    box_classes=("car",),
    box_size_priors={"car": (3.9, 1.6, 1.5)},
    fitness={"a": 1.0},
    training={"licence": "Apache-2.0", "data": "Straße"},
    golden=Golden(7, "00", {"map": {"positions": [*range(16)], "values": [0.5] * 16, "std": 1.0, "sha256": "11"}}),
)
RANGE_CARD = replace(
    TOP_VIEW_CARD,
    view=RangeImageGeometry((2.0, 0.0, -5.0), width=2048, azimuth_left_deg=180.0, azimuth_right_deg=-180.0),
    input=InputSpec("x", ("range",), (10.0,), (5.0,)),
    outputs=(OutputSpec("p", "class_probabilities"),),
    box_classes=(),
    box_size_priors={},
    golden=None,
)


FRONT_CARD = replace(TOP_VIEW_CARD, outputs=(TOP_VIEW_CARD.outputs[0], OutputSpec("boxes", "box_dense", front=True)))
HEIGHT_CARD = replace(
    RANGE_CARD, input=InputSpec("x", ("range", "height_above_ground"), (10.0, 0.4), (5.0, 0.7)), precision="int8"
)
CAMERA = InputSpec("image", ("red", "green", "blue"), (128.0,) * 3, (64.0,) * 3)
CAMERA_CARD = replace(
    RANGE_CARD,
    view=CameraGeometry(480, 360),
    input=CAMERA,
    outputs=(OutputSpec("logits", "camera_logits"),),
    classes=("Sky", "Road"),
    fitness=None,
)


def refuse(document: Any, message: str) -> None:
    with pytest.raises(CardError, match=message):
        ModelCard.from_json(json.dumps(document))


@pytest.mark.parametrize("card", [TOP_VIEW_CARD, RANGE_CARD, FRONT_CARD, HEIGHT_CARD, CAMERA_CARD])
def test_card_is_read_back_from_json(card: ModelCard) -> None:
    assert ModelCard.from_json(card.to_json()) == card
    assert ModelCard.from_json(card.to_json()).to_json() == card.to_json()
    later = json.loads(card.to_json()) | {"from_the_future": [1, 2]}
    assert ModelCard.from_json(json.dumps(later)) == card


def test_a_card_says_whether_boxes_have_a_front() -> None:
    assert TOP_VIEW_CARD.output_shape("box_dense") == (1, 9, 100, 50)
    assert FRONT_CARD.output_shape("box_dense") == (1, 11, 100, 50)
    assert FRONT_CARD.output_shape("class_logits") == (1, 3, 400, 200)
    document = json.loads(TOP_VIEW_CARD.to_json())
    for output in document["outputs"]:  # as cards were before there was a front
        del output["front"]
    assert ModelCard.from_json(json.dumps(document)) == TOP_VIEW_CARD
    for wrong in (1, "true", None):
        document["outputs"][1]["front"] = wrong
        refuse(document, r"outputs\[1\]\.front is .*; expected true or false")
    for kind in ("class_logits", "class_probabilities", "box_slots"):
        with pytest.raises(CardError, match=f"'o' of kind {kind} has a front; only box_dense may"):
            OutputSpec("o", kind, front=True)


BOXES = {"outputs": (*RANGE_CARD.outputs, OutputSpec("b", "box_slots")), "box_classes": ("car",)}
LOGITS = (OutputSpec("p", "class_logits"), OutputSpec("c", "camera_logits"))


@pytest.mark.parametrize(
    ("card", "change", "message"),
    [
        (CAMERA_CARD, {"outputs": LOGITS[:1]}, "of a camera; expected one, camera_logits"),
        (CAMERA_CARD, {"outputs": ()}, "of a camera; expected one, camera_logits"),
        (CAMERA_CARD, {"input": replace(CAMERA, channels=("red", "red", "blue"))}, "expected red, green and blue"),
        (CAMERA_CARD, {"input": InputSpec("x", ("red",), (0.0,), (1.0,))}, "expected red, green and blue"),
        (CAMERA_CARD, {"input": RANGE_CARD.input}, "unknown to a camera"),
        (CAMERA_CARD, {"fitness": {"a": 1.0}}, "fitness"),
        (RANGE_CARD, {"outputs": LOGITS}, "one class output"),
        (RANGE_CARD, BOXES, "boxes need a top_view"),
        (TOP_VIEW_CARD, {"input": HEIGHT_CARD.input}, "unknown to a top_view"),
    ],
)
def test_what_another_view_may_not_have(card: ModelCard, change: dict[str, Any], message: str) -> None:
    with pytest.raises(CardError, match=message):
        replace(card, **change)


def test_cameras_say_how_an_image_is_scaled() -> None:
    assert CAMERA_CARD.output_shape("camera_logits") == (1, 2, None, None)
    assert (CAMERA_CARD.view.height, CAMERA_CARD.view.width) == (360, 480)
    for view in ({"width": 0}, {"height": 5000}, {"width": 65_536, "height": 4096}, {"fit": "crop"}):
        document = json.loads(CAMERA_CARD.to_json())
        document["view"] |= view
        refuse(document, "expected")


def test_inputs_and_shapes_that_cards_tell() -> None:
    assert HEIGHT_CARD.input.needs_ground
    assert not RANGE_CARD.input.needs_ground
    assert RANGE_CARD.output_shape("class_probabilities") == (1, 3, 3, 2048)


def test_top_view_holds_positions_in_its_cells() -> None:
    view = TopViewGeometry()
    for place in ((6.0, -10.0), (45.99, 9.99), (20.0, 0.0)):
        assert view.holds(*place)
    for place in ((5.99, 0.0), (46.0, 0.0), (20.0, 10.0), (20.0, -10.01), (-20.0, 0.0)):
        assert not view.holds(*place)


@pytest.mark.parametrize("key", sorted(json.loads(TOP_VIEW_CARD.to_json())))
def test_missing_keys_are_refused(key: str) -> None:
    document = json.loads(TOP_VIEW_CARD.to_json())
    del document[key]
    refuse(document, key)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema": 4}, "schema 4.*upgrade edgeperc"),
        ({"precision": "fp8"}, "'fp8'; expected fp32 or int8"),
        ({"precisions": [1]}, r"precisions is \[1\]; expected an object"),
        ({"precisions": {"int8": [["loss", 0.1]]}}, "precisions.*expected an object"),
        ({"schema": 0}, "schema 0.*export the model again"),
        ({"schema": 2}, "schema 2.*export the model again"),
        ({"schema": "1"}, "schema '1'; expected 3"),
        ({"name": ""}, "name ''"),
        ({"classes": ["background", "background"]}, "different names"),
        ({"classes": ["background"]}, "2 to 255"),
        ({"classes": ["background", "drivable", "Car"]}, "class 'Car' would be .*; write 'car'"),
        ({"classes": ["drivable", "background", "car"]}, "begin with 'drivable', which would be the background"),
        ({"classes": ["car", "tram", "bus"]}, "begin with 'car', which would be the background"),
        ({"classes": ["background", "road", "car"]}, "'road' of a top view would be no .*; write 'drivable'"),
        ({"outputs": [{"name": "a", "kind": "magic"}]}, "'magic'.*class_logits"),
        ({"outputs": []}, "one class output"),
        ({"box_classes": []}, "without box_classes"),
        ({"box_classes": ["tram"]}, r"box_classes has \['tram'\], not among"),
        ({"box_size_priors": {"tram": [1, 2, 3]}}, r"box_size_priors has \['tram'\], not among"),
        ({"score_threshold": 1.5}, "score_threshold"),
        ({"box_size_priors": {"car": []}}, "expected a list of 3 numbers"),
        ({"box_size_priors": {"car": [1, 2, 3, 4]}}, "expected a list of 3 numbers"),
        ({"view": {"kind": "sphere"}}, "'sphere'.*top_view"),
        ({"view": 3}, "view is 3; expected an object"),
        ({"input": {"name": "x", "channels": ["color"], "mean": [0], "std": [1]}}, "color"),
        ({"input": {"name": "x", "channels": ["height"], "mean": [0, 1], "std": [1]}}, "2 means"),
        ({"input": {"name": "x", "channels": ["height"], "mean": [0], "std": [0]}}, r"input.std\[0\] is 0"),
    ],
)
def test_each_corruption_is_named(change: dict[str, Any], message: str) -> None:
    refuse(json.loads(TOP_VIEW_CARD.to_json()) | change, message)


@pytest.mark.parametrize(
    ("kind", "view"),
    [
        (RangeImageGeometry, {"row_elevations_deg": (0.0, 1.0)}),
        (RangeImageGeometry, {"row_elevations_deg": (1.0,)}),
        (RangeImageGeometry, {"row_elevations_deg": (1.0, 0.0), "width": 0}),
        (RangeImageGeometry, {"row_elevations_deg": (1.0, 0.0), "azimuth_left_deg": -60.0}),
        (TopViewGeometry, {"x_range_m": (46.0, 6.0)}),
        (TopViewGeometry, {"cell_m": 0.0}),
        (TopViewGeometry, {"z_range_m": (0.0, float("nan"))}),
    ],
)
def test_impossible_views_are_refused(kind: type[Any], view: dict[str, Any]) -> None:
    with pytest.raises(CardError, match="expected"):
        kind(**view)


def test_deeply_nested_json_is_a_card_error() -> None:
    with pytest.raises(CardError, match="not JSON"):
        ModelCard.from_json("[" * 200_000)


@given(st.text() | JSON.map(json.dumps))
def test_anything_else_is_a_card_error(text: str) -> None:
    with pytest.raises(CardError):
        ModelCard.from_json(text)


@given(st.sampled_from(sorted(json.loads(TOP_VIEW_CARD.to_json()))), JSON)
def test_any_value_anywhere_is_read_or_refused(key: str, value: object) -> None:
    document = json.loads(TOP_VIEW_CARD.to_json()) | {key: value}
    with contextlib.suppress(CardError):
        ModelCard.from_json(json.dumps(document))


def test_positions_and_cells_agree() -> None:
    view = TopViewGeometry()
    x, y = view.cell_centers()
    rows, cols, in_view = view.cells(x, y)
    assert in_view.all()
    np.testing.assert_array_equal(rows, np.broadcast_to(np.arange(400)[:, None], (400, 200))[:, :1])
    np.testing.assert_array_equal(cols[0], np.arange(200))
    places = np.array([[46.0, 10.0], [46.01, 0.0], [6.0, 0.0], [5.99, 0.0], [20.0, -10.0], [np.nan, 0.0], [1e30, 0.0]])
    rows, cols, in_view = view.cells(*places.T)
    assert in_view.tolist() == [True, False, False, False, False, False, False]
    assert (rows[0], cols[0]) == (0, 0)  # a cell holds its far and left edges


CARD = entry(CARD_KEY, TOP_VIEW_CARD.to_json().encode())
GRAPH = varint(1 << 3) + varint(8) + field(2, b"pytorch") + field(7, bytes(range(256)) * 40)


def write(folder: Path, content: bytes) -> Path:
    path = folder / "model.onnx"
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    "content",
    [
        GRAPH + CARD,
        CARD + GRAPH,
        GRAPH + entry("author", b"nobody") + CARD + entry("edgeperc.cards", b"{}"),
        entry(CARD_KEY, b"an older one") + CARD,  # the last one counts
        GRAPH + field(14, field(2, TOP_VIEW_CARD.to_json().encode()) + field(1, CARD_KEY.encode())),
        varint(9 << 3 | 1) + bytes(8) + varint(10 << 3 | 5) + bytes(4) + CARD,  # fields of fixed length
    ],
)
def test_a_card_is_found_in_a_file(tmp_path: Path, content: bytes) -> None:
    assert ModelCard.read(write(tmp_path, content)) == TOP_VIEW_CARD


@pytest.mark.parametrize("content", [b"", GRAPH, entry("author", b"nobody"), field(7, CARD)])
def test_file_without_a_card_is_a_card_error(tmp_path: Path, content: bytes) -> None:
    with pytest.raises(CardError, match=r"model\.onnx has no card; .* card MODEL CARD\.json OUT"):
        ModelCard.read(write(tmp_path, content))


@pytest.mark.parametrize(
    "content",
    [
        GRAPH[:-1],
        (GRAPH + CARD)[:-1],
        varint(7 << 3 | 2) + varint(2**40),
        varint(7 << 3 | 2) + b"\xff" * 11,
        varint(7 << 3 | 3),  # groups are no part of an .onnx
        varint(7 << 3 | 7),
        b"\x00",
        b"\x80",
        field(14, varint(1 << 3 | 2) + varint(5)),
        (varint(9 << 3) + b"\x00") * 20_000,
    ],
)
def test_damaged_file_is_a_model_file_error(tmp_path: Path, content: bytes) -> None:
    with pytest.raises(ModelFileError, match=r"model\.onnx is not a complete \.onnx file"):
        ModelCard.read(write(tmp_path, content))


def test_a_card_is_json_in_utf_8_of_at_most_16_mb(tmp_path: Path) -> None:
    with pytest.raises(CardError, match=r"model\.onnx: the card is not JSON"):
        ModelCard.read(write(tmp_path, entry(CARD_KEY, b"{")))
    with pytest.raises(CardError, match=r"model\.onnx: the entry edgeperc\.card is not UTF-8"):
        ModelCard.read(write(tmp_path, entry(CARD_KEY, b"\xff\xfe")))
    with pytest.raises(CardError, match=r"model\.onnx: the entry edgeperc\.card has 16000001 bytes; expected at most"):
        ModelCard.read(write(tmp_path, entry(CARD_KEY, b" " * 16_000_001)))
    with pytest.raises(CardError, match="16000001 characters; expected at most 16000000"):
        ModelCard.from_json(" " * 16_000_001)


def test_a_missing_file_is_a_model_file_error(tmp_path: Path) -> None:
    for path in (tmp_path / "model.onnx", tmp_path):
        with pytest.raises(ModelFileError, match="cannot be read"):
            ModelCard.read(path)


@given(st.data())
def test_any_bytes_are_a_card_or_an_error(data: st.DataObject) -> None:
    content = bytearray(GRAPH[-300:] + CARD if data.draw(st.booleans()) else GRAPH + CARD)
    for _ in range(data.draw(st.integers(0, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        kind = data.draw(st.sampled_from(["set", "cut", "insert"]))
        if kind == "set":
            content[at] = data.draw(st.integers(0, 255))
        elif kind == "cut":
            del content[at : at + data.draw(st.integers(1, 40))]
        else:
            content[at:at] = data.draw(st.binary(max_size=20))
        if not content:
            break
    with tempfile.TemporaryDirectory() as folder, contextlib.suppress(CardError, ModelFileError):
        ModelCard.read(write(Path(folder), bytes(content)))


@pytest.mark.parametrize("path", files(".onnx", "models"), ids=lambda path: path.stem)
def test_every_models_card_is_the_one_that_onnxruntime_finds(path: Path) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    text = session.get_modelmeta().custom_metadata_map[CARD_KEY]
    assert ModelCard.read(path) == ModelCard.from_json(text)
