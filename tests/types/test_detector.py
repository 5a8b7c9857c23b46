"""Cards of detectors on pillars: read back, each wrong entry named, and the one in the documentation is valid."""

from __future__ import annotations

import copy
import json
import re
from dataclasses import replace
from typing import Any

import pytest
from test_card import refuse

from checkout import REPOSITORY
from edgeperc.errors import CardError
from edgeperc.types.card import InputSpec, ModelCard, OutputSpec
from edgeperc.types.detector import AnchorHead, CenterHead, PillarGeometry
from edgeperc.types.views import TopViewGeometry

PAGE = REPOSITORY / "docs" / "howto" / "own-network.md"
(KITTI,) = re.findall(r"```json\n(.*?)```", PAGE.read_text("utf-8"), flags=re.DOTALL)
CENTERS: dict[str, Any] = {
    "kind": "centers",
    "classes": ["car", "bus", "truck", "pedestrian"],
    "stride": 4,
    "scores": "logits",
    "max_candidates": 500,
    "across_classes": False,
    "groups": [1, 2, 1],
    "rotation": "sin_cos",
}


def document() -> Any:
    return json.loads(KITTI)


def centers() -> Any:
    """Of a center head in three groups, two of whose classes are of one kind."""
    outputs = [{"name": f"{kind}{k}", "kind": kind} for k in range(3) for kind in ("heatmap", "reg", "height", "dim")]
    outputs.append({"name": "rot", "kind": "rot"})
    return document() | {
        "head": copy.deepcopy(CENTERS),
        "outputs": outputs,
        "classes": ["background", "car", "truck", "pedestrian"],
        "box_classes": ["car", "truck", "truck", "pedestrian"],
    }


def test_the_documented_card_is_that_of_openpcdet() -> None:
    card = ModelCard.from_json(KITTI)
    assert isinstance(card.view, PillarGeometry)
    assert isinstance(card.head, AnchorHead)
    assert (card.view.height, card.view.width) == (496, 432)
    assert card.input_shape == (None, 32, 4)
    assert [card.shape_of(output) for output in card.outputs] == [(1, 248, 216, n) for n in (18, 42, 12)]
    assert card.head.n_anchors == 6
    assert not card.view.is_all_around
    assert not card.input.needs_ground
    assert ModelCard.from_json(KITTI, exact=True) == card
    with pytest.raises(CardError, match=r"head\.anchors\[0\] has unknown entries ranges; expected some of .*range_m"):
        ModelCard.from_json(KITTI.replace('"yaws_rad"', '"ranges": [0], "yaws_rad"'), exact=True)


@pytest.mark.parametrize("given", [document(), centers(), document() | {"outputs": document()["outputs"][:2]}])
def test_cards_of_detectors_are_read_back(given: Any) -> None:
    card = ModelCard.from_json(json.dumps(given))
    assert ModelCard.from_json(card.to_json()) == card
    assert ModelCard.from_json(card.to_json()).to_json() == card.to_json()


def test_shapes_of_a_center_head() -> None:
    """One output for each group, or one for all."""
    card = ModelCard.from_json(json.dumps(centers()))
    assert isinstance(card.head, CenterHead)
    shapes = {output.name: card.shape_of(output) for output in card.outputs}
    assert [shapes[f"heatmap{k}"][1] for k in range(3)] == [1, 2, 1]
    assert shapes["dim2"] == (1, 3, 124, 108)
    assert shapes["rot"] == (1, 6, 124, 108)
    names = ("heatmap", "reg_height_dim_vel", "rot")
    joined = replace(card, outputs=tuple(OutputSpec(name, name) for name in names))
    assert [joined.shape_of(output) for output in joined.outputs] == [(1, n, 124, 108) for n in (4, 24, 6)]


@pytest.mark.parametrize("part", ["view", "head"])
def test_missing_entries_are_named(part: str) -> None:
    for given in (document(), centers()):
        for name in given[part]:
            less = copy.deepcopy(given)
            del less[part][name]
            refuse(less, rf"{part}.*(lacks {name}|kind is None)")


ANCHOR = {"size_m": [4, 2, 1.5], "bottom_m": 0, "yaws_rad": [0]}
WRONG = [
    ("view", {"x_range_m": [69.12, 0]}, r"view\.x_range_m is \(69\.12, 0"),
    ("view", {"x_range_m": [0, 69.2]}, r"view\.x_range_m is .*a multiple of view\.cell_m, 0\.16 m"),
    ("view", {"z_range_m": [1]}, r"view\.z_range_m is \[1\]; expected a list of 2 numbers"),
    ("view", {"cell_m": 0}, r"view\.cell_m is 0"),
    ("view", {"cell_m": 0.01}, "the view has 7936 rows"),
    ("view", {"max_points": 0}, r"view\.max_points is 0; expected a whole number from 1"),
    ("view", {"max_points": 32.5}, r"view\.max_points is 32\.5; expected a whole number"),
    ("view", {"max_pillars": 10**9}, r"view\.max_pillars is 1000000000; expected a whole number from 1 to 214272"),
    ("view", {"max_points": 4096}, r"the input has 655360000 values \(view\.max_pillars\); expected at most"),
    ("view", {"pitch_deg": 90}, r"view\.pitch_deg is 90"),
    ("view", {"yaw_deg": "left"}, r"view\.yaw_deg is 'left'; expected a number"),
    ("view", {"coords": ""}, r"view\.coords"),
    ("view", {"coords": "voxels"}, "the inputs are named .*; expected different names"),
    ("head", {"kind": "points"}, r"head\.kind is 'points'; expected anchors or centers"),
    ("head", {"stride": 7}, r"head\.stride is 7; expected a divisor of the view's 496 rows"),
    ("head", {"scores": "softmax"}, r"head\.scores is 'softmax'; expected logits or probabilities"),
    ("head", {"classes": ["Car"]}, r"box_classes .*expected a class of boxes for each"),
    ("head", {"anchors": []}, r"the number of head\.anchors is 0"),
    ("head", {"anchors": [{**ANCHOR, "size_m": [4, 2]}]}, r"anchors\[0\]\.size_m is \[4, 2\]"),
    ("head", {"anchors": [{**ANCHOR, "size_m": [4, 2, 0]}]}, r"size_m\[2\] is 0"),
    ("head", {"anchors": [{**ANCHOR, "range_m": [-9, 9, -9, 9]}]}, r"range_m is .* expected lowest x and y, then"),
    ("head", {"box_values": 6}, r"head\.box_values is 6; expected a whole number from 7"),
    ("head", {"box_values": 8}, r"head\.box_values is 8; expected 7, or 9 with velocities; angles of two values"),
    ("head", {"box_values": 10}, r"head\.box_values is 10; expected 7, or 9"),
    ("head", {"direction_bins": 0}, r"head\.direction_bins is 0"),
    ("head", {"across_classes": 1}, r"head\.across_classes is 1; expected true or false"),
    ("input", {"channels": ["x", "y", "z", "ring"]}, "'ring'.* are unknown to a pillars; expected some of x, y, z"),
]


