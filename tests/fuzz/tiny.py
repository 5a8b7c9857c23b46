"""Cards of other views for the tiny model."""

from __future__ import annotations

from dataclasses import replace

import tiny_model

from edgeperc.types.card import CHANNELS, InputSpec, ModelCard, OutputSpec
from edgeperc.types.views import RangeImageGeometry
from edgeperc.zoo import resolve

CARD = replace(tiny_model.tiny_card(), fitness=resolve("lodnn")[0].card.fitness)
GRAPH = tiny_model.graph(tiny_model.CONVOLUTION, tiny_model.INITIALIZER)


def model(graph: bytes, card: bytes | None = None) -> bytes:
    """The bytes of an .onnx file, with `CARD` by default."""
    return tiny_model.model(graph, card=CARD if card is None else card)


def boxed_card() -> ModelCard:
    """With oriented boxes that know their fronts."""
    sizes = {"car": (4.0, 1.8, 1.6), "van": (5.0, 2.0, 2.2)}
    return replace(
        CARD,
        golden=None,
        outputs=(OutputSpec("d", "box_dense", front=True), OutputSpec("y", "class_logits")),
        classes=("background", "drivable", "car", "van"),
        box_classes=("car", "van"),
        box_size_priors=sizes,
        box_size_spreads={name: (0.1, 0.1, 0.1) for name in sizes},
    )


def image_card() -> ModelCard:
    """Of a range image with every channel."""
    names = CHANNELS["range_image"]
    return replace(
        CARD,
        golden=None,
        view=RangeImageGeometry(tuple(2.0 - 1.7 * k for k in range(16)), 64),
        input=InputSpec("x", names, (0.0,) * len(names), (10.0,) * len(names)),
        classes=("background", "car", "pedestrian", "cyclist"),
        fitness=resolve("pointseg")[0].card.fitness,
    )
