"""int8 models: layers whose rounding is harmless are rounded; slower or less accurate models are refused."""

from __future__ import annotations

import json
import shlex
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")

import tiny_model
from pillar_networks import card_of
from torch import Tensor, nn

from cli_helpers import Shell
from edgeperc.datasets.kitti import KittiObjects
from edgeperc.datasets.splits import in_split
from edgeperc.errors import ModelError, PointsError, SplitError
from edgeperc.evaluation.metrics import Confusion
from edgeperc.evaluation.tables import Record
from edgeperc.inference.session import Session
from edgeperc.simulation.samples import simulated_scan
from edgeperc.simulation.scene import POINT_CLASSES
from edgeperc.types.card import InputSpec, ModelCard, OutputSpec
from edgeperc.types.views import RangeImageGeometry
from edgeperc.zoo import model_path
from edgeperc_export.data.scans import LabeledScan
from edgeperc_export.release import quantize as module
from edgeperc_export.release.agree import agree
from edgeperc_export.release.quantize import (
    Calibration,
    LabeledSets,
    RefusedError,
    calibration_scans,
    check_fp32,
    quantize,
)
from edgeperc_export.release.to_onnx import sets_of, to_graph, with_golden, write_card
from edgeperc_export.release.triton import write_repository


class Fragile(nn.Module):
    """Labels everything as car, by an activation of 1 among values of 10,000 and more, which int8 rounds to 0."""

    def __init__(self, spoil: float) -> None:
        super().__init__()
        torch.manual_seed(0)  # from some starts, rounding harms the good layer, too
        self.first, self.good, self.spoil = nn.Conv2d(5, 8, 3, padding=1), nn.Conv2d(8, 8, 1), nn.Conv2d(8, 8, 1)
        self.last = nn.Conv2d(8, 4, 1)
        with torch.no_grad():
            for layer in (self.good, self.spoil):
                layer.weight[:] = torch.eye(8)[:, :, None, None]
                layer.bias[:] = 0.0
            self.first.bias[0] = 1.0
            self.first.weight[0] = 0.0
            self.spoil.weight[1, 1] = spoil
            self.last.weight[:] = 0.0
            self.last.weight[1, 0] = 1.0
            self.last.bias[:] = torch.tensor([0.5, 0.0, 0.0, 0.0])

    def forward(self, x: Tensor) -> Tensor:
        x = self.first(x).relu()
        x = self.spoil(self.good(x).relu()).relu()
        return self.last(x)


