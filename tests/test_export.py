"""Training resumes bit for bit, exports prove themselves, and networks made elsewhere run once they have a card."""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")

from torch import Tensor, nn

from edgeperc import Perceiver
from edgeperc.card import CARD_KEY, InputSpec, ModelCard, OutputSpec, RangeImageGeometry
from edgeperc.datasets import simulated_scan
from edgeperc.errors import CardMismatchError
from edgeperc.sensors import FitnessProfile
from edgeperc.session import Session
from edgeperc_export.augment import LabelledScan
from edgeperc_export.cli import main
from edgeperc_export.dataset import parity_scans, simulate
from edgeperc_export.models_page import models_page
from edgeperc_export.to_onnx import ParityError, export, load, to_graph, verify, write_card
from edgeperc_export.train import Recipe, Samples, build, loss_of, train


@pytest.fixture(scope="module")
def scans() -> list[np.ndarray]:
    return [simulated_scan(10**9 + k).points for k in range(2)]


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("simulated")
    simulate(out, 2)
    return out


def small(network: str, **changes: object) -> Recipe:
    return replace(Recipe(network, steps=4, batch=1, context_width=8), **changes)  # type: ignore[arg-type]


def untrained(network: str, folder: Path, **changes: object) -> Path:
    """A checkpoint of random weights, with batch norms that have seen something."""
    recipe = small(network, **changes)
    net = build(recipe).train()
    with torch.no_grad():
        for _ in range(2):
            channels, height, width = (5, 64, 512) if network == "pointseg" else (3, 400, 200)
            net(torch.rand(1, channels, height, width))
    state = {k: v for k, v in net.state_dict().items()}
    path = folder / f"{network}-{recipe.head}.pt"
    notes = {"frames": "{}", "before": "[]", "curve": "[]", "n_simulated": 2, "step": 0}
    torch.save({"averaged": state, "best": None, "recipe": json.dumps(recipe.__dict__), **notes}, path)
    return path


def weights(path: Path) -> dict[str, Tensor]:
    return torch.load(path, weights_only=True)["averaged"]


