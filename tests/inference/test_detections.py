"""Detectors of others: an .onnx as OpenPCDet exports it gives the boxes that torch gives for the same scan."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")

import pillar_networks as networks
from pillar_networks import CENTER_HEAD, DECORATED, KINDS, STRIDE, VIEW, PillarNet, card_of

import twins.decode
from cli_helpers import Shell
from edgeperc import Perceiver, Tracker
from edgeperc.errors import CardMismatchError, InferenceError, ProviderError
from edgeperc.evaluation.judge import Judge
from edgeperc.inference.detections import decode_detections
from edgeperc.inference.pillars import Pillarizer
from edgeperc.inference.session import Session
from edgeperc.records import scan_record
from edgeperc.simulation.samples import simulated_scan
from edgeperc.types.card import Golden, ModelCard, OutputSpec
from edgeperc.types.detector import Anchor, CenterHead
from edgeperc.types.frame import ModelFrame
from edgeperc.types.geometry import rectangles
from edgeperc.types.mounting import MODEL_MOUNTING, Mounting
from edgeperc.types.perception import Box, Perception

SCORE, MAX_IOU = 0.5, 0.1
HEADS = ("anchors", "centers")


@pytest.fixture(scope="module")
def points() -> NDArray[np.float32]:
    return simulated_scan(0).points


@pytest.fixture(scope="module")
def trained() -> dict[str, PillarNet]:
    return {kind: networks.trained(kind, n_steps=75, n_scans=1) for kind in HEADS}


@pytest.fixture(scope="module")
def models(trained: dict[str, PillarNet], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("detectors")
    return {kind: networks.exported(trained[kind], folder / f"{kind}.onnx") for kind in HEADS}


def perceived(path: Path, points: NDArray[np.float32], **options: object) -> Perception:
    """The answer of a detector alone, without what the stages after it change."""
    as_is: dict[str, object] = {
        "provider": "cpu",
        "n_threads": 1,
        "mounting": MODEL_MOUNTING,
        "on_mismatch": "ignore",
        "adapt": "none",
        "agree": False,
        "score_threshold": SCORE,
    }
    return Perceiver(path, **{**as_is, **options})(points)  # type: ignore[arg-type]


def by_torch(network: PillarNet, card: ModelCard, points: NDArray[np.float32]) -> list[tuple[str, float, list[float]]]:
    """Label, score, and x, y, z, length, width, height, yaw of the boxes, best first; decoded in torch."""
    with torch.no_grad():
        outputs = network(*networks.inputs_of(card, points))
        rows, columns = VIEW.height // STRIDE, VIEW.width // STRIDE
        if network.kind == "anchors":
            x = torch.linspace(*VIEW.x_range_m, columns)
            y = torch.linspace(*VIEW.y_range_m, rows)
            anchors = torch.zeros(rows, columns, 6, 7)
            anchors[..., 0], anchors[..., 1] = x[None, :, None], y[:, None, None]
            for k, anchor in enumerate(networks.ANCHORS):
                anchors[:, :, 2 * k : 2 * k + 2, 2] = anchor.bottom_m + anchor.size_m[2] / 2
                anchors[:, :, 2 * k : 2 * k + 2, 3:6] = torch.tensor(anchor.size_m)
                anchors[:, :, 2 * k : 2 * k + 2, 6] = torch.tensor(anchor.yaws_rad)
            anchors = anchors.view(-1, 7)
            scores, labels = outputs[0].reshape(-1, 3).sigmoid().max(dim=1)
            code = outputs[1].reshape(-1, 7)
            diagonal = anchors[:, 3:5].norm(dim=1, keepdim=True)
            boxes = torch.cat(
                [
                    code[:, :2] * diagonal + anchors[:, :2],
                    code[:, 2:3] * anchors[:, 5:6] + anchors[:, 2:3],
                    code[:, 3:6].exp() * anchors[:, 3:6],
                    code[:, 6:] + anchors[:, 6:],
                ],
                dim=1,
            )
            off = boxes[:, 6] - 0.78539
            half = outputs[2].reshape(-1, 2).argmax(dim=1)
            boxes[:, 6] = off - torch.floor(off / math.pi) * math.pi + 0.78539 + math.pi * half
        else:
            heat, reg, height, dim, rot, _ = (each[0].flatten(1) for each in outputs)
            at = torch.arange(rows * columns)
            one = torch.stack([at % columns, at // columns]) + reg
            low = torch.tensor([[VIEW.x_range_m[0]], [VIEW.y_range_m[0]]])
            one = torch.cat([one * STRIDE * VIEW.cell_m + low, height, dim.exp(), torch.atan2(rot[:1], rot[1:])])
            boxes = one.t().repeat(3, 1)
            scores, labels = heat.sigmoid().flatten(), torch.arange(3).repeat_interleave(rows * columns)
            best = heat.max(dim=0)[0].sigmoid().repeat(3)
            scores = torch.where(scores == best, scores, torch.zeros(()))
        order = torch.argsort(-scores)
        order = order[scores[order] >= SCORE]
        near = (boxes[order, 2] >= -8.0) & (boxes[order, 2] <= 6.0)
        order = order[near]
        kept = []
        groups = [order] if network.kind == "centers" else [order[labels[order] == label] for label in range(3)]
        for alike in groups:
            flat = boxes[alike][:, [0, 1, 3, 4, 6]].double().numpy()
            kept += alike[torch.from_numpy(twins.decode.nms(flat, MAX_IOU))].tolist()
        kept.sort(key=lambda row: -float(scores[row]))
        return [(KINDS[int(labels[row])], float(scores[row]), boxes[row].tolist()) for row in kept]


def assert_alike(found: list[Box] | tuple[Box, ...], wanted: list[tuple[str, float, list[float]]]) -> None:
    assert len(found) == len(wanted) >= 3
    for box, (label, score, (x, y, z, length, width, height, yaw)) in zip(found, wanted, strict=True):
        assert box.label == label
        assert box.score == pytest.approx(score, abs=1e-3)
        assert box.center == pytest.approx((x, y, z), abs=1e-3)
        sizes = np.clip((length, width, height), 0.2, 40.0)
        assert box.size == pytest.approx(sizes, abs=1e-3)
        assert math.cos(box.yaw - yaw) > 1.0 - 1e-6
        assert -math.pi <= box.yaw <= math.pi
        assert 0.5 <= box.front <= 1.0


def assert_near(found: Sequence[Box], wanted: Sequence[Box], most_m: float) -> None:
    """Boxes of the same classes at the same places."""
    assert [box.label for box in found] == [box.label for box in wanted]
    np.testing.assert_allclose([box.center for box in found], [box.center for box in wanted], atol=most_m, rtol=0)


@pytest.mark.compiled
@pytest.mark.parametrize("kind", HEADS)
def test_boxes_are_those_of_torch(
    kind: str, models: dict[str, Path], trained: dict[str, PillarNet], points: NDArray[np.float32]
) -> None:
    found = perceived(models[kind], points)
    assert found.points is None
    assert found.top_view is None
    assert_alike(found.boxes, by_torch(trained[kind], card_of(kind), points))


@pytest.mark.parametrize("kind", HEADS)
def test_a_trained_network_finds_what_it_has_seen(
    kind: str, models: dict[str, Path], points: NDArray[np.float32]
) -> None:
    """The kinds of the heads, their classes and directions are those of the scene."""
    found = perceived(models[kind], points).boxes
    true = [box for box in simulated_scan(0).boxes if box.label == "car" and VIEW.x_range_m[0] < box.center[0] < 14.0]
    true = [box for box in true if abs(box.center[1]) < 10.0]
    assert len(true) >= 2
    for box in true:
        near = [each for each in found if each.label == "car" and math.dist(each.center, box.center) < 1.0]
        assert near
        assert math.cos(near[0].yaw - box.yaw) > 0.7
        assert near[0].size[1] == pytest.approx(box.size[1], abs=0.4)


def test_features_by_the_kernel_are_those_in_the_graph(
    trained: dict[str, PillarNet], models: dict[str, Path], points: NDArray[np.float32], tmp_path: Path
) -> None:
    """The same weights with points that come decorated, a fixed number of pillars, and other types of inputs."""
    network = PillarNet("anchors", decorated=True).eval()
    network.load_state_dict(trained["anchors"].state_dict())
    wanted = perceived(models["anchors"], points).boxes
    card = card_of("anchors", DECORATED)
    assert len(networks.inputs_of(card, points)[0]) < VIEW.max_pillars
    graphs = (
        networks.exported(network, tmp_path / "dynamic.onnx"),
        networks.exported(network, tmp_path / "static.onnx", card, n_pillars=VIEW.max_pillars, whole=torch.int64),
        networks.exported(trained["anchors"], tmp_path / "floats.onnx", whole=torch.float32),
    )
    for path in graphs:
        found = perceived(path, points).boxes
        assert_near(found, wanted, 1e-3)
        np.testing.assert_allclose([box.size for box in found], [box.size for box in wanted], atol=1e-3, rtol=0)


@pytest.mark.parametrize("height_m", [1.2, 1.73, 2.5])
def test_boxes_are_in_the_frame_of_the_scan(
    height_m: float, models: dict[str, Path], points: NDArray[np.float32]
) -> None:
    """A sensor of any height and heading sees the same objects; the network sees the scan from its own height."""
    wanted = perceived(models["centers"], points).boxes
    mounting = Mounting(height_m, 1.0, -2.0, 90.0)
    found = perceived(models["centers"], ModelFrame(mounting).move_back(points), mounting=mounting).boxes
    back = ModelFrame(mounting).move_boxes(found)
    assert_near(back, wanted, 0.01)
    x, y, _ = wanted[0].center
    assert math.hypot(found[0].center[0] - y, found[0].center[1] + x) < 1.0  # ahead is to the right of the sensor


@pytest.mark.parametrize(
    "training", [Mounting(0.0, 0.0, 0.0), Mounting(1.84, 0.0, 1.0, -90.0), Mounting(3.0, 0.0, -5.0)]
)
def test_the_frame_of_the_training_points(
    training: Mounting,
    trained: dict[str, PillarNet],
    models: dict[str, Path],
    points: NDArray[np.float32],
    tmp_path: Path,
) -> None:
    """A network that was trained in another frame, such as that of the road, sees points there; boxes come back."""
    view = replace(VIEW, pitch_deg=training.pitch_deg, yaw_deg=training.yaw_deg)
    path = networks.exported(
        trained["anchors"],
        tmp_path / "other.onnx",
        replace(card_of("anchors"), mount_height_m=training.height_m, view=view),
    )
    frame = ModelFrame(training)
    wanted = frame.move_boxes(perceived(models["anchors"], points).boxes)
    found = perceived(path, frame.move(points)).boxes
    assert_near(found, wanted, 0.01)


@pytest.mark.compiled
@pytest.mark.parametrize(("kind", "among"), [("anchors", [*zip(KINDS)]), ("centers", [KINDS])])
def test_a_full_turn_has_the_boxes_of_each_quarter(
    kind: str, among: list[tuple[str, ...]], models: dict[str, Path], points: NDArray[np.float32]
) -> None:
    """Without those that overlap a better one of their class, or of their group, at the seams."""
    every: list[Box] = []
    for k in range(4):
        frame = ModelFrame(replace(MODEL_MOUNTING, yaw_deg=90.0 * k))
        every += frame.move_boxes(perceived(models[kind], frame.move_back(points)).boxes)
    whole = perceived(models[kind], points, full_turn=True).boxes
    kept: list[Box] = []
    for names in among:
        alike = sorted((box for box in every if box.label in names), key=lambda box: -box.score)
        rows = twins.decode.nms(rectangles(alike), MAX_IOU)
        kept += [box for box, keep in zip(alike, rows, strict=True) if keep]
    assert len(kept) > 20
    assert_near(whole, sorted(kept, key=lambda box: -box.score), 1e-3)


def test_what_it_cannot_see_is_not_judged(models: dict[str, Path]) -> None:
    view = Judge([models["anchors"]]).detected_in
    assert view is not None
    assert [view.holds(*at) for at in ((20.0, 10.0), (-5.0, 0.0), (30.0, 0.0), (20.0, 20.0))] == [True, *[False] * 3]
    assert Judge([models["anchors"], "objects"]).detected_in is None


def test_it_runs_beside_the_other_networks_and_is_tracked(models: dict[str, Path], points: NDArray[np.float32]) -> None:
    alone = perceived(models["anchors"], points, agree=True)
    options = {"provider": "cpu", "mounting": MODEL_MOUNTING, "on_mismatch": "ignore", "adapt": "none"}
    every = [models["anchors"], "pointseg", "ssadnet"]
    together = Perceiver(every, score_threshold=SCORE, **options)(points)  # type: ignore[arg-type]
    assert {*alone.boxes} <= {*together.boxes}
    assert together.top_view is not None
    assert together.points is not None
    tracks = Tracker().update(together.boxes, 0.0)
    assert len(tracks) + tracks.n_tentative == len(together.boxes)
    document = json.loads(json.dumps(scan_record(together)))
    assert len(document["boxes"]) == len(together.boxes)


def test_its_boxes_add_labels(models: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """As those of the top view do: with true boxes of vehicles, more of their points are labeled."""
    both = [models["anchors"], "pointseg"]
    perceive = Perceiver(both, provider="cpu", on_mismatch="ignore", adapt="none")
    for seed in (0, 2, 5):
        scan, n_cars = simulated_scan(seed), []
        sure = [replace(box, score=0.9) for box in scan.boxes if box.label in ("car", "van", "truck")]
        for boxes in ([], sure):
            monkeypatch.setattr(perceive.pipeline.pillars, "find_boxes", lambda _, boxes=boxes: boxes)
            found = perceive(scan.points)
            assert len(found.boxes) >= len(boxes)
            n_cars.append(np.count_nonzero(found.require_points().labels == 1))
        assert n_cars[1] > n_cars[0] > 0


def test_without_points_there_are_no_boxes(models: dict[str, Path]) -> None:
    for empty in (np.empty((0, 4), np.float32), np.full((1, 4), np.nan, np.float32), np.full((3, 4), 99.0, np.float32)):
        assert perceived(models["centers"], empty).boxes == ()


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("kind", HEADS)
def test_few_pillars(kind: str, n: int, models: dict[str, Path], trained: dict[str, PillarNet]) -> None:
    """A pillar alone is as the same one twice, which changes nothing."""
    scan = np.float32([[5.0, 0.3, -1.0, 0.2], [9.0, 4.0, -1.5, 0.4], [20.0, -3.0, -0.5, 0.1]])[:n]
    session, maker = Session(models[kind], "cpu"), Pillarizer(VIEW, card_of(kind).input)
    assert maker.fill(scan) == n
    for given, array in zip(session.inputs.values(), maker.pillars, strict=True):
        given[:n] = array[:n]
    found = session.run(n)
    rows = torch.arange(max(n, 2)) % n
    with torch.no_grad():
        wanted = trained[kind](*(torch.from_numpy(array[:n])[rows] for array in maker.pillars))
    for output, right in zip(card_of(kind).outputs, wanted, strict=True):
        np.testing.assert_allclose(found[output.name], right[0].numpy(), atol=1e-3)


def test_clusters_alone_leave_the_detector_out(models: dict[str, Path], points: NDArray[np.float32]) -> None:
    options = {"provider": "cpu", "mounting": MODEL_MOUNTING, "on_mismatch": "ignore", "boxes_from": "clusters"}
    with_detector = Perceiver([models["centers"], "pointseg"], **options)(points)  # type: ignore[arg-type]
    assert with_detector.boxes == Perceiver("pointseg", **options)(points).boxes  # type: ignore[arg-type]


def test_the_command_line(models: dict[str, Path], points: NDArray[np.float32], tmp_path: Path, shell: Shell) -> None:
    shown = shell.out("info", models["anchors"])
    for text in ("pillars: x 0..25.6 m", "anchors: Car as car", "1.73 m above", "boxes in its range"):
        assert text in shown
    points.tofile(tmp_path / "scan.bin")
    words = (tmp_path / "scan.bin", "--model", models["anchors"], "--provider", "cpu", "--anyway")
    (document,) = shell.records("run", *words, "--png", "--out", tmp_path / "out")
    assert [*(tmp_path / "out").glob("*.png")]
    assert document["boxes"]
    assert re.search(rf"{len(points):,} points  [\d.]+ ms  boxes: \d+ ", shell.out("run", *words))
    assert {box["label"] for box in document["boxes"]} <= {*KINDS}


MISMATCHES = {
    "inputs .'points', .*the graph has .'voxels'": {"input": {"name": "points"}},
    r"'voxels' is tensor\(float\) of shape .*8, 4.*declares .*\(None, 5, 4\)": {"view": {"max_points": 5}},
    r"'cls_preds' is .*32, 32, 18.*declares .*16, 16, 18": {"head": {"stride": 4}},
    r"'cls_preds' is .*32, 32, 18.*declares .*18, 32, 32": {"head": {"channels_last": False}},
    r"'box_preds' is .*42.*declares .*54": {"head": {"box_values": 9}},
    "names output 'boxes', the graph has": {
        "outputs": (*card_of("anchors").outputs[:1], OutputSpec("boxes", "box_preds"))
    },
}


@pytest.mark.parametrize("message", MISMATCHES)
def test_a_graph_that_does_not_fit_its_card(message: str, models: dict[str, Path], tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    card = replace(ModelCard.read(models["anchors"]), golden=None)
    for name, change in MISMATCHES[message].items():
        part = getattr(card, name)
        card = replace(card, **{name: replace(part, **change) if isinstance(change, dict) else change})
    model = onnx.load(models["anchors"])
    (entry,) = [entry for entry in model.metadata_props if entry.key == "edgeperc.card"]
    entry.value = card.to_json()
    path = tmp_path / "wrong.onnx"
    onnx.save(model, path)
    with pytest.raises(CardMismatchError, match=message):
        Session(path, "cpu")


def test_a_fixed_number_of_pillars_is_that_of_the_card(trained: dict[str, PillarNet], tmp_path: Path) -> None:
    with pytest.raises(CardMismatchError, match=r"takes 100 pillars, its card declares view\.max_pillars 4000"):
        networks.exported(trained["anchors"], tmp_path / "static.onnx", n_pillars=100)


def test_sizes_by_constants_need_the_cpu_provider(models: dict[str, Path]) -> None:
    """The scatter's canvas is one; `Session` asks before any provider opens the file."""
    from edgeperc.inference.providers import available_providers

    other = [name for name in available_providers() if name not in ("cpu", "cuda")]
    for provider in other:
        with pytest.raises(ProviderError, match="sizes from constants alone"):
            Session(models["anchors"], provider)
    assert Session(models["anchors"], "cpu").golden_deviation < 1e-3


