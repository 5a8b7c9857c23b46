"""Training of the object network: samples are what the runtime sees, and the exported graph is the network."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")

from filelock import FileLock, Timeout
from training_helpers import interrupted_in_step, losses_of_steps, train

from cli_helpers import Shell
from edgeperc.datasets.scan_folder import ScanFolder
from edgeperc.errors import ModelError, PointsError
from edgeperc.ground.planes import find_ground
from edgeperc.ground.scan import Scan
from edgeperc.inference.session import MAX_ROWS, Session
from edgeperc.objects.candidate_boxes import decode_objects
from edgeperc.objects.candidates import find_candidates, sort_into_cells
from edgeperc.objects.crops import crop_candidates, fill_features
from edgeperc.perceiver import Perceiver
from edgeperc.simulation.samples import simulated_scan
from edgeperc.types.card import ModelCard
from edgeperc.types.mounting import MODEL_MOUNTING
from edgeperc.types.points import Floats, read_only
from edgeperc.types.sensor import get_sensor
from edgeperc.zoo import model_path
from edgeperc_export.cards import OBJECT_CLASSES, OBJECT_VIEW
from edgeperc_export.data.scans import LabeledScan
from edgeperc_export.networks import build
from edgeperc_export.networks.objects import ObjectNet, parts_of, rejected
from edgeperc_export.recipe import MODELS
from edgeperc_export.release import object_int8
from edgeperc_export.release.object_int8 import candidate_batches, quantize_objects, rounded
from edgeperc_export.release.quantize import Calibration, folded
from edgeperc_export.release.to_onnx import load, to_graph, verify, with_golden, write_card
from edgeperc_export.training import object_batches
from edgeperc_export.training.object_batches import Drawn, ObjectBatches, ObjectWatch, found_again, tensors
from edgeperc_export.training.object_samples import (
    GROUP,
    N_STORED,
    TRUE,
    ObjectSamples,
    build_samples,
    load_samples,
    samples_of,
)
from edgeperc_export.training.object_sets import variants, write_samples
from edgeperc_export.training.object_task import Objects, fill_box_ious
from edgeperc_export.training.start import start

SEED = 4 * 10**9
RECIPE = replace(MODELS["objects"].recipe, steps=4, batch=16, kept=0.0)


@pytest.fixture(scope="module")
def labeled() -> LabeledScan:
    return LabeledScan.from_simulation(simulated_scan(SEED))


@pytest.fixture(scope="module")
def scans(labeled: LabeledScan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the scan."""
    folder = tmp_path_factory.mktemp("scans")
    labeled.save(folder / "000000.npz")
    return folder


@pytest.fixture(scope="module")
def samples(labeled: LabeledScan) -> ObjectSamples:
    options = {"mounting": MODEL_MOUNTING, "boxes_from": "network", "agree": False, "on_mismatch": "ignore"}
    return samples_of(
        labeled, "simulated/0", Perceiver("ssadnet:fp32", **options), np.random.default_rng(0), real=False
    )


def test_samples_are_what_the_runtime_sees(labeled: LabeledScan, samples: ObjectSamples) -> None:
    """Of a candidate with few points, the input in training and at run time differ by the rounding of the store."""
    task = Objects.of(RECIPE)
    points = read_only(labeled.points)
    scan = Scan.of(points, find_ground(points))
    cells = sort_into_cells(scan, OBJECT_VIEW.height_range_m)
    own = find_candidates(scan, cells, get_sensor("hdl-64e").link_per_m)
    groups = np.flatnonzero(samples.origin == GROUP)
    assert len(groups) > 20
    for k in groups:
        assert np.abs(own.rectangles - samples.rectangles[k]).max(axis=1).min() < 1e-3
    places = samples.rectangles[groups].astype(np.float64)
    crops = crop_candidates(scan, own._replace(rectangles=places), OBJECT_VIEW.n_points, OBJECT_VIEW.margin_m)
    right = np.empty((len(groups), OBJECT_VIEW.n_points, len(task.input.channels)), np.float32)
    spec = task.input
    fill_features(crops.points, crops.counts, places, np.array([spec.mean, spec.std], np.float32), right)
    found, labels, _ = tensors(task, Drawn.of(samples, groups))
    few = np.flatnonzero(
        (samples.counts[groups] <= N_STORED) & (crops.counts >= 3) & (crops.counts <= OBJECT_VIEW.n_points)
    )
    assert len(few) > 5
    for k in few:
        seen, shown = (np.unique(np.round(array[k].astype(np.float64), 1), axis=0) for array in (found.numpy(), right))
        np.testing.assert_allclose(seen.max(axis=0), shown.max(axis=0), atol=0.21)
        np.testing.assert_allclose(seen.min(axis=0), shown.min(axis=0), atol=0.21)
        np.testing.assert_allclose(found[k, 0, -1], right[k, 0, -1], atol=1e-5)  # the number of points
    assert (labels.numpy() == samples.classes[groups]).all()


