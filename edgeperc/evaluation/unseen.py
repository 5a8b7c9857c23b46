"""Raise an error when a model would be evaluated on a scan that it was trained on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..datasets.kitti import scan_hash
from ..errors import SplitError
from ..types.card import ModelCard

__all__ = ["check_unseen", "training_scans_of"]


def training_scans_of(cards: Sequence[ModelCard]) -> dict[str, set[str]]:
    """Read from cards the `scan_hash` of every real training scan, by name and version of the model."""
    frames = {f"{card.name} {card.version}": card.training.get("frames", {}) for card in cards}
    return {name: set(of.values()) if isinstance(of, Mapping) else set() for name, of in frames.items()}


def check_unseen(trained_on: Mapping[str, set[str]], name: str, drive: str, points: NDArray[np.float32]) -> None:
    """Raise `SplitError` if one of the models was trained on this scan (see `training_scans_of`)."""
    digest = scan_hash(points)
    for model, hashes in trained_on.items():
        if digest in hashes:
            raise SplitError(
                f"{model} was trained on scan {name} of drive {drive}, so figures on it are too good; evaluate the "
                "test split, or a model trained without this drive, or ask for split 'train'"
            )
