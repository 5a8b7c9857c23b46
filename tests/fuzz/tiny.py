"""A tiny model file made of bytes, and cards of other views."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np

from edgeperc.card import CARD_KEY, Golden, InputSpec, ModelCard, OutputSpec, RangeImageGeometry, TopViewGeometry
from edgeperc.session import golden_input
from edgeperc.zoo import resolve

from .mutate import varint

__all__ = ["CARD", "GRAPH", "boxed_card", "field", "image_card", "model", "node", "number", "tensor"]

SHAPE = (1, 2, 16, 16)
WEIGHTS = np.array([[1.0, 2.0], [-1.0, 0.5]], np.float32)


def _card() -> ModelCard:
    x = golden_input(3, SHAPE)
    answers = np.einsum("kc,ncij->nkij", WEIGHTS, x)
    places = [*range(0, 512, 16)]
    record = {"std": float(answers.std()), "positions": places, "values": [float(v) for v in answers.ravel()[places]]}
    return ModelCard(
        name="tiny",
        version="1",
        view=TopViewGeometry((0.0, 16.0), (-8.0, 8.0), (-3.0, 3.0), 1.0),
        input=InputSpec("x", ("distance", "height"), (0.0, 0.0), (10.0, 1.0)),
        outputs=(OutputSpec("y", "class_logits"),),
        classes=("background", "drivable"),
        fitness=resolve("lodnn")[0].card.fitness,
        golden=Golden(3, hashlib.sha256(x.tobytes()).hexdigest(), {"y": record}),
    )


CARD = _card()
"""Of the network `GRAPH`: one convolution of 1x1, whose answers numpy computes."""


def boxed_card() -> ModelCard:
    """With oriented boxes."""
    sizes = {"car": (4.0, 1.8, 1.6), "van": (5.0, 2.0, 2.2)}
    return replace(
        CARD,
        golden=None,
        outputs=(OutputSpec("d", "box_dense"), OutputSpec("y", "class_logits")),
        classes=("background", "drivable", "car", "van"),
        box_classes=("car", "van"),
        box_size_priors=sizes,
        box_size_spreads={name: (0.1, 0.1, 0.1) for name in sizes},
    )


def image_card() -> ModelCard:
    """Of a range image."""
    return replace(
        CARD,
        golden=None,
        view=RangeImageGeometry(tuple(2.0 - 1.7 * k for k in range(16)), 64),
        input=InputSpec("x", ("x", "y", "z", "remission", "range"), (0.0,) * 5, (10.0,) * 5),
        classes=("background", "car", "pedestrian", "cyclist"),
        fitness=resolve("pointseg")[0].card.fitness,
    )


def field(number: int, content: bytes) -> bytes:
    return varint(number << 3 | 2) + varint(len(content)) + content


def number(key: int, value: int) -> bytes:
    return varint(key << 3) + varint(value)


def tensor(name: str, shape: tuple[int, ...], content: bytes, more: bytes = b"") -> bytes:
    dims = b"".join(number(1, n) for n in shape)
    return dims + number(2, 1) + field(8, name.encode()) + field(9, content) + more


def node(operator: str, inputs: str, outputs: str, more: bytes = b"") -> bytes:
    names = b"".join(field(1, name.encode()) for name in inputs.split())
    names += b"".join(field(2, name.encode()) for name in outputs.split())
    return field(1, names + field(4, operator.encode()) + more)


def shaped(name: str) -> bytes:
    dims = b"".join(field(1, number(1, n)) for n in SHAPE)
    return field(1, name.encode()) + field(2, field(1, number(1, 1) + field(2, dims)))


GRAPH = (
    node("Conv", "x w", "y")
    + field(5, tensor("w", (2, 2, 1, 1), WEIGHTS.tobytes()))
    + field(2, b"g")
    + field(11, shaped("x"))
    + field(12, shaped("y"))
)


def model(graph: bytes, card: bytes | None = None) -> bytes:
    """The bytes of an .onnx file."""
    text = CARD.to_json().encode() if card is None else card
    entry = field(14, field(1, CARD_KEY.encode()) + field(2, text))
    return number(1, 8) + field(8, number(2, 17)) + field(7, graph) + entry
