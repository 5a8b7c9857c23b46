"""Targets and losses compared with plain numpy."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from edgeperc.inference.box_heads import decode_dense, decode_scored_slots, decode_slots
from edgeperc.simulation.samples import IGNORE
from edgeperc.simulation.scene import TOP_VIEW_CLASSES
from edgeperc.types.perception import Box
from edgeperc.types.views import TopViewGeometry
from edgeperc_export.data.scans import LabeledScan, mirrored, turned
from edgeperc_export.data.targets import REGRESSED_FROM, dense_targets, paper_slot_targets, slot_targets
from edgeperc_export.training import losses

VIEW = TopViewGeometry()  # x 6..46 m, y -10..10 m, 0.1 m cells
CAR = (26.0, 2.0, -1.0, 4.0, 1.6, 1.5, 0.0)


def card_like(**fields: Any) -> Any:
    """What the decoding of boxes asks of a card."""
    usual = {"name": "the model", "view": VIEW, "classes": CLASSES, "box_classes": CLASSES[2:], "mount_height_m": 1.73}
    return SimpleNamespace(**usual | {"box_size_priors": {}, "box_size_spreads": None, "nms_iou": 0.2} | fields)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def log_softmax(logits: np.ndarray) -> np.ndarray:
    shifted = logits - logits.max(1, keepdims=True)
    return shifted - np.log(np.exp(shifted).sum(1, keepdims=True))


def random_maps(
    rng: np.random.Generator, n_classes: int = 5, shape: tuple[int, int, int] = (2, 6, 7), ignored: float = 0.2
) -> tuple[np.ndarray, np.ndarray]:
    logits = rng.normal(size=(shape[0], n_classes, *shape[1:])).astype(np.float32)
    labels = rng.integers(n_classes, size=shape).astype(np.uint8)
    labels[rng.random(shape) < ignored] = IGNORE
    return logits, labels


def test_the_papers_slots_are_the_upright_footprints_of_the_nearest_boxes(rng: np.random.Generator) -> None:
    # Row (46 - 26) / 0.1 = 200 of 400, column (10 - 2) / 0.1 = 80 of 200; 16 columns across, 40 rows along.
    ahead = [80 / 200, 200 / 400, 16 / 200, 40 / 400]
    np.testing.assert_allclose(paper_slot_targets([CAR], VIEW, 4), [ahead, *[[0.0] * 4] * 3], rtol=1e-6)
    for nothing in ([], np.empty((0, 7))):
        empty = paper_slot_targets(nothing, VIEW, 2)
        assert (empty.tolist(), empty.dtype) == ([[0.0] * 4] * 2, np.float32)
    boxes = [(x, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0) for x in (30.0, 10.0, 40.0, 20.0)]
    np.testing.assert_allclose(paper_slot_targets(boxes, VIEW, 3)[:, 1], [0.9, 0.65, 0.4], rtol=1e-6)
    for _ in range(20):
        yaw = rng.uniform(-np.pi, np.pi)
        box = np.array([rng.uniform(12, 40), rng.uniform(-5, 5), 0.0, rng.uniform(1, 9), rng.uniform(1, 3), 1.5, yaw])
        corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * box[3:5] / 2
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        x, y = (corners @ turn.T + box[:2]).T
        places = np.stack([(10 - y) / 0.1 / 200, (46 - x) / 0.1 / 400])  # columns and rows, as shares
        expected = [*(places.min(1) + places.max(1)) / 2, *np.ptp(places, axis=1)]
        np.testing.assert_allclose(paper_slot_targets([box], VIEW, 1)[0], expected, rtol=1e-5)


def test_a_slot_has_the_nearest_box_centered_in_its_square() -> None:
    # Row 200 is in the square of rows 192 to 223, column 80 in that of columns 64 to 95.
    target = slot_targets([CAR], VIEW).reshape(12, 6, 5)
    np.testing.assert_allclose(target[6, 2], [80 / 200, 200 / 400, 16 / 200, 40 / 400, 1.0], rtol=1e-6)
    assert np.count_nonzero(target) == 5
    # The last squares get the cells left over.
    target = slot_targets([(6.05, -9.95, 0.0, 4.0, 2.0, 1.5, 0.0)], VIEW).reshape(12, 6, 5)
    np.testing.assert_allclose(target[11, 5, :2], [199.5 / 200, 399.5 / 400], rtol=1e-6)
    assert np.count_nonzero(target[..., 4]) == 1
    near, far = (26.0, 1.0, 0.0, 2.0, 1.0, 1.5, 0.0), (26.5, 3.0, 0.0, 3.0, 1.0, 1.5, 0.0)
    for boxes in ([near, far], [far, near]):
        np.testing.assert_array_equal(slot_targets(boxes, VIEW), slot_targets([near], VIEW))


def test_squares_with_unlabeled_cells_or_unsure_objects_are_not_learned() -> None:
    labeled = np.ones((400, 200), bool)
    labeled[399, 0] = False  # beyond the last whole square
    labeled[200, 80] = False  # in the square of the car, which is learned anyway
    labeled[0, 33] = False
    unsure = [(46.0 - 0.1 * 330, 10.0 - 0.1 * 100, 0.0, 4.0, 2.0, 1.5, 0.0)]
    presence = slot_targets([CAR], VIEW, labeled=labeled, unsure=unsure).reshape(12, 6, 5)[..., 4]
    assert {tuple(at) for at in np.argwhere(presence == -1.0)} == {(11, 0), (0, 1), (10, 3)}
    assert np.argwhere(presence == 1.0).tolist() == [[6, 2]]
    assert slot_targets([CAR], VIEW, unsure=[CAR])[:, 4].max() == 1.0
    assert slot_targets([], VIEW, unsure=np.empty((0, 7))).shape == (72, 5)


@pytest.mark.parametrize("targets", [partial(paper_slot_targets, n_slots=2), slot_targets, dense_targets])
def test_boxes_outside_the_view_are_left_out_and_those_without_extent_refused(targets: Callable[..., Any]) -> None:
    for center in ((5.9, 0.0), (46.1, 0.0), (20.0, 10.1), (20.0, -10.1), (6.0, 0.0), (np.nan, 0.0)):
        assert not targets([(*center, *CAR[2:])], VIEW).any(), center
    with pytest.raises(ValueError, match="has no extent"):
        targets([(20.0, 0.0, 0.0, 4.0, 0.0, 1.5, 0.0)], VIEW)


def test_dense_target_of_one_box() -> None:
    yaw = 0.3
    target = dense_targets([(26.13, 2.27, -0.8, 4.1, 1.7, 1.5, yaw)], VIEW)
    assert target.shape == (11, 100, 50)
    assert target.dtype == np.float32
    ((row, col),) = np.argwhere(target[0] == 1.0)
    assert (row, col) == (49, 19)  # (46 - 26.13) / 0.4 = 49.675, (10 - 2.27) / 0.4 = 19.325
    expected = [0.175, -0.175, np.log(4.1), np.log(1.7), np.sin(2 * yaw), np.cos(2 * yaw), -0.8, np.log(1.5)]
    np.testing.assert_allclose(target[1:, row, col], [*expected, np.cos(yaw), np.sin(yaw)], atol=1e-5)
    # Every learned cell of a large one points to the same center.
    target = dense_targets([(26.13, 2.27, -0.8, 9.0, 3.0, 1.5, yaw)], VIEW)
    rows, cols = np.nonzero(target[0] >= REGRESSED_FROM)
    assert len(rows) > 5
    np.testing.assert_allclose(rows + 0.5 + target[1, rows, cols], 49.675, atol=1e-4)
    np.testing.assert_allclose(cols + 0.5 + target[2, rows, cols], 19.325, atol=1e-4)
    assert not target[1:, target[0] < REGRESSED_FROM].any()


@pytest.mark.parametrize("degrees", [0, 89, -89, 90, 91, -91, 179, -179, 180, 271, 361, -541])
def test_the_front_that_is_learned_is_decoded(degrees: float) -> None:
    target = dense_targets([(26.13, 2.27, -0.8, 4.1, 1.7, 1.5, np.radians(degrees))], VIEW)
    learned = target[0] >= REGRESSED_FROM
    assert learned.sum() > 1
    np.testing.assert_allclose(target[9] ** 2 + target[10] ** 2, learned, atol=1e-6)
    dense = np.concatenate([np.where(target[:1] == 1.0, 5.0, -5.0), target[1:9], 9.0 * target[9:]])[None]
    classes = np.zeros((1, len(TOP_VIEW_CLASSES), VIEW.height, VIEW.width), np.float32)
    card = card_like(classes=TOP_VIEW_CLASSES, box_classes=("car",))
    (box,) = decode_dense(card, dense.astype(np.float32), classes, "class_logits", 0.3)
    assert np.cos(box.yaw - np.radians(degrees)) == pytest.approx(1.0, abs=1e-6)
    assert box.front == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(
    "change", [lambda scan: turned(scan, 2.5), mirrored, lambda scan: mirrored(turned(scan, -1.0))]
)
def test_the_front_stays_right_when_a_scan_is_turned_or_mirrored(change: Callable[[LabeledScan], LabeledScan]) -> None:
    """A car's nose, a point 2 m ahead of its center, stays ahead of its yaw."""
    box = Box("car", 1.0, (10.0, 3.0, -1.0), (4.0, 1.7, 1.5), 2.0)
    nose = np.float32([[10.0 + 2.0 * np.cos(2.0), 3.0 + 2.0 * np.sin(2.0), -1.0, 0.0]])
    scan = change(LabeledScan(nose, np.zeros(1, np.uint8), (box,), (1,), np.zeros((500, 500), np.uint8)))
    (moved,) = scan.boxes
    x, y = scan.points[0, :2] - moved.center[:2]
    assert np.cos(moved.yaw - np.arctan2(y, x)) == pytest.approx(1.0, abs=1e-5)