GROUPS = replace(CENTER_HEAD, groups=(1, 2))
MAPS = {"heatmap": 3, "reg": 4, "height": 2, "dim": 6, "rot": 4, "vel": 4}


def random_maps(seed: int) -> dict[str, NDArray[np.float32]]:
    """Outputs of a center head with two groups, by kind."""
    rng = np.random.default_rng(seed)
    shape = VIEW.height // STRIDE, VIEW.width // STRIDE
    maps = {kind: rng.normal(0.0, 0.5, (n, *shape)).astype(np.float32) for kind, n in MAPS.items()}
    maps["heatmap"] -= 1.5
    return maps


def decoded(outputs: dict[str, tuple[str, NDArray[np.float32]]], head: CenterHead = GROUPS) -> list[Box]:
    specs = tuple(OutputSpec(name, kind) for name, (kind, _) in outputs.items())
    card = replace(card_of("centers"), outputs=specs, head=head)
    return decode_detections(card, {name: values for name, (_, values) in outputs.items()}, 0.4)[0]


@pytest.mark.parametrize("seed", range(3))
def test_groups_of_classes_come_in_one_output_or_several(seed: int) -> None:
    """Of mmdet3d: all groups' channels one after the other, or reg, height, dim and vel of each group in one output."""
    maps = random_maps(seed)
    one = decoded({kind: (kind, values) for kind, values in maps.items()})
    assert {box.label for box in one} == {*KINDS}
    each: dict[str, tuple[str, NDArray[np.float32]]] = {}
    joined: list[NDArray[np.float32]] = []
    for group in range(2):
        for kind in ("reg", "height", "dim", "vel", "rot"):
            n = MAPS[kind] // 2
            each[f"{kind}{group}"] = (kind, maps[kind][group * n : group * n + n])
            joined += [maps[kind][group * n : group * n + n]] if kind != "rot" else []
    each |= {"heatmap0": ("heatmap", maps["heatmap"][:1]), "heatmap1": ("heatmap", maps["heatmap"][1:])}
    assert decoded(each) == one
    boxes = np.concatenate(joined)
    heat, turns = ("heatmap", maps["heatmap"]), ("rot", maps["rot"])
    assert decoded({"cls_score": heat, "bbox_pred": ("reg_height_dim_vel", boxes), "dir_cls_pred": turns}) == one


