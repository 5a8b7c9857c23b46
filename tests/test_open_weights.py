"""Weights that anyone may use."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cli_helpers import Shell
from edgeperc import Perceiver
from edgeperc.errors import OptionError
from edgeperc.simulation.samples import FIRST_SEED, simulated_scan
from edgeperc.types.card import ModelCard
from edgeperc.types.choices import STATIC
from edgeperc.zoo import DEFAULT, OPEN, resolve
from edgeperc_export.recipe import MODELS, Stage


@pytest.mark.parametrize("name", OPEN)
def test_no_frame_of_kitti_was_trained_on(name: str) -> None:
    for variant in resolve(name):
        training = variant.card.training
        assert training["frames"]
        assert all(frame.startswith("pandaset/") for frame in training["frames"])
        assert "CC BY 4.0" in training["licence"]
        assert "KITTI" not in training["licence"]
    stages: list[Stage] = [MODELS[name]]
    while (before := stages[-1].after) is not None:
        stages.append(MODELS[before])
    assert all(stage.is_open for stage in stages)  # nor the networks that it was started from
    for variant in resolve(name):
        assert len(variant.card.training["started_from"]) == len(stages) - 1


def test_they_see_what_the_default_models_see() -> None:
    """The network of points has the curvature as well, and classes of the surroundings."""
    for name, other in zip(OPEN, DEFAULT, strict=True):
        open_card, card = (resolve(each)[0].card for each in (name, other))
        assert open_card.view == card.view
        is_scene = name == "sceneseg"
        assert open_card.classes == (*card.classes, *(STATIC if is_scene else ()))
        inputs, n = open_card.input, len(card.input.channels)
        assert inputs.channels[n:] == (("curvature",) if is_scene else ())
        assert replace(inputs, channels=inputs.channels[:n], mean=inputs.mean[:n], std=inputs.std[:n]) == card.input


def test_a_perceiver_takes_them() -> None:
    scan = simulated_scan(FIRST_SEED + 3)
    perceive = Perceiver(weights="open", n_threads=1)
    assert [card.name for card in perceive.cards] == [*OPEN]
    perception = perceive(scan.points)
    points = perception.require_points()
    car, building = points.classes.index("car"), points.classes.index("building")
    assert (points.labels[points.in_view & (scan.labels == car)] == car).mean() > 0.5
    assert np.count_nonzero(points.labels == building) > 100
    assert any(box.label == "car" for box in perception.boxes)


def test_weights_and_models_exclude_each_other(tmp_path: Path, shell: Shell) -> None:
    with pytest.raises(OptionError, match="weights is 'open', and models="):
        Perceiver("pointseg", weights="open")
    with pytest.raises(OptionError, match="weights is 'opne' \\(did you mean open"):
        Perceiver(weights="opne")
    (tmp_path / "scan.bin").write_bytes(bytes(16 * 100))
    assert "both name models" in shell.err("run", tmp_path / "scan.bin", "--model", "pointseg", "--weights", "open")


def test_the_program_takes_them(tmp_path: Path, shell: Shell) -> None:
    simulated_scan(FIRST_SEED).points.tofile(tmp_path / "scan.bin")
    said = shell.out("run", tmp_path / "scan.bin", "--weights", "open", "--json", "--threads", "1")
    assert all(ModelCard.read(resolve(name)[0].path).name in said for name in OPEN)