def test_heat_lies_along_the_box() -> None:
    # 45 degrees to the left: ahead (up a row) goes with left (down a column).
    heat = dense_targets([(26.0, 0.0, 0.0, 8.0, 2.0, 1.5, np.pi / 4)], VIEW)[0]
    ((row, col),) = np.argwhere(heat == 1.0)
    assert heat[row - 2, col - 2] == pytest.approx(heat[row + 2, col + 2])
    assert heat[row - 2, col - 2] > 0.5 > 0.1 > heat[row - 2, col + 2]
    # The edge of the footprint, 4 m from the center, is three standard deviations away.
    ahead = dense_targets([(26.0, 0.0, 0.0, 8.0, 2.0, 1.5, 0.0)], VIEW)[0]
    ((row, col),) = np.argwhere(ahead == 1.0)
    assert ahead[row - 10, col] == pytest.approx(np.exp(-4.5), rel=1e-5)


def test_neighbors_keep_their_own_geometry() -> None:
    near, far = (20.0, 0.1, -1.0, 4.0, 1.6, 1.5, 0.0), (21.7, 0.1, -0.5, 8.0, 2.4, 3.0, 0.0)
    for boxes in ([near, far], [far, near]):
        target = dense_targets(boxes, VIEW)
        centers = np.argwhere(target[0] == 1.0)
        assert len(centers) == 2
        (far_row, far_col), (near_row, near_col) = centers  # farther ahead is higher up
        assert target[7, far_row, far_col] == pytest.approx(-0.5)
        assert target[7, near_row, near_col] == pytest.approx(-1.0)
        alone = np.maximum(dense_targets([near], VIEW)[0], dense_targets([far], VIEW)[0])
        np.testing.assert_array_equal(target[0], alone)