@pytest.mark.parametrize("seed", range(3))
def test_order_of_sine_and_cosine_and_probabilities(seed: int) -> None:
    maps = random_maps(seed)
    one = decoded({kind: (kind, values) for kind, values in maps.items()})
    other = {**maps, "rot": maps["rot"].reshape(2, 2, *maps["rot"].shape[1:])[:, ::-1].reshape(maps["rot"].shape)}
    turned_head = replace(GROUPS, rotation="cos_sin")
    assert decoded({kind: (kind, values) for kind, values in other.items()}, turned_head) == one
    likely = {**maps, "heatmap": (1.0 / (1.0 + np.exp(-maps["heatmap"].astype(np.float64)))).astype(np.float32)}
    found = decoded({kind: (kind, values) for kind, values in likely.items()}, replace(GROUPS, scores="probabilities"))
    assert [box.center for box in found] == [box.center for box in one]
    assert [box.score for box in found] == pytest.approx([box.score for box in one], abs=1e-6)


def test_logits_that_a_card_calls_probabilities_are_refused() -> None:
    """They were clipped: each above 1 was a box with a score of 1."""
    maps = random_maps(0)
    with pytest.raises(InferenceError, match=r"best scores of the head's positions are -.* has head\.scores logits"):
        decoded({kind: (kind, values) for kind, values in maps.items()}, replace(GROUPS, scores="probabilities"))


