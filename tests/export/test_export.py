"""Training resumes bit for bit, exports are verified, and third-party networks run with a card."""

from __future__ import annotations

import functools
import itertools
import json
import re
import shutil
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")

import pillar_networks as pillars
import tiny_model
from database_helpers import simulated_kitti
from filelock import FileLock
from tiny_model import tiny_card
from torch import Tensor, nn
from training_helpers import ablate, interrupted_in_step, losses_of_steps, make, train

from checkout import REPOSITORY
from cli_helpers import Shell
from edgeperc import Perceiver
from edgeperc.datasets.kitti import KittiObjects, scan_hash
from edgeperc.datasets.splits import fold_of
from edgeperc.errors import CardMismatchError, ModelError, ModelFileError
from edgeperc.evaluation.evaluate import evaluate
from edgeperc.ground.planes import find_ground
from edgeperc.inference.projection import make_projector, project
from edgeperc.inference.session import Session
from edgeperc.preprocess.fitness import FitnessProfile
from edgeperc.simulation.samples import FIRST_SEED, IGNORE, simulated_scan
from edgeperc.simulation.scene import SimulatedScan
from edgeperc.types.card import CARD_KEY, InputSpec, ModelCard, OutputSpec
from edgeperc.types.frame import ModelFrame
from edgeperc.types.mounting import Mounting
from edgeperc.types.perception import Box
from edgeperc.types.sensor import get_sensor
from edgeperc.types.views import RangeImageGeometry, TopViewGeometry
from edgeperc_export import cards
from edgeperc_export import make as make_module
from edgeperc_export.cards import RANGE_IMAGE, RANGE_IMAGE_INPUT, TOP_VIEW, TOP_VIEW_INPUT
from edgeperc_export.data.augment import ObjectBank
from edgeperc_export.data.processes import mapped
from edgeperc_export.data.roads import DRAWN, drawn_roads
from edgeperc_export.data.scan_sets import Labeled, seen_by_network
from edgeperc_export.data.scans import LabeledScan, mirrored
from edgeperc_export.data.simulate import parity_samples, simulate
from edgeperc_export.networks import build
from edgeperc_export.recipe import MODELS, PAPER, SCAN_NETWORKS, TASKS, Recipe, Stage
from edgeperc_export.release import to_onnx
from edgeperc_export.release.models_page import models_page, sums_of
from edgeperc_export.release.to_onnx import (
    ParityError,
    export,
    halve,
    load,
    sets_of,
    terms_of,
    to_graph,
    verify,
    with_golden,
    write_card,
)
from edgeperc_export.training import ablation
from edgeperc_export.training.ablation import PAPERS, SHIPPED, VARIANTS, plot
from edgeperc_export.training.checkpoint import CheckpointError, frames_of, read_checkpoint, write_checkpoint
from edgeperc_export.training.samples import Recent, Samples, Watch, loaded, real_scans
from edgeperc_export.training.start import start
from edgeperc_export.training.task import Points, task_of
from edgeperc_export.training.teacher import OnnxTeacher, pseudo_labeled, teach, unlabeled_scans
from edgeperc_export.training.train import make_optimizer, make_schedule
from scenes import urban

Exported = Callable[[str, str], tuple[Path, Path, ModelCard]]


@pytest.fixture(scope="module")
def scans() -> list[np.ndarray]:
    return [simulated_scan(10**9 + k).points for k in range(2)]


