"""Accuracy of camera models on labeled images in CamVid's layout (Brostow et al., 2008 and 2009).

Each image is reduced to its confusion matrix. Figures are of the summed matrices of all images, so every pixel counts
the same, as in the papers. Intervals are from resampled images. Images of one drive resemble one another, so intervals
over drives would be wider; CamVid's validation images are of a single drive.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..datasets.images import FOLDERS, LabeledImages, image_hash
from ..errors import CardMismatchError, OptionError, SplitError
from ..perceiver import Perceiver
from ..types.card import ModelCard
from ..types.points import Bytes, Floats, Ints64
from .judge import training_scans_of
from .metrics import Confusion, mean
from .tables import interval, plain
from .truth import check_different


def evaluate_images(
    roots: Sequence[Path],
    model: str | Path,
    *,
    split: str | None = None,
    provider: str = "cpu",
    precision: str = "auto",
    on_image: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Compute the figures of a camera model on labeled images; ``split`` None is that of the test images if there are
    any, else of the validation images. Raises ImageError, CardMismatchError, OptionError, PointsError,
    SplitError.
    """
    check_different(roots)
    perceive = Perceiver([model], provider=provider, precision=precision)
    (card,) = perceive.cards
    if card.view.kind != "camera":
        raise OptionError(f"{card.name} is of a {card.view.kind}; images need a camera model such as camseg")
    data = [LabeledImages(root) for root in roots]
    if split is None:
        split = "test" if any((each.root / FOLDERS["test"]).is_dir() for each in data) else "validation"
    for each in data:
        check_classes(each, card)
    files = [(each, file) for each in data for file in each.files(split)]
    trained_on = {} if split == "train" else training_scans_of(perceive.cards)
    counts = []
    for done, (each, file) in enumerate(files, start=1):
        image, truth = each.read(file)
        check_unseen_image(trained_on, image, file)
        confusion = Confusion(card.classes)
        confusion.update(perceive(image=image).require_image().labels, truth)
        counts.append(confusion.counts)
        on_image(done, len(files))
    return {
        "models": {card.name: card.version},
        "providers": dict(perceive.providers),
        "split": split,
        "fold": None,
        "images": image_figures(card.classes, np.stack(counts)),
    }


def check_unseen_image(trained_on: Mapping[str, set[str]], image: Bytes, file: Path) -> None:
    """Raise `SplitError` if one of the models was trained on this image (see `training_scans_of`)."""
    for name, hashes in trained_on.items():
        if image_hash(image) in hashes:
            raise SplitError(
                f"{name} was trained on {file}; evaluate other images, or, with 'edgeperc eval', ask for split 'train'"
            )


def check_classes(data: LabeledImages, card: ModelCard) -> None:
    """Raise `CardMismatchError` if the classes of images are not those of a model, in their order."""
    if [name.casefold() for name in data.classes] != [name.casefold() for name in card.classes]:
        raise CardMismatchError(f"{card.name} has classes {card.classes}; those of {data.root} are {data.classes}")


def image_figures(classes: Sequence[str], counts: Ints64, n_resamples: int = 1000) -> dict[str, Any]:
    """Figures of the summed confusion matrices (n, C, C) of images, of all and of each class, with 95 % intervals over
    resampled images (None with fewer than two); shares have four decimals, None for those of no pixels.
    """
    n, n_classes, _ = counts.shape
    rng = np.random.default_rng(0)
    weights = rng.multinomial(n, np.full(n, 1.0 / n), n_resamples) if n > 1 else np.zeros((0, n), np.int64)
    summed = [counts.sum(axis=0), *(weights @ counts.reshape(n, -1)).reshape(-1, n_classes, n_classes)]
    of_all, of_classes = zip(*(_rates(classes, each) for each in summed), strict=True)
    n_pixels = counts.sum(axis=2)
    rows = {
        name: _with_intervals([{key: values[k] for key, values in each.items()} for each in of_classes])
        | {"n_pixels": int(n_pixels[:, k].sum()), "n_images": int((n_pixels[:, k] > 0).sum())}
        for k, name in enumerate(classes)
    }
    return {"n_images": n, "all": _with_intervals(of_all) | {"n_pixels": int(n_pixels.sum())}, "classes": rows}


def _rates(classes: Sequence[str], counts: Ints64) -> tuple[dict[str, float], dict[str, Floats]]:
    """Rates of a confusion matrix over all pixels, and of each class."""
    confusion = Confusion(classes, counts)
    iou, recall = confusion.iou(), confusion.recall()
    of_all = {"mean_iou": mean(iou), "mean_accuracy": mean(recall), "accuracy": confusion.accuracy()}
    return of_all, {"iou": iou, "precision": confusion.precision(), "recall": recall}


def _with_intervals(rates: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """The first rates, each with the interval of the others."""
    intervals = {f"{key}_interval": interval(np.array([each[key] for each in rates[1:]])) for key in rates[0]}
    row: dict[str, Any] = plain({key: float(value) for key, value in rates[0].items()} | intervals)
    return row