@pytest.mark.parametrize("kind", HEADS)
def test_probabilities_that_a_card_calls_logits_are_refused(
    kind: str, trained: dict[str, PillarNet], tmp_path: Path
) -> None:
    """Each position of the map was a box with a score from 0.5 to 0.73."""
    network = networks.with_sigmoid(trained[kind])
    path, card = networks.exported(network, tmp_path / "sigmoid.onnx"), card_of(kind)
    with pytest.raises(InferenceError, match=r"positions are .* expected logits.* has head\.scores probabilities"):
        perceived(path, simulated_scan(0).points)
    likely = replace(card, head=replace(card.head, scores="probabilities"))
    assert perceived(networks.exported(network, path, likely), simulated_scan(0).points).boxes


def test_a_scan_with_more_pillars_than_its_card_has(
    trained: dict[str, PillarNet], points: NDArray[np.float32], tmp_path: Path
) -> None:
    """The rest of the scan was not seen, and nothing said so."""
    card = replace(card_of("anchors"), view=replace(VIEW, max_pillars=200))
    path = networks.exported(trained["anchors"], tmp_path / "few.onnx", card)
    perceive = Perceiver(path, provider="cpu", n_threads=1, mounting=MODEL_MOUNTING, on_mismatch="ignore")
    with pytest.warns(UserWarning, match=r"does not see [\d,]+ points .*beyond the first 200, view\.max_pillars"):
        perceive(points)
    perceive(points)  # said once


