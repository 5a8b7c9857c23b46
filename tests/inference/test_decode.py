from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import twins.decode
from edgeperc.errors import CardMismatchError, InferenceError
from edgeperc.inference import box_heads, decode
from edgeperc.inference.box_heads import decode_dense, decode_scored_slots, decode_slots
from edgeperc.inference.decode import decode_classes, decode_top_view
from edgeperc.types.geometry import draw_footprints
from edgeperc.types.points import read_only
from edgeperc.types.views import TopViewGeometry
from edgeperc_export.cards import card_of
from edgeperc_export.recipe import Recipe

CLASSES = ("background", "drivable", "car", "van", "truck")
VEHICLES = CLASSES[2:]
PRIORS = {"car": (3.9, 1.6, 1.5), "van": (5.1, 1.9, 2.2), "truck": (10.0, 2.6, 3.3)}
VIEW = TopViewGeometry()
SHAPE = (VIEW.height, VIEW.width)


def card_like(**fields: Any) -> Any:
    """What the decoding of boxes asks of a card."""
    usual = {"name": "the model", "view": VIEW, "classes": CLASSES, "box_classes": VEHICLES, "box_size_priors": PRIORS}
    return SimpleNamespace(**usual | {"box_size_spreads": None, "mount_height_m": 1.73, "nms_iou": 0.2} | fields)


def pixel_of(x: float, y: float) -> tuple[int, int]:
    return int((VIEW.x_range_m[1] - x) / VIEW.cell_m), int((VIEW.y_range_m[1] - y) / VIEW.cell_m)


@pytest.mark.parametrize("shape", [(1, 4, 64, 512), (1, 5, 7, 3), (2, 1, 1), (1, 1, 4, 5), (3, 0, 4)])
def test_classes_agree_with_the_twin(shape: tuple[int, ...]) -> None:
    logits = np.random.default_rng(1).normal(0.0, 5.0, shape).astype(np.float32)
    values = logits[0] if logits.ndim == 4 else logits
    labels, scores = decode_classes(logits, "class_logits")
    expected_labels, expected_scores, _ = twins.decode.classes(values, True) if values.size else (labels, scores, 0)
    assert labels.dtype == np.uint8
    assert scores.dtype == np.float32
    np.testing.assert_array_equal(labels, expected_labels)
    np.testing.assert_allclose(scores, expected_scores, atol=3e-6)

    probabilities = twins.decode.softmax(values).astype(np.float32) if values.size else values
    labels, scores = decode_classes(probabilities, "class_probabilities")
    np.testing.assert_array_equal(labels, expected_labels)
    np.testing.assert_array_equal(scores, probabilities.max(axis=0))


def test_lower_class_wins_a_tie_and_scores_stay_probabilities() -> None:
    logits = np.zeros((1, 5, 2, 2), dtype=np.float32)
    logits[0, 3:, 0, 0] = 7.0
    logits[0, 4, 1, 1] = 1e30
    logits[0, :, 1, 0] = -3e38
    labels, scores = decode_classes(logits, "class_logits")
    assert labels.tolist() == [[3, 0], [0, 4]]
    np.testing.assert_allclose(scores, [[1.0 / (2.0 + 3.0 * math.exp(-7.0)), 0.2], [0.2, 1.0]], atol=1e-6)
    assert ((scores > 0.0) & (scores <= 1.0)).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("kind", ["class_logits", "class_probabilities"])
def test_classes_that_are_not_finite_raise(value: float, kind: str) -> None:
    output = np.full((1, 3, 4, 5), 0.25, dtype=np.float32)
    output[0, 1, 2, 3] = output[0, 2, 0, 0] = value
    with pytest.raises(InferenceError, match=r"pointseg: 2 of 60 values of class_"):
        decode_classes(output, kind, model="pointseg")