def test_unlabeled_cells_and_unsure_boxes_are_not_learned() -> None:
    labeled = np.ones((400, 200), bool)
    labeled[:101] = False  # the 26th output row is only partly labeled
    heat = dense_targets([CAR, (44.0, 0.0, *CAR[2:])], VIEW, labeled=labeled)[0]
    assert (heat[26:] >= 0.0).all()
    assert set(np.unique(heat[:26])) - {-1.0} == set(np.unique(heat[:26][heat[:26] >= REGRESSED_FROM]))
    assert (heat == 1.0).sum() == 2  # a labeled box counts in any cell
    plain, unsure = dense_targets([CAR], VIEW), (26.0, -4.0, *CAR[2:])
    target = dense_targets([CAR], VIEW, unsure=[unsure])
    np.testing.assert_array_equal(target[0] == -1.0, dense_targets([unsure], VIEW)[0] > 0.1)
    np.testing.assert_array_equal(target[1:], plain[1:])
    np.testing.assert_array_equal(dense_targets([CAR], VIEW, unsure=[CAR])[0] == 1.0, plain[0] == 1.0)
    assert (dense_targets([], VIEW, unsure=np.empty((0, 7))) == 0.0).all()


CLASSES = ("background", "drivable", "car", "van", "truck")
ROUND_TRIP = {  # nearest first, as slots are
    "car": (9.37, -4.21, -0.91, 3.9, 1.6, 1.5, np.pi / 2),
    "van": (22.04, 3.33, -0.62, 5.1, 1.9, 2.2, 0.0),
    "truck": (38.81, -2.4, -0.1, 10.0, 2.6, 3.3, 0.0),
}


