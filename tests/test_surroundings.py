"""`sceneseg` in the runtime: surroundings are no objects, and the road is known on all sides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edgeperc import Perceiver, Perception, RollingGrid, occupancy_grid
from edgeperc.simulation.samples import FIRST_SEED, labels_of_scene, simulated_scan
from edgeperc.simulation.scene import SCENE_CLASSES, SimulatedScan
from edgeperc.types.choices import STATIC
from edgeperc.types.views import TopViewGeometry
from edgeperc.zoo import resolve
from edgeperc_export.recipe import MODELS

VIEW = TopViewGeometry((-30.0, 30.0), (-30.0, 30.0), cell_m=0.2)


@pytest.fixture(scope="module")
def perceived() -> tuple[SimulatedScan, Perception]:
    scan = simulated_scan(FIRST_SEED + 3)
    return scan, Perceiver(["ssadnet", "sceneseg", "objects"], full_turn=True, n_threads=1)(scan.points)


def test_the_model_has_the_classes_that_it_is_trained_for() -> None:
    (variant,) = resolve("sceneseg")
    assert variant.card.classes == SCENE_CLASSES == MODELS["sceneseg"].recipe.classes
    assert all(frame.startswith("pandaset/") for frame in variant.card.training["frames"])
    assert "CC BY 4.0" in variant.card.training["licence"]


def test_most_points_have_their_class(perceived: tuple[SimulatedScan, Perception]) -> None:
    scan, perception = perceived
    labels, true = perception.require_points(), labels_of_scene(scan)
    assert labels.classes == SCENE_CLASSES
    for name in ("road", "building", "car"):
        of_class = labels.in_view & (true == SCENE_CLASSES.index(name))
        assert np.count_nonzero(of_class) > 500
        assert (labels.labels[of_class] == SCENE_CLASSES.index(name)).mean() > 0.7, name


def test_surroundings_have_no_boxes(perceived: tuple[SimulatedScan, Perception]) -> None:
    _, perception = perceived
    assert perception.boxes
    assert not {box.label for box in perception.boxes} & {*STATIC, "background"}
    assert not perception.require_points().objects().labels[~perception.require_points().in_view].any()


def test_a_card_says_which_classes_have_boxes(perceived: tuple[SimulatedScan, Perception]) -> None:
    perceive = Perceiver("sceneseg", n_threads=1)
    network = perceive.pipeline.ranged[0]
    network.card = replace(network.card, box_classes=("pole",))
    found = perceive(perceived[0].points)
    assert {box.label for box in found.boxes} == {"pole"}
    assert np.count_nonzero(found.require_points().labels == SCENE_CLASSES.index("car")) > 100


def test_agreement_changes_objects_alone(perceived: tuple[SimulatedScan, Perception]) -> None:
    scan, perception = perceived
    alone = Perceiver(["ssadnet", "sceneseg", "objects"], full_turn=True, n_threads=1, agree=False)(scan.points)
    before, after = alone.require_points().labels, perception.require_points().labels
    changed = before != after
    assert changed.any()
    static = np.isin(after, [SCENE_CLASSES.index(name) for name in STATIC])
    assert not (changed & static).any()  # what is no object any more is background


def test_the_road_behind_is_drivable(perceived: tuple[SimulatedScan, Perception]) -> None:
    scan, perception = perceived
    grid = occupancy_grid(perception, scan.points)
    assert grid.x_range_m == grid.y_range_m == (-40.0, 40.0)
    grid = occupancy_grid(perception, scan.points, x_range_m=VIEW.x_range_m, y_range_m=VIEW.y_range_m)
    x, _ = np.broadcast_arrays(*VIEW.cell_centers())
    behind, road = grid.observed & (x < 0.0), scan.top_view_labels(VIEW) == 1
    found = grid.drivable & behind
    assert np.count_nonzero(found) * grid.cell_m**2 > 50.0
    assert road[found].mean() > 0.7
    assert not (grid.drivable & grid.obstacle).any()


def test_without_such_labels_no_road_is_behind(perceived: tuple[SimulatedScan, Perception]) -> None:
    scan, _ = perceived
    perception = Perceiver(["ssadnet", "pointseg"], full_turn=True, n_threads=1)(scan.points)
    grid = occupancy_grid(perception, scan.points, x_range_m=VIEW.x_range_m, y_range_m=VIEW.y_range_m)
    x, _ = np.broadcast_arrays(*VIEW.cell_centers())
    assert not grid.drivable[x < 0.0].any()
    assert grid.drivable[x > 6.0].any()


def test_one_and_two_threads_give_the_same(perceived: tuple[SimulatedScan, Perception]) -> None:
    scan, perception = perceived
    again = Perceiver(["ssadnet", "sceneseg", "objects"], full_turn=True, n_threads=2)(scan.points)
    np.testing.assert_array_equal(again.require_points().labels, perception.require_points().labels)
    assert again.boxes == perception.boxes


def test_a_rolling_grid_judges_the_ground_on_all_sides(perceived: tuple[SimulatedScan, Perception]) -> None:
    scan, perception = perceived
    seen = []
    for labels in (perception.points, perception.require_points().objects()):
        rolling = RollingGrid(remember_s=1.0)
        rolling.update(replace(perception, points=labels, stamp_s=1.0), scan.points, np.eye(4))
        seen.append(np.count_nonzero(rolling.values(off_road=50, unjudged=25)[:, :90] == 25))  # columns behind
    assert seen[0] == 0 < seen[1]