@pytest.mark.parametrize("seed", range(3))
def test_boxes_of_a_group_do_not_overlap(seed: int) -> None:
    """Whatever their classes, as in OpenPCDet and mmdetection3d; those of two groups may."""
    maps = random_maps(seed)
    found = decoded({kind: (kind, values) for kind, values in maps.items()})
    groups = [[box for box in found if box.label in kinds] for kinds in (KINDS[:1], KINDS[1:])]
    for boxes in groups:
        assert len(boxes) > 5
        assert twins.decode.nms(rectangles(boxes), card_of("centers").nms_iou).all()
    assert not twins.decode.nms(rectangles([*groups[0], *groups[1]]), card_of("centers").nms_iou).all()


@pytest.mark.parametrize("n_groups", [1, 6, 64])
def test_a_golden_record_of_an_output_for_each_part_and_group(n_groups: int) -> None:
    """OpenPCDet's CenterPoint for nuScenes has 36 outputs."""
    known = {"sha256": "0" * 64, "std": 1.0, "positions": [*range(16)], "values": [0.0] * 16}
    outputs = {f"{kind}{k}": known for kind in MAPS for k in range(n_groups)}
    assert len(Golden(0, "0" * 64, outputs).outputs) == 6 * n_groups


def anchored(
    bins: list[float] | None, yaw: float, across_classes: bool = False, iou: float = 0.1, **of_anchor: Any
) -> list[Box]:
    """The boxes of one position: cars of the two anchors there, and a pedestrian at the same place."""
    anchors = (Anchor((3.9, 1.6, 1.56), -1.78, (0.0, 1.57), **of_anchor), Anchor((3.9, 1.6, 1.73), -1.6, (0.0,)))
    head = replace(
        networks.ANCHOR_HEAD,
        classes=("Car", "Pedestrian"),
        anchors=anchors,
        channels_last=False,
        across_classes=across_classes,
    )
    names = ("cls_preds", "box_preds", *(["dir_cls_preds"] if bins else []))
    card = replace(
        card_of("anchors"),
        head=head,
        box_classes=("car", "pedestrian"),
        outputs=tuple(OutputSpec(name, name) for name in names),
        nms_iou=iou,
    )
    maps = {spec.name: np.zeros(card.shape_of(spec)[1:], np.float32) for spec in card.outputs}  # type: ignore[arg-type]
    maps["cls_preds"][:] = -9.0
    maps["cls_preds"][[0, 2, 5], 20, 20] = 3.0, 1.0, 2.0
    maps["box_preds"][[6, 13, 20], 20, 20] = yaw
    if bins:
        maps["dir_cls_preds"][:, 20, 20] = np.tile(bins, 3)
    return decode_detections(card, maps, 0.1)[0]