def test_candidates_of_objects_have_their_truth(labeled: LabeledScan, samples: ObjectSamples) -> None:
    objects = samples.classes > 0
    assert 0 < objects.sum() < len(objects)
    for k in np.flatnonzero(objects & (samples.origin == TRUE)):
        np.testing.assert_allclose(samples.rectangles[k, :2], samples.truth[k, :2], atol=1e-3)
    names = {OBJECT_CLASSES[k] for k in samples.classes[objects]}
    assert names <= {box.label.replace("person_sitting", "pedestrian") for box in labeled.boxes}
    assert not samples.truth[samples.classes == 0].any()


def test_batches_are_the_same_for_the_same_step(samples: ObjectSamples) -> None:
    batches = ObjectBatches(Objects.of(RECIPE), samples, ["simulated"])
    first, again, other = batches.batch(3), batches.batch(3), batches.batch(4)
    for a, b in zip(first, again, strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(first[0], other[0])
    assert len(batches.simulated) == 1
    x, labels, boxes = first
    assert x.shape == (16, OBJECT_VIEW.n_points, len(Objects.of(RECIPE).input.channels))
    assert torch.isfinite(x).all()
    assert torch.isfinite(boxes).all()
    assert (boxes[labels > 0][:, 3:6] > 0.0).all()


class Finder(ObjectNet):
    """Finds at each candidate a car 1 m ahead and 0.5 m to the left, turned by 0.2 rad; none among few points."""

    def closely(self, x: Any) -> Any:
        """Outputs (B, 29)."""
        outputs = torch.zeros(len(x), 29)
        outputs[:, 0], outputs[:, 1], outputs[:, -1] = torch.where(x[:, 0, -1] > 0.0, -9.0, 9.0), 0.0, 9.0
        outputs[:, 6], outputs[:, 7] = 1.0, 0.5
        outputs[:, 24], outputs[:, 25], outputs[:, 26] = math.cos(0.4), math.sin(0.4), 1.0
        return outputs


def in_scan(drawn: Drawn) -> Floats:
    """x, y of the points (2, B, N_STORED) in the scan."""
    cos, sin = np.cos(drawn.rectangles[:, 4])[:, None], np.sin(drawn.rectangles[:, 4])[:, None]
    u, v = drawn.points[:, :, 0], drawn.points[:, :, 1]
    return np.stack([cos * u - sin * v, sin * u + cos * v]) + drawn.rectangles[:, :2].T[:, :, None]


def test_what_is_found_is_a_candidate_from_either_end(samples: ObjectSamples) -> None:
    task = Objects.of(RECIPE)
    network = Finder(len(task.input.channels), len(task.classes))
    before = Drawn.of(samples, np.arange(len(samples.counts)))
    many = tensors(task, before, np.random.default_rng(0))[0][:, 0, -1].numpy() > 0.0
    old = before.rows(many)
    found = found_again(task, network, Drawn.of(samples, np.arange(len(samples.counts))), np.random.default_rng(0))
    assert 0 < len(found.counts) == many.sum() < len(many)

    cos, sin = np.cos(old.rectangles[:, 4]), np.sin(old.rectangles[:, 4])
    right = old.rectangles[:, :2] + np.stack([cos - 0.5 * sin, sin + 0.5 * cos], axis=1)
    np.testing.assert_allclose(found.rectangles[:, :2], right, atol=1e-5)
    np.testing.assert_allclose(found.rectangles[:, 2:4], np.tile(task.card.box_size_priors["car"][:2], (len(right), 1)))
    turns = found.rectangles[:, 4] - old.rectangles[:, 4] - 0.2
    np.testing.assert_allclose(np.cos(2.0 * turns), 1.0, atol=1e-5)
    assert {*np.sign(np.cos(turns))} == {-1.0, 1.0}
    # The points stay where they are in the scan, and so does the object.
    np.testing.assert_allclose(in_scan(found), in_scan(old), atol=1e-4)
    np.testing.assert_array_equal(found.truth, old.truth)


def test_a_share_of_the_batch_is_found_again(samples: ObjectSamples) -> None:
    task = Objects.of(replace(RECIPE, found_again=0.25))
    batches = ObjectBatches(task, samples, ["simulated"])
    plain = batches.batch(3)
    batches.network = Finder(len(task.input.channels), len(task.classes))
    mixed, again = batches.batch(3), batches.batch(3)
    assert all(map(torch.equal, mixed, again))
    for kept, drawn in zip(mixed[1:], plain[1:], strict=True):
        assert torch.equal(kept[:12], drawn[:12])
    assert not torch.equal(mixed[2][12:], plain[2][12:])
    # Candidates that were found have the sizes of a car; the others do not.
    spec, (length, width, _) = task.input, task.card.box_size_priors["car"]
    sides = mixed[0][:, 0, 6:8] * torch.tensor(spec.std[6:8]) + torch.tensor(spec.mean[6:8])
    is_car = np.isclose(sides.numpy(), np.log([length, width]), atol=1e-4).all(axis=1)
    assert is_car.tolist() == [False] * 12 + [True] * 4


def test_boxes_of_the_training_are_those_of_the_runtime() -> None:
    task = Objects.of(RECIPE)
    outputs = torch.from_numpy(np.random.default_rng(1).normal(0.0, 1.0, (40, 29)).astype(np.float32))
    parts = parts_of(outputs, len(OBJECT_CLASSES))
    kinds = 1 + parts.classes[:, 1:].argmax(1)
    boxes = task.boxes(parts, kinds).numpy()
    found = decode_objects(task.card, outputs.numpy(), np.zeros((40, 5)), np.zeros(40))
    boxes[:, 2] += 0.5 * boxes[:, 5]  # the middle, not the bottom
    np.testing.assert_allclose(found[:, :6], boxes[:, :6], atol=1e-5)
    np.testing.assert_allclose(np.cos(found[:, 6] - boxes[:, 6]), 1.0, atol=1e-5)
    np.testing.assert_array_equal(found[:, 8], kinds.numpy())


@pytest.mark.kernel
def test_overlap_in_space() -> None:
    box = np.array([[1.0, 2.0, 0.0, 4.0, 2.0, 1.5, 0.3]])
    for change, right in (
        ({}, 1.0),
        ({2: 0.75}, 1.0 / 3.0),
        ({2: 1.5}, 0.0),
        ({0: 9.0}, 0.0),
        ({6: 0.3 + math.pi}, 1.0),
        ({3: 2.0}, 0.5),
    ):
        other = box.copy()
        for column, value in change.items():
            other[0, column] = value
        iou = np.empty(1)
        fill_box_ious(box, other, iou)
        np.testing.assert_allclose(iou, right, atol=1e-9)


def test_a_step_lowers_the_loss(samples: ObjectSamples) -> None:
    task = Objects.of(RECIPE)
    network, (x, *targets) = build(RECIPE), ObjectBatches(task, samples, ["simulated"]).batch(0)
    losses = losses_of_steps(network, lambda network: task.loss(network(x), targets), 12, 2e-3)
    assert losses[-1] < 0.8 * losses[0]
    figure, loss, figures = ObjectWatch(task, samples).validate(network.eval())
    assert 0.0 <= figure <= 1.0
    assert math.isfinite(loss)
    assert "precision" in figures


def test_the_graph_looks_closely_where_the_first_look_says_so(tmp_path: Path) -> None:
    """None, some and all of the candidates: torch and onnxruntime agree."""
    network = build(RECIPE).eval()
    card, path = Objects.of(RECIPE).card, tmp_path / "objects.onnx"
    with torch.no_grad():
        network.look.head2.bias.fill_(-3.5)
    model = to_graph(network, card)
    (held,) = (each for each in model.graph.initializer if (onnx.numpy_helper.to_array(each) == -3.5).all())
    shape = network.look.head2.bias.shape
    for bias in (-100.0, -3.5, 100.0):
        with torch.no_grad():
            network.look.head2.bias.fill_(bias)
        held.CopyFrom(onnx.numpy_helper.from_array(np.full(shape, bias, np.float32), held.name))
        write_card(model, with_golden(model, card), path)
        session = Session(path, "cpu")
        for n in (1, 2, 50, *([MAX_ROWS] if bias == -3.5 else [])):
            x = torch.randn(
                n, OBJECT_VIEW.n_points, len(card.input.channels), generator=torch.Generator().manual_seed(n)
            )
            session.input[:n] = x.numpy()
            found = session.run(n)["objects"][:n]
            with torch.no_grad():
                right = network.detect(x).numpy()
            np.testing.assert_allclose(found, right, atol=2e-3)
            kept = ~np.isclose(right, rejected(29).numpy()).all(axis=1)
            assert kept.all() if bias > 0.0 else True
            assert not kept.any() if bias < -10.0 else True
    assert verify(network, path, [simulated_scan(SEED).points])["label_agreement"] >= 0.999


def test_training_resumes_bit_for_bit(scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(object_batches, "AGAIN", 0.0)  # what random weights find is among the candidates, too
    recipe = replace(RECIPE, found_again=0.5)

    def run(name: str) -> dict[str, torch.Tensor]:
        checkpoint = train(recipe, tmp_path / name, simulated=scans, checkpoint_every=2)
        weights: dict[str, torch.Tensor] = load(checkpoint)[0].state_dict()
        return weights

    whole = run("whole")
    with interrupted_in_step(3, Objects):  # there is a checkpoint of the second
        run("cut")
    for name, weight in run("cut").items():
        assert torch.equal(weight, whole[name]), name


def test_two_runs_leave_the_mean_of_their_weights(scans: Path, tmp_path: Path) -> None:
    recipe = replace(RECIPE, steps=2, runs=2, seed=7)
    mean, of_mean, _ = load(train(recipe, tmp_path / "both", simulated=scans))
    one, other = (load(tmp_path / f"both-run-{k}" / "checkpoint.pt")[0].state_dict() for k in range(2))
    alone = load(train(replace(recipe, runs=1, seed=8), tmp_path / "alone", simulated=scans))[0].state_dict()
    assert of_mean == recipe
    for name, weight in mean.state_dict().items():
        assert torch.equal(other[name], alone[name])
        torch.testing.assert_close(weight, 0.5 * (one[name] + other[name]))
    assert any(not torch.equal(weight, one[name]) for name, weight in mean.state_dict().items())


def test_a_run_starts_from_the_shipped_model(samples: ObjectSamples) -> None:
    task, network = Objects.of(RECIPE), build(RECIPE)
    assert start(network, RECIPE, model_path("objects"), [])[-1]["network"] == "objects"
    x, *_ = tensors(task, Drawn.of(samples, np.arange(len(samples.counts))))
    session = Session("objects:fp32", "cpu", n_threads=1)
    session.input[: len(x)] = x.numpy()
    with torch.no_grad():
        outputs = network.eval().detect(x).numpy()
    np.testing.assert_allclose(session.run(len(x))["objects"][: len(x)], outputs, atol=1e-4)
    assert (outputs[:, 0] < outputs[:, 1]).any()


def test_without_a_detector_candidates_are_groups(
    labeled: LabeledScan, scans: Path, tmp_path: Path, shell: Shell
) -> None:
    """The network is exported by the command line, too; what the networks of others found is no part of it."""
    recipe = replace(RECIPE, steps=1, detector=False)
    checkpoint = train(recipe, tmp_path / "run", simulated=scans)
    found = load_samples(tmp_path / "object-samples-of-groups", ["simulated"])
    alone = samples_of(labeled, "simulated/000000", None, np.random.default_rng((0, 0, len("simulated"))), real=False)
    np.testing.assert_array_equal(found.rectangles, alone.rectangles)
    assert not (tmp_path / "object-samples").exists()
    path = tmp_path / "objects.onnx"
    assert "mine 1.0.0, parity" in shell.out("export", checkpoint, path, "--name", "mine")
    assert ModelCard.read(path).fitness is None


def test_a_missing_source_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no samples of kitti-0"):
        load_samples(tmp_path, ["kitti-0"])
    with pytest.raises(ValueError, match="no scans to train objects on"):
        train(RECIPE, tmp_path / "run")
    build_samples(tmp_path, "nothing", [], real=True)
    nothing = Calibration([np.zeros((0, 4), np.float32)])
    with pytest.raises(PointsError, match="no candidate in 1 scans"):
        quantize_objects(model_path("objects:fp32"), tmp_path / "int8.onnx", nothing)
    with pytest.raises(ModelError, match="quantize the model in fp32"):
        quantize_objects(model_path("objects:int8"), tmp_path / "int8.onnx", nothing)


def test_samples_are_of_the_scans_and_labels_that_are_there(labeled: LabeledScan, tmp_path: Path) -> None:
    def samples(*scans: LabeledScan) -> list[bytes]:
        of_drives = [(f"drive {k}", partial(replace, scan)) for k, scan in enumerate(scans)]
        build_samples(tmp_path, "mine", of_drives, real=True, detector=False)
        return [array.tobytes() for array in load_samples(tmp_path, ["mine"])]

    first = samples(labeled)
    (made,) = tmp_path.glob("*.npz")
    written = made.stat().st_mtime_ns
    assert samples(labeled) == first
    assert made.stat().st_mtime_ns == written  # kept
    corrected = replace(labeled, boxes=labeled.boxes[1:], counts=labeled.counts[1:])
    assert samples(corrected) != first
    made.with_name("mine-001.npz").write_bytes(made.read_bytes())  # of a hundred scans that are gone
    assert samples(labeled, labeled) != first
    assert samples(labeled) == first


@pytest.mark.parametrize("name", ["validation", "simulated", "kitti-0", "kitti-0-pasted", "kitti-0-sparse"])
def test_a_set_has_a_name_of_its_own(tmp_path: Path, name: str) -> None:
    (tmp_path / "velodyne").mkdir()
    (tmp_path / "label").mkdir()
    np.zeros((4, 4), np.float32).tofile(tmp_path / "velodyne/a.bin")
    (tmp_path / "label/a.txt").write_text("")
    (tmp_path / "scans.json").write_text(
        json.dumps({"schema": 1, "name": name, "sensor": "hdl-64e", "boxes": {"*": "ignore"}})
    )
    with pytest.raises(ValueError, match="another source of samples is called"):
        write_samples(tmp_path / "samples", scan_sets=[ScanFolder(tmp_path)])


def test_int8_agrees_with_fp32(tmp_path: Path) -> None:
    """The shipped network, rounded on one scan: the classes of the candidates of another."""
    path, rounded_path = model_path("objects:fp32"), tmp_path / "int8.onnx"
    card = Session(path, "cpu").card
    (batch,) = candidate_batches(card, [simulated_scan(SEED).points])
    model = rounded(folded(path), card, [batch])
    write_card(model, with_golden(model, replace(card, precision="int8", precisions={})), rounded_path)
    (other,) = candidate_batches(card, [simulated_scan(SEED + 1).points])
    classes = []
    for session in (Session(path, "cpu"), Session(rounded_path, "cpu")):
        session.input[: len(other)] = other
        classes.append(session.run(len(other))["objects"][: len(other), : len(card.classes)].argmax(axis=1))
    assert (classes[0] == classes[1]).mean() > 0.95


def test_the_card_of_int8_has_figures_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The card of the network in fp32 has some, which are not those of int8."""
    faster = np.full(40, 2.0), np.full(40, 1.0)
    monkeypatch.setattr(object_int8, "race", lambda *_, **__: faster)
    monkeypatch.setattr(
        object_int8,
        "object_figures",
        lambda kitti, path, name: ({"of": ModelCard.read(path).precision}, f"{kitti} {name}"),
    )
    path, calibration = model_path("objects:fp32"), Calibration([simulated_scan(SEED).points])
    assert ModelCard.read(path).metrics
    assert quantize_objects(path, tmp_path / "int8.onnx", calibration).metrics == {}
    measured = quantize_objects(path, tmp_path / "int8.onnx", calibration, kitti=Path("KITTI")).metrics
    assert measured == {"of": "int8", "command": "KITTI objects:int8"}


def test_other_processes_paste_the_same_objects(labeled: LabeledScan, tmp_path: Path) -> None:
    labeled.save(tmp_path / "scan.npz")
    pasted = variants([("drive", partial(LabeledScan.load, tmp_path / "scan.npz"))])
    assert len({len(scan().points) for _, scan in pasted}) > 1
    sparse = variants([("drive", partial(LabeledScan.load, tmp_path / "scan.npz"))], sparse=True)
    assert all((sensor := scan().sensor) is not None and sensor.median_gap_deg > 0.8 for _, scan in sparse)
    for n_workers in (0, 1):
        build_samples(tmp_path / str(n_workers), "pasted", pasted, real=True, detector=False, n_workers=n_workers)
    ours, theirs = (load_samples(tmp_path / folder, ["pasted"]) for folder in ("0", "1"))
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(one, other)


def test_runs_on_other_scans_wait_for_one_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They share the folder of samples, whose parts were then of both."""

    def written(folder: Path, *_: object, **__: object) -> None:
        with pytest.raises(Timeout):
            FileLock(folder / ".lock").acquire(timeout=0)
        raise KeyboardInterrupt

    monkeypatch.setattr("edgeperc_export.training.sources.write_samples", written)
    with pytest.raises(KeyboardInterrupt):
        train(RECIPE, tmp_path / "run")
