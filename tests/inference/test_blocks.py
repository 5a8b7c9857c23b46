"""Outputs in blocks: the kernel, and sessions, cards and exports with such outputs."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import twins.blocks
from cli_helpers import POINTSEG
from edgeperc.errors import CardError
from edgeperc.inference.decode import fill_pixels
from edgeperc.inference.session import Session
from edgeperc.types.card import ModelCard, OutputSpec
from edgeperc.zoo import model_path


@pytest.mark.parametrize("block", [(1, 1), (1, 2), (2, 4), (4, 4), (3, 2)])
@pytest.mark.parametrize("size", [(0, 0), (1, 1), (1, 7), (5, 3)])
@pytest.mark.parametrize("n_classes", [1, 4])
def test_pixels_of_blocks_match_the_twin(block: tuple[int, int], size: tuple[int, int], n_classes: int) -> None:
    rows, cols = block
    blocks = np.random.default_rng(1).normal(size=(n_classes * rows * cols, *size)).astype(np.float32)
    blocks.ravel()[::3] = np.nan
    pixels = np.full((n_classes, size[0] * rows, size[1] * cols), 9.0, np.float32)
    fill_pixels(blocks, rows, cols, pixels)
    np.testing.assert_array_equal(pixels, twins.blocks.pixels(blocks, rows, cols))


@pytest.mark.parametrize("name", ["pointseg", "ssadnet"])
def test_a_session_gives_an_image_of_every_class(name: str) -> None:
    session = Session(model_path(f"{name}:fp32"), "cpu", n_threads=1)
    card = session.card
    rows, cols = next(output.block for output in card.outputs if output.kind == "class_logits")
    assert rows * cols > 1
    session.input[:] = np.random.default_rng(2).uniform(-1.0, 1.0, session.input.shape)
    outputs = session.run()
    assert outputs["class_logits"].shape == (len(card.classes), card.view.height, card.view.width)
    assert session.raw["class_logits"].shape == card.output_shape("class_logits")[1:]
    np.testing.assert_array_equal(outputs["class_logits"], twins.blocks.pixels(session.raw["class_logits"], rows, cols))


def test_cards_hold_blocks_and_earlier_ones_have_none() -> None:
    blocked = replace(POINTSEG, outputs=(OutputSpec("logits", "class_logits", block=(3, 4)),))
    assert ModelCard.from_json(blocked.to_json()) == blocked
    height, width, n = blocked.view.height, blocked.view.width, len(blocked.classes)
    assert blocked.output_shape("class_logits") == (1, 12 * n, height // 3, width // 4)
    document = json.loads(POINTSEG.to_json())
    del document["outputs"][0]["block"]
    assert ModelCard.from_json(json.dumps(document)) == POINTSEG
    with pytest.raises(CardError, match="has blocks; only outputs of classes may"):
        OutputSpec("boxes", "box_dense", block=(2, 2))


@pytest.mark.parametrize(
    ("block", "message"),
    [
        ([0, 2], "expected two numbers from 1 to 16"),
        ([1, 17], "expected two numbers from 1 to 16"),
        ([1, 2.0], "expected a whole number"),
        ([2, 1], "expected divisors of the view's"),
        ("12", "expected a list"),
        ([2, 4, 1], "expected"),
        ([2], "expected"),
    ],
)
def test_blocks_that_cannot_be(block: list[Any], message: str) -> None:
    document = json.loads(POINTSEG.to_json())
    document["outputs"][0]["block"] = block
    with pytest.raises(CardError, match=message):
        ModelCard.from_json(json.dumps(document))
