"""Networks with the height above the ground in their input, and with the front of boxes in their output, end to end."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from numpy.typing import NDArray

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")

import edgeperc.pipeline as pipeline_module
import edgeperc_export.release.quantize as quantize_module
from edgeperc import Perceiver, SensorProfile
from edgeperc.ground.planes import fit_ground
from edgeperc.inference.object_network import BoxesFrom
from edgeperc.inference.projection import make_projector, project
from edgeperc.inference.session import Session
from edgeperc.simulation.samples import simulated_scan
from edgeperc.types.card import ModelCard
from edgeperc.types.mounting import MODEL_MOUNTING
from edgeperc_export.networks import build
from edgeperc_export.recipe import Recipe
from edgeperc_export.release.quantize import Calibration, LabeledSets, quantize
from edgeperc_export.release.to_onnx import export
from edgeperc_export.training.task import task_of

NOISE = np.random.default_rng(0).normal(0.0, 0.1, (2, 40))


@pytest.fixture(scope="module")
def scans() -> list[NDArray[np.float32]]:
    return [simulated_scan(10**9).points]


def untrained(recipe: Recipe, path: Path) -> Path:
    """A checkpoint of random weights, with batch statistics of two random inputs, and a head that finds many boxes."""
    task, network = task_of(recipe), build(recipe).train()
    with torch.no_grad():
        for _ in range(2):
            network(torch.rand(1, len(task.input.channels), task.view.height, task.view.width))
    weights = network.state_dict()
    for name in weights.keys() & {"predict.bias", "detection.predict.bias"}:
        weights[name][0] = 1.0
    for name in weights.keys() & {"predict.weight", "detection.predict.weight"}:
        weights[name][0] *= 50.0  # scores that differ by more than rounding
    notes = {"frames": "{}", "before": "[]", "curve": "[]", "n_simulated": 2, "step": 0}
    torch.save({"averaged": weights, "best": None, "recipe": json.dumps(recipe.__dict__), **notes}, path)
    return path


@pytest.fixture(scope="module")
def exported(
    tmp_path_factory: pytest.TempPathFactory, scans: Sequence[NDArray[np.float32]]
) -> Callable[[Recipe], tuple[Path, ModelCard]]:
    """An untrained network, exported once. That raises if onnxruntime's labels or boxes differ."""

    @functools.cache
    def of(recipe: Recipe) -> tuple[Path, ModelCard]:
        folder = tmp_path_factory.mktemp("exported")
        path = folder / "model.onnx"
        return path, export(untrained(recipe, folder / "checkpoint.pt"), path, scans=scans)

    return of


HEIGHTS = Recipe("pointseg", edge=True, curvature=True, width=0.25)
FRONTS = Recipe("ssadnet", edge=True, front=True)


@pytest.mark.parametrize("recipe", [HEIGHTS, FRONTS], ids=lambda recipe: recipe.network)
def test_from_training_to_the_vehicle(
    exported: Callable[[Recipe], tuple[Path, ModelCard]],
    tmp_path: Path,
    scans: Sequence[NDArray[np.float32]],
    recipe: Recipe,
) -> None:
    (path, card), top = exported(recipe), recipe.network == "ssadnet"
    assert card.parity["n_scans"] == len(scans)
    assert card.input.needs_ground is not top
    assert card.output_shape("box_dense")[1] == (11 if top else 9)

    boxes_from: BoxesFrom = "network" if top else "both"
    perceive = Perceiver(path, provider="cpu", mounting=MODEL_MOUNTING, on_mismatch="ignore", boxes_from=boxes_from)
    with mock.patch.object(pipeline_module, "fit_ground", side_effect=fit_ground) as found:
        answer = perceive(scans[0])
    assert found.call_count == 1  # once for the network's input, the clusters and the agreement
    seen = project(make_projector(card.view, card.input), scans[0])
    np.testing.assert_array_equal(perceive.sessions[0].input, seen.image)
    if top:
        fronts = [box.front for box in answer.boxes if box.front is not None]
        assert len(fronts) == len(answer.boxes) > 10
        assert min(fronts) >= 0.5
    else:
        assert np.ptp(seen.image[5]) > 1.0  # heights, not a constant
        assert all(box.front is None for box in answer.boxes)

    rounded = tmp_path / "int8.onnx"
    with mock.patch.object(quantize_module, "evaluate", return_value=({}, {})):
        quantize(
            path,
            rounded,
            Calibration(scans),
            LabeledSets(n_simulated=1),
            max_noise=9.0,
            race=lambda *_: (10.0 + NOISE[0], 5.0 + NOISE[1]),
        )
    session = Session(rounded, "cpu")
    assert (session.card.input, session.card.outputs) == (card.input, card.outputs)
    assert session.precision == "int8"


def test_interpolated_points_have_heights_too(
    exported: Callable[[Recipe], tuple[Path, ModelCard]], scans: Sequence[NDArray[np.float32]]
) -> None:
    path, _ = exported(HEIGHTS)
    coarse: dict[str, Any] = {"sensor": SensorProfile.uniform("coarse", 32, 2.0, -24.8), "on_mismatch": "ignore"}
    for full_turn in (False, True):
        filled = Perceiver(path, provider="cpu", full_turn=full_turn, **coarse)
        filled(scans[0][::2].copy())
        image = filled.sessions[0].input
        plain = Perceiver(path, provider="cpu", adapt="none", full_turn=full_turn, **coarse)
        plain(scans[0][::2].copy())
        more = (image != 0.0).any(axis=0) & ~(plain.sessions[0].input != 0.0).any(axis=0)
        assert np.count_nonzero(more) > 1000
        std, mean = filled.cards[0].input.std[5], filled.cards[0].input.mean[5]
        heights = image[5][more] * std + mean
        assert -1.0 <= heights.min() < 0.2 < heights.max() <= 5.0
        assert abs(float(np.median(heights))) < 0.5  # most interpolated points are on the ground