def painted(boxes: dict[str, tuple[float, ...]]) -> np.ndarray:
    """Labels (400, 200) of upright boxes, by class."""
    labels = np.zeros((400, 200), np.uint8)
    for label, box in boxes.items():
        col, row, width, height = paper_slot_targets([box], VIEW, 1)[0] * [200, 400, 200, 400]
        rows, cols = np.ogrid[:400, :200]
        inside = (np.abs(rows + 0.5 - row) <= height / 2) & (np.abs(cols + 0.5 - col) <= width / 2)
        labels[inside] = CLASSES.index(label)
    return labels


def same_boxes(found: Sequence[Any], boxes: dict[str, tuple[float, ...]], *, atol: float) -> None:
    assert sorted(box.label for box in found) == sorted(boxes)
    for box in found:
        x, y, z, length, width, height, yaw = boxes[box.label]
        np.testing.assert_allclose(box.center, (x, y, z), atol=atol)
        np.testing.assert_allclose(box.size, (length, width, height), atol=atol)
        assert abs(np.sin(box.yaw - yaw)) < 1e-4  # front and rear look alike


@pytest.mark.parametrize("scored", [False, True])
def test_slots_survive_the_round_trip(scored: bool) -> None:
    boxes, labels = list(ROUND_TRIP.values()), painted(ROUND_TRIP)
    card = card_like(box_size_priors={label: box[3:6] for label, box in ROUND_TRIP.items()})
    if scored:
        slots = slot_targets(boxes, VIEW)
        slots[:, 4] = 8.0 * slots[:, 4] - 4.0  # logits
        probabilities = np.eye(5, dtype=np.float32)[labels].transpose(2, 0, 1)
        found = decode_scored_slots(card, slots[None], probabilities, "class_probabilities", 0.3)
    else:
        scores = np.full((400, 200), 0.5, np.float32)
        found = decode_slots(card, paper_slot_targets(boxes, VIEW, 8)[None], labels, scores)
    standing = {label: (*box[:2], box[5] / 2 - 1.73, *box[3:]) for label, box in ROUND_TRIP.items()}
    same_boxes(found, standing, atol=1e-4)


@pytest.mark.parametrize("turn", [0.0, 0.3, 1.0, 2.2, -0.8, -2.9])
def test_dense_boxes_survive_the_round_trip(turn: float) -> None:
    boxes = {label: (*box[:6], box[6] + turn) for label, box in ROUND_TRIP.items()}
    dense = dense_targets(list(boxes.values()), VIEW)
    heat = dense[0].clip(1e-6, 1.0 - 1e-6)
    dense[0] = np.log(heat) - np.log1p(-heat)
    probabilities = np.eye(5, dtype=np.float32)[painted(boxes)].transpose(2, 0, 1)
    found = decode_dense(card_like(), dense, probabilities, "class_probabilities", 0.3)
    same_boxes(found, boxes, atol=1e-4)
    assert all(box.score > 0.999 for box in found)


