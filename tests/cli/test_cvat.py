"""CVAT's function: requests as CVAT's lambda manager sends them, through nuclio's events."""

from __future__ import annotations

import base64
import functools
import json
import re
import runpy
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from test_files import packed_pcd, pcd, text_rows

from checkout import REPOSITORY
from cli_helpers import thinned
from edgeperc import Box, OptionError, Perceiver
from edgeperc.cli.cvat import OPTIONS_VARIABLE, CvatFunction, handler, init_context
from edgeperc.zoo import DEFAULT, OPEN, resolve
from scenes import urban

yaml = pytest.importorskip("yaml")

FOLDER = REPOSITORY / "recipe/cvat"
CONTAINERFILE = (FOLDER / "Containerfile").read_text("utf-8")
(OPTIONS_TEXT,) = re.findall(rf"^ENV {OPTIONS_VARIABLE}='(.*)'$", CONTAINERFILE, flags=re.MULTILINE)
FUNCTION = yaml.safe_load((FOLDER / "function.yaml").read_text("utf-8"))
LABELS = json.loads(FUNCTION["metadata"]["annotations"]["spec"])

pytestmark = [
    pytest.mark.filterwarnings("ignore::UserWarning"),  # what a perceiver says of a simulated scan
    pytest.mark.usefixtures("networks_opened_once"),
]


class Reply(NamedTuple):
    status: int
    content_type: str
    answer: Any


def binary_pcd(points: NDArray[np.float32]) -> bytes:
    """What CVAT makes of KITTI's .bin."""
    return pcd("x y z intensity", "F F F F", "4 4 4 4", "1 1 1 1", len(points), "binary", points.tobytes())


def ascii_pcd(points: NDArray[np.float32]) -> bytes:
    return pcd("x y z intensity", "F F F F", "4 4 4 4", "1 1 1 1", len(points), "ascii", text_rows(points))


FORMATS: dict[str, Callable[[NDArray[np.float32]], bytes]] = {
    "binary .pcd": binary_pcd,
    "ascii .pcd": ascii_pcd,
    "binary_compressed .pcd": packed_pcd,
    ".bin": lambda points: points.tobytes(),
}


def request(content: bytes, **others: object) -> dict[str, object]:
    """The payload of CVAT's lambda manager for a detector."""
    return {**others, "image": base64.b64encode(content).decode("utf-8")}


