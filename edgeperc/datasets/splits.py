"""The drives for training, validation and testing.

Frames of one drive look similar, so whole drives are assigned to a split. Test drives are only used for the final
figures. No model is trained on their scans or on their layouts (the boxes that simulated scenes are built around), and
no decision is based on them. Training recipes are compared by cross-validation on the folds of the training drives.
Shipped models are compared on the validation drives.
"""

from __future__ import annotations

from typing import Any

from ..errors import OptionError, PointsError


def _drives(*names: str) -> frozenset[str]:
    """Drives of KITTI in 2011, by month, day and number."""
    return frozenset(f"2011_{name[:5]}_drive_{name[6:]}" for name in names)


# Three object drives with cars, vans, trucks, pedestrians and cyclists, and all of SemanticKITTI's sequence 00.
TEST_DRIVES = _drives("09_26 0011", "09_26 0015", "09_26 0032", "10_03 0027")

# Fold 0 is one long drive with most of the cyclists; the others are many short drives.
FOLDS = (
    _drives("09_26 0005"),
    _drives(
        *("09_26 0029", "09_26 0036", "09_26 0046", "09_26 0048", "09_26 0052", "09_26 0064", "09_26 0096"),
        "09_28 0002",
    ),
    _drives(
        *("09_26 0013", "09_26 0014", "09_26 0022", "09_26 0023", "09_26 0059", "09_26 0070"),
        *("09_29 0026", "10_03 0047"),
    ),
)


# No shipped model was trained on these scans, but simulated training scenes use their layouts. These drives decide
# which network is shipped for a task, and which precisions are accurate enough.
VALIDATION_DRIVES = _drives(
    *("09_26 0001", "09_26 0020", "09_26 0027", "09_26 0039", "09_26 0060", "09_26 0087", "09_26 0095"),
    *("09_28 0001", "09_28 0016", "09_28 0043", "09_28 0141", "09_28 0185", "09_29 0071"),
)


def fold_of(drive: str) -> int | None:
    """The fold of a training drive, 0 to 2; None for any other drive."""
    return next((k for k, drives in enumerate(FOLDS) if drive in drives), None)


def in_split(drive: str, split: str, fold: int | None = None) -> bool:
    """Whether a drive is of "train", "validation", "test" or "all". With a ``fold`` that one is for validation, else
    `VALIDATION_DRIVES`. A user's own drive is for training and testing: cards hold hashes. Raises OptionError.
    """
    if split not in ("train", "validation", "test", "all"):
        raise OptionError(f"split is {split!r}; expected train, validation, test or all")
    if fold is not None and fold not in range(len(FOLDS)):
        raise OptionError(f"fold is {fold!r:.80}; expected 0 to {len(FOLDS) - 1}")
    drive_fold = fold_of(drive)
    if drive in VALIDATION_DRIVES:
        return split == "all" or (split == "validation" and fold is None)
    if drive_fold is None:
        return split in (("all", "test") if drive in TEST_DRIVES else ("all", "test", "train"))
    return split in ("all", "validation" if drive_fold == fold else "train")


def names_of(scans: Any, split: str, fold: int | None = None) -> list[str]:
    """Names of a data set's scans of a split, "held-back" too: validation and test. PointsError without any."""
    parts = ("validation", "test") if split == "held-back" else (split,)
    names = [name for part in parts for name in scans.names(part, fold=fold)]
    if not names:
        raise PointsError(
            f"{scans.root} has no scans of the {split} drives (fold: {fold}); ask for another split, or all, or list "
            "drives for this one: 'splits' in the description of a set"
        )
    return names