@pytest.mark.kernel
@pytest.mark.parametrize("shape", [(0, 4), (1, 1), (7, 33)])
def test_cells_without_a_return_lose_a_class_of_boxes(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(3)
    labels, returned = rng.integers(0, 4, shape).astype(np.uint8), rng.random(shape) < 0.5
    is_box = np.array([False, False, True, True])
    found = labels.copy()
    decode.clear_empty(read_only(returned, np.bool_), is_box, found)
    np.testing.assert_array_equal(found, np.where(is_box[labels] & ~returned, 0, labels))


def test_values_that_are_not_finite_are_counted() -> None:
    values = np.linspace(-3e38, 3e38, 1000, dtype=np.float32)
    assert box_heads.count_not_finite(values) == box_heads.count_not_finite(values[:0]) == 0
    values[::7], values[1::70], values[-1] = np.nan, np.inf, -np.inf
    assert box_heads.count_not_finite(values) == np.count_nonzero(~np.isfinite(values))


def test_classes_of_another_shape_or_kind_raise() -> None:
    with pytest.raises(CardMismatchError, match=r"\(2, 3, 4, 5\)"):
        decode_classes(np.zeros((2, 3, 4, 5), dtype=np.float32), "class_logits")
    with pytest.raises(CardMismatchError, match="box_dense"):
        decode_classes(np.zeros((1, 3, 4, 5), dtype=np.float32), "box_dense")


def slots_for(slots: Any, labels: np.ndarray | None = None, scores: np.ndarray | None = None) -> list[Any]:
    labels = np.zeros(SHAPE, dtype=np.uint8) if labels is None else labels
    scores = np.ones(SHAPE, dtype=np.float32) if scores is None else scores
    return decode_slots(card_like(name="ssadnet"), np.asarray(slots, dtype=np.float32), labels, scores)


def test_slots_become_boxes_in_meters() -> None:
    labels, scores = np.zeros(SHAPE, dtype=np.uint8), np.zeros(SHAPE, dtype=np.float32)
    # A car 26 m ahead, 5 m to the left, 4 m along x; a truck 16 m ahead, 5 m right, lying across.
    labels[200, 50], scores[200, 50] = 2, 0.75
    labels[300, 150], scores[300, 150] = 4, 0.9
    boxes = slots_for([[[0.2525, 0.50125, 0.1, 0.1], [0, 0, 0, 0], [0.7525, 0.75125, 0.5, 0.0625]]], labels, scores)
    assert [b.label for b in boxes] == ["truck", "car"]
    truck, car = boxes
    assert car.score == 0.75
    np.testing.assert_allclose(car.center, (25.95, 4.95, 0.75 - 1.73), atol=1e-5)
    np.testing.assert_allclose(car.size, (4.0, 2.0, 1.5), atol=1e-5)
    assert car.yaw == 0.0
    np.testing.assert_allclose(truck.center, (15.95, -5.05, 1.65 - 1.73), atol=1e-5)
    np.testing.assert_allclose(truck.size, (10.0, 2.5, 3.3), atol=1e-5)
    assert truck.yaw == math.pi / 2.0


@pytest.mark.parametrize(
    "slot",
    [
        [0.5, 0.5, 0.0, 0.0],
        [0.5, 0.5, 0.1, 0.012],  # 0.48 m long
        [0.5, 0.5, 0.024, 0.1],  # 0.48 m wide
        [0.5, 0.5, -0.1, 0.1],
        [1.0, 0.5, 0.1, 0.1],
        [0.5, -0.01, 0.1, 0.1],
        [0.5, 1.2, 0.1, 0.1],
    ],
)
def test_empty_slots(slot: list[float]) -> None:
    assert slots_for([slot], np.full(SHAPE, 2, dtype=np.uint8)) == []
    n_found = [len(slots_for([[0.5, 0.5, 0.1, 0.1]], np.full(SHAPE, label, dtype=np.uint8))) for label in (0, 1, 2)]
    assert n_found == [0, 0, 1]  # in a vehicle alone


def test_malformed_slots_are_refused() -> None:
    with pytest.raises(InferenceError, match="ssadnet: 1 of 4 values of box_slots"):
        slots_for([[0.5, np.nan, 0.1, 0.1]])
    with pytest.raises(CardMismatchError, match=r"\(1, 5\)"):
        slots_for([[0.5, 0.5, 0.1, 0.1, 0.0]])
    with pytest.raises(CardMismatchError, match="3, 3"):
        slots_for([[0.5, 0.5, 0.1, 0.1]], labels=np.zeros((3, 3), dtype=np.uint8))
    with pytest.raises(CardMismatchError, match="truck"):
        decode_slots(
            card_like(box_size_priors={"car": PRIORS["car"], "van": PRIORS["van"]}),
            np.zeros((1, 4), dtype=np.float32),
            np.zeros(SHAPE, dtype=np.uint8),
            np.zeros(SHAPE, dtype=np.float32),
        )
    assert slots_for(np.zeros((0, 4))) == []


def scored_slots_for(
    slots: Any, class_output: np.ndarray | None = None, score_threshold: float = 0.3, iou_threshold: float = 0.2
) -> list[Any]:
    class_output = np.zeros((len(CLASSES), *SHAPE), np.float32) if class_output is None else class_output
    card = card_like(nms_iou=iou_threshold)
    return decode_scored_slots(card, np.asarray(slots, np.float32), class_output, "class_logits", score_threshold)


def twin_of_scored_slots(slots: Any, logits: np.ndarray, score_threshold: float, iou_threshold: float) -> list[Any]:
    """One slot after the other."""
    found = []
    for col, row, across, along, logit in np.asarray(slots, np.float64):
        score = 1.0 / (1.0 + np.exp(-logit))
        if not (0 <= col < 1 and 0 <= row < 1) or score < score_threshold:
            continue
        along, across = along * SHAPE[0] * 0.1, across * SHAPE[1] * 0.1
        sides = np.clip([max(along, across), min(along, across)], 0.2, 40.0)
        yaw = 0.0 if along >= across else math.pi / 2.0
        found.append((score, np.array([46.0 - row * 40.0, 10.0 - col * 20.0, *sides, yaw])))
    found = sorted(found, key=lambda each: -each[0])[: box_heads.MAX_BOXES]
    rectangles = np.array([rectangle for _, rectangle in found]).reshape(-1, 5)
    kept = twins.decode.nms(rectangles, iou_threshold)
    sums = twins.decode.footprint_sums(logits, True, rectangles[kept], 46.0, 10.0, 0.1)
    numbers = [CLASSES.index(name) for name in VEHICLES]
    names = [VEHICLES[k] for k in sums[:, numbers].argmax(1)]
    scores = [score for (score, _), each in zip(found, kept, strict=True) if each]
    return list(zip(names, scores, rectangles[kept], strict=True))


@pytest.mark.parametrize("n", [0, 1, 200])
def test_scored_slots_equal_their_twin(n: int) -> None:
    rng = np.random.default_rng(n)
    slots = np.column_stack([rng.uniform(-0.1, 1.1, (n, 2)), rng.uniform(-0.02, 0.2, (n, 2)), rng.normal(size=n)])
    slots = slots.astype(np.float32)
    logits = rng.normal(size=(len(CLASSES), *SHAPE)).astype(np.float32)
    limits = {"score_threshold": 0.4, "iou_threshold": 0.2}
    found = scored_slots_for(slots, logits, **limits)
    expected = twin_of_scored_slots(slots, logits, **limits)
    assert [box.label for box in found] == [name for name, *_ in expected]
    for box, (label, score, (x, y, length, width, yaw)) in zip(found, expected, strict=True):
        assert box.score == pytest.approx(score, abs=1e-6)
        tall = PRIORS[label][2]
        np.testing.assert_allclose(box.center, (x, y, tall / 2.0 - 1.73), atol=1e-5)
        np.testing.assert_allclose(box.size, (length, width, tall), atol=1e-5)
        assert box.yaw == yaw


def test_of_two_slots_with_one_object_the_surer_remains(monkeypatch: pytest.MonkeyPatch) -> None:
    car, same = [0.5, 0.5, 0.08, 0.1, 1.0], [0.5, 0.505, 0.08, 0.1, 2.0]
    (box,) = scored_slots_for([car, same, [0.5, 0.9, 0.08, 0.1, -4.0]])
    assert box.score == pytest.approx(1.0 / (1.0 + math.exp(-2.0)))
    assert box.center[0] == pytest.approx(46.0 - 0.505 * 40.0)
    assert len(scored_slots_for([car, same], iou_threshold=1.0)) == 2
    with monkeypatch.context() as few:
        few.setattr(box_heads, "MAX_BOXES", 1)
        assert len(scored_slots_for([car, same], iou_threshold=1.0)) == 1
    assert len(scored_slots_for([[0.5, 0.5, 0.1, 0.1, -1e4]], score_threshold=0.0)) == 1


def test_malformed_scored_slots_are_refused() -> None:
    with pytest.raises(InferenceError, match="1 of 5 values of box_slots"):
        scored_slots_for([[0.5, 0.5, np.inf, 0.1, 1.0]])
    with pytest.raises(CardMismatchError, match=r"\(1, 4\)"):
        scored_slots_for([[0.5, 0.5, 0.1, 0.1]])
    with pytest.raises(CardMismatchError, match="3, 3"):
        scored_slots_for([[0.5, 0.5, 0.1, 0.1, 1.0]], np.zeros((len(CLASSES), 3, 3), np.float32))
    broken = np.zeros((len(CLASSES), *SHAPE), np.float32)
    broken[0, 0, 0] = np.nan
    with pytest.raises(InferenceError, match="of class_logits"):
        scored_slots_for([[0.5, 0.5, 0.1, 0.1, 1.0]], broken)


def test_a_top_view_decodes_slots_with_and_without_scores() -> None:
    card = card_of(Recipe("ssadnet", head="slots"), version="1")
    outputs = {"class_logits": class_logits((slice(100, 140), slice(50, 66), CLASSES.index("van"), 9.0))[0]}
    for slot, score in (([0.29, 0.3, 0.08, 0.1], 1.0), ([0.29, 0.3, 0.08, 0.1, 0.0], 0.5)):
        outputs["box_slots"] = np.array([slot], np.float32)
        _, (box,) = decode_top_view(card, np.zeros(SHAPE, np.bool_), outputs, 0.3)
        assert box.label == "van"
        assert box.score == pytest.approx(score, abs=2e-3)


def dense_of(*boxes: Sequence[float]) -> np.ndarray:
    """What a perfect network says of (x, y, z, length, width, height, yaw, logit)."""
    dense = np.zeros((1, 9, SHAPE[0] // 4, SHAPE[1] // 4), dtype=np.float32)
    dense[0, 0] = -10.0
    for x, y, z, length, width, height, yaw, logit in boxes:
        row, col = (VIEW.x_range_m[1] - x) / 0.4, (VIEW.y_range_m[1] - y) / 0.4
        r, c = int(row), int(col)
        dense[0, :, r, c] = [
            logit,
            row - r - 0.5,
            col - c - 0.5,
            math.log(length),
            math.log(width),
            math.sin(2.0 * yaw),
            math.cos(2.0 * yaw),
            z,
            math.log(height),
        ]
    return dense


def class_logits(*patches: Any) -> np.ndarray:
    """Background, with (row slice, column slice, class, logit) on top."""
    logits = np.zeros((1, 5, *SHAPE), dtype=np.float32)
    logits[0, 0] = 2.0
    for rows, cols, k, value in patches:
        logits[0, k, rows, cols] = value
    return logits


def dense_boxes(
    dense: np.ndarray,
    logits: np.ndarray | None = None,
    score_threshold: float = 0.3,
    named_from: float = 0.0,
    iou_threshold: float = 0.2,
    **fields: Any,
) -> list[Any]:
    logits, card = class_logits() if logits is None else logits, card_like(nms_iou=iou_threshold, **fields)
    return decode_dense(card, dense, logits, "class_logits", score_threshold, named_from)


def test_dense_boxes_are_decoded_exactly() -> None:
    a = (20.13, 3.37, -0.9, 4.2, 1.7, 1.5, 0.4, 3.0)
    b = (38.8, -6.1, -0.5, 9.5, 2.5, 3.1, -1.2, 1.0)
    rows_a, cols_a = pixel_of(a[0], a[1])
    rows_b, cols_b = pixel_of(b[0], b[1])
    logits = class_logits(
        (slice(rows_a - 8, rows_a + 8), slice(cols_a - 8, cols_a + 8), 3, 6.0),
        (slice(rows_b - 30, rows_b + 30), slice(cols_b - 30, cols_b + 30), 4, 6.0),
    )
    boxes = dense_boxes(dense_of(b, a), logits)
    assert [box.label for box in boxes] == ["van", "truck"]
    for box, (x, y, z, length, width, height, yaw, logit) in zip(boxes, (a, b), strict=True):
        np.testing.assert_allclose(box.center, (x, y, z), atol=1e-5)
        np.testing.assert_allclose(box.size, (length, width, height), rtol=1e-5)
        assert box.yaw == pytest.approx(yaw, abs=1e-5)
        assert box.score == pytest.approx(1.0 / (1.0 + math.exp(-logit)), abs=1e-6)
    probabilities = twins.decode.softmax(logits[0])[None].astype(np.float32)
    assert decode_dense(card_like(), dense_of(b, a), probabilities, "class_probabilities", 0.3) == boxes


def with_front(dense: np.ndarray, x: float, y: float) -> np.ndarray:
    """The dense maps with a vector towards the front."""
    return np.concatenate([dense, *(np.broadcast_to(np.float32(v), dense[:, :1].shape) for v in (x, y))], axis=1)


@pytest.mark.compiled
@pytest.mark.parametrize("yaw", [0.0, 0.4, -1.2, 1.57, -1.57])
@pytest.mark.parametrize("front", [(0, 0), (3, 0), (-3, 0), (0, 3), (0.1, -0.2), (-0.1, -0.1), (800, 1), (3e38, -3e38)])
def test_boxes_turn_to_their_fronts(yaw: float, front: tuple[float, float]) -> None:
    dense = dense_of((20.13, 3.37, -0.9, 4.2, 1.7, 1.5, yaw, 3.0), (38.8, -6.1, -0.5, 9.5, 2.5, 3.1, 0.7, 1.0))
    plain = dense_boxes(dense)
    boxes = dense_boxes(with_front(dense, *front))
    assert all(box.front is None for box in plain)
    for before, box in zip(plain, boxes, strict=True):
        expected_yaw, likely = twins.decode.facing(before.yaw, *front)
        assert replace(before, yaw=box.yaw, front=box.front) == box
        assert box.yaw == pytest.approx(expected_yaw)
        assert box.front == pytest.approx(likely)
        assert 0.5 <= box.front <= 1.0
        assert -math.pi <= box.yaw <= math.pi


def test_each_box_has_its_own_front() -> None:
    ahead, away = (20.13, 3.37, -0.9, 4.2, 1.7, 1.5, 0.4, 3.0), (38.8, -6.1, -0.5, 9.5, 2.5, 3.1, 0.7, 1.0)
    dense = with_front(dense_of(ahead, away), 2.0, 0.0)
    row, col = int((VIEW.x_range_m[1] - away[0]) / 0.4), int((VIEW.y_range_m[1] - away[1]) / 0.4)
    dense[0, 9:, row, col] = -np.cos(0.7), -np.sin(0.7)
    boxes = dense_boxes(dense)
    assert [box.yaw for box in boxes] == pytest.approx([0.4, 0.7 - math.pi], abs=1e-5)
    assert [box.front for box in boxes] == pytest.approx(
        [1 / (1 + math.exp(-2.0 * math.cos(0.4))), 1 / (1 + math.exp(-1.0))]
    )
    dense[0, 9, 0, 0] = np.nan
    with pytest.raises(InferenceError, match="1 of 55000 values of box_dense"):
        dense_boxes(dense)


def test_one_pixel_at_the_center_does_not_decide_the_class() -> None:
    x, y = 26.05, 0.05
    row, col = pixel_of(x, y)
    logits = class_logits(
        (slice(row - 15, row + 16), slice(col - 6, col + 7), 2, 5.0), (slice(row, row + 1), slice(col, col + 1), 4, 9.0)
    )
    (box,) = dense_boxes(dense_of((x, y, -1.0, 4.0, 1.6, 1.5, 0.0, 2.0)), logits)
    assert box.label == "car"


def test_background_under_the_box_still_leaves_a_vehicle() -> None:
    logits = class_logits()
    logits[0, 3] = 0.1
    (box,) = dense_boxes(dense_of((26.0, 0.0, -1.0, 4.0, 1.6, 1.5, 0.0, 2.0)), logits)
    assert box.label == "van"


def test_sizes_decide_between_equally_likely_classes() -> None:
    priors = {"car": (3.9, 1.6, 1.5), "van": (5.0, 1.9, 2.2), "truck": (10.0, 2.6, 3.2)}
    spreads = dict.fromkeys(priors, (0.1, 0.1, 0.1))
    sizes = {"box_size_priors": priors, "box_size_spreads": spreads}
    for name, size in priors.items():
        dense = dense_of((26.0, 0.0, -1.0, *size, 0.0, 2.0))
        (by_map,) = dense_boxes(dense)
        (by_both,) = dense_boxes(dense, **sizes)
        assert by_both.label == name
        assert replace(by_both, label=by_map.label) == by_map
    # A map that is sure of a car outweighs a size a little nearer to a van's.
    logits = class_logits((slice(None), slice(None), CLASSES.index("car"), 30.0))
    sizes["box_size_priors"] = priors | {"van": (4.15, 1.6, 1.5)}
    dense = dense_of((26.0, 0.0, -1.0, 4.1, 1.6, 1.5, 0.0, 2.0))
    (box,) = dense_boxes(dense, logits, **sizes)
    assert box.label == "car"


def test_overlapping_boxes_of_the_dense_head() -> None:
    first = (20.2, 3.4, -0.9, 4.2, 1.7, 1.5, 0.0, 1.0)
    second = (21.4, 3.4, -0.9, 4.2, 1.7, 1.5, 0.0, 2.0)
    beside = (20.2, 0.6, -0.9, 4.2, 1.7, 1.5, 0.0, 0.5)
    dense = dense_of(first, second, beside)
    boxes = dense_boxes(dense)
    assert [round(box.center[0], 3) for box in boxes] == [21.4, 20.2]
    assert [round(box.center[1], 3) for box in boxes] == [3.4, 0.6]
    everything = dense_boxes(dense, iou_threshold=1.0)
    assert len(everything) == 3
    sure = dense_boxes(dense, score_threshold=0.7)
    assert sure == boxes[:1]
    weak_unnamed = dense_boxes(dense, named_from=0.7)
    assert weak_unnamed == [boxes[0], *(replace(box, label="") for box in boxes[1:])]
    unnamed = dense_boxes(dense, named_from=1.0)
    assert unnamed == [replace(box, label="") for box in boxes]


def test_score_thresholds_0_and_1() -> None:
    dense = dense_of((26.0, 0.0, -1.0, 4.0, 1.6, 1.5, 0.0, 2.0))
    assert dense_boxes(dense, score_threshold=1.0) == []
    # A flat heat map has one peak a plateau, and the plateau of -10 touches the real one.
    everything = dense_boxes(dense, score_threshold=0.0)
    assert 1 <= len(everything) <= 2
    assert decode_dense(card_like(box_classes=()), dense, class_logits(), "class_logits", 0.3) == []


def test_a_heat_map_of_probabilities_is_refused() -> None:
    """As logits, each of its peaks was a box with a score of 0.5 or more."""
    dense = dense_of((26.0, 0.0, -1.0, 4.0, 1.6, 1.5, 0.0, 2.0))
    dense[0, 0] = 1.0 / (1.0 + np.exp(-dense[0, 0]))
    with pytest.raises(InferenceError, match=r"ssadnet: values of the heat map .* are .* expected logits.* sigmoid of"):
        dense_boxes(dense, name="ssadnet")


def test_dense_clips_extreme_sizes_and_refuses_non_finite_values() -> None:
    dense = dense_of((26.0, 0.0, -1.0, 4.0, 1.6, 1.5, 0.0, 2.0))
    dense[0, [3, 4, 8], 50, 25] = 200.0, -200.0, 90.0
    (box,) = dense_boxes(dense)
    assert np.allclose(box.size, (40.0, 0.2, 40.0))
    dense[0, 7, 3, 3] = np.nan
    with pytest.raises(InferenceError, match="ssadnet: 1 of 45000 values of box_dense"):
        dense_boxes(dense, name="ssadnet")
    logits = class_logits()
    logits[0, 1, 2, 3] = np.inf
    with pytest.raises(InferenceError, match="1 of 400000 values of class_logits"):
        dense_boxes(dense_of(), logits)
    with pytest.raises(CardMismatchError, match=r"\(1, 8, 100, 50\).*\(1, 9, 100, 50\) or \(1, 11, 100, 50\)"):
        dense_boxes(dense[:, :8])
    with pytest.raises(CardMismatchError, match=r"\(1, 13, 100, 50\)"):
        dense_boxes(with_front(with_front(dense, 0, 0), 0, 0))
    with pytest.raises(CardMismatchError, match=r"\(1, 4, 400, 200\)"):
        dense_boxes(dense_of(), class_logits()[:, :4])


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (20, 30)])
def test_peaks_agree_with_the_twin(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(5)
    for heat in (rng.normal(size=shape), rng.integers(0, 3, shape), np.zeros(shape)):
        heat = heat.astype(np.float32)
        peak = np.empty(shape, dtype=np.bool_)
        box_heads.mark_peaks(heat, 0.0, peak)
        np.testing.assert_array_equal(peak, twins.decode.peaks(heat, 0.0))
        assert peak.any() or (heat < 0.0).all()


@pytest.mark.parametrize("are_logits", [True, False])
def test_footprint_sums_agree_with_the_twin(are_logits: bool) -> None:
    rng = np.random.default_rng(6)
    values = rng.normal(0.0, 3.0, (5, 40, 30)).astype(np.float32)
    rectangles = np.column_stack(
        [rng.uniform(4.0, 9.0, 12), rng.uniform(-2.0, 2.0, 12), rng.uniform(0.01, 4.0, (12, 2)), rng.uniform(-2, 2, 12)]
    )
    rectangles[-1] = [500.0, -500.0, 1.0, 1.0, 0.0]  # far out of view
    sums = np.empty((12, 5))
    box_heads.fill_footprint_sums(values, are_logits, rectangles, 8.0, 1.5, 0.1, sums)
    np.testing.assert_allclose(
        sums, twins.decode.footprint_sums(values, are_logits, rectangles, 8.0, 1.5, 0.1), rtol=1e-9, atol=1e-9
    )


def test_huge_footprints_are_sampled() -> None:
    values = np.random.default_rng(7).normal(0.0, 3.0, (20, 150, 150)).astype(np.float32)
    rectangles = np.array([[7.5, 0.0, 15.0, 14.0, 0.3], [7.5, 0.0, 4.0, 2.0, 0.3]])
    sums = np.empty((2, 20))
    box_heads.fill_footprint_sums(values, True, rectangles, 15.0, 7.5, 0.1, sums)
    np.testing.assert_allclose(sums, twins.decode.footprint_sums(values, True, rectangles, 15.0, 7.5, 0.1), rtol=1e-9)
    assert sums.sum(axis=1).max() < 150 * 140 / 3  # every second row and column
    assert sums[1].sum() == pytest.approx(40 * 20, rel=0.05)


def test_only_the_best_slots_become_boxes() -> None:
    scores = np.random.default_rng(8).random(SHAPE).astype(np.float32)
    labels = np.full(SHAPE, 2, np.uint8)
    slots = np.column_stack([np.random.default_rng(9).uniform(0, 1, (5000, 2)), np.full((5000, 2), 0.1)])
    boxes = slots_for(slots, labels, scores)
    at = (np.float32(slots[:, :2]).astype(float) * [SHAPE[1], SHAPE[0]]).astype(int)
    best = np.sort(scores[at[:, 1], at[:, 0]])[::-1][:100]
    np.testing.assert_array_equal([box.score for box in boxes], best)


def test_boxes_are_drawn_into_the_map() -> None:
    card = card_of(Recipe("ssadnet"), version="1")
    drivable, stray = CLASSES.index("drivable"), CLASSES.index("van")
    logits = class_logits((slice(0, 10), slice(None), drivable, 9.0), (slice(350, 360), slice(0, 20), stray, 9.0))[0]
    dense = dense_of((26.0, 0.0, -1.0, 4.0, 1.6, 1.5, 0.0, 2.0), (38.0, 5.0, -1.0, 10.0, 2.6, 3.2, 0.4, 2.0))[0]
    returned = np.zeros(SHAPE, np.bool_)
    returned[355, 7] = True  # a stray van's cell with a return
    labels, boxes = decode_top_view(card, returned, {"class_logits": logits, "box_dense": dense}, 0.3)
    assert [box.label for box in boxes] == ["truck", "car"]  # of equal scores, the farther first
    expected = np.zeros(SHAPE, np.uint8)
    expected[:10], expected[355, 7] = drivable, stray
    draw_footprints(expected, boxes, VIEW, CLASSES)
    np.testing.assert_array_equal(labels, expected)
    assert abs(np.count_nonzero(labels == 2) - 40 * 16) < 60
    assert abs(np.count_nonzero(labels == 4) - 100 * 26) < 60


def test_slot_boxes_do_not_change_the_map() -> None:
    card = card_of(Recipe("ssadnet", head="slots-paper"), version="1")
    logits = class_logits((slice(100, 140), slice(50, 66), CLASSES.index("van"), 9.0))[0]
    slots = np.zeros((2, 4), np.float32)
    slots[0] = 58 / 200, 120 / 400, 20 / 200, 44 / 400
    labels, (box,) = decode_top_view(card, np.zeros(SHAPE, np.bool_), {"class_logits": logits, "box_slots": slots}, 0.3)
    assert box.label == "van"
    assert np.count_nonzero(labels == 3) == 40 * 16