class Small(nn.Module):
    """The parts of networks for small computers: residual blocks, upsampling, channels moved to pixels."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Conv2d(5, 16, 3, stride=2, padding=1)
        self.down, self.context = nn.Conv2d(16, 16, 3, stride=2, padding=1), nn.Conv2d(16, 16, 3, padding=1)
        self.merge, self.last = nn.Conv2d(16, 16, 3, padding=1), nn.Conv2d(16, 16, 1)

    def forward(self, x: Tensor) -> Tensor:
        x = self.stem(x).relu()
        low = self.down(x).relu()
        low = (low + self.context(low)).relu()
        x = self.merge((x + nn.functional.interpolate(low, size=x.shape[-2:], mode="nearest")).relu()).relu()
        return nn.functional.pixel_shuffle(self.last(x), 2)


@pytest.fixture(scope="module")
def scans() -> list[np.ndarray]:
    return [simulated_scan(10**9 + k).points for k in range(2)]


def written(network: nn.Module, path: Path) -> Path:
    card = ModelCard(
        name="small",
        version="1.0.0",
        view=RangeImageGeometry(tuple(np.linspace(2.0, -24.0, 16)), width=128),
        input=InputSpec("image", ("x", "y", "z", "remission", "range"), (0.0,) * 5, (10.0, 10.0, 2.0, 1.0, 10.0)),
        outputs=(OutputSpec("logits", "class_logits"),),
        classes=POINT_CLASSES,
        training={"licence": "Apache-2.0", "frames": {"known": "0123456789abcdef"}},
    )
    model = to_graph(network.eval(), card)
    write_card(model, with_golden(model, card), path)
    return path


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(2)
    return written(Small(), tmp_path_factory.mktemp("small") / "small.onnx")


def timed(fp32_ms: float, int8_ms: float) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    def race(one: Path, other: Path, n_threads: int | None) -> tuple[np.ndarray, np.ndarray]:
        Session(one), Session(other)
        noise = np.random.default_rng(0).normal(0.0, 0.1, (2, 40))
        return fp32_ms + noise[0], int8_ms + noise[1]

    return race


ONE = LabeledSets(n_simulated=1)
FASTER = timed(10.0, 5.0)


def convolutions(path: Path) -> dict[str, int]:
    """The type of every convolution's weight, by the weight's name in fp32."""
    graph = onnx.load(path).graph
    types = {weight.name: weight.data_type for weight in graph.initializer}
    types |= {
        n.output[0]: types[n.input[0]] for n in graph.node if n.op_type == "DequantizeLinear" and n.input[0] in types
    }
    types |= {n.output[0]: onnx.TensorProto.FLOAT for n in graph.node if n.op_type == "Cast" and n.input[0] in types}
    return {n.input[1].split(".")[0]: types[n.input[1]] for n in graph.node if n.op_type == "Conv"}


def test_inner_layers_become_int8_and_the_card_says_so(tmp_path: Path, small: Path, scans: list[np.ndarray]) -> None:
    out = tmp_path / "small-int8.onnx"
    before = Session(small).card
    card = quantize(small, out, Calibration(scans, {"mine/1": "f" * 16}), ONE, max_noise=9.0, race=FASTER)
    int8, fp32 = onnx.TensorProto.INT8, onnx.TensorProto.FLOAT
    assert convolutions(out) == {"stem": fp32, "down": int8, "context": int8, "merge": int8, "last": fp32}
    nodes = onnx.load(out).graph.node
    zeros = {w.name: w.data_type for w in onnx.load(out).graph.initializer}
    assert {zeros[n.input[2]] for n in nodes if n.op_type == "QuantizeLinear"} == {onnx.TensorProto.UINT8}

    session = Session(out, "cpu")
    assert session.description == "small int8, CPUExecutionProvider"
    assert session.card.to_json() == card.to_json()
    assert (card.name, card.version, card.view, card.outputs) == ("small", "1.0.0", before.view, before.outputs)
    assert (card.precision, card.precisions) == ("int8", {})
    assert session.golden_deviation == 0.0
    assert card.golden != before.golden
    assert card.training["licence"] == "Apache-2.0; mine: terms of that set"
    assert set(card.training["frames"].values()) == {"f" * 16, "0123456789abcdef"}
    assert len(card.training["quantized"]["left_alone"]) == 2
    assert card.training["quantized"]["noise"] == pytest.approx(noise_of(small, scans))
    assert (largest_weight(out), card.training["quantized"]["weight_bits"]) == (64, 7)
    with pytest.raises(ModelError, match="quantize the model in fp32"):
        quantize(out, out, Calibration(scans), LabeledSets())
    assert card.parity["label_agreement"] > 0.9
    assert card.metrics["simulated"]["n_frames"] == 1
    assert [p.name for p in tmp_path.iterdir()] == ["small-int8.onnx"]


def noise_of(path: Path, scans: list[np.ndarray]) -> float:
    """The noise of a model whose inner layers are all rounded, with nothing corrected."""
    fp32 = module.Calibrated.on(path, Session(path).card, scans)
    return float(fp32.noise(module.find_candidates(fp32.model.graph, ())))


def largest_weight(path: Path) -> int:
    weights = [onnx.numpy_helper.to_array(w) for w in onnx.load(path).graph.initializer]
    return max(int(abs(w.astype(int)).max()) for w in weights if w.dtype == np.int8)


def test_on_request_weights_have_eight_bits_and_nodes_stay_in_fp32(
    tmp_path: Path, small: Path, scans: list[np.ndarray]
) -> None:
    out, options = tmp_path / "int8.onnx", {"max_noise": 9.0, "race": FASTER}
    name = next(n.name for n in onnx.load(small).graph.node if "down.weight" in n.input)
    card = quantize(small, out, Calibration(scans), ONE, exclude=[name], seven_bits=False, **options)  # type: ignore[arg-type]
    assert (largest_weight(out), card.training["quantized"]["weight_bits"]) == (127, 8)
    assert convolutions(out)["down"] == onnx.TensorProto.FLOAT
    with pytest.raises(ValueError, match="no node is called nothing"):
        quantize(small, out, Calibration(scans), LabeledSets(), exclude=["nothing"], race=FASTER)


@pytest.mark.parametrize("name", ["objects", "objects-open", "pointseg", "sceneseg", "ssadnet", "ssadnet-open"])
def test_no_processor_saturates_the_shipped_models(name: str) -> None:
    """Two products of 8-bit activations and 7-bit weights have a sum of at most 16 bits."""
    path = model_path(f"{name}:int8")
    assert 2 * 255 * largest_weight(path) < 2**15
    card = ModelCard.read(path)
    assert card.training["quantized"]["weight_bits"] == 7
    assert [record["weight_bits"] for record in card.precisions.values()] in ([7], [])  # open models have no record


@pytest.mark.parametrize("equalized", [False, True])
def test_layers_that_rounding_harms_stay_in_fp32(
    tmp_path: Path, scans: list[np.ndarray], monkeypatch: pytest.MonkeyPatch, equalized: bool
) -> None:
    """Unless equalized channels make the layer harmless."""
    if not equalized:
        monkeypatch.setattr(module, "STRENGTHS", (None,))
    path, out = written(Fragile(1e4), tmp_path / "spoilt.onnx"), tmp_path / "int8.onnx"
    card = quantize(path, out, Calibration(scans), ONE, race=FASTER)
    types = convolutions(out)
    assert types["good"] == onnx.TensorProto.INT8
    assert types["spoil"] == (onnx.TensorProto.INT8 if equalized else onnx.TensorProto.FLOAT)
    assert card.parity["label_agreement"] == 1.0


def test_a_less_accurate_model_is_refused(tmp_path: Path, scans: list[np.ndarray]) -> None:
    path = written(Fragile(1e4), tmp_path / "spoilt.onnx")
    with pytest.raises(RefusedError, match=r"simulated car IoU 0\.\d+ to 0\.000"):
        quantize(path, tmp_path / "int8.onnx", Calibration(scans), ONE, max_noise=9.0, race=FASTER)
    assert [p.name for p in tmp_path.iterdir()] == ["spoilt.onnx"]


@pytest.mark.parametrize("int8_ms", [20.0, 10.0, 9.99])
def test_a_model_that_is_not_faster_is_refused(
    tmp_path: Path, small: Path, scans: list[np.ndarray], int8_ms: float
) -> None:
    out = tmp_path / "int8.onnx"
    out.write_bytes(b"of another day")
    with pytest.raises(RefusedError, match=rf"not faster here .* 10\.0 ms in fp32, {int8_ms:.1f} in int8"):
        quantize(small, out, Calibration(scans), LabeledSets(), max_noise=9.0, race=timed(10.0, int8_ms))
    assert out.read_bytes() == b"of another day"
    assert [p.name for p in tmp_path.iterdir()] == ["int8.onnx"]


def test_the_interval_of_a_loss_is_over_drives() -> None:
    def of(*shares: float) -> dict[str, list[Record]]:
        records = []
        for k, share in enumerate(shares):
            counted = Confusion(("background", "car"))
            counted.update((np.arange(100) < 100 * share).astype(np.uint8), np.ones(100, np.uint8))
            records.append(
                Record(f"{k}", f"drive {k // 2}", {("points", "all"): counted, ("objects", "all"): Counter()})
            )
        return {"real": records}

    right = of(*[1.0] * 12)
    one_drive = module.losses_of(right, of(*[1.0] * 11, 0.4))["real car IoU"]
    assert one_drive[:2] == pytest.approx((1.0, 0.95))
    assert one_drive[2] == 0.0 < one_drive[3]
    every_drive = module.losses_of(right, of(*[0.8] * 12))["real car IoU"]
    assert every_drive == pytest.approx((1.0, 0.8, 0.2, 0.2))
    alone = module.losses_of(of(1.0, 1.0), of(0.9, 0.9))["real car IoU"]
    assert alone == pytest.approx((1.0, 0.9, 0.1, 0.1))


def test_a_range_clips_what_costs_less_than_it_saves() -> None:
    values = np.abs(np.random.default_rng(0).normal(0.0, 1.0, 100_000)).astype(np.float32)
    values[0] = 1000.0

    def range_of(values: np.ndarray) -> tuple[float, float]:
        bins = values.view(np.uint32) >> (32 - module.BIN_BITS)
        return module.range_of(np.bincount(bins, minlength=1 << module.BIN_BITS))

    low, high = range_of(values[1:])
    assert low == 0.0
    assert 3.0 < high < 5.0
    assert range_of(values)[1] > 500.0  # a single value of a million squares is no outlier to clip
    assert range_of(-values[1:])[1] == 0.0
    assert range_of(np.zeros(9, np.float32)) == (0.0, 0.0)


def test_the_race_runs_both_models_equally_often(small: Path) -> None:
    one, other = module.race(small, small, 1, n_runs=3)
    assert one.shape == other.shape == (3,)
    assert (one > 0).all()
    assert (other > 0).all()


def test_no_layer_in_int8_is_said(tmp_path: Path, small: Path, scans: list[np.ndarray]) -> None:
    inner = [n.name for n in onnx.load(small).graph.node if n.op_type == "Conv"]
    quietest = r"no layer became int8: .* of 3 layers alone, \S+, makes noise of \d.*limit"
    for options, message in (
        ({"max_noise": 0.0}, quietest),
        ({"max_noise": -1.0}, quietest),
        ({"exclude": inner}, r"no layer became int8: .* those of --exclude stay in fp32"),
    ):
        with pytest.raises(RefusedError, match=message):
            quantize(small, tmp_path / "int8.onnx", Calibration(scans), ONE, race=FASTER, **options)  # type: ignore[arg-type]


def test_unpooling_is_not_rounded_on_one_side(tmp_path: Path, scans: list[np.ndarray]) -> None:
    class Unpooling(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.first, self.inner, self.last = (nn.Conv2d(c, d, 1) for c, d in ((5, 8), (8, 8), (8, 4)))

        def forward(self, x: Tensor) -> Tensor:
            x = nn.functional.elu(self.first(x))
            pooled = nn.functional.max_pool2d(x, 2)
            mask = x == nn.functional.interpolate(pooled, scale_factor=2, mode="nearest")
            inner = nn.functional.interpolate(self.inner(pooled), scale_factor=2, mode="nearest")
            return self.last(inner * mask)

    torch.manual_seed(0)
    path = written(Unpooling(), tmp_path / "unpooling.onnx")
    fp32 = module.Calibrated.on(path, Session(path).card, scans)
    assert fp32.noise([n.name for n in fp32.model.graph.node if "inner.weight" in n.input]) < 0.1


def test_no_scans_is_an_error(tmp_path: Path, small: Path, shell: Shell) -> None:
    with pytest.raises(PointsError, match="no scan to calibrate on"):
        calibration_scans([])
    (tmp_path / "empty").mkdir()
    words = ["quantize", str(small), str(tmp_path / "o.onnx"), "--scans", str(tmp_path / "empty")]
    assert "no scan to calibrate on in " in shell.err(*words)
    with pytest.raises(PointsError, match="expected at least one"):
        quantize(small, tmp_path / "o.onnx", Calibration([]), LabeledSets())


def test_calibration_never_sees_test_drives(tmp_path: Path, scans: list[np.ndarray]) -> None:
    raw = tmp_path / "2011_09_26_drive_0011_sync/velodyne_points/data/0000000000.bin"
    objects = tmp_path / "objects/training/velodyne/000007.bin"
    sequence = tmp_path / "sequences/00/velodyne/000000.bin"
    training = tmp_path / "2011_09_26_drive_0005_sync/velodyne_points/data/0000000000.bin"
    nowhere = tmp_path / "own/0.bin"
    for file in (raw, objects, sequence, training, nowhere):
        file.parent.mkdir(parents=True)
        scans[0].tofile(file)
    labels = tmp_path / "objects/training/label_2"
    labels.mkdir()
    (labels / "000007.txt").touch()
    (tmp_path / "objects/frames.csv").write_text("name,drive\n000007,2011_09_26_drive_0015\n")
    for file, drive in ((raw, "26_drive_0011"), (objects, "26_drive_0015"), (sequence, "03_drive_0027")):
        with pytest.raises(SplitError, match=f"is of drive .*{drive}"):
            calibration_scans([file])
        with pytest.raises(SplitError, match=f"is of drive .*{drive}"):
            calibration_scans([file.parents[2]], n_simulated=1)
    found, frames = calibration_scans([training, nowhere.parent])
    assert [len(points) for points in found] == [len(scans[0])] * 2
    assert sets_of(frames) == {"KITTI", "scans to calibrate on"}


def test_images_to_calibrate_on_are_spread_over_the_whole_set(monkeypatch: pytest.MonkeyPatch) -> None:
    files = [Path(f"{k}.png") for k in range(100)]
    images = SimpleNamespace(files=lambda split: files, read=lambda file: (np.array([int(file.stem)]), None))
    monkeypatch.setattr(module, "LabeledImages", lambda root: images)
    found = np.concatenate(module.calibration_images(Path("camvid")).scans)
    assert len(found) == 64
    assert (found[0], found[32], found[63]) == (0, 50, 98)  # the last third was left out


def test_calibration_on_kitti_takes_only_training_drives(kitti_root: Path) -> None:
    objects = KittiObjects(kitti_root)
    names = [name for name, drive in objects.drives.items() if not in_split(drive, "train")]
    test = {module.scan_hash(objects.frame(name).points) for name in objects.names("test") if name in names}
    found, frames = calibration_scans(kitti=kitti_root)
    assert 0 < len(found) == len(frames) <= 64
    assert sets_of(frames) == {"KITTI"}
    assert test
    assert not test & {*frames.values()}


def test_what_is_for_sparse_sensors_is_calibrated_on_their_scans() -> None:
    dense, sparse = (calibration_scans(n_simulated=3, sparse=sparse).scans for sparse in (False, True))
    for scan, thinned in zip(dense, sparse, strict=True):
        assert isinstance(thinned, LabeledScan)
        assert thinned.sensor is not None
        assert thinned.sensor.median_gap_deg >= 0.9
        assert 0 < len(thinned.points) < 0.7 * len(scan)  # type: ignore[arg-type]


def test_the_command_exits_with_1_if_it_refuses_and_0_if_it_writes(
    tmp_path: Path, small: Path, scans: list[np.ndarray], monkeypatch: pytest.MonkeyPatch, shell: Shell
) -> None:
    out, scan = tmp_path / "its int8.onnx", tmp_path / "scan.bin"
    scans[0].tofile(scan)
    arguments = ["quantize", str(small), str(out), "--scans", str(scan), "--simulated", "2", "--evaluate-on", "1"]
    monkeypatch.setattr(module.quantize, "__kwdefaults__", {**quantize.__kwdefaults__, "race": timed(5.0, 5.0)})
    assert "not faster here" in shell.err(*arguments, code=1)
    assert not out.exists()
    settings = {**quantize.__kwdefaults__, "race": FASTER, "max_noise": 9.0}
    monkeypatch.setattr(module.quantize, "__kwdefaults__", settings)
    printed = shell.out(*arguments).splitlines()
    assert "small 1.0.0, kept in fp32: " in printed[0]
    assert json.loads(printed[1])["n_scans"] == 4
    next_command = printed[2].partition(" by: ")[2]
    assert shlex.split(next_command) == ["edgeperc-export", "agree", str(small), str(out), "--labeled", "FOLDER"]


def test_the_mean_of_every_channel_is_that_of_fp32(small: Path, scans: list[np.ndarray]) -> None:
    card = Session(small).card
    shifts = {}
    for strength in (None, 0.0, 1.0):
        fp32 = module.Calibrated.on(small, card, scans, strength=strength)
        candidates = module.find_candidates(fp32.model.graph, ())
        rounded = fp32.rounded(candidates)
        made = {n.name: n.output[0] for n in rounded.graph.node if n.name in candidates}
        means = module.channel_means(rounded, card, fp32.images, [*made.values()])
        right = {n.name: n.output[0] for n in fp32.model.graph.node if n.name in candidates}
        expected = module.channel_means(fp32.model, card, fp32.images, [*right.values()])
        own = {name: expected[output] for name, output in right.items()}
        shifts[strength] = max(abs(means[made[name]] - own[name]).max() / own[name].std() for name in candidates)
    assert shifts[0.0] < 0.2 * shifts[None]
    assert shifts[1.0] < 0.2 * shifts[None]


def test_the_shift_is_corrected_where_the_noise_is_above_the_limit(
    tmp_path: Path, small: Path, scans: list[np.ndarray]
) -> None:
    limit, out = 0.99 * noise_of(small, scans), tmp_path / "int8.onnx"
    card = quantize(small, out, Calibration(scans), ONE, max_noise=limit, race=FASTER)
    assert card.training["quantized"]["noise"] <= limit
    assert len(card.training["quantized"]["left_alone"]) == 2  # nothing was left out


def test_networks_of_pillars_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    path, card = tmp_path / "anchors.onnx", card_of("anchors")
    path.write_bytes(tiny_model.model(tiny_model.graph(), card=card))
    with pytest.raises(ModelError, match="of pillars"):
        check_fp32(path, card)
    with pytest.raises(ModelError, match="of pillars"):
        agree([path], kitti=None)
    with pytest.raises(ModelError, match="of pillars"):
        write_repository(tmp_path / "models", [path])
    assert [*tmp_path.iterdir()] == [path]