@pytest.mark.parametrize("gamma", [0.0, 2.0])
@pytest.mark.parametrize("weights", [None, [0.1, 1.0, 2.0, 0.0, 5.0]])
@pytest.mark.parametrize("ignored", [0.0, 0.2])
def test_cross_entropy_is_equation_4_weighted_and_of_labeled_pixels(
    rng: np.random.Generator, ignored: float, weights: list[float] | None, gamma: float
) -> None:
    logits, labels = random_maps(rng, ignored=ignored)
    total = share = 0.0
    log_p = log_softmax(logits)
    for (n, r, c), label in np.ndenumerate(labels):
        if label != IGNORE:
            weight = 1.0 if weights is None else weights[label]
            p = np.exp(log_p[n, label, r, c])
            total -= weight * (1 - p) ** gamma * log_p[n, label, r, c]
            share += weight
    tensor = None if weights is None else torch.tensor(weights)
    loss = losses.cross_entropy(torch.tensor(logits), torch.tensor(labels), tensor, focal_gamma=gamma)
    assert loss.item() == pytest.approx(total / share, rel=1e-5)


@pytest.mark.parametrize(("p", "gamma"), [(0.5, 2.0), (0.9, 2.0), (0.1, 0.5), (1.0, 0.5), (1.0, 1.0), (1.0, 2.0)])
def test_the_focal_loss_of_a_pixel_is_its_formula_and_has_a_finite_gradient(p: float, gamma: float) -> None:
    """Also of a certain one: the slope of a power below 1 is infinite at 0."""
    pair = [np.log(p), np.log(1.0 - p)] if p < 1.0 else [30.0, 0.0]
    logits = torch.tensor(pair, dtype=torch.float32).view(1, 2, 1, 1).requires_grad_()
    loss = losses.cross_entropy(logits, torch.zeros((1, 1, 1), dtype=torch.uint8), focal_gamma=gamma)
    loss.backward()
    assert loss.item() == pytest.approx(-((1.0 - p) ** gamma) * np.log(p), rel=1e-5, abs=1e-9)
    assert torch.isfinite(logits.grad).all()


def test_losses_take_bfloat16(rng: np.random.Generator) -> None:
    logits, labels = (torch.tensor(a) for a in random_maps(rng))
    loss, of_bfloat16 = losses.cross_entropy(logits, labels), losses.cross_entropy(logits.bfloat16(), labels)
    assert of_bfloat16.dtype == torch.float32
    assert of_bfloat16.item() == pytest.approx(loss.item(), rel=0.02)


@pytest.mark.parametrize(
    "loss", [losses.cross_entropy, losses.lovasz_softmax, lambda x, y: losses.pixel_loss(x, y, lovasz_weight=1.0)]
)
def test_the_loss_without_labels_is_0(loss: Callable[..., torch.Tensor]) -> None:
    logits = torch.randn(2, 4, 3, 3, requires_grad=True)
    value = loss(logits, torch.full((2, 3, 3), IGNORE, dtype=torch.uint8))
    value.backward()
    assert value.item() == 0.0
    assert not logits.grad.any()


@pytest.mark.parametrize("loss", [losses.cross_entropy, losses.lovasz_softmax])
def test_ignored_pixels_get_no_gradient(rng: np.random.Generator, loss: Callable[..., torch.Tensor]) -> None:
    logits, labels = random_maps(rng)
    tensor = torch.tensor(logits, requires_grad=True)
    loss(tensor, torch.tensor(labels)).backward()
    gradient = tensor.grad.abs().sum(1).numpy()
    assert not gradient[labels == IGNORE].any()
    assert gradient[labels != IGNORE].any()


def test_distillation_is_lowest_at_the_teachers_probabilities(rng: np.random.Generator) -> None:
    logits, _ = random_maps(rng)
    teacher = np.exp(log_softmax(rng.normal(size=logits.shape)))
    expected = -(teacher * log_softmax(logits.astype(np.float64))).sum(1).mean()
    loss = losses.distillation_loss(torch.from_numpy(logits), torch.from_numpy(teacher))
    assert float(loss) == pytest.approx(expected, rel=1e-5)
    assert losses.distillation_loss(torch.from_numpy(np.log(teacher)), torch.from_numpy(teacher)) < loss


