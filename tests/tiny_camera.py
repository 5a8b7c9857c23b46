"""A camera model made of bytes, without onnx: one convolution, whose answers numpy computes."""

from __future__ import annotations

import hashlib
import struct
import zlib
from pathlib import Path

import numpy as np
import tiny_model
from tiny_model import field, integers, node, shaped, tensor

from edgeperc.inference.session import golden_input
from edgeperc.types.card import Golden, InputSpec, ModelCard, OutputSpec
from edgeperc.types.views import CameraGeometry

CLASSES = ("Sky", "Road", "Tree")
# A pixel is road if it is red, a tree if it is green, sky if it is blue.
WEIGHTS = np.array([[-1.0, -1.0, 2.0], [2.0, -1.0, -1.0], [-1.0, 2.0, -1.0]], np.float32)


def camera_card(width: int = 32, height: int = 24, stride: int = 4) -> ModelCard:
    """Of `camera_model`, named tinycam."""
    x = golden_input(3, (1, 3, height, width))
    blocks = x.reshape(1, 3, height // stride, stride, width // stride, stride).mean(axis=(3, 5))
    answers = np.einsum("kc,ncij->nkij", WEIGHTS, blocks)
    kept = range(0, answers.size, max(1, answers.size // 24))
    record = {
        "sha256": "",
        "std": float(answers.std()),
        "positions": [*kept],
        "values": [float(answers.ravel()[k]) for k in kept],
    }
    return ModelCard(
        name="tinycam",
        version="1",
        view=CameraGeometry(width, height),
        input=InputSpec("x", ("red", "green", "blue"), (127.5,) * 3, (127.5,) * 3),
        outputs=(OutputSpec("y", "camera_logits"),),
        classes=CLASSES,
        golden=Golden(3, hashlib.sha256(x.tobytes()).hexdigest(), {"y": record}),
        training={"licence": "CC0-1.0"},
    )


def camera_model(card: ModelCard | None = None, stride: int = 4) -> bytes:
    """The bytes of an .onnx file: a convolution whose stride and kernel are ``stride`` pixels."""
    card = camera_card(stride=stride) if card is None else card
    height, width = card.view.height, card.view.width
    weights = np.repeat(np.repeat(WEIGHTS[:, :, None, None], stride, axis=2), stride, axis=3) / stride**2
    square = integers("kernel_shape", stride, stride) + integers("strides", stride, stride)
    graph = node("Conv", "x w", "y", square) + field(
        5, tensor("w", (3, 3, stride, stride), weights.astype("<f4").tobytes())
    )
    graph += field(2, b"g") + field(11, shaped("x", (1, 3, height, width)))
    graph += field(12, shaped("y", (1, 3, height // stride, width // stride)))
    return tiny_model.model(graph, card=card)


def write_camera(folder: Path) -> Path:
    """Write `camera_model` as tinycam.onnx; return its path."""
    path = folder / "tinycam.onnx"
    path.write_bytes(camera_model())
    return path


PNG = b"\x89PNG\r\n\x1a\n"


def png_chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png_file(width: int, height: int, depth: int, color: int, rows: bytes) -> bytes:
    """A PNG file made by hand, for what Pillow does not write."""
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0))
    return PNG + header + png_chunk(b"IDAT", zlib.compress(rows)) + png_chunk(b"IEND", b"")
