"""The networks of a camera: structure, training samples, losses, the comparison on CamVid, export and int8."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")
Image = pytest.importorskip("PIL.Image")

import torch.nn.functional as F
from torch import nn
from training_helpers import interrupted_in_step, make, train

from cli_helpers import Shell
from edgeperc.errors import ImageError, PointsError, SplitError
from edgeperc.evaluation.camvid import evaluate_images
from edgeperc.readers.images import read_image
from edgeperc.simulation.samples import IGNORE
from edgeperc.simulation.street import CAMERA_CLASSES
from edgeperc.types.card import ModelCard
from edgeperc_export.data.simulate import parity_samples
from edgeperc_export.networks import build, segnet
from edgeperc_export.networks.camseg import CamSeg
from edgeperc_export.networks.fcn import FCN, bilinear
from edgeperc_export.networks.segnet import VGG_16, SegNet, unpool
from edgeperc_export.networks.unet import UNet
from edgeperc_export.recipe import MODELS, PAPER, Recipe
from edgeperc_export.release.agree import agree
from edgeperc_export.release.quantize import LabeledSets, calibration_images, quantize
from edgeperc_export.release.to_onnx import export, load, to_graph, verify
from edgeperc_export.training import camvid
from edgeperc_export.training import images as camvid_images
from edgeperc_export.training.camera import Camera, class_weights
from edgeperc_export.training.checkpoint import read_checkpoint
from edgeperc_export.training.images import augmented_images, camvid_samples, confusions, normalized, read_camvid
from edgeperc_export.training.losses import cross_entropy, lovasz_at_once, lovasz_softmax
from edgeperc_export.training.train import last_step

SMALL: dict[str, Any] = {"image_width": 48, "image_height": 36, "batch": 2, "steps": 4, "dropout": 0.0}


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set in CamVid's layout, drawn: 6 training and 3 validation images of 96 x 72."""
    root = tmp_path_factory.mktemp("drawn")
    rng = np.random.default_rng(0)
    for folder, n in (("train", 6), ("val", 3)):
        (root / folder).mkdir()
        (root / f"{folder}annot").mkdir()
        for k in range(n):
            labels = np.full((72, 96), 1, np.uint8)
            labels[: 20 + k], labels[45:], labels[45:50] = 0, 3, 4
            labels[40:55, 10 + 5 * k : 30 + 5 * k] = 8
            labels[0, 0] = 11
            image = 20 * labels[..., None] + np.array([0, 10, 20]) + rng.integers(0, 12, (72, 96, 3))
            name = f"{'0001TP_' if k < 2 else ''}{k:03}.png"
            Image.fromarray(image.astype(np.uint8)).save(root / folder / name)
            Image.fromarray(labels).save(root / f"{folder}annot" / name)
    names = dict(enumerate((*CAMERA_CLASSES, "Unlabeled")))
    (root / "classes.json").write_text(json.dumps(names))
    return root


