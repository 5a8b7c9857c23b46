"""Agreement of reduced precisions with fp32: measured after post-processing, and written into the cards."""

from __future__ import annotations

import importlib.util
import itertools
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")

from edgeperc.datasets.kitti import KittiObjects
from edgeperc.datasets.layout import ScanLayout
from edgeperc.datasets.scan_folder import ScanFolder
from edgeperc.errors import CardMismatchError, ModelError, PointsError, SplitError
from edgeperc.inference.session import Session
from edgeperc.system.machine import cpu_features
from edgeperc.types.card import ModelCard
from edgeperc.types.sensor import get_sensor
from edgeperc.zoo import BF16_FEATURES, model_path, resolve
from edgeperc_export.release import agree as module
from edgeperc_export.release.agree import agree, summary
from edgeperc_export.release.to_onnx import write_card


def measured(labels: list[int], mean_iou: float, ap: float | None) -> module.Measured:
    return module.Measured([np.array(labels, np.uint8)], mean_iou, ap, "an engine")


@pytest.mark.parametrize(
    ("mean_iou", "ap", "loss"),
    [(0.8, 0.6, 0.0), (0.79, 0.6, 1.0), (0.9, 0.58, 2.0), (0.79, 0.58, 2.0), (0.9, 0.7, 0.0)],
)
def test_the_loss_is_the_larger_one_of_iou_and_ap_in_points(mean_iou: float, ap: float, loss: float) -> None:
    record = module.record_of(measured([0, 1, 2, 3], mean_iou, ap), measured([0, 1, 2, 2], 0.8, 0.6), "a command")
    assert record["loss"] == pytest.approx(loss)
    assert (record["label_agreement"], record["n_scans"]) == (0.75, 1)
    assert (record["mean_iou"], record["fp32_mean_iou"], record["ap"], record["fp32_ap"]) == (mean_iou, 0.8, ap, 0.6)
    assert summary({"int8": record})[0].startswith("int8: labels agree on 75.000%")


def test_what_is_not_measured_has_no_figure() -> None:
    """`auto` took a model of which no accuracy was measured: the larger one of 0 and NaN is 0."""
    record = module.record_of(measured([0], 0.5, None), measured([0], 0.6, None), "a command")  # without boxes
    assert (record["loss"], record["ap"], record["fp32_ap"]) == (10.0, None, None)
    assert "AP" not in summary({"int8": record})[0]
    for own in (measured([0], np.nan, None), measured([0], 0.5, np.nan)):
        with pytest.raises(PointsError, match="show no class of the network"):
            module.record_of(own, own, "a command")


def test_files_must_be_of_one_network_and_one_in_fp32(tmp_path: Path) -> None:
    for models in (["pointseg:fp32", "ssadnet:int8"], ["pointseg:int8"]):
        with pytest.raises(ModelError, match="expected files of one network, one of them in fp32"):
            agree(models, kitti=None)
    path = Path(shutil.copy(model_path("pointseg"), tmp_path))
    with pytest.raises(PointsError, match="drives: no data set was named; name a KITTI object set"):
        agree([path], kitti=None)
    (tmp_path / "training/label_2").mkdir(parents=True)
    (tmp_path / "training/label_2/000000.txt").touch()  # of a drive of its own, for training and testing
    for model in (path, "objects:fp32"):
        with pytest.raises(PointsError, match="no scans of the validation drives"):
            agree([model], kitti=tmp_path)
    assert path.read_bytes() == model_path("pointseg").read_bytes()


def test_classes_that_no_label_shows_are_not_called_accurate(tmp_path: Path) -> None:
    path, card = tmp_path / "own.onnx", ModelCard.read(model_path("pointseg"))
    classes = ("background", "car", "pedestrian", "motorcycle")
    write_card(onnx.load(model_path("pointseg")), replace(card, classes=classes, golden=None), path)
    with pytest.raises(ModelError, match="classes that no labels of KITTI show: motorcycle"):
        agree([path], kitti=tmp_path)


def test_images_have_the_classes_of_the_model_in_its_order(tmp_path: Path) -> None:
    card = ModelCard.read(model_path("camseg"))
    (tmp_path / "val").mkdir()
    (tmp_path / "valannot").mkdir()
    (tmp_path / "classes.json").write_text(json.dumps(dict(enumerate(card.classes[::-1]))))
    with pytest.raises(CardMismatchError, match="camseg has classes"):
        agree(["camseg"], kitti=None, camvid=tmp_path)


def test_every_precision_is_measured_and_recorded(kitti_root: Path, tmp_path: Path) -> None:
    paths = [tmp_path / "a.onnx", tmp_path / "b.onnx"]  # the names of the files have no effect
    for variant, path in zip(resolve("pointseg"), paths, strict=True):
        shutil.copy(variant.path, path)
    has_bf16 = importlib.util.find_spec("openvino") is not None and not BF16_FEATURES.isdisjoint(cpu_features())
    records = agree(paths, kitti=kitti_root, split="test", n_scans=2)
    assert set(records) == {"fp32", "int8"} | ({"bf16"} if has_bf16 else set())
    assert (records["fp32"]["label_agreement"], records["fp32"]["loss"]) == (1.0, 0.0)
    for record in records.values():
        assert record["label_agreement"] > 0.99
        assert record["n_scans"] == 2
        assert record["command"] == "edgeperc-export agree pointseg --kitti KITTI --split test --scans 2"
    fp32, int8 = (Session(path, "cpu").card for path in paths)
    assert fp32.precisions == {precision: records[precision] for precision in records if precision != "int8"}
    assert int8.precisions == {"int8": records["int8"]}
    names = KittiObjects(kitti_root).names("test")[:2]
    boxes = {"Car": "car", "Pedestrian": "pedestrian", "Cyclist": "cyclist", "*": "ignore"}
    splits = {"test": tuple(names), "train": ("*",)}
    layout = ScanLayout("own", get_sensor("hdl-64e"), boxes, {}, box_format="kitti", drives="scan", splits=splits)
    own = agree(paths, kitti=None, labeled=[ScanFolder(kitti_root / "training", layout)], split="test")["int8"]
    assert own["command"] == "edgeperc-export agree pointseg --labeled OWN --split test"
    assert own["n_scans"] == 2
    assert own["label_agreement"] > 0.99
    rows = itertools.cycle([{"ap": None}, {"ap": 0.6}])  # of a set without vehicles, and of another one
    with pytest.MonkeyPatch.context() as patch:
        found = {"points": {"all": {"car": {"iou": 0.5}}}}
        patch.setattr(module, "figures", lambda *_: {**found, "boxes": {"oriented": {"all": {"vehicle": next(rows)}}}})
        both = {"kitti": kitti_root, "labeled": [ScanFolder(kitti_root / "training", layout)]}
        assert agree(paths, **both, split="test", n_scans=1)["int8"]["ap"] == 0.6
    for model in ("pointseg", "pointseg-sparse", "objects"):
        with pytest.raises(SplitError, match=f"{model} .* was trained on scan"):
            agree([Path(shutil.copy(model_path(model), tmp_path))], kitti=kitti_root, split="train", n_scans=1)
    for variant, path in zip(resolve("pointseg"), paths, strict=True):
        assert onnx.load(path).graph == onnx.load(variant.path).graph
