"""Accuracy of camera models on labeled images: figures counted by hand, intervals, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny_camera
from numpy.typing import NDArray

from cli_helpers import Shell

pillow = pytest.importorskip("PIL.Image")

from edgeperc import CardMismatchError, ImageError, OptionError, SplitError
from edgeperc.datasets.images import LabeledImages, image_hash
from edgeperc.evaluation.camvid import evaluate_images, image_figures

COLORS = np.uint8([[20, 10, 200], [200, 10, 20], [10, 200, 20]])  # of sky, road and tree, as the tiny model has them
HEIGHT, WIDTH = 24, 32


def write_set(root: Path, ids: dict[str, NDArray[np.uint8]], names: tuple[str, ...] = tiny_camera.CLASSES) -> Path:
    """Images whose colors are the classes 0, 1 and 2 in stripes of 8 columns, with the given labels."""
    document = {str(k): name for k, name in enumerate((*names, "Unlabeled"))}
    root.mkdir(exist_ok=True)
    (root / "classes.json").write_text(json.dumps(document))
    for name, labels in ids.items():
        folder, _, stem = name.partition("/")
        for each in (folder, f"{folder}annot"):
            (root / each).mkdir(exist_ok=True)
        pillow.fromarray(labels).save(root / f"{folder}annot" / f"{stem}.png")
        pillow.fromarray(np.broadcast_to(COLORS[stripes()], (HEIGHT, WIDTH, 3)).copy()).save(
            root / folder / f"{stem}.webp", lossless=True
        )
    return root


def stripes() -> NDArray[np.int64]:
    return np.repeat([0, 1, 2, 0], 8)


def labels(*classes: int) -> NDArray[np.uint8]:
    """True classes of the four stripes."""
    return np.broadcast_to(np.repeat(np.uint8(classes), 8), (HEIGHT, WIDTH)).copy()


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return tiny_camera.write_camera(tmp_path)


def test_figures_are_those_counted_by_hand(tmp_path: Path, model: Path) -> None:
    """One image is right, unlabeled in its last stripe; in the other a stripe of road is a tree."""
    root = write_set(tmp_path / "set", {"val/a": labels(0, 1, 2, 3), "val/b": labels(0, 2, 2, 0)})
    done: list[tuple[int, int]] = []
    figures = evaluate_images([root], model, on_image=lambda *at: done.append(at))
    assert done == [(1, 2), (2, 2)]
    assert (figures["split"], figures["models"]) == ("validation", {"tinycam": "1"})
    images = figures["images"]
    stripe = HEIGHT * 8
    assert (images["n_images"], images["all"]["n_pixels"]) == (2, 7 * stripe)
    assert images["all"]["accuracy"] == round(6 / 7, 4)
    rows = images["classes"]
    assert [rows[name]["iou"] for name in tiny_camera.CLASSES] == [1.0, 0.5, round(2 / 3, 4)]
    assert [rows[name]["recall"] for name in tiny_camera.CLASSES] == [1.0, 1.0, round(2 / 3, 4)]
    assert [rows[name]["precision"] for name in tiny_camera.CLASSES] == [1.0, 0.5, 1.0]
    assert [rows[name]["n_pixels"] for name in tiny_camera.CLASSES] == [3 * stripe, stripe, 3 * stripe]
    assert [rows[name]["n_images"] for name in tiny_camera.CLASSES] == [2, 1, 2]
    assert images["all"]["mean_iou"] == round((1.0 + 0.5 + 2 / 3) / 3, 4)
    assert images["all"]["mean_iou_interval"][0] < images["all"]["mean_iou"] < images["all"]["mean_iou_interval"][1]
    assert rows["Sky"]["iou_interval"] == [1.0, 1.0]
    json.dumps(figures, allow_nan=False)


def test_intervals_are_quantiles_of_resampled_images() -> None:
    rng = np.random.default_rng(1)
    counts = rng.integers(0, 50, (40, 3, 3)) + 100 * np.eye(3, dtype=np.int64)
    figures = image_figures("abc", counts, 2000)
    drawn = counts[np.random.default_rng(5).integers(0, 40, (2000, 40))].sum(axis=1)
    hits = np.diagonal(drawn, axis1=1, axis2=2)
    iou = hits / (drawn.sum(axis=1) + drawn.sum(axis=2) - hits)
    np.testing.assert_allclose(
        figures["classes"]["b"]["iou_interval"], np.quantile(iou[:, 1], [0.025, 0.975]), atol=0.004
    )
    np.testing.assert_allclose(
        figures["all"]["mean_iou_interval"], np.quantile(iou.mean(axis=1), [0.025, 0.975]), atol=0.004
    )


def test_classes_that_do_not_occur_have_no_figures() -> None:
    counts = np.zeros((1, 3, 3), np.int64)
    counts[0, :2, :2] = [[3, 1], [0, 4]]
    figures = image_figures("abc", counts)
    assert figures["classes"]["c"]["iou"] is None
    assert figures["all"]["mean_iou"] == round((3 / 4 + 4 / 5) / 2, 4)
    assert figures["all"]["mean_iou_interval"] is None


def test_splits(tmp_path: Path, model: Path) -> None:
    right = labels(0, 1, 2, 0)
    root = write_set(tmp_path / "set", {"train/a": right, "val/b": right, "val/c": right})
    (root / "val/._b.webp").touch()
    data = LabeledImages(root)
    assert [[file.stem for file in data.files(split)] for split in ("train", "validation", "held-back", "all")] == [
        *(["a"], ["b", "c"], ["b", "c"], ["a", "b", "c"])
    ]
    with pytest.raises(ImageError, match=r"no images of split test; expected some in .*test"):
        data.files("test")
    assert evaluate_images([root], model)["split"] == "validation"
    write_set(root, {"test/d": right})
    assert evaluate_images([root], model)["split"] == "test"
    pillow.fromarray(right).save(root / "test/d.png")
    with pytest.raises(ImageError, match=r"d\.png and .*d\.webp would share the labels d\.png"):
        data.files("test")


def test_a_model_is_not_evaluated_on_what_it_was_trained_on(tmp_path: Path) -> None:
    root = write_set(tmp_path / "set", {"val/a": labels(0, 1, 2, 0)})
    image, _ = LabeledImages(root).read(root / "val" / "a.webp")
    card = tiny_camera.camera_card()
    path = tmp_path / "trained.onnx"
    path.write_bytes(tiny_camera.camera_model(replace(card, training={"frames": {"a": image_hash(image)}})))
    with pytest.raises(SplitError, match=r"tinycam 1 was trained on .*a\.webp; evaluate other images"):
        evaluate_images([root], path)
    assert evaluate_images([write_set(root, {"train/a": labels(0, 1, 2, 0)})], path, split="train")["split"] == "train"


def test_what_cannot_be_evaluated(tmp_path: Path, model: Path) -> None:
    right = labels(0, 1, 2, 0)
    root = write_set(tmp_path / "set", {"val/a": right}, ("Sky", "Tree", "Road"))
    with pytest.raises(CardMismatchError, match="tinycam has classes"):
        evaluate_images([root], model)
    with pytest.raises(OptionError, match="pointseg is of a range_image; images need a camera model"):
        evaluate_images([root], "pointseg")
    write_set(root, {"val/a": right})
    annotation = root / "valannot" / "a.png"
    pillow.fromarray(right[:20]).save(annotation)
    with pytest.raises(ImageError, match="32 x 20 pixels of mode L; expected an id for each of the 32 x 24"):
        evaluate_images([root], model)
    pillow.fromarray(labels(0, 1, 2, 255)).save(annotation)
    assert evaluate_images([root], model)["images"]["all"]["n_pixels"] == 3 * 8 * HEIGHT
    pillow.fromarray(labels(0, 1, 2, 4)).save(annotation)
    with pytest.raises(ImageError, match="192 pixels have ids up to 4; expected the ids 0 to 3 of"):
        evaluate_images([root], model)
    sorted_by_number = pillow.fromarray(labels(1, 0, 2, 2))  # as a palette of the grays 2, 0, 1
    sorted_by_number.putpalette(np.repeat(np.uint8([2, 0, 1]), 3).tobytes())
    sorted_by_number.save(annotation)
    with pytest.raises(ImageError, match="the grays of its palette are ids in another order"):
        evaluate_images([root], model)
    annotation.write_bytes(b"no image")
    with pytest.raises(ImageError, match="the labels cannot be read"):
        evaluate_images([root], model)
    annotation.unlink()
    with pytest.raises(ImageError, match="the labels cannot be read"):
        evaluate_images([root], model)
    for text in ("[]", "{", '{"1": "Sky"}', "3"):
        (root / "classes.json").write_text(text)
        if text != "[]":
            with pytest.raises(ImageError, match="expected an object of id and name"):
                LabeledImages(root)


def test_the_table_of_images(tmp_path: Path, model: Path, shell: Shell) -> None:
    root = write_set(tmp_path / "set", {"val/a": labels(0, 1, 2, 3), "val/b": labels(0, 2, 2, 0)})
    lines = shell.out("eval", root, "--model", model, "--json", tmp_path / "figures.json").splitlines()
    assert lines[0] == "tinycam 1; validation images; shares in per cent, intervals over images"
    assert "== 2 images, 3 classes, unlabeled pixels not counted ==" in lines
    (row,) = (line.split() for line in lines if line.startswith("  Road"))
    assert row[:2] == ["Road", "50.0"]
    document = json.loads((tmp_path / "figures.json").read_text())
    assert document["images"]["classes"]["Road"]["iou"] == 0.5
    for arguments, said in (
        ((root, "simulation:1"), "different figures"),
        ((root, "--fold", "0"), "--fold needs scans"),
        ((root, "--worst", tmp_path / "w.png"), "--worst needs scans"),
        ((root, "--weights", "open"), "--weights needs scans"),
        ((root, "--boxes-from", "clusters"), "--boxes-from needs scans"),
        ((root, "--without-rule", "boxes"), "--without-rule needs scans"),
        ((root, "--model", model, "--model", model), "got 2 models"),
    ):
        assert said in shell.err("eval", *arguments)


@pytest.mark.parametrize("name", ["unlabeled", "Unlabelled", "VOID"])
def test_a_class_of_unlabeled_pixels_is_not_a_class(tmp_path: Path, name: str) -> None:
    root = write_set(tmp_path / "set", {"val/a": labels(0, 1, 2, 0)}, ("Sky", "Road", name))
    data = LabeledImages(root)
    assert data.classes == ("Sky", "Road")
    assert {*np.unique(data.read(root / "val" / "a.webp")[1]).tolist()} == {0, 1, 255}


def test_camvid_is_read(data_root: Callable[[str], Path]) -> None:
    data = LabeledImages(data_root("camvid"))
    assert len(data.classes) == 11
    assert [len(data.files(split)) for split in ("train", "validation")] == [367, 101]
    image, truth = data.read(data.files("validation")[0])
    assert image.shape == (360, 480, 3)
    assert {*np.unique(truth).tolist()} <= {*range(11), 255}