WRONG_CENTERS = [
    ({"groups": [1, 2]}, r"head\.groups is \(1, 2\); expected numbers from 1 on that add up to the 4 classes"),
    ({"groups": [4, 0]}, r"head\.groups is \(4, 0\)"),
    ({"rotation": "yaw"}, r"head\.rotation is 'yaw'; expected sin_cos or cos_sin"),
    ({"max_candidates": 0}, r"head\.max_candidates is 0"),
    ({"groups": [1, 1, 1, 1]}, "each once or once for each of the 4 groups"),
]


@pytest.mark.parametrize(("part", "change", "message"), [*WRONG, *(("centers", *each) for each in WRONG_CENTERS)])
def test_each_wrong_entry_is_named(part: str, change: dict[str, Any], message: str) -> None:
    given = centers() if part == "centers" else document()
    given["head" if part == "centers" else part] |= change
    refuse(given, message)


@pytest.mark.parametrize(
    ("outputs", "message"),
    [
        (["cls_preds"], "of an anchor head; expected cls_preds, box_preds, dir_cls_preds"),
        (["cls_preds", "box_preds", "heatmap"], "of an anchor head"),
        (["cls_preds", "box_preds", "box_preds"], "of an anchor head"),
        ([], "of an anchor head"),
    ],
)
def test_outputs_are_those_of_the_head(outputs: list[str], message: str) -> None:
    given = document() | {"outputs": [{"name": f"{k}", "kind": kind} for k, kind in enumerate(outputs)]}
    refuse(given, message)
    for kinds in (["heatmap"], ["heatmap", "reg", "height", "dim"], ["heatmap", "reg", "reg_height_dim", "rot"]):
        other = centers() | {"outputs": [{"name": kind, "kind": kind} for kind in kinds]}
        refuse(other, "of a center head; expected heatmap, reg, height, dim and rot")


@pytest.mark.parametrize("names", [["pedestrian", "car", "cyclist"], ["car", "cyclist", "pedestrian"]])
def test_classes_of_boxes_in_another_order_are_refused(names: list[str]) -> None:
    """Each pedestrian was called a car."""
    refuse(document() | {"box_classes": names}, r"call the network's '\w+' '\w+'; expected .* head\.classes .* order")


@pytest.mark.parametrize("order", [(2, 1, 0), (1, 0, 2), (0, 2, 1)])
def test_anchors_in_another_order_are_refused(order: tuple[int, ...]) -> None:
    """Cars had the size of pedestrians."""
    given = document()
    given["head"]["anchors"] = [given["head"]["anchors"][k] for k in order]
    refuse(given, r"head\.anchors have [\d.]+ m for a \w+ and [\d.]+ m for a \w+; expected .* order of head\.classes")


def test_a_remission_that_is_divided_by_255_is_refused() -> None:
    """It is 0 to 1 already, and a network that was trained with 0 to 255 saw 0."""
    given = document()
    given["input"]["std"] = [1, 1, 1, 255]
    refuse(given, r"input\.std of the remission is 255; .* has 1/255, 0\.0039215686274509803")


def test_a_head_is_of_pillars_alone() -> None:
    given = document()
    del given["head"]
    refuse(given, "head is missing in a card of pillars")
    card = ModelCard.from_json(KITTI)
    ahead = {"view": TopViewGeometry(), "input": InputSpec("x", ("height",), (0.0,), (1.0,))}
    with pytest.raises(CardError, match="head is given in a card of top_view"):
        replace(card, **ahead, outputs=(OutputSpec("y", "class_logits"),))  # type: ignore[arg-type]
    for kind in ("cls_preds", "heatmap"):
        with pytest.raises(CardError, match="expected one class output"):
            replace(card, **ahead, head=None, outputs=(OutputSpec("y", kind),))  # type: ignore[arg-type]


def test_a_class_of_boxes_is_not_the_background() -> None:
    """The network's own classes, which have no background, as the classes of the card: the first was the background."""
    given = document()
    given["classes"] = given["box_classes"]
    refuse(given, r"box_classes .* hold 'car', the first of the classes, which is the background")
