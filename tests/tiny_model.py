"""Model files made of bytes, without onnx: the fields of protobuf, and a network of one convolution."""

from __future__ import annotations

import hashlib

import numpy as np

from edgeperc.inference.session import golden_input
from edgeperc.types.card import CARD_KEY, Golden, InputSpec, ModelCard, OutputSpec
from edgeperc.types.views import TopViewGeometry

SHAPE = (1, 2, 16, 16)
WEIGHTS = np.array([[1.0, 2.0], [-1.0, 0.5]], np.float32)


def varint(value: int) -> bytes:
    """A number of at most 64 bits."""
    value &= (1 << 64) - 1
    groups = bytearray()
    while value > 0x7F:
        groups.append(value & 0x7F | 0x80)
        value >>= 7
    groups.append(value)
    return bytes(groups)


def field(key: int, content: bytes) -> bytes:
    return varint(key << 3 | 2) + varint(len(content)) + content


def number(key: int, value: int) -> bytes:
    return varint(key << 3) + varint(value)


def entry(key: str, value: bytes) -> bytes:
    """An entry of a model's metadata."""
    return field(14, field(1, key.encode()) + field(2, value))


def tensor(name: str, shape: tuple[int, ...], content: bytes, kind: int = 1, more: bytes = b"") -> bytes:
    dims = b"".join(number(1, n) for n in shape)
    return dims + number(2, kind) + field(8, name.encode()) + field(9, content) + more


def node(operator: str, inputs: str, outputs: str, more: bytes = b"") -> bytes:
    names = b"".join(field(1, name.encode()) for name in inputs.split())
    names += b"".join(field(2, name.encode()) for name in outputs.split())
    return field(1, names + field(4, operator.encode()) + more)


def shaped(name: str, shape: tuple[int, ...], kind: int = 1) -> bytes:
    dims = b"".join(field(1, number(1, n)) for n in shape)
    return field(1, name.encode()) + field(2, field(1, number(1, kind) + field(2, dims)))


def integers(name: str, *values: int) -> bytes:
    """An attribute of a node."""
    return field(5, field(1, name.encode()) + b"".join(number(8, value) for value in values) + number(20, 7))


CONVOLUTION = node("Conv", "x w", "y", integers("kernel_shape", 1, 1))
INITIALIZER = field(5, tensor("w", (2, 2, 1, 1), WEIGHTS.tobytes()))


HALF = node("Cast", "half", "x", field(5, field(1, b"to") + number(3, 1) + number(20, 2)))


def graph(*parts: bytes) -> bytes:
    """Of the nodes and weights ``parts``; with `HALF`, its input is in half precision."""
    given = shaped("half", SHAPE, 10) if HALF in parts else shaped("x", SHAPE)
    return b"".join(parts) + field(2, b"g") + field(11, given) + field(12, shaped("y", SHAPE))


def tiny_card() -> ModelCard:
    """Of a network with one convolution of 1x1, whose answers numpy computes."""
    x = golden_input(3, SHAPE)
    answers = np.einsum("kc,ncij->nkij", WEIGHTS, x)
    record = {
        "sha256": "",
        "std": float(answers.std()),
        "positions": [*range(0, 512, 16)],
        "values": [float(v) for v in answers.ravel()[::16]],
    }
    return ModelCard(
        name="tiny",
        version="1",
        view=TopViewGeometry((0.0, 16.0), (-8.0, 8.0), (-3.0, 3.0), 1.0),
        input=InputSpec("x", ("distance", "height"), (0.0, 0.0), (10.0, 1.0)),
        outputs=(OutputSpec("y", "class_logits"),),
        classes=("background", "drivable"),
        golden=Golden(3, hashlib.sha256(x.tobytes()).hexdigest(), {"y": record}),
    )


def model(graph: bytes, more: bytes = b"", card: ModelCard | bytes | None = None) -> bytes:
    """The bytes of an .onnx file with a card, `tiny_card` by default."""
    text = card if isinstance(card, bytes) else (card or tiny_card()).to_json().encode()
    return number(1, 8) + field(8, number(2, 17)) + field(7, graph) + more + entry(CARD_KEY, text)