@pytest.fixture(autouse=True, scope="module")
def _scans_are_simulated_once() -> Iterator[None]:
    """Verification and profiles need many simulated scans. Here they get four, which are simulated once."""
    once = functools.cache(simulated_scan)

    def cached(seed: int, sensor: str = "hdl-64e", boxes: Sequence[Box] | None = None, **options: Any) -> SimulatedScan:
        seed = seed if seed < 10**9 else 10**9 + seed % 4
        is_plain = boxes is None and options.get("where", "street") == "street"
        return once(seed, sensor) if is_plain else simulated_scan(seed, sensor, boxes, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("edgeperc_export.data.simulate.simulated_scan", cached)
        yield


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("simulated")
    simulate(out, 2)
    return out


def samples_of(recipe: Recipe, simulated: Path, teacher: OnnxTeacher | None = None) -> Samples:
    return Samples(recipe, [], [], sorted(simulated.glob("*.npz")), teacher)


def alone(scan: LabeledScan, hashes: dict[str, str]) -> Any:
    """A scan to train on, and none to watch."""
    return Labeled([scan], [1.0], hashes), []


def logged(run: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]


@pytest.fixture
def small_views(monkeypatch: pytest.MonkeyPatch) -> None:
    make_views_small(monkeypatch)


def make_views_small(patch: pytest.MonkeyPatch) -> None:
    """Views with a quarter of the beams and columns, or with the 16 x 8 m ahead: a sixteenth of the arithmetic. A run
    that starts from a model takes the statistics of one batch.
    """
    beams = RANGE_IMAGE.row_elevations_deg[::4]
    patch.setattr(cards, "RANGE_IMAGE", replace(RANGE_IMAGE, row_elevations_deg=beams, width=128))
    patch.setattr(cards, "TOP_VIEW", TopViewGeometry((6.0, 22.0), (-4.0, 4.0)))
    patch.setattr("edgeperc_export.training.train.STATISTICS_BATCHES", 1)


def small(network: str, **changes: object) -> Recipe:
    return replace(Recipe(network, steps=4, batch=1, context_width=8), **changes)  # type: ignore[arg-type]


def untrained(network: str, folder: Path, **changes: object) -> Path:
    """A checkpoint of random weights, with batch statistics of two random inputs."""
    recipe = small(network, **changes)
    task, net = task_of(recipe), build(recipe).train()
    with torch.no_grad():
        for _ in range(2):
            net(torch.rand(1, len(task.input.channels), task.view.height, task.view.width))
    path = folder / f"{network}-{recipe.head}.pt"
    notes = {"frames": "{}", "before": "[]", "curve": "[]", "n_simulated": 2, "step": 0}
    torch.save({"averaged": net.state_dict(), "best": None, "recipe": json.dumps(recipe.__dict__), **notes}, path)
    return path


def weights(path: Path) -> dict[str, Tensor]:
    return read_checkpoint(path)["averaged"]


def assert_equal(one: dict[str, Tensor], other: dict[str, Tensor]) -> None:
    for name, value in one.items():
        assert torch.equal(value, other[name]), name


def test_a_network_of_half_precision_is_told_how_to_take_scans(tmp_path: Path) -> None:
    """As onnxruntime would say it when it runs, nobody knew what to do."""
    card = replace(tiny_card(), input=replace(tiny_card().input, name="half"), golden=None)
    path = tmp_path / "half.onnx"
    path.write_bytes(
        tiny_model.model(tiny_model.graph(tiny_model.HALF, tiny_model.CONVOLUTION, tiny_model.INITIALIZER), card=card)
    )
    for opened in (lambda: with_golden(onnx.load(path), card), lambda: Session(path, "cpu")):
        with pytest.raises(CardMismatchError, match=r"'half' is tensor\(float16\).*inputs and outputs in float32"):
            opened()


@pytest.mark.parametrize("of_sensor", [None, "vlp-16"])
def test_samples_are_seen_from_the_height_of_the_training_sensor(of_sensor: str | None) -> None:
    """As `Perceiver` shows them: calibrated from another height, int8 rounds values that never come."""
    view, spec = RANGE_IMAGE, InputSpec("x", ("range", "z"), (0.0, 0.0), (10.0, 1.0))
    card = replace(tiny_card(), view=view, input=spec, mount_height_m=2.6)
    seen, frame = urban(3).points, ModelFrame.of_training(2.6)  # by a sensor at that height
    sample = LabeledScan(frame.move(seen), np.zeros(len(seen), np.uint8), (), (), np.zeros((500, 500), np.uint8))
    sample = replace(sample, sensor=None if of_sensor is None else get_sensor(of_sensor))
    expected = seen_by_network(make_projector(view, spec), replace(sample, points=seen))[1].image
    ((image, _),) = to_onnx.views(card, [sample])
    np.testing.assert_allclose(image, expected, atol=1e-5)
    if of_sensor is None:
        ((image, _),) = to_onnx.views(card, [frame.move(seen)])
        np.testing.assert_allclose(image, expected, atol=1e-5)


@pytest.mark.usefixtures("small_views")
@pytest.mark.parametrize(
    ("network", "changes", "n_workers"),
    [("lodnn", {}, 0), ("pointseg", {"edge": True}, 0), ("ssadnet", {"head": "slots"}, 2)],
)
def test_a_resumed_run_equals_an_uninterrupted_one(
    tmp_path: Path, simulated: Path, network: str, changes: dict[str, object], n_workers: int
) -> None:
    recipe = small(network, steps=3, redraw_every=1, **changes)
    arguments = {"simulated": simulated, "checkpoint_every": 2}
    whole = train(recipe, tmp_path / "whole", **arguments)  # without workers: they change nothing
    with interrupted_in_step(3, type(task_of(recipe))):  # when there is a checkpoint of the second
        train(recipe, tmp_path / "cut", n_workers=n_workers, **arguments)
    assert_equal(weights(whole), weights(train(recipe, tmp_path / "cut", n_workers=n_workers, **arguments)))
    assert all(np.isfinite(line["loss"]) for line in logged(tmp_path / "whole"))


@pytest.mark.usefixtures("small_views")
def test_a_run_may_keep_a_share_of_the_weights_that_it_starts_from(tmp_path: Path, simulated: Path) -> None:
    begun = untrained("pointseg", tmp_path, edge=True)
    start = {"simulated": simulated, "start_from": begun}
    recipes = [small("pointseg", edge=True, kept=kept, steps=2, n_pasted=0.0) for kept in (0.0, 0.25)]
    own, mixed = (weights(train(recipe, tmp_path / f"{recipe.kept}", **start)) for recipe in recipes)
    for name, before in weights(begun).items():
        if before.dtype.is_floating_point:
            assert torch.allclose(mixed[name], 0.75 * own[name] + 0.25 * before, atol=1e-5), name
    with pytest.raises(ValueError, match="give --start-from"):
        train(replace(recipes[0], kept=0.5), tmp_path / "none", simulated=simulated)
    with pytest.raises(ValueError, match="of a run with another --start-from; give the same or"):
        train(recipes[1], tmp_path / "0.25", simulated=simulated, start_from=tmp_path / "0.0/checkpoint.pt")
    with pytest.raises(OSError, match="No space left"):
        write_checkpoint(weights(begun), Path("/dev/full"))


@pytest.mark.usefixtures("small_views")
def test_reused_samples_are_drawn_from_the_newest(tmp_path: Path, simulated: Path) -> None:
    recipe = small("pointseg", edge=True, steps=7, batch=2, reuse=3, redraw_every=0)
    samples = samples_of(recipe, simulated)
    batches = [[part.clone() for part in batch] for batch in loaded(samples, 0, recipe.steps, 0)]
    assert len(batches) == recipe.steps
    seen: list[Tensor] = []
    for step, (image, *_) in enumerate(batches):
        if step % recipe.reuse == 0:
            np.testing.assert_array_equal(image, samples.batch(step)[0])
            seen += list(image)
        else:
            numbers = [next(k for k, other in enumerate(seen) if torch.equal(one, other)) for one in image]
            assert len(set(numbers)) == 2
    assert train(recipe, tmp_path, simulated=simulated).exists()


def test_recent_samples_replace_the_oldest() -> None:
    recent = Recent(4)
    for number in range(5):
        recent.add([torch.full((2, 1), float(number)), torch.full((2,), number)])
        found, labels = recent.draw(4, torch.Generator().manual_seed(number))
        expected = sorted([number, number, *([number - 1] * 2 if number else [])])
        assert sorted(labels.tolist()) == expected
        assert found[:, 0].tolist() == labels.tolist()


def _touched(path: Path) -> None:
    path.touch()
    time.sleep(0.02)


def test_workers_leave_what_they_have_not_begun_at_an_error(tmp_path: Path) -> None:
    """A thousand scans were simulated to their end after a signal."""

    def interrupted() -> None:
        with mapped(_touched, [tmp_path / str(k) for k in range(100)], 2) as done:
            next(done)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert 1 <= len([*tmp_path.iterdir()]) < 50


def test_workers_simulate_the_same_scans_and_cut_out_the_same_objects(tmp_path: Path) -> None:
    """Also after a simulation that was stopped, whose scans are kept."""
    simulate(tmp_path / "0", 1)
    stamp = (tmp_path / "0/000000.npz").stat().st_mtime_ns
    for n_workers in (0, 2):
        simulate(tmp_path / str(n_workers), 3, n_workers=n_workers)
    assert (tmp_path / "0/000000.npz").stat().st_mtime_ns == stamp
    ours, theirs = (sorted((tmp_path / folder).glob("*.npz")) for folder in ("0", "2"))
    assert [path.name for path in ours] == [path.name for path in theirs]
    assert all(one.read_bytes() == other.read_bytes() for one, other in zip(ours, theirs, strict=True))
    scans = [LabeledScan.load(path) for path in ours]
    assert len(scans[1].points) > 50_000
    bank, other_bank = (ObjectBank.of(scans, n_workers=n_workers) for n_workers in (0, 2))
    assert list(bank.objects) == list(other_bank.objects)
    for name, objects in bank.objects.items():
        for (box, points), (other_box, other_points) in zip(objects, other_bank.objects[name], strict=True):
            assert box == other_box
            np.testing.assert_array_equal(points, other_points)


@pytest.mark.usefixtures("small_views")
def test_another_recipe_and_other_data_do_not_resume(tmp_path: Path, simulated: Path) -> None:
    """The card would not know the scans of the second run, and the fold was trained on."""
    recipe = small("pointseg", edge=True, steps=1, n_pasted=0.0)
    scan = LabeledScan.load(sorted(simulated.glob("*.npz"))[0])
    scan = replace(scan, labels=np.zeros_like(scan.labels))
    given = alone(scan, {"a": "1"})

    def run(folder: str, recipe: Recipe = recipe, **changes: Any) -> Path:
        return train(recipe, tmp_path / folder, **{"simulated": simulated, "given": given, **changes})

    def refused(message: str, folder: str = "own", **changes: Any) -> None:
        with pytest.raises(ValueError, match=message):
            run(folder, **changes)

    first = run("own")
    assert run("own") == first
    with FileLock(tmp_path / "own/.lock"):
        refused("another training runs in")
    refused("of another recipe: steps 1, now 2; give the same options", recipe=replace(recipe, steps=2))
    refused("of a run with no --start-from; give the same or an empty", start_from=first)
    fewer = tmp_path / "fewer"
    fewer.mkdir()
    shutil.copy(sorted(simulated.glob("*.npz"))[0], fewer)
    for changes in ({"given": alone(scan, {"b": "2"})}, {"fold": 0}, {"simulated": fewer}):
        refused("of a run on other data", **changes)
    corrected = replace(scan, labels=np.ones_like(scan.labels))
    refused("of a run with another truth of its scans", given=alone(corrected, {"a": "1"}))
    aside = replace(scan, azimuths=(-1.0, 1.0))
    refused("of a run with another sensor or labeled sector", given=alone(aside, {"a": "1"}))
    # Another scan of the same name: the card knows both. So it does those of a teacher, whose terms are the student's.
    run("after", start_from=first, given=alone(scan, {"a": "2"}))
    frames = load(tmp_path / "after/checkpoint.pt")[2]["frames"]
    assert sorted(frames.values()) == ["1", "2"]
    refused("of a run on other data", "after", start_from=first, given=alone(scan, {"a": "3"}))
    assert load(run("taught", recipe=replace(recipe, distil=1.0), teacher=first, given=None))[2]["frames"] == {"a": "1"}
    torch.save({name: of for name, of in torch.load(first, weights_only=True).items() if name != "optimizer"}, first)
    with pytest.raises(CheckpointError, match=r"checkpoint\.pt is damaged .'optimizer'.; train again"):
        run("own")


@pytest.mark.usefixtures("small_views")
def test_a_longer_run_starts_like_a_shorter_one(tmp_path: Path, simulated: Path) -> None:
    for run, steps in (("short", 4), ("long", 6)):
        recipe = small("pointseg", edge=True, steps=steps, cooldown=0.5, n_pasted=0.0)
        train(recipe, tmp_path / run, simulated=simulated, checkpoint_every=2)
    one, other = logged(tmp_path / "short"), logged(tmp_path / "long")
    assert one[0]["loss"] == other[0]["loss"]  # of steps 1 and 2, before either cools down
    assert len(other) == 3


def test_the_learning_rate_rises_stays_and_falls() -> None:
    recipe = Recipe("pointseg", steps=1000, cooldown=0.4)
    rates = [make_schedule(recipe, step) for step in range(1000)]
    assert rates[0] == 0.01
    assert set(rates[99:600]) == {1.0}
    assert all(a > b for a, b in itertools.pairwise(rates[600:]))
    assert rates[-1] < 1e-4
    assert {make_schedule(PAPER["ssadnet"], step) for step in (0, 30_000, 64_999)} == {1.0}


@pytest.mark.usefixtures("small_views")
def test_a_run_starts_from_the_weights_it_shares_with_a_checkpoint(tmp_path: Path) -> None:
    dense = untrained("ssadnet", tmp_path)
    slots = build(small("ssadnet", head="slots", seed=5))
    before = {name: value.clone() for name, value in slots.state_dict().items()}
    assert start(slots, small("ssadnet", head="slots", seed=5), dense, [])[-1]["head"] == "dense"
    assert frames_of(dense) == {}
    given = weights(dense)
    for name, value in slots.state_dict().items():
        origin = given.get(name) if name.startswith("segmentation") else before[name]
        assert torch.equal(value, origin), name
    recipe = small("pointseg", edge=True)
    for network, changes in (("ssadnet", {"edge": True}), ("pointseg", {}), ("pointseg", {"edge": True, "width": 0.5})):
        with pytest.raises(ValueError, match=r"is of another network, .* as --edge"):
            start(build(recipe), recipe, untrained(network, tmp_path, **changes), [])
    with pytest.warns(UserWarning, match="sees height_above_ground too"):
        start(build(recipe), recipe, untrained("pointseg", tmp_path, edge=True, height_above_ground=True), [])


SHIPPED_MODELS = REPOSITORY / "models"


@pytest.mark.parametrize(
    ("model", "recipe"),
    [
        ("pointseg", Recipe("pointseg", edge=True, height_above_ground=True, batch=1)),
        ("ssadnet", Recipe("ssadnet", edge=True, front=True, width=0.75, batch=1)),
        ("lodnn", Recipe("lodnn", edge=True, batch=1)),
        ("research/kulseg", Recipe("kulseg", height_above_ground=True, batch=1)),
    ],
)
def test_a_run_that_starts_from_a_model_starts_with_its_outputs(
    simulated: Path, scans: Sequence[np.ndarray], model: str, recipe: Recipe
) -> None:
    path, network = SHIPPED_MODELS / f"{model}.onnx", build(recipe)
    task = task_of(recipe)
    samples = samples_of(recipe, simulated)
    image = torch.from_numpy(samples.batch(0)[0])
    session = Session(path, "cpu", n_threads=1)
    assert frames_of(path) == session.card.training["frames"]
    assert start(network, recipe, path, [image])[-1] == session.card.training["recipe"]
    theirs, ours = (make_projector(card.view, card.input) for card in (session.card, task.card))
    points = np.ascontiguousarray(scans[0])
    session.input[:] = project(theirs, points).image
    with torch.no_grad():
        outputs = network.eval()(torch.from_numpy(project(ours, points).image[None]))
    for output, expected in zip(as_tuple(outputs), session.run().values(), strict=True):
        value = output[0].numpy()
        assert np.abs(value[: len(expected)] - expected).max() < 1e-4 * expected.std()
        assert not value[len(expected) :].any()  # the vector to the front
    # In training, batch norm uses the statistics of the batch, here those of the one that it started with.
    for module in network.train().modules():
        if isinstance(module, nn.Dropout2d):
            module.eval()
    with torch.no_grad():
        trained = as_tuple(network(image))[0]
        expected = as_tuple(network.eval()(image))[0]
    assert (trained - expected).abs().max() < 1e-2 * expected.std()


def as_tuple(outputs: Tensor | tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    return outputs if isinstance(outputs, tuple) else (outputs,)


@pytest.mark.parametrize(
    "classes", [("background", "cone", "pedestrian"), ("background", "cone", "pedestrian", "cyclist")]
)
def test_classes_of_a_start_keep_their_weights(simulated: Path, classes: tuple[str, ...]) -> None:
    """As many classes, or in another order, as well: they took the weights in the place of theirs."""
    recipe = Recipe("pointseg", edge=True, height_above_ground=True, batch=1, classes=classes)
    image, labels = samples_of(recipe, simulated).batch(0)
    assert set(np.unique(labels)) <= {0, 2, len(classes) - 1, IGNORE}  # cars are of no class of this one

    def logits(recipe: Recipe) -> Tensor:
        network, images = build(recipe), [torch.from_numpy(image)]
        start(network, recipe, SHIPPED_MODELS / "pointseg.onnx", images)
        with torch.no_grad():
            found: Tensor = network.eval()(*images)
        return found

    ours, theirs = logits(recipe), logits(replace(recipe, classes=()))
    assert torch.equal(ours[:, [0, 2]], theirs[:, [0, 2]])
    assert not ours[:, 1].any()
    moved = logits(replace(recipe, classes=("background", "pedestrian", "car", "cyclist")))
    assert torch.equal(moved, theirs[:, [0, 2, 1, 3]])


@pytest.mark.usefixtures("small_views")
def test_a_start_shares_whole_layers_or_none(tmp_path: Path) -> None:
    """Of a narrower network, batch norm got zeros for the channels that it lacks, which then stayed zero."""
    network, recipe = build(small("ssadnet", context_width=16)), small("ssadnet", context_width=16)
    start(network, recipe, untrained("ssadnet", tmp_path, context_width=8), [])
    assert all(module.running_var.all() for module in network.modules() if isinstance(module, nn.BatchNorm2d))
    with pytest.raises(ModelError, match="is in int8, without most weights in fp32; give the model in fp32"):
        start(network, recipe, SHIPPED_MODELS / "pointseg-int8.onnx", [])


@pytest.mark.usefixtures("small_views")
def test_head_only_trains_only_the_head(tmp_path: Path, simulated: Path) -> None:
    start = untrained("ssadnet", tmp_path)
    recipe = small("ssadnet", head="slots", head_only=True, steps=2, ema=0.0, n_pasted=0.0)
    state = read_checkpoint(train(recipe, tmp_path / "run", simulated=simulated, start_from=start))["network"]
    drawn, given = build(recipe).state_dict(), weights(start)
    assert_equal({name: value for name, value in state.items() if name.startswith("segmentation")}, given)
    assert any(not torch.equal(value, drawn[name]) for name, value in state.items() if name.startswith("detection"))


def test_the_papers_recipes_match_the_papers() -> None:
    """SSADNet 3.2, PointSeg 5 and LoDNN-I 3.3 to 3.6, without settings that they do not mention."""
    expected = {
        "ssadnet": {"head": "slots-paper", "optimizer": "adam", "learning_rate": 1e-5, "batch": 8, "halve_after": 100},
        "pointseg": {"optimizer": "adagrad", "learning_rate": 1e-3, "batch": 32, "steps": 50_000},
        "lodnn": {"optimizer": "adam", "learning_rate": 1e-3, "batch": 16, "context_width": 128, "drawn_roads": True}
        | {"steps": 22 * 300 * 8 // 16},  # epochs, scenes, variations
    }
    unmentioned = ("n_pasted", "swap", "ema", "lovasz_weight", "simulated_share", "distil")
    for name, settings in expected.items():
        settings |= {"augment": name == "lodnn", **dict.fromkeys(unmentioned, 0.0)}
        assert {setting: getattr(PAPER[name], setting) for setting in settings} == settings
    for network in (build(PAPER["lodnn"]), build(PAPER["ssadnet"]).segmentation):
        assert not any(isinstance(m, nn.BatchNorm2d) for m in network.modules())
    assert type(make_optimizer(PAPER["pointseg"], build(PAPER["pointseg"]))) is torch.optim.Adagrad


@pytest.fixture(scope="module")
def kitti(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated KITTI object set: labeled frames of fold 0, of fold 1 and of a test drive, and an unlabeled frame."""
    drives = ("0005", "0048", "0048", "0011")
    root = simulated_kitti(tmp_path_factory.mktemp("kitti"), drives, seeds=(0, 1, 0, 3))
    for part in ("label_2", "calib"):
        (root / "training" / part / "000002.txt").unlink()
    return root


@pytest.mark.usefixtures("small_views")
@pytest.mark.parametrize("network", ["lodnn", "pointseg", "ssadnet"])
def test_a_fold_is_for_validation_and_not_for_training(
    tmp_path: Path, kitti: Path, simulated: Path, network: str
) -> None:
    recipe = small(network, edge=True, steps=2, n_pasted=0.0)
    root = shutil.copytree(kitti, tmp_path / "kitti")
    rows = (root / "frames.csv").read_text().splitlines()
    (root / "frames.csv").write_text("\n".join(row for row in rows if "000003" not in row))  # of the test drive
    with pytest.warns(UserWarning, match="1 labeled scans without a row in frames"):
        checkpoint = train(recipe, tmp_path / "out", kitti=root, simulated=simulated, fold=1, checkpoint_every=1)
    state = read_checkpoint(checkpoint)
    assert state["frames"].keys() == {"000000"}  # of fold 0
    assert [line["step"] for line in state["curve"]] == [1, 2]
    assert all(0.0 <= line["validation"]["background"] <= 1.0 for line in state["curve"])
    assert all(np.isfinite(line["validation_loss"]) for line in state["curve"])
    assert state["best"].keys() == state["averaged"].keys()
    network_, _, notes = load(checkpoint)
    assert notes["curve"] == state["curve"]
    assert_equal(network_.state_dict(), state["best"])


def test_drawn_roads_are_of_training_drives() -> None:
    pytest.importorskip("faster_coco_eval")
    images = json.loads(DRAWN.read_text())["images"]
    assert len(images) == len({image["scan"] for image in images}) >= 8
    assert all(fold_of(image["drive"]) is not None for image in images)
    masks = drawn_roads()
    assert masks.keys() == {image["scan"] for image in images}
    for mask in masks.values():
        assert 0.1 < mask.mean() < 0.8
        assert mask[390:, 95:105].all()  # the vehicle stands on it


def test_a_drawn_road_is_the_ground_truth_of_its_scan(kitti: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    objects, road = KittiObjects(kitti), np.zeros((400, 200), np.uint8)
    road[100:, 60:150] = 1
    digest = scan_hash(objects.frame("000000").points)
    monkeypatch.setattr("edgeperc_export.training.samples.drawn_roads", lambda: {digest: road})
    (scan, other), weights, hashes = real_scans(objects, ["000000", "000001"], drawn=True)
    assert weights == [1.0, 1.0]
    assert hashes["000000"] == digest
    ((plain, _), _, _) = real_scans(objects, ["000000", "000001"])
    truth, without = scan.top_view_truth(TOP_VIEW), plain.top_view_truth(TOP_VIEW)
    known = np.isin(truth, (0, 1)) & (without < 2)
    assert (truth[known] == road[known]).mean() > 0.99  # cells of 0.2 m, half a cell aside
    assert np.isin(truth, (0, 1, IGNORE)).mean() > 0.9
    assert (without == IGNORE).mean() > (truth == IGNORE).mean() + 0.1
    np.testing.assert_array_equal(other.surface, real_scans(objects, ["000001"])[0][0].surface)
    assert 0 in scan.labels
    assert 0 not in real_scans(objects, ["000000"], classes=("background", "car", "road"))[0][0].labels  # perhaps road
    # Outside the drawing, the certain cells of the scan remain.
    np.testing.assert_array_equal(scan.surface[:20], plain.surface[:20])


def test_lodnn_learns_only_road(simulated: Path) -> None:
    samples = samples_of(small("lodnn", edge=True), simulated)
    scan = LabeledScan.load(samples.simulated[0])
    image, truth = samples.sample(scan)
    assert image.shape == (3, 400, 200)
    whole = scan.top_view_truth(TOP_VIEW)
    np.testing.assert_array_equal(truth == 1, whole == 1)
    np.testing.assert_array_equal(truth == IGNORE, whole == IGNORE)
    assert (truth[(whole > 1) & (whole != IGNORE)] == 0).all()


@pytest.mark.usefixtures("small_views")
def test_a_simulated_share_of_1_uses_no_real_frame(tmp_path: Path, kitti: Path, simulated: Path) -> None:
    recipe = small("pointseg", edge=True, steps=1, simulated_share=1.0, n_pasted=0.0)
    state = read_checkpoint(train(recipe, tmp_path, kitti=kitti, simulated=simulated))
    assert state["frames"] == {}
    assert state["curve"][0]["validation"].keys() >= {"car"}


@pytest.mark.usefixtures("small_views")
def test_the_learning_rate_is_halved_after_epochs_without_improvement(
    tmp_path: Path, kitti: Path, simulated: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Watch, "validate", lambda self, network: (0.5, 1.0, {"car": 0.5}))
    recipe = small("pointseg", edge=True, steps=4, halve_after=2, n_pasted=0.0)
    data = {"kitti": kitti, "simulated": simulated, "fold": 1, "teacher": untrained("pointseg", tmp_path, edge=True)}
    state = read_checkpoint(train(recipe, tmp_path, **data, checkpoint_every=1))  # no scan is unlabeled
    assert state["watched"][-1] == 1  # at step 3, two epochs of one step after the first and best
    assert state["optimizer"]["param_groups"][0]["lr"] < 0.6 * recipe.learning_rate


class AlwaysCar(nn.Module):
    """Labels everything as car."""

    def forward(self, x: Tensor) -> Tensor:
        out = torch.zeros(x.shape[0], 4, *x.shape[2:])
        out[:, 1] = 9.0
        return out


def test_a_teacher_labels_unlabeled_points(kitti: Path) -> None:
    objects = KittiObjects(kitti)
    (unlabeled,) = unlabeled_scans(objects, fold=0)
    assert not unlabeled_scans(objects, fold=1)  # its drive is in the excluded fold
    frame = LabeledScan.from_frame(objects.frame("000000"))
    task = task_of(Recipe("pointseg"))
    ahead, all_around = pseudo_labeled(AlwaysCar(), task, [frame, unlabeled])
    own = frame.labels != IGNORE
    np.testing.assert_array_equal(ahead.labels[own], frame.labels[own])
    assert (ahead.labels[~own] == 1).mean() > 0.5
    azimuth = np.degrees(np.arctan2(all_around.points[:, 1], all_around.points[:, 0]))
    for left in range(-180, 180, 15):
        sector = all_around.labels[(azimuth >= left) & (azimuth < left + 15)]
        assert (sector == 1).mean() > 0.5 if len(sector) > 50 else True
    unsure = pseudo_labeled(AlwaysCar(), task, [unlabeled], sure=1.1)[0]
    assert (unsure.labels == IGNORE).all()


@pytest.mark.usefixtures("small_views")
def test_deep_supervision_is_only_for_training(simulated: Path) -> None:
    recipe = small("pointseg", deep_supervision=0.4)
    network = build(recipe)
    inputs, truth = (torch.from_numpy(a) for a in samples_of(recipe, simulated).batch(0))
    logits, early = network.train()(inputs)
    assert early.shape == (1, 4, 16, 32)
    plain = task_of(replace(recipe, deep_supervision=0.0)).loss(logits, [truth])
    assert task_of(recipe).loss((logits, early), [truth]) > plain
    assert isinstance(network.eval()(inputs), Tensor)


def test_a_teacher_averages_a_scene_and_its_mirror_image() -> None:
    class Outward(nn.Module):
        """Predicts class 1 where y points away from the middle column; it tells left from right by the column index."""

        def forward(self, image: Tensor) -> Tensor:
            side = torch.tensor([1.0] * 4 + [-1.0] * 4)
            away = 10.0 * (image[:, 1:2] * side).sign()
            return torch.cat([-away, away], dim=1)

    image = torch.randn(2, 5, 3, 8)
    p, boxes = teach(Outward(), image, RANGE_IMAGE_INPUT, mirror=True)
    assert boxes is None
    assert torch.equal(p.argmax(1), Outward()(image).argmax(1))
    assert p.max(1).values.min() > 0.99
    # A top view has no channel y to negate, so the two predictions contradict each other here.
    p, _ = teach(Outward(), image, TOP_VIEW_INPUT, mirror=True)
    assert torch.allclose(p, torch.full((2, 2, 3, 8), 0.5))
    p, _ = teach(Outward(), image, TOP_VIEW_INPUT, mirror=False)
    assert torch.equal(p.argmax(1), Outward()(image).argmax(1))


@pytest.mark.usefixtures("small_views")
@pytest.mark.parametrize(
    ("network", "edge", "teacher_network"),
    [("pointseg", True, "pointseg"), ("ssadnet", True, "ssadnet"), ("lodnn", False, "ssadnet")],
)
def test_a_network_is_distilled_from_a_teacher(
    tmp_path: Path, simulated: Path, network: str, edge: bool, teacher_network: str
) -> None:
    recipe, teacher = small(network, steps=1, edge=edge, n_pasted=0.0), untrained(teacher_network, tmp_path, seed=9)
    train(recipe, tmp_path / "alone", simulated=simulated)
    train(replace(recipe, distil=1.0), tmp_path / "taught", simulated=simulated, teacher=teacher)
    assert logged(tmp_path / "taught")[0]["loss"] > logged(tmp_path / "alone")[0]["loss"] + 0.1


@pytest.mark.usefixtures("small_views")
def test_an_unused_or_unsuitable_teacher_is_refused(tmp_path: Path, simulated: Path) -> None:
    points, slots = untrained("pointseg", tmp_path, edge=True), untrained("ssadnet", tmp_path, head="slots")
    for recipe, teacher, message in (
        (small("pointseg", distil=1.0), None, r"distils \(1\) but there is no teacher; give --teacher"),
        (small("pointseg", n_pasted=0.0), points, "the teacher is not used; give --distil"),
        (small("lodnn", distil=1.0, n_pasted=0.0), points, "is of pointseg, which sees another view than lodnn"),
        (small("ssadnet", edge=True, distil=1.0, n_pasted=0.0), slots, "the teacher has no dense boxes"),
        (
            small("pointseg", distil=1.0, classes=("background", "car")),
            points,
            "has the classes background, .* expected",
        ),
        (small("objects"), points, "--teacher has no effect on objects; leave it out"),
    ):
        with pytest.raises(ValueError, match=message):
            train(recipe, tmp_path, simulated=simulated, teacher=teacher)


@pytest.mark.parametrize("network", ["pointseg", "ssadnet", "lodnn"])
def test_an_exported_teacher_answers_with_each_sample(simulated: Path, network: str) -> None:
    path = SHIPPED_MODELS / ("pointseg.onnx" if network == "pointseg" else "ssadnet.onnx")
    recipe = small(network, edge=True, distil=1.0, seen_twice=False, height_above_ground=network == "pointseg")
    task = task_of(recipe)
    samples = samples_of(recipe, simulated, OnnxTeacher(path, task))
    arrays = [torch.from_numpy(array) for array in samples.batch(0)]
    image, taught = arrays[0], arrays[1 + samples.n_targets :]
    assert len(taught) == (2 if network == "ssadnet" else 1)
    assert float((taught[0].sum(1) - 1.0).abs().max()) < 1e-5
    # The teacher reads the same channels of the same scan.
    session = Session(path, "cpu", n_threads=1)
    session.input[:] = image[0].numpy()
    assert torch.allclose(torch.from_numpy(session.run()["class_logits"]).softmax(0), taught[0][0], atol=1e-6)
    outputs = build(recipe).eval()(image)
    assert torch.isfinite(task.distillation(outputs, *taught))
    twice = OnnxTeacher(path, task_of(replace(recipe, seen_twice=True)))
    scan = LabeledScan.load(samples.simulated[0])
    np.testing.assert_allclose(twice(scan)[0], twice(mirrored(scan))[0][:, :, ::-1], atol=0.02)


@pytest.mark.usefixtures("small_views")
def test_a_run_with_an_exported_teacher_equals_one_with_workers(
    tmp_path: Path, simulated: Path, exported: Exported
) -> None:
    _, teacher, _ = exported("pointseg", "dense")
    recipe = small("pointseg", edge=True, distil=1.0, steps=2, n_pasted=0.0)
    given = {"simulated": simulated, "teacher": teacher}
    assert_equal(*(weights(train(recipe, tmp_path / f"with-{n}", n_workers=n, **given)) for n in (0, 1)))
    with pytest.raises(ValueError, match="sees another view than lodnn"):
        OnnxTeacher(teacher, task_of(small("lodnn")))


def test_scans_with_false_objects_are_drawn_more_often(kitti: Path, simulated: Path) -> None:
    scans, scan_weights, _ = real_scans(KittiObjects(kitti), ["000000", "000001"])
    samples = Samples(small("pointseg", n_pasted=0.0), scans, scan_weights, sorted(simulated.glob("*.npz")))

    class Blind(nn.Module):
        """Calls everything farther away than a distance a pedestrian."""

        def __init__(self) -> None:
            super().__init__()
            self.weight = nn.Parameter(torch.zeros(1))

        def forward(self, x: Tensor) -> Tensor:
            far = (x[:, 4] > self.weight + 1.0).float()
            return torch.stack([1.0 - far, 0.0 * far, far, 0.0 * far], dim=1)

    samples.redraw(Blind(), 1000)
    for name in ("real", "simulated"):
        odds = samples.odds[name]
        loads = [samples.real[k] if name == "real" else samples.load(k) for k in range(2)]
        false = [int(((far := samples.sample(s))[0][4] > 1.0)[far[1] == 0].sum()) for s in loads]
        assert odds[int(np.argmax(false))] > odds[int(np.argmin(false))]
    again = Samples(small("pointseg", n_pasted=0.0), scans, scan_weights, sorted(simulated.glob("*.npz")))
    again.redraw(Blind(), 1000)
    for name in ("real", "simulated"):
        np.testing.assert_array_equal(samples.odds[name], again.odds[name])


@pytest.mark.usefixtures("small_views")
def test_each_variant_of_an_ablation_changes_its_setting(
    tmp_path: Path, kitti: Path, simulated: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for network, variants in VARIANTS.items():
        whole = MODELS[SHIPPED[network]].recipe
        for name, changes in variants.items():
            changed = replace(whole, **{k: v for k, v in changes.items() if k not in ("teacher", "scans")})
            assert name == "as shipped" or changes.keys() & {"teacher", "scans"} or changed != whole
    monkeypatch.setattr(ablation, "PAPER", PAPER | {"pointseg": replace(PAPER["pointseg"], batch=4)})
    start = untrained("pointseg", tmp_path)
    arguments = {"kitti": kitti, "simulated": simulated, "start_from": start, "fold": 1, "steps": 1, "n_threads": 1}
    one_scan = tmp_path / "one"
    one_scan.mkdir()
    shutil.copy(min(simulated.iterdir()), one_scan)
    asked = ["nothing pasted", PAPERS]
    rows = ablate("pointseg", tmp_path / "out", **arguments, variants=asked)
    assert [row["variant"] for row in rows] == asked
    (tmp_path / "out/ablation.json").write_text(json.dumps([*rows, rows[0] | {"fold": 2}]))
    assert ablate("pointseg", tmp_path / "out", **arguments, variants=asked) == rows
    with pytest.raises(ValueError, match="is of a run on other data"):
        ablate("pointseg", tmp_path / "out", **{**arguments, "simulated": one_scan}, variants=asked)
    assert all(row["figures"].keys() == {"background", "car", "pedestrian", "cyclist"} for row in rows)
    asked = ["as shipped", "scans times 2", "batches of 2"]
    rows = ablate("lodnn", tmp_path / "lodnn", **{**arguments, "start_from": None}, variants=asked)
    assert [row["scans"] for row in rows] == [4, 8, 4]
    pytest.importorskip("matplotlib")
    plot([*rows, rows[0] | {"variant": "learning rate 0.001"}], tmp_path / "figure.png")
    assert (tmp_path / "figure.png").read_bytes()[:4] == b"\x89PNG"
    with pytest.raises(ValueError, match="no run of lodnn as shipped to draw"):
        plot(rows[1:], tmp_path / "none.png")


@pytest.mark.usefixtures("small_views")
def test_make_also_makes_the_models_that_it_starts_from(
    tmp_path: Path, kitti: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    layouts = tmp_path / "layouts"
    shutil.copytree(kitti / "training", layouts)
    rows = (kitti / "frames.csv").read_text().splitlines()
    (layouts / "frames.csv").write_text("\n".join(row for row in rows if "000002" not in row))  # it has no labels
    full = small("pointseg", edge=True, steps=3, n_pasted=1.0)  # a network for small computers is exported faster
    base = Stage(replace(full, simulated_share=1.0, steps=1))
    stages = {
        "pointseg-sim": base,
        "pointseg-full": Stage(full, after="pointseg-sim"),
        "pointseg": Stage(replace(full, width=0.5, distil=1.0, steps=1), teacher="pointseg-full"),
        "sceneseg": Stage(replace(full, steps=1), is_open=True, also=("halls",)),
    }
    evaluated = []

    def recorded_evaluate(
        datasets: list[object], *args: object, **kwargs: object
    ) -> tuple[dict[str, object], list[object]]:
        evaluated.append([*map(str, datasets)])
        return evaluate(["simulation:1" if d == "simulation" else d for d in datasets], *args, **kwargs)

    monkeypatch.setattr(make_module, "MODELS", stages)
    monkeypatch.setattr(make_module, "N_SIMULATED", 2)
    monkeypatch.setattr(make_module, "MORE_SCANS", {"halls": (600_000, {"vlp-16": 1}, "hall")})
    monkeypatch.setattr(make_module, "evaluate", recorded_evaluate)
    monkeypatch.setattr(to_onnx, "MIN_AGREEMENT", 0.99)  # after so few steps, the logits of many pixels are close
    out = tmp_path / "out"
    arguments = {"kitti": kitti, "layouts": layouts, "n_threads": 1}
    made = make("pointseg-full", out, fold=0, steps=1, **arguments)
    assert made == out / "pointseg-full-fold0.onnx"
    assert evaluated == [[str(kitti), "simulation"]] * 2
    cards = [Session(path, "cpu").card for path in (out / "pointseg-sim.onnx", made)]
    assert [card.training["recipe"]["steps"] for card in cards] == [1, 1]
    assert [bool(card.training["frames"]) for card in cards] == [False, True]
    assert [card.metrics["command"] for card in cards] == [
        "edgeperc eval KITTI simulation --model pointseg-sim --no-agreement",
        "edgeperc eval KITTI simulation --model pointseg-full --fold 0 --no-agreement",
    ]
    assert cards[1].training["started_from"] == [cards[0].training["recipe"]]
    assert [card.training["data"].endswith("in the last run") for card in cards] == [False, True]
    assert cards[1].fitness == read_checkpoint(made.with_suffix("") / "checkpoint.pt")["fitness"].to_dict()
    assert json.loads(made.with_suffix(".json").read_text())["real"]["n_frames"] == 1
    taught = make("pointseg", out, fold=0, **arguments)
    assert len(evaluated) == 3  # the teacher of this fold was made already
    (out / "pointseg-sim.json").unlink()  # as if it had been stopped before its figures
    make("pointseg-full", out, fold=0, steps=1, **arguments)
    assert len(evaluated) == 5
    assert taught.stat().st_size < 0.6 * made.stat().st_size
    # An open one reads KITTI for its figures alone.
    training = Session(make("sceneseg", out, **arguments), "cpu").card.training
    assert (training["frames"], training["licence"], training["started_from"]) == ({}, "Apache-2.0", [])
    assert len(evaluated) == 6
    with pytest.raises(ValueError, match="trained on real scans too; give --kitti and --layouts"):
        make("pointseg", out, kitti=None, layouts=None)


@pytest.mark.usefixtures("small_views")
@pytest.mark.parametrize(("network", "focal_gamma"), [("pointseg", 0.0), ("kulseg", 2.0)])
def test_training_lowers_the_loss(simulated: Path, network: str, focal_gamma: float) -> None:
    recipe = small(network, steps=12, learning_rate=3e-3, focal_gamma=focal_gamma)
    samples = samples_of(recipe, simulated)
    inputs, truth = (torch.from_numpy(a) for a in samples.batch(0))
    losses = losses_of_steps(build(recipe), lambda net: samples.task.loss(net(inputs), [truth]), 8, 3e-3)
    assert losses[-1] < 0.8 * losses[0]


@pytest.mark.usefixtures("small_views")
def test_a_step_always_draws_the_same_samples(simulated: Path) -> None:
    samples = samples_of(small("ssadnet"), simulated)
    for one, other in zip(samples.batch(5), samples.batch(5), strict=True):
        np.testing.assert_array_equal(one, other)
    assert not np.array_equal(samples.batch(5)[0], samples.batch(6)[0])


def test_an_empty_scan_is_a_sample_without_ground_truth(simulated: Path) -> None:
    samples = samples_of(small("pointseg"), simulated)
    scan = LabeledScan.load(samples.simulated[0])
    image, truth = samples.sample(replace(scan, points=scan.points[:0], labels=scan.labels[:0]))
    assert not image.any()
    assert (truth == IGNORE).all()
    assert np.isnan(samples.task.tally().decisive())  # without a word
    full_image, full_truth = samples.sample(scan)
    empty = (full_image == 0.0).all(axis=0)
    assert (full_truth[empty] == IGNORE).all()
    # Without a point of unknown class, such as those of a tram, every other pixel is labeled.
    known = replace(scan, labels=np.where(scan.labels == IGNORE, 0, scan.labels).astype(np.uint8))
    assert ((samples.sample(known)[1] == IGNORE) == empty).all()


def test_simulated_scans_of_another_sensor_are_not_taken_for_those_asked_for(tmp_path: Path) -> None:
    for first, (kept, asked) in enumerate((("hdl-64e", "vlp-16"), ("vlp-16", "hdl-64e"))):
        simulate(tmp_path, 1, first=first, sensor=kept)
        with pytest.raises(ValueError, match=f"is a scan of {kept}, and would be kept; .* for {asked}"):
            simulate(tmp_path, 4, first=first, sensor=asked)
    with pytest.raises(ValueError, match=r"is a scan of a street, and would be kept; .* for a hall"):
        simulate(tmp_path, 1, where="hall")
    assert len([*tmp_path.iterdir()]) == 2
    (tmp_path / "000000.npz").write_bytes((tmp_path / "000000.npz").read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"000000\.npz is damaged or no simulated scan"):
        simulate(tmp_path, 1)


def test_a_mounting_is_simulated_and_the_scan_is_in_the_frame_of_the_models(tmp_path: Path) -> None:
    profile, scans = tmp_path / "mine.json", tmp_path / "scans"
    mine = replace(get_sensor("vlp-32c"), name="mine", mounting=Mounting(0.6, 180.0, 0.0))
    profile.write_text(mine.to_json())
    simulate(scans, 1, sensor=str(profile))
    scan = LabeledScan.load(scans / "000000.npz")
    assert scan.sensor is not None
    assert scan.sensor.fov_down_deg == -15.0  # the beams that look up, of a sensor that hangs
    assert find_ground(scan.points, mount_height_m=1.73).mask.mean() > 0.2
    profile.write_text(replace(mine, mounting=Mounting(0.6, 0.0, 0.0)).to_json())
    with pytest.raises(ValueError, match="is a scan of another mine, and would be kept"):
        simulate(scans, 1, sensor=str(profile))


@pytest.mark.usefixtures("small_views")
@pytest.mark.filterwarnings("default:no scan to train on")
def test_a_run_tells_of_what_it_cannot_learn(
    tmp_path: Path, simulated: Path, monkeypatch: pytest.MonkeyPatch, shell: Shell
) -> None:
    words = ["train", "pointseg", str(tmp_path), "--edge", "--simulated", str(simulated), "--n-pasted", "0"]
    monkeypatch.setattr(Points, "loss", lambda *_: torch.tensor(np.nan, requires_grad=True))
    shown = shell.err(*words, "--batch", "1", "--threads", "1", "--classes", "background,car,pedestrain")
    assert "no scan to train on has a label of pedestrain; see boxes and points" in shown
    assert "the loss is nan at step 0; lower --learning-rate" in shown
    scan = LabeledScan.load(sorted(simulated.glob("*.npz"))[0])
    for network in ("pointseg", "ssadnet", "lodnn"):
        nothing = replace(scan, labels=np.full_like(scan.labels, IGNORE), azimuths=(3.0, 3.1))
        with pytest.raises(ValueError, match=r"no label of the 1 scans to train on is of background, .*; see boxes"):
            train(small(network, edge=True), tmp_path, given=alone(nothing, {"a": "1"}))


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory, scans: Sequence[np.ndarray]) -> Exported:
    """Export an untrained network, once: its checkpoint, the model, and the card."""

    @functools.cache
    def of(network: str, head: str = "dense") -> tuple[Path, Path, ModelCard]:
        folder = tmp_path_factory.mktemp(network)
        with pytest.MonkeyPatch.context() as patch:
            make_views_small(patch)
            checkpoint, path = untrained(network, folder, head=head), folder / "model.onnx"
            patch.setattr(to_onnx, "fitness_of", lambda _: FitnessProfile.from_scans(scans))
            return checkpoint, path, export(checkpoint, path, scans=scans, version="0.0.1")

    return of


@pytest.mark.parametrize(
    ("network", "head"),
    [
        ("kulseg", "dense"),
        ("lodnn", "dense"),
        ("pointseg", "dense"),
        ("ssadnet", "dense"),
        ("ssadnet", "slots"),
        ("ssadnet", "slots-paper"),
    ],
)
def test_an_export_is_verified(exported: Exported, scans: Sequence[np.ndarray], network: str, head: str) -> None:
    checkpoint, path, card = exported(network, head)
    assert card.parity["n_scans"] == 2
    assert card.parity["max_deviation"] < 0.02  # from rounded weights, or from maxima that rounding moves
    session = Session(path, "cpu")
    assert session.card == card
    assert session.golden_deviation < 1e-3
    blob = path.read_bytes()
    assert str(path.parent).encode() not in blob
    assert b"site-packages" not in blob
    answer = Perceiver(path, provider="cpu", on_mismatch="ignore")(scans[0])
    assert (answer.points is None) == (network in ("lodnn", "ssadnet"))
    if network == "lodnn":
        assert answer.require_top_view().classes == ("background", "drivable")
        assert answer.boxes == ()
    if network == "kulseg":  # batch norm is folded, and every operator has a kernel in all engines
        plain = {"Add", "Cast", "Concat", "Conv", "ConvTranspose", "MaxPool", "Mul", "Relu", "Sigmoid"}
        mask = {"Abs", "ReduceMax", "Greater"}
        assert {node.op_type for node in onnx.load(path).graph.node} == plain | mask
    assert sorted(p.name for p in path.parent.iterdir()) == sorted([checkpoint.name, "model.onnx"])


@pytest.mark.usefixtures("small_views")
def test_a_graph_that_disagrees_is_not_written(
    tmp_path: Path, exported: Exported, scans: Sequence[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint, right, _ = exported("pointseg", "dense")
    path = tmp_path / "model.onnx"
    path.write_bytes(b"the model before")

    def broken(network: nn.Module, card: ModelCard) -> onnx.ModelProto:
        model = onnx.load(right)
        largest = max(model.graph.initializer, key=lambda t: len(t.raw_data))
        wrong = onnx.numpy_helper.to_array(largest) * np.float16(1.5)
        largest.CopyFrom(onnx.numpy_helper.from_array(wrong, largest.name))
        return model

    monkeypatch.setattr(to_onnx, "to_graph", broken)
    with pytest.raises(ParityError, match=r"raw outputs differ by \S+ standard deviations"):
        export(checkpoint, path, scans=scans)
    assert path.read_bytes() == b"the model before"
    assert [p.name for p in tmp_path.iterdir()] == ["model.onnx"]
    network = load(checkpoint)[0]
    assert verify(network, right, scans)["label_agreement"] > 0.999
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(1.01)
    with pytest.raises(ParityError):
        verify(network, right, scans)


def test_figures_written_later_change_only_the_card(tmp_path: Path, exported: Exported) -> None:
    """`make.finish` adds figures after evaluation: the bytes equal those of an export with these figures."""
    checkpoint, path, card = exported("lodnn", "dense")
    figures = {"command": "edgeperc eval simulation --model lodnn", "simulated": {"n_frames": 24}}
    with_figures = replace(card, metrics=figures)
    write_card(onnx.load(path), with_figures, tmp_path / "later.onnx")
    write_card(to_graph(load(checkpoint)[0], card), with_figures, tmp_path / "at-once.onnx")
    assert (tmp_path / "later.onnx").read_bytes() == (tmp_path / "at-once.onnx").read_bytes()
    assert ModelCard.read(tmp_path / "later.onnx") == with_figures


class ThirdParty(nn.Module):
    """A third-party range-image network: two channels, a full turn, probabilities as output."""

    def __init__(self) -> None:
        super().__init__()
        self.body = nn.Sequential(nn.Conv2d(2, 8, 3, padding=1), nn.LeakyReLU(), nn.Conv2d(8, 3, 1))

    def forward(self, scan: Tensor) -> Tensor:
        return torch.softmax(self.body(scan), dim=1)


@pytest.fixture(scope="module")
def third_party(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ModelCard]:
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("elsewhere") / "elsewhere.onnx"
    example = (torch.zeros(1, 2, 32, 1024),)
    names = {"input_names": ["scan"], "output_names": ["probabilities"]}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(ThirdParty(), example, path, dynamo=True, external_data=False, verbose=False, **names)
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


def card_command(folder: Path, path: Path, card: ModelCard, encoding: str = "utf-8") -> tuple[str | Path, ...]:
    """The words that write a network with a card as out.onnx."""
    (folder / "card.json").write_text(card.to_json(), encoding=encoding)
    return "card", path, folder / "card.json", folder / "out.onnx"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_a_third_party_network_runs_with_a_card(
    encoding: str, tmp_path: Path, scans: Sequence[np.ndarray], third_party: tuple[Path, ModelCard], shell: Shell
) -> None:
    """In an encoding of Windows too: its shell and editors write these, such as for ``edgeperc info NAME --json``."""
    (path, card), out = third_party, tmp_path / "out.onnx"
    shell.out(*card_command(tmp_path, path, replace(card, version="2é"), encoding))
    assert ModelCard.read(out).version == "2é"
    points = Perceiver(out, provider="cpu")(scans[0]).require_points()
    assert points.classes == ("nothing", "tree", "car")
    assert points.in_view.mean() > 0.9  # all around
    assert len(np.unique(points.labels[points.in_view])) > 1
    write_card(onnx.load(out), card, out)  # it replaces the one before
    assert [p.key for p in onnx.load(out).metadata_props].count(CARD_KEY) == 1
    assert Session(out, "cpu").card.version == card.version


def test_a_card_that_does_not_fit_writes_nothing(
    tmp_path: Path, third_party: tuple[Path, ModelCard], shell: Shell
) -> None:
    path, card = third_party
    wrong = replace(card, classes=("nothing", "car"))
    with pytest.raises(CardMismatchError, match=r"/out.onnx: 'probabilities' is .* of shape \(1, 3, 32, 1024\)"):
        write_card(onnx.load(path), wrong, tmp_path / "out.onnx")
    assert not (tmp_path / "out.onnx").exists()
    said = shell.err(*card_command(tmp_path, path, wrong))
    assert "'probabilities' has shape (1, 3, 32, 1024) in the graph; its card declares" in said
    copied = replace(card, golden=tiny_card().golden)
    said = shell.err(*card_command(tmp_path, path, copied))
    assert "card.json: the golden record is of another network" in said
    assert "Set golden and fitness to null" in said
    words = card_command(tmp_path, path, card)
    Path(words[2]).write_text(card.to_json().replace('"nms_iou"', '"license":"MIT","nms_iou"'))
    assert "card.json: the card has unknown entries license; expected some of" in shell.err(*words)
    assert not (tmp_path / "out.onnx").exists()


def _renamed(model: onnx.ModelProto) -> None:
    model.graph.output[0].name = model.graph.node[-1].output[0] = "scores"


def _not_finite(model: onnx.ModelProto) -> None:
    weights = next(each for each in model.graph.initializer if len(each.dims) == 4)
    weights.CopyFrom(onnx.numpy_helper.from_array(np.full(weights.dims, np.nan, np.float32), weights.name))


FOREIGN = {
    "the graph gives values of 'probabilities' that are not finite": _not_finite,
    r"card names outputs \['probabilities'\], the graph has \['scores'\]": _renamed,
    "cannot open the graph: .*PPScatter": lambda model: setattr(model.graph.node[0], "op_type", "PPScatterPlugin"),
    r"does not run on inputs as the card declares them, \{'scan': \(1, 2, 32, 1024\)\}: .*Expected: 2": (
        lambda model: setattr(model.graph.input[0].type.tensor_type.shape.dim[0], "dim_value", 2)
    ),
}


@pytest.mark.parametrize("message", FOREIGN)
def test_a_graph_that_does_not_fit_is_told_of(
    message: str, tmp_path: Path, third_party: tuple[Path, ModelCard], shell: Shell
) -> None:
    """In a line that says what came and what was expected, with no trace of the program."""
    path, card = third_party
    model = onnx.load(path)
    FOREIGN[message](model)
    onnx.save(model, tmp_path / "wrong.onnx")
    assert re.search(message, shell.err(*card_command(tmp_path, tmp_path / "wrong.onnx", card)))


def test_weights_that_stayed_elsewhere_and_a_card_that_is_no_text_are_told_of(
    tmp_path: Path, third_party: tuple[Path, ModelCard], shell: Shell
) -> None:
    """PyTorch writes weights beside the graph, in a file that is easily left behind; that was a traceback."""
    path, card = third_party
    onnx.save(
        onnx.load(path), tmp_path / "network.onnx", save_as_external_data=True, location="weights", size_threshold=0
    )
    command = card_command(tmp_path, tmp_path / "network.onnx", card)
    shell.out(*command)
    (tmp_path / "weights").unlink()
    assert "network.onnx keeps weights in another file, which cannot be read" in shell.err(*command)
    assert "card.json is not an ONNX model" in shell.err("card", tmp_path / "card.json", path, tmp_path / "out.onnx")
    model = onnx.load(path)
    model.training_info.add()
    onnx.save(model, tmp_path / "network.onnx")
    shell.out(*command)
    with pytest.raises(ModelFileError, match=r"holds graphs for training; .*--trusted to edgeperc run"):
        Session(tmp_path / "out.onnx", "cpu")
    (tmp_path / "card.json").write_bytes('{"name": "é"}'.encode("latin-1"))
    assert "card.json: 'utf-8' codec can't decode byte 0xe9" in shell.err(*command)


def test_weights_have_the_terms_of_their_scans() -> None:
    assert terms_of(sets_of([])) == ""
    assert terms_of(sets_of(["pandaset/002_00", "pandaset/002_01"])).startswith("CC BY 4.0")
    assert terms_of(sets_of(["lyft/7", "000001"])) == "KITTI: CC BY-NC-SA 3.0; Lyft Level 5: CC BY-NC-SA 4.0"
    assert terms_of(sets_of(["pandaset/002_00", "1"])).startswith("KITTI: CC BY-NC-SA 3.0; CC BY 4.0, as PandaSet's")
    assert terms_of(sets_of(["mine/1"])) == "mine: terms of that set"
    assert terms_of(sets_of(["0001TP_1", "yard/1"], camera=True)).endswith("; images of another set: terms of that set")


@pytest.mark.usefixtures("small_views")
def test_the_command_line_from_scans_to_a_model(tmp_path: Path, shell: Shell) -> None:
    data, run, model = tmp_path / "data", tmp_path / "run", tmp_path / "models/pointseg.onnx"
    shell.out("simulate", data, "-n", "2")
    shell.out("simulate", tmp_path, "-n", "1", "--sensor", "vlp-16", "--where", "yard")
    yard = simulated_scan(0, "vlp-16", where="yard", clumped_leaves=True)
    np.testing.assert_array_equal(LabeledScan.load(tmp_path / "000000.npz").points, yard.points)
    said = shell.err("simulate", tmp_path, "-n", "1", "--layouts", tmp_path, "--where", "yard")
    assert "layouts are those of streets, and the place is a yard; leave them out" in said
    arguments = ["--steps", "1", "--batch", "1", "--threads", "1", "--edge"]
    shell.out("train", "pointseg", run, "--simulated", data, *arguments)
    assert "parity" in shell.out("export", run / "checkpoint.pt", model)
    assert '"n_scans": 4' in shell.out("verify", run / "checkpoint.pt", model)
    said = shell.err("verify", run / "checkpoint.pt", "pointseg")
    assert "pointseg.onnx is of another network or other options than" in said
    assert Session(model, "cpu").card.fitness is not None


@pytest.mark.parametrize("network", SCAN_NETWORKS)
def test_a_network_has_one_task(network: str, simulated: Path) -> None:
    """Targets fit the outputs: the loss is finite, and lower for correct labels than for wrong ones."""
    recipe = small(network)
    task = task_of(recipe)
    assert [network in networks for networks in TASKS.values()].count(True) == 1
    samples = samples_of(recipe, simulated)
    image, labels, *boxes = samples.sample(samples.load(0))
    assert image.shape == (len(task.input.channels), task.view.height, task.view.width)
    assert labels.shape == image.shape[1:]
    assert {*np.unique(labels)} <= {*range(len(task.classes)), IGNORE}
    known = torch.from_numpy(np.where(labels == IGNORE, 0, labels).astype(np.int64))
    right = 20.0 * torch.nn.functional.one_hot(known, len(task.classes)).movedim(-1, 0)[None].float()
    targets = [torch.from_numpy(target[None]) for target in (labels, *boxes)]
    losses = []
    for logits in (right, -right):
        outputs = (logits, targets[1]) if boxes else logits
        losses.append(float(task.loss(outputs, targets)))
    assert np.isfinite(losses).all()
    assert losses[0] + 5.0 < losses[1]


def test_large_weights_are_stored_in_half_precision_and_what_it_holds_loses_nothing(tmp_path: Path) -> None:
    shipped, path, again = REPOSITORY / "models" / "pointseg.onnx", tmp_path / "model.onnx", tmp_path / "again.onnx"
    model, card = onnx.load(shipped), replace(ModelCard.read(shipped), golden=None)
    large = [tensor for tensor in model.graph.initializer if onnx.numpy_helper.to_array(tensor).size >= 1024]
    assert large
    for tensor in large:
        values = onnx.numpy_helper.to_array(tensor).astype(np.float16).astype(np.float32)
        tensor.CopyFrom(onnx.numpy_helper.from_array(values, tensor.name))
    write_card(model, card, path)
    halve(model.graph)
    write_card(model, card, again)
    assert again.stat().st_size < 0.6 * path.stat().st_size
    before, after = Session(path, "cpu"), Session(again, "cpu")
    for session in (before, after):
        session.input[:] = np.random.default_rng(0).normal(size=session.input.shape)
    first, second = before.run(), after.run()
    assert all(np.array_equal(first[name], second[name]) for name in first)
    weights = [onnx.numpy_helper.to_array(tensor) for tensor in onnx.load(again).graph.initializer]
    assert not [values for values in weights if values.dtype == np.float32 and values.size >= 1024]


def test_the_models_page_matches_the_cards() -> None:
    folder = REPOSITORY / "models"
    assert (folder / "MODELS.md").read_text() == models_page(folder), "run: edgeperc-export models models"
    assert (folder / "SHA256SUMS").read_text() == sums_of(folder), "run: edgeperc-export models models"


def test_a_page_of_own_models_says_nothing_of_the_shipped_ones(tmp_path: Path) -> None:
    points = {"all": {"car": {"precision": 0.5, "recall": 0.5, "iou": 0.25, "n_points": 7}}}
    metrics = {"command": "edgeperc eval MINE --json f.json", "folders": {"mine": {"n_frames": 2, "points": points}}}
    own = replace(tiny_card(), metrics=metrics, precisions={"fp32": {"command": "edgeperc-export agree mine"}})
    for card in (own, pillars.card_of("anchors")):
        entry = {"key": CARD_KEY, "value": card.to_json()}
        onnx.save(onnx.ModelProto(metadata_props=[entry]), tmp_path / f"{card.name}.onnx")
    with pytest.raises(ModelFileError, match="is not a folder with"):
        models_page(tmp_path / "none")
    page = models_page(tmp_path)
    assert not [line for line in page.splitlines() if line.endswith(": ")]
    expected = "| points, 2 scans of mine |", "by `edgeperc eval MINE --json f.json`\n", "64 x 64 cells of 0.4 m"
    assert [words in page for words in expected] == [True] * 3
    assert not [words for words in ("drive_0011", "Research", "Precision", "NAME:int8") if words in page]


def test_parity_scans_are_no_training_scans(monkeypatch: pytest.MonkeyPatch) -> None:
    seeds: list[int] = []
    scan = simulated_scan(0)

    def recorded(seed: int, *_: object) -> object:
        seeds.append(seed)
        return scan

    monkeypatch.setattr("edgeperc_export.data.simulate.simulated_scan", recorded)
    assert len(parity_samples("points")) == len({*seeds}) == 4
    # Seeds of training scenes start at 0 (a set has thousands), seeds of evaluation scenes at `FIRST_SEED`.
    assert 10**8 < min(seeds) <= max(seeds) < FIRST_SEED - 10**8