@pytest.mark.parametrize("yaw", [-1.5, -0.3, 0.0, 0.5, 1.2])
def test_bins_of_directions_choose_the_half_turn(yaw: float) -> None:
    """The first bin has yaws from the offset on, the second those of the other half."""
    first, second = anchored([2.0, 0.0], yaw)[0], anchored([0.0, 2.0], yaw)[0]
    assert math.cos(first.yaw - second.yaw) == pytest.approx(-1.0)
    assert 0.0 <= (first.yaw - 0.78539) % (2.0 * math.pi) < math.pi
    assert abs(math.sin(first.yaw - yaw)) < 1e-6
    assert first.front == pytest.approx(1.0 / (1.0 + math.exp(-2.0)))
    without = anchored(None, yaw)[0]
    assert without.front is None
    assert without.yaw == pytest.approx(yaw)


def test_anchors_may_stand_within_other_bounds_than_the_pillars() -> None:
    """As mmdetection3d's of nuScenes, whose outermost were 0.4 m off; row and column are 20 of 0 to 31."""
    box = anchored(None, 0.0, range_m=(1.0, -10.0, 25.0, 6.0))[0]
    assert box.center == pytest.approx((1.0 + 24.0 * 20 / 31, -10.0 + 16.0 * 20 / 31, -1.0))


