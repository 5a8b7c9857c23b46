"""Augmentation (pasted objects, swapped sectors, bad weather) keeps the labels correct."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("tqdm")

from edgeperc.preprocess.remission import NO_REMISSION
from edgeperc.simulation.samples import IGNORE, simulated_scan
from edgeperc.simulation.scene import POINT_CLASS_OF
from edgeperc.types.geometry import inside
from edgeperc.types.perception import Box
from edgeperc_export.data import augment
from edgeperc_export.data.scans import SURFACE, LabeledScan, turned

GROUND_M = -1.73


def flat_street(*others: np.ndarray, label: int = 0) -> LabeledScan:
    """Ground points every 10 cm ahead, and others of a label."""
    x, y = np.meshgrid(np.arange(3.0, 40.0, 0.1), np.arange(-12.0, 12.0, 0.1))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, GROUND_M), np.full(x.size, 0.3)], 1).astype(np.float32)
    unknown = np.full((SURFACE.height, SURFACE.width), IGNORE, np.uint8)
    labels = np.repeat(np.uint8([0, label]), [len(points), sum(map(len, others))])
    return LabeledScan(np.concatenate([points, *others]), labels, (), (), unknown)


def post(x: float, y: float, label: str = "pedestrian") -> tuple[Box, np.ndarray]:
    """A flat figure facing the sensor, 0.4 m wide and 1.7 m tall."""
    across, up = np.meshgrid(np.arange(-0.2, 0.2, 0.02), np.arange(0.05, 1.7, 0.05))
    points = np.full((across.size, 4), 0.5, np.float32)
    points[:, 0], points[:, 1], points[:, 2] = x, y + across.ravel(), GROUND_M + up.ravel()
    return Box(label, 1.0, (x, y, GROUND_M + 0.85), (0.6, 0.6, 1.7), 0.0), points


@pytest.fixture(scope="module")
def scan() -> LabeledScan:
    return LabeledScan.from_simulation(simulated_scan(17))


def test_points_in_a_simulated_box_belong_to_the_object(scan: LabeledScan) -> None:
    for box, count in zip(scan.boxes, scan.counts, strict=True):
        core = replace(box, size=(box.size[0], box.size[1], box.size[2] - 0.2))  # clear of the ground
        if count and not any(b is not box and np.hypot(*np.subtract(b.center, box.center)[:2]) < 6 for b in scan.boxes):
            assert set(scan.labels[inside(core, scan.points)]) <= {POINT_CLASS_OF[box.label]}


def test_a_bank_holds_each_object_with_its_points() -> None:
    box, points = post(10.0, 0.0)
    held = replace(
        flat_street(points, label=2),
        boxes=(box, replace(box, center=(20.0, 5.0, -0.88)), replace(box, label="tram")),
        counts=(len(points), 3, 50),  # enough returns, too few returns, an unknown class
    )
    bank = augment.ObjectBank.of([held])
    ((kept, cut),) = bank.objects.pop("pedestrian")
    assert not bank.objects
    assert kept == box
    assert len(cut) >= len(points)
    assert inside(box, cut).all()


def test_a_pasted_object_hides_only_what_is_behind_it() -> None:
    box, points = post(10.0, 0.0, "car")
    street = flat_street()
    bank = augment.ObjectBank({"car": [(box, points)]})
    out = augment.pasted(street, bank, np.random.default_rng(0), 1, {"car": 1.0})
    (there,) = out.boxes
    (count,) = out.counts
    assert count == np.count_nonzero(out.labels == 1) == len(points)
    assert np.hypot(*there.center[:2]) == pytest.approx(10.0)  # as far away as it was
    assert there.center[2] - there.size[2] / 2 == pytest.approx(GROUND_M, abs=0.01)
    assert inside(there, out.points[out.labels == 1], 0.01).all()
    azimuth = np.arctan2(there.center[1], there.center[0])

    left = {tuple(p) for p in out.points[out.labels == 0].tolist()}
    lost = np.array([p for p in street.points.tolist() if tuple(p) not in left])
    assert len(lost) > 50
    assert (np.hypot(lost[:, 0], lost[:, 1]) > 9.5).all()  # its shadow begins at its base
    assert (np.abs(np.arctan2(lost[:, 1], lost[:, 0]) - azimuth) < np.radians(1.6)).all()


def test_an_object_behind_a_wall_is_not_pasted() -> None:
    y, z = np.meshgrid(np.arange(-12.0, 12.0, 0.01), np.arange(GROUND_M, 2.0, 0.03))
    wall = np.stack([np.full(y.size, 5.0), y.ravel(), z.ravel(), np.full(y.size, 0.2)], 1).astype(np.float32)
    hidden = flat_street(wall)
    bank = augment.ObjectBank({"pedestrian": [post(10.0, 0.0)]})
    for seed in range(5):
        assert augment.pasted(hidden, bank, np.random.default_rng(seed), 1, {"pedestrian": 1.0}) is hidden


def test_objects_are_not_pasted_into_one_another() -> None:
    bank = augment.ObjectBank({"pedestrian": [post(10.0, 0.0)], "cyclist": [post(10.0, 0.0, "cyclist")]})
    out = augment.pasted(flat_street(), bank, np.random.default_rng(3), 60, {"pedestrian": 1.0, "cyclist": 1.0})
    centers = np.array([b.center[:2] for b in out.boxes])
    apart = np.hypot(*(centers[:, None] - centers[None]).transpose(2, 0, 1)) + 9 * np.eye(len(centers))
    assert len(centers) > 5
    assert apart.min() > 0.7
    assert {b.label for b in out.boxes} == {"pedestrian", "cyclist"}


def test_nothing_to_paste_is_no_change(scan: LabeledScan) -> None:
    empty = replace(flat_street(), points=np.zeros((0, 4), np.float32), labels=np.zeros(0, np.uint8))
    one = {"pedestrian": [post(10, 0)]}
    for street, objects, n in ((scan, {}, 5), (scan, one, 0), (empty, one, 5)):
        bank, rng = augment.ObjectBank(objects), np.random.default_rng(0)
        assert augment.pasted(street, bank, rng, n, {"pedestrian": 1.0}) is street


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1))
def test_pasted_labels_are_those_of_the_boxes(scan: LabeledScan, seed: int) -> None:
    rng = np.random.default_rng(seed)
    bank = augment.ObjectBank.of([scan])
    out = augment.pasted(scan, bank, rng, 6, dict.fromkeys(bank.objects, 1.0))
    assert len(out.points) == len(out.labels)
    assert len(out.boxes) == len(out.counts)
    for box, count in zip(out.boxes[len(scan.boxes) :], out.counts[len(scan.boxes) :], strict=True):
        own = inside(box, out.points, 0.05) & (out.labels == POINT_CLASS_OF[box.label])
        assert np.count_nonzero(own) >= 0.9 * count > 0


def test_a_swapped_sector_keeps_its_labels(scan: LabeledScan) -> None:
    other = replace(scan, points=scan.points + np.float32([0, 0, 0.5, 0]), labels=np.full_like(scan.labels, 3))
    scan = replace(scan, labels=np.zeros_like(scan.labels))
    out = augment.swapped(scan, other, np.random.default_rng(1))
    azimuth = np.arctan2(out.points[:, 1], out.points[:, 0])
    low, high = azimuth[out.labels == 3].min(), azimuth[out.labels == 3].max()
    assert np.radians(20) < high - low <= np.pi / 4
    within = (azimuth > low) & (azimuth < high)
    assert (out.labels[within] == 3).all()
    assert (out.labels[~within & (azimuth != low) & (azimuth != high)] == 0).all()


def test_weather_loses_returns_and_labels_drops_background(scan: LabeledScan) -> None:
    out = augment.weathered(replace(scan, labels=np.ones_like(scan.labels)), np.random.default_rng(4))
    far = [np.mean(np.linalg.norm(s.points[:, :3], axis=1) > 30) for s in (scan, out)]
    assert far[1] < far[0]
    assert len(out.points) == len(out.labels) < len(scan.points)
    drops = out.labels == 0
    assert 0 < drops.mean() < 0.02
    unknown = augment.weathered(replace(scan, labels=np.full_like(scan.labels, IGNORE)), np.random.default_rng(4))
    assert (unknown.labels == IGNORE).all()


def test_facing_turns_a_rare_object_to_the_front(scan: LabeledScan) -> None:
    rare = [b for b, n in zip(scan.boxes, scan.counts, strict=True) if b.label in ("pedestrian", "cyclist") and n >= 5]
    assert rare, "the scene has no pedestrian or cyclist"
    for seed in range(5):
        angle = augment.facing(scan, np.random.default_rng(seed))
        ahead = [b for b in turned(scan, angle).boxes if b.label in ("pedestrian", "cyclist")]
        assert min(abs(np.arctan2(b.center[1], b.center[0])) for b in ahead) <= 0.6
    assert augment.facing(flat_street(), np.random.default_rng(0)) == 0.0


def test_a_scan_labeled_on_all_sides_turns_anywhere(scan: LabeledScan) -> None:
    middle = np.array([scan.boxes[0].center[:2]])

    def turns(**how: float) -> np.ndarray:
        seen = [
            augment.augmented(scan, np.random.default_rng(seed), augment.Augmentation(**how)).boxes[0].center[:2]
            for seed in range(60)
        ]
        return np.abs(np.degrees(np.angle(np.array(seen) @ [1, 1j] / (middle @ [1, 1j]))))

    # A mirror changes only the sign of an angle, so an object ahead or behind shows how far the scan was turned.
    along = np.degrees(np.abs(np.arctan2(middle[0, 1], np.abs(middle[0, 0]))))
    street = turns()
    assert np.minimum(street, 180.0 - street).max() < 2 * along + 25.0
    anywhere = turns(turn_anywhere=1.0)
    assert np.histogram(anywhere, bins=6, range=(0.0, 180.0))[0].min() >= 2


def test_the_same_draw_gives_the_same_scan(scan: LabeledScan) -> None:
    bank = augment.ObjectBank.of([scan])
    how = augment.Augmentation(n_pasted=5.0, turn_to_rare=0.5, weather=0.5)
    one, other = (augment.augmented(scan, np.random.default_rng(9), how, bank) for _ in range(2))
    np.testing.assert_array_equal(one.points, other.points)
    np.testing.assert_array_equal(one.labels, other.labels)
    assert one.boxes == other.boxes


def test_saved_scans_read_back(tmp_path: Path, scan: LabeledScan) -> None:
    scan.save(tmp_path / "scan.npz")
    back = LabeledScan.load(tmp_path / "scan.npz")
    np.testing.assert_array_equal(back.labels, scan.labels)
    assert back.counts == scan.counts


def pole_and_wall() -> LabeledScan:
    """A street with a pole of 3 m, a pedestrian as tall as a pedestrian, and a wall of 8 m."""
    up, side = np.meshgrid(np.arange(0.05, 3.0, 0.05), np.arange(-0.06, 0.06, 0.03))
    pole = np.stack([np.full(up.size, 12.0), 4.0 + side.ravel(), GROUND_M + up.ravel()], 1)
    up, along = np.meshgrid(np.arange(0.05, 2.5, 0.1), np.arange(0.0, 8.0, 0.1))
    wall = np.stack([15.0 + along.ravel(), np.full(up.size, -6.0), GROUND_M + up.ravel()], 1)
    box, person = post(20.0, 2.0)
    parts = [np.column_stack([part, np.full(len(part), 0.3)]).astype(np.float32) for part in (pole, wall)]
    street = flat_street(*parts, person)
    street.labels[-len(person) :] = 2
    return replace(street, boxes=(box,), counts=(len(person),))


def test_poles_and_walls_are_cut_out_of_the_background() -> None:
    scan = pole_and_wall()
    pieces = list(augment.background_pieces(scan))
    assert sorted({box.label for box, _ in pieces}) == ["pole", "wall"]
    for box, points in pieces:
        assert inside(box, points, 0.05).all()
        foot = box.center[2] - box.size[2] / 2.0
        assert foot == pytest.approx(GROUND_M, abs=0.05)
        assert points[:, 2].min() > foot + 0.05  # without the ground
        assert len(points) > 50
    ((pole, _),) = [piece for piece in pieces if piece[0].label == "pole"]
    assert pole.center[:2] == pytest.approx((12.0, 4.0), abs=0.1)
    # A pole of unknown class, or beside a labeled object, is not known to be background.
    assert not list(augment.background_pieces(replace(scan, labels=np.full_like(scan.labels, IGNORE))))
    nothing = replace(scan, points=scan.points[:0], labels=scan.labels[:0])
    assert not list(augment.background_pieces(nothing))


def test_pasted_background_is_background_and_objects_get_the_number_of_their_class() -> None:
    bank = augment.ObjectBank.of([pole_and_wall()])
    assert set(bank.objects) == {"pedestrian", "pole", "wall"}
    out = augment.pasted(flat_street(), bank, np.random.default_rng(0), 8, augment.NEGATIVES)
    assert not out.boxes
    assert not out.counts
    assert not out.labels.any()
    assert np.count_nonzero(out.points[:, 2] > GROUND_M + 1.0) > 30
    bank = augment.ObjectBank({"cone": [post(10.0, 0.0, "cone")]}, ("background", "car", "cone"))
    out = augment.pasted(flat_street(), bank, np.random.default_rng(0), 1, {"cone": 1.0})
    assert set(np.unique(out.labels)) == {0, 2}


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), distance=st.floats(4.0, 44.0))
def test_a_resized_person_stands_on_the_same_ground(seed: int, distance: float) -> None:
    box, points = post(distance, 0.0)
    other, moved = augment.resized(box, points, np.random.default_rng(seed))
    assert distance - 1e-6 <= np.hypot(*other.center[:2]) <= min(1.6 * distance, augment.MAX_PERSON_RANGE_M) + 1e-6
    assert other.center[2] - other.size[2] / 2 == pytest.approx(GROUND_M, abs=1e-6)
    assert 0.87 <= other.size[2] / box.size[2] <= 1.15
    assert inside(other, moved, 0.01).all()
    assert 0 < len(moved) <= len(points)


def test_the_ground_at_the_bumper_is_background() -> None:
    box, points = post(4.0, 1.0)
    street = flat_street()
    scan = replace(flat_street(points, label=IGNORE), boxes=(box,), counts=(len(points),))
    scan.labels[:] = IGNORE
    out = augment.with_ground_ahead(scan)
    known = out.labels == 0
    near = (scan.points[:, 0] < 6.0) & (np.abs(scan.points[:, 1]) < 3.0) & (scan.points[:, 2] < GROUND_M + 0.2)
    assert (near | ~known).all()
    assert np.count_nonzero(known) > 500
    assert not (known & inside(box, scan.points)).any()
    assert augment.with_ground_ahead(street) is street


def test_a_tilted_scan_keeps_its_objects(scan: LabeledScan) -> None:
    out = augment.tilted(scan, np.radians(0.5), np.radians(-0.5), 0.05)
    for box, other in zip(scan.boxes, out.boxes, strict=True):
        shift = np.subtract(other.center, box.center)
        assert abs(shift[2]) < 0.05 + np.radians(0.75) * np.hypot(*box.center[:2])
        core = replace(box, size=(box.size[0], box.size[1], box.size[2] - 0.2))
        own = inside(core, scan.points)
        assert inside(replace(other, size=box.size), out.points[own], 0.2).all()
    np.testing.assert_allclose(
        np.linalg.norm(out.points[:, :3] - np.float32([0, 0, 0.05]), axis=1),
        np.linalg.norm(scan.points[:, :3], axis=1),
        rtol=1e-3,
    )


def test_noise_moves_points_along_their_rays(scan: LabeledScan) -> None:
    far = np.linalg.norm(scan.points[:, :3], axis=1) > 2.0
    spreads = []
    for seed in range(20):
        other = augment.noisy(scan, np.random.default_rng(seed), 0.03)
        moved = (other.points[:, :3] - scan.points[:, :3])[far]
        ray = scan.points[far, :3] / np.linalg.norm(scan.points[far, :3], axis=1)[:, None]
        along = (moved * ray).sum(axis=1)
        np.testing.assert_allclose(moved, along[:, None] * ray, atol=1e-4)
        assert abs(along.mean()) < 1e-3
        spreads.append(along.std())
        np.testing.assert_array_equal(other.points[:, 3], scan.points[:, 3])
    assert 0.0 <= min(spreads) < 0.01 < 0.02 < max(spreads) <= 0.031


def test_scans_without_remission_have_the_constant_of_the_runtime(scan: LabeledScan) -> None:
    rng = np.random.default_rng(0)
    missing = augment.augmented(scan, rng, augment.Augmentation(no_remission=1.0))
    assert (missing.points[:, 3] == np.float32(NO_REMISSION.coefficients[0])).all()
    assert np.ptp(augment.augmented(scan, rng).points[:, 3]) > 0.1