@pytest.mark.parametrize(("n_taught", "n_own"), [(9, 9), (9, 11), (11, 9), (11, 11)])
def test_distillation_of_boxes_is_weighted_by_the_teachers_heat(
    rng: np.random.Generator, n_taught: int, n_own: int
) -> None:
    taught = rng.normal(size=(2, n_taught, 3, 4)).astype(np.float32)
    own = rng.normal(size=(2, n_own, 3, 4)).astype(np.float32)
    heat = 1.0 / (1.0 + np.exp(-taught[:, 0].astype(np.float64)))
    p = 1.0 / (1.0 + np.exp(-own[:, 0].astype(np.float64)))
    share = heat * (heat >= REGRESSED_FROM)
    assert share.sum() > 1.0
    cross = -(heat * np.log(p) + (1.0 - heat) * np.log(1.0 - p)).sum()
    apart = (np.abs(own[:, :9] - taught[:, :9])[:, 1:] * np.array(losses.GEOMETRY_WEIGHTS).reshape(1, -1, 1, 1)).sum(1)
    if n_taught == n_own == 11:
        yaw = 0.5 * np.arctan2(taught[:, 5], taught[:, 6])
        theirs, ours = (front[:, 9] * np.cos(yaw) + front[:, 10] * np.sin(yaw) for front in (taught, own))
        apart += losses.FRONT_WEIGHT * cross_of_logits(ours, 1.0 / (1.0 + np.exp(-theirs.astype(np.float64))))
    expected = (cross + (apart * share).sum()) / share.sum()
    loss = losses.box_distillation_loss(torch.from_numpy(own), torch.from_numpy(taught))
    assert loss.item() == pytest.approx(expected, rel=1e-5)
    nothing = torch.from_numpy(taught).clone()
    nothing[:, 0] = -50.0
    assert torch.isfinite(losses.box_distillation_loss(torch.from_numpy(own), nothing))


def test_lovasz_of_hard_predictions_is_one_minus_mean_iou(rng: np.random.Generator) -> None:
    _, labels = random_maps(rng, n_classes=3)
    predicted = rng.integers(3, size=labels.shape)
    known = labels != IGNORE
    ious = [
        ((predicted == c) & (labels == c))[known].sum() / ((predicted == c) | (labels == c))[known].sum()
        for c in range(3)
    ]
    logits = 1e4 * np.eye(3, dtype=np.float32)[predicted].transpose(0, 3, 1, 2)
    loss = losses.lovasz_softmax(torch.tensor(logits), torch.tensor(labels))
    assert loss.item() == pytest.approx(1.0 - np.mean(ious), abs=1e-5)


def test_lovasz_is_the_extension_of_the_jaccard_loss(rng: np.random.Generator) -> None:
    """Its definition: the Jaccard loss of each set of largest errors, weighted by the steps between the errors."""
    logits, labels = random_maps(rng, n_classes=2, shape=(1, 3, 4), ignored=0.0)
    p = np.exp(log_softmax(logits))[0]
    expected = []
    for c in range(2):
        truth = labels[0] == c
        errors = np.abs(truth - p[c]).ravel()
        levels = np.append(np.sort(errors)[::-1], 0.0)
        value = 0.0
        for higher, lower in itertools.pairwise(levels):
            wrong = (errors >= higher).reshape(truth.shape)
            value += (higher - lower) * wrong.sum() / (truth | wrong).sum()
        expected.append(value)
    loss = losses.lovasz_softmax(torch.tensor(logits), torch.tensor(labels))
    assert loss.item() == pytest.approx(np.mean(expected), rel=1e-5)


@pytest.mark.parametrize("stride", [1, 2])
def test_the_loss_of_pixels_is_the_sum_of_its_parts(rng: np.random.Generator, stride: int) -> None:
    logits, labels = (torch.tensor(a) for a in random_maps(rng, n_classes=4))
    weights, few = torch.tensor([0.1, 1.0, 2.0, 3.0]), (..., slice(None, None, stride), slice(None, None, stride))
    total = losses.pixel_loss(logits, labels, weights, focal_gamma=1.5, lovasz_weight=0.7, stride=stride)
    parts = losses.cross_entropy(logits, labels, weights, focal_gamma=1.5)
    torch.testing.assert_close(total, parts + 0.7 * losses.lovasz_softmax(logits[few], labels[few]))
    torch.testing.assert_close(losses.pixel_loss(logits, labels), losses.cross_entropy(logits, labels))