@pytest.mark.parametrize(("network", "head"), [("pointseg", "dense"), ("ssadnet", "dense"), ("ssadnet", "slots")])
def test_a_resumed_run_ends_where_an_uninterrupted_one_does(
    tmp_path: Path, simulated: Path, network: str, head: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = small(network, head=head)
    arguments = {"kitti": None, "simulated": simulated, "n_threads": 1, "checkpoint_every": 2}
    whole = train(recipe, tmp_path / "whole", **arguments)

    # Killed after the second step, when its checkpoint lies there.
    import edgeperc_export.train as module

    calls = 0

    def dying(*given: object) -> Tensor:
        nonlocal calls
        calls += 1
        if calls == 3:
            raise KeyboardInterrupt
        return loss_of(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(module, "loss_of", dying)
    with pytest.raises(KeyboardInterrupt):
        train(recipe, tmp_path / "cut", **arguments)
    monkeypatch.undo()
    resumed = train(recipe, tmp_path / "cut", **arguments)
    for name, value in weights(whole).items():
        assert torch.equal(value, weights(resumed)[name]), name
    log = [json.loads(line) for line in (tmp_path / "whole/log.jsonl").read_text().splitlines()]
    assert all(np.isfinite(line["loss"]) for line in log)


def test_another_recipe_does_not_resume(tmp_path: Path, simulated: Path) -> None:
    train(small("pointseg", steps=1), tmp_path, kitti=None, simulated=simulated, n_threads=1)
    with pytest.raises(ValueError, match="of another recipe"):
        train(small("pointseg", steps=2), tmp_path, kitti=None, simulated=simulated, n_threads=1)


def test_training_learns(tmp_path: Path, simulated: Path) -> None:
    recipe = small("pointseg", steps=12, learning_rate=3e-3)
    samples = Samples(recipe, [], [], sorted(simulated.glob("*.npz")))
    inputs, truth = (torch.from_numpy(a) for a in samples.batch(0))
    net = build(recipe)
    optimizer = torch.optim.Adam(net.parameters(), 3e-3)
    losses = []
    for _ in range(8):
        loss = loss_of(recipe, net(inputs), [truth])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.8 * losses[0]


def test_a_step_always_draws_the_same_samples(simulated: Path) -> None:
    samples = Samples(small("ssadnet"), [], [], sorted(simulated.glob("*.npz")))
    for one, other in zip(samples.batch(5), samples.batch(5), strict=True):
        np.testing.assert_array_equal(one, other)
    assert not np.array_equal(samples.batch(5)[0], samples.batch(6)[0])


def test_simulated_scans_resume_too(tmp_path: Path) -> None:
    simulate(tmp_path, 1)
    stamp = (tmp_path / "000000.npz").stat().st_mtime_ns
    simulate(tmp_path, 2)
    assert (tmp_path / "000000.npz").stat().st_mtime_ns == stamp
    assert len(LabelledScan.load(tmp_path / "000001.npz").points) > 50_000


@pytest.mark.parametrize(("network", "head"), [("pointseg", "dense"), ("ssadnet", "dense"), ("ssadnet", "slots")])
def test_an_export_proves_itself(tmp_path: Path, scans: Sequence[np.ndarray], network: str, head: str) -> None:
    checkpoint = untrained(network, tmp_path, head=head)
    path = tmp_path / "model.onnx"
    fitness = FitnessProfile.from_scans(scans)
    card = export(checkpoint, path, scans=scans, fitness=fitness, version="0.0.1")
    assert card.parity["n_scans"] == 2
    assert card.parity["max_deviation"] < 1e-3
    session = Session(path, "cpu")
    assert session.card == card
    assert session.golden_deviation < 1e-3
    blob = path.read_bytes()
    assert str(tmp_path).encode() not in blob
    assert b"site-packages" not in blob
    answer = Perceiver(path, provider="cpu", on_mismatch="ignore")(scans[0])
    assert (answer.points is None) == (network == "ssadnet")
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([checkpoint.name, "model.onnx"])


def test_a_graph_that_disagrees_is_not_written(
    tmp_path: Path, scans: Sequence[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint = untrained("pointseg", tmp_path)
    path = tmp_path / "model.onnx"
    path.write_bytes(b"the model before")
    import edgeperc_export.to_onnx as module

    def wrong(network: nn.Module, card: ModelCard) -> onnx.ModelProto:
        model = to_graph(network, card)
        largest = max(model.graph.initializer, key=lambda t: len(t.raw_data))
        largest.raw_data = (np.frombuffer(largest.raw_data, np.float32) * np.float32(1.5)).tobytes()
        return model

    monkeypatch.setattr(module, "to_graph", wrong)
    with pytest.raises(ParityError, match=r"raw outputs differ by up to \S+ standard deviations"):
        export(checkpoint, path, scans=scans, fitness=None)
    assert path.read_bytes() == b"the model before"
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([checkpoint.name, "model.onnx"])


def test_verify_notices_another_network(tmp_path: Path, scans: Sequence[np.ndarray]) -> None:
    checkpoint = untrained("pointseg", tmp_path)
    export(checkpoint, tmp_path / "model.onnx", scans=scans, fitness=None)
    network = load(checkpoint)[0]
    assert verify(network, tmp_path / "model.onnx", scans)["label_agreement"] > 0.999
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(1.01)
    with pytest.raises(ParityError):
        verify(network, tmp_path / "model.onnx", scans)


class Elsewhere(nn.Module):
    """A range-image network in another's style: two channels, a full turn, probabilities out."""

    def __init__(self) -> None:
        super().__init__()
        self.body = nn.Sequential(nn.Conv2d(2, 8, 3, padding=1), nn.LeakyReLU(), nn.Conv2d(8, 3, 1))

    def forward(self, scan: Tensor) -> Tensor:
        return torch.softmax(self.body(scan), dim=1)


def third_party(tmp_path: Path) -> tuple[Path, ModelCard]:
    torch.manual_seed(0)
    path = tmp_path / "elsewhere.onnx"
    example = (torch.zeros(1, 2, 32, 1024),)
    names = {"input_names": ["scan"], "output_names": ["probabilities"]}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(Elsewhere(), example, path, dynamo=True, external_data=False, verbose=False, **names)
    card = ModelCard(
        name="elsewhere",
        version="2",
        view=RangeImageGeometry(
            tuple(np.linspace(10.0, -30.0, 32)), width=1024, azimuth_left_deg=180.0, azimuth_right_deg=-180.0
        ),
        input=InputSpec("scan", ("range", "remission"), (15.0, 0.3), (10.0, 0.2)),
        outputs=(OutputSpec("probabilities", "class_probabilities"),),
        classes=("nothing", "tree", "car"),
    )
    return path, card


def test_a_network_made_elsewhere_runs_with_a_card(tmp_path: Path, scans: Sequence[np.ndarray]) -> None:
    path, card = third_party(tmp_path)
    (tmp_path / "card.json").write_text(card.to_json())
    out = tmp_path / "carded.onnx"
    assert main(["card", str(path), str(tmp_path / "card.json"), str(out)]) == 0
    answer = Perceiver(out, provider="cpu")(scans[0])
    assert answer.points is not None
    assert answer.points.classes == ("nothing", "tree", "car")
    assert answer.points.in_view.mean() > 0.9  # all around
    assert len(np.unique(answer.points.labels[answer.points.in_view])) > 1


def test_a_card_that_does_not_fit_writes_nothing(tmp_path: Path) -> None:
    path, card = third_party(tmp_path)
    wrong = replace(card, classes=("nothing", "car"))
    with pytest.raises(CardMismatchError, match=r"'probabilities' is tensor\(float\) of shape \(1, 3, 32, 1024\)"):
        write_card(onnx.load(path), wrong, tmp_path / "out.onnx")
    assert not (tmp_path / "out.onnx").exists()
    (tmp_path / "card.json").write_text(wrong.to_json())
    assert main(["card", str(path), str(tmp_path / "card.json"), str(tmp_path / "out.onnx")]) == 2


def test_a_card_replaces_the_one_there(tmp_path: Path) -> None:
    path, card = third_party(tmp_path)
    write_card(onnx.load(path), card, tmp_path / "one.onnx")
    write_card(onnx.load(tmp_path / "one.onnx"), replace(card, version="3"), tmp_path / "two.onnx")
    assert [p.key for p in onnx.load(tmp_path / "two.onnx").metadata_props].count(CARD_KEY) == 1
    assert Session(tmp_path / "two.onnx", "cpu").card.version == "3"


def test_the_command_line_from_scans_to_a_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, run, model = tmp_path / "data", tmp_path / "run", tmp_path / "pointseg.onnx"
    assert main(["simulate", str(data), "-n", "2"]) == 0
    arguments = ["--steps", "1", "--batch", "1", "--threads", "1"]
    assert main(["train", "pointseg", str(run), "--simulated", str(data), *arguments]) == 0
    assert main(["export", str(run / "checkpoint.pt"), str(model)]) == 0
    assert main(["verify", str(run / "checkpoint.pt"), str(model)]) == 0
    shown = capsys.readouterr().out
    assert "parity" in shown
    assert '"n_scans": 4' in shown
    assert Session(model, "cpu").card.fitness is not None


def test_wrong_usage_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "pointseg", str(tmp_path)]) == 2
    assert "no scans to train on" in capsys.readouterr().err
    assert main(["verify", str(tmp_path / "no.pt"), str(tmp_path / "no.onnx")]) == 2
    assert "no.pt" in capsys.readouterr().err


def test_the_models_page_is_what_the_cards_say() -> None:
    folder = Path(__file__).resolve().parent.parent / "models"
    assert (folder / "MODELS.md").read_text() == models_page(folder), "run: edgeperc-export models models"


def test_parity_scans_are_no_training_scans() -> None:
    assert len(parity_scans([])) == 4