@functools.cache
def started() -> SimpleNamespace:
    """What nuclio starts, with the options of the container."""
    logged: list[str] = []
    context = SimpleNamespace(
        user_data=SimpleNamespace(), logger=SimpleNamespace(warn=logged.append), logged=logged, Response=None
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(OPTIONS_VARIABLE, OPTIONS_TEXT)
        init_context(context)
    return context


def post(payload: object) -> Reply:
    """As nuclio does: a JSON body is decoded, any other is given as bytes; the answer is a text."""
    context = started()
    context.Response = lambda **parts: SimpleNamespace(**parts)
    response = handler(context, SimpleNamespace(body=payload))
    assert isinstance(response.body, str)
    return Reply(response.status_code, response.content_type, json.loads(response.body))


def post_by_sdk(payload: object) -> Reply:
    """The same through nuclio's own event and response."""
    sdk = pytest.importorskip("nuclio_sdk")
    body = payload if isinstance(payload, bytes) else json.dumps(payload).encode()
    names = "id method path size url shard_id num_shards type type_version version"
    message = dict.fromkeys(names.split()) | {"fields": {}, "headers": {}, "timestamp": 0}
    message |= {"trigger": {"kind": "http", "name": "t"}, "content_type": "application/json", "body": body}
    event = sdk.Event.deserialize(message, kind=sdk.event.EventDeserializerKinds.msgpack)
    context = started()
    context.Response = sdk.Response
    sent = sdk.Response.from_entrypoint_output(json.dumps, handler(context, event))
    return Reply(sent["status_code"], sent["content_type"], json.loads(sent["body"]))


def street(seed: int = 4, sensor: str = "hdl-64e") -> NDArray[np.float32]:
    return urban(seed, thinned(sensor)).points


@functools.cache
def expected(seed: int = 4, sensor: str = "hdl-64e", threshold: float | None = None) -> tuple[Box, ...]:
    """Boxes of a perceiver that has seen no other scan."""
    options = json.loads(OPTIONS_TEXT) | ({} if threshold is None else {"score_threshold": threshold})
    return Perceiver(**options)(street(seed, sensor)).boxes


def check(shapes: Any, boxes: tuple[Box, ...]) -> None:
    """Each shape has what CVAT reads of it, and its 16 numbers are those of the box."""
    assert [each["label"] for each in shapes] == [box.label for box in boxes]
    assert {each["label"] for each in shapes} <= {label["name"] for label in LABELS}
    for each, box in zip(shapes, boxes, strict=True):
        assert each["type"] == "cuboid"
        assert float(each["confidence"]) == pytest.approx(box.score, abs=1e-4)
        points = each["points"]
        assert len(points) == 16
        assert points[3:5] == [0.0, 0.0]
        assert points[9:] == [0.0] * 7
        assert [*points[:3], *points[6:9]] == pytest.approx([*box.center, *box.size], abs=1e-4)
        assert np.exp(1j * points[5]) == pytest.approx(np.exp(1j * box.yaw), abs=1e-4)


@pytest.mark.parametrize(
    ("kind", "seed", "sensor"),
    [*((kind, 4, "hdl-64e") for kind in FORMATS), (".bin", 5, "hdl-64e"), (".bin", 4, "os1-64")],
)
def test_shapes_are_the_boxes_of_a_perceiver(kind: str, seed: int, sensor: str) -> None:
    boxes = expected(seed, sensor)
    assert len(boxes) >= 3
    status, content_type, shapes = post(request(FORMATS[kind](street(seed, sensor))))
    assert (status, content_type) == (200, "application/json")
    check(shapes, boxes)


@pytest.mark.filterwarnings("ignore:datetime.datetime.utcfromtimestamp:DeprecationWarning")
def test_nuclios_own_events_and_answers() -> None:
    status, content_type, shapes = post_by_sdk(request(binary_pcd(street()), threshold=0.5))
    assert (status, content_type) == (200, "application/json")
    check(shapes, expected(threshold=0.5))
    for body in (b"", b"{", b"[]"):
        assert post_by_sdk(body).status == 400


@pytest.mark.parametrize("threshold", [0.1, 0.9, 1])
def test_the_threshold_of_a_request_is_the_perceivers(threshold: float) -> None:
    reply = post(request(binary_pcd(street()), threshold=threshold))
    check(reply.answer, expected(threshold=threshold))
    assert all(float(each["confidence"]) >= threshold - 1e-4 for each in reply.answer)
    check(post(request(binary_pcd(street()))).answer, expected())


def test_thresholds_show_fewer_boxes() -> None:
    assert len(expected(threshold=0.1)) > len(expected(threshold=0.9))


def test_a_scan_without_points_has_no_boxes() -> None:
    assert post(request(binary_pcd(np.zeros((0, 4), np.float32)))) == (200, "application/json", [])


IMAGE = b"\xff\xd8\xff\xe0" + np.random.default_rng(0).bytes(16_000 - 4)
FAULTS: dict[str, tuple[object, int, str, str]] = {
    "no JSON": (b"{", 400, "OptionError", "bytes.*JSON object"),
    "a list": ([1], 400, "OptionError", "list.*JSON object"),
    "no image": ({"threshold": 0.5}, 400, "OptionError", "'threshold'.*scan in base64"),
    "nothing": ({}, 400, "OptionError", "nothing.*scan in base64"),
    "image of a number": ({"image": 3}, 400, "OptionError", "image is 3"),
    "no base64": ({"image": "%%%%"}, 400, "OptionError", "'%%%%', no base64"),
    "base64 cut short": ({"image": "QUJDR"}, 400, "OptionError", "no base64"),
    "no ASCII": ({"image": "é"}, 400, "OptionError", "no base64"),
    "threshold of a text": ({"image": "", "threshold": "high"}, 400, "OptionError", "'high'.*0..1"),
    "threshold of a flag": ({"image": "", "threshold": True}, 400, "OptionError", "True.*0..1"),
    "threshold of a list": ({"image": "", "threshold": [0.5]}, 400, "OptionError", "0..1"),
    "threshold out of range": ({"image": "", "threshold": 50}, 400, "OptionError", "50.*0..1"),
    "an empty file": ({"image": ""}, 422, "PointsError", "empty"),
    "a JPEG": (request(IMAGE), 422, "PointsError", "an image"),
    "a PCD cut short": (request(binary_pcd(street())[:9999]), 422, "PointsError", "cut short|bytes"),
    "too few points": (request(binary_pcd(np.ones((9, 4), np.float32))), 422, "SensorError", "9 points"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_wrong_request_is_answered_with_what_came_and_what_was_expected(fault: str) -> None:
    payload, status, kind, words = FAULTS[fault]
    reply = post(payload)
    assert (reply.status, reply.content_type, reply.answer["error"]) == (status, "application/json", kind)
    assert re.search(words, reply.answer["message"])
    assert started().logged[-1] == f"{kind}: {reply.answer['message']}"
    assert len(reply.answer["message"]) < 600
    check(post(request(binary_pcd(street()))).answer, expected())  # it goes on


VALUES = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text() | st.binary().map(lambda b: base64.b64encode(b).decode()),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


@settings(max_examples=60)
@given(st.binary(max_size=50) | VALUES | st.fixed_dictionaries({"image": VALUES}, optional={"threshold": VALUES}))
def test_no_request_ends_the_function(payload: object) -> None:
    reply = post(payload)
    assert reply.status in (400, 422)
    assert reply.answer.keys() == {"error", "message"}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "no JSON"),
        ('["auto"]', "a JSON object"),
        ('{"sensr": "auto"}', "'sensr'.*sensor"),
        ('{"score_threshold": 7}', "score_threshold is 7"),
    ],
)
def test_wrong_options_are_told_at_the_start(text: str, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(OPTIONS_VARIABLE, text)
    with pytest.raises(OptionError, match=words):
        init_context(SimpleNamespace(user_data=SimpleNamespace()))


def test_options_without_a_threshold_of_the_request() -> None:
    function = CvatFunction(**json.loads(OPTIONS_TEXT), score_threshold=0.9)
    check(function.annotate(request(binary_pcd(street()))), expected(threshold=0.9))


def test_labels_are_the_classes_of_the_models() -> None:
    classes = {name for model in (*DEFAULT, *OPEN) for name in resolve(model)[0].card.box_classes}
    classes |= {*resolve("pointseg")[0].card.classes[1:]}
    assert len(LABELS) == len({label["id"] for label in LABELS}) == len(classes)
    assert {label["name"] for label in LABELS} == classes
    assert {label["type"] for label in LABELS} == {"cuboid"}


def test_function_yaml_is_of_what_is_here() -> None:
    metadata, spec = FUNCTION["metadata"], FUNCTION["spec"]
    assert (metadata["namespace"], metadata["annotations"]["type"]) == ("cvat", "detector")
    module, _, entry = spec["handler"].partition(":")
    found = runpy.run_path(str(FOLDER / f"{module}.py"))
    assert (found[entry], found["init_context"]) == (handler, init_context)
    base = (REPOSITORY / "Containerfile").read_text("utf-8")
    assert set(re.findall(r"/(python:\d+\.\d+)\.\d+-slim", base)) == {spec["runtime"]}
    (trigger,) = spec["triggers"].values()
    largest = 64 * len(json.dumps(request(bytes(2**22 // 4))))  # four million points
    assert trigger["kind"] == "http"
    assert trigger["attributes"]["maxRequestBodySize"] > largest


def test_the_container_is_edgepercs_own_with_a_command_for_nuclio() -> None:
    lines = CONTAINERFILE.splitlines()
    assert [line for line in lines if line.startswith(("ARG", "FROM"))] == ["ARG EDGEPERC=edgeperc", "FROM ${EDGEPERC}"]
    assert int([line.split()[1] for line in lines if line.startswith("USER")][-1]) >= 1000
    assert "ENTRYPOINT []" in lines
    assert all("==" in each for each in re.findall(r":all: (.*)$", CONTAINERFILE, flags=re.M)[0].split())