@pytest.fixture
def narrow_segnet(monkeypatch: pytest.MonkeyPatch) -> None:
    """SegNet with as many layers, an eighth as wide: its 29.5 million weights take seconds to build and to write."""
    monkeypatch.setattr(segnet, "VGG_16", tuple(tuple(width // 8 for width in widths) for widths in VGG_16))


def convolutions(network: nn.Module) -> int:
    return sum(isinstance(module, nn.Conv2d | nn.ConvTranspose2d) for module in network.modules())


def weights(network: nn.Module) -> int:
    return sum(weight.numel() for weight in network.parameters())


def unet_weights(widths: list[int], n_channels: int, n_classes: int) -> int:
    """By the description: two 3 x 3 a level and path, a 2 x 2 between levels, one 1 x 1."""
    down = sum(9 * a * b + b + 9 * b * b + b for a, b in pairwise([n_channels, *widths]))
    up = sum(4 * b * a + a + 9 * (2 * a) * a + a + 9 * a * a + a for a, b in pairwise(widths))
    return down + up + widths[0] * n_classes + n_classes


@pytest.mark.parametrize(
    ("sizes", "widths", "layers"),
    [
        ({}, [64, 128, 256, 512, 1024], 23),  # Ronneberger et al., section 2: 23 convolutional layers
        ({"width": 16, "leaky": True}, [16, 32, 64, 128, 256], 23),
        ({"n_levels": 7}, [64, 128, 256, 512, 1024, 1024, 1024], 33),
    ],
)
def test_unet_has_the_described_layers(sizes: dict[str, Any], widths: list[int], layers: int) -> None:
    with torch.device("meta"):  # no weights are drawn
        network = UNet(**sizes)
    assert convolutions(network) == layers
    assert weights(network) == unet_weights(widths, 3, 11)
    assert not any(isinstance(module, nn.BatchNorm2d) for module in network.modules())
    assert any(isinstance(module, nn.LeakyReLU) for module in network.modules()) == bool(sizes.get("leaky"))


def test_segnet_has_13_and_13_convolutions() -> None:
    with torch.device("meta"):
        network = SegNet()
    assert convolutions(network.encoders) == 13
    assert convolutions(network.decoders) + 1 == 13
    # Badrinarayanan et al., section 3: 14.7 million parameters in the encoder; table 6: 29.5 million in all.
    assert weights(network.encoders) / 1e6 == pytest.approx(14.7, abs=0.05)
    assert weights(network) / 1e6 == pytest.approx(29.5, abs=0.1)
    assert sum(isinstance(module, nn.BatchNorm2d) for module in network.modules()) == 25


@pytest.mark.parametrize(("stride", "n_skips"), [(16, 1), (8, 2)])
def test_fcn_has_the_layers_of_vgg_16(stride: int, n_skips: int) -> None:
    with torch.device("meta"):
        network = FCN(stride=stride)
    assert convolutions(network.blocks) == 13 == sum(map(len, VGG_16))
    assert convolutions(network.fully_connected) == 2
    assert len(network.score_skips) == len(network.upsamplings) == n_skips
    assert weights(network) / 1e6 == pytest.approx(134.0, abs=0.5)  # Long et al., table 1: 134 million


@pytest.mark.parametrize(
    ("network", "expected"),
    [
        (UNet(width=2, n_levels=7, dropout=0.7), [(32, 2, 2), (32, 1, 1)]),
        (SegNet(dropout=0.5), [(256, 8, 8), (512, 4, 4), (512, 2, 2), (512, 4, 4), (256, 8, 8), (128, 16, 16)]),
    ],
)
def test_dropout_is_where_the_docstrings_say(network: Any, expected: list[tuple[int, ...]]) -> None:
    calls: list[tuple[int, ...]] = []
    network.dropout.register_forward_hook(lambda *call: calls.append(tuple(call[2].shape[1:])))
    network(torch.zeros(2, 3, 64, 64))
    assert calls == expected


@pytest.mark.parametrize("network", [UNet(width=2), UNet(width=2, n_levels=7), SegNet(), CamSeg()])
def test_logits_have_the_size_of_the_image(network: nn.Module) -> None:
    """Also of images whose sides no pooling divides; camseg's have a quarter of it."""
    stride = 4 if isinstance(network, CamSeg) else 1
    for height, width in ((36 // stride, 48 // stride), (45 // stride, 58 // stride)):
        logits = network.eval()(torch.zeros(1, 3, stride * height, stride * width))
        assert logits.shape == (1, 11, height, width)


def test_early_logits_are_of_training_alone() -> None:
    network = CamSeg(deep_supervision=True)
    shapes = [tuple(each.shape[1:]) for each in network(torch.zeros(2, 3, 32, 48))]
    assert shapes == [(11, 8, 12), (11, 4, 6), (11, 2, 3)]
    assert network.eval()(torch.zeros(1, 3, 32, 48)).shape == (1, 11, 8, 12)


def test_unpooling_puts_values_back_where_they_were_the_maximum() -> None:
    x = torch.randn(2, 3, 9, 7)
    pooled, positions = F.max_pool2d(x, 2, ceil_mode=True, return_indices=True)
    again = unpool(pooled, positions, (9, 7))
    assert torch.equal(again, F.max_unpool2d(pooled, positions, 2, output_size=[9, 7]))
    assert ((again == x) | (again == 0)).all()
    assert int((again != 0).sum()) == pooled.numel()


def test_upsampling_starts_bilinear() -> None:
    x = torch.randn(1, 2, 6, 5)
    found = F.conv_transpose2d(x, bilinear(2, 4), stride=4, padding=2)
    expected = F.interpolate(x, scale_factor=4, mode="bilinear", align_corners=False)
    inside = (..., slice(2, -2), slice(2, -2))  # at the border, a transposed convolution pads with zeros
    assert torch.allclose(found[inside], expected[inside], atol=1e-6)


def test_camseg_is_small_enough() -> None:
    network, multiplications = CamSeg().eval(), 0

    def count(module: nn.Module, _: Any, output: Any) -> None:
        nonlocal multiplications
        multiplications += output.numel() * module.weight[0].numel()  # type: ignore[operator, union-attr]

    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            module.register_forward_hook(count)
    network(torch.zeros(1, 3, 360, 480))
    assert weights(network) < 1.5e6
    assert multiplications < 3e9
    dilated = [m for m in network.modules() if isinstance(m, nn.Conv2d) and m.dilation != (1, 1)]
    assert dilated
    assert not any(module.in_channels % 16 for module in dilated)


def test_unlabeled_pixels_are_ignored_and_other_classes_refused(drawn: Path, tmp_path: Path) -> None:
    images = read_camvid(drawn, "train")
    assert images.images.shape == (6, 3, 72, 96)
    assert set(images.labels.unique().tolist()) == {0, 1, 3, 4, 8, IGNORE}
    assert (images.labels[:, 0, 0] == IGNORE).all()
    half = images.scaled(48, 36)
    assert half.images.shape == (6, 3, 36, 48)
    assert set(half.labels.unique().tolist()) <= {0, 1, 3, 4, 8, IGNORE}
    (tmp_path / "classes.json").write_text(json.dumps({"0": "road", "1": "void"}))
    with pytest.raises(ImageError, match="expected"):
        read_camvid(tmp_path, "train")


def test_images_that_teach_nothing_or_are_watched_too_are_refused(drawn: Path, tmp_path: Path) -> None:
    for name in ("void", "twice"):
        shutil.copytree(drawn, tmp_path / name)
    for path in (tmp_path / "void/trainannot").iterdir():
        Image.fromarray(np.full((72, 96), 11, np.uint8)).save(path)
    shutil.copy(tmp_path / "twice/train/002.png", tmp_path / "twice/val/002.png")
    for name, said in (("void", "nothing can be learned"), ("twice", "image 002 is the training image 002")):
        with pytest.raises(ValueError, match=said):
            train(replace(Recipe("camseg"), **SMALL), tmp_path / "run", camvid=tmp_path / name)


@pytest.fixture
def squares() -> tuple[torch.Tensor, torch.Tensor]:
    """Images of squares with a gray for each class, and their labels."""
    rng = np.random.default_rng(0)
    labels = torch.from_numpy(np.kron(rng.integers(0, 11, (8, 6, 8)), np.ones((12, 12))).astype(np.uint8))
    return (labels[:, None] * 10 + 60).expand(-1, 3, -1, -1).contiguous(), labels


def test_augmented_labels_follow_their_pixels(
    monkeypatch: pytest.MonkeyPatch, squares: tuple[torch.Tensor, torch.Tensor]
) -> None:
    """Each class has its own gray, so the label of an augmented pixel can be read off its unchanged color order."""
    monkeypatch.setattr(camvid_images, "FLAWED", 0.0)
    images, labels = squares
    moved, truth = augmented_images(images, labels, np.random.default_rng(1))
    assert moved.shape == images.shape
    assert moved.min() >= 0.0
    assert moved.max() <= 255.0
    outside = truth == IGNORE
    assert 0.0 < outside.float().mean() < 0.5
    for image, its, unknown in zip(moved[:, 0], truth, outside, strict=True):
        # Away from the edges of the squares, equal labels have equal colors, and higher labels are brighter.
        same = (F.max_pool2d(its[None].float(), 5, 1, 2) == -F.max_pool2d(-its[None].float(), 5, 1, 2))[0] & ~unknown
        same[:, [0, -1]] = same[[0, -1]] = False  # the edge of the batch may be the edge of the image
        values = [image[same & (its == k)] for k in range(11) if (same & (its == k)).any()]
        assert all(float(each.max() - each.min()) < 1e-2 for each in values)
        means = [float(each.mean()) for each in values]
        assert means == sorted(means)
    again, _ = augmented_images(images, labels, np.random.default_rng(1))
    assert torch.equal(moved, again)


def test_images_are_blurred_and_get_noise(
    monkeypatch: pytest.MonkeyPatch, squares: tuple[torch.Tensor, torch.Tensor]
) -> None:
    images, labels = squares
    drawn = {}
    for share in (0.0, 0.5, 1.0):
        monkeypatch.setattr(camvid_images, "FLAWED", share)
        drawn[share], truth = augmented_images(images, labels, np.random.default_rng(3))
        assert drawn[share].min() >= 0.0
        assert drawn[share].max() <= 255.0
        again, same = augmented_images(images, labels, np.random.default_rng(3))
        assert torch.equal(drawn[share], again)
        assert torch.equal(truth, same)
    apart = [(drawn[share] - drawn[0.0]).abs().amax((1, 2, 3)) for share in (0.5, 1.0)]
    assert 0 < int((apart[0] == 0.0).sum()) < len(images)  # some images are not disturbed
    assert (apart[1] > 1.0).all()
    means = [drawn[share].mean((1, 2, 3)) for share in (0.0, 1.0)]
    assert (means[0] - means[1]).abs().max() < 3.0  # noise and blur change no image as a whole


def test_each_epoch_draws_each_image_once(drawn: Path) -> None:
    recipe = Recipe("unet-small", **{**SMALL, "batch": 4}, augment=False)
    samples, _ = camvid_samples(Camera.of(recipe), drawn, torch.device("cpu"))
    inputs = normalized(samples.images.images, samples.task.input)
    drawn_images = [
        [bool((x == y).all()) for y in inputs].index(True) for step in range(3) for x in samples.batch(step)[0]
    ]
    assert sorted(drawn_images[:6]) == sorted(drawn_images[6:]) == [*range(6)]
    assert drawn_images[:6] != drawn_images[6:]
    assert [torch.equal(a, b) for a, b in zip(samples.batch(5), samples.batch(5), strict=True)] == [True, True]


def test_loss_is_categorical_cross_entropy_by_the_papers_recipe() -> None:
    task = Camera.of(PAPER["unet"])
    logits = torch.randn(2, 11, 6, 8, requires_grad=True)
    labels = torch.randint(0, 11, (2, 6, 8)).byte()
    labels[0, 0] = IGNORE
    loss = task.loss(logits, [labels])
    assert torch.allclose(loss, F.cross_entropy(logits, labels.long(), ignore_index=IGNORE))


def test_early_logits_and_class_weights_count() -> None:
    task = Camera.of(replace(MODELS["camseg"].recipe, lovasz_weight=0.0))
    labels = torch.full((1, 16, 16), 3, dtype=torch.uint8)
    outputs = tuple(torch.randn(1, 11, n, n) for n in (16, 2, 1))
    logits, *early = outputs
    quarter = labels[:, ::4, ::4]
    expected = cross_entropy(logits, labels) + 0.4 * sum(
        cross_entropy(F.interpolate(one, (4, 4), mode="bilinear"), quarter) for one in early
    )
    assert torch.allclose(task.loss(outputs, [labels]), expected)  # of one class, weights have no effect
    assert sum(class_weights()) / 11 == pytest.approx(1.0)
    assert class_weights()[10] == max(class_weights())  # bicyclists are rarest


def test_lovasz_of_all_classes_at_once_is_the_same() -> None:
    torch.manual_seed(0)
    for n_known in (5, 4, 1, 0):
        logits = torch.randn(2, 5, 9, 11, requires_grad=True)
        labels = torch.randint(0, max(n_known, 1), (2, 9, 11)).byte()
        labels[:, : 9 if n_known == 0 else 2] = IGNORE
        one, other = lovasz_softmax(logits, labels), lovasz_at_once(logits, labels)
        assert torch.allclose(one, other, atol=1e-6)
        slopes = [torch.autograd.grad(each, logits)[0] for each in (one, other)]
        assert torch.allclose(*slopes, atol=1e-4)


def test_figures_follow_the_papers_equations() -> None:
    # Class 0: 5 right, 1 missed, 2 false. Class 1: 2 right, 2 missed, 1 false. Class 2 does not occur.
    found = camvid.figures_of(np.array([[5, 1, 0], [2, 2, 0], [0, 0, 0]]))
    assert found["miou"] == pytest.approx((5 / 8 + 2 / 5) / 2)  # equation 1
    assert found["accuracy"] == pytest.approx(7 / 10)  # equation 2
    f1 = [2 * (5 / 7 * 5 / 6) / (5 / 7 + 5 / 6), 2 * (2 / 3 * 2 / 4) / (2 / 3 + 2 / 4)]  # equations 3 to 5
    assert found["f1"] == pytest.approx(sum(f1) / 2)
    assert found["dice"] == pytest.approx(2 * 7 / (10 + 10))  # equation 6
    found = camvid.figures_of(np.array([[5, 0], [3, 0]]))  # a class that is never found counts as 0
    assert found["miou"] == pytest.approx((5 / 8) / 2)
    assert found["f1"] == pytest.approx((2 * 5 / 8 * 1 / (5 / 8 + 1)) / 2)


def test_confusions_count_each_image(drawn: Path) -> None:
    images = read_camvid(drawn, "validation")

    class Right(nn.Module):
        def forward(self, x: Any) -> Any:
            return F.one_hot(images.labels.long().clamp(max=10), 11).movedim(3, 1).float() * 20.0

    counts, loss, labels = confusions(Right(), images, images.labels, Camera.of(Recipe("unet")).input)
    known = images.labels != IGNORE
    assert counts.shape == (3, 11, 11)
    assert [int(each.sum()) for each in counts] == known.sum((1, 2)).tolist()
    assert counts.sum(0).trace() == counts.sum()
    assert loss < 1e-6
    assert torch.equal(labels[known], images.labels[known])


@pytest.mark.usefixtures("narrow_segnet")
@pytest.mark.parametrize("network", ["camseg", "segnet", "unet-small", "unet-small-leaky"])
def test_one_step_of_each_network(network: str, drawn: Path, tmp_path: Path) -> None:
    recipe = replace(Recipe(network), **{**SMALL, "steps": 1})
    start = build(recipe)
    state = read_checkpoint(train(recipe, tmp_path, camvid=drawn))
    assert [*state["frames"]] == [path.stem for path in sorted((drawn / "train").iterdir())]
    (line,) = (json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines())
    assert line["validation"].keys() == {"mean", *CAMERA_CLASSES}
    changed = [not torch.equal(a, b) for a, b in zip(start.parameters(), state["network"].values(), strict=False)]
    assert any(changed)


def test_a_resumed_run_ends_with_the_same_weights(drawn: Path, tmp_path: Path) -> None:
    recipe = replace(Recipe("camseg"), **{**SMALL, "deep_supervision": 0.4, "dropout": 0.1})
    whole = read_checkpoint(train(recipe, tmp_path / "whole", camvid=drawn, checkpoint_every=2))
    with interrupted_in_step(4, Camera):
        train(recipe, tmp_path / "parts", camvid=drawn, checkpoint_every=2)
    parts = read_checkpoint(train(recipe, tmp_path / "parts", camvid=drawn, checkpoint_every=2))
    assert all(torch.equal(whole["averaged"][name], parts["averaged"][name]) for name in whole["averaged"])


def test_accumulated_gradients_are_those_of_the_batch(drawn: Path, tmp_path: Path) -> None:
    """Of a network without batch norm. One step of Adam is as long as the rate for any gradient, so its sign counts."""
    recipe = replace(PAPER["unet-small"], **{**SMALL, "batch": 4, "steps": 1, "stop_after": 0})
    moments = []
    for n in (1, 4):
        state = read_checkpoint(train(replace(recipe, accumulate=n), tmp_path / str(n), camvid=drawn))
        moments.append(torch.cat([each["exp_avg"].flatten() for each in state["optimizer"]["state"].values()]))
    one, other = moments
    assert float(torch.linalg.norm(one - other) / torch.linalg.norm(one)) < 0.05  # of bf16


def test_training_stops_without_a_better_validation() -> None:
    recipe = replace(PAPER["unet"], stop_after=3)

    def curve(*figures: float) -> list[dict[str, Any]]:
        return [{"step": 11 * (k + 1), "validation": {"mean": figure}} for k, figure in enumerate(figures)]

    assert last_step(recipe, [], 11) == recipe.steps
    assert last_step(recipe, curve(0.1, 0.3, 0.2, 0.3), 11) == recipe.steps
    assert last_step(recipe, curve(0.1, 0.3, 0.2, 0.3, 0.1), 11) == 55
    assert last_step(replace(recipe, stop_after=0), curve(0.3, 0.1, 0.1, 0.1, 0.1), 11) == recipe.steps


def test_the_papers_protocol_keeps_the_best_epoch(drawn: Path, tmp_path: Path) -> None:
    sizes = {"image_width": 48, "image_height": 36, "batch": 2, "accumulate": 2, "steps": 9, "learning_rate": 1e-3}
    state = read_checkpoint(train(replace(PAPER["unet-small"], **sizes), tmp_path, camvid=drawn))
    assert [row["step"] for row in state["curve"]] == [3, 6, 9]  # an epoch is three steps
    assert state["best"] is not None
    with pytest.raises(ValueError, match="give --camvid"):
        train(Recipe("camseg"), tmp_path / "none")
    with pytest.raises(ValueError, match="--fold has no effect on camseg; leave it out"):
        make("camseg", tmp_path, camvid=drawn, fold=1)


def test_comparison_resumes_network_by_network(drawn: Path, tmp_path: Path) -> None:
    assert len(camvid.ELEVEN) == 11
    assert all(len(figures) == 5 for _, _, figures in camvid.ELEVEN.values())
    pytest.importorskip("matplotlib")
    small = {"width": 48, "height": 36, "epochs": 1, "batch": 3, "n_threads": 1}
    names = ["Small U-Net ReLU", "Small U-Net Leaky ReLU"]
    (one,) = camvid.ablate_camvid(drawn, tmp_path, networks=names[1:], **small)  # type: ignore[arg-type]
    first, second = camvid.ablate_camvid(drawn, tmp_path, networks=names, **small)  # type: ignore[arg-type]
    assert (first["name"], second) == (names[0], one)  # in the paper's order, and not trained again
    assert first["budget"] == second["budget"]
    assert first["budget"]["images"] == 6
    low, high = first["miou_interval"]
    assert low <= first["miou"] <= high
    assert not [*tmp_path.rglob("checkpoint.pt")]
    with pytest.raises(ValueError, match="results of the budget"):
        camvid.ablate_camvid(drawn, tmp_path, networks=names, **{**small, "epochs": 2})  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="no network"):
        camvid.ablate_camvid(drawn, tmp_path, networks=["unet"])

    text = camvid.table([first, second])
    assert text.count("\n") == 4
    assert "(0.533)" in text
    for path in camvid.plot_camvid([first, second], tmp_path):
        assert read_image(path).shape[1] > 500
    camvid.show_camvid(tmp_path / "camvid.npz", tmp_path / "own.png")
    camvid.show_camvid(tmp_path / "camvid.npz", tmp_path / "all.png", drawn)
    assert read_image(tmp_path / "own.png").shape[1] == read_image(tmp_path / "all.png").shape[1]
    assert np.load(tmp_path / "camvid.npz")[names[0]].shape == (3, 72, 96)


@pytest.fixture(scope="module")
def trained(drawn: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A checkpoint of camseg and its exported model, of images of 64 x 48."""
    folder = tmp_path_factory.mktemp("camseg")
    recipe = replace(Recipe("camseg"), **{**SMALL, "image_width": 64, "image_height": 48, "steps": 30, "ema": 0.5})
    checkpoint = train(recipe, folder, camvid=drawn)
    export(checkpoint, folder / "camseg.onnx", scans=parity_samples("camera"))
    return checkpoint, folder / "camseg.onnx"


def test_exported_camseg_equals_the_network(trained: tuple[Path, Path]) -> None:
    checkpoint, model = trained
    network, _, _ = load(checkpoint)
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (48, 64, 3), dtype=np.uint8), rng.integers(0, 256, (33, 91, 3), dtype=np.uint8)]
    assert verify(network, model, images)["label_agreement"] > 0.999
    assert model.stat().st_size < 2e6


def test_card_of_camseg_names_camvid(trained: tuple[Path, Path], drawn: Path) -> None:
    card = ModelCard.read(trained[1])
    assert (card.view.kind, card.view.width, card.view.height) == ("camera", 64, 48)
    assert card.classes == CAMERA_CLASSES
    assert re.match("terms of CamVid: .*; images of another set: terms of that set", card.training["licence"])
    assert card.training["data"] == "2 images of CamVid, 4 images of another set"
    figures = evaluate_images([drawn], trained[1], split="validation")
    assert figures["images"]["n_images"] == 3
    (drawn / "test").symlink_to(drawn / "train")
    (drawn / "testannot").symlink_to(drawn / "trainannot")
    with pytest.raises(SplitError):  # the images that it was trained on, as if they were of another split
        evaluate_images([drawn], trained[1], split="test")


@pytest.mark.usefixtures("narrow_segnet")
@pytest.mark.parametrize("name", ["segnet", "unet-small-leaky"])
def test_graphs_of_the_comparison_equal_the_networks(name: str) -> None:
    """Also SegNet's, which unpools; the runtime does not open its operators unless it is told to trust the file."""
    import onnxruntime

    recipe = replace(Recipe(name), **SMALL)
    network = build(recipe).eval()
    graph = to_graph(network, Camera.of(recipe).card)
    session = onnxruntime.InferenceSession(graph.SerializeToString(), providers=["CPUExecutionProvider"])
    x = torch.rand(1, 3, 36, 48)
    with torch.no_grad():
        expected = network(x).numpy()
    (found,) = session.run(None, {"image": x.numpy()})
    assert np.abs(found - expected).max() < 0.01 * expected.std()


def test_int8_of_a_camera(trained: tuple[Path, Path], drawn: Path, tmp_path: Path) -> None:
    calibration = calibration_images(drawn)
    assert len(calibration.scans) == len(calibration.frames) == 6

    def race(one: Path, other: Path, n_threads: int | None) -> Any:
        return np.linspace(2.0, 2.1, 40), np.linspace(1.0, 1.1, 40)

    out, given = tmp_path / "int8.onnx", (calibration, LabeledSets(camvid=drawn))
    card = quantize(trained[1], out, *given, race=race, max_noise=9.0)
    assert card.precision == "int8"
    assert card.training["quantized"]["calibration"] == "6 images"
    assert card.metrics["images"]["n_images"] == 3
    # The record that "auto" decides by, with OpenVINO in bf16 too if it is installed and the processor has bf16.
    records = agree([trained[1], out], kitti=None, camvid=drawn)
    assert records.keys() >= {"fp32", "int8"}
    assert records["int8"]["n_scans"] == 3
    assert records["fp32"]["label_agreement"] == 1.0
    assert records["int8"]["command"] == "edgeperc-export agree camseg --camvid CAMVID --split validation"
    assert ModelCard.read(out).precisions["int8"] == records["int8"]
    with pytest.raises(PointsError, match="is of a camera"):
        agree([trained[1]], kitti=drawn)
    with pytest.raises(SplitError, match="; evaluate other images, or, with"):
        agree([trained[1]], kitti=None, camvid=drawn, split="train")


def test_comparison_is_one_command(drawn: Path, tmp_path: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, Any] = {}
    row = {"name": "SegNet", "parameters": 1, "miou_interval": [0.1, 0.2], **dict.fromkeys(camvid.FIGURES, 0.15)}
    monkeypatch.setattr(camvid, "ablate_camvid", lambda root, out, **given: asked.update(given) or [row])
    command = ["ablate", "camvid", str(tmp_path), "--camvid", str(drawn), "--size", "96x72", "--variant", "SegNet"]
    assert "0.150 (0.486)" in shell.out(*command, "--no-plots")
    assert (tmp_path / "camvid.md").read_text().startswith("| network")
    assert (asked["width"], asked["height"], asked["networks"]) == (96, 72, ["SegNet"])
    assert "give --camvid" in shell.err("ablate", "camvid", tmp_path)
    assert "give --kitti and --simulated" in shell.err("ablate", "pointseg", tmp_path)