def test_overlaps_are_dropped_within_a_class_or_across() -> None:
    assert [box.label for box in anchored([0.0, 0.0], 0.0)] == ["car", "pedestrian"]
    assert [box.label for box in anchored([0.0, 0.0], 0.0, across_classes=True)] == ["car"]
    assert [box.label for box in anchored([0.0, 0.0], 0.0, iou=0.9)] == ["car", "pedestrian", "car"]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_outputs_that_are_not_finite(value: float) -> None:
    for kind in ("heatmap", "dim", "rot"):
        maps = random_maps(0)
        maps[kind][0, 3, 3] = value
        with pytest.raises(InferenceError, match=rf"1 of \d+ values of {kind} are not finite"):
            decoded({name: (name, values) for name, values in maps.items()})


@pytest.mark.parametrize("size", [-90.0, 90.0, 0.0])
def test_sizes_and_places_have_bounds(size: float) -> None:
    """What no tracker takes: boxes of no or endless size, and centers far out of the view."""
    maps = random_maps(0)
    maps["dim"][:] = size
    maps["reg"][:, :20] = 1e9
    found = decoded({kind: (kind, values) for kind, values in maps.items()})
    assert found
    for box in found:
        assert all(0.2 - 1e-9 <= side <= 40.0 + 1e-9 for side in box.size)
        assert box.center[1] <= VIEW.y_range_m[1] + 5.0