def test_paper_slots_loss_is_equations_5_and_6_without_negative_slots(rng: np.random.Generator) -> None:
    predicted, target = rng.random((2, 3, 6, 4)).astype(np.float32)
    n, k, _ = target.shape
    mean_squared = [((target[..., i] - predicted[..., i]) ** 2).sum() / (n * k) for i in range(4)]
    predicted, target = torch.tensor(predicted), torch.tensor(target)
    assert losses.paper_slots_loss(predicted, target).item() == pytest.approx(sum(mean_squared))
    known = losses.paper_slots_loss(predicted[:1], target[:1])
    target[1:] = -1.0
    torch.testing.assert_close(losses.paper_slots_loss(predicted, target), known)
    assert losses.paper_slots_loss(predicted[1:], target[1:]).item() == 0.0


def slots_case(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    target = np.stack([slot_targets([CAR, (15.0, -3.0, 0.0, 6.0, 2.0, 2.0, 0.7)], VIEW), slot_targets([], VIEW)])
    target[:, :9, 4] = -1.0
    predicted = rng.uniform(0.02, 0.3, target.shape)
    predicted[..., :2] += target[..., :2] - 0.15
    predicted[..., 4] = rng.normal(size=target.shape[:2])
    return predicted.astype(np.float32), target


def test_slots_loss_is_the_presence_and_the_error_of_each_box(rng: np.random.Generator) -> None:
    predicted, target = slots_case(rng)
    tensor = torch.tensor(predicted, requires_grad=True)
    presence, boxes = losses.slots_loss(tensor, torch.tensor(target))
    learned = target[..., 4] >= 0.0
    cross = cross_of_logits(predicted[..., 4], target[..., 4] == 1.0)
    assert presence.item() == pytest.approx(cross[learned].sum() / 2, rel=1e-5)
    expected = 0.0
    present = target[..., 4] == 1.0
    for (x, y, w, h, _), (tx, ty, tw, th, _) in zip(predicted[present], target[present], strict=True):
        across = min(x + w / 2, tx + tw / 2) - max(x - w / 2, tx - tw / 2)
        along = min(y + h / 2, ty + th / 2) - max(y - h / 2, ty - th / 2)
        shared = max(across, 0.0) * max(along, 0.0)
        error = abs(x - tx) / tw + abs(y - ty) / th + abs(np.log(w / tw)) + abs(np.log(h / th))
        expected += error + 1.0 - shared / (w * h + tw * th - shared)
    assert boxes.item() == pytest.approx(expected / 2, rel=1e-4)
    (presence + boxes).backward()
    gradient = tensor.grad.numpy()
    assert (gradient[..., 4].astype(bool) == learned).all()
    assert (gradient[..., :4].any(-1) == present).all()


def test_slots_loss_of_the_truth_is_small_and_of_no_objects_is_finite(rng: np.random.Generator) -> None:
    _, target = slots_case(rng)
    perfect = torch.tensor(target)
    perfect[..., 4] = torch.where(perfect[..., 4] == 1.0, 30.0, -30.0)
    presence, boxes = losses.slots_loss(perfect, torch.tensor(target))
    assert presence.item() < 1e-6
    assert boxes.item() < 1e-5
    for value in (0.0, -1e30, 1e30):
        extreme = torch.full((1, 72, 5), value, requires_grad=True)
        loss = sum(losses.slots_loss(extreme, torch.tensor(target[1:])))
        loss.backward()
        assert extreme.grad.isfinite().all()
        assert loss.isfinite()


def cross_of_logits(logits: np.ndarray, truth: np.ndarray | float) -> np.ndarray:
    p = 1.0 / (1.0 + np.exp(-logits.astype(np.float64)))
    return -(truth * np.log(p) + (1.0 - truth) * np.log(1.0 - p))


def dense_case(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    target = np.stack([dense_targets([CAR, (15.0, -3.0, 0.0, 6.0, 2.0, 2.0, 0.7)], VIEW), dense_targets([], VIEW)])
    target[:, 0, :20] = -1.0
    return rng.normal(size=target.shape).astype(np.float32), target


def test_dense_loss_is_of_the_learned_cells(rng: np.random.Generator) -> None:
    predicted, target = dense_case(rng)
    heat, p = target[:, 0], 1.0 / (1.0 + np.exp(-predicted[:, 0].astype(np.float64)))
    hit = (1 - p) ** 2 * np.log(p)
    miss = (1 - heat) ** 4 * p**2 * np.log(1 - p)
    expected_heat = -(hit[heat == 1].sum() + miss[(heat >= 0) & (heat < 1)].sum()) / 2
    share = np.where(heat >= REGRESSED_FROM, heat, 0.0)
    error = (np.abs(predicted - target)[:, 1:9] * np.reshape(losses.GEOMETRY_WEIGHTS, (1, 8, 1, 1))).sum(1)
    heat_loss, geometry_loss = losses.dense_loss(torch.tensor(predicted[:, :9]), torch.tensor(target))
    assert heat_loss.item() == pytest.approx(expected_heat, rel=1e-4)
    assert geometry_loss.item() == pytest.approx((error * share).sum() / share.sum(), rel=1e-4)
    error += losses.FRONT_WEIGHT * cross_of_logits((predicted * target)[:, 9:].sum(1), 1.0)
    tensor = torch.tensor(predicted, requires_grad=True)
    with_front = losses.dense_loss(tensor, torch.tensor(target))
    assert with_front[0].item() == heat_loss.item()
    assert with_front[1].item() == pytest.approx((error * share).sum() / share.sum(), rel=1e-4)
    sum(with_front).backward()
    gradient = tensor.grad.numpy()
    assert not gradient[:, 0][heat == -1.0].any()
    assert not gradient[:, 1:].any(1)[heat < REGRESSED_FROM].any()
    assert gradient[:, 1:].any(1)[heat >= REGRESSED_FROM].all()


def test_dense_loss_of_the_truth_is_small_and_of_no_boxes_is_finite() -> None:
    target = torch.tensor(dense_targets([CAR], VIEW))[None]
    perfect = target.clone()
    perfect[:, 0] = torch.where(target[:, 0] == 1.0, 30.0, -30.0)
    perfect[:, 9] = torch.where(target[:, 9] == 1.0, 30.0, -30.0)
    heat_loss, geometry_loss = losses.dense_loss(perfect, target)
    assert heat_loss.item() < 1e-6
    assert geometry_loss.item() < 1e-6
    extreme = torch.full((1, 10, 100, 50), 200.0, requires_grad=True)
    heat_loss, geometry_loss = losses.dense_loss(extreme, torch.zeros(1, 10, 100, 50))
    (heat_loss + geometry_loss).backward()
    assert torch.isfinite(heat_loss)
    assert geometry_loss.item() == 0.0
    assert torch.isfinite(extreme.grad).all()


@pytest.mark.parametrize("head", ["slots-paper", "slots", "dense"])
def test_ssadnet_loss_is_equation_3(rng: np.random.Generator, head: str) -> None:
    logits, labels = (torch.tensor(a) for a in random_maps(rng))
    if head == "slots":
        boxes, targets = (torch.tensor(a) for a in slots_case(rng))
        detection = sum(losses.slots_loss(boxes, targets))
    elif head == "slots-paper":
        boxes, targets = (torch.tensor(a.astype(np.float32)) for a in rng.random((2, 2, 6, 4)))
        detection = losses.paper_slots_loss(boxes, targets)
    else:
        boxes, targets = (torch.tensor(a) for a in dense_case(rng))
        detection = sum(losses.dense_loss(boxes, targets))
    segmentation = losses.cross_entropy(logits, labels)
    total = losses.ssadnet_loss(logits, boxes, labels, targets)
    torch.testing.assert_close(total, 1.0 * segmentation + 0.1 * detection)
    total = losses.ssadnet_loss(logits, boxes, labels, targets, lw_det=0.5)
    torch.testing.assert_close(total, segmentation + 0.5 * detection)


@pytest.mark.parametrize("shape", [(2, 6, 4), (2, 6, 5), (2, 9, 4, 3), (2, 10, 4, 3)])
def test_a_batch_without_ground_truth_is_not_learned(shape: tuple[int, ...]) -> None:
    logits, boxes = torch.randn(2, 5, 16, 12, requires_grad=True), torch.randn(shape, requires_grad=True)
    labels = torch.full((2, 16, 12), IGNORE, dtype=torch.uint8)
    total = losses.ssadnet_loss(logits, boxes, labels, torch.full(shape, -1.0), class_weights=torch.rand(5))
    total.backward()
    assert total.item() == 0.0
    assert not logits.grad.any()
    assert not boxes.grad.any()
