"""Labels of the surroundings: apart from those of objects, and together with them again."""

from __future__ import annotations

import numpy as np
import pytest

from edgeperc.types.choices import STATIC
from edgeperc.types.perception import PointLabels

CLASSES = ("background", "road", "car", "building", "pedestrian")


def labels_of(*names: str, classes: tuple[str, ...] = CLASSES) -> PointLabels:
    return PointLabels(
        np.array([classes.index(name) for name in names], np.uint8), np.ones(len(names), np.bool_), classes
    )


def names_of(labels: PointLabels) -> list[str]:
    return [labels.classes[k] for k in labels.labels]


def test_surroundings_are_background_among_objects() -> None:
    objects = labels_of("road", "car", "building", "pedestrian", "background").objects()
    assert objects.classes == ("background", "car", "pedestrian")
    assert names_of(objects) == ["background", "car", "background", "pedestrian", "background"]


def test_without_surroundings_nothing_changes() -> None:
    labels = labels_of("car", "background", classes=("background", "car"))
    assert labels.objects() is labels
    assert labels.with_objects(labels) is labels


@pytest.mark.parametrize(
    ("seen", "agreed", "expected"),
    [
        ("road", "background", "road"),
        ("building", "car", "car"),  # a box adds a label
        ("car", "background", "background"),  # no object any more, and nothing else is known
        ("car", "pedestrian", "pedestrian"),
        ("background", "background", "background"),
    ],
)
def test_labels_of_objects_are_put_back(seen: str, agreed: str, expected: str) -> None:
    labels = labels_of(seen)
    objects = labels_of(agreed, classes=("background", "car", "pedestrian"))
    assert names_of(labels.with_objects(objects)) == [expected]


def test_apart_and_together_is_the_same() -> None:
    rng = np.random.default_rng(1)
    classes = ("background", *STATIC, "car")
    for n in (0, 1, 500):
        labels = PointLabels(rng.integers(0, len(classes), n).astype(np.uint8), rng.random(n) < 0.7, classes)
        again = labels.with_objects(labels.objects())
        np.testing.assert_array_equal(again.labels, labels.labels)
        np.testing.assert_array_equal(again.in_view, labels.in_view)
        assert again.classes == classes
